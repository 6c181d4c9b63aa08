// Pictures of a race that another process drives: the cars are put where they are in that race, and
// the game itself does not move them.
//
// A picture depends on its moment only, not on moments that were drawn before; see also the
// settings in rendering/game_camera.py.

#include <poll.h>

#include <algorithm>
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <string>
#include <typeinfo>
#include <vector>

#include "../appearance.h"
#include "window.h"

namespace window {
namespace {

using namespace torcs;

constexpr int LOOK_AROUND = 500;  // [ms] between two looks after the owner

// The parts of the game's graphics that remember the previous picture: some of the cameras, and the
// needles of a car's instruments.
struct Camera {
    const std::type_info* const* methods;  // behind them: what kind of camera it is
    Unused<36> a_;
    float speed[3];  // [m/s]
    float place[3];  // [m]
    Unused<68> b_;
};

struct CameraBehind {
    Camera camera;
    float heading;  // [rad] in the picture before
};

struct FlyingCamera {
    Camera camera;
    int car;          // that it flew with
    float time_left;  // [s] until it changes its mind
    float climb;      // [m]
    float pull, damping;
    float offset[3];  // [m] from the car, where it wants to be
    double time;      // [s] of the picture before
};

struct DirectedCamera {
    Camera camera;
    Unused<32> a_;
    double last_event, last_cut;  // [s]
    Unused<4> b_;
    int car;  // by its place in the race; -1 for the one that is looked at
};

struct Screen {
    Unused<8> a_;
    CarElement* car;  // that is looked at
    Unused<176> b_;
    Camera* camera;
};

struct Instrument {
    Unused<32> a_;
    float value, range;        // at the lower end of the scale, and from there to the upper one
    float angle, angle_range;  // [degrees] of the needle there
    const float* shown;
    float needle;  // [degrees] in the picture before
    Unused<12> b_;
};

struct DrawnCar {
    Unused<552> a_;
    Instrument instrument[2];
    Unused<32> b_;
};

static_assert(sizeof(Camera) == 136 && offsetof(Camera, place) == 56);
static_assert(offsetof(CameraBehind, heading) == 136 && offsetof(Screen, camera) == 192);
static_assert(offsetof(FlyingCamera, offset) == 156 && offsetof(FlyingCamera, time) == 168);
static_assert(offsetof(DirectedCamera, last_event) == 168 && offsetof(DirectedCamera, car) == 188);
static_assert(offsetof(Instrument, needle) == 56 && sizeof(Instrument) == 72);
static_assert(sizeof(DrawnCar) == 728);

// In each picture the camera turns by a share of the angle that is left. At the game's usual 60
// pictures a second, it lags in a steady turn by the angle that the car turns in this time.
constexpr float TURN_PER_PICTURE = 0.1f;
constexpr float CAMERA_LAG = 0.15f;     // [s]
constexpr float MAX_CAMERA_LAG = 0.5f;  // [rad] when the car spins

// The helicopter is put where it would come to rest. It moves only if time has passed.
constexpr float ABOVE_CAR[3] = {-15, -15, 30};  // [m]
constexpr double JUST_BEFORE = 1.0 / 256;       // [s] never a whole number of physics steps
constexpr float LONG = 10;                      // [s]

int appearances_descriptor() {
    static const char* text = std::getenv("SB3_TORCS_APPEARANCES");
    static const int number = text ? std::atoi(text) : -1;
    return number;
}

template <typename Record>
Record receive() {
    Record record;
    char* rest = reinterpret_cast<char*>(&record);
    std::size_t size = sizeof record;
    while (size > 0) {
        const ssize_t got = read(appearances_descriptor(), rest, size);
        if (got < 0 && errno == EINTR) continue;
        if (got <= 0) owner().lost_contact();
        rest += got;
        size -= static_cast<std::size_t>(got);
    }
    return record;
}

Segment* segment(int id) {
    static const std::vector<Segment*> segments = [] {
        std::vector<Segment*> all(static_cast<std::size_t>(ReInfo->track->segments_number));
        Segment* next = ReInfo->track->last;
        for (std::size_t i = 0; i < all.size(); i++, next = next->next)
            all.at(static_cast<std::size_t>(next->id)) = next;
        return all;
    }();
    return segments.at(static_cast<std::size_t>(id));
}

// Addresses, and what names the car here, are not overwritten.
void put(CarElement& car, const CarAppearance& looks) {
    const CarRace race = car.race;
    const CarPrivate priv = car.priv;
    car.pub = looks.pub;
    car.race = looks.race;
    car.priv = looks.priv;
    car.control = looks.control;
    car.pub.track.segment = segment(looks.segment);
    car.race.pit = race.pit;
    car.race.penalties = race.penalties;
    car.priv.driver_params = priv.driver_params;
    car.priv.car_params = priv.car_params;
    car.priv.driver_index = priv.driver_index;
    std::copy(std::begin(priv.module), std::end(priv.module), car.priv.module);
    for (int i = 0; i < 4; i++) car.priv.wheel[i].segment = priv.wheel[i].segment;
    // Without this, a body would keep its dents in pictures of earlier moments.
    car.priv.dents = 0;
}

// What the game's graphics module calls by a name.
template <typename Thing>
Thing& drawn(const char* name) {
    static void* const library = [] {
        Dl_info module;
        dladdr(ReInfo->graphics.init_track, &module);
        return dlopen(module.dli_fname, RTLD_LAZY | RTLD_NOLOAD);
    }();
    return *static_cast<Thing*>(dlsym(library, name));
}

bool is(const Camera& camera, const char* kind) {
    return std::strcmp(camera.methods[-1]->name(), kind) == 0;
}

void turn(CameraBehind& behind, const CarElement& car) {
    const float lag =
        std::clamp(CAMERA_LAG * car.pub.local.vel.az, -MAX_CAMERA_LAG, MAX_CAMERA_LAG);
    behind.heading = car.pub.local.pos.az - lag / (1 - TURN_PER_PICTURE);
}

void hover(FlyingCamera& helicopter, const CarElement& car, double time) {
    const auto& pos = car.pub.local.pos;
    const float at[3] = {pos.x, pos.y, pos.z};
    for (int i = 0; i < 3; i++) {
        helicopter.offset[i] = ABOVE_CAR[i];
        helicopter.camera.place[i] = at[i] + ABOVE_CAR[i];
        helicopter.camera.speed[i] = 0;
    }
    helicopter.car = car.index;
    helicopter.time_left = LONG;
    helicopter.pull = helicopter.damping = 1;
    helicopter.time = time - JUST_BEFORE;
}

// The director would cut to another car.
void stay(DirectedCamera& camera, double time) {
    camera.last_event = camera.last_cut = time;
    camera.car = -1;
}

// Sets the cameras as if the previous pictures had been of a drive to this moment.
void pretend_a_past(const CarElement& car, Screen& screen, double time) {
    Camera& camera = *screen.camera;
    if (is(camera, "15cGrCarCamBehind")) turn(reinterpret_cast<CameraBehind&>(camera), car);
    if (is(camera, "16cGrCarCamRoadFly")) hover(reinterpret_cast<FlyingCamera&>(camera), car, time);
    if (is(camera, "20cGrCarCamRoadZoomTVD")) stay(reinterpret_cast<DirectedCamera&>(camera), time);
    for (Instrument& it : drawn<DrawnCar*>("grCarInfo")[car.index].instrument) {
        const float share = std::clamp((*it.shown - it.value) / it.range, 0.0f, 1.0f);
        it.needle = it.angle + share * it.angle_range;
    }
}

}  // namespace

bool acting() { return appearances_descriptor() >= 0; }

void take_appearance() {
    pollfd waiting{appearances_descriptor(), POLLIN, 0};
    while (poll(&waiting, 1, LOOK_AROUND) <= 0) owner().check();
    const auto scene = receive<SceneAppearance>();
    Situation& situation = *ReInfo->situation;
    if (scene.car_size != sizeof(CarAppearance)) give_up("the engine is of another build");
    if (scene.cars_number != situation.cars_number)
        give_up("the race has " + std::to_string(scene.cars_number) + " cars, the game drew up " +
                std::to_string(situation.cars_number));
    static const bool endless = situation.laps >= MANY_LAPS;
    situation.time = scene.time;
    for (int i = 0; i < scene.cars_number; i++) {
        const auto looks = receive<CarAppearance>();
        CarElement& car = ReInfo->cars[looks.index];
        put(car, looks);
        situation.cars[i] = &car;
    }
    // The game draws lights that shine at random angles.
    std::srand(1);  // NOLINT(bugprone-random-generator-seed): the same each time
    Screen& screen = *drawn<Screen*>("grScreens");
    pretend_a_past(*screen.car, screen, scene.time);
    // In a race without an end, the board shows the present lap as the last one.
    if (endless) situation.laps = std::max(situation.cars[0]->race.crossings, 1);
}

}  // namespace window
