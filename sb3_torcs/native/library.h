// A module of the game, loaded as a copy of its own with its imports redirected.
//
// The game's modules keep their world in global variables, so every race needs its own copy: the
// file's bytes in an anonymous file, opened with local symbols. The copy's imports from the C
// library are then pointed at ours: memory comes from the race's arena, `rand` from the race's
// generator, `exit` becomes an error, nothing is printed, and no file is written. Mathematics of
// floats is ours, which is the same on every machine; robots' few functions of doubles stay the
// system's.
#pragma once

#include <memory>
#include <string>
#include <vector>

struct link_map;

namespace torcs {

using Variables = std::vector<std::vector<char>>;

// Hold the game's lock when a library is taken or given back.
class Library {
public:
    // A copy of the module. A copy that an earlier race gave back is used first, because libraries
    // with C++ templates can never be unloaded. `folder` holds the libraries that all share;
    // `error` is the exception if it does not load.
    static std::unique_ptr<Library> take(const std::string& path, const std::string& folder,
                                         const char* error);
    static void give_back(std::unique_ptr<Library> library);

    // The one instance that all races share, with global symbols. What it allocates lives in the
    // race's arena only if `race_memory` says so.
    static Library& shared(const std::string& path, bool race_memory);

    // The same for a library that others in this process may use: of a copy, since its imports are
    // redirected, too.
    static void share_copy(const std::string& path);

    void* find(const char* symbol) const;  // null if there is none
    template <typename T>
    T require(const char* symbol) const {
        return reinterpret_cast<T>(require_address(symbol));
    }
    const std::string& path() const { return path_; }

    Variables save() const;
    void restore(const Variables& saved);

private:
    Library(std::string path, void* handle, bool race_memory);
    void* require_address(const char* symbol) const;
    void redirect_imports(bool race_memory) const;

    // The loader prefers the process's functions to a library's own ones of the same names. Some
    // Pythons contain another version of the XML parser that the game's parameter files need.
    void keep_own_calls() const;

    struct Range {
        char* begin;
        std::size_t size;
    };
    std::string path_;
    void* handle_;
    std::vector<Range> variables_;  // what the module can write to
    Variables pristine_;
};

// A redirected import acts on the race that this thread drives.
class Arena;
struct Random;

struct Host {
    Arena* arena = nullptr;
    Random* random = nullptr;
    std::string data;  // folder against which the game names its files, with a slash at its end
};

class Hosted {
public:
    explicit Hosted(Host& host);
    ~Hosted();
    Hosted(const Hosted&) = delete;
    Hosted& operator=(const Hosted&) = delete;

private:
    Host* previous_;
    void* locale_;  // numbers in XML have a point, whatever the process's locale says
};

Random* new_random(Arena& arena);  // in the state in which a process begins

// What modules would have printed on this thread since `forget_printed`; the game explains its
// failures there.
std::string printed();
void forget_printed();

}  // namespace torcs
