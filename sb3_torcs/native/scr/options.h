// The server's options, which are those of patched servers: -nofuel, -nodamage, -nolaptime and
// -noisy. They hold for all cars.
#pragma once

#include <vector>

#include "../layout.h"

namespace torcs::scr {

struct Options {
    bool no_fuel = false;       // no car uses any
    bool no_damage = false;     // no car takes any; clients are told what it would have taken
    bool no_lap_limit = false;  // nobody is taken out of the race for being slow
    bool noisy = false;         // sensors err
};

// Reads SB3_TORCS_SCR_OPTIONS, whose names are separated by commas. Ends the game if one is
// unknown.
const Options& options();

// Keeps from the cars what the options take out of the race.
class Mercy {
public:
    // For a race that begins.
    void begin(const Simulation& simulation);

    // Around each step of the simulation.
    void before(const Situation& situation);
    void after(const Situation& situation);

    // What the damage of a car [points] would be.
    int damage_of(const CarElement& car) const;

private:
    SimulatedCar* simulated(const CarElement& car) const;

    struct Kept {
        float fuel = 0.0f;  // [l] before the step
        int damage = 0;     // [points] taken away so far
        bool slow = false;  // over the time limit of a lap
    };
    SimulatedCar** simulated_ = nullptr;
    std::vector<Kept> kept_;
};

Mercy& mercy();

}  // namespace torcs::scr
