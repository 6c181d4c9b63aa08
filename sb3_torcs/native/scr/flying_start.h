// A race that begins where a client asks for, not on the grid: as Race::start does it.
//
// The engine puts the cars on the grid, tells the drivers of the race, lets the cars settle and
// counts down. A client's wish is known when its driver is told of the race, but all drivers must
// be told where they stand. So the race begins once more: the field is moved before the drivers are
// told, and drives off without the countdown.
#pragma once

#include <vector>

#include "../placing.h"

namespace torcs::scr {

class FlyingStart {
public:
    // For cars that the engine has just put on the grid: moves them, if the race is begun once more
    // for that.
    void put_down(const Simulation& simulation, int cars, bool once_more);

    // Instead of the engine's first step of settling, where the field stands elsewhere.
    void come_to_rest(Situation& situation);

    // Whether the field was moved and waits to drive off.
    bool stands() const { return stands_; }

    // Whether the cars are not where the race shall begin, so that it has to begin once more. Call
    // it when they have settled: it also measures how high they stand.
    bool misses_grid();

    void drive_off(Situation& situation);

    // The first crossing of the line starts the clock. Call it before the engine counts laps.
    void start_clocks(const Situation& situation);

    // A place that was refused may be free when the next race begins.
    void forget_refusal() { refused_ = false; }

private:
    // Finds the car whose client asks for a start that is possible.
    bool find_start();
    void refuse(const char* reason);

    Field field_{};
    Simulation simulation_{};
    SimulatedCar** simulated_ = nullptr;
    Start start_{};
    bool wanted_ = false, stands_ = false, flying_ = false, refused_ = false, again_ = false;
    std::vector<double> distances_;
    std::vector<Control> controls_;     // with which the field drives off
    std::vector<float> rest_heights_;   // [m] of each car's mass centre over the road, standing
    const TrackData* track_ = nullptr;  // on which these were measured
};

FlyingStart& flying_start();

}  // namespace torcs::scr
