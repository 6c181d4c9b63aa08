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

    // Begin to drive one engine, and return at once. Call `wait` for it before any other use of it.
    void begin(std::size_t race, const Controls& controls, int ticks);
    // Drive until this engine has arrived. Throws the error that stopped it.
    const Reading& wait(std::size_t race);
    // Drive until all have arrived.
    void finish() { pool_.finish(); }

    // What a car drives, and where it is written when it has arrived.
    struct Order {
        std::size_t race;
        int car;  // an agent's; FIRST_AGENT is the first one's
        Controls controls;
        int ticks;
        Reading* arrival;
    };
    static constexpr int FIRST_AGENT = -1;
    // Drive several engines until all have arrived; orders for one race follow each other, and
    // are for as many ticks. Returns the indices of the orders that failed; their arrivals are not
    // written, and `wait` throws their errors.
    std::vector<std::size_t> step(const std::vector<Order>& orders);

private:
    struct Task {
        std::shared_ptr<Engine> engine;
        std::vector<Order> orders;
        Reading reading;  // where an order names no other record
        std::exception_ptr failure;
    };

    void begin(std::vector<Order> orders);
    void work(std::size_t index);

    std::vector<Task> tasks_;
    Pool pool_;  // last, so that its threads end first
};

}  // namespace torcs
