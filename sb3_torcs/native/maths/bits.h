// Numbers as patterns of bits, and the binary digits of 2/pi.
#pragma once

#include <cstdint>
#include <cstring>

namespace torcs::maths {

inline std::uint32_t bits(float x) {
    std::uint32_t pattern;
    std::memcpy(&pattern, &x, sizeof pattern);
    return pattern;
}

inline std::uint64_t bits(double x) {
    std::uint64_t pattern;
    std::memcpy(&pattern, &x, sizeof pattern);
    return pattern;
}

inline float from_bits(std::uint32_t pattern) {
    float x;
    std::memcpy(&x, &pattern, sizeof x);
    return x;
}

inline double from_bits(std::uint64_t pattern) {
    double x;
    std::memcpy(&x, &pattern, sizeof x);
    return x;
}

// 64 binary digits of 2/pi, the first of them `place` places behind the point. Digits before the
// point are 0; `place` is at least -63.
inline std::uint64_t digits_of_two_over_pi(int place) {
    static constexpr std::uint64_t DIGITS[] = {
        0,
        0xa2f9836e4e441529,
        0xfc2757d1f534ddc0,
        0xdb6295993c439041,
        0xfe5163abdebbc561,
        0xb7246e3a424dd2e0,
    };
    const int first =
        place + 63;  // from the beginning of the table, whose last 0 is before digit 1
    const std::uint64_t* word = DIGITS + first / 64;
    const int shift = first % 64;
    return shift == 0 ? word[0] : word[0] << shift | word[1] >> (64 - shift);
}

}  // namespace torcs::maths
