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

    // What one of several engines shall do, and where the car that has arrived is written down.
    struct Order {
        std::size_t index;
        Controls controls;
        int ticks;
        Reading* arrival;
    };
    // Drive several until all have arrived. Returns which of the orders have failed, and have no
    // arrival: `wait` throws what stopped them.
    std::vector<std::size_t> step(const std::vector<Order>& orders);

private:
    struct Task {
        Engine* engine;
        Controls controls;
        int ticks;
        Reading* arrival;
        Reading reading;  // of those who give no other place for it
        std::exception_ptr failure;
    };

    void begin(const Order& order);
    void work(std::size_t index);

    std::vector<Task> tasks_;
    Pool pool_;  // last, so that its threads end first
};

}  // namespace torcs
