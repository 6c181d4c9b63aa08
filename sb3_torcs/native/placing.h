// Where a race begins that does not begin on the grid: the whole field is moved along the road, so
// that one car is at a place, and given a speed. For races in this process and for the game's own.
#pragma once

#include <vector>

#include "layout.h"

namespace torcs {

struct Start {
    double distance;        // [m] along the road from the start line
    double track_position;  // [-] of the agent: 1 is the left edge, -1 the right
    double heading_error;   // [rad] of the agent: positive if it points to the right
    double speed;           // [m/s] of all cars
};

// The cars of a race, and what it takes to move them.
struct Field {
    CarElement* cars;
    int number;
    int agent;  // the car that a start is meant for
    RaceManager* manager;
    const Simulation* simulation;
    SimulatedCar* const* simulated;  // the simulation's own cars
    void (*to_global)(TrackPosition*, float* x, float* y, int against);
    float (*road_height)(TrackPosition*);
};

// Whether it is on the road or near it, at a speed that cars have.
bool is_valid(const Start& start, double track_length);

// Puts a car down, standing still; `height` [m] is that of its mass centre over the road.
void place(const Field& field, CarElement& car, float distance, float to_right, float heading_error,
           float height);

float height_over_road(const Field& field, const CarElement& car);  // [m] of the mass centre

// All stand on the brake for some steps, in neutral or in the gear that was put in before.
void settle(const Field& field, Situation& situation, int steps, bool in_gear);

// Puts down cars that are on the grid, each at the height at which it stands, in the gear for the
// speed. Returns where each is along the road [m], not wrapped: it can be before the start line, or
// a lap further. Tell drivers of the race after this, not before.
std::vector<double> put_down(const Field& field, const Start& start,
                             const std::vector<float>& rest_heights);

// Puts one car down among others that drive, rolling in the gear for its speed; its springs come to
// rest while it drives.
void put_down_rolling(const Field& field, CarElement& car, const Start& start, float rest_height);

// Lets cars that were put down come to rest.
void come_to_rest(const Field& field, Situation& situation);

// The first car that stands in a wall or in another car; none if all can drive off.
const CarElement* stuck_car(const Field& field);

void give_speed(const Field& field, CarElement& car, double speed);

// Counts how often a car that was put down at a distance has crossed the line, from the agent's
// first lap on. Returns how often it has to cross it before that counts. Where the agent starts on
// the line itself, its lap has begun.
int count_crossings(CarElement& car, double distance, double track_length, bool lap_has_begun);

}  // namespace torcs
