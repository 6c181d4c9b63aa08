// How a race is set up: its memory, track, cars, drivers, rules and starting grid.
#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cmath>
#include <cstring>

#include "checks.h"
#include "errors.h"
#include "race.h"

namespace torcs {

namespace {

constexpr std::size_t RACE_MEMORY = std::size_t{128} << 20;  // reserved; a full grid uses 17
constexpr std::size_t TRACK_MEMORY = std::size_t{64} << 20;

constexpr float PIT_LENGTH = 15.0f, SHORTEST_PIT = 1.0f;  // [m] by default; longer than nothing

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

// The game's loader divides by the length of pits, if the file names the segments where they are.
bool has_too_short_pits(const Params& file) {
    const bool is_new = file.number("Header", "version", 0.0f) >= 4.0f;
    const char* const section = is_new ? "Main Track/Pits" : "Main Track";
    const std::string segments = is_new ? "Main Track/Track Segments/" : "Main Track/segments/";
    const std::string prefix = is_new ? "" : "pit ";
    if (!is_new && file.text(section, "pit type", "no pit") == "no pit") return false;
    for (const char* const place : {"entry", "start", "end", "exit"}) {
        const std::string name = file.text(section, (prefix + place).c_str());
        if (name.empty() || file.text((segments + name).c_str(), "type").empty()) return false;
    }
    return !(file.number(section, (prefix + "length").c_str(), PIT_LENGTH) >= SHORTEST_PIT);
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
    session_ = Params(game_, nullptr);  // released here, while the game's lock is held
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
    if (has_too_short_pits(file))
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
                                        ", but " + category_path +
                                        " is missing or broken; the game has those of its folder "
                                        "categories/, for example trb1");
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

}  // namespace torcs
