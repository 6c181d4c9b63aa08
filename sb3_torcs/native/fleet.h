// Several engines that are driven at once, each by one of a few threads.
#pragma once

#include <cstddef>
#include <exception>
#include <vector>

#include "engine.h"
#include "pool.h"

namespace torcs {

class Fleet {
public:
    // The engines have to outlive this object; each is named once.
    Fleet(const std::vector<Engine*>& engines, int threads);

    // Begin to drive one of them, and return at once. It must be waited for before anything else
    // is done with it.
    void begin(std::size_t index, const Controls& controls, int ticks);
    // Drive until one of them has arrived; throws what stopped it.
    const Reading& wait(std::size_t index);
    // Drive until all have arrived.
    void finish() { pool_.finish(); }

private:
    struct Task {
        Engine* engine;
        Controls controls;
        int ticks;
        Reading reading;
        std::exception_ptr failure;
    };

    void work(std::size_t index);

    std::vector<Task> tasks_;
    Pool pool_;  // last, so that its threads end first
};

}  // namespace torcs
