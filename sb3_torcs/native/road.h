// The road as the game's loader built it, for comparison with what Python read from its file.
#pragma once

#include <array>
#include <map>
#include <vector>

#include "layout.h"

namespace torcs {

// Of one segment: its length [m], curvature [1/m], the widths of the road, of the ground to its
// left and to its right, each at its beginning and at its end [m], friction and rolling resistance
// of the road, the friction of the left and the right wall, where it ends [m], as the game adds
// it up from the start line, the height of its axis at its beginning and at its end [m], and by how
// much its left edge lies higher than its right one there [m].
constexpr int ROAD_COLUMNS = 17;
using RoadSegment = std::array<double, ROAD_COLUMNS>;

// Segments begin at the start line. The track has passed `check_track`. The friction of the road is
// that of its file, which a race with another grip has changed in the track.
std::vector<RoadSegment> road_of(const TrackData& track, const std::map<Surface*, float>& friction);

}  // namespace torcs
