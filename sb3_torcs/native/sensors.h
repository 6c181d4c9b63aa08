// What a driver senses, as the SCR server measures it (Loiacono, Cardamone and Lanzi 2013,
// arXiv:1304.1672, table 1): a car's state and the track's geometry in, metres and radians out.
//
// A car stands where the simulation says that it is against the road (`CarPublic::track`) and
// heads for its yaw; heights are left out. All functions only read the game's structures.
#pragma once

#include <cstdint>

#include "layout.h"

namespace torcs {

constexpr double SENSOR_RANGE = 200.0;  // [m] of range finders and of opponent sensors
constexpr int RANGE_FINDERS = 19;
constexpr int FOCUS_BEAMS = 5;
constexpr int OPPONENT_SECTORS = 36;
constexpr double OFF_TRACK = -1.0;  // what range finders read beside the road

// Direction of the road at the car minus its yaw, [rad] in [-pi, pi]: positive when the car points
// to the right of the road.
double heading_error(const CarElement& car);

// Along the middle of the road from the start line, [m]; by rounding, a little less than 0 or more
// than the track's length can come out at the line.
double distance_from_start(const CarElement& car);

// The same in [0, length).
double distance_along(const CarElement& car, double length);

// Distances [m] to the road's edge in RANGE_FINDERS directions: SENSOR_RANGE where nothing is
// nearer, all OFF_TRACK when the car's mass centre is beside the road. The edges are those of the
// road itself: kerbs and verges lie beyond. `angles` [rad] are against the car's axis, left
// negative, and may point backwards.
void range_finders(const CarElement& car, const double* angles, double* distances);

// The SCR server's `focus`: FOCUS_BEAMS distances [m], 1 degree from each other, around a
// direction [rad] against the car's axis, left negative.
void focused_range_finders(const CarElement& car, double direction, double* distances);

// Distances [m], centre to centre, to the nearest car in each of OPPONENT_SECTORS sectors of 10
// degrees: clockwise, the first one begins straight behind and ends over the left shoulder.
// SENSOR_RANGE where nobody is nearer. Cars that are out of the race are not seen; one that stands
// in its pit is.
void opponents(const CarElement& car, CarElement* const* cars, int number, double* distances);

// The cars that are nearest along the road, within SENSOR_RANGE, the nearest first: in a block for
// each, (1) how far ahead they are along the road [m], SENSOR_RANGE where there is none, (2) how
// far to the left [m], (3) and (4) how much faster that way [m/s], (5) their length and (6) width
// [m].
constexpr int RIVALS = 4, RIVAL_NUMBERS = 6 * RIVALS;
void rivals(const CarElement& car, CarElement* const* cars, int number, double track_length,
            double* numbers);

// A seeded stream of random numbers, the same on every machine (but for the last digit of the
// mathematical library's log and cos). Its state is one number: a copy goes on alike.
class Generator {
public:
    explicit Generator(std::uint64_t seed) : state_(seed) {}

    double normal();  // mean 0, standard deviation 1

private:
    std::uint64_t next();

    std::uint64_t state_;
};

// What the SCR server's `-noisy` does: each reading times N(1, 0.1), of opponents N(1, 0.02). It is
// not clipped: readings can exceed SENSOR_RANGE. OFF_TRACK stays. Always draws the same number of
// random numbers, so that what one sensor reads does not shift the noise of the others.
void add_noise(Generator& generator, double* range_finders, double* opponents);

}  // namespace torcs
