// The structures that the game's modules exchange, in the layout of TORCS 1.3.7 on 64-bit Linux.
//
// Only the members used here have names, in this project's own words; what lies between is
// `Unused`. The offsets are asserted below, and `check_layout` compares them with the installed
// libraries before the first race.
#pragma once

#include <cstddef>
#include <cstdint>

namespace torcs {

constexpr int MANY_LAPS = 1 << 30;  // of a race without an end

template <std::size_t n>
using Unused = unsigned char[n];

struct Point {
    float x, y, z;  // [m]
};

// A position or a velocity with its three angles.
struct Pose {
    float x, y, z;     // [m] or [m/s]
    float ax, ay, az;  // [rad] or [rad/s]: roll, pitch, yaw
};

struct Motion {
    Pose pos, vel, acc;
};

// ---- Track -------------------------------------------------------------------------------------

enum SegmentType : int { RIGHT_TURN = 1, LEFT_TURN = 2, STRAIGHT = 3 };
enum Side : int { RIGHT = 0, LEFT = 1 };
enum Vertex : int { START_LEFT = 0, START_RIGHT = 1, END_LEFT = 2, END_RIGHT = 3 };

enum RaceInfo : unsigned {
    BEFORE_LINE = 0x1,
    AFTER_LINE = 0x2,
    SPEED_LIMIT = 0x8,
    PIT = 0x40,
    PIT_START = 0x80,
    PIT_END = 0x100,
};

struct Surface {
    Surface* next;
    const char* name;
    float friction;
    float rebound;
    float rolling_resistance;
    Unused<8> a_;
    float damage;
};

struct Barrier {
    int style;
    float width;   // [m]
    float height;  // [m]
    Surface* surface;
    Unused<8> a_;
};

struct Segment {
    const char* name;
    int id;
    int type;  // SegmentType
    Unused<8> a_;
    float length;  // [m] of its middle
    float width;   // [m]
    float start_width;
    float end_width;
    float from_start;  // [m] of its beginning, from the start line
    float radius;      // [m] of its middle, 0 if straight
    float radius_right;
    float radius_left;
    float arc;  // [rad]
    Point center;
    Point vertex[4];  // Vertex
    float heading;    // [rad] of its beginning
    Unused<24> b_;
    Unused<8> c_;
    float widening;  // [m/m] or [m/rad]
    Unused<12> d_;
    Unused<8> e_;
    unsigned race_info;
    Unused<16> f_;
    Surface* surface;
    Barrier* barrier[2];  // Side
    Unused<8> g_;
    Segment* next;
    Segment* prev;
    Segment* side[2];  // Side
};

struct TrackPosition {
    Segment* segment;
    int type;         // 0: against the road, without its borders
    float to_start;   // [m], in a turn [rad], from the segment's beginning
    float to_right;   // [m]
    float to_middle;  // [m] left positive
    float to_left;    // [m]
};

struct CarElement;

struct Pit {
    TrackPosition pos;
    int occupied_by;  // place in `cars`, -1 if free
    float from, to;   // [m] along the road where a car can stop
    int cars_number;
    CarElement* cars[4];
};

struct Pits {
    int type;  // 1: beside the road
    int number;
    Unused<4> a_;
    int side;      // SegmentType of that side's turn
    float length;  // [m] of one
    float width;
    float speed_limit;  // [m/s]
    Segment* entry;
    Unused<16> b_;
    Segment* exit;
    Pit* pits;
    int cars_per_pit;
    int cars_number;
};

struct TrackData {
    const char* name;
    Unused<8> a_;
    char* filename;
    void* params;
    char* internal_name;
    Unused<8> b_;
    int segments_number;
    int version;
    float length;
    float width;
    Pits pits;
    Segment* last;  // whose next is the first after the start line
    Unused<8> c_;
    Unused<24> d_;
    Unused<64> e_;
};

// ---- Car ---------------------------------------------------------------------------------------

enum Wheel : int { FRONT_RIGHT = 0, FRONT_LEFT = 1, REAR_RIGHT = 2, REAR_LEFT = 3 };

enum CarStatus : int {
    IN_PIT = 0x1,
    OUT_OF_RACE = 0x2,
    NOT_SIMULATED = 0xff,
    FINISHED = 0x100,
    BROKEN = 0x200,
    OUT_OF_FUEL = 0x400,
    ELIMINATED = 0x800,
};

constexpr int NAME_LENGTH = 32;
constexpr int ROBOT_DRIVER = 2;
constexpr int COLLISION_WITH_WALL = 0x2;  // of CarPrivate::collision
constexpr int COLLISION_WITH_BODY = 0x4;  // another car, or a wall that stands on the ground
constexpr int PIT_ASKED = 1;              // of Control::race_command

struct CarInfo {
    char name[NAME_LENGTH];
    char team[NAME_LENGTH];
    char car[NAME_LENGTH];
    char category[NAME_LENGTH];
    int race_number;
    int start_rank;
    int driver_type;
    int skill;  // 0 rookie to 3 professional
    Unused<12> a_;
    Point dimension;  // [m]
    Unused<24> b_;
    float tank;        // [l]
    float steer_lock;  // [rad]
    Point mass_center;
    Unused<80> c_;
    Unused<32> d_;
};

struct CarPublic {
    Motion local;   // in the car's axes, but its position
    Motion global;  // in the track's frame
    float speed;    // [m/s]
    Unused<64> a_;
    TrackPosition track;
    int status;  // CarStatus
    Pose corner[4];
};

struct Penalty {
    int kind;  // 1: drive through, 2: stop and go
    int lap_to_clear;
    Penalty* next;
    Penalty** prev;
};

struct PenaltyList {
    Penalty* first;
    Penalty** last;
};

struct CarRace {
    double best_lap_time;  // [s]
    bool best_lap_counts;  // a lap that hit a wall or cut a corner does not
    double delta_best_lap_time;
    double lap_time;
    double last_lap_time;
    double total_time;
    float top_speed;
    float lowest_speed;
    int crossings;  // of the start line: whole laps and one
    int pit_stops;
    int remaining_laps;
    int position;          // 1 is the leader
    double behind_leader;  // [s]
    int laps_behind_leader;
    double behind_previous;
    double before_next;
    float distance_raced;  // [m]
    float distance_from_start;
    double event_time;  // [s] at which a pit stop ends
    Pit* pit;
    Unused<8> a_;
    PenaltyList penalties;
    float penalty_time;
};

struct WheelState {
    Pose pos;    // against the mass centre
    float spin;  // [rad/s]
    Unused<12> a_;
    Segment* segment;
    Unused<4> b_;
    float temperature_inner, temperature_middle, temperature_outer;
    float condition;
    Unused<20> c_;
};

constexpr int MAX_GEARS = 10;  // with reverse and neutral

struct CarPrivate {
    void* driver_params;
    void* car_params;
    int driver_index;
    char module[NAME_LENGTH];
    WheelState wheel[4];
    Unused<96> a_;
    int gear;
    float fuel;          // [l]
    float engine_speed;  // [rad/s]
    float red_line;      // [rad/s] at which the limiter cuts in
    Unused<20> b_;
    float gear_ratio[MAX_GEARS];  // reverse, neutral, first and up
    int gears_number;             // forward ones and neutral
    int gear_offset;
    Unused<36> c_;
    int collision;
    Unused<28> d_;
    int damage;  // [points]
    Unused<4> e_;
    int dents;  // to be made in the body that is drawn
    Unused<24> f_;
};

struct Control {
    float steering;  // [-1, 1], left positive
    float throttle;  // [0, 1]
    float brake;     // [0, 1]
    float clutch;    // [0, 1], 1 is pressed
    int gear;
    int race_command;
    char message[4][NAME_LENGTH];
    float message_color[4];
    int lights;
};

struct PitCommand {
    float fuel;     // [l] to take in
    int repair;     // [points] to mend
    int stop_type;  // 0: repair, 1: stop and go
    unsigned char setup[936];
};

struct Robot {
    void (*new_track)(int, TrackData*, void*, void**, struct Situation*);
    void (*new_race)(int, CarElement*, struct Situation*);
    void (*end_race)(int, CarElement*, struct Situation*);
    void (*drive)(int, CarElement*, struct Situation*);
    int (*pit)(int, CarElement*, struct Situation*);
    void (*shutdown)(int);
    int index;
};

struct CarElement {
    int index;
    CarInfo info;
    CarPublic pub;
    CarRace race;
    CarPrivate priv;
    Control control;
    PitCommand pit_command;
    Robot* robot;
    CarElement* next;
};

// ---- Race --------------------------------------------------------------------------------------

enum RaceState : int { RUNNING = 1, FINISHING = 2, ENDED = 4, STARTING = 8, PRESTART = 16 };
enum RaceType : int { PRACTICE = 0, QUALIFYING = 1, RACE = 2 };

constexpr double PHYSICS_STEP = 0.002;  // [s]
constexpr double ROBOT_STEP = 0.02;     // [s] least time between two calls of a robot

struct Situation {
    int cars_number;
    int laps;
    int state;  // RaceState
    int type;   // RaceType
    int max_damage;
    Unused<8> a_;
    double delta_time;  // [s] since the robots were called
    double time;        // [s] since the start
    Unused<8> b_;
    CarElement** cars;  // in the order of the race
};

struct RaceManager;

// ---- Modules -----------------------------------------------------------------------------------

constexpr int MODULE_INTERFACES = 10;

struct ModuleInfo {
    char* name;
    char* description;
    int (*init)(int index, void* interface);
    unsigned id;
    int index;
    int priority;
    int magic;
};

struct TrackInterface {
    TrackData* (*build)(char* filename);
    void* unused_[7];
    void (*shutdown)();
};

struct Simulation {
    void (*init)(int cars, TrackData*, float fuel_factor, float damage_factor);
    void (*config)(CarElement*, RaceManager*);
    void (*reconfig)(CarElement*);
    void (*update)(Situation*, double step, int telemetry);
    void (*shutdown)();
};

struct Graphics {
    void* init_track;
    int (*init_view)(int x, int y, int width, int height, int flag, void* screen);
    void* unused_;
    int (*refresh)(Situation*);
    void* unused_too_[3];
};

enum EngineState : int { LOAD_EVENT = 1 };

// What the race engine keeps about a car beside the shared record.
struct CarProgress {
    TrackPosition previous;
    float lap_began;  // [s]
    int backwards;    // crossings of the line that have to be made up for
    Unused<40> a_;
};

// What the game's exported `ReInfo` points to. The simulation's `config` reads only its track.
struct RaceManager {
    CarElement* cars;
    Situation* situation;
    TrackData* track;
    void* params;  // of the race's file
    void* results;
    Unused<16> a_;
    int state;  // EngineState
    Unused<8> b_;
    TrackInterface tracks;
    Graphics graphics;
    Simulation simulation;
    Unused<16> c_;
    char* file_name;  // of the race, without folder and ending
    const char* name;
    const char* race_name;
    CarProgress* progress;  // of each car, in the order of `cars`
    double time;            // [s] on the game's clock that the simulation has come to
    double robots_time;     // [s] since the start, when the robots were called
    double time_factor;
    int running;  // 0 while paused
    int display_mode;
    Unused<80> e_;
};

// ---- The simulation's own car, behind its exported `SimCarTable` --------------------------------

struct SimulatedWheel {
    Unused<156> a_;
    float spin;  // [rad/s]
    float previous_spin;
    Unused<116> b_;
    float radius;  // [m]
    Unused<56> c_;
    float axle_spin;  // [rad/s] of the shaft that drives it
    Unused<40> d_;
};

struct SimulatedCar {
    Control* control;
    void* params;
    CarElement* element;
    Unused<368> a_;
    SimulatedWheel wheel[4];
    Unused<120> b_;
    int gear;
    Unused<564> c_;
    float engine_speed;  // [rad/s]
    Unused<40> d_;
    float mass;  // [kg] without fuel
    float inverse_mass;
    Unused<16> f_;
    float inverse_inertia[3];  // of rolling, pitching and yawing
    float fuel;                // [l]
    Motion local;
    Motion global;
    Unused<544> e_;
    int damage;
    Unused<80> g_;
};

// ---- Offsets ------------------------------------------------------------------------------------

static_assert(offsetof(Segment, length) == 24 && offsetof(Segment, center) == 60);
static_assert(offsetof(Segment, vertex) == 72 && offsetof(Segment, heading) == 120);
static_assert(offsetof(Segment, widening) == 156 && offsetof(Segment, race_info) == 180);
static_assert(offsetof(Segment, surface) == 200 && offsetof(Segment, next) == 232);
static_assert(offsetof(Segment, side) == 248 && sizeof(Segment) == 264);
static_assert(offsetof(Segment, barrier) == 208 && offsetof(Barrier, surface) == 16);
static_assert(offsetof(Surface, rolling_resistance) == 24 && offsetof(Surface, damage) == 36);
static_assert(sizeof(TrackPosition) == 32 && sizeof(Pit) == 80 && sizeof(Pits) == 80);
static_assert(offsetof(Pit, cars) == 48 && offsetof(Pits, entry) == 32);
static_assert(offsetof(Pits, exit) == 56 && offsetof(Pits, pits) == 64);
static_assert(offsetof(TrackData, segments_number) == 48 && offsetof(TrackData, pits) == 64);
static_assert(offsetof(TrackData, last) == 144 && sizeof(TrackData) == 248);
static_assert(sizeof(Pose) == 24 && sizeof(Motion) == 72);
static_assert(offsetof(CarInfo, race_number) == 128 && offsetof(CarInfo, dimension) == 156);
static_assert(offsetof(CarInfo, tank) == 192 && offsetof(CarInfo, mass_center) == 200);
static_assert(sizeof(CarInfo) == 324);
static_assert(offsetof(CarPublic, speed) == 144 && offsetof(CarPublic, track) == 216);
static_assert(offsetof(CarPublic, status) == 248 && offsetof(CarPublic, corner) == 252);
static_assert(sizeof(CarPublic) == 352);
static_assert(offsetof(CarRace, lap_time) == 24 && offsetof(CarRace, crossings) == 56);
static_assert(offsetof(CarRace, behind_leader) == 72 && offsetof(CarRace, distance_raced) == 104);
static_assert(offsetof(CarRace, pit) == 120 && offsetof(CarRace, penalties) == 136);
static_assert(offsetof(CarRace, penalty_time) == 152 && sizeof(CarRace) == 160);
static_assert(offsetof(WheelState, spin) == 24 && offsetof(WheelState, segment) == 40);
static_assert(offsetof(WheelState, condition) == 64 && sizeof(WheelState) == 88);
static_assert(offsetof(CarPrivate, module) == 20 && offsetof(CarPrivate, wheel) == 56);
static_assert(offsetof(CarPrivate, gear) == 504 && offsetof(CarPrivate, gear_ratio) == 540);
static_assert(offsetof(CarPrivate, gears_number) == 580 && offsetof(CarPrivate, collision) == 624);
static_assert(offsetof(CarPrivate, damage) == 656 && offsetof(CarPrivate, dents) == 664);
static_assert(sizeof(CarPrivate) == 696);
static_assert(offsetof(Control, message) == 24 && sizeof(Control) == 172);
static_assert(sizeof(PitCommand) == 948);
static_assert(offsetof(CarElement, info) == 4 && offsetof(CarElement, pub) == 328);
static_assert(offsetof(CarElement, race) == 680 && offsetof(CarElement, priv) == 840);
static_assert(offsetof(CarElement, control) == 1536 && offsetof(CarElement, robot) == 2656);
static_assert(sizeof(CarElement) == 2672 && sizeof(Penalty) == 24);
static_assert(offsetof(Situation, max_damage) == 16 && offsetof(Situation, delta_time) == 32);
static_assert(offsetof(Situation, cars) == 56 && sizeof(Situation) == 64);
static_assert(offsetof(RaceManager, track) == 16 && offsetof(RaceManager, state) == 56);
static_assert(offsetof(RaceManager, graphics) == 144 && offsetof(RaceManager, simulation) == 200);
static_assert(offsetof(CarProgress, lap_began) == 32 && sizeof(CarProgress) == 80);
static_assert(offsetof(RaceManager, progress) == 280);
static_assert(offsetof(RaceManager, file_name) == 256 && offsetof(RaceManager, time) == 288);
static_assert(offsetof(RaceManager, running) == 312 && sizeof(RaceManager) == 400);
static_assert(offsetof(Graphics, refresh) == 24 && sizeof(Graphics) == 56);
static_assert(sizeof(ModuleInfo) == 40 && sizeof(TrackInterface) == 72);
static_assert(sizeof(Simulation) == 40 && sizeof(Robot) == 56);
static_assert(offsetof(SimulatedWheel, spin) == 156 && offsetof(SimulatedWheel, radius) == 280);
static_assert(offsetof(SimulatedWheel, axle_spin) == 340 && sizeof(SimulatedWheel) == 384);
static_assert(offsetof(SimulatedCar, wheel) == 392 && offsetof(SimulatedCar, gear) == 2048);
static_assert(offsetof(SimulatedCar, engine_speed) == 2616 && offsetof(SimulatedCar, fuel) == 2696);
static_assert(offsetof(SimulatedCar, global) == 2772 && offsetof(SimulatedCar, damage) == 3388);
static_assert(sizeof(SimulatedCar) == 3472);

}  // namespace torcs
