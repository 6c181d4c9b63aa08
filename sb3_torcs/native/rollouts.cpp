#include "rollouts.h"

#include <algorithm>
#include <cmath>
#include <string>

#include "errors.h"
#include "sensors.h"

namespace torcs {

namespace {

constexpr double SLOW = 20.0;       // [m/s] up to which the wheel is turned for the full gain
constexpr double WALKING = 2.0;     // [m/s]
constexpr double MOST_ASIDE = 2.0;  // [m] that a car steers back at once
constexpr double FULL_THROTTLE = 0.98;

Waypoint where(const Race& race) {
    const CarElement& car = race.car(race.agents().front());
    return {race.situation().time,
            race.distance_raced(race.agents().front()),
            car.pub.track.to_middle,
            heading_error(car),
            car.pub.local.vel.x,
            0.0,
            0.0};
}

double between(double a, double b, double share) { return a + share * (b - a); }

// The line where the car is; `cursor` is the waypoint before it, from which the search goes on. A
// car that sets off takes the waypoints one by one: it stands, or even rolls back.
Waypoint line_at(const std::vector<Waypoint>& line, const Waypoint& car, std::size_t& cursor) {
    const double distance = car.distance;
    if (car.speed < WALKING && line[cursor].speed < WALKING)
        return line[cursor + 2 < line.size() ? cursor++ : cursor];
    while (cursor + 2 < line.size() && line[cursor + 1].distance <= distance) cursor++;
    while (cursor > 0 && line[cursor].distance > distance) cursor--;
    const Waypoint &a = line[cursor], &b = line[cursor + 1];
    const double gap = b.distance - a.distance;
    const double share = gap > 0.0 ? std::clamp((distance - a.distance) / gap, 0.0, 1.0) : 0.0;
    return {between(a.time, b.time, share),     distance,
            between(a.offset, b.offset, share), between(a.heading_error, b.heading_error, share),
            between(a.speed, b.speed, share),   between(a.steering, b.steering, share),
            between(a.pedal, b.pedal, share)};
}

// Where the line is at full throttle, a car that is faster shall not lift.
Waypoint controlled(const Waypoint& car, const Waypoint& line, const Offsets& offsets,
                    const Gains& gains) {
    const double aside =
        std::clamp(line.offset + offsets.place - car.offset, -MOST_ASIDE, MOST_ASIDE);
    const double turned = std::remainder(car.heading_error - line.heading_error, 2.0 * M_PI);
    const double steering = line.steering + offsets.steering + gains.heading * turned +
                            gains.place * aside * SLOW / std::max(car.speed, SLOW);
    double pedal = line.pedal + offsets.pedal;
    if (line.pedal < FULL_THROTTLE) pedal += gains.speed * (line.speed - car.speed);
    Waypoint now = car;
    now.steering = static_cast<float>(std::clamp(steering, -1.0, 1.0));
    now.pedal = static_cast<float>(std::clamp(pedal, -1.0, 1.0));
    return now;
}

Controls controls_of(const Waypoint& now) {
    return {static_cast<float>(now.steering), static_cast<float>(std::max(now.pedal, 0.0)),
            static_cast<float>(std::max(-now.pedal, 0.0)), AUTOMATIC_GEAR, 0.0f};
}

bool on_road(const Waypoint& car, const Race& race) {
    return std::abs(car.offset) <= 0.5 * race.car(race.agents().front()).pub.track.segment->width;
}

}  // namespace

Rollouts::Rollouts(const std::vector<std::shared_ptr<Engine>>& engines)
    : places_(engines.size()),
      pool_(static_cast<int>(engines.size()), engines.size(), [this](std::size_t i) { work(i); }) {
    for (std::size_t i = 0; i < engines.size(); i++) places_[i].engine = engines[i];
}

void Rollouts::mark() {
    job_ = Job::MARK;
    for_all();
}

void Rollouts::drive(const std::vector<Waypoint>& path, int ticks) {
    job_ = Job::DRIVE;
    path_ = &path;
    ticks_ = ticks;
    for_all();
}

void Rollouts::go_back(std::size_t drives) {
    for (const Place& place : places_)
        if (!place.marks.empty() && drives >= place.marks.size())
            throw Error("InvalidOption", "going back " + std::to_string(drives) + " drives of " +
                                             std::to_string(place.marks.size() - 1));
    job_ = Job::GO_BACK;
    drives_ = drives;
    for_all();
}

void Rollouts::follow(const Order& order) {
    if (order.line->size() < 2)
        throw Error("InvalidOption", "the line has " + std::to_string(order.line->size()) +
                                         " waypoints; expected two or more");
    job_ = Job::FOLLOW;
    order_ = &order;
    next_ = 0;
    for_all();
}

void Rollouts::for_all() {
    for (const Place& place : places_)
        if (job_ != Job::MARK && place.marks.empty())
            throw Error("InvalidOption", "candidates begin nowhere; mark a moment");
    for (std::size_t i = 0; i < places_.size(); i++) pool_.begin(i);
    pool_.finish();
    for (const Place& place : places_)
        if (place.failure) std::rethrow_exception(place.failure);
}

void Rollouts::work(std::size_t index) {
    Place& place = places_[index];
    place.failure = nullptr;
    try {
        work(place);
    } catch (...) {
        place.failure = std::current_exception();
    }
}

void Rollouts::work(Place& place) {
    Engine::Access race(*place.engine);
    const int agent = Engine::first_agent(*race);
    if (job_ == Job::MARK) place.marks.clear();
    if (job_ == Job::GO_BACK) place.marks.resize(place.marks.size() - drives_);
    if (job_ != Job::MARK) race->restore(place.marks.back());
    if (job_ == Job::DRIVE)
        for (const Waypoint& waypoint : *path_) {
            race->hold(agent, controls_of(waypoint));
            race->drive(ticks_);
        }
    if (job_ == Job::MARK || job_ == Job::DRIVE) place.marks.push_back(race->save());
    if (job_ != Job::FOLLOW) return;
    for (std::size_t candidate = next_++; candidate < order_->candidates; candidate = next_++) {
        follow(*race, candidate);
        race->restore(place.marks.back());
    }
}

void Rollouts::follow(Race& race, std::size_t candidate) const {
    const Order& order = *order_;
    const Offsets* offsets = order.offsets + candidate * order.steps;
    Waypoint* path = order.paths + candidate * (order.steps + 1);
    const std::vector<Waypoint>& line = *order.line;
    path[0] = where(race);
    const CarElement& car = race.car(race.agents().front());
    const int damage = car.priv.damage;
    const bool counted = car.race.best_lap_counts;
    std::size_t cursor = 0;
    std::size_t step = 0;
    for (; step < order.steps; step++) {
        Waypoint& now = path[step];
        now = controlled(now, line_at(line, now, cursor), offsets[step], order.gains);
        try {
            race.hold(race.agents().front(), controls_of(now));
            race.drive(order.ticks);
        } catch (const Error& error) {
            if (std::string(error.python_class) != "CarLost") throw;
            break;
        }
        path[step + 1] = where(race);
        const bool void_lap = counted && !car.race.best_lap_counts;
        if (!on_road(path[step + 1], race) || car.priv.damage > damage || void_lap) break;
    }
    order.lasted[candidate] = static_cast<std::int64_t>(step);
    std::fill(path + step + 1, path + order.steps + 1, path[step]);
}

}  // namespace torcs
