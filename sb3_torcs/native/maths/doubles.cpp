// Functions of doubles, for our own code. They are not rounded correctly, but the same everywhere.
#include <cmath>

#include "bits.h"
#include "maths.h"

namespace torcs::maths {

// By minimax polynomials of mpmath, for at most an eighth of a turn.
SineCosine sine_cosine(double angle) {
    constexpr double PARTS[] = {0x1.921fb54400000p+0, 0x1.0b4611a600000p-34, 0x1.3198a2e037073p-69};
    constexpr double ROUNDER = 0x1.8p52, TWO_OVER_PI = 0x1.45f306dc9c883p-1;
    const double shifted = angle * TWO_OVER_PI + ROUNDER, number = shifted - ROUNDER;
    const double x = ((angle - number * PARTS[0]) - number * PARTS[1]) - number * PARTS[2];
    const double x2 = x * x, x4 = x2 * x2;
    const double odd = (-0x1.5555555555555p-3 + x2 * 0x1.1111111110babp-7) +
                       x4 * ((-0x1.a01a019e820aep-13 + x2 * 0x1.71de37946ed6dp-19) +
                             x4 * (-0x1.ae6008d114485p-26 + x2 * 0x1.5e0a4fc16be59p-33));
    const double even = (0x1.5555555555555p-5 + x2 * -0x1.6c16c16c16963p-10) +
                        x4 * ((0x1.a01a019f4ddfdp-16 + x2 * -0x1.27e4fa16cc2d1p-22) +
                              x4 * (0x1.1eeb67d026ec6p-29 + x2 * -0x1.907cd8ff5ede7p-37));
    const double sine = x + x * (x2 * odd), cosine = 1.0 - (0.5 * x2 - x4 * even);
    switch (bits(shifted) & 3) {
        case 0:
            return {sine, cosine};
        case 1:
            return {cosine, -sine};
        case 2:
            return {-sine, -cosine};
        default:
            return {-cosine, sine};
    }
}

double log(double x) {
    constexpr double LN2 = 0x1.62e42fefa39efp-1;
    constexpr std::uint64_t ROOT_OF_HALF = 0x3fe6a09e667f3bcd, EXPONENT = 0xfff0000000000000;
    const std::uint64_t scale = (bits(x) - ROOT_OF_HALF) & EXPONENT;
    const double mantissa = from_bits(bits(x) - scale);  // from the root of 1/2 to that of 2
    const double exponent = static_cast<double>(static_cast<std::int64_t>(scale) >> 52);
    // The logarithm is twice the inverse hyperbolic tangent of this.
    const double s = (mantissa - 1.0) / (mantissa + 1.0), s2 = s * s, s4 = s2 * s2;
    const double series = ((0x1.5555555555555p-2 + s2 * 0x1.9999999999a39p-3) +
                           s4 * (0x1.2492492476a1ap-3 + s2 * 0x1.c71c7201a55d7p-4)) +
                          s4 * s4 *
                              ((0x1.745cf8e4bba1bp-4 + s2 * 0x1.3b1c3c1c81c8fp-4) +
                               s4 * (0x1.0fbde0f4ad17bp-4 + s2 * 0x1.0c0aff044a970p-4));
    return exponent * LN2 + 2.0 * (s + s * (s2 * series));
}

double hypot(double x, double y) { return std::sqrt(x * x + y * y); }

}  // namespace torcs::maths
