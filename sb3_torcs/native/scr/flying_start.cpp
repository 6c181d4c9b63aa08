#include "flying_start.h"

#include <cstdio>
#include <utility>

#include "driver.h"
#include "engine.h"

namespace torcs::scr {

FlyingStart& flying_start() {
    static FlyingStart start;
    return start;
}

void FlyingStart::put_down(const Simulation& simulation, int cars, bool once_more) {
    simulation_ = simulation;
    simulated_ = simulated_cars(simulation);
    field_ = {ReInfo->cars, cars,       field_.agent, ReInfo,
              &simulation_, simulated_, to_global,    road_height};
    stands_ = once_more && wanted_;
    flying_ = again_ = false;
    if (stands_) distances_ = torcs::put_down(field_, start_, rest_heights_);
}

void FlyingStart::come_to_rest(Situation& situation) {
    if (!stands_) {
        const bool known = track_ == ReInfo->track &&
                           rest_heights_.size() == static_cast<std::size_t>(field_.number);
        if (!known) rest_heights_.clear();
        wanted_ = find_start();
        again_ = wanted_ && known;
        return;
    }
    torcs::come_to_rest(field_, situation);
    if (stuck_car(field_)) return refuse("somebody would stand in a wall or in another car");
    controls_.clear();
    for (int i = 0; i < field_.number; i++) controls_.push_back(field_.cars[i].control);
}

bool FlyingStart::find_start() {
    for (const Driver& driver : drivers()) {
        if (refused_ || !driver.races() || !driver.init().start) continue;
        start_ = *driver.init().start;
        field_.agent = driver.place();
        if (simulated_ && is_valid(start_, ReInfo->track->length)) return true;
        refuse("there is no such place");
        again_ = false;  // nobody was moved
    }
    return false;
}

void FlyingStart::refuse(const char* reason) {
    refused_ = again_ = true;
    wanted_ = stands_ = false;
    std::printf("scr_server: no start at %g m, %g across, %g rad, %g m/s: %s; begins on the grid\n",
                start_.distance, start_.track_position, start_.heading_error, start_.speed, reason);
    std::fflush(stdout);
}

bool FlyingStart::misses_grid() {
    if (stands_ || flying_) return false;
    if (rest_heights_.empty() && !again_) {
        for (int i = 0; i < field_.number; i++)
            rest_heights_.push_back(height_over_road(field_, field_.cars[i]));
        track_ = ReInfo->track;
        again_ = wanted_;
    }
    return std::exchange(again_, false);
}

void FlyingStart::drive_off(Situation& situation) {
    stands_ = false;
    flying_ = true;
    situation.state = RUNNING;
    situation.time = 0.0;
    situation.delta_time = ROBOT_STEP;
    ReInfo->robots_time = -ROBOT_STEP;
    for (int i = 0; i < field_.number; i++) {
        CarElement& car = field_.cars[i];
        const auto place = static_cast<std::size_t>(i);
        car.control = controls_[place];
        give_speed(field_, car, start_.speed);
        ReInfo->progress[i].previous = car.pub.track;  // it may have settled across the line
        ReInfo->progress[i].backwards =
            count_crossings(car, distances_[place], ReInfo->track->length, start_.distance == 0.0);
    }
}

void FlyingStart::start_clocks(const Situation& situation) {
    if (!flying_) return;
    for (int i = 0; i < field_.number; i++) {
        CarElement& car = field_.cars[i];
        CarProgress& progress = ReInfo->progress[i];
        if (car.race.crossings == 0 && progress.backwards == 0 &&
            progress.previous.segment->race_info & BEFORE_LINE &&
            car.pub.track.segment->race_info & AFTER_LINE) {
            progress.lap_began = static_cast<float>(situation.time);
            car.race.best_lap_counts = true;  // whatever was hit on the way here
        }
    }
}

}  // namespace torcs::scr
