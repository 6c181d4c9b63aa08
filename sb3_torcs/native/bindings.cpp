// The Python module `sb3_torcs._engine`.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>
#include <unistd.h>

#include <cmath>
#include <cstring>
#include <string_view>

#include "engine.h"
#include "errors.h"
#include "fleet.h"
#include "maths/check.h"
#include "rollouts.h"
#include "scr/messages.h"

namespace py = pybind11;
using namespace py::literals;

namespace torcs {

namespace {

// Lets other threads of Python run. A thread that returns while the interpreter ends waits until
// the process ends, because it can neither continue nor be unwound.
class WithoutPython {
public:
    WithoutPython() : state_(PyEval_SaveThread()) {}
    ~WithoutPython() {
#if PY_VERSION_HEX >= 0x030D0000
        const bool ending = Py_IsFinalizing();
#else
        const bool ending = _Py_IsFinalizing();
#endif
        if (ending)
            for (;;) pause();
        PyEval_RestoreThread(state_);
    }
    WithoutPython(const WithoutPython&) = delete;
    WithoutPython& operator=(const WithoutPython&) = delete;

private:
    PyThreadState* state_;
};

template <std::size_t n>
py::array_t<double> read_only(const std::array<double, n>& values) {
    py::array_t<double> array(n, values.data());
    py::detail::array_proxy(array.ptr())->flags &= ~py::detail::npy_api::NPY_ARRAY_WRITEABLE_;
    return array;
}

// Makes the named tuple directly: it is a tuple of another class.
py::object as_state(const Reading& reading) {
    static PyTypeObject* type = reinterpret_cast<PyTypeObject*>(
        py::object(py::module_::import("sb3_torcs.car").attr("CarState")).release().ptr());
    const auto state = py::reinterpret_steal<py::object>(type->tp_alloc(type, SCALARS + 4));
    if (!state) throw py::error_already_set();
    for (int i = 0; i < SCALARS; i++) {
        const double value = reading.scalars[static_cast<std::size_t>(i)];
        const bool whole = i == GEAR_SCALAR || i == LAPS_SCALAR || i == POSITION_SCALAR;
        PyTuple_SET_ITEM(state.ptr(), i,
                         whole ? PyLong_FromLong(std::lround(value)) : PyFloat_FromDouble(value));
    }
    PyTuple_SET_ITEM(state.ptr(), SCALARS, read_only(reading.wheel_speeds).release().ptr());
    PyTuple_SET_ITEM(state.ptr(), SCALARS + 1, read_only(reading.range_finders).release().ptr());
    PyTuple_SET_ITEM(state.ptr(), SCALARS + 2, read_only(reading.opponents).release().ptr());
    PyTuple_SET_ITEM(state.ptr(), SCALARS + 3, read_only(reading.race).release().ptr());
    return state;
}

Controls controls_of(double steering, double throttle, double brake, std::optional<int> gear,
                     double clutch) {
    if (!std::isfinite(steering + throttle + brake + clutch))
        throw Error("InvalidAction",
                    "steering, throttle, brake and clutch are " + std::to_string(steering) + ", " +
                        std::to_string(throttle) + ", " + std::to_string(brake) + ", " +
                        std::to_string(clutch) + "; expected finite numbers");
    return {static_cast<float>(steering), static_cast<float>(throttle), static_cast<float>(brake),
            gear.value_or(AUTOMATIC_GEAR), static_cast<float>(clutch)};
}

std::vector<Angles> angles_of(const std::vector<std::vector<double>>& lists) {
    std::vector<Angles> arrays;
    for (const std::vector<double>& angles : lists) {
        if (angles.size() != RANGE_FINDERS)
            throw Error("InvalidOption", "range finders have " + std::to_string(angles.size()) +
                                             " angles, expected 19");
        std::copy(angles.begin(), angles.end(), arrays.emplace_back().begin());
    }
    return arrays;
}

// Agents take their car and gearbox from the lists, by their index.
std::vector<Entry> entries_of(const std::vector<std::pair<std::string, int>>& names,
                              const std::vector<std::string>& cars,
                              const std::vector<bool>& road_speed) {
    std::vector<Entry> entries;
    for (const auto& [name, index] : names) {
        Entry& entry = entries.emplace_back();
        entry.module = name;
        entry.index = index;
        if (!entry.is_agent()) continue;
        const auto agent = static_cast<std::size_t>(index);
        if (index < 0 || agent >= cars.size())
            throw Error("InvalidOption", "agent " + std::to_string(index) + " has no car; " +
                                             std::to_string(cars.size()) + " are named");
        entry.car = cars[agent];
        if (agent < road_speed.size() && road_speed[agent]) entry.gearbox = Gearbox::ROAD_SPEED;
    }
    return entries;
}

using Engines = std::vector<std::shared_ptr<Engine>>;

Engines checked(Engines engines) {
    for (const auto& engine : engines)
        if (!engine) throw py::type_error("engine is None; expected an Engine");
    return engines;
}

// Reads orders from arrays with one row per order. Controls are those of sb3_torcs.car.Controls; a
// gear of NaN leaves the choice to the gearbox. Arrivals are written into the rows of `cars`.
std::vector<Fleet::Order> orders_of(const py::array_t<std::int64_t, py::array::c_style>& races,
                                    const py::array_t<std::int64_t, py::array::c_style>& seats,
                                    const py::array_t<double, py::array::c_style>& controls,
                                    const py::array_t<std::int64_t, py::array::c_style>& ticks,
                                    py::array_t<double, py::array::c_style>& cars) {
    constexpr py::ssize_t NUMBERS = sizeof(Reading) / sizeof(double);
    const py::ssize_t number = races.size();
    if (races.ndim() != 1 || ticks.ndim() != 1 || ticks.size() != number || seats.ndim() != 1 ||
        seats.size() != number || controls.ndim() != 2 || controls.shape(0) != number ||
        controls.shape(1) != 5 || cars.ndim() != 2 || cars.shape(0) != number ||
        cars.shape(1) != NUMBERS)
        throw py::type_error(
            "expected races and seats (n,), controls (n, 5), ticks (n,), cars (n, " +
            std::to_string(NUMBERS) + ")");
    const auto asked = controls.unchecked<2>();
    Reading* const arrivals = reinterpret_cast<Reading*>(cars.mutable_data());
    std::vector<Fleet::Order> orders;
    orders.reserve(static_cast<std::size_t>(number));
    for (py::ssize_t i = 0; i < number; i++) {
        std::optional<int> gear;
        if (!std::isnan(asked(i, 3))) gear = static_cast<int>(asked(i, 3));
        orders.push_back({static_cast<std::size_t>(races.at(i)), static_cast<int>(seats.at(i)),
                          controls_of(asked(i, 0), asked(i, 1), asked(i, 2), gear, asked(i, 4)),
                          static_cast<int>(ticks.at(i)), arrivals + i});
    }
    return orders;
}

constexpr py::ssize_t WAYPOINT = sizeof(Waypoint) / sizeof(double);

std::vector<Waypoint> line_of(const py::array_t<double, py::array::c_style>& rows) {
    if (rows.ndim() != 2 || rows.shape(1) != WAYPOINT)
        throw py::type_error("expected a line (m, " + std::to_string(WAYPOINT) + ")");
    const Waypoint* first = reinterpret_cast<const Waypoint*>(rows.data());
    return {first, first + rows.shape(0)};
}

// Makes a method of the engine that reads something of one car.
template <typename Read>
auto of_car(Read read) {
    return [read](Engine& engine, int car) {
        const Engine::Access race(engine);
        Engine::check_car(*race, car);
        return read(*race, car);
    };
}

py::tuple follow(Rollouts& rollouts, const py::array_t<double, py::array::c_style>& rows,
                 const std::array<double, 3>& gains,
                 const py::array_t<double, py::array::c_style>& offsets, int ticks) {
    if (offsets.ndim() != 3 || offsets.shape(2) != 3)
        throw py::type_error("expected offsets (n, steps, 3)");
    const std::vector<Waypoint> line = line_of(rows);
    const py::ssize_t candidates = offsets.shape(0), steps = offsets.shape(1);
    py::array_t<double> paths({candidates, steps + 1, WAYPOINT});
    py::array_t<std::int64_t> lasted(candidates);
    const Rollouts::Order order{&line,
                                {gains[0], gains[1], gains[2]},
                                reinterpret_cast<const Offsets*>(offsets.data()),
                                reinterpret_cast<Waypoint*>(paths.mutable_data()),
                                lasted.mutable_data(),
                                static_cast<std::size_t>(candidates),
                                static_cast<std::size_t>(steps),
                                ticks};
    {
        const WithoutPython released;
        rollouts.follow(order);
    }
    return py::make_tuple(paths, lasted);
}

void bind_maths(py::module_& module) {
    module.def("wrong_functions", maths::wrong_functions,
               "Return the names of mathematical functions with wrong values on this machine.");
    module.def("maths_checksum", maths::checksum, py::call_guard<WithoutPython>(), "function"_a,
               "step"_a, "added"_a = false,
               "Sum up a float function's results at every so many-th of all arguments; `added` "
               "does without the processor's fused multiply-adds.");
}

// The game's side of the SCR protocol, so that tests can compare the Python client with it.
void bind_scr(py::module_& module) {
    module.def(
        "scr_format_state",
        [](const std::array<double, scr::STATE_NUMBERS>& numbers, bool exact) {
            scr::State state;
            std::memcpy(&state, numbers.data(), sizeof state);
            char text[scr::LONGEST_STATE];
            return py::bytes(text, scr::format_state(state, exact, text));
        },
        "numbers"_a, "exact"_a = false,
        "Write a state: its numbers in the order of the protocol, SI; with six digits or all.");
    module.def(
        "scr_parse_action",
        [](const py::bytes& text) {
            const scr::Action action = scr::parse_action(std::string_view(text));
            return py::make_tuple(action.throttle, action.brake, action.gear, action.steering,
                                  action.clutch, action.restart, action.focus, action.lap_time);
        },
        "text"_a, "Read an action: throttle, brake, gear, steering, clutch, restart, focus, time.");
    module.def(
        "scr_parse_init",
        [](const py::bytes& text) {
            const scr::Init init = scr::parse_init(std::string_view(text));
            py::object start = py::none();
            if (init.start)
                start = py::make_tuple(init.start->distance, init.start->track_position,
                                       init.start->heading_error, init.start->speed);
            return py::make_tuple(init.angles, start, init.exact, init.name);
        },
        "text"_a,
        "Read how a client introduces itself: angles, start or None, whether it wants all digits, "
        "its name.");
}

}  // namespace

PYBIND11_MODULE(_engine, module) {
    Game::watch_forks();
    module.doc() = "The real TORCS in this process; use it through sb3_torcs.backends.native.";

    // NOLINTNEXTLINE(performance-unnecessary-value-param): pybind11 hands it over so
    py::register_exception_translator([](std::exception_ptr pointer) {
        try {
            if (pointer) std::rethrow_exception(pointer);
        } catch (const Error& error) {
            const py::object type =
                py::module_::import("sb3_torcs.errors").attr(error.python_class);
            // A path in the message may not be valid UTF-8.
            PyErr_SetObject(
                type.ptr(),
                py::reinterpret_steal<py::object>(PyUnicode_DecodeFSDefault(error.what())).ptr());
        }
    });

    py::class_<Moment>(module, "Moment", "The whole state of a race, to go back to.")
        .def_property_readonly("size",
                               [](const Moment& moment) { return moment.race.memory.size(); });

    py::class_<Engine, std::shared_ptr<Engine>>(module, "Engine", "One race of the real game.")
        .def(py::init([](const std::string& data, const std::string& libraries,
                         const std::string& plib, const std::string& track,
                         const std::string& session,
                         const std::vector<std::pair<std::string, int>>& entries,
                         const std::vector<std::string>& cars, int laps,
                         const std::vector<std::vector<double>>& angles,
                         const std::vector<bool>& road_speed, bool flagged) {
                 RaceOptions options{track, session, entries_of(entries, cars, road_speed), laps,
                                     flagged};
                 const WithoutPython released;
                 Game& game = Game::open(data, libraries, plib);
                 return std::make_unique<Engine>(game, std::move(options), angles_of(angles));
             }),
             py::kw_only(), "data"_a, "libraries"_a, "plib"_a, "track"_a, "session"_a, "entries"_a,
             "cars"_a, "laps"_a, "angles"_a, "road_speed"_a = std::vector<bool>{},
             "flagged"_a = false)
        .def("start", py::overload_cast<>(&Engine::start), py::call_guard<WithoutPython>(),
             "Begin a race from the grid.")
        .def(
            "start_at",
            [](Engine& engine, double distance, double position, double error, double speed) {
                const WithoutPython released;
                engine.start(Start{distance, position, error, speed});
            },
            "distance"_a, "position"_a, "error"_a, "speed"_a,
            "Begin a race rolling: distance [m] along the road, position [-1 to 1] across it, "
            "error [rad] of the heading, speed [m/s].")
        .def(
            "step",
            [](Engine& engine, double steering, double throttle, double brake,
               std::optional<int> gear, int ticks, double clutch) {
                const Controls controls = controls_of(steering, throttle, brake, gear, clutch);
                Reading reading;
                {
                    const WithoutPython released;
                    Engine::Access race(engine);
                    const int agent = Engine::first_agent(*race);
                    race->hold(agent, controls);
                    race->drive(ticks);
                    reading = engine.read(*race, agent);
                }
                return as_state(reading);
            },
            "steering"_a, "throttle"_a, "brake"_a, "gear"_a, "ticks"_a, "clutch"_a = 0.0,
            "Hold controls for some ticks; returns the first agent's car as the fields of "
            "CarState.")
        .def(
            "hold",
            [](Engine& engine, int car, double steering, double throttle, double brake,
               std::optional<int> gear, double clutch) {
                const Controls controls = controls_of(steering, throttle, brake, gear, clutch);
                Engine::Access race(engine);
                Engine::check_agent(*race, car);
                race->hold(car, controls);
            },
            "car"_a, "steering"_a, "throttle"_a, "brake"_a, "gear"_a, "clutch"_a = 0.0,
            "Say what an agent does from its next call on.")
        .def(
            "retire", [](Engine& engine, int car) { engine.retire(car); }, "car"_a,
            "Take a car off the road and out of the race.")
        .def(
            "rejoin",
            [](Engine& engine, int car, double position, double error, double speed) {
                engine.rejoin(car, Start{0.0, position, error, speed});
            },
            "car"_a, "position"_a, "error"_a, "speed"_a,
            "Put an agent's car down in the middle of the longest free stretch of road, rolling.")
        .def("advance", &Engine::advance, py::call_guard<WithoutPython>(), "ticks"_a,
             "Drive on, with the agents standing on their brakes.")
        .def("drive", &Engine::drive, py::call_guard<WithoutPython>(), "ticks"_a,
             "Drive on; each agent does what it was last told to hold.")
        .def(
            "read", [](Engine& engine, int car) { return as_state(engine.read(car)); }, "car"_a,
            "Return a car as the fields of CarState.")
        .def("set_noise", &Engine::set_noise, "seed"_a,
             "Let range finders and opponents err from now on; None is no noise.")
        .def("mute_noise", &Engine::mute_noise, "muted"_a,
             "Read without noise for as long as it is muted, and draw none; returns what was set "
             "before.")
        .def(
            "set_conditions",
            [](Engine& engine, double grip, double mass) { engine.set_conditions({grip, mass}); },
            "grip"_a, "mass"_a, "Change the starts that follow, by factors.")
        .def("set_origin", &Engine::set_origin, "x"_a, "y"_a,
             "Move the positions that are read by x and y [m].")
        .def("save", &Engine::save, "Keep the whole race, for restore.")
        .def("restore", &Engine::restore, "moment"_a, "Go back to a moment of this engine.")
        .def(
            "focus",
            [](Engine& engine, int car, double direction) {
                return read_only(engine.focus(car, direction));
            },
            "car"_a, "direction"_a,
            "Return five distances [m] to the road's edge around a direction [rad], left negative.")
        .def(
            "appearance", [](Engine& engine) { return py::bytes(engine.appearance()); },
            "Return what the game's window needs to draw this moment.")
        .def("close", &Engine::close, "Free the race. A second call does nothing.")
        .def("controls", of_car([](const Race& race, int car) {
                 const Control& control = race.car(car).control;
                 return py::make_tuple(control.steering, control.throttle, control.brake,
                                       control.gear, control.clutch);
             }),
             "car"_a, "Return the controls that a car holds.")
        .def_property_readonly("agents",
                               [](Engine& engine) { return Engine::Access(engine)->agents(); })
        .def("lost", of_car([](const Race& race, int car) { return race.lost(car); }), "car"_a,
             "Whether the game's physics lost a car, which is out of the race then.")
        .def("finished", of_car([](const Race& race, int car) { return race.finished(car); }),
             "car"_a, "Say whether an agent was flagged off.")
        .def_property_readonly("ended",
                               [](Engine& engine) { return Engine::Access(engine)->ended(); })
        .def("car_name",
             of_car([](const Race& race, int car) { return std::string(race.car(car).info.car); }),
             "car"_a, "Return the name of a car's model.")
        .def("gears",
             of_car([](const Race& race, int car) { return race.car(car).priv.gears_number - 1; }),
             "car"_a, "Return the number of a car's forward gears.")
        .def("laps", of_car([](const Race& race, int car) {
                 py::list laps;
                 for (const LapRecord& lap : race.laps(car))
                     laps.append(py::make_tuple(lap.time, lap.damage));
                 return laps;
             }),
             "car"_a, "Return a car's laps so far: time [s] and damage [points].")
        .def(
            "results",
            [](Engine& engine) {
                py::list results;
                for (const Result& result : Engine::Access(engine)->results())
                    results.append(py::make_tuple(result.entry, result.laps, result.total_time,
                                                  result.best_lap, result.damage, result.out));
                return results;
            },
            "Return by place: entry, laps, time [s], best lap [s], damage [points], whether out.")
        .def(
            "track_summary",
            [](Engine& engine) {
                const Engine::Access race(engine);
                const TrackData& track = race->track();
                const Segment& first = *track.last->next;
                return py::dict(
                    "name"_a = track.name, "length"_a = track.length, "width"_a = track.width,
                    "segments"_a = track.segments_number,
                    "x"_a = 0.5 * (first.vertex[START_LEFT].x + first.vertex[START_RIGHT].x),
                    "y"_a = 0.5 * (first.vertex[START_LEFT].y + first.vertex[START_RIGHT].y),
                    "heading"_a = first.heading);
            },
            "Return name, sizes and the middle of the start line of the track.")
        .def(
            "road",
            [](Engine& engine) {
                const std::vector<RoadSegment> road = Engine::Access(engine)->road();
                py::array_t<double> rows({road.size(), std::size_t{ROAD_COLUMNS}});
                std::memcpy(rows.mutable_data(), road.data(), road.size() * sizeof road[0]);
                return rows;
            },
            "Return the segments of the road, one per row; see road.h.")
        .def(
            "replay",
            [](Engine& engine, const py::array_t<double, py::array::c_style>& controls,
               bool sensors) {
                const auto rows = controls.unchecked<2>();
                if (rows.shape(1) != 3)
                    throw Error("InvalidAction",
                                "controls have " + std::to_string(rows.shape(1)) +
                                    " columns; expected 3: steering, throttle, brake");
                std::vector<Controls> list;
                list.reserve(static_cast<std::size_t>(rows.shape(0)));
                for (py::ssize_t i = 0; i < rows.shape(0); i++)
                    list.push_back(controls_of(rows(i, 0), rows(i, 1), rows(i, 2), {}, 0.0));
                const WithoutPython released;
                engine.replay(list, sensors);
            },
            "controls"_a, "sensors"_a,
            "Drive controls, a tick each, with or without sensors; for benchmarks.")
        .def("update_physics", &Engine::update_physics, py::call_guard<WithoutPython>(), "steps"_a,
             "Move the bare physics on; for benchmarks.");

    py::class_<Fleet>(module, "Fleet", "Engines that are driven at once, on threads that stay.")
        .def(py::init([](const Engines& engines, int threads) {
                 return std::make_unique<Fleet>(checked(engines), threads);
             }),
             "engines"_a, "threads"_a)
        .def(
            "put",
            [](Fleet& fleet, std::size_t race, const std::shared_ptr<Engine>& engine) {
                checked({engine});
                const WithoutPython released;
                fleet.put(race, engine);
            },
            "race"_a, "engine"_a, "Let a race go on with another engine.")
        .def(
            "step",
            [](Fleet& fleet, const py::array_t<std::int64_t, py::array::c_style>& races,
               const py::array_t<std::int64_t, py::array::c_style>& seats,
               const py::array_t<double, py::array::c_style>& controls,
               const py::array_t<std::int64_t, py::array::c_style>& ticks,
               py::array_t<double, py::array::c_style>& cars) {
                const std::vector<Fleet::Order> orders =
                    orders_of(races, seats, controls, ticks, cars);
                const WithoutPython released;
                return fleet.step(orders);
            },
            "races"_a, "seats"_a, "controls"_a, "ticks"_a, py::arg("cars").noconvert(),
            "Drive several at once; writes their cars, and returns the rows of those that failed.")
        .def("check", &Fleet::check, "race"_a,
             "Raise what stopped a race in the latest step, if something did.");

    py::class_<Rollouts>(module, "Rollouts", "Short drives from one moment, at once.")
        .def(py::init([](const Engines& engines) {
                 return std::make_unique<Rollouts>(checked(engines));
             }),
             "engines"_a)
        .def("mark", &Rollouts::mark, py::call_guard<WithoutPython>(),
             "Keep the moment of the first engine, from which all candidates begin.")
        .def(
            "drive",
            [](Rollouts& rollouts, const py::array_t<double, py::array::c_style>& path, int ticks) {
                const std::vector<Waypoint> line = line_of(path);
                const WithoutPython released;
                rollouts.drive(line, ticks);
            },
            "path"_a, "ticks"_a, "Drive on from the mark, and mark there.")
        .def("go_back", &Rollouts::go_back, py::call_guard<WithoutPython>(), "drives"_a,
             "Begin again where the last so many drives began.")
        .def("follow", &follow, "line"_a, "gains"_a, "offsets"_a, "ticks"_a,
             "Follow a line with offsets; returns the paths, and how many timesteps each lasted.");

    bind_scr(module);
    bind_maths(module);
}

}  // namespace torcs
