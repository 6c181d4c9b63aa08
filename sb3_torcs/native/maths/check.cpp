#include "check.h"

#include <algorithm>
#include <cmath>

#include "../errors.h"
#include "bits.h"
#include "maths.h"

namespace torcs::maths {
namespace {

using Call = float (*)(float);

struct Value {
    const char* name;
    Call call;
    float at, is;
};

struct DoubleValue {
    const char* name;
    double (*call)(double);
    double at, is;
};

float sine_of_both(float x) {
    float sine, cosine;
    sincosf(x, &sine, &cosine);
    return sine;
}

float cosine_of_both(float x) {
    float sine, cosine;
    sincosf(x, &sine, &cosine);
    return cosine;
}

float added_sine_of_both(float x) {
    float sine, cosine;
    BY_ADDITIONS.sincosf(x, &sine, &cosine);
    return sine;
}

float added_cosine_of_both(float x) {
    float sine, cosine;
    BY_ADDITIONS.sincosf(x, &sine, &cosine);
    return cosine;
}

float atan2f_of_one(float y) { return atan2f(y, 1.7f); }

// The second argument of a checksum's pair: any of all 2^32 as well.
float partner(std::uint32_t pattern) { return from_bits(pattern * 0x9e3779b1u + 0x7f4a7c15u); }

float atan2f_of_pair(float y) { return atan2f(y, partner(bits(y))); }

const std::vector<Value>& values() {
    static const std::vector<Value> list = {
        {"tanf", tanf, 0x1.d4326cp-6f, 0x1.d4530ep-6f},
        {"tanf", tanf, 0x1.93e594p+99f, 0x1.4b2876p+0f},
        {"atanf", atanf, 0x1.7b4c24p-4f, 0x1.7a3802p-4f},
        {"asinf", asinf, 0x1.11542ap-6f, 0x1.115768p-6f},
        {"acosf", acosf, -0x1.1777p-7f, 0x1.944ea6p+0f},
        {"tanhf", tanhf, 0x1p-7f, 0x1.fffd56p-8f},
        {"atan2f", atan2f_of_one, 0x1.002eeep-7f, 0x1.2d63d8p-8f},
        {"sinf", sinf, 0x1.46b80ep+6f, -0x1.b54768p-10f},
        {"sinf", sinf, 0x1.93e594p+99f, -0x1.95136p-1f},
        {"cosf", cosf, 0x1.52e6cp+6f, -0x1.fd8f74p-1f},
        {"sincosf", sine_of_both, 0x1.52e6cp+6f, 0x1.8f6114p-4f},
        {"sincosf", cosine_of_both, -0x1.4p+1f, -0x1.9a2f7ep-1f},
        {"expf", expf, 0x1.19999ap+0f, 0x1.808884p+1f},
        {"logf", logf, 0x1.666666p-1f, -0x1.6d3c34p-2f},
        {"sinf", BY_ADDITIONS.sinf, 0x1.46b80ep+6f, -0x1.b54768p-10f},
        {"cosf", BY_ADDITIONS.cosf, 0x1.52e6cp+6f, -0x1.fd8f74p-1f},
        {"sincosf", added_sine_of_both, 0x1.52e6cp+6f, 0x1.8f6114p-4f},
        {"expf", BY_ADDITIONS.expf, 0x1.19999ap+0f, 0x1.808884p+1f},
        {"logf", BY_ADDITIONS.logf, 0x1.666666p-1f, -0x1.6d3c34p-2f},
    };
    return list;
}

const std::vector<DoubleValue>& double_values() {
    static const std::vector<DoubleValue> list = {
        {"sine", [](double x) { return sine_cosine(x).sine; }, 100.0, -0x1.03425b78c4db8p-1},
        {"cosine", [](double x) { return sine_cosine(x).cosine; }, -3.0, -0x1.fae04be85e5d2p-1},
        {"atan2", [](double y) { return atan2(y, -1.1); }, -0.3, -0x1.700b29327680fp+1},
        {"log", log, 0.7, -0x1.6d3c324e13f5p-2},
        {"hypot", [](double x) { return hypot(x, 1.1); }, 0.3, 0x1.23e2896280f23p+0},
    };
    return list;
}

template <typename Values>
void add_wrong(std::vector<std::string>& wrong, const Values& list) {
    for (const auto& value : list)
        if (bits(value.call(value.at)) != bits(value.is) &&
            std::find(wrong.begin(), wrong.end(), value.name) == wrong.end())
            wrong.emplace_back(value.name);
}

Call function_of(const std::string& name, bool added) {
    if (name == "tanf") return tanf;
    if (name == "atanf") return atanf;
    if (name == "asinf") return asinf;
    if (name == "acosf") return acosf;
    if (name == "tanhf") return tanhf;
    if (name == "atan2f") return atan2f_of_pair;
    if (name == "sinf") return added ? BY_ADDITIONS.sinf : sinf;
    if (name == "cosf") return added ? BY_ADDITIONS.cosf : cosf;
    if (name == "sincosf's sine") return added ? added_sine_of_both : sine_of_both;
    if (name == "sincosf's cosine") return added ? added_cosine_of_both : cosine_of_both;
    if (name == "expf") return added ? BY_ADDITIONS.expf : expf;
    if (name == "logf") return added ? BY_ADDITIONS.logf : logf;
    throw Error("InvalidOption", "there is no float function '" + name + "'");
}

}  // namespace

std::vector<std::string> wrong_functions() {
    std::vector<std::string> wrong;
    add_wrong(wrong, values());
    add_wrong(wrong, double_values());
    return wrong;
}

std::uint64_t checksum(const std::string& function, std::uint32_t step, bool added) {
    const Call call = function_of(function, added);
    std::uint64_t sum = 0xcbf29ce484222325;
    for (std::uint64_t pattern = 0; pattern >> 32 == 0; pattern += step) {
        const float result = call(from_bits(static_cast<std::uint32_t>(pattern)));
        sum = (sum ^ (result == result ? bits(result) : 1)) * 0x100000001b3;
    }
    return sum;
}

}  // namespace torcs::maths
