// How a race looks at one moment: what the engine hands out and the game's window shows.
//
// Two programs on one machine exchange the records as they lie in memory; they are built together.
// The records are the game's own, without addresses, which would mean nothing to the other program.
#pragma once

#include "layout.h"

namespace torcs {

// The scene comes first, then the cars it counts, in the order of the race.
struct SceneAppearance {
    double time;  // [s] since the start
    std::int32_t cars_number;
    std::int32_t car_size;  // [bytes] of the record of each
};

struct CarAppearance {
    std::int32_t index;    // in the starting list
    std::int32_t segment;  // id of the one that it is on
    CarPublic pub;
    CarRace race;
    CarPrivate priv;
    Control control;
};

}  // namespace torcs
