#include "sensors.h"

#include <algorithm>
#include <cmath>

#include "maths/maths.h"

namespace torcs {
namespace {

constexpr double SECTOR = 2.0 * M_PI / OPPONENT_SECTORS;  // [rad]

constexpr double RANGE_FINDER_NOISE = 0.1;  // [-] standard deviation relative to the reading
constexpr double OPPONENT_NOISE = 0.02;

struct Vector {
    double x, y;
};

Vector operator-(Vector a, Vector b) { return {a.x - b.x, a.y - b.y}; }
double dot(Vector a, Vector b) { return a.x * b.x + a.y * b.y; }
double cross(Vector a, Vector b) { return a.x * b.y - a.y * b.x; }  // positive if b is left of a

Vector towards(double angle) {
    const maths::SineCosine at = maths::sine_cosine(angle);
    return {at.cosine, at.sine};
}

Vector ground(const Point& point) { return {point.x, point.y}; }

// Direction of the road at the car, [rad].
double road_heading(const TrackPosition& track) {
    const Segment& segment = *track.segment;
    if (segment.type == STRAIGHT) return segment.heading;
    const double turned = track.to_start;
    return segment.type == LEFT_TURN ? segment.heading + turned : segment.heading - turned;
}

// The car's place, from its place against the road; `left` is the unit vector across the road.
Vector place(const TrackPosition& track, Vector left) {
    const Segment& segment = *track.segment;
    if (segment.type == STRAIGHT) {
        const Vector corner = ground(segment.vertex[START_RIGHT]);
        return {corner.x + track.to_start * left.y + track.to_right * left.x,
                corner.y - track.to_start * left.x + track.to_right * left.y};
    }
    const Vector center = ground(segment.center);
    const double outwards = segment.type == LEFT_TURN
                                ? double(track.to_right) - segment.radius_right
                                : double(track.to_right) + segment.radius_right;
    return {center.x + outwards * left.x, center.y + outwards * left.y};
}

// ---- Range finders -----------------------------------------------------------------------------

// A ray that follows the road one way, from border to border between segments, until an edge stops
// it. It never turns back: a ray that crosses one border forwards crosses the next one forwards,
// because its direction is constant on a straight, and its angular momentum about the centre in a
// turn. So it is enough to know on which side of a border's corners the ray passes, which needs no
// trigonometry. This holds for turns of up to half a circle; a segment of the game's tracks turns
// by 90 degrees at most.
//
// The game's loader gives the road of a segment one width from start to end. So corners and radii
// agree with the width at the start, which the SCR server uses.
class Ray {
public:
    // `direction` is a unit vector.
    Ray(Vector origin, Vector direction, bool forwards)
        : origin_(origin), direction_(direction), forwards_(forwards) {}

    // Distance [m] to the edge, from a place within `first`.
    double cast(const Segment& first) const {
        Vector entry = origin_;
        const Segment* segment = &first;
        do {
            const Vector left = corner(*segment, LEFT, EXIT);
            const Vector right = corner(*segment, RIGHT, EXIT);
            const bool leaves = passes_between(left, right);
            if (!leaves || (segment->type != STRAIGHT && grazes(*segment, entry, left))) {
                const bool outside = segment != &first && !comes_in(*segment);
                return limited(outside ? end_at_entry(*segment) : end_in(*segment, entry));
            }
            if (std::min(ahead(left), ahead(right)) >= SENSOR_RANGE) break;
            entry = left;
            segment = forwards_ ? segment->next : segment->prev;
        } while (segment != &first);  // one lap at most, on any track
        return SENSOR_RANGE;
    }

private:
    enum Border { ENTRY, EXIT };

    static double limited(double distance) { return std::clamp(distance, 0.0, SENSOR_RANGE); }

    // A corner, named in the direction of the ray, not of the road.
    Vector corner(const Segment& segment, Side side, Border border) const {
        if ((border == EXIT) == forwards_) {
            return ground(segment.vertex[(side == LEFT) == forwards_ ? END_LEFT : END_RIGHT]);
        }
        return ground(segment.vertex[(side == LEFT) == forwards_ ? START_LEFT : START_RIGHT]);
    }

    double ahead(Vector point) const { return dot(direction_, point - origin_); }
    double leftwards(Vector point) const { return cross(direction_, point - origin_); }

    bool passes_between(Vector left, Vector right) const {
        return leftwards(left) > 0.0 && leftwards(right) < 0.0;
    }

    // A ray that leaves a segment may miss the next one: tracks have gaps of up to 0.3 m at the
    // start line. There the corner that stands out stops the ray.
    bool comes_in(const Segment& segment) const {
        return passes_between(corner(segment, LEFT, ENTRY), corner(segment, RIGHT, ENTRY));
    }

    double end_at_entry(const Segment& segment) const {
        const Vector left = corner(segment, LEFT, ENTRY);
        return ahead(leftwards(left) > 0.0 ? corner(segment, RIGHT, ENTRY) : left);
    }

    // Whether the inner edge of a turn is in its way although it passes the corners at the exit.
    // It is if the ray comes nearest to the centre within the turn, and too near. `entry` and
    // `exit` are any points of the borders; a ray that begins here comes in at its origin.
    bool grazes(const Segment& segment, Vector entry, Vector exit) const {
        const Vector center = ground(segment.center);
        return dot(direction_, exit - center) > 0.0 && heads_inside(segment, entry);
    }

    bool heads_inside(const Segment& segment, Vector entry) const {
        const Vector center = ground(segment.center);
        return dot(direction_, entry - center) < 0.0 &&
               std::abs(leftwards(center)) < std::min(segment.radius_left, segment.radius_right);
    }

    // Distance [m] to the edge of the segment in which it ends; negative by rounding only.
    double end_in(const Segment& segment, Vector entry) const {
        if (segment.type == STRAIGHT) return end_in_straight(segment);
        const Vector center = ground(segment.center);
        const bool inside = heads_inside(segment, entry);
        const double radius = inside ? std::min(segment.radius_left, segment.radius_right)
                                     : std::max(segment.radius_left, segment.radius_right);
        const double aside = leftwards(center);
        const double half_chord = std::sqrt(std::max(radius * radius - aside * aside, 0.0));
        return ahead(center) + (inside ? -half_chord : half_chord);
    }

    // The ends of the edge lie on both sides of the ray, which hits it in proportion: never beyond
    // its ends, however short it is and however flat the ray.
    double end_in_straight(const Segment& segment) const {
        const Vector across = corner(segment, LEFT, EXIT) - corner(segment, RIGHT, EXIT);
        const Side side = dot(direction_, across) > 0.0 ? LEFT : RIGHT;
        const Vector begin = corner(segment, side, ENTRY), end = corner(segment, side, EXIT);
        const double before = leftwards(begin), after = leftwards(end);
        const double share = before == after ? 0.0 : before / (before - after);
        return ahead(begin) + std::clamp(share, 0.0, 1.0) * (ahead(end) - ahead(begin));
    }

    Vector origin_;
    Vector direction_;
    bool forwards_;
};

}  // namespace

double heading_error(const CarElement& car) {
    return std::remainder(road_heading(car.pub.track) - car.pub.local.pos.az, 2.0 * M_PI);
}

double distance_from_start(const CarElement& car) {
    const Segment& segment = *car.pub.track.segment;
    const double scale = segment.type == STRAIGHT ? 1.0 : segment.radius;
    return segment.from_start + car.pub.track.to_start * scale;
}

double distance_along(const CarElement& car, double length) {
    double distance = std::fmod(distance_from_start(car), length);
    if (distance < 0.0) distance += length;
    return distance < length ? distance : 0.0;
}

void range_finders(const CarElement& car, const double* angles, double* distances) {
    const TrackPosition& track = car.pub.track;
    if (std::abs(2.0 * track.to_middle) > track.segment->width) {
        std::fill_n(distances, RANGE_FINDERS, OFF_TRACK);
        return;
    }
    const Vector along = towards(road_heading(track));
    const Vector origin = place(track, {-along.y, along.x});
    const double yaw = car.pub.local.pos.az;
    for (int i = 0; i < RANGE_FINDERS; ++i) {
        const Vector direction = towards(yaw - angles[i]);
        distances[i] = Ray(origin, direction, dot(direction, along) >= 0.0).cast(*track.segment);
    }
}

void focused_range_finders(const CarElement& car, double direction, double* distances) {
    double angles[RANGE_FINDERS] = {}, all[RANGE_FINDERS];
    for (int i = 0; i < FOCUS_BEAMS; i++)
        angles[i] = direction + (i - FOCUS_BEAMS / 2) * M_PI / 180.0;
    range_finders(car, angles, all);
    std::copy_n(all, FOCUS_BEAMS, distances);
}

// ---- Opponents ---------------------------------------------------------------------------------

void opponents(const CarElement& car, CarElement* const* cars, int number, double* distances) {
    std::fill_n(distances, OPPONENT_SECTORS, SENSOR_RANGE);
    const Pose& own = car.pub.local.pos;
    for (int i = 0; i < number; ++i) {
        const CarElement& other = *cars[i];
        if (&other == &car || (other.pub.status & NOT_SIMULATED & ~IN_PIT) != 0) continue;
        const double x = double(other.pub.local.pos.x) - own.x;
        const double y = double(other.pub.local.pos.y) - own.y;
        const double distance = maths::hypot(x, y);
        const double clockwise = M_PI + std::remainder(own.az - maths::atan2(y, x), 2.0 * M_PI);
        if (!(distance < SENSOR_RANGE && clockwise >= 0.0)) continue;  // nor what is no number
        // Half a turn to either side is the same direction: straight behind is sector 0.
        double& nearest = distances[int(clockwise / SECTOR) % OPPONENT_SECTORS];
        nearest = std::min(nearest, distance);
    }
}

// ---- Rivals ------------------------------------------------------------------------------------

namespace {

// A car's velocity along the road and to its left, [m/s].
Vector road_velocity(const CarElement& car) {
    const Vector along = towards(road_heading(car.pub.track));
    const Vector velocity = {car.pub.global.vel.x, car.pub.global.vel.y};
    return {dot(velocity, along), cross(along, velocity)};
}

}  // namespace

void rivals(const CarElement& car, CarElement* const* cars, int number, double track_length,
            double* numbers) {
    std::fill_n(numbers, RIVALS, SENSOR_RANGE);
    std::fill_n(numbers + RIVALS, RIVAL_NUMBERS - RIVALS, 0.0);
    if (number < 2) return;
    const CarElement* nearest[RIVALS];
    int found = 0;
    for (int i = 0; i < number; i++) {
        const CarElement& other = *cars[i];
        if (&other == &car || (other.pub.status & NOT_SIMULATED & ~IN_PIT) != 0) continue;
        const double ahead =
            std::remainder(distance_from_start(other) - distance_from_start(car), track_length);
        int place = found;
        while (place > 0 && std::abs(ahead) < std::abs(numbers[place - 1])) place--;
        if (place == RIVALS || !(std::abs(ahead) < SENSOR_RANGE)) continue;
        for (int j = std::min(found, RIVALS - 1); j > place; j--) {
            numbers[j] = numbers[j - 1];
            nearest[j] = nearest[j - 1];
        }
        numbers[place] = ahead;
        nearest[place] = &other;
        found = std::min(found + 1, RIVALS);
    }
    const Vector own = road_velocity(car);
    for (int i = 0; i < found; i++) {
        const CarElement& other = *nearest[i];
        const Vector faster = road_velocity(other) - own;
        numbers[RIVALS + i] = double(other.pub.track.to_middle) - car.pub.track.to_middle;
        numbers[2 * RIVALS + i] = faster.x;
        numbers[3 * RIVALS + i] = faster.y;
        numbers[4 * RIVALS + i] = other.info.dimension.x;
        numbers[5 * RIVALS + i] = other.info.dimension.y;
    }
}

// ---- Noise -------------------------------------------------------------------------------------

// SplitMix64 (Steele, Lea and Flood 2014, doi 10.1145/2660193.2660195).
std::uint64_t Generator::next() {
    state_ += 0x9e3779b97f4a7c15;
    std::uint64_t mixed = state_;
    mixed = (mixed ^ (mixed >> 30)) * 0xbf58476d1ce4e5b9;
    mixed = (mixed ^ (mixed >> 27)) * 0x94d049bb133111eb;
    return mixed ^ (mixed >> 31);
}

// Box and Muller 1958 (doi 10.1214/aoms/1177706645), of whose two numbers one is kept.
double Generator::normal() {
    constexpr double UNIT = 0x1p-53;
    const double radius = std::sqrt(-2.0 * maths::log(double((next() >> 11) + 1) * UNIT));
    return radius * maths::sine_cosine(2.0 * M_PI * (double(next() >> 11) * UNIT)).cosine;
}

void add_noise(Generator& generator, double* range_finders, double* opponents) {
    for (int i = 0; i < RANGE_FINDERS; ++i) {
        const double factor = 1.0 + RANGE_FINDER_NOISE * generator.normal();
        if (range_finders[i] != OFF_TRACK) range_finders[i] *= factor;
    }
    for (int i = 0; i < OPPONENT_SECTORS; ++i) {
        opponents[i] *= 1.0 + OPPONENT_NOISE * generator.normal();
    }
}

}  // namespace torcs
