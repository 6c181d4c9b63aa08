// Whether this build and this machine compute as they should: for `doctor` and for tests.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace torcs::maths {

// Names of functions that have other values than they should at known places, which are hard: there
// the functions of glibc 2.36 are wrong, or those of a processor without fused multiply-adds.
std::vector<std::string> wrong_functions();

// Of the results of a float function at every `step`-th of all 2^32 arguments, by FNV-1a over
// words. If `added`, the functions that need fused multiply-adds do without the processor's.
// `atan2f` gets each argument with another one, which its pattern determines.
std::uint64_t checksum(const std::string& function, std::uint32_t step, bool added);

}  // namespace torcs::maths
