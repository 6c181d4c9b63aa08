// Five functions with exactly the results of glibc 2.28 to 2.41 on a processor with FMA.
//
// The algorithms and all numbers are those of Arm's optimized routines (sincosf, expf and logf of
// 2017 and 2018, MIT licence, also in glibc). Their results depend on which products and sums the
// compiler has fused, so each fusion is written out here: `fused(a, b, c)` is a * b + c, rounded
// once.
#include <cmath>
#include <limits>

#include "bits.h"
#include "maths.h"

namespace torcs::maths {
namespace {

constexpr float INF = std::numeric_limits<float>::infinity();

// Code that is compiled for two processors, once with each of these.
#define EITHER inline __attribute__((always_inline))
#define FOR_FMA __attribute__((target("fma")))

// What is near enough where the last digits of a double do not matter.
struct Separate {
    static EITHER double fused(double a, double b, double c) { return a * b + c; }
};

struct Processor {
    static constexpr bool IS_QUICK = true;
    static EITHER double fused(double a, double b, double c) { return __builtin_fma(a, b, c); }
};

struct Additions {
    static constexpr bool IS_QUICK = false;

    struct Sum {
        double nearest, rest;
    };

    // Knuth's two-sum.
    static Sum sum(double a, double b) {
        const double nearest = a + b, part = nearest - a;
        return {nearest, (a - (nearest - part)) + (b - part)};
    }

    // Dekker's and Veltkamp's product.
    static Sum product(double a, double b) {
        constexpr double SPLITTER = 0x1p27 + 1.0;
        const double ca = SPLITTER * a, cb = SPLITTER * b;
        const double a1 = ca - (ca - a), b1 = cb - (cb - b), a2 = a - a1, b2 = b - b1;
        const double nearest = a * b;
        return {nearest, ((a1 * b1 - nearest) + a1 * b2 + a2 * b1) + a2 * b2};
    }

    // Boldo and Melquiond 2008 (doi 10.1109/TC.2007.70819): the small parts are summed up with
    // rounding to odd. Exact as long as no part is subnormal or infinite.
    static double fused(double a, double b, double c) {
        const Sum ab = product(a, b), low = sum(c, ab.rest), high = sum(ab.nearest, low.nearest);
        Sum rest = sum(low.rest, high.rest);
        if (rest.rest != 0.0 && bits(rest.nearest) % 2 == 0)
            rest.nearest = from_bits(bits(rest.nearest) +
                                     ((rest.rest > 0.0) == (rest.nearest > 0.0) ? 1 : -1));
        return high.nearest + rest.nearest;
    }
};

// Round what a formula yields by fused operations. Where these take long, separate ones decide if
// they are not near the middle between two floats: a double from the one and the other way differs
// by much less than the margin.
template <typename Unit, typename Formula>
EITHER float rounded(Formula formula) {
    if constexpr (!Unit::IS_QUICK) {
        constexpr std::uint64_t SURPLUS = (1 << 29) - 1, MIDDLE = 1 << 28, MARGIN = 1 << 11;
        const double near = formula(Separate{});
        const bool sure = (bits(near) & SURPLUS) - (MIDDLE - MARGIN) > 2 * MARGIN;
        if (sure && std::fabs(near) >= std::numeric_limits<float>::min())
            return static_cast<float>(near);
    }
    return static_cast<float>(formula(Unit{}));
}

// A formula for a unit that it is called with.
#define BY_UNIT [&](auto unit) __attribute__((always_inline))

// ---- Sine and cosine ----------------------------------------------------------------------------

constexpr double S1 = -0x1.555545995a603p-3, S2 = 0x1.1107605230bc4p-7, S3 = -0x1.994eb3774cf24p-13;
constexpr double C1 = -0x1.ffffffd0c621cp-2, C2 = 0x1.55553e1068f19p-5, C3 = -0x1.6c087e89a359dp-10,
                 C4 = 0x1.99343027bf8c3p-16;
constexpr double TWO_OVER_PI = 0x1.45f306dc9c883p-1, HALF_PI = 0x1.921fb54442d18p0;

// The sine of small angles, from the angle and its square.
template <typename Unit>
EITHER double sine(double x, double x2) {
    const double x3 = x * x2, x7 = x3 * x2;
    return Unit::fused(Unit::fused(S3, x2, S2), x7, Unit::fused(x3, S1, x));
}

template <typename Unit>
EITHER double cosine(double x2) {
    const double x4 = x2 * x2, x6 = x4 * x2;
    const double first = Unit::fused(x4, C2, Unit::fused(x2, C1, 1.0));
    return Unit::fused(Unit::fused(C4, x2, C3), x6, first);
}

// An angle as a number of quarter turns, and a rest of at most an eighth.
struct Quarters {
    double rest;
    unsigned number;
};

template <typename Unit>
EITHER Quarters reduce(float x) {
    constexpr float FAST = 120.0f;
    if (std::fabs(x) < FAST) {
        const int scaled = static_cast<int>(x * (TWO_OVER_PI * 0x1p24));
        const int number = (scaled + (1 << 23)) >> 24;
        return {Unit::fused(-number, HALF_PI, x), static_cast<unsigned>(number)};
    }
    // The angle in units of 2^-62 quarter turns, without whole turns, by 96 digits of 2/pi.
    const std::uint32_t pattern = bits(x);
    const std::uint64_t mantissa = ((pattern & 0x7fffff) | 0x800000) << (pattern >> 23 & 7);
    const int place = 8 * static_cast<int>(pattern >> 26 & 15) - 23;
    const std::uint64_t high = digits_of_two_over_pi(place);
    const std::uint64_t low = digits_of_two_over_pi(place + 64) >> 32;
    std::uint64_t turned = mantissa * high + (mantissa * low >> 32);
    const std::uint64_t number = (turned + (std::uint64_t{1} << 61)) >> 62;
    turned -= number << 62;
    const double rest =
        static_cast<double>(static_cast<std::int64_t>(turned)) * 0x1.921fb54442d18p-62;
    return {x < 0.0f ? -rest : rest, static_cast<unsigned>(x < 0.0f ? -number : number)};
}

constexpr float REDUCED = 0.75f;  // [rad] smaller angles are less than an eighth of a turn
constexpr float TINY = 0x1p-12f;

// The sine of an angle, or with one quarter more its cosine.
template <typename Unit>
EITHER float wave(float angle, unsigned more) {
    const float size = std::fabs(angle);
    if (size < TINY) return more ? 1.0f : angle;
    if (!(size < INF)) return angle - angle;
    const Quarters at = size < REDUCED ? Quarters{angle, 0} : reduce<Unit>(angle);
    const double x2 = at.rest * at.rest;
    const unsigned number = at.number + more;
    const float found = number & 1
                            ? rounded<Unit>(BY_UNIT { return cosine<decltype(unit)>(x2); })
                            : rounded<Unit>(BY_UNIT { return sine<decltype(unit)>(at.rest, x2); });
    return number & 2 ? -found : found;
}

template <typename Unit>
EITHER void waves(float angle, float* sine_, float* cosine_) {
    const float size = std::fabs(angle);
    if (size < TINY || !(size < INF)) {
        *sine_ = wave<Unit>(angle, 0);
        *cosine_ = wave<Unit>(angle, 1);
        return;
    }
    const Quarters at = size < REDUCED ? Quarters{angle, 0} : reduce<Unit>(angle);
    const double x2 = at.rest * at.rest;
    const float odd = rounded<Unit>(BY_UNIT { return sine<decltype(unit)>(at.rest, x2); });
    const float even = rounded<Unit>(BY_UNIT { return cosine<decltype(unit)>(x2); });
    const bool swapped = at.number & 1;
    const float s = swapped ? even : odd, c = swapped ? odd : even;
    *sine_ = at.number & 2 ? -s : s;
    *cosine_ = (at.number + 1) & 2 ? -c : c;
}

// ---- Exponential function and logarithm ---------------------------------------------------------

// Bits of 2^(i / 32), less i << 47.
constexpr std::uint64_t POWERS[] = {
    0x3ff0000000000000, 0x3fefd9b0d3158574, 0x3fefb5586cf9890f, 0x3fef9301d0125b51,
    0x3fef72b83c7d517b, 0x3fef54873168b9aa, 0x3fef387a6e756238, 0x3fef1e9df51fdee1,
    0x3fef06fe0a31b715, 0x3feef1a7373aa9cb, 0x3feedea64c123422, 0x3feece086061892d,
    0x3feebfdad5362a27, 0x3feeb42b569d4f82, 0x3feeab07dd485429, 0x3feea47eb03a5585,
    0x3feea09e667f3bcd, 0x3fee9f75e8ec5f74, 0x3feea11473eb0187, 0x3feea589994cce13,
    0x3feeace5422aa0db, 0x3feeb737b0cdc5e5, 0x3feec49182a3f090, 0x3feed503b23e255d,
    0x3feee89f995ad3ad, 0x3feeff76f2fb5e47, 0x3fef199bdd85529c, 0x3fef3720dcef9069,
    0x3fef5818dcfba487, 0x3fef7c97337b9b5f, 0x3fefa4afa2a490da, 0x3fefd0765b6e4540,
};

template <typename Unit>
EITHER float exponential(float x) {
    constexpr float OVERFLOWS = 0x1.62e42ep6f, UNDERFLOWS = -0x1.9fe368p6f;
    if (!(x <= OVERFLOWS)) return x + INF;  // NaN stays itself
    if (x < UNDERFLOWS) return 0.0f;
    constexpr double PARTS = 0x1.71547652b82fep0 * 32, ROUNDER = 0x1.8p52;
    constexpr double E3 = 0x1.c6af84b912394p-20, E2 = 0x1.ebfce50fac4f3p-13,
                     E1 = 0x1.62e42ff0c52d6p-6;
    const double shifted = Unit::fused(PARTS, x, ROUNDER);
    const double rest = Unit::fused(PARTS, x, -(shifted - ROUNDER));
    const std::uint64_t number = bits(shifted);
    const double power = from_bits(POWERS[number % 32] + (number << 47));
    return rounded<Unit>(BY_UNIT {
        const double first = unit.fused(E1, rest, 1.0);
        return unit.fused(unit.fused(E3, rest, E2), rest * rest, first) * power;
    });
}

struct Knot {
    double inverse, logarithm;
};
constexpr Knot KNOTS[] = {
    {0x1.661ec79f8f3bep+0, -0x1.57bf7808caadep-2}, {0x1.571ed4aaf883dp+0, -0x1.2bef0a7c06ddbp-2},
    {0x1.49539f0f010bp+0, -0x1.01eae7f513a67p-2},  {0x1.3c995b0b80385p+0, -0x1.b31d8a68224e9p-3},
    {0x1.30d190c8864a5p+0, -0x1.6574f0ac07758p-3}, {0x1.25e227b0b8eap+0, -0x1.1aa2bc79c81p-3},
    {0x1.1bb4a4a1a343fp+0, -0x1.a4e76ce8c0e5ep-4}, {0x1.12358f08ae5bap+0, -0x1.1973c5a611cccp-4},
    {0x1.0953f419900a7p+0, -0x1.252f438e10c1ep-5}, {0x1p+0, 0x0p+0},
    {0x1.e608cfd9a47acp-1, 0x1.aa5aa5df25984p-5},  {0x1.ca4b31f026aap-1, 0x1.c5e53aa362eb4p-4},
    {0x1.b2036576afce6p-1, 0x1.526e57720db08p-3},  {0x1.9c2d163a1aa2dp-1, 0x1.bc2860d22477p-3},
    {0x1.886e6037841edp-1, 0x1.1058bc8a07ee1p-2},  {0x1.767dcf5534862p-1, 0x1.4043057b6ee09p-2},
};

template <typename Unit>
EITHER float logarithm(float x) {
    constexpr float SMALLEST_NORMAL = std::numeric_limits<float>::min();
    constexpr std::uint32_t FIRST_KNOT = 0x3f330000;
    constexpr double LN2 = 0x1.62e42fefa39efp-1;
    constexpr double L3 = -0x1.00ea348b88334p-2, L2 = 0x1.5575b0be00b6ap-2,
                     L1 = -0x1.ffffef20a4123p-2;
    if (x == 1.0f) return 0.0f;
    if (!(x < INF)) return x + x;  // NaN stays itself
    if (x <= 0.0f) return x == 0.0f ? -INF : (x - x) / 0.0f;
    const bool subnormal = x < SMALLEST_NORMAL;
    const std::uint32_t pattern = subnormal ? bits(x * 0x1p23f) - (23 << 23) : bits(x);
    const std::uint32_t above = pattern - FIRST_KNOT;
    const Knot& knot = KNOTS[above >> 19 & 15];
    const int exponent = static_cast<std::int32_t>(above) >> 23;
    const float mantissa = from_bits(pattern - (above & 0xff800000));
    const double rest = Unit::fused(mantissa, knot.inverse, -1.0), rest2 = rest * rest;
    return rounded<Unit>(BY_UNIT {
        const double first = rest + unit.fused(exponent, LN2, knot.logarithm);
        const double second = unit.fused(L3, rest2, unit.fused(L2, rest, L1));
        return unit.fused(second, rest2, first);
    });
}

// ---- For either processor -----------------------------------------------------------------------

FOR_FMA float sinf_fused(float x) { return wave<Processor>(x, 0); }
FOR_FMA float cosf_fused(float x) { return wave<Processor>(x, 1); }
FOR_FMA void sincosf_fused(float x, float* sine, float* cosine) {
    waves<Processor>(x, sine, cosine);
}
FOR_FMA float expf_fused(float x) { return exponential<Processor>(x); }
FOR_FMA float logf_fused(float x) { return logarithm<Processor>(x); }

float sinf_added(float x) { return wave<Additions>(x, 0); }
float cosf_added(float x) { return wave<Additions>(x, 1); }
void sincosf_added(float x, float* sine, float* cosine) { waves<Additions>(x, sine, cosine); }
float expf_added(float x) { return exponential<Additions>(x); }
float logf_added(float x) { return logarithm<Additions>(x); }

// Before this is set, a call finds `false`, and the same result in a longer way.
const bool FUSES = processor_fuses();

}  // namespace

const Fused BY_PROCESSOR = {sinf_fused, cosf_fused, sincosf_fused, expf_fused, logf_fused};
const Fused BY_ADDITIONS = {sinf_added, cosf_added, sincosf_added, expf_added, logf_added};

bool processor_fuses() {
    __builtin_cpu_init();
    return __builtin_cpu_supports("fma");
}

float sinf(float x) { return FUSES ? sinf_fused(x) : sinf_added(x); }
float cosf(float x) { return FUSES ? cosf_fused(x) : cosf_added(x); }
void sincosf(float x, float* sine, float* cosine) {
    FUSES ? sincosf_fused(x, sine, cosine) : sincosf_added(x, sine, cosine);
}
float expf(float x) { return FUSES ? expf_fused(x) : expf_added(x); }
float logf(float x) { return FUSES ? logf_fused(x) : logf_added(x); }

}  // namespace torcs::maths
