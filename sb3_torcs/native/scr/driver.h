// One car that a client drives.
#pragma once

#include <array>
#include <optional>

#include "../layout.h"
#include "../sensors.h"
#include "client.h"

namespace torcs::scr {

class Driver {
public:
    void new_track(int index, const TrackData* track);

    // Waits for the client, if it does not drive already.
    void new_race(CarElement* car, const Situation* situation);

    // Asks the client, and does what it says. Returns whether it wants the race restarted.
    bool drive();

    // As `drive`, for a car that is out of the race or in its pit, whose driver the game does not
    // call.
    bool watch();

    // Tells the client that the race is over, or that it begins anew.
    void leave();

    bool races() const { return car_ != nullptr; }
    int place() const { return car_->index; }  // in the starting list
    const Init& init() const { return client_.init(); }

private:
    void name_car();
    void report_restart() const;
    State sense();
    void sense_focus(State& state);
    void show_board(const State& state) const;

    int index_ = 0;
    Client client_;
    std::optional<Generator> noise_;
    const TrackData* track_ = nullptr;
    CarElement* car_ = nullptr;
    const Situation* situation_ = nullptr;
    Action action_;
    bool started_ = false;       // the countdown is over
    double raced_before_ = 0.0;  // [m] by the race's count, where the start was
    double next_focus_ = 0.0;    // [s] since the start
    int told_crossings_ = 0;     // of the start line, that the client knows of
};

// They outlive the races that they drive in.
std::array<Driver, MODULE_INTERFACES>& drivers();

}  // namespace torcs::scr
