// How a race is set up: track, cars, starting grid, countdown, snapshots.
#include "race.h"

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cmath>
#include <cstring>

#include "checks.h"
#include "errors.h"
#include "gearbox.h"
#include "sensors.h"

namespace torcs {

namespace {

constexpr std::size_t RACE_MEMORY = std::size_t{128} << 20;  // reserved; a full grid uses 17
constexpr std::size_t TRACK_MEMORY = std::size_t{64} << 20;

constexpr float PIT_LENGTH = 15.0f, SHORTEST_PIT = 1.0f;  // [m] by default; longer than nothing
constexpr double COUNTDOWN = -2.0;                        // [s]
constexpr int SETTLING_STEPS = 500;  // of standing on the brake, so that the springs come to rest
constexpr int MANY_LAPS = 1 << 30;

const char* const SKILLS[] = {"rookie", "amateur", "semi-pro", "pro"};
constexpr int SEMI_PROFESSIONAL = 2;  // what the game takes for drivers that do not say

// Of races that are closed; under the game's lock.
std::vector<Arena*>& spare_arenas(std::size_t size) {
    static auto* race = new std::vector<Arena*>;
    static auto* track = new std::vector<Arena*>;
    return size == RACE_MEMORY ? *race : *track;
}

Arena& take_arena(Game& game, std::size_t size) {
    std::lock_guard<std::mutex> lock(game.mutex);
    auto& spare = spare_arenas(size);
    if (spare.empty()) return *new Arena(size);
    Arena* arena = spare.back();
    spare.pop_back();
    return *arena;
}

void copy_name(char (&to)[NAME_LENGTH], const std::string& from) {
    std::strncpy(to, from.c_str(), NAME_LENGTH - 1);
}

// A module exports a function under its own name, which fills this table.
ModuleInfo module_info(const Library& library, const std::string& name, int index) {
    ModuleInfo modules[MODULE_INTERFACES] = {};
    library.require<int (*)(ModuleInfo*)>(name.c_str())(modules);
    for (const ModuleInfo& module : modules)
        if (module.init && module.index == index) return module;
    throw Error("UnknownRobot", name + " has no driver of index " + std::to_string(index) +
                                    "; list them with: sb3-torcs robots");
}

void no_track(int, TrackData*, void*, void** params, Situation*) { *params = nullptr; }
void no_race(int, CarElement*, Situation*) {}
int no_pit(int, CarElement*, Situation*) { return 0; }
void no_shutdown(int) {}

[[noreturn]] void refuse_file(const char* error, const std::string& path) {
    const std::string reason = printed();
    if (reason.find(std::strerror(EMFILE)) != std::string::npos)
        throw Error("BackendUnavailable", path + ": " + reason + MORE_FILES);
    throw Error(error, path + ": " + reason);
}

Robot agent_robot() { return {no_track, no_race, no_race, no_race, no_pit, no_shutdown, 0}; }

}  // namespace

LentArena::LentArena(Game& game, std::size_t size)
    : game_(game), size_(size), arena_(take_arena(game, size)) {}

LentArena::~LentArena() {
    std::lock_guard<std::mutex> lock(game_.mutex);
    arena_.clear();
    spare_arenas(size_).push_back(&arena_);
}

Race::Race(Game& game, RaceOptions options)
    : game_(game),
      options_(std::move(options)),
      memory_(game, RACE_MEMORY),
      track_memory_(game, TRACK_MEMORY),
      arena_(memory_.arena()),
      session_(game, nullptr) {
    static std::atomic<std::uint64_t> races{0};
    number_ = ++races;
    std::lock_guard<std::mutex> lock(game_.mutex);
    host_ = {&arena_, new_random(arena_), game_.data};
    track_host_ = {&track_memory_.arena(), host_.random, game_.data};
    try {
        load_track();
        load_cars();
        prepare();
    } catch (...) {
        close();
        throw;
    }
}

Race::~Race() {
    std::lock_guard<std::mutex> lock(game_.mutex);
    close();
}

void Race::close() {
    if (world_) {
        Hosted hosted(host_);
        for (int i = 0; i < world_->situation.cars_number; i++) {
            CarElement& car = world_->cars[i];
            try {
                if (i < set_up_ && car.robot->shutdown) car.robot->shutdown(car.robot->index);
            } catch (const Error&) {  // NOLINT(bugprone-empty-catch)
                // Its memory is freed with the race in any case.
            }
            const Params car_params(game_, car.priv.car_params);  // releases it
            const Params driver_params(game_, car.priv.driver_params);
        }
    }
    if (track_) {
        Hosted hosted(track_host_);
        if (track_pits_) track_->pits.pits = track_pits_;
        track_interface_.shutdown();
    }
    for (auto& library : robot_libraries_) Library::give_back(std::move(library));
    Library::give_back(std::move(simulation_library_));
    Library::give_back(std::move(track_library_));
}

// ---- Loading ------------------------------------------------------------------------------------

void Race::load_track() {
    Hosted hosted(track_host_);
    track_library_ = game_.take_module("modules/track", "track");
    ModuleInfo module = module_info(*track_library_, "track", 0);
    module.init(module.index, &track_interface_);
    const Params file = Params::read(game_, options_.track);
    if (!file) refuse_file("TrackFileError", options_.track);
    std::string path = options_.track;
    // The game's loader fills the pit lane with pits, however short they are.
    if (!(file.number("Main Track", "pit length", PIT_LENGTH) >= SHORTEST_PIT &&
          file.number("Main Track/Pits", "length", PIT_LENGTH) >= SHORTEST_PIT))
        throw Error("TrackFileError", path + " has pits of no length; 15 m are usual");
    forget_printed();
    try {
        track_ = track_interface_.build(path.data());
    } catch (const Error& error) {
        throw Error("TrackFileError", path + ": " + error.what());
    }
    check_track(track_, file, path);
    const Segment* road = track_->last;
    for (int i = 0; i < track_->segments_number; i++, road = road->next) {
        friction_.emplace(road->surface, road->surface->friction);
        for (const Side side : {RIGHT, LEFT})
            for (const Segment* strip = road->side[side]; strip; strip = strip->side[side])
                friction_.emplace(strip->surface, strip->surface->friction);
    }
}

Params Race::load_car(const std::string& name) {
    const std::string path = "cars/" + name + "/" + name + ".xml";
    Params car = Params::read(game_, path);
    if (!car) refuse_file("CarFileError", game_.data + path);
    const std::string category = car.text("Car", "category");
    if (category.empty())
        throw Error("CarFileError",
                    game_.data + path + " names no category; every car of the game has one");
    const std::string category_path = "categories/" + category + ".xml";
    Params limits = Params::read(game_, category_path);
    if (!limits)
        throw Error("CarFileError", game_.data + path + " is of the category " + category +
                                        ", but " + category_path + " cannot be read: " + printed());
    if (car.misfits(limits))
        throw Error("CarFileError", game_.data + path + " does not fit its category " + category +
                                        ": " + printed());
    Params whole = Params::merge(std::move(limits), std::move(car));
    // Without these the simulation reads memory that is not there, or divides by zero.
    const auto require = [&](bool has, const char* what) {
        if (!has) throw Error("CarFileError", game_.data + path + " has no " + what);
    };
    require(whole.elements("Engine/data points") >= 2, "motor torque of two speeds or more");
    require(whole.elements("Gearbox/gears") >= 2, "gears");
    require(whole.number("Car", "mass", 0.0f) > 0.0f, "mass");
    require(whole.number("Engine", "inertia", 0.2f) > 0.0f, "motor inertia");
    require(whole.number("Car", "fuel tank", 80.0f) > 0.0f, "fuel tank");
    require(whole.number("Engine", "revs limiter", 0.0f) > 0.0f, "rev limiter");
    return whole;
}

void Race::load_cars() {
    Hosted hosted(host_);
    session_ = Params::read(game_, "config/raceman/" + options_.session + ".xml");
    if (!session_)
        throw Error("GameIncomplete",
                    game_.data + "config/raceman/" + options_.session + ".xml: " + printed());
    race_name_ = session_.text("Races/1", "name");
    simulation_library_ = game_.take_module("modules/simu", "simuv2");
    ModuleInfo module = module_info(*simulation_library_, "simuv2", 0);
    module.init(module.index, &simulation_);

    const int number = static_cast<int>(options_.entries.size());
    world_ = make<World>();
    world_->cars = make<CarElement>(number);
    world_->order = make<CarElement*>(number);
    world_->records = make<Record>(number);
    world_->controls = make<Controls>(number);
    world_->manager.cars = world_->cars;
    world_->manager.situation = &world_->situation;
    world_->manager.track = track_;
    set_rules();
    agents_.resize(static_cast<std::size_t>(
        std::count_if(options_.entries.begin(), options_.entries.end(),
                      [](const Entry& entry) { return entry.is_agent(); })));
    for (int i = 0; i < number; i++) {
        CarElement& car = world_->cars[i];
        car.index = i;
        world_->order[i] = &car;
        world_->situation.cars_number = i + 1;
        load_driver(car, options_.entries[static_cast<std::size_t>(i)]);
    }
    world_->situation.cars = world_->order;

    simulation_.init(number, track_, rules_.fuel_factor, rules_.damage_factor);
    simulated_ = simulation_library_->require<SimulatedCar**>("SimCarTable");
    stop_colliding_ = simulation_library_->require<void (*)(SimulatedCar*, int)>(
        "_Z19SimCollideRemoveCarP4tCari");
    for (int i = 0; i < number; i++) {
        world_->cars[i].race.best_lap_counts = true;
        place_on_grid(world_->cars[i]);
    }
    assign_pits();
}

void Race::load_driver(CarElement& car, const Entry& entry) {
    car.race.penalties.last = &car.race.penalties.first;
    car.priv.driver_index = entry.index;
    car.info.driver_type = ROBOT_DRIVER;
    car.info.start_rank = car.index;
    car.info.skill = SEMI_PROFESSIONAL;
    car.race.position = car.index + 1;
    car.race.remaining_laps = world_->situation.laps;
    car.robot = make<Robot>();
    std::string car_name = entry.car;
    if (entry.is_agent()) {
        agents_[static_cast<std::size_t>(entry.index)] = car.index;
        *car.robot = agent_robot();
        copy_name(car.info.name,
                  entry.index == 0 ? "agent" : "agent " + std::to_string(entry.index + 1));
        copy_name(car.info.team, "agent");
        copy_name(car.priv.module, "agent");
    } else {
        // Several drivers of a module share its copy, as they do in the game.
        Library*& library = robots_[entry.module];
        if (!library) {
            robot_libraries_.push_back(
                game_.take_module("drivers/" + entry.module, entry.module, "RobotUnavailable"));
            library = robot_libraries_.back().get();
        }
        ModuleInfo module = module_info(*library, entry.module, entry.index);
        module.init(entry.index, car.robot);
        Params driver =
            Params::read(game_, "drivers/" + entry.module + "/" + entry.module + ".xml");
        if (!driver)
            throw Error("GameIncomplete", game_.data + "drivers/" + entry.module + "/" +
                                              entry.module + ".xml: " + printed());
        const std::string section = "Robots/index/" + std::to_string(entry.index);
        copy_name(car.priv.module, entry.module);
        copy_name(car.info.name, driver.text(section.c_str(), "name", "<none>"));
        copy_name(car.info.team, driver.text(section.c_str(), "team", "<none>"));
        car.info.race_number =
            static_cast<int>(driver.number(section.c_str(), "race number", 0.0f));
        const std::string skill = driver.text(section.c_str(), "skill level", "semi-pro");
        car.info.skill = 0;
        for (int i = 0; i < 4; i++)
            if (skill == SKILLS[i]) car.info.skill = i;
        car_name = driver.text(section.c_str(), "car name");
        car.priv.driver_params = driver.release();
    }
    copy_name(car.info.car, car_name);
    Params params = load_car(car_name);
    copy_name(car.info.category, params.text("Car", "category"));
    void* own = nullptr;
    car.robot->new_track(entry.index, track_, params.handle(), &own, &world_->situation);
    set_up_++;
    if (own) {
        Params setup(game_, own);
        if (setup.misfits(params))
            throw Error("RobotUnavailable", entry.module + " has a set-up that does not fit " +
                                                car_name + ": " + printed());
        params = Params::merge(std::move(params), std::move(setup));
    }
    car.priv.car_params = params.release();
    game_.init_pit_setup(car.priv.car_params, car.pit_command.setup, false);
}

void Race::set_rules() {
    const char* race = race_name_.c_str();
    const auto enabled = [&](const char* name) {
        return session_.text(race, name, "yes") == "yes";
    };
    const auto at_least = [&](const char* name, float fallback, float least) {
        return std::max(session_.number(race, name, fallback), least);
    };
    rules_.wall_voids_lap = enabled("invalidate best lap on wall touch");
    rules_.cut_voids_lap = enabled("invalidate best lap on corner cutting");
    rules_.cut_costs_time = enabled("corner cutting time penalty");
    rules_.fuel_factor = at_least("fuel consumption factor", 1.0f, 0.0f);
    rules_.damage_factor = at_least("damage factor", 1.0f, 0.0f);
    rules_.fuel_flow = at_least("refuel fuel flow", 8.0f, 1.0f);
    rules_.repair_factor = at_least("damage repair factor", 0.007f, 0.0f);
    rules_.pit_base_time = at_least("pitstop base time", 2.0f, 0.0f);
    track_->pits.speed_limit = session_.number(race, "pit speed limit", track_->pits.speed_limit);

    Situation& situation = world_->situation;
    situation.laps = options_.laps ? options_.laps : MANY_LAPS;
    situation.max_damage = static_cast<int>(session_.number(race, "maximum dammage", 10000.0f));
    const std::string type = session_.text(race, "type", "race");
    situation.type = type == "practice" ? PRACTICE : type == "qualifications" ? QUALIFYING : RACE;
}

// ---- The grid -----------------------------------------------------------------------------------

// A track's own settings override the session's.
float Race::grid_number(const char* name, float fallback) const {
    const std::string section = race_name_ + "/Starting Grid";
    return Params::view(game_, track_->params)
        .number("Starting Grid", name, session_.number(section.c_str(), name, fallback));
}

float Race::grid_distance(int index) const {
    const int rows = std::max(static_cast<int>(grid_number("rows", 2.0f)), 1);
    const float to_start = grid_number("distance to start", 10.0f);
    const float between_columns = grid_number("distance between columns", 10.0f);
    const float within_column = grid_number("offset within a column", 5.0f);
    return track_->length - (to_start + static_cast<float>(index / rows) * between_columns +
                             static_cast<float>(index % rows) * within_column);
}

float Race::grid_to_right(int index) const {
    const Segment* turn = track_->last->next;
    while (turn->type == STRAIGHT) turn = turn->next;
    const std::string section = race_name_ + "/Starting Grid";
    std::string pole = turn->type == LEFT_TURN ? "left" : "right";
    pole = session_.text(section.c_str(), "pole position side", pole.c_str());
    pole = Params::view(game_, track_->params)
               .text("Starting Grid", "pole position side", pole.c_str());
    const float first = pole == "left" ? track_->width : 0.0f;
    const float across = pole == "left" ? -track_->width : track_->width;
    const int rows = std::max(static_cast<int>(grid_number("rows", 2.0f)), 1);
    return first + across * static_cast<float>(index % rows + 1) / static_cast<float>(rows + 1);
}

void Race::place_on_grid(CarElement& car) {
    const float distance = grid_distance(car.index);
    if (!(distance >= 0.0f))
        throw Error("TrackFileError",
                    options_.track + " is " + std::to_string(std::lround(track_->length)) +
                        " m long, and its grid has place " + std::to_string(car.index + 1) + " " +
                        std::to_string(std::lround(track_->length - distance)) +
                        " m before the line; name fewer opponents, or see its Starting Grid");
    place(field(), car, distance, grid_to_right(car.index), 0.0f,
          grid_number("initial height", 0.3f));
}

Field Race::field() const {
    const int first = agents_.empty() ? -1 : agents_.front();
    return {world_->cars, cars_number(), first,           &world_->manager,
            &simulation_, simulated_,    game_.to_global, game_.road_height};
}

void Race::assign_pits() {
    Pits& pits = track_->pits;
    if (pits.type != 1) return;
    // The race's pits are its own, so that a snapshot has them.
    track_pits_ = pits.pits;
    world_->pits = make<Pit>(pits.number);
    std::copy_n(track_pits_, pits.number, world_->pits);
    pits.pits = world_->pits;
    pits.cars_number = world_->situation.cars_number;
    const float shared = session_.number(race_name_.c_str(), "cars per pit", 1.0f);
    pits.cars_per_pit = std::clamp(static_cast<int>(shared), 1, 4);
    for (int i = 0; i < pits.number; i++) {
        pits.pits[i].cars_number = 0;
        pits.pits[i].occupied_by = -1;
        std::fill(std::begin(pits.pits[i].cars), std::end(pits.pits[i].cars), nullptr);
    }
    for (int i = 0; i < world_->situation.cars_number; i++) {
        CarElement& car = world_->cars[i];
        for (int j = 0; j < pits.number; j++) {
            Pit& pit = pits.pits[j];
            const bool mates = pit.cars_number > 0 && pit.cars_number < pits.cars_per_pit &&
                               std::strcmp(pit.cars[0]->info.team, car.info.team) == 0;
            if (pit.cars_number > 0 && !mates) continue;
            if (pit.cars_number == 0) {
                const float middle = pit.pos.segment->from_start + pit.pos.to_start;
                pit.from = middle - pits.length / 2.0 + car.info.dimension.x / 2.0;
                pit.to = middle + pits.length / 2.0 - car.info.dimension.x / 2.0;
                if (pit.from > track_->length) pit.from -= track_->length;
                if (pit.to > track_->length) pit.to -= track_->length;
            }
            pit.cars[pit.cars_number++] = &car;
            car.race.pit = &pit;
            break;
        }
    }
}

// ---- The start ----------------------------------------------------------------------------------

// Robots find their place on the road here, and later search only around their last place. So the
// cars must stand where the race begins, and a robot can be told of one race only.
void Race::announce() {
    for (int i = 0; i < cars_number(); i++) {
        CarElement& car = world_->cars[i];
        car.robot->new_race(car.robot->index, &car, &world_->situation);
    }
}

void Race::prepare() {
    Hosted hosted(host_);
    unannounced_ = save();
    announce();
    simulation_.update(&world_->situation, PHYSICS_STEP, -1);
    for (int i = 0; i < cars_number(); i++) world_->records[i].previous = world_->cars[i].pub.track;
    settle(field(), world_->situation, SETTLING_STEPS, false);
    for (int i = 0; i < cars_number(); i++)
        rest_heights_.push_back(height_over_road(field(), world_->cars[i]));
    check_simulation(*simulated_, world_->cars, cars_number());
    Situation& situation = world_->situation;
    world_->last_call = -1.0;
    situation.time = COUNTDOWN;
    situation.delta_time = PHYSICS_STEP;
    situation.state = STARTING;
    // The agent waits on its brake; robots are called, as they are in the game.
    while (situation.time < 0.0 || !call_is_due()) step();
    for (int i = 0; i < cars_number(); i++)
        world_->records[i].start_distance = world_->cars[i].race.distance_raced;
    on_grid_ = save();
}

void Race::set_conditions(const Conditions& conditions) { conditions_ = conditions; }

void Race::set_grip(double grip) {
    if (grip == grip_) return;
    for (const auto& [surface, friction] : friction_)
        surface->friction = static_cast<float>(friction * grip);
    grip_ = grip;
}

// The agents' cars get the mass of the episode.
void Race::load_agents() {
    if (conditions_.mass == 1.0) return;
    const auto factor = static_cast<float>(conditions_.mass);
    for (const int agent : agents_) {
        SimulatedCar& car = (*simulated_)[agent];
        car.mass *= factor;
        car.inverse_mass /= factor;
        for (float& inverse : car.inverse_inertia) inverse /= factor;
    }
}

void Race::start() {
    restore(on_grid_);
    set_grip(conditions_.grip);
    load_agents();
}

void Race::start(const Start& start) {
    restore(unannounced_);
    set_grip(conditions_.grip);
    try {
        start_elsewhere(start);
    } catch (...) {
        this->start();  // the race that was begun cannot be driven
        throw;
    }
}

void Race::start_elsewhere(const Start& start) {
    Hosted hosted(host_);
    Situation& situation = world_->situation;
    const std::vector<double> distances = put_down(field(), start, rest_heights_);
    load_agents();
    {
        std::lock_guard<std::mutex> lock(game_.mutex);  // robots may read files, as when loaded
        announce();
    }
    come_to_rest(field(), situation);
    if (const CarElement* car = stuck_car(field()))
        throw Error("InvalidOption", std::string(car->info.name) +
                                         " would stand in a wall or in another car; start "
                                         "elsewhere, or nearer to the middle of the road");
    situation.state = RUNNING;
    situation.time = 0.0;
    situation.delta_time = ROBOT_STEP;
    world_->last_call = -ROBOT_STEP;
    for (int i = 0; i < cars_number(); i++) {
        give_speed(field(), world_->cars[i], start.speed);
        begin_on_the_way(i, start, distances[static_cast<std::size_t>(i)]);
    }
    sort();
}

// Counts laps and distance from where a car has been put down.
void Race::begin_on_the_way(int index, const Start& start, double distance) {
    CarElement& car = world_->cars[index];
    Record& record = world_->records[index];
    record.flying = true;
    record.previous = car.pub.track;  // it may have settled across the line
    manage(car);
    const int ahead = crossings_of(car, distance, track_->length, start.distance == 0.0);
    car.race.crossings = std::max(ahead, 0);
    car.race.remaining_laps -= car.race.crossings;
    record.backwards = std::max(-ahead, 0);
    measure_distance(car);
    record.start_distance = car.race.distance_raced;
}

// ---- Driving ------------------------------------------------------------------------------------

void Race::hold(int index, const Controls& controls) { world_->controls[index] = controls; }

void Race::drive(int ticks) {
    if (ticks < 0)
        throw Error("InvalidOption",
                    "ticks is " + std::to_string(ticks) + "; expected a whole number >= 0");
    Hosted hosted(host_);
    // In a race without a flag, environments decide when it is over.
    const auto over = [this] { return has_flag() && ended(); };
    for (int i = 0; i < ticks && !over(); i++) {
        step();
        while (!call_is_due() && !over()) step();
    }
    for (int i = 0; i < cars_number(); i++)
        if (!std::isfinite(car(i).pub.local.vel.x) || !std::isfinite(car(i).pub.local.pos.x))
            throw Error("CarLost", "the game's physics has divided by zero, " +
                                       std::string(car(i).info.name) +
                                       " is nowhere; call reset to go on");
}

void Race::update_physics(int steps) {
    Hosted hosted(host_);
    for (int i = 0; i < steps; i++) simulation_.update(&world_->situation, PHYSICS_STEP, -1);
}

bool Race::ended() const { return world_->situation.state == ENDED; }

bool Race::call_is_due() const {
    return world_->situation.time + PHYSICS_STEP - world_->last_call >= ROBOT_STEP;
}

void Race::step() {
    Situation& situation = world_->situation;
    situation.time += PHYSICS_STEP;
    if (situation.time < 0.0) {
        situation.state = PRESTART;
    } else if (situation.state == PRESTART) {
        situation.state = RUNNING;
        situation.time = 0.0;
        world_->last_call = 0.0;
    }
    if (situation.time - world_->last_call >= ROBOT_STEP) call_drivers();
    keep_rolling();
    simulation_.update(&situation, PHYSICS_STEP, -1);
    for (int i = 0; i < situation.cars_number; i++) manage(*world_->order[i]);
    sort();
    if (situation.cars_number > 1) watch_contacts();
}

// The game's tyre model divides by zero if a wheel moves sideways and its forward speed is exactly
// 0. That is rare, and would end the drive; here such a car gets a tiny forward speed.
void Race::keep_rolling() {
    constexpr float HAIR = 1e-5f;  // [m/s]
    for (int i = 0; i < world_->situation.cars_number; i++) {
        Pose& velocity = (*simulated_)[i].local.vel;
        if (velocity.x == 0.0f && velocity.az == 0.0f && velocity.y != 0.0f) velocity.x = HAIR;
    }
}

void Race::call_drivers() {
    Situation& situation = world_->situation;
    situation.delta_time = situation.time - world_->last_call;
    for (int i = 0; i < situation.cars_number; i++) {
        CarElement& car = *world_->order[i];
        if (car.pub.status & NOT_SIMULATED) continue;
        if (is_agent(car.index))
            drive_agent(car);
        else
            car.robot->drive(car.robot->index, &car, &situation);
    }
    world_->last_call = situation.time;
}

void Race::drive_agent(CarElement& car) {
    if (world_->situation.state == PRESTART) return;
    const Controls& controls = world_->controls[car.index];
    car.control.steering = controls.steering;
    car.control.throttle = controls.throttle;
    car.control.brake = controls.brake;
    car.control.gear = controls.gear;
    car.control.clutch = controls.clutch;  // the gearbox presses it, too, while it shifts
    if (controls.gear == AUTOMATIC_GEAR) shift(car);
}

// A gearbox that shifts by motor speed hunts while wheels spin. By road speed, it shifts by the
// speed that the motor would have if no wheel slipped. In first gear the clutch slips, so that the
// motor can turn faster than the wheels.
void Race::shift(CarElement& car) const {
    const CarPrivate& priv = car.priv;
    const float* ratio = priv.gear_ratio + priv.gear_offset;
    const float shift_up = SHIFT_UP * priv.red_line;
    const int gear = std::max(priv.gear, 1);
    float engine_speed = priv.engine_speed;
    const Entry& entry = options_.entries[static_cast<std::size_t>(car.index)];
    if (entry.gearbox == Gearbox::ROAD_SPEED) {
        const float radius = (*simulated_)[car.index].wheel[REAR_RIGHT].radius;
        engine_speed = std::max(car.pub.local.vel.x, 0.0f) / radius * ratio[gear];
        if (gear == 1) {
            const float launch = LAUNCH_CLUTCH * std::max(1.0f - engine_speed / shift_up, 0.0f);
            car.control.clutch = std::max(car.control.clutch,
                                          std::floor(launch * CLUTCH_STEPS + 0.5f) / CLUTCH_STEPS);
        }
    }
    car.control.gear = gear;
    if (priv.gear < 1) return;
    if (engine_speed > shift_up && gear < priv.gears_number - 1)
        car.control.gear = gear + 1;
    else if (gear > 1 && engine_speed * ratio[gear - 1] / ratio[gear] < SHIFT_DOWN * priv.red_line)
        car.control.gear = gear - 1;
}

// ---- Leaving and rejoining ----------------------------------------------------------------------

// Takes a car out of the collision library, as the simulation does with a wreck.
void Race::lift(CarElement& car) {
    stop_colliding_(*simulated_ + car.index, cars_number());
    if (car.race.pit && car.pub.status & IN_PIT) car.race.pit->occupied_by = -1;
}

void Race::retire(int index) {
    Hosted hosted(host_);
    CarElement& car = world_->cars[index];
    if (car.pub.status & OUT_OF_RACE) return;
    lift(car);
    car.pub.status = (car.pub.status & ~IN_PIT) | OUT_OF_RACE;
}

// Along the road from the start line, [m].
double Race::free_place(int index) const {
    const double length = track_->length;
    std::vector<double> taken;
    for (int i = 0; i < cars_number(); i++)
        if (i != index && !(car(i).pub.status & NOT_SIMULATED & ~IN_PIT))
            taken.push_back(distance_along(car(i), length));
    if (taken.empty()) return grid_distance(index);
    std::sort(taken.begin(), taken.end());
    double begin = taken.back() - length, widest = 0.0, place = 0.0;
    for (const double end : taken) {
        if (end - begin > widest) {
            widest = end - begin;
            place = begin + 0.5 * widest;
        }
        begin = end;
    }
    return place < 0.0 ? place + length : place;
}

void Race::rejoin(int index, const Start& start) {
    Hosted hosted(host_);
    CarElement& car = world_->cars[index];
    Record& record = world_->records[index];
    lift(car);
    car.pub.status = 0;
    const Start there = {free_place(index), start.track_position, start.heading_error, start.speed};
    put_down_rolling(field(), car, there, rest_heights_[static_cast<std::size_t>(index)]);
    CarRace& race = car.race;
    while (race.penalties.first) {
        Penalty* penalty = race.penalties.first;
        race.penalties.first = penalty->next;
        arena_.release(penalty);
    }
    race.penalties.last = &race.penalties.first;
    race.best_lap_time = race.last_lap_time = race.total_time = race.delta_best_lap_time = 0.0;
    race.penalty_time = race.top_speed = 0.0f;
    race.best_lap_counts = true;
    race.remaining_laps = world_->situation.laps;
    const int room = record.laps_room;
    LapRecord* laps = record.laps;
    record = Record{};
    record.laps = laps;
    record.laps_room = room;
    record.lap_began = static_cast<float>(world_->situation.time);
    world_->controls[index] = Controls{};
    begin_on_the_way(index, there, there.distance);
    sort();
}

// ---- Reading and keeping ------------------------------------------------------------------------

float Race::height(int index) const { return height_over_road(field(), car(index)); }

double Race::distance_raced(int index) const {
    return world_->cars[index].race.distance_raced - world_->records[index].start_distance;
}

double Race::gap(int index, int places) const {
    const int other = car(index).race.position - 1 + places;
    if (other < 0 || other >= cars_number()) return SENSOR_RANGE;
    const float behind = world_->order[other]->race.distance_raced - car(index).race.distance_raced;
    return std::fabs(static_cast<double>(behind));
}

int Race::laps_left(int index) const {
    return world_->situation.laps - std::max(car(index).race.crossings - 1, 0);
}

std::vector<LapRecord> Race::laps(int index) const {
    const Record& record = world_->records[index];
    return {record.laps, record.laps + record.laps_number};
}

Snapshot Race::save() const {
    Snapshot snapshot{number_, grip_, arena_.save(), {}};
    snapshot.variables.push_back(simulation_library_->save());
    for (const auto& library : robot_libraries_) snapshot.variables.push_back(library->save());
    return snapshot;
}

void Race::restore(const Snapshot& snapshot) {
    set_grip(snapshot.grip);
    arena_.restore(snapshot.memory);
    simulation_library_->restore(snapshot.variables[0]);
    for (std::size_t i = 0; i < robot_libraries_.size(); i++)
        robot_libraries_[i]->restore(snapshot.variables[i + 1]);
}

}  // namespace torcs
