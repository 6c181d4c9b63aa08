// Check sb3_torcs/native/maths against references, argument by argument. On Debian:
//
//   sudo apt install g++ libmpfr-dev
//   g++ -std=c++17 -O2 -ffp-contract=off -o /tmp/check_maths tools/check_maths.cpp
//       sb3_torcs/native/maths/{rounded,as_glibc}.cpp -lmpfr   (one line)
//   /tmp/check_maths rounded              all 2^32 arguments of five functions, against MPFR
//   /tmp/check_maths pairs 1000000000     so many random pairs for atan2f, against MPFR
//   /tmp/check_maths fused                all 2^32 arguments with and without the processor's FMA
//   /tmp/check_maths libm                 all 2^32 arguments, and pairs, against the system's libm:
//                                         with FMA and glibc from 2.28 on, the last five functions
//                                         are equal; from 2.41 on, all are
//
// A further argument is the name of one function. Each takes some minutes. The exit status is 1 if
// anything differs.
//
// The system's results in double are the filter, and its long doubles a finer one: only what is
// near the middle between two floats is computed by MPFR.
#include <gnu/libc-version.h>
#include <mpfr.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <string>

#include "../sb3_torcs/native/maths/bits.h"
#include "../sb3_torcs/native/maths/maths.h"

namespace maths = torcs::maths;
using maths::bits;
using maths::from_bits;

namespace {

using Call = float (*)(float);
using Near = double (*)(double);
using Nearer = long double (*)(long double);
using Exact = int (*)(mpfr_ptr, mpfr_srcptr, mpfr_rnd_t);

struct Function {
    const char* name;
    Call ours, system;
    Near near;
    Nearer nearer;
    Exact exact;
};

float sine_of_both(float x) {
    float sine, cosine;
    maths::sincosf(x, &sine, &cosine);
    return sine;
}
float cosine_of_both(float x) {
    float sine, cosine;
    maths::sincosf(x, &sine, &cosine);
    return cosine;
}
float system_sine_of_both(float x) {
    float sine, cosine;
    ::sincosf(x, &sine, &cosine);
    return sine;
}
float system_cosine_of_both(float x) {
    float sine, cosine;
    ::sincosf(x, &sine, &cosine);
    return cosine;
}

const Function ROUNDED[] = {
    {"tanf", maths::tanf, ::tanf, ::tan, ::tanl, mpfr_tan},
    {"atanf", maths::atanf, ::atanf, ::atan, ::atanl, mpfr_atan},
    {"asinf", maths::asinf, ::asinf, ::asin, ::asinl, mpfr_asin},
    {"acosf", maths::acosf, ::acosf, ::acos, ::acosl, mpfr_acos},
    {"tanhf", maths::tanhf, ::tanhf, ::tanh, ::tanhl, mpfr_tanh},
};
const Function AS_GLIBC[] = {
    {"sinf", maths::sinf, ::sinf, nullptr, nullptr, nullptr},
    {"cosf", maths::cosf, ::cosf, nullptr, nullptr, nullptr},
    {"sincosf's sine", sine_of_both, system_sine_of_both, nullptr, nullptr, nullptr},
    {"sincosf's cosine", cosine_of_both, system_cosine_of_both, nullptr, nullptr, nullptr},
    {"expf", maths::expf, ::expf, nullptr, nullptr, nullptr},
    {"logf", maths::logf, ::logf, nullptr, nullptr, nullptr},
};

long different = 0, exactly = 0;

bool same(float a, float b) { return bits(a) == bits(b) || (std::isnan(a) && std::isnan(b)); }

void compare(const char* name, float ours, float reference, float x, float y = 0.0f) {
    if (same(ours, reference)) return;
    if (++different <= 20) std::printf("%s(%a, %a) is %a, not %a\n", name, x, y, ours, reference);
}

template <typename Real>
bool unsure_subnormal(Real value) {
    const Real steps = std::fabs(value) * 0x1p149;
    return std::fabs(steps - std::floor(steps) - 0.5) <= steps * 0x1p-40;
}

// Whether a number that is right but for its last 7 or 13 digits does not say which float is the
// nearest.
bool unsure(double value) {
    constexpr std::uint64_t SURPLUS = (1 << 29) - 1, MIDDLE = 1 << 28, MARGIN = 1 << 7;
    if (std::fabs(value) < std::numeric_limits<float>::min()) return unsure_subnormal(value);
    return (bits(value) & SURPLUS) - (MIDDLE - MARGIN) <= 2 * MARGIN;
}

bool unsure(long double value) {
    constexpr std::uint64_t SURPLUS = (std::uint64_t{1} << 40) - 1, MIDDLE = std::uint64_t{1} << 39;
    constexpr std::uint64_t MARGIN = 1 << 13;
    std::uint64_t mantissa;
    std::memcpy(&mantissa, &value, sizeof mantissa);
    if (std::fabs(value) < std::numeric_limits<float>::min()) return unsure_subnormal(value);
    return (mantissa & SURPLUS) - (MIDDLE - MARGIN) <= 2 * MARGIN;
}

mpfr_t argument, second, result;

float exact_result(const Function& function, float x) {
    exactly++;
    mpfr_set_flt(argument, x, MPFR_RNDN);
    function.exact(result, argument, MPFR_RNDN);
    return mpfr_get_flt(result, MPFR_RNDN);
}

float reference(const Function& function, float x) {
    const double near = function.near(x);
    if (!unsure(near)) return static_cast<float>(near);
    const long double nearer = function.nearer(x);
    return unsure(nearer) ? exact_result(function, x) : static_cast<float>(nearer);
}

float exact_atan2f(float y, float x) {
    exactly++;
    mpfr_set_flt(argument, y, MPFR_RNDN);
    mpfr_set_flt(second, x, MPFR_RNDN);
    mpfr_atan2(result, argument, second, MPFR_RNDN);
    return mpfr_get_flt(result, MPFR_RNDN);
}

template <typename Check>
void all_floats(const char* name, const char* only, Check check) {
    if (only && std::strcmp(name, only) != 0) return;
    const long before = different;
    exactly = 0;
    std::uint32_t pattern = 0;
    do check(from_bits(pattern));
    while (++pattern != 0);
    std::printf("%s: 2^32 arguments, %ld of them by MPFR, %ld differ\n", name, exactly,
                different - before);
    std::fflush(stdout);
}

void check_rounded(const char* only) {
    for (const Function& function : ROUNDED)
        all_floats(function.name, only, [&](float x) {
            const bool odd = function.exact != mpfr_acos;
            if (odd && std::signbit(x)) {  // then the reference of -x will do
                compare(function.name, function.ours(x), -function.ours(-x), x);
                return;
            }
            compare(function.name, function.ours(x), reference(function, x), x);
        });
}

void check_fused(const char* only) {
    const maths::Fused &a = maths::BY_PROCESSOR, &b = maths::BY_ADDITIONS;
    const struct {
        const char* name;
        Call a, b;
    } pairs[] = {{"sinf", a.sinf, b.sinf},
                 {"cosf", a.cosf, b.cosf},
                 {"expf", a.expf, b.expf},
                 {"logf", a.logf, b.logf}};
    for (const auto& pair : pairs)
        all_floats(pair.name, only, [&](float x) { compare(pair.name, pair.a(x), pair.b(x), x); });
    all_floats("sincosf", only, [&](float x) {
        float sine, cosine, other_sine, other_cosine;
        a.sincosf(x, &sine, &cosine);
        b.sincosf(x, &other_sine, &other_cosine);
        compare("sincosf's sine", sine, other_sine, x);
        compare("sincosf's cosine", cosine, other_cosine, x);
    });
}

// ---- Pairs --------------------------------------------------------------------------------------

std::uint64_t state = 1;  // of SplitMix64

std::uint64_t next() {
    std::uint64_t mixed = state += 0x9e3779b97f4a7c15;
    mixed = (mixed ^ (mixed >> 30)) * 0xbf58476d1ce4e5b9;
    mixed = (mixed ^ (mixed >> 27)) * 0x94d049bb133111eb;
    return mixed ^ (mixed >> 31);
}

struct Pair {
    float y, x;
};

// Any patterns; numbers of a like size; results that are nearly or exactly subnormal; quotients
// that lie in the middle between two floats, or next to it.
Pair draw() {
    const auto random = static_cast<std::uint32_t>(next());
    const float any = from_bits(static_cast<std::uint32_t>(next()));
    const auto unit = [](std::uint32_t pattern) {
        return from_bits((pattern & 0x807fffff) | 0x3f800000);  // from 1 to 2, and a sign
    };
    const float one = unit(static_cast<std::uint32_t>(next()));
    if (random % 1024 == 0) {  // y is x times the middle between two subnormal numbers
        const auto odd = static_cast<double>((random >> 10 & 0x3fff) * 2 + 1);
        const float x = std::ldexp(static_cast<float>(next() & 0x1ff), 60);
        return {static_cast<float>(odd * x * 0x1p-150), x};
    }
    switch (random % 8) {
        case 1:
        case 2:
            return {from_bits(static_cast<std::uint32_t>(next())), any};
        case 3:
            return {static_cast<float>(static_cast<std::int32_t>(next()) * 0x1p-22),
                    static_cast<float>(static_cast<std::int32_t>(next()) * 0x1p-22)};
        case 4:  // from -158 to -94 is the exponent of the result
            return {std::ldexp(one, -142 + static_cast<int>(random >> 8 & 63)),
                    std::ldexp(unit(static_cast<std::uint32_t>(next())), 16)};
        case 5: {  // y / x is as near to a middle as floats allow
            const double middle = std::fabs(one) + 0x1p-24;
            const float x = unit(static_cast<std::uint32_t>(next()) & 0x7fffffff);
            return {
                static_cast<float>(std::ldexp(middle * x, -14 - static_cast<int>(random >> 28))),
                x};
        }
        default:  // ratios around 1
            return {one, std::ldexp(unit(static_cast<std::uint32_t>(next())),
                                    static_cast<int>(random >> 8 & 15) - 8)};
    }
}

float reference_atan2f(float y, float x) {
    const double near = ::atan2(y, x);
    if (!unsure(near)) return static_cast<float>(near);
    const long double nearer = ::atan2l(y, x);
    return unsure(nearer) ? exact_atan2f(y, x) : static_cast<float>(nearer);
}

template <typename Reference>
void check_pairs(long number, Reference reference) {
    const float specials[] = {0.0f,
                              1.0f,
                              0x1p-149f,
                              0x1p-126f,
                              0x1.fffffep127f,
                              3.0f,
                              std::numeric_limits<float>::infinity(),
                              std::numeric_limits<float>::quiet_NaN()};
    for (float y : specials)
        for (float x : specials)
            for (int signs = 0; signs < 4; signs++) {
                const float v = signs & 1 ? -y : y, u = signs & 2 ? -x : x;
                compare("atan2f", maths::atan2f(v, u), reference(v, u), v, u);
            }
    const long before = different;
    exactly = 0;
    for (long i = 0; i < number; i++) {
        const Pair pair = draw();
        compare("atan2f", maths::atan2f(pair.y, pair.x), reference(pair.y, pair.x), pair.y, pair.x);
    }
    std::printf("atan2f: %ld pairs, %ld of them by MPFR, %ld differ\n", number, exactly,
                different - before);
}

void check_libm(const char* only) {
    std::printf("glibc %s\n", gnu_get_libc_version());
    const auto check = [&](const Function& function) {
        all_floats(function.name, only, [&](float x) {
            compare(function.name, function.ours(x), function.system(x), x);
        });
    };
    for (const Function& function : AS_GLIBC) check(function);
    for (const Function& function : ROUNDED) check(function);
    if (!only || std::strcmp(only, "atan2f") == 0)
        check_pairs(1000000000, [](float y, float x) { return ::atan2f(y, x); });
}

}  // namespace

int main(int number, char** words) {
    mpfr_inits2(300, argument, second, result, nullptr);
    const std::string what = number > 1 ? words[1] : "";
    const char* only = number > 2 ? words[2] : nullptr;
    if (what == "rounded") {
        check_rounded(only);
    } else if (what == "fused") {
        check_fused(only);
    } else if (what == "libm") {
        check_libm(only);
    } else if (what == "pairs" && only) {
        check_pairs(std::atol(only), reference_atan2f);
    } else {
        std::fprintf(stderr, "usage: %s rounded|fused|libm [FUNCTION] | pairs NUMBER\n", words[0]);
        return 2;
    }
    return different == 0 ? 0 : 1;
}
