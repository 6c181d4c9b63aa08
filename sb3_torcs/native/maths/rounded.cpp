// Six functions that are rounded correctly, each in two ways: in doubles, and in quadruple
// precision where the former is too near to the middle between two floats, which is once in
// millions of calls.
#include <cmath>
#include <limits>

#include "bits.h"
#include "maths.h"

namespace torcs::maths {
namespace {

using Quad = __float128;  // by the compiler's own library, in integers: the same everywhere

template <typename Real>
constexpr Real absolute(Real x) {
    return x < 0 ? -x : x;
}

// Round to the nearest float.
//
// The doubles below are wrong by less than eight of their last digits; twice that is the margin.
template <typename Exact>
float rounded(double value, Exact exact) {
    constexpr std::uint64_t SURPLUS = (1 << 29) - 1, MIDDLE = 1 << 28, MARGIN = 16;
    constexpr double SMALLEST_NORMAL = std::numeric_limits<float>::min();
    const bool unsure = (bits(value) & SURPLUS) - (MIDDLE - MARGIN) <= 2 * MARGIN;
    if (unsure || std::fabs(value) < SMALLEST_NORMAL) return static_cast<float>(exact());
    return static_cast<float>(value);
}

// Of a float, below which x plus or minus a third of its cube rounds to x.
constexpr float TINY = 0x1p-13f;

// ---- Arc tangent --------------------------------------------------------------------------------

// Its Taylor series, for numbers of at most an eighth; the 19th term is below the last digit.
constexpr Quad arc_series(Quad t) {
    const Quad square = t * t;
    Quad sum = 0;
    for (int n = 39; n >= 1; n -= 2) sum = 1 / Quad(n) - square * sum;
    return t * sum;
}

constexpr Quad PI = 16 * arc_series(1 / Quad(5)) - 4 * arc_series(1 / Quad(239));  // Machin 1706

// The angle in a right triangle: num >= 0, den > 0.
constexpr Quad arc_tangent(Quad num, Quad den) {
    constexpr Quad STEP = 1 / Quad(8), ANGLE = arc_series(STEP);
    const bool steep = num > den;
    Quad t = steep ? den / num : num / den, angle = 0;
    for (; t > STEP; angle += ANGLE) t = (t - STEP) / (1 + STEP * t);
    angle += arc_series(t);
    return steep ? PI / 2 - angle : angle;
}

// Slopes from 2^-5 to 2^5, eight per octave, each with the angle of its middle.
constexpr int CELLS = 80;
constexpr std::uint64_t FIRST_CELL = 0x3fa0000000000000 >> 49;

struct Angles {
    double of[CELLS] = {};

    constexpr Angles() {
        Quad octave = 1 / Quad(32);
        for (int i = 0; i < CELLS; i++) {
            of[i] = static_cast<double>(arc_tangent(octave * (17 + 2 * (i % 8)), 16));
            if (i % 8 == 7) octave *= 2;
        }
    }
};
constexpr Angles ANGLES;

// Divisions by 1 disappear where this is part of its caller.
inline __attribute__((always_inline)) double arc_tangent(double num, double den) {
    constexpr double FLATTEST = 0x1p-5, STEEPEST = 0x1p5, HALF_PI = static_cast<double>(PI / 2);
    const double slope = num / den;
    double angle = 0.0, t = slope;
    if (slope >= STEEPEST) {
        angle = HALF_PI;
        t = -den / num;
    } else if (slope >= FLATTEST) {
        const std::uint64_t cell = bits(slope) >> 49;
        const double middle = from_bits(cell << 49 | std::uint64_t{1} << 48);
        angle = ANGLES.of[cell - FIRST_CELL];
        t = (num - middle * den) / (den + middle * num);
    }
    // The minimax polynomial of atan(t) / t - 1 in the square of t up to 2^-10, by mpmath; it is
    // wrong by 2^-60.
    const double t2 = t * t;
    const double series = (-0x1.555555555554ap-2 + t2 * 0x1.99999998dfb88p-3) +
                          t2 * t2 * (-0x1.24923a9e77a75p-3 + t2 * 0x1.c662795501790p-4);
    return angle + (t + t * t2 * series);
}

// The angle of a vector, neither of whose numbers is infinite and not both of which are 0.
template <typename Real>
inline __attribute__((always_inline)) Real direction(Real y, Real x) {
    if (x == 0) return (y < 0 ? -1 : 1) * static_cast<Real>(PI / 2);
    const Real acute = arc_tangent(absolute(y), absolute(x));
    const Real angle = x < 0 ? static_cast<Real>(PI) - acute : acute;
    return y < 0 ? -angle : angle;
}

// The square root of 1 - x * x.
double other_leg(double x) { return std::sqrt((1.0 - x) * (1.0 + x)); }

Quad other_leg(Quad x) {
    const Quad square = (1 - x) * (1 + x);
    if (square == 0) return 0;
    const Quad near = std::sqrt(static_cast<double>(square));
    const Quad nearer = (near + square / near) / 2;  // Heron's step doubles the digits
    return (nearer + square / nearer) / 2;
}

// ---- Tangents -----------------------------------------------------------------------------------

struct Ratio {
    Quad num, den;
};

// sin : cos if `sign` is -1, sinh : cosh if it is 1. By Taylor's series; all of hyperbolic ones'
// terms are positive, and circular ones get at most an eighth of a turn.
constexpr Ratio tangent_series(Quad x, int sign) {
    constexpr Quad LAST = 1e-36;  // relative to the first
    Ratio ratio = {0, 1};
    Quad term = 1;
    for (int n = 1; n < 20 || absolute(term) > LAST; n++) {
        term *= x / n;
        if (n % 2 == 1) {
            ratio.num += term;
            term *= sign;
        } else {
            ratio.den += term;
        }
    }
    return ratio;
}

// Tangents, circular and hyperbolic, of the middles of cells of a sixteenth.
template <int Number, int Sign>
struct Tangents {
    double of[Number] = {};

    constexpr Tangents() {
        for (int i = 0; i < Number; i++) {
            const Ratio ratio = tangent_series(i / Quad(16), Sign);
            of[i] = static_cast<double>(ratio.num / ratio.den);
        }
    }
};
constexpr Tangents<14, -1> CIRCULAR;
constexpr Tangents<146, 1> HYPERBOLIC;

// The tangent as a fraction, by the formula for sums of angles.
struct Fraction {
    double num, den;
};

Fraction tangent(double size, int sign, const double* table) {
    const int cell = (static_cast<int>(size * 32.0) + 1) / 2;  // the nearest
    const double rest = size - cell / 16.0, middle = table[cell], square = -sign * rest * rest;
    // The minimax polynomial of tan(x) / x - 1 in the square of x from -2^-10 to 2^-10, by mpmath;
    // it is wrong by 2^-59. The hyperbolic tangent is that of an imaginary angle.
    const double series = (0x1.5555555555543p-2 + square * 0x1.1111111111102p-3) +
                          square * square * (0x1.ba1ba643d481ap-5 + square * 0x1.664f4c3068b9dp-6);
    const double small = rest + rest * (square * series);
    return {middle + small, 1.0 + sign * middle * small};
}

// A whole number of quarter turns, and what is left: at most about an eighth of a turn.
template <typename Real>
struct Quarters {
    Real rest;
    bool odd;
};

constexpr float MANY_TURNS = 0x1p20f;  // [rad] beyond them the digits of `reduce` do not suffice

Quarters<double> reduce(double x) {
    if (std::fabs(x) < 0.75) return {x, false};
    constexpr double PARTS[] = {0x1.921fb54400000p+0, 0x1.0b4611a600000p-34, 0x1.3198a2e037073p-69};
    constexpr double ROUNDER = 0x1.8p52, TWO_OVER_PI = 0x1.45f306dc9c883p-1;
    const double shifted = x * TWO_OVER_PI + ROUNDER, number = shifted - ROUNDER;
    const double rest = ((x - number * PARTS[0]) - number * PARTS[1]) - number * PARTS[2];
    return {rest, (bits(shifted) & 1) != 0};
}

// x is the mantissa times 2^exponent. Of 2/pi those 192 digits matter that neither make up whole
// turns nor are beyond the last digit of the result.
template <typename Real>
Quarters<Real> reduce_exactly(float x) {
    if (std::fabs(x) < 0.75f) return {x, false};
    using Wide = unsigned __int128;
    const std::uint64_t mantissa = (bits(x) & 0x7fffff) | 0x800000;
    const int exponent = static_cast<int>(bits(x) >> 23 & 0xff) - 150;
    const int place = exponent - 1;  // so the product's first two digits are quarters
    const Wide low = Wide(mantissa) * digits_of_two_over_pi(place + 128);
    const Wide middle = Wide(mantissa) * digits_of_two_over_pi(place + 64) + (low >> 64);
    const std::uint64_t high =
        mantissa * digits_of_two_over_pi(place) + static_cast<std::uint64_t>(middle >> 64);
    // In units of 2^-126 quarter turns.
    Wide turned = Wide(high) << 64 | static_cast<std::uint64_t>(middle);
    const Wide number = (turned + (Wide(1) << 125)) >> 126;
    turned -= number << 126;
    const Real unit = static_cast<Real>(PI / 2) * 0x1p-126;
    const Real rest = static_cast<Real>(static_cast<__int128>(turned)) * unit;
    return {x < 0.0f ? -rest : rest, (number & 1) != 0};
}

Quad tangent_exactly(float x) {
    const Quarters<Quad> at = reduce_exactly<Quad>(x);
    const Ratio ratio = tangent_series(at.rest, -1);
    return at.odd ? -ratio.den / ratio.num : ratio.num / ratio.den;
}

Quad hyperbolic_tangent_exactly(float x) {
    const Ratio ratio = tangent_series(x, 1);
    return ratio.num / ratio.den;
}

// Everything in quadruple precision is kept out of the way of the usual case.
#define RARELY [=]() __attribute__((noinline, cold))->Quad

}  // namespace

float tanf(float x) {
    if (std::fabs(x) < TINY) return x;
    if (!std::isfinite(x)) return x - x;
    const Quarters<double> at = std::fabs(x) < MANY_TURNS ? reduce(x) : reduce_exactly<double>(x);
    const Fraction found = tangent(std::fabs(at.rest), -1, CIRCULAR.of);
    const double size = at.odd ? -found.den / found.num : found.num / found.den;
    return rounded(std::copysign(1.0, at.rest) * size, RARELY { return tangent_exactly(x); });
}

float tanhf(float x) {
    constexpr float ONE = 9.03125f;  // from here on 1 is the nearest float
    const float size = std::fabs(x);
    if (size < TINY || std::isnan(x)) return x + 0.0f * x;
    if (size >= ONE) return std::copysign(1.0f, x);
    const Fraction found = tangent(size, 1, HYPERBOLIC.of);
    return rounded(
        std::copysign(found.num / found.den, x), RARELY { return hyperbolic_tangent_exactly(x); });
}

float atanf(float x) {
    if (std::fabs(x) < TINY || std::isnan(x)) return x + 0.0f * x;
    if (std::isinf(x)) return std::copysign(static_cast<float>(PI / 2), x);
    return rounded(direction<double>(x, 1.0), RARELY { return direction<Quad>(x, 1); });
}

float asinf(float x) {
    if (std::fabs(x) < TINY) return x;
    if (!(std::fabs(x) <= 1.0f)) return (x - x) / (x - x);
    return rounded(
        direction(double{x}, other_leg(double{x})),
        RARELY { return direction(Quad(x), other_leg(Quad(x))); });
}

float acosf(float x) {
    if (!(std::fabs(x) <= 1.0f)) return (x - x) / (x - x);
    return rounded(
        direction(other_leg(double{x}), double{x}),
        RARELY { return direction(other_leg(Quad(x)), Quad(x)); });
}

float atan2f(float y, float x) {
    if (std::isnan(x) || std::isnan(y)) return x + y;
    if (y == 0.0f) return std::signbit(x) ? std::copysign(static_cast<float>(PI), y) : y;
    if (std::isinf(y)) {  // as if an infinite x were as long
        const Quad angle = !std::isinf(x) ? PI / 2 : x < 0.0f ? 3 * PI / 4 : PI / 4;
        return std::copysign(static_cast<float>(angle), y);
    }
    if (std::isinf(x)) return std::copysign(x < 0.0f ? static_cast<float>(PI) : 0.0f, y);
    return rounded(
        direction<double>(y, x), RARELY {
            // An angle is less than its tangent. Where it is too small for that to show in a Quad,
            // a quotient in the middle between two subnormal floats has to be rounded down.
            const Quad angle = direction<Quad>(y, x);
            return absolute(angle) < 0x1p-50 ? angle * (1 - Quad(0x1p-110)) : angle;
        });
}

double atan2(double y, double x) {
    if (y == 0.0) return std::copysign(std::signbit(x) ? static_cast<double>(PI) : 0.0, y);
    return direction(y, x);
}

}  // namespace torcs::maths
