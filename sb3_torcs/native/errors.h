#pragma once

#include <stdexcept>
#include <string>

namespace torcs {

// This becomes the exception of that name in sb3_torcs.errors.
struct Error : std::runtime_error {
    Error(const char* python_class, const std::string& message)
        : std::runtime_error(message), python_class(python_class) {}
    const char* python_class;
};

// The remedies for EMFILE, and for ENOMEM where the loader says it.
constexpr const char* MORE_FILES =
    "; each module of a race keeps a file open: raise the limit with ulimit -n";
constexpr const char* MORE_MAPS =
    "; each race maps parts of libraries: hold fewer races at once, or raise the limit with "
    "sudo sysctl vm.max_map_count=1000000";

}  // namespace torcs
