// The road as the game's loader has laid it, to be held to what was read of its file.
#pragma once

#include <array>
#include <vector>

#include "layout.h"

namespace torcs {

// Of one segment: its length [m], curvature [1/m], the widths of the road, of the ground to its
// left and to its right, each at its beginning and at its end [m], friction and rolling resistance
// of the road, and the friction of the left and the right wall.
constexpr int ROAD_COLUMNS = 12;
using RoadSegment = std::array<double, ROAD_COLUMNS>;

// From the start line on. The track has passed `check_track`.
std::vector<RoadSegment> road_of(const TrackData& track);

}  // namespace torcs
