// Whether the installed game lays things out as layout.h says; reads nothing that is not there.
#pragma once

#include <string>

#include "game.h"
#include "layout.h"

namespace torcs {

// Throws LayoutMismatch, or TrackFileError if the file is what is wrong.
void check_track(const TrackData* track, const Params& file, const std::string& path);

// After the cars have stood for a while: the simulation's own records agree with the shared ones.
void check_simulation(const SimulatedCar* simulated, const CarElement* cars, int number);

}  // namespace torcs
