#include "driver.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>

#include "engine.h"
#include "loop.h"
#include "options.h"

namespace torcs::scr {
namespace {

constexpr auto PATIENCE = std::chrono::seconds(3);  // until the user learns who is awaited
constexpr double FOCUS_COOL_DOWN = 1.0;             // [s] the focused range finders rest
constexpr double FOCUS_NOISE = 0.01;                // [-] of each reading, standard deviation
constexpr float WHITE[] = {1.0f, 1.0f, 1.0f, 1.0f};

}  // namespace

void Driver::new_track(int index, const TrackData* track) {
    index_ = index;
    track_ = track;
    client_.open(index);
    // The generator is not seeded anew at a restart: each race has other noise, each session the
    // same.
    if (options().noisy && !noise_) noise_.emplace(static_cast<std::uint64_t>(index));
}

void Driver::new_race(CarElement* car, const Situation* situation) {
    car_ = car;
    situation_ = situation;
    next_focus_ = 0.0;
    told_crossings_ = 0;
    started_ = false;
    action_ = Action{};
    action_.focus.reset();  // nobody has asked for it yet
    if (!client_.has_network() || leaving() == Leaving::UNNOTICED) return;
    // Clients that end at a restart would stop the race for the others, without a sign.
    const bool restarts = leaving() == Leaving::TO_RESTART;
    const auto until = std::chrono::steady_clock::now() + PATIENCE;
    bool reported = !restarts;
    while (!ending() && !client_.await_introduction()) {
        for (Driver& other : drivers())
            if (other.client_.has_network()) other.client_.hear_introduction();
        if (reported || std::chrono::steady_clock::now() < until) continue;
        reported = true;
        client_.report("the race waits for " + client_.description() +
                       ", who has not come back after the restart; start that client again");
    }
    name_car();
}

// The game's boards and results show the client's name, not its port.
void Driver::name_car() {
    if (!client_.name().empty())
        std::snprintf(car_->info.name, NAME_LENGTH, "%s", client_.name().c_str());
}

bool Driver::drive() {
    if (!client_.has_network() || !goes_on()) return false;
    const State state = sense();
    const auto answer = client_.ask(state);
    name_car();
    if (!answer) return false;  // the car goes on with what it was told last
    action_ = *answer;
    Control& control = car_->control;
    control.throttle = static_cast<float>(action_.throttle);
    control.brake = static_cast<float>(action_.brake);
    control.clutch = static_cast<float>(action_.clutch);
    control.steering = static_cast<float>(action_.steering);
    control.gear = action_.gear;
    if (ReInfo->display_mode != TEXT_MODE) show_board(state);
    if (action_.restart) report_restart();
    return action_.restart;
}

bool Driver::watch() {
    if (!car_ || !client_.has_network() || !goes_on()) return false;
    if (!(car_->pub.status & NOT_SIMULATED)) return false;
    const auto answer = client_.ask(sense());
    if (!answer || !answer->restart) return false;
    report_restart();
    return true;
}

// It is nobody's own affair where several clients race.
void Driver::report_restart() const {
    const auto races = [](const Driver& driver) {
        return driver.races() && driver.client_.has_network();
    };
    if (std::count_if(drivers().begin(), drivers().end(), races) > 1)
        client_.report(client_.description() + " restarts the race, for all clients");
}

void Driver::leave() {
    if (!car_) return;
    const bool for_good = leaving() == Leaving::FOR_GOOD;
    if (for_good && client_.has_network()) {
        // The race may end at the line, before a client hears of its last lap.
        if (car_->race.crossings != told_crossings_) client_.tell(sense());
        const std::string who = client_.description();
        std::printf("scr_server %d: %s: %ld control ticks, %ld late\n", index_,
                    who.empty() ? "nobody" : who.c_str(), client_.ticks(), client_.late());
        std::fflush(stdout);
    }
    if (leaving() != Leaving::UNNOTICED) client_.dismiss(for_good ? SHUTDOWN : RESTART);
    car_ = nullptr;
}

std::array<Driver, MODULE_INTERFACES>& drivers() {
    static std::array<Driver, MODULE_INTERFACES> drivers;
    return drivers;
}

// ---- Sensors ------------------------------------------------------------------------------------

State Driver::sense() {
    const Motion& motion = car_->pub.local;
    TrackPosition position = car_->pub.track;
    if (!started_) raced_before_ = car_->race.distance_raced;
    started_ = situation_->state != PRESTART;
    told_crossings_ = car_->race.crossings;
    State state{};
    state.heading_error = heading_error(*car_);
    state.lap_time = car_->race.lap_time;
    state.damage = mercy().damage_of(*car_);
    state.distance = distance_along(*car_, track_->length);
    state.distance_raced = car_->race.distance_raced - raced_before_;
    state.fuel = car_->priv.fuel;
    state.gear = car_->priv.gear;
    state.last_lap_time = car_->race.last_lap_time;
    opponents(*car_, situation_->cars, situation_->cars_number, state.opponents);
    state.position = car_->race.position;
    state.engine_speed = car_->priv.engine_speed;
    state.velocity[0] = motion.vel.x;
    state.velocity[1] = motion.vel.y;
    state.velocity[2] = motion.vel.z;
    range_finders(*car_, client_.init().angles.data(), state.range_finders);
    state.track_position = 2.0 * position.to_middle / position.segment->width;
    for (int i = 0; i < 4; i++) state.wheel_speeds[i] = car_->priv.wheel[i].spin;
    state.height = motion.pos.z - road_height(&position);
    state.yaw_rate = motion.vel.az;
    sense_focus(state);
    if (noise_) add_noise(*noise_, state.range_finders, state.opponents);
    return state;
}

void Driver::sense_focus(State& state) {
    std::fill_n(state.focus, FOCUS_BEAMS, OFF_TRACK);
    const double now = situation_->time;
    if (!action_.focus || now < next_focus_ || state.range_finders[0] == OFF_TRACK) return;
    next_focus_ = now + FOCUS_COOL_DOWN;
    focused_range_finders(*car_, *action_.focus, state.focus);
    if (!noise_) return;
    for (double& reading : state.focus) reading *= 1.0 + FOCUS_NOISE * noise_->normal();
}

// ---- The game's board ---------------------------------------------------------------------------

void Driver::show_board(const State& state) const {
    Control& control = car_->control;
    std::snprintf(control.message[0], NAME_LENGTH, "steer %+.2f  gas %3.0f  brake %3.0f",
                  action_.steering, 100.0 * action_.throttle, 100.0 * action_.brake);
    std::snprintf(control.message[1], NAME_LENGTH, "left %.0f ahead %.0f right %.0f m",
                  state.range_finders[0], state.range_finders[9], state.range_finders[18]);
    const int minutes = static_cast<int>(std::max(state.lap_time, 0.0) / 60.0);
    std::snprintf(control.message[3], NAME_LENGTH, "lap %d:%05.2f", minutes,
                  std::max(state.lap_time, 0.0) - 60.0 * minutes);
    std::copy_n(WHITE, 4, control.message_color);
}

}  // namespace torcs::scr
