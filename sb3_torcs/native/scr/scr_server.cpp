// The driver module `scr_server`: ten cars whose drivers are clients of the SCR protocol.
#include <dlfcn.h>

#include <cstring>
#include <string>

#include "driver.h"
#include "loop.h"

namespace torcs::scr {
namespace {

Driver& driver(int index) { return drivers()[static_cast<std::size_t>(index)]; }

// No set-up of our own: the car is as its maker left it.
void new_track(int index, TrackData* track, void*, void** setup, Situation*) {
    *setup = nullptr;
    enter_loop();
    driver(index).new_track(index, track);
}

void new_race(int index, CarElement* car, Situation* situation) {
    driver(index).new_race(car, situation);
}

void end_race(int, CarElement*, Situation*) {}

void drive(int index, CarElement*, Situation*) {
    if (driver(index).drive()) request_restart();
}

int command_pit(int, CarElement*, Situation*) { return 0; }

void shut_down(int index) { driver(index).leave(); }

int fill_robot(int index, void* robot) {
    *static_cast<Robot*>(robot) = {new_track,   new_race,  end_race, drive,
                                   command_pit, shut_down, index};
    return 0;
}

// The game unloads its modules between two races; the clients' sockets must stay, and so must the
// function that a restart returns to.
void stay_loaded() {
    Dl_info info{};
    if (dladdr(reinterpret_cast<void*>(&stay_loaded), &info))
        dlopen(info.dli_fname, RTLD_NOW | RTLD_NOLOAD | RTLD_NODELETE);
}

}  // namespace
}  // namespace torcs::scr

// Fills ten places; the game frees the texts.
extern "C" __attribute__((visibility("default"))) int scr_server(torcs::ModuleInfo* modules) {
    torcs::scr::stay_loaded();
    torcs::scr::hear_owner();
    for (int i = 0; i < torcs::MODULE_INTERFACES; i++) {
        const std::string name = "scr_server " + std::to_string(i);
        modules[i] = {strdup(name.c_str()),
                      strdup("client of the SCR protocol"),
                      torcs::scr::fill_robot,
                      0,
                      i,
                      0,
                      0};
    }
    return 0;
}
