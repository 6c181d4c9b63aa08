#include "loop.h"

#include <csignal>
#include <cstdlib>

#include "client.h"
#include "driver.h"
#include "engine.h"
#include "flying_start.h"
#include "options.h"

namespace torcs::scr {
namespace {

constexpr int SETTLING = 0;       // of Situation::state, before a race begins
constexpr int WATCH_STEPS = 250;  // between two looks for the game's owner: half a second of race

Simulation simulation;  // the engine's own
bool restart_wanted, settling;
Leaving why = Leaving::FOR_GOOD;
volatile std::sig_atomic_t ended = 0;

void restart(Leaving reason) {
    restart_wanted = false;
    why = reason;
    clean_race_up();
    // Skip the menu before a start that no user asked for.
    set_text(ReInfo->params, ReInfo->race_name, "splash menu", "no");
    prepare_race();
    start_race();
    why = Leaving::FOR_GOOD;
}

void put_on_grid(CarElement* car, RaceManager* race) {
    simulation.config(car, race);
    const int cars = race->situation->cars_number;
    if (car == &race->cars[cars - 1])
        flying_start().put_down(simulation, cars, why == Leaving::UNNOTICED);
}

void step(Situation* situation, double duration, int telemetry) {
    static int steps = 0;
    if (++steps % WATCH_STEPS == 0) watch_owner();
    FlyingStart& start = flying_start();
    if (situation->state == SETTLING) {
        if (settling) start.come_to_rest(*situation);
        settling = false;
        if (!start.stands()) simulation.update(situation, duration, telemetry);
        return;
    }
    if (ending()) {
        situation->state = ENDED;
        return;
    }
    if (start.misses_grid()) return restart(Leaving::UNNOTICED);
    if (start.stands()) return start.drive_off(*situation);
    if (ReInfo->robots_time == situation->time)
        for (Driver& driver : drivers())
            if (driver.watch()) request_restart();
    if (restart_wanted) return restart(Leaving::TO_RESTART);
    mercy().before(*situation);
    simulation.update(situation, duration, telemetry);
    mercy().after(*situation);
    start.start_clocks(*situation);
}

}  // namespace

void enter_loop() {
    if (why != Leaving::UNNOTICED) flying_start().forget_refusal();
    if (ReInfo->simulation.update == step) return;
    settling = true;
    simulation = ReInfo->simulation;
    mercy().begin(simulation);
    ReInfo->simulation.config = put_on_grid;
    ReInfo->simulation.update = step;
}

void request_restart() { restart_wanted = true; }

void hear_owner() {
    if (std::getenv("SB3_TORCS_OWNER")) std::signal(SIGTERM, [](int) { ended = 1; });
}

bool ending() { return ended != 0; }

bool goes_on() { return !restart_wanted && !ending(); }

Leaving leaving() { return why; }

}  // namespace torcs::scr
