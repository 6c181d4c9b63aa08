// Whether the structures of the installed game are those of layout.h. Reads only mapped memory.
#pragma once

#include <string>

#include "game.h"
#include "layout.h"

namespace torcs {

// Throws LayoutMismatch, or TrackFileError if the track's file is the cause.
void check_track(const TrackData* track, const Params& file, const std::string& path);

// After the cars have stood for a while: the simulation's own records equal the shared ones.
void check_simulation(const SimulatedCar* simulated, const CarElement* cars, int number);

}  // namespace torcs
