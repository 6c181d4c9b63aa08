// What the parts of this library share. It is loaded before the game's own libraries; functions
// marked `INSTEAD` replace those of the same name there.
#pragma once

#include <dlfcn.h>

#include <string>

#include "../layout.h"
#include "../owner.h"

#define INSTEAD __attribute__((visibility("default")))

// The game's race, null before it is set up.
extern torcs::RaceManager* ReInfo;

namespace window {

// The function that the game would have called without this library.
template <typename Function>
Function* original(const char* symbol) {
    return reinterpret_cast<Function*>(dlsym(RTLD_NEXT, symbol));
}

torcs::Owner& owner();

// End the game, with a reason for its owner to read.
[[noreturn]] void give_up(const std::string& message);

// ---- clock.cpp: how fast the game runs ----------------------------------------------------------

// Advance the clock by exactly the time between two frames.
void advance_clock();

// Whether the picture that is drawn now belongs to the video.
bool rolling();

// Whether the video goes on although the race is over.
bool run_out();

// ---- frames.cpp: what comes out -----------------------------------------------------------------

// Whether frames are sent to another process, not shown.
bool recording();

// Send a frame after every picture of the race that is drawn.
void send_frames();

// ---- puppet.cpp: a race that goes on elsewhere --------------------------------------------------

// Whether another process says where the cars are, and the game does not move them.
bool acting();

// Wait for a moment of that race, and put the cars where they are in this moment.
void take_appearance();

}  // namespace window
