// Our hook in the race engine's loop, from which a race can begin anew or elsewhere.
//
// The engine calls its simulation through pointers that it exports; we replace them by ours. Ours
// for steps is called at every step, after the drivers, and passes the step on. Instead it can do
// what the game's own "Restart Race" does; the engine then continues as after any start.
#pragma once

namespace torcs::scr {

// Call it whenever a race is loaded, before its cars are put on the grid: the engine loads its
// simulation again for each race.
void enter_loop();

// At the next step.
void request_restart();

// From now on SIGTERM ends the race, as if all cars had finished. This is so only in a game that
// has an owner; a user's game ends as before.
void hear_owner();

// Whether that has come.
bool ending();

// Whether this race is still driven: no driver is called any more when it is about to end or to
// begin anew.
bool goes_on();

// Why drivers are shut down.
enum class Leaving {
    FOR_GOOD,
    TO_RESTART,
    UNNOTICED,  // the clients know nothing of this restart
};
Leaving leaving();

}  // namespace torcs::scr
