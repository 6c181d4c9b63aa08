// The game's clock. It shows real time, except for a video: there it goes on by one frame at a
// time, however long the drawing takes.

#include <cmath>
#include <cstdlib>

#include "window.h"

namespace window {
namespace {

constexpr double FIRST_FRAME = -1.0;  // [s] before the start: the cars stand on the grid
constexpr double RUN_OUT = 1.0;       // [s] after the end: the last crossing of the line is seen

double now = 0;               // [s] what the game's clock shows
double origin = 0;            // [s] simulated time of the first frame
long frame = 0;               // number of the last one; frame -1 is drawn, but not sent
double last_time = HUGE_VAL;  // [s] simulated, of the last frame
double over_since = 0;        // [s] simulated time of the race's end

double frame_time() {
    static const char* text = std::getenv("SB3_TORCS_FRAME_TIME");
    static const double seconds = text ? std::strtod(text, nullptr) : 0;
    return seconds;
}

// The time of a frame is computed from its number, so that rounding errors do not add up. A flying
// camera finds its place only with its second picture.
double time_of_next_frame(double time) {
    if (time < last_time) {  // a race that begins, or begins again
        origin = std::fmax(FIRST_FRAME, time);
        frame = -2;
    }
    return origin + static_cast<double>(++frame) * frame_time();
}

}  // namespace

// The game does steps while its clock is more than one of them ahead, so half a step more than
// the number wanted makes it do exactly that number.
void advance_clock() {
    const double time = ReInfo->situation->time;
    double steps = 0;
    if (frame_time() > 0) {
        steps = std::fmax(0, std::round((time_of_next_frame(time) - time) / torcs::PHYSICS_STEP));
        last_time = time;
    }
    now = ReInfo->time + (steps + 0.5) * torcs::PHYSICS_STEP;
}

bool rolling() { return frame >= 0; }

bool run_out() {
    if (frame_time() <= 0) return false;
    if (over_since == 0) over_since = ReInfo->situation->time;
    return ReInfo->situation->time < over_since + RUN_OUT - torcs::PHYSICS_STEP / 2;
}

}  // namespace window

INSTEAD double GfTimeClock() {
    static auto* const real = window::original<double()>("_Z11GfTimeClockv");
    return window::recording() ? window::now : real();
}
