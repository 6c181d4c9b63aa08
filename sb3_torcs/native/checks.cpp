#include "checks.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>

#include "errors.h"

namespace torcs {

namespace {

constexpr float PI = 3.14159265f;
constexpr float HALF_CIRCLE = PI + 1e-3f;  // [rad] and what rounding adds

// Reads memory that may not be mapped: if it is not, writing it into a pipe returns an error.
class Probe {
public:
    Probe() {
        if (pipe2(ends_, O_CLOEXEC) != 0)
            throw Error("BackendUnavailable",
                        std::string("a pipe cannot be had: ") + std::strerror(errno) + MORE_FILES);
    }
    ~Probe() {
        close(ends_[0]);
        close(ends_[1]);
    }
    Probe(const Probe&) = delete;
    Probe& operator=(const Probe&) = delete;

    template <typename T>
    bool read(const void* address, T& value) const {
        static_assert(sizeof(T) <= 4096);
        if (write(ends_[1], address, sizeof(T)) != static_cast<ssize_t>(sizeof(T))) return false;
        return ::read(ends_[0], static_cast<void*>(&value), sizeof(T)) ==
               static_cast<ssize_t>(sizeof(T));
    }

    bool equals(const char* address, const std::string& text) const {
        for (std::size_t i = 0; i <= text.size(); i++) {
            char character;
            if (!read(address + i, character) || character != text.c_str()[i]) return false;
        }
        return true;
    }

private:
    int ends_[2];
};

[[noreturn]] void disagree(const std::string& what, const std::string& expected,
                           const std::string& found) {
    throw Error("LayoutMismatch",
                "the installed game does not lay out its data as TORCS 1.3.7 does: " + what +
                    " is " + found + ", expected " + expected +
                    "; install that version with: sb3-torcs install-torcs");
}

void expect(const std::string& what, float expected, float found) {
    if (!(std::fabs(found - expected) <= 1e-4f * std::max(1.0f, std::fabs(expected))))
        disagree(what, std::to_string(expected), std::to_string(found));
}

void expect(const std::string& what, int expected, int found) {
    if (found != expected) disagree(what, std::to_string(expected), std::to_string(found));
}

[[noreturn]] void refuse(const CarElement& car, const std::string& reason) {
    throw Error("CarFileError", std::string(car.info.car) + " " + reason +
                                    ": its file describes no car that can drive");
}

void check_plausible(const CarElement& car, const SimulatedCar& simulated) {
    for (const SimulatedWheel& wheel : simulated.wheel)
        if (!(wheel.radius > 0.05f && wheel.radius < 2.0f))
            refuse(car, "has a wheel of radius " + std::to_string(wheel.radius) + " m");
    if (!(car.priv.fuel > 0.0f)) refuse(car, "has no fuel");
    if (!(car.priv.red_line > 10.0f)) refuse(car, "has no rev limiter");
    if (car.priv.gears_number < 2 || car.priv.gears_number >= MAX_GEARS)
        refuse(car, "has " + std::to_string(car.priv.gears_number - 1) + " gears");
    if (!(car.priv.gear_ratio[car.priv.gear_offset + 1] > 0.0f))
        refuse(car, "has a first gear of ratio 0");
}

bool is_finite(const Segment& segment) {
    return std::all_of(std::begin(segment.vertex), std::end(segment.vertex), [](const Point& at) {
        return std::isfinite(at.x) && std::isfinite(at.y) && std::isfinite(at.z);
    });
}

// The road and the ground beside it, as far as the barriers.
void check_strips(const Probe& probe, const Segment& road, const std::string& path) {
    constexpr int STRIPS = 2;  // a border and a side
    Surface surface;
    if (!probe.read(road.surface, surface)) disagree("a road's surface", "a record", "not there");
    for (const Side side : {RIGHT, LEFT}) {
        Barrier barrier;
        if (!probe.read(road.barrier[side], barrier) || !probe.read(barrier.surface, surface))
            disagree("a barrier", "a record of 32 bytes", "none of that layout");
        Segment strip = road;
        for (int i = 0; i <= STRIPS; i++) {
            if (!is_finite(strip))
                throw Error("TrackFileError", path + " has a segment with a corner nowhere: a " +
                                                  "height, a width or an angle is absurd");
            if (!strip.side[side]) break;
            if (i == STRIPS || !probe.read(strip.side[side], strip))
                disagree("the ground beside a segment", "two strips at most", "more");
        }
    }
}

void check_pits(const Pits& pits, const std::string& path) {
    constexpr int MOST_PITS = 1000;
    if (pits.type == 1 && (pits.number < 1 || pits.number > MOST_PITS))
        throw Error("TrackFileError", path + " has room for " + std::to_string(pits.number) +
                                          " pits; expected 1 to " + std::to_string(MOST_PITS) +
                                          ", see start, end and length in its section Pits");
}

}  // namespace

void check_track(const TrackData* track, const Params& file, const std::string& path) {
    const Probe probe;
    TrackData data;
    if (!probe.read(track, data)) disagree("the track", "a record of 248 bytes", "not there");
    const std::string name = file.text("Header", "name", "no name");
    if (!probe.equals(data.name, name)) disagree("the track's name", name, "something else");
    expect("the track's width", file.number("Main Track", "width", 15.0f), data.width);
    expect("the track's version", static_cast<int>(file.number("Header", "version", 0.0f)),
           data.version);
    if (data.segments_number < 1 || !data.last)
        throw Error("TrackFileError", path + " has no segments the game can read");
    const Segment* address = data.last;
    float length = 0.0f;
    for (int i = 0; i < data.segments_number; i++) {
        Segment segment, next;
        if (!probe.read(address, segment) || !probe.read(segment.next, next) ||
            next.prev != address || segment.type < RIGHT_TURN || segment.type > STRAIGHT)
            disagree("segment " + std::to_string(i) + " of the track", "one of a ring",
                     "none of that layout");
        address = segment.next;
        length += next.length;
        if (!(std::isfinite(next.length) && next.length > 0.0f))
            throw Error("TrackFileError",
                        path + " has a segment that is " + std::to_string(next.length) + " m long");
        check_strips(probe, next, path);
        // Range finders would see past its other end.
        if (next.type != STRAIGHT && !(next.arc <= HALF_CIRCLE))
            throw Error("TrackFileError", path + " has a segment that turns by " +
                                              std::to_string(std::lround(next.arc * 180.0f / PI)) +
                                              " degrees, and 180 is the most; cut it into two");
    }
    if (address != data.last)
        disagree("the number of segments", "that of the ring",
                 std::to_string(data.segments_number));
    if (!(std::fabs(length - data.length) <= 1e-3f * length))
        disagree("the track's length", std::to_string(length), std::to_string(data.length));
    check_pits(data.pits, path);
}

void check_simulation(const SimulatedCar* simulated, const CarElement* cars, int number) {
    const Probe probe;
    for (int i = 0; i < number; i++) {
        const CarElement& car = cars[i];
        SimulatedCar own;
        if (!probe.read(simulated + i, own) || own.element != &car || own.control != &car.control)
            disagree("the simulation's car", "a record of 3472 bytes", "none of that layout");
        if (!std::isfinite(car.pub.global.pos.x) || !std::isfinite(car.pub.global.vel.z) ||
            !std::isfinite(car.priv.engine_speed) || !std::isfinite(car.priv.wheel[0].spin) ||
            !std::isfinite(car.priv.wheel[REAR_LEFT].spin))
            refuse(car, "does not come to rest on its wheels");
        expect("its x", own.global.pos.x, car.pub.global.pos.x);
        expect("its yaw", own.local.pos.az, car.pub.local.pos.az);
        expect("its motor speed", own.engine_speed, car.priv.engine_speed);
        expect("its fuel", own.fuel, car.priv.fuel);
        expect("its mass by its inverse mass", 1.0f, own.mass * own.inverse_mass);
        expect("its gear", own.gear, car.priv.gear);
        expect("its damage", own.damage, car.priv.damage);
        for (int wheel = FRONT_RIGHT; wheel <= REAR_LEFT; wheel++) {
            expect("a wheel's speed", own.wheel[wheel].spin, car.priv.wheel[wheel].spin);
        }
        check_plausible(car, own);
    }
}

}  // namespace torcs
