// The texts of the SCR protocol (Loiacono, Cardamone and Lanzi 2013, arXiv:1304.1672): functions
// between texts and what they mean. Nothing here uses sockets or the game.
//
// Everything is SI; the protocol's km/h, degrees and revolutions stay inside messages.cpp.
#pragma once

#include <array>
#include <cstddef>
#include <optional>
#include <string>
#include <string_view>

#include "../placing.h"
#include "../sensors.h"

namespace torcs::scr {

constexpr int STATE_NUMBERS = 80;
constexpr std::size_t LONGEST_STATE = 4096;    // [bytes] 80 numbers of 25 characters, and 20 tags
constexpr std::size_t LONGEST_MESSAGE = 4096;  // [bytes] that a client may send

constexpr std::string_view IDENTIFIED = "***identified***";
constexpr std::string_view SHUTDOWN = "***shutdown***";
constexpr std::string_view RESTART = "***restart***";

// What a driver senses, in the order of the protocol.
struct State {
    double heading_error;       // [rad] positive if the car points to the right of the road
    double lap_time;            // [s] negative during the countdown
    double damage;              // [points]
    double distance;            // [m] from the start line
    double distance_raced;      // [m]
    double fuel;                // [l]
    double gear;                // -1 reverse, 0 neutral
    double last_lap_time;       // [s]
    double opponents[36];       // [m]
    double position;            // in the race, from 1
    double engine_speed;        // [rad/s]
    double velocity[3];         // [m/s] along, to the left of, and above the car
    double range_finders[19];   // [m]
    double track_position;      // [-] 1 is the left edge, -1 the right
    double wheel_speeds[4];     // [rad/s]
    double height;              // [m]
    double focus[FOCUS_BEAMS];  // [m]
    double yaw_rate;            // [rad/s] left positive (an extension)
};
static_assert(sizeof(State) == STATE_NUMBERS * sizeof(double));

// What a client wants. A tag that it leaves out has the default given here. All numbers are finite
// and within their ranges.
struct Action {
    double throttle = 0.0;  // [0, 1]
    double brake = 0.0;     // [0, 1]
    int gear = 1;           // [-1, 8]
    double steering = 0.0;  // [-1, 1] left positive
    double clutch = 0.0;    // [0, 1] 1 is pressed
    bool restart = false;
    std::optional<double> focus = 0.0;  // [rad] left negative; none outside of a quarter turn
    // Of the state that it answers, if the client repeats it (an extension): [s].
    std::optional<double> lap_time{};
};

// How a client introduces itself.
struct Init {
    std::array<double, 19> angles;  // [rad] of range finders, left negative
    std::optional<Start> start{};   // not on the grid (an extension)
    bool exact = false;             // states shall have all digits, and all extensions
    std::string name{};             // of the driver (an extension): plain characters only
};

// Writes the state with its closing zero; returns the length with it. Six significant digits, as
// C++ streams write them, and the tags of the protocol; or exactly: as many digits as it takes to
// read the very numbers, and all tags.
std::size_t format_state(const State& state, bool exact, char (&text)[LONGEST_STATE]);

// What a client reads where a number is written.
double as_written(double number, bool exact);

// Every text is valid. Tags can have any order; a missing value or one that is no number becomes
// the default, one out of range is clipped, and an unknown tag is ignored.
Action parse_action(std::string_view text);
Init parse_init(std::string_view text);

// As in the original server, only the first three characters count.
inline bool is_init(std::string_view text) { return text.substr(0, 3) == "SCR"; }

}  // namespace torcs::scr
