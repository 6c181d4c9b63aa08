#include "engine.h"

#include <pthread.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <utility>

#include "appearance.h"
#include "errors.h"

namespace torcs {

namespace {

int forks = 0;

int count_forks() {
    static const int watching = pthread_atfork(nullptr, nullptr, [] { forks++; });
    (void)watching;
    return forks;
}

double wrapped(double angle) { return std::remainder(angle, 2.0 * M_PI); }

template <typename Record>
void append(std::string& to, const Record& record) {
    to.append(reinterpret_cast<const char*>(&record), sizeof record);
}

CarAppearance appearance_of(const CarElement& car) {
    CarAppearance looks;
    std::memset(&looks, 0, sizeof looks);  // also the padding between the members
    looks.index = car.index;
    looks.segment = car.pub.track.segment->id;
    looks.pub = car.pub;
    looks.race = car.race;
    looks.priv = car.priv;
    looks.control = car.control;
    looks.pub.track.segment = nullptr;
    looks.race.pit = nullptr;
    looks.race.penalties = {nullptr, nullptr};
    looks.priv.driver_params = looks.priv.car_params = nullptr;
    for (WheelState& wheel : looks.priv.wheel) wheel.segment = nullptr;
    return looks;
}

// Agents have the indices 0, 1, ... in any order.
void check_entries(const std::vector<Entry>& entries, std::size_t angles) {
    std::vector<int> agents;
    for (const Entry& entry : entries)
        if (entry.is_agent()) agents.push_back(entry.index);
    std::sort(agents.begin(), agents.end());
    bool numbered = true;
    for (std::size_t i = 0; i < agents.size(); i++) numbered &= agents[i] == static_cast<int>(i);
    if (entries.empty() || !numbered || angles != std::max<std::size_t>(agents.size(), 1))
        throw Error("InvalidOption",
                    std::to_string(entries.size()) + " drivers, " + std::to_string(agents.size()) +
                        " of them agents, and range finders of " + std::to_string(angles) +
                        "; expected one driver or more, agents numbered from 0, "
                        "and range finders for each agent");
}

}  // namespace

Engine::Engine(Game& game, RaceOptions options, std::vector<Angles> angles)
    : forks_(count_forks()) {
    check_entries(options.entries, angles.size());
    for (const Entry& entry : options.entries)
        angles_.push_back(angles[entry.is_agent() ? static_cast<std::size_t>(entry.index) : 0]);
    const PlainRounding rounding;
    race_ = std::make_unique<Race>(game, std::move(options));
}

Engine::~Engine() {
    // In a child process, threads that exist only in the parent may hold the locks for ever.
    if (forks_ != forks) (void)race_.release();
}

Engine::Access::Access(Engine& engine) : engine_(engine) {
    if (engine.busy_.exchange(true, std::memory_order_acquire))
        throw Error("EngineBusy",
                    "another thread is driving this engine; make one environment per thread");
    const char* reason = nullptr;
    if (engine.forks_ != forks)
        reason = "this engine belongs to the parent process; make the environment after the fork";
    else if (!engine.race_)
        reason = "this engine is closed; make a new environment";
    if (reason) {
        const bool closed = engine.forks_ == forks;
        engine.busy_.store(false, std::memory_order_release);
        throw Error(closed ? "EnvClosed" : "EngineForked", reason);
    }
}

void Engine::start() { Access(*this)->start(); }

namespace {

void check_start(const Start& start, double length) {
    if (!is_valid(start, length))
        throw Error("InvalidOption",
                    "start at " + std::to_string(start.distance) + " m, place across " +
                        std::to_string(start.track_position) + ", heading error " +
                        std::to_string(start.heading_error) + " rad, " +
                        std::to_string(start.speed) + " m/s; expected 0 to " +
                        std::to_string(length) + " m, -5 to 5, -2 pi to 2 pi, 0 to 200 m/s");
}

}  // namespace

void Engine::start(const Start& start) {
    Access race(*this);
    (void)first_agent(*race);
    check_start(start, race->track().length);
    race->start(start);
}

void Engine::drive(int ticks) { Access(*this)->drive(ticks); }

void Engine::advance(int ticks) {
    Access race(*this);
    for (const int agent : race->agents()) race->hold(agent, {0.0f, 0.0f, 1.0f, 0, 0.0f});
    race->drive(ticks);
}

void Engine::retire(int car) {
    Access race(*this);
    check_car(*race, car);
    race->retire(car);
}

void Engine::rejoin(int car, const Start& start) {
    Access race(*this);
    check_agent(*race, car);
    check_start(start, race->track().length);
    race->rejoin(car, start);
}

void Engine::set_noise(std::optional<std::uint64_t> seed) {
    Access race(*this);
    noise_.reset();
    if (seed) noise_.emplace(*seed);
}

bool Engine::mute_noise(bool muted) {
    Access race(*this);
    return std::exchange(muted_, muted);
}

void Engine::set_conditions(const Conditions& conditions) {
    Access(*this)->set_conditions(conditions);
}

void Engine::set_origin(double x, double y) {
    Access race(*this);
    x_ = x;
    y_ = y;
}

Moment Engine::save() {
    Access race(*this);
    return {race->save(), noise_};
}

void Engine::restore(const Moment& moment) {
    Access race(*this);
    if (moment.race.race != race->number())
        throw Error("InvalidOption",
                    "the snapshot was saved by another engine; restore it where it was saved");
    race->restore(moment.race);
    noise_ = moment.noise;
}

void Engine::close() {
    if (!race_ || forks_ != forks) return;
    Access race(*this);
    race_.reset();
}

int Engine::first_agent(const Race& race) {
    if (race.agents().empty())
        throw Error("InvalidOption", "this race has robots only; put the agent into its list");
    return race.agents().front();
}

void Engine::check_agent(const Race& race, int car) {
    check_car(race, car);
    if (!race.is_agent(car))
        throw Error("InvalidOption", "car " + std::to_string(car) +
                                         " is a robot's, which drives itself; name an agent's");
}

void Engine::check_car(const Race& race, int car) {
    if (car < 0 || car >= race.cars_number())
        throw Error("InvalidOption", "car is " + std::to_string(car) + "; expected 0 to " +
                                         std::to_string(race.cars_number() - 1));
}

std::string Engine::appearance() {
    Access race(*this);
    std::string looks;
    append(looks,
           SceneAppearance{race->situation().time, race->cars_number(), sizeof(CarAppearance)});
    for (int i = 0; i < race->cars_number(); i++) append(looks, appearance_of(*race->cars()[i]));
    return looks;
}

Reading Engine::read(int car) {
    Access race(*this);
    check_car(*race, car);
    return read(*race, car);
}

std::array<double, FOCUS_BEAMS> Engine::focus(int car, double direction) {
    Access race(*this);
    check_car(*race, car);
    if (!std::isfinite(direction))
        throw Error("InvalidOption", "direction is no finite number; expected radians");
    std::array<double, FOCUS_BEAMS> beams;
    focused_range_finders(race->car(car), direction, beams.data());
    return beams;
}

Reading Engine::read(Race& race, int index) {
    const CarElement& car = race.car(index);
    const Motion& motion = car.pub.local;
    const TrackPosition& position = car.pub.track;
    Reading reading;
    reading.scalars = {
        race.situation().time,
        motion.pos.x + x_,
        motion.pos.y + y_,
        wrapped(motion.pos.az),
        motion.vel.az,
        motion.vel.x,
        motion.vel.y,
        motion.vel.z,
        race.height(index),
        heading_error(car),
        position.to_middle,
        position.segment->width,
        distance_along(car, race.track().length),
        race.distance_raced(index),
        car.priv.engine_speed,
        static_cast<double>(car.priv.gear),
        car.priv.fuel,
        static_cast<double>(car.priv.damage),
        static_cast<double>(std::max(car.race.crossings - 1, 0)),
        car.race.lap_time,
        car.race.last_lap_time,
        car.race.best_lap_time,
        static_cast<double>(car.race.position),
    };
    for (std::size_t i = 0; i < 4; i++) reading.wheel_speeds[i] = car.priv.wheel[i].spin;
    range_finders(car, angles_[static_cast<std::size_t>(index)].data(),
                  reading.range_finders.data());
    opponents(car, race.cars(), race.cars_number(), reading.opponents.data());
    reading.race = {
        race.gap(index, -1), race.gap(index, 1), static_cast<double>(race.laps_left(index)),
        static_cast<double>(race.contacts(index)), static_cast<double>(race.faults(index))};
    rivals(car, race.cars(), race.cars_number(), race.track().length,
           reading.race.data() + (RACE_NUMBERS - RIVAL_NUMBERS));
    if (noise_ && !muted_)
        add_noise(*noise_, reading.range_finders.data(), reading.opponents.data());
    return reading;
}

void Engine::replay(const std::vector<Controls>& controls, bool sensors) {
    Access race(*this);
    const int agent = first_agent(*race);
    double sum = 0.0;
    for (const Controls& control : controls) {
        race->hold(agent, control);
        race->drive(1);
        if (sensors) sum += read(*race, agent).range_finders[0];
    }
    if (!std::isfinite(sum)) throw Error("BackendUnavailable", "a sensor read no number");
}

void Engine::update_physics(int steps) { Access(*this)->update_physics(steps); }

}  // namespace torcs
