// How a race is driven: its start, its loop, snapshots.
#include "race.h"

#include <algorithm>
#include <cmath>

#include "checks.h"
#include "errors.h"
#include "gearbox.h"
#include "sensors.h"

namespace torcs {

namespace {

constexpr double COUNTDOWN = -2.0;   // [s]
constexpr int SETTLING_STEPS = 500;  // of standing on the brake, so that the springs come to rest

}  // namespace

// ---- The start ----------------------------------------------------------------------------------

// Robots find their place on the road here, and later search only around their last place. So the
// cars must stand where the race begins, and a robot can be told of one race only.
void Race::announce() {
    for (int i = 0; i < cars_number(); i++) {
        CarElement& car = world_->cars[i];
        car.robot->new_race(car.robot->index, &car, &world_->situation);
    }
}

void Race::prepare() {
    Hosted hosted(host_);
    unannounced_ = save();
    announce();
    simulation_.update(&world_->situation, PHYSICS_STEP, -1);
    for (int i = 0; i < cars_number(); i++) world_->records[i].previous = world_->cars[i].pub.track;
    settle(field(), world_->situation, SETTLING_STEPS, false);
    for (int i = 0; i < cars_number(); i++)
        rest_heights_.push_back(height_over_road(field(), world_->cars[i]));
    check_simulation(*simulated_, world_->cars, cars_number());
    Situation& situation = world_->situation;
    world_->last_call = -1.0;
    situation.time = COUNTDOWN;
    situation.delta_time = PHYSICS_STEP;
    situation.state = STARTING;
    // The agent waits on its brake; robots are called, as they are in the game.
    while (situation.time < 0.0 || !call_is_due()) step();
    for (int i = 0; i < cars_number(); i++)
        world_->records[i].start_distance = world_->cars[i].race.distance_raced;
    on_grid_ = save();
}

void Race::set_conditions(const Conditions& conditions) { conditions_ = conditions; }

void Race::set_grip(double grip) {
    if (grip == grip_) return;
    for (const auto& [surface, friction] : friction_)
        surface->friction = static_cast<float>(friction * grip);
    grip_ = grip;
}

// The agents' cars get the mass of the episode.
void Race::load_agents() {
    if (conditions_.mass == 1.0) return;
    const auto factor = static_cast<float>(conditions_.mass);
    for (const int agent : agents_) {
        SimulatedCar& car = (*simulated_)[agent];
        car.mass *= factor;
        car.inverse_mass /= factor;
        for (float& inverse : car.inverse_inertia) inverse /= factor;
    }
}

void Race::start() {
    restore(on_grid_);
    set_grip(conditions_.grip);
    load_agents();
}

void Race::start(const Start& start) {
    restore(unannounced_);
    set_grip(conditions_.grip);
    try {
        start_elsewhere(start);
    } catch (...) {
        this->start();  // the race that was begun cannot be driven
        throw;
    }
}

void Race::start_elsewhere(const Start& start) {
    Hosted hosted(host_);
    Situation& situation = world_->situation;
    const std::vector<double> distances = put_down(field(), start, rest_heights_);
    load_agents();
    {
        std::lock_guard<std::mutex> lock(game_.mutex);  // robots may read files, as when loaded
        announce();
    }
    come_to_rest(field(), situation);
    if (const CarElement* car = stuck_car(field()))
        throw Error("StartBlocked", std::string(car->info.name) +
                                        " would stand in a wall or in another car; start "
                                        "elsewhere, or nearer to the middle of the road");
    situation.state = RUNNING;
    situation.time = 0.0;
    situation.delta_time = ROBOT_STEP;
    world_->last_call = -ROBOT_STEP;
    for (int i = 0; i < cars_number(); i++) {
        give_speed(field(), world_->cars[i], start.speed);
        begin_on_the_way(i, start, distances[static_cast<std::size_t>(i)]);
    }
    sort();
}

// Counts laps and distance from where a car has been put down.
void Race::begin_on_the_way(int index, const Start& start, double distance) {
    CarElement& car = world_->cars[index];
    Record& record = world_->records[index];
    record.flying = true;
    record.previous = car.pub.track;  // it may have settled across the line
    manage(car);
    record.backwards = count_crossings(car, distance, track_->length, start.distance == 0.0);
    measure_distance(car);
    record.start_distance = car.race.distance_raced;
}

// ---- Driving ------------------------------------------------------------------------------------

void Race::hold(int index, const Controls& controls) { world_->controls[index] = controls; }

void Race::drive(int ticks) {
    if (ticks < 0)
        throw Error("InvalidOption",
                    "ticks is " + std::to_string(ticks) + "; expected a whole number >= 0");
    Hosted hosted(host_);
    // In a race without a flag, environments decide when it is over.
    const auto over = [this] { return has_flag() && ended(); };
    for (int i = 0; i < ticks && !over(); i++) {
        step();
        while (!call_is_due() && !over()) step();
    }
    take_out_lost();
}

// A robot that is nowhere is out, and so is an agent in a race under a flag; the others race on. An
// environment has to end the episode of its agent.
void Race::take_out_lost() {
    for (int i = 0; i < cars_number(); i++) {
        CarElement& car = world_->cars[i];
        CarPublic& state = car.pub;
        if (std::isfinite(state.local.vel.x) && std::isfinite(state.local.pos.x)) continue;
        if (options_.entries[static_cast<std::size_t>(i)].is_agent() && !options_.flagged)
            throw Error("CarLost", "the game's physics has divided by zero, " +
                                       std::string(car.info.name) +
                                       " is nowhere; call reset to go on");
        retire(i);
        world_->records[i].lost = true;
        // What is read of it stays finite: it stands where its last segment of road begins.
        state.local = state.global = Motion{};
        state.speed = 0.0f;
        state.track.to_start = state.track.to_right = state.track.to_middle = 0.0f;
        state.track.to_left = 0.0f;
        measure_distance(car);
    }
}

void Race::update_physics(int steps) {
    Hosted hosted(host_);
    for (int i = 0; i < steps; i++) simulation_.update(&world_->situation, PHYSICS_STEP, -1);
}

bool Race::ended() const { return world_->situation.state == ENDED; }

bool Race::call_is_due() const {
    return world_->situation.time + PHYSICS_STEP - world_->last_call >= ROBOT_STEP;
}

void Race::step() {
    Situation& situation = world_->situation;
    situation.time += PHYSICS_STEP;
    if (situation.time < 0.0) {
        situation.state = PRESTART;
    } else if (situation.state == PRESTART) {
        situation.state = RUNNING;
        situation.time = 0.0;
        world_->last_call = 0.0;
    }
    if (situation.time - world_->last_call >= ROBOT_STEP) call_drivers();
    keep_rolling();
    simulation_.update(&situation, PHYSICS_STEP, -1);
    for (int i = 0; i < situation.cars_number; i++) manage(*world_->order[i]);
    sort();
    if (situation.cars_number > 1) watch_contacts();
}

// The game's tyre model divides by zero if a wheel moves sideways and its forward speed is exactly
// 0. That is rare, and would end the drive; here such a car gets a tiny forward speed.
void Race::keep_rolling() {
    constexpr float HAIR = 1e-5f;  // [m/s]
    for (int i = 0; i < world_->situation.cars_number; i++) {
        Pose& velocity = (*simulated_)[i].local.vel;
        if (velocity.x == 0.0f && velocity.az == 0.0f && velocity.y != 0.0f) velocity.x = HAIR;
    }
}

void Race::call_drivers() {
    Situation& situation = world_->situation;
    situation.delta_time = situation.time - world_->last_call;
    for (int i = 0; i < situation.cars_number; i++) {
        CarElement& car = *world_->order[i];
        if (car.pub.status & NOT_SIMULATED) continue;
        if (is_agent(car.index))
            drive_agent(car);
        else
            car.robot->drive(car.robot->index, &car, &situation);
    }
    world_->last_call = situation.time;
}

void Race::drive_agent(CarElement& car) {
    if (world_->situation.state == PRESTART) return;
    const Controls& controls = world_->controls[car.index];
    car.control.steering = controls.steering;
    car.control.throttle = controls.throttle;
    car.control.brake = controls.brake;
    car.control.gear = controls.gear;
    car.control.clutch = controls.clutch;  // the gearbox presses it, too, while it shifts
    if (controls.gear == AUTOMATIC_GEAR) shift(car);
}

// A gearbox that shifts by motor speed hunts while wheels spin. By road speed, it shifts by the
// speed that the motor would have if no wheel slipped. In first gear the clutch slips, so that the
// motor can turn faster than the wheels.
void Race::shift(CarElement& car) const {
    const CarPrivate& priv = car.priv;
    const float* ratio = priv.gear_ratio + priv.gear_offset;
    const float shift_up = SHIFT_UP * priv.red_line;
    const int gear = std::max(priv.gear, 1);
    float engine_speed = priv.engine_speed;
    const Entry& entry = options_.entries[static_cast<std::size_t>(car.index)];
    if (entry.gearbox == Gearbox::ROAD_SPEED) {
        const float radius = (*simulated_)[car.index].wheel[REAR_RIGHT].radius;
        engine_speed = std::max(car.pub.local.vel.x, 0.0f) / radius * ratio[gear];
        if (gear == 1) {
            const float launch = LAUNCH_CLUTCH * std::max(1.0f - engine_speed / shift_up, 0.0f);
            car.control.clutch = std::max(car.control.clutch,
                                          std::floor(launch * CLUTCH_STEPS + 0.5f) / CLUTCH_STEPS);
        }
    }
    car.control.gear = gear;
    if (priv.gear < 1) return;
    if (engine_speed > shift_up && gear < priv.gears_number - 1)
        car.control.gear = gear + 1;
    else if (gear > 1 && engine_speed * ratio[gear - 1] / ratio[gear] < SHIFT_DOWN * priv.red_line)
        car.control.gear = gear - 1;
}

// ---- Leaving and rejoining ----------------------------------------------------------------------

// Takes a car out of the collision library, as the simulation does with a wreck.
void Race::lift(CarElement& car) {
    stop_colliding_(*simulated_ + car.index, cars_number());
    if (car.race.pit && car.pub.status & IN_PIT) car.race.pit->occupied_by = -1;
}

void Race::retire(int index) {
    Hosted hosted(host_);
    CarElement& car = world_->cars[index];
    if (car.pub.status & OUT_OF_RACE) return;
    lift(car);
    car.pub.status = (car.pub.status & ~IN_PIT) | OUT_OF_RACE;
}

// Along the road from the start line, [m].
double Race::free_place(int index) const {
    const double length = track_->length;
    std::vector<double> taken;
    for (int i = 0; i < cars_number(); i++)
        if (i != index && !(car(i).pub.status & NOT_SIMULATED & ~IN_PIT))
            taken.push_back(distance_along(car(i), length));
    if (taken.empty()) return grid_distance(index);
    std::sort(taken.begin(), taken.end());
    double begin = taken.back() - length, widest = 0.0, place = 0.0;
    for (const double end : taken) {
        if (end - begin > widest) {
            widest = end - begin;
            place = begin + 0.5 * widest;
        }
        begin = end;
    }
    return place < 0.0 ? place + length : place;
}

void Race::rejoin(int index, const Start& start) {
    Hosted hosted(host_);
    CarElement& car = world_->cars[index];
    Record& record = world_->records[index];
    lift(car);
    car.pub.status = 0;
    const Start there = {free_place(index), start.track_position, start.heading_error, start.speed};
    put_down_rolling(field(), car, there, rest_heights_[static_cast<std::size_t>(index)]);
    CarRace& race = car.race;
    while (race.penalties.first) {
        Penalty* penalty = race.penalties.first;
        race.penalties.first = penalty->next;
        arena_.release(penalty);
    }
    race.penalties.last = &race.penalties.first;
    race.best_lap_time = race.last_lap_time = race.total_time = race.delta_best_lap_time = 0.0;
    race.penalty_time = race.top_speed = 0.0f;
    race.lap_time = 0.0;  // the rules look at it first
    race.best_lap_counts = true;
    race.remaining_laps = world_->situation.laps;
    const int room = record.laps_room;
    LapRecord* laps = record.laps;
    record = Record{};
    record.laps = laps;
    record.laps_room = room;
    record.lap_began = static_cast<float>(world_->situation.time);
    world_->controls[index] = Controls{};
    begin_on_the_way(index, there, there.distance);
    sort();
}

// ---- Reading and keeping ------------------------------------------------------------------------

float Race::height(int index) const { return height_over_road(field(), car(index)); }

double Race::distance_raced(int index) const {
    return world_->cars[index].race.distance_raced - world_->records[index].start_distance;
}

double Race::gap(int index, int places) const {
    const int other = car(index).race.position - 1 + places;
    if (other < 0 || other >= cars_number()) return SENSOR_RANGE;
    const float behind = world_->order[other]->race.distance_raced - car(index).race.distance_raced;
    return std::fabs(static_cast<double>(behind));
}

int Race::laps_left(int index) const {
    return world_->situation.laps - std::max(car(index).race.crossings - 1, 0);
}

std::vector<LapRecord> Race::laps(int index) const {
    const Record& record = world_->records[index];
    return {record.laps, record.laps + record.laps_number};
}

Snapshot Race::save() const {
    Snapshot snapshot{number_, grip_, arena_.save(), {}};
    snapshot.variables.push_back(simulation_library_->save());
    for (const auto& library : robot_libraries_) snapshot.variables.push_back(library->save());
    return snapshot;
}

void Race::restore(const Snapshot& snapshot) {
    set_grip(snapshot.grip);
    arena_.restore(snapshot.memory);
    simulation_library_->restore(snapshot.variables[0]);
    for (std::size_t i = 0; i < robot_libraries_.size(); i++)
        robot_libraries_[i]->restore(snapshot.variables[i + 1]);
}

}  // namespace torcs
