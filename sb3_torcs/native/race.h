// One race of the real game: a track, cars, and the loop that drives them.
//
// The loop, the lap counting, the rules, the pits and the results follow TORCS 1.3.7's race engine
// to the arithmetic, in the same types, since rounding decides at which physics step a robot is
// called. What the game shows or prints is left out.
#pragma once

#include <cstring>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "arena.h"
#include "game.h"
#include "layout.h"
#include "library.h"
#include "placing.h"
#include "road.h"

namespace torcs {

// How a gearbox chooses an agent's gears, where the agent does not.
enum class Gearbox { ENGINE_SPEED, ROAD_SPEED };

// A driver of the starting list: a robot of the game, or without a module an agent.
struct Entry {
    std::string module;
    int index = 0;         // of the module's drivers, or of the agents
    std::string car = {};  // an agent's
    Gearbox gearbox = Gearbox::ENGINE_SPEED;

    bool is_agent() const { return module.empty(); }
};

struct RaceOptions {
    std::string track;    // path of its XML
    std::string session;  // of the game's race managers, "practice" or "quickrace"
    std::vector<Entry> entries;
    int laps = 0;          // 0 drives on
    bool flagged = false;  // whether agents are flagged off, as robots are in a race of their own
};

struct Controls {
    float steering, throttle, brake;
    int gear;
    float clutch;
};

constexpr int AUTOMATIC_GEAR = -100;

struct LapRecord {
    double time;      // [s]
    int damage;       // [points] at its end
    float top_speed;  // [m/s]
    float lowest_speed;
};

struct Result {
    int entry;  // place in the starting list
    int laps;
    double total_time;  // [s] with penalties
    double best_lap;    // [s], 0 if none counts
    int damage;
    bool out;  // did not finish
};

// What an episode may change of the world; 1 is as it is.
struct Conditions {
    double grip = 1.0;  // of all ground
    double mass = 1.0;  // of each agent's car, and of its inertia
};

struct Snapshot {
    std::uint64_t race;  // number of the one that it is of
    double grip;         // the track's memory is not kept
    std::vector<char> memory;
    std::vector<Variables> variables;
};

// Memory of an earlier, closed race if there is one; a later race uses it again.
class LentArena {
public:
    LentArena(Game& game, std::size_t size);
    ~LentArena();
    LentArena(const LentArena&) = delete;
    LentArena& operator=(const LentArena&) = delete;

    Arena& arena() const { return arena_; }

private:
    Game& game_;
    std::size_t size_;
    Arena& arena_;
};

class Race {
public:
    Race(Game& game, RaceOptions options);
    ~Race();
    Race(const Race&) = delete;
    Race& operator=(const Race&) = delete;

    // Puts the field on the grid, at the moment before drivers are called for the first time.
    void start();
    // Moves the field along the road, so that the agent is at a place; all cars get a speed.
    void start(const Start& start);
    // For the starts that follow.
    void set_conditions(const Conditions& conditions);

    // What an agent does from its next call on.
    void hold(int index, const Controls& controls);
    // Drives for some intervals between two calls of drivers.
    void drive(int ticks);
    // Takes a car off the road and out of the race; nobody sees it or hits it any more.
    void retire(int index);
    // Puts a car down in the middle of the longest stretch of road without cars, rolling, undamaged
    // and without a lap; where along the road `start` says does not count.
    void rejoin(int index, const Start& start);
    // The physics alone, for comparison: no drivers, no rules.
    void update_physics(int steps);
    bool ended() const;
    bool finished(int index) const { return world_->records[index].finished; }
    // Whether the physics has divided by zero for a car, so that it was taken out of the race.
    bool lost(int index) const { return world_->records[index].lost; }

    Snapshot save() const;
    void restore(const Snapshot& snapshot);

    std::uint64_t number() const { return number_; }

    // Read what follows between two calls; `index` counts the starting list.
    const TrackData& track() const { return *track_; }
    std::vector<RoadSegment> road() const { return road_of(*track_, friction_); }
    const Situation& situation() const { return world_->situation; }
    const CarElement& car(int index) const { return world_->cars[index]; }
    CarElement* const* cars() const { return world_->order; }
    int cars_number() const { return world_->situation.cars_number; }
    const std::vector<int>& agents() const { return agents_; }  // their cars, by their index
    bool is_agent(int index) const {
        return options_.entries[static_cast<std::size_t>(index)].is_agent();
    }
    float height(int index) const;           // [m] of the mass centre above the road
    double distance_raced(int index) const;  // [m] since the start
    // To the car a place before (-1) or after (1), [m] of road; SENSOR_RANGE if there is none.
    double gap(int index, int places) const;
    int laps_left(int index) const;  // MANY_LAPS in a race without an end
    int contacts(int index) const { return world_->records[index].contacts; }  // with other cars
    int faults(int index) const { return world_->records[index].faults; }      // own ones of these
    std::vector<LapRecord> laps(int index) const;
    std::vector<Result> results() const;  // in the order of a race's standings

private:
    // What the race engine keeps about a car beside the shared record.
    struct Record {
        TrackPosition previous;
        float lap_began;  // [s]
        int backwards;    // crossings of the line that have to be made up for
        double pit_time;  // [s] of the present stop
        float top_speed, lowest_speed;
        int lane_state;         // of race_rules.cpp
        double start_distance;  // [m] by the race's count, where the episode began
        bool finished;          // drove all its laps
        bool lost;              // was nowhere, see `take_out_lost`
        bool flying;            // began on the way: the first crossing starts the clock
        int contacts, faults;   // with other cars; of these by its own fault
        double contact_time;    // [s] of the last moment of contact
        LapRecord* laps;
        int laps_number, laps_room;
    };
    struct World {
        Situation situation;
        RaceManager manager;
        double last_call;    // [s] when drivers were called
        Controls* controls;  // of each car; those of robots are not read
        CarElement** order;
        CarElement* cars;
        Record* records;
        Pit* pits;
    };
    struct Rules {
        bool wall_voids_lap, cut_voids_lap, cut_costs_time;
        float fuel_factor, damage_factor, fuel_flow, repair_factor, pit_base_time;
    };

    template <typename T>
    T* make(int number = 1) {
        const std::size_t size = sizeof(T) * static_cast<std::size_t>(number);
        return static_cast<T*>(std::memset(arena_.allocate(size), 0, size));
    }
    void close();
    void take_out_lost();

    void load_track();
    void load_cars();
    void load_driver(CarElement& car, const Entry& entry);
    Params load_car(const std::string& name);
    void set_rules();
    float grid_number(const char* name, float fallback) const;
    float grid_distance(int index) const;
    float grid_to_right(int index) const;
    void place_on_grid(CarElement& car);
    Field field() const;
    void assign_pits();
    void announce();
    void prepare();
    void start_elsewhere(const Start& start);
    void set_grip(double grip);
    void load_agents();
    void begin_on_the_way(int index, const Start& start, double distance);
    void lift(CarElement& car);
    double free_place(int index) const;

    bool has_flag() const { return options_.flagged || agents_.empty(); }
    void step();
    bool call_is_due() const;
    void keep_rolling();
    void call_drivers();
    void drive_agent(CarElement& car);
    void shift(CarElement& car) const;

    // Of race_rules.cpp.
    void manage(CarElement& car);
    void manage_pit(CarElement& car, Record& record);
    void stop_in_pit(CarElement& car, Record& record);
    bool stands_in_pit(const CarElement& car) const;
    bool cross_line(CarElement& car, Record& record);
    void record_lap(const CarElement& car, Record& record);
    void measure_distance(CarElement& car);
    void apply_rules(CarElement& car, Record& record);
    void check_cut(CarElement& car);
    void check_pit_lane(CarElement& car, Record& record);
    void add_penalty(CarElement& car, int kind);
    void sort();
    void watch_contacts();
    void note_contact(const CarElement& car, const CarElement& other);

    std::uint64_t number_;
    Game& game_;
    RaceOptions options_;
    LentArena memory_, track_memory_;
    Arena& arena_;  // of memory_
    Host host_;
    Host track_host_;
    std::unique_ptr<Library> track_library_, simulation_library_;
    std::vector<std::unique_ptr<Library>> robot_libraries_;
    std::map<std::string, Library*> robots_;  // of robot_libraries_, by name
    TrackInterface track_interface_{};
    Simulation simulation_{};
    TrackData* track_ = nullptr;
    Pit* track_pits_ = nullptr;  // the track's own, while the race's are in their place
    Params session_;
    std::string race_name_;
    Rules rules_{};
    World* world_ = nullptr;
    SimulatedCar** simulated_ = nullptr;
    void (*stop_colliding_)(SimulatedCar*, int cars) = nullptr;  // of the simulation
    std::vector<int> agents_;
    int set_up_ = 0;                   // drivers that know the track
    std::vector<float> rest_heights_;  // [m] of each car's mass centre over the road, standing
    Snapshot unannounced_, on_grid_;
    Conditions conditions_;
    double grip_ = 1.0;                   // of the ground now
    std::map<Surface*, float> friction_;  // of the ground by its file
};

}  // namespace torcs
