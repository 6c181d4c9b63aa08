// A place of ours in the race engine's loop, from which a race can begin anew or elsewhere.
//
// The engine calls its simulation through pointers that it exports, in whose place ours stand. The
// one for steps is called at every step after the drivers were, and passes the step on. Instead of
// that it can do what the game's own "Restart Race" does; the engine then goes on as after any
// start.
#pragma once

namespace torcs::scr {

// To be called whenever a race is loaded, before its cars are put on the grid: the engine gets its
// simulation anew for each.
void enter_loop();

// At the next step.
void request_restart();

// From now on SIGTERM ends the race, as if all had come to its end. Only of a game that has an
// owner: that of a user ends as it always did.
void hear_owner();

// Whether that has come.
bool ending();

// Whether this race is still driven: nobody is asked any more once it is to end or to begin anew.
bool goes_on();

// Why drivers are shut down.
enum class Leaving {
    FOR_GOOD,
    TO_RESTART,
    UNNOTICED,  // the clients know nothing of this restart
};
Leaving leaving();

}  // namespace torcs::scr
