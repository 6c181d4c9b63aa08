// Several engines that a few threads drive at once.
#pragma once

#include <cstddef>
#include <exception>
#include <memory>
#include <vector>

#include "engine.h"
#include "pool.h"

namespace torcs {

class Fleet {
public:
    // One engine for each race; none may be in the list twice.
    Fleet(std::vector<std::shared_ptr<Engine>> engines, int threads);

    // Let a race go on with another engine, which drives for no other race.
    void put(std::size_t race, std::shared_ptr<Engine> engine);

    // What a car drives, and where it is written when it has arrived.
    struct Order {
        std::size_t race;
        int car;  // an agent's
        Controls controls;
        int ticks;
        Reading* arrival;
    };
    // Drive several engines until all have arrived; orders for one race follow each other, and
    // are for as many ticks. Returns the indices of the orders that failed; their arrivals are not
    // written, and `check` throws their errors.
    std::vector<std::size_t> step(const std::vector<Order>& orders);
    // Throw the error that stopped a race in the latest step, if one did.
    void check(std::size_t race) const;

private:
    struct Task {
        std::shared_ptr<Engine> engine;
        std::vector<Order> orders;
        std::exception_ptr failure;
    };

    void work(std::size_t index);

    std::vector<Task> tasks_;
    Pool pool_;  // last, so that its threads end first
};

}  // namespace torcs
