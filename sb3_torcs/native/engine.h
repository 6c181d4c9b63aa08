// A race as Python holds it, guarded against use by two threads at once and after a fork.
#pragma once

#include <array>
#include <atomic>
#include <cfenv>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "race.h"
#include "sensors.h"

namespace torcs {

// A car at one moment; the order of `scalars` is that of sb3_torcs.car.CarState.
constexpr int SCALARS = 23;
constexpr int GEAR_SCALAR = 15;
constexpr int LAPS_SCALAR = 18;
constexpr int POSITION_SCALAR = 22;
constexpr int RACE_NUMBERS = 5 + RIVAL_NUMBERS;

using Angles = std::array<double, RANGE_FINDERS>;  // [rad] left negative

struct Reading {
    std::array<double, SCALARS> scalars;
    std::array<double, 4> wheel_speeds;
    std::array<double, RANGE_FINDERS> range_finders;
    std::array<double, OPPONENT_SECTORS> opponents;
    std::array<double, RACE_NUMBERS> race;  // see sb3_torcs.car.CarState
};

// A race at one moment, with its sensors' noise.
struct Moment {
    Snapshot race;
    std::optional<Generator> noise;
};

// Other libraries of the process may have changed the rounding mode, or made tiny numbers zero.
// This sets the defaults while a race is computed.
class PlainRounding {
public:
    PlainRounding() {
        std::fegetenv(&previous_);
        std::fesetenv(FE_DFL_ENV);
    }
    ~PlainRounding() { std::fesetenv(&previous_); }
    PlainRounding(const PlainRounding&) = delete;
    PlainRounding& operator=(const PlainRounding&) = delete;

private:
    std::fenv_t previous_;
};

class Engine {
public:
    // `angles` of the range finders of each agent; those of the first are the robots', too.
    Engine(Game& game, RaceOptions options, std::vector<Angles> angles);
    ~Engine();
    Engine(const Engine&) = delete;
    Engine& operator=(const Engine&) = delete;

    void start();
    void start(const Start& start);
    void drive(int ticks);
    void advance(int ticks);  // agents stand on their brakes
    void retire(int car);
    void rejoin(int car, const Start& start);
    Reading read(int car);
    void set_noise(std::optional<std::uint64_t> seed);
    bool mute_noise(bool muted);  // read without noise, and draw none; returns what was set before
    void set_conditions(const Conditions& conditions);  // for the starts that follow
    void set_origin(double x, double y);                // added to positions that are read
    Moment save();
    void restore(const Moment& moment);
    // The SCR server's `focus`: distances at 1 degree from each other around a direction [rad]
    // against the car's axis, left negative.
    std::array<double, FOCUS_BEAMS> focus(int car, double direction);
    // What the game needs to draw the present moment; see appearance.h.
    std::string appearance();
    void close();

    // Drives a list of controls, one tick each, with or without sensors; for benchmarks.
    void replay(const std::vector<Controls>& controls, bool sensors);
    void update_physics(int steps);

    // Checks that the engine may be used, and gives access to it for as long as this object lives.
    class Access {
    public:
        explicit Access(Engine& engine);
        ~Access() { engine_.busy_.store(false, std::memory_order_release); }
        Access(const Access&) = delete;
        Access& operator=(const Access&) = delete;
        Race* operator->() const { return engine_.race_.get(); }
        Race& operator*() const { return *engine_.race_; }

    private:
        Engine& engine_;
        PlainRounding rounding_;
    };

    Reading read(Race& race, int car);

    static void check_car(const Race& race, int car);
    static int first_agent(const Race& race);  // its car
    static void check_agent(const Race& race, int car);

private:
    std::unique_ptr<Race> race_;
    std::vector<Angles> angles_;  // of each car
    std::optional<Generator> noise_;
    bool muted_ = false;
    double x_ = 0.0, y_ = 0.0;
    std::atomic<bool> busy_{false};
    int forks_;  // of the process when the engine was made
};

}  // namespace torcs
