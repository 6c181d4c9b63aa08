#include "placing.h"

#include <algorithm>
#include <cmath>

#include "gearbox.h"
#include "maths/maths.h"
#include "sensors.h"

namespace torcs {
namespace {

constexpr int SETTLING_STEPS = 300;  // of a car put down at the height at which it stands
constexpr int AGAINST_RIGHT = 0;     // of to_global

Segment* segment_at(const TrackData& track, double distance) {
    Segment* segment = track.last;
    while (distance < segment->from_start) segment = segment->prev;
    return segment;
}

int gear_for(const Field& field, const CarElement& car, double speed) {
    const double spin = speed / (*field.simulated)[car.index].wheel[REAR_RIGHT].radius;
    const int highest = car.priv.gears_number - 1;
    int gear = 1;
    while (gear < highest &&
           spin * car.priv.gear_ratio[gear + car.priv.gear_offset] > SHIFT_UP * car.priv.red_line)
        gear++;
    return gear;
}

}  // namespace

bool is_valid(const Start& start, double track_length) {
    // A car may stand a little beyond the end, because the game adds lengths up in several ways.
    return start.distance >= 0.0 && start.distance <= track_length + 1.0 &&
           std::fabs(start.track_position) <= 5.0 && std::fabs(start.heading_error) <= 2.0 * M_PI &&
           start.speed >= 0.0 && start.speed <= 200.0;
}

void place(const Field& field, CarElement& car, float distance, float to_right, float heading_error,
           float height) {
    Segment* segment = segment_at(*field.manager->track, distance);
    const float along = distance - segment->from_start;
    car.pub.local = Motion{};
    Pose& pose = car.pub.local.pos;
    TrackPosition& position = car.pub.track;
    position.segment = segment;
    position.type = 0;
    position.to_right = to_right;
    position.to_start = segment->type == STRAIGHT ? along : along / segment->radius;
    field.to_global(&position, &pose.x, &pose.y, AGAINST_RIGHT);
    pose.az = segment->heading;
    if (segment->type == RIGHT_TURN) pose.az = segment->heading - position.to_start;
    if (segment->type == LEFT_TURN) pose.az = segment->heading + position.to_start;
    pose.az -= heading_error;
    pose.z = field.road_height(&position) + height;
    while (pose.az > 2 * M_PI) pose.az -= 2 * M_PI;
    while (pose.az < 0) pose.az += 2 * M_PI;
    field.simulation->config(&car, field.manager);
}

float height_over_road(const Field& field, const CarElement& car) {
    TrackPosition position = car.pub.track;
    return car.pub.local.pos.z - field.road_height(&position);
}

void settle(const Field& field, Situation& situation, int steps, bool in_gear) {
    for (int i = 0; i < field.number; i++) {
        Control& control = field.cars[i].control;
        const int gear = control.gear;
        control = Control{};
        control.brake = 1.0f;
        control.gear = in_gear ? gear : 0;
    }
    for (int i = 0; i < steps; i++) field.simulation->update(&situation, PHYSICS_STEP, -1);
}

std::vector<double> put_down(const Field& field, const Start& start,
                             const std::vector<float>& rest_heights) {
    const TrackData& track = *field.manager->track;
    const double from = distance_from_start(field.cars[field.agent]);
    std::vector<double> distances;
    for (int i = 0; i < field.number; i++) {
        CarElement& car = field.cars[i];
        distances.push_back(start.distance + (distance_from_start(car) - from));
        double distance = std::fmod(distances.back(), track.length);
        if (distance < 0.0) distance += track.length;
        float to_right = car.pub.track.to_right, heading_error = 0.0f;
        if (i == field.agent) {
            const double half_width = 0.5 * segment_at(track, distance)->width;
            to_right = static_cast<float>((1.0 + start.track_position) * half_width);
            heading_error = static_cast<float>(start.heading_error);
        }
        place(field, car, static_cast<float>(distance), to_right, heading_error,
              rest_heights[static_cast<std::size_t>(i)]);
        car.control.gear = gear_for(field, car, start.speed);  // engages while the car settles
    }
    return distances;
}

void put_down_rolling(const Field& field, CarElement& car, const Start& start, float rest_height) {
    const float width = segment_at(*field.manager->track, start.distance)->width;
    place(field, car, static_cast<float>(start.distance),
          static_cast<float>((1.0 + start.track_position) * 0.5 * width),
          static_cast<float>(start.heading_error), rest_height);
    // What the simulation would hand out after its next step.
    const SimulatedCar& simulated = (*field.simulated)[car.index];
    TrackPosition& position = car.pub.track;
    position.to_left = width - position.to_right;
    position.to_middle = position.to_right - 0.5f * width;
    car.pub.global = simulated.global;
    car.pub.speed = 0.0f;
    car.priv.fuel = simulated.fuel;
    car.priv.engine_speed = simulated.engine_speed;
    for (int i = 0; i < 4; i++) car.priv.wheel[i].spin = simulated.wheel[i].spin;
    // The gearbox of the simulation is in neutral, and goes into the gear that the car seems to
    // have.
    car.priv.gear = car.control.gear = gear_for(field, car, start.speed);
    give_speed(field, car, start.speed);
}

void come_to_rest(const Field& field, Situation& situation) {
    field.simulation->update(&situation, PHYSICS_STEP, -1);
    settle(field, situation, SETTLING_STEPS, true);
}

// The collision library cannot separate objects that were never apart: it returns NaN.
const CarElement* stuck_car(const Field& field) {
    for (int i = 0; i < field.number; i++) {
        const CarElement& car = field.cars[i];
        const Pose& pose = car.pub.local.pos;
        const bool nowhere = !std::isfinite(pose.x) || !std::isfinite(pose.z);
        if (nowhere || car.priv.collision & COLLISION_WITH_BODY) return &car;
    }
    return nullptr;
}

void give_speed(const Field& field, CarElement& car, double speed) {
    SimulatedCar& simulated = (*field.simulated)[car.index];
    simulated.damage = car.priv.damage = 0;  // of being put down level on a slope
    if (speed == 0.0) return;
    const maths::SineCosine yaw = maths::sine_cosine(simulated.global.pos.az);
    simulated.local.vel.x = static_cast<float>(speed);
    simulated.global.vel.x = static_cast<float>(speed * yaw.cosine);
    simulated.global.vel.y = static_cast<float>(speed * yaw.sine);
    for (int i = 0; i < 4; i++) {
        SimulatedWheel& wheel = simulated.wheel[i];
        wheel.spin = wheel.previous_spin = wheel.axle_spin =
            static_cast<float>(speed / wheel.radius);
        car.priv.wheel[i].spin = wheel.spin;
    }
    const float ratio = car.priv.gear_ratio[car.priv.gear + car.priv.gear_offset];
    simulated.engine_speed =
        std::max(simulated.engine_speed, simulated.wheel[REAR_RIGHT].spin * ratio);
    car.priv.engine_speed = simulated.engine_speed;
    car.pub.local = simulated.local;
    car.pub.global = simulated.global;
    car.pub.speed = static_cast<float>(speed);
}

int count_crossings(CarElement& car, double distance, double track_length, bool lap_has_begun) {
    const double shift = distance - distance_from_start(car);
    const int ahead = (lap_has_begun ? 1 : 0) + static_cast<int>(std::lround(shift / track_length));
    car.race.crossings = std::max(ahead, 0);
    car.race.remaining_laps -= car.race.crossings;
    return std::max(-ahead, 0);
}

}  // namespace torcs
