// How a race looks at one moment: what the engine hands out and the game's window shows.
//
// The records travel between two programs of one machine that are built together, as they lie in
// memory. They are the game's own, without addresses: those would mean nothing to the other side.
#pragma once

#include "layout.h"

namespace torcs {

// First the scene, then as many cars, in the order of the race.
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
