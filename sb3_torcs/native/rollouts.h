// Many short drives from one moment of a race, on copies of it that are driven at once.
//
// A candidate follows a line that was driven before: it takes the line's controls for the place
// where the car is, corrects them by how far the car is from the line, and adds offsets of its own.
// So a small change somewhere does not end in the grass five seconds later, as it does where
// controls are replayed by time.
#pragma once

#include <atomic>
#include <cstddef>
#include <exception>
#include <memory>
#include <vector>

#include "engine.h"
#include "pool.h"

namespace torcs {

// A car at the beginning of a timestep, and the controls that it was then given.
struct Waypoint {
    double time;           // [s]
    double distance;       // [m] raced
    double offset;         // [m] from the axis, left positive
    double heading_error;  // [rad]
    double speed;          // [m/s] along the car
    double steering;       // [-] left positive
    double pedal;          // [-] throttle, or negative brake
};

// What a candidate adds to the controls and to the place of the line in one timestep.
struct Offsets {
    double steering, pedal;
    double place;  // [m] left positive
};

// How strongly a candidate is drawn to the line.
struct Gains {
    double place;    // [1/m] steering per distance from it, at 20 m/s; less at higher speed
    double heading;  // [1/rad] steering per difference of heading
    double speed;    // [s/m] pedal per difference of speed
};

class Rollouts {
public:
    // The engines must be of one race with one agent, at the same moment.
    explicit Rollouts(const std::vector<std::shared_ptr<Engine>>& engines);

    // Let candidates begin where the engines stand, and forget all other marks.
    void mark();
    // Drive all engines from the mark with a path's controls, and let candidates begin there.
    void drive(const std::vector<Waypoint>& path, int ticks);
    // Forget the marks of so many drives: candidates begin where the first of them began.
    void go_back(std::size_t drives);

    // A drive of `steps` timesteps fills a path of so many waypoints and one more, where it ended.
    struct Order {
        const std::vector<Waypoint>* line;
        Gains gains;
        const Offsets* offsets;  // (candidates, steps)
        Waypoint* paths;         // (candidates, steps + 1)
        std::int64_t* lasted;    // (candidates) timesteps on the road and without damage
        std::size_t candidates, steps;
        int ticks;
    };
    void follow(const Order& order);

private:
    struct Place;
    void work(std::size_t index);
    void work(Place& place);
    void follow(Race& race, std::size_t candidate) const;
    void for_all();

    enum class Job { MARK, DRIVE, GO_BACK, FOLLOW };
    struct Place {
        std::shared_ptr<Engine> engine;
        std::vector<Snapshot> marks;
        std::exception_ptr failure;
    };

    std::vector<Place> places_;
    Job job_ = Job::MARK;
    const std::vector<Waypoint>* path_ = nullptr;
    int ticks_ = 0;
    std::size_t drives_ = 0;
    const Order* order_ = nullptr;
    std::atomic<std::size_t> next_{0};
    Pool pool_;  // last, so that its threads end first
};

}  // namespace torcs
