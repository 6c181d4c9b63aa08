// From the start of the program into the race and out again, past all menus.

#include <chrono>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>
#include <utility>

#include "window.h"

// Of the game's libraries and of plib.
void ssgInit();
void GfInitClient();
void ReInit();
void ReInitResults();
void ReStateApply(void* state);
const char* ReGetCurrentRaceName();
extern "C" void glutDisplayFunc(void (*display)());
extern "C" void glDisable(unsigned capability);
void* GfParmReadFile(const char* file, int mode);
const char* GfParmGetStr(void* params, const char* section, const char* key, const char* fallback);
int GfParmSetStr(void* params, const char* section, const char* key, const char* value);

namespace window {
namespace {

constexpr int READ_STANDARD = 1;
constexpr std::intptr_t STOP_RACE = 7;  // the state of the race in which Escape puts it
constexpr unsigned LIGHTING = 0x0B50, CULL_FACE = 0x0B44, ALPHA_TEST = 0x0BC0;
constexpr int AT_ONCE_NEXT_STEP = 0x1 | 0x100;  // what a state of the race returns to go on

std::string base_name(const std::string& file) {
    const auto name = file.substr(file.rfind('/') + 1);
    return name.substr(0, name.rfind('.'));
}

int (*original_init_view)(int, int, int, int, int, void*) = nullptr;

// The game paints the map of the track here. Lighting or culling that is still on would make the
// map invisible.
int init_view(int x, int y, int width, int height, int flag, void* screen) {
    for (const unsigned capability : {LIGHTING, CULL_FACE, ALPHA_TEST}) glDisable(capability);
    return original_init_view(x, y, width, height, flag, screen);
}

// As the game's text mode does it, but with graphics. It has to wait for the window, whose size
// the game learns in its main loop.
void start_race() {
    const char* file = std::getenv("SB3_TORCS_RACE");
    if (!file) give_up("SB3_TORCS_RACE does not name the file of a race");
    ReInit();
    if (!ReInfo || !ReInfo->graphics.refresh) give_up("the game's graphics module does not load");
    ReInfo->params = GfParmReadFile(file, READ_STANDARD);
    if (!ReInfo->params) give_up(std::string("cannot read the race ") + file);
    ReInfo->file_name = strdup(base_name(file).c_str());
    ReInfo->name = GfParmGetStr(ReInfo->params, "Header", "name", "");
    ReInitResults();
    // Skip the question whether to start, and the screen that shows only results.
    const char* race = ReGetCurrentRaceName();
    if (!race) give_up(std::string("no race in ") + file);
    GfParmSetStr(ReInfo->params, race, "splash menu", "no");
    GfParmSetStr(ReInfo->params, race, "display mode", "normal");
    original_init_view = std::exchange(ReInfo->graphics.init_view, init_view);
    if (recording()) send_frames();
    // To close the window is Escape, too. Not every GLUT tells of it.
    if (auto* const on_close = original<void(void (*)())>("glutCloseFunc"))
        on_close([] { ReStateApply(reinterpret_cast<void*>(STOP_RACE)); });
    ReStateApply(reinterpret_cast<void*>(torcs::LOAD_EVENT));
}

}  // namespace

[[noreturn]] void give_up(const std::string& message) {
    std::printf("%s\n", message.c_str());
    std::fflush(stdout);
    _exit(1);
}

torcs::Owner& owner() {
    static torcs::Owner the_owner;
    return the_owner;
}

}  // namespace window

// ---- Instead of the game's own ------------------------------------------------------------------

// The program calls this one after it has opened its window.
INSTEAD void TorcsEntry() {
    std::signal(SIGPIPE, SIG_IGN);
    std::setvbuf(stdout, nullptr, _IOLBF, 0);  // so that a crash loses no output
    window::owner();  // made before what is called at the exit, and so there for it
    // Without its display the program ends at once.
    std::atexit([] { window::owner().await_end(std::chrono::milliseconds(500)); });
    ssgInit();
    GfInitClient();
    glutDisplayFunc(window::start_race);
}

// Called again and again while the race is on.
INSTEAD int ReUpdate() {
    static auto* const real = window::original<int()>("_Z8ReUpdatev");
    window::owner().check();
    if (window::acting()) {
        window::take_appearance();
    } else if (window::recording()) {
        window::advance_clock();
    }
    return real();
}

// Escape ends the race; its results are kept as if it had come to its end.
INSTEAD int ReRaceStop() { return window::AT_ONCE_NEXT_STEP; }

INSTEAD int ReRaceEnd() {
    static auto* const real = window::original<int()>("_Z9ReRaceEndv");
    return window::run_out() ? ReUpdate() : real();
}

INSTEAD int ReDisplayResults() { return window::AT_ONCE_NEXT_STEP; }

// Here the game would return to its menus. Its libraries are not closed, because that can crash.
INSTEAD int ReRacemanMenu() {
    std::fflush(nullptr);
    _exit(0);
}
