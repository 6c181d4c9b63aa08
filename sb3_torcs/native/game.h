// The installed game: its shared libraries, opened once per process, and its parameter files.
#pragma once

#include <memory>
#include <mutex>
#include <string>

#include "layout.h"
#include "library.h"

namespace torcs {

class Params;

class Game {
public:
    // `libraries` holds lib/, modules/ and drivers/; `plib` is the folder of its PLIB library if
    // the system's loader does not find that, else empty. One game per process.
    static Game& open(const std::string& data, const std::string& libraries,
                      const std::string& plib);

    const std::string data;  // each ends in a slash
    const std::string libraries;

    // This lock is held while races are loaded and closed: all races share one list of parameter
    // files, one of spare libraries and one of arenas. A fork waits for the lock.
    std::mutex mutex;
    static void watch_forks();  // once, before any race

    std::unique_ptr<Library> take_module(const std::string& kind, const std::string& name,
                                         const char* error = "GameIncomplete") const {
        return Library::take(libraries + kind + "/" + name + ".so", libraries + "lib/", error);
    }

    // Of librobottools.
    Segment* (*segment_under)(TrackPosition*);
    float (*road_height)(TrackPosition*);
    float (*segment_width)(Segment*, float to_start);
    void (*to_global)(TrackPosition*, float* x, float* y, int against);
    void (*init_pit_setup)(void* params, void* setup, bool limits_only);

private:
    Game(const std::string& data, const std::string& libraries, const std::string& plib);
    friend class Params;

    void* (*read_file_)(const char*, int);
    void (*release_)(void*);
    void* (*merge_)(void*, void*, int);
    int (*check_)(void*, void*);
    const char* (*text_)(void*, const char*, const char*, const char*);
    int (*elements_)(void*, const char*);
    float (*number_)(void*, const char*, const char*, const char*, float);
};

// One parameter file, or several merged.
class Params {
public:
    static Params read(Game& game, const std::string& path);  // empty if it cannot be read
    // Borrows a handle; the caller releases it.
    static Params view(Game& game, void* handle) { return {game, handle, false}; }
    // Owns the handle, and releases it.
    Params(Game& game, void* handle) : Params(game, handle, true) {}
    Params(Params&& other) noexcept
        : game_(other.game_), handle_(other.handle_), owned_(other.owned_) {
        other.handle_ = nullptr;
    }
    Params& operator=(Params&& other) noexcept;
    ~Params();

    explicit operator bool() const { return handle_ != nullptr; }
    void* handle() const { return handle_; }
    void* release();  // the caller owns the handle

    std::string text(const char* section, const char* name, const char* fallback = "") const;
    float number(const char* section, const char* name, float fallback) const;
    int elements(const char* section) const;     // number of its subsections
    int misfits(const Params& reference) const;  // values outside the reference's limits

    // Releases both. Values of `own` replace those of `reference`, or are added.
    static Params merge(Params reference, Params own);

private:
    Params(Game& game, void* handle, bool owned) : game_(&game), handle_(handle), owned_(owned) {}

    Game* game_;
    void* handle_;
    bool owned_;
};

}  // namespace torcs
