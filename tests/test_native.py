"""The real game in this process: equal to itself bit for bit, and its physics make sense."""

from __future__ import annotations

import hashlib
import itertools
import math
import pickle
import threading
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from drives import drive
from game_copy import python

from sb3_torcs.actions import controls_from_action
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.backends.native import NativeBackend, NativeFleet, make_engine
from sb3_torcs.car import CAR_NUMBERS, Controls, Start, car_from_record
from sb3_torcs.errors import CarLost, InvalidOption
from sb3_torcs.sensors import encode
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.starting_list import AGENT

pytestmark = pytest.mark.usefixtures("game")

ALONE = [AGENT]
# The car settles on its springs, and rolls while it does: on a slope by a few centimetres. At the
# line some tracks have a gap of up to 0.3 m.
ROLLS = 0.3  # [m]
AMONG = [("inferno", 3), ("bt", 3), AGENT, ("olethros", 3)]
GAS = Controls(0.02, 0.7, 0.0)

DRIVES = [
    ("aalborg", ALONE, 0),
    ("dirt-1", ALONE, 1),
    ("michigan", AMONG, 2),
    ("g-track-1", AMONG, 3),
]


def whole(engine, cars=1):
    """Everything that can be read of a race, to the bit."""
    return b"".join(np.float64(value).tobytes() for i in range(cars) for value in engine.read(i))


def race_of(track, entries=ALONE, **options):
    """A race on the grid."""
    session = "race" if len(entries) > 1 else "practice"
    engine = make_engine(find_game(), track, entries, session=session, **options)
    engine.start()
    return engine


@pytest.fixture
def rng():
    return np.random.default_rng(0)


class TestEqualToItself:
    @pytest.mark.parametrize("what", DRIVES, ids=lambda what: what[0])
    def test_twice_in_one_process(self, what):
        """The second race gets the modules of the first, given back in between."""
        first = drive(*what)
        drive("alpine-2", [AGENT, ("bt", 3)], 4, ticks=50)
        assert drive(*what) == first

    def test_in_another_process(self):
        code = (
            "import ast, sys\nfrom drives import drive\n"
            "for what in ast.literal_eval(sys.argv[1]): print(drive(*what))"
        )
        tests = str(Path(__file__).parent)
        # In the other order, and with a locale and a folder that are not this process's.
        found = python(
            code, repr(DRIVES[::-1]), cwd="/", LC_ALL="C.UTF-8", PYTHONPATH=tests
        ).split()
        assert found[::-1] == [drive(*what) for what in DRIVES]

    def test_side_by_side(self):
        """Each is driven a little in turn, on four tracks, among robots of the same modules."""

        def states(engine, number, cars):
            for _ in range(number):
                engine.step(0.01, 0.8, 0.0, None, 2)
                yield whole(engine, cars)

        kinds = [("aalborg", AMONG), ("aalborg", AMONG), ("dirt-2", AMONG), ("michigan", ALONE)]
        alone = []
        for track, entries in kinds:
            engine = race_of(track, entries)
            alone.append(list(states(engine, 60, len(entries))))
            engine.close()
        engines = [race_of(*kind) for kind in kinds]
        turns = zip(
            *(states(e, 60, len(k[1])) for e, k in zip(engines, kinds, strict=True)), strict=True
        )
        for step, (seen, expected) in enumerate(zip(turns, zip(*alone, strict=True), strict=True)):
            assert seen == expected, f"step {step}"

    def test_in_threads_at_the_same_time(self):
        expected = [drive(*what) for what in DRIVES]
        found: dict[int, str] = {}

        def work(number):
            found[number] = drive(*DRIVES[number % len(DRIVES)])

        threads = [threading.Thread(target=work, args=(i,)) for i in range(2 * len(DRIVES))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [found[i] for i in range(len(threads))] == 2 * expected

    @pytest.mark.parametrize("threads", [1, 2, 5])
    def test_several_at_once_are_as_one_by_one(self, rng, threads):
        tracks = ["g-track-1", "michigan", "dirt-1"]
        together = [NativeBackend(track) for track in tracks]
        alone = [NativeBackend(track) for track in tracks]
        for backend in (*together, *alone):
            backend.reset(rng, Start(50.0, 0.0, 0.0, 20.0))
        controls = [Controls(0.01 * i, 0.5, 0.0) for i in range(3)]
        fleet, cars = NativeFleet(together, threads), np.empty((3, CAR_NUMBERS))
        for step in range(30):
            expected = [b.step(c, 3) for b, c in zip(alone, controls, strict=True)]
            for order in ([2, 0], [1]):  # in any order
                asked = np.array([controls[i] for i in order], np.float64)  # None is nan
                ticks = np.full(len(order), 3)
                assert fleet.step(np.array(order), asked, ticks, cars[: len(order)]) == []
                for row, i in zip(cars, order, strict=False):
                    car = car_from_record(row)
                    assert pickle.dumps(car) == pickle.dumps(expected[i]), f"step {step}"

    def test_many_controls_at_once_are_as_one_by_one(self):
        one, other = race_of("g-track-1"), race_of("g-track-1")
        controls = np.random.default_rng(0).uniform([-0.1, 0, 0], [0.1, 1, 0.2], (200, 3))
        one.replay(controls, True)
        for row in controls:
            other.step(*row, None, 1)
        assert whole(one) == whole(other)
        one, other = race_of("aalborg", AMONG), race_of("aalborg", AMONG)
        for _ in range(20):
            one.step(0.01, 0.9, 0.0, None, 7)  # a timestep of many ticks is many of one
            for _ in range(7):
                other.step(0.01, 0.9, 0.0, None, 1)
        assert whole(one, 4) == whole(other, 4)

    def test_a_reset_forgets_what_came_before(self):
        engine = race_of("aalborg", AMONG)
        fresh = [engine.step(0.0, 1.0, 0.0, None, 5) for _ in range(40)]
        engine.start_at(700.0, 0.3, 0.1, 40.0)
        engine.advance(300)
        engine.start()
        again = [engine.step(0.0, 1.0, 0.0, None, 5) for _ in range(40)]
        assert pickle.dumps(again) == pickle.dumps(fresh)

    def test_a_pickled_environment_goes_on_among_robots_with_noise(self):
        options = {"opponents": ("bt", "inferno:3"), "grid_place": 2}
        options["conditions"] = {"sensor_noise": True}
        env = gym.make("Torcs-v0", track="dirt-2", **options).unwrapped
        env.reset(seed=3)
        for _ in range(20):
            env.step(np.array([0.0, 0.8, 0.0], np.float32))
        copy = pickle.loads(pickle.dumps(env))
        for step in range(40):
            action = np.array([0.01, 0.9, 0.0], np.float32)
            one, other = env.step(action), copy.step(action)
            assert pickle.dumps(one[4]["car"]) == pickle.dumps(other[4]["car"]), f"step {step}"
        assert env.reset()[0].tobytes() == copy.reset()[0].tobytes()


class TestSnapshots:
    @pytest.mark.parametrize("entries", [ALONE, AMONG], ids=["alone", "among robots"])
    @pytest.mark.parametrize("track", ["aalborg", "dirt-2"])
    def test_a_race_goes_on_from_any_tick(self, track, entries, rng):
        engine, cars = race_of(track, entries), len(entries)
        for tick in sorted(rng.integers(0, 2000, 6)):
            engine.advance(int(tick) // 3)
            saved = engine.save()
            before = whole(engine, cars)
            drives = []
            for away in (0, 150, 1):
                engine.restore(saved)
                assert whole(engine, cars) == before
                engine.step(0.1, 1.0, 0.0, None, 3)
                engine.advance(200)
                drives.append(whole(engine, cars))
                engine.advance(away)
            assert drives[0] == drives[1] == drives[2], f"tick {tick}"

    def test_right_at_a_collision(self):
        """The collision library keeps what touched what; that has to come back, too."""
        engine = race_of("aalborg", AMONG)
        engine.start_at(150.0, 0.0, 0.0, 40.0)
        saved, hits = [], 0
        damage = 0.0
        for _ in range(300):
            snapshot = engine.save()
            state = engine.step(0.05, 0.0, 1.0, None, 1)
            if state.damage > damage and hits < 3:
                hits += 1
                saved += [snapshot, engine.save()]
            damage = max(damage, state.damage)
        assert hits == 3
        for snapshot in saved:
            drives = []
            for _ in range(2):
                engine.restore(snapshot)
                engine.advance(250)
                drives.append(whole(engine, 4))
            assert drives[0] == drives[1]

    def test_saving_at_every_tick_changes_nothing(self):
        plain, saving = race_of("michigan", AMONG), race_of("michigan", AMONG)
        for tick in range(100):
            plain.step(0.0, 1.0, 0.0, None, 2)
            snapshot = saving.save()
            saving.advance(3)
            saving.restore(snapshot)
            saving.step(0.0, 1.0, 0.0, None, 2)
            assert whole(plain, 4) == whole(saving, 4), f"tick {tick}"

    def test_laps_and_standings_come_back(self):
        entries = [("inferno", 3), ("berniw", 3)]
        engine = race_of("g-speedway", entries, laps=3)
        while not engine.laps(0):
            engine.advance(50)
        saved, laps = engine.save(), [engine.laps(i) for i in range(2)]
        ends = []
        for _ in range(2):
            engine.restore(saved)
            assert [engine.laps(i) for i in range(2)] == laps
            assert not engine.ended
            while not engine.ended:
                engine.advance(50)
            ends.append((engine.results(), [engine.laps(i) for i in range(2)]))
        assert ends[0] == ends[1]
        assert len(ends[0][1][0]) == 3

    def test_another_engine_s_is_refused(self):
        one, other = race_of("aalborg"), race_of("aalborg")
        with pytest.raises(InvalidOption, match="saved by another engine; restore it where"):
            other.restore(one.save())


def around(difference, length):
    """A distance along a closed road, the short way."""
    return (difference + 0.5 * length) % length - 0.5 * length


class TestStarts:
    @pytest.mark.parametrize(
        "track", ["aalborg", "michigan", "dirt-1", "corkscrew", "wheel-2", "mixed-2", "b-speedway"]
    )
    def test_anywhere_is_where_it_was_asked_for(self, track, rng):
        backend = NativeBackend(track)
        length = backend.track.length
        borders = np.cumsum([segment.length for segment in backend.track.segments])[:-1]
        places = [0.0, *rng.choice(borders, 10), *rng.uniform(0.0, length, 60), length - 1e-3]
        places.append(math.nextafter(length, 0.0))
        for place in places:
            position, error = rng.uniform(-0.6, 0.6), rng.uniform(-0.25, 0.25)
            start = Start(float(place), position, error, rng.uniform(1.0, 40.0))
            car = backend.reset(rng, start)
            away = around(car.distance_from_start - place, length)
            assert away == pytest.approx(0.0, abs=ROLLS), start
            aside = (car.track_position - position) * 0.5 * car.track_width
            assert aside == pytest.approx(0.0, abs=ROLLS), start
            assert car.heading_error == pytest.approx(error, abs=0.04), start
            assert car.speed_x == pytest.approx(start.speed, rel=1e-6), start
            assert 0.1 < car.height < 0.6, start
            assert (car.time, car.laps, car.lap_time) == (0.0, 0, 0.0)
            assert car.distance_raced == pytest.approx(0.0, abs=1e-3)
            later = backend.step(Controls(0.0, 0.5, 0.0), 5)
            assert np.isfinite([*later[:23]]).all(), start
            # In a bend, who drives outside does not come as far along the axis.
            went, straight = later.distance_raced, 0.1 * start.speed
            assert 0.5 * straight - 0.1 < went < 2.0 * straight + 0.1, start

    def test_wheels_and_engine_turn_with_the_road(self, rng):
        """Else the car would jerk, and the first second of every episode be another world."""
        backend = NativeBackend("michigan")
        for speed in (5.0, 20.0, 40.0, 70.0):
            car = backend.reset(rng, Start(100.0, 0.0, 0.0, speed))
            rolling = car.wheel_speeds * 0.33
            np.testing.assert_allclose(rolling, speed, rtol=0.1)
            later = backend.step(Controls(0.0, 0.3, 0.0), 5)
            assert later.speed_x == pytest.approx(speed, abs=1.5)
            assert car.gear >= 1
            assert 50.0 < car.engine_speed < 1000.0

    @pytest.mark.parametrize("track", ["michigan", "dirt-1", "b-speedway"])
    def test_nobody_is_damaged_by_a_start(self, rng, track):
        backend = NativeBackend(track)
        for _ in range(150):
            place, aside = rng.uniform(0.0, backend.track.length), rng.uniform(-0.6, 0.6)
            start = Start(place, aside, rng.uniform(-0.25, 0.25), 20.0)
            assert backend.reset(rng, start).damage == 0, start

    @pytest.mark.parametrize(
        ("track", "place"), [("e-track-6", 0.0), ("wheel-1", 409.9999691639124)]
    )
    @pytest.mark.parametrize("off", [0.0, 1e-6, 1e-2])
    def test_standing_exactly_level_and_straight(self, rng, track, place, off):
        """Where a wheel goes sideways only, the game's tyre model divides by zero."""
        backend = NativeBackend(track)
        backend.reset(rng, Start(place + off))
        for _ in range(10):
            assert np.isfinite([*backend.step(Controls(0.0, 0.5, 0.0), 1)[:23]]).all()

    def test_a_division_by_zero_is_told(self, rng):
        """A car slides along a wall so that a steered wheel goes sideways and nowhere else."""
        start = Start(
            593.074358493905, -0.2728089577556073, -0.028781531394979465, 55.77088799243907
        )
        *drive, last = [
            Controls(-0.9758033752441406, 0.765198826789856, 0.8796617388725281),
            Controls(-1.0, 0.8305118083953857, 0.9072043895721436),
            Controls(-1.0, 0.7145910859107971, 1.0),
            Controls(-0.7505556344985962, 0.0, 0.018453478813171387),
            Controls(-1.0, 0.0, 0.10761964321136475),
            Controls(-0.80303955078125, 0.0, 0.1278386116027832),
            Controls(-0.15662217140197754, 0.0, 0.1056486964225769),
            Controls(-0.33580005168914795, 0.0, 0.02483975887298584),
            Controls(-0.9947521686553955, 0.0, 0.07539516687393188),  # found by trying each float
        ]
        backend = NativeBackend("aalborg")
        backend.reset(rng, start)
        for controls in drive:
            before = backend.step(controls, 5)
        with pytest.raises(CarLost, match="divided by zero, agent is nowhere; call reset"):
            backend.step(last, 5)
        anew = pickle.loads(pickle.dumps(backend))
        assert anew.engine.read(0)[:23] == before[:23]
        again = backend.reset(rng, start)
        assert again[:23] == NativeBackend("aalborg").reset(rng, start)[:23]

    @pytest.mark.parametrize("error", [-3.1, -1.5, 1.5, 3.1])
    def test_facing_any_way(self, rng, error):
        car = NativeBackend("michigan").reset(rng, Start(500.0, 0.1, error, 10.0))
        assert car.heading_error == pytest.approx(error, abs=0.02)

    @pytest.mark.parametrize("track", ["aalborg", "michigan", "dirt-1"])
    def test_the_grid_is_the_session_s(self, rng, track):
        """A practice begins in the middle, far before the line; a race in rows, near to it."""
        backend = NativeBackend(track)
        car, length = backend.reset(rng, None), backend.track.length
        assert around(car.distance_from_start, length) == pytest.approx(-100.0, abs=0.1)
        assert car.distance_from_axis == pytest.approx(0.0, abs=0.1)
        assert abs(car.speed_x) < 0.1
        assert (car.laps, car.lap_time, car.distance_raced) == (0, car.time, 0.0)
        backend = NativeBackend(track, opponents=("bt",), grid_place=1)
        car, grid = backend.reset(rng, None), backend.track.grid
        assert around(car.distance_from_start, length) == pytest.approx(-25.0, abs=0.1)
        assert car.distance_from_axis == pytest.approx(grid.offset, abs=0.1)

    @pytest.mark.parametrize("place", [1, 2, 3, None])
    def test_a_place_on_the_grid(self, rng, place):
        opponents = ("inferno", "bt")
        backend = NativeBackend("aalborg", opponents=opponents, grid_place=place)
        place = place or 3  # the last one, unless somebody says
        assert backend.reset(rng, None).race_position == place
        cars = [backend.engine.read(i) for i in range(3)]
        places = [around(car.distance_from_start, backend.track.length) for car in cars]
        assert places == sorted(places, reverse=True)
        assert backend.engine.agents == [place - 1]

    def test_the_field_moves_with_the_agent(self, rng):
        backend = NativeBackend("aalborg", opponents=("inferno", "bt"), grid_place=2)
        backend.reset(rng, None)
        grid = [backend.engine.read(i).distance_from_start for i in range(3)]
        backend.reset(rng, Start(800.0, 0.0, 0.0, 30.0))
        moved = [backend.engine.read(i) for i in range(3)]
        for at_first, car in zip(grid, moved, strict=True):
            expected = at_first - grid[1] + 800.0
            assert car.distance_from_start == pytest.approx(expected, abs=0.3)
            assert car.speed_x == pytest.approx(30.0)


def lap(backend, rng, start, laps, ticks=20000):
    """Drive by script; return the states at which a lap ended, and the last one."""
    driver, car, ends = ScriptedDriver(), backend.reset(rng, start), []
    for _ in range(ticks // 2):
        before = car
        car = backend.step(controls_from_action(driver.predict(encode(car))[0]), 2)
        if car.laps > before.laps:
            ends.append(car)
        if len(ends) == laps:
            break
    return ends, car


CLOCK = 1e-4  # [s] the game keeps the time at which a lap began in a float


class TestLaps:
    def test_from_the_grid_the_clock_runs_at_once(self, rng):
        backend = NativeBackend("dirt-5")
        length = backend.track.length
        ends, _ = lap(backend, rng, None, 2)
        first, second = ends
        assert (first.laps, second.laps) == (1, 2)
        assert first.last_lap_time == pytest.approx(first.time - first.lap_time, abs=CLOCK)
        both = first.last_lap_time + second.last_lap_time
        assert second.time == pytest.approx(both + second.lap_time, abs=CLOCK)
        start = backend.reset(rng, None).distance_from_start
        raced = (length - start) + length + first.distance_from_start
        assert first.distance_raced == pytest.approx(raced, abs=0.5)

    @pytest.mark.parametrize("place", [0.25, 0.75])
    def test_on_the_way_the_first_crossing_starts_the_clock(self, rng, place):
        backend = NativeBackend("dirt-5")
        length = backend.track.length
        ends, _ = lap(backend, rng, Start(place * length, 0.0, 0.0, 15.0), 2)
        first, second = ends
        expected = (2.0 - place) * length
        assert first.distance_raced == pytest.approx(expected + first.distance_from_start, abs=0.5)
        assert first.last_lap_time < first.time - first.lap_time - 1.0
        began = first.time - first.lap_time
        lap_time = second.time - second.lap_time - began
        assert second.last_lap_time == pytest.approx(lap_time, abs=CLOCK)

    @pytest.mark.parametrize("speed", [0.0, 20.0])
    @pytest.mark.parametrize(
        ("track", "before"),
        [
            *itertools.product(["dirt-1", "g-track-1"], [1e-6, 1e-3, 0.01, 0.1, 1.0]),
            ("dirt-1", 0.0),
            ("g-track-1", 0.0),
            # Where the car settles across the line, that crossing is lost: the lap lasts two.
            ("dirt-5", 0.0),
            ("a-speedway", 0.0),
            ("michigan", 1e-6),
            ("aalborg", 1e-6),
        ],
    )
    def test_at_the_line_the_first_lap_is_the_first_lap(self, rng, track, before, speed):
        """Wherever the car settles: on the line, just before it, or pushed over it."""
        backend = NativeBackend(track)
        length = backend.track.length
        ends, _ = lap(backend, rng, Start((length - before) % length, 0.0, 0.0, speed), 1)
        assert ends
        raced = ends[0].distance_raced - ends[0].distance_from_start
        assert raced == pytest.approx(length, abs=before + 0.5)

    def test_laps_are_equal_to_the_tick(self, rng):
        backend = NativeBackend("dirt-5")
        first = [end.last_lap_time for end in lap(backend, rng, None, 2)[0]]
        lap(backend, rng, Start(300.0, 0.3, 0.1, 20.0), 1)
        assert [end.last_lap_time for end in lap(backend, rng, None, 2)[0]] == first

    def test_rolling_back_over_the_line_counts_no_lap(self, rng):
        backend = NativeBackend("michigan")
        length = backend.track.length
        car = backend.reset(rng, Start(3.0, 0.0, 0.0, 0.0))
        while around(car.distance_from_start, length) > -3.0:
            car = backend.step(Controls(0.0, 0.3, 0.0, -1), 5)
            assert car.laps == 0
        assert car.speed_x < 0.0
        assert car.distance_raced == pytest.approx(-6.0, abs=0.5)
        assert car.distance_from_start > length - 4.0
        while around(car.distance_from_start, length) < 3.0:
            car = backend.step(Controls(0.0, 0.5, 0.0, 1), 5)
        assert car.laps == 0
        assert car.distance_raced == pytest.approx(0.0, abs=0.5)

    def test_info_tells_a_lap_once(self):
        env = gym.make("Torcs-v0", track="dirt-5", laps=2)
        driver = ScriptedDriver()
        observation, _ = env.reset(seed=0)
        times, over = [], False
        while not over:
            observation, _, terminated, truncated, info = env.step(driver.predict(observation)[0])
            times += [info["lap_time"]] if info["lap_time"] else []
            over = terminated or truncated
        assert (info["end"], info["laps"], len(times)) == ("laps", 2, 2)
        assert info["best_lap_time"] in (0.0, *times)

    def test_a_wall_before_the_line_voids_no_lap(self):
        """The car hits it on its way to the line, where its first lap begins, and then no more."""
        options = {"ends": {"runoff": 30.0, "recovery": 20.0}, "aids": ["unstick"]}
        env = gym.make("Torcs-v0", track="g-track-1", laps=1, **options)
        before = env.unwrapped.track.length - 400.0
        driver, gas = ScriptedDriver(), np.array([0.0, 1.0, 0.0], np.float32)
        seen, _ = env.reset(options={"distance": before, "speed": 20.0, "heading_error": -0.5})
        for _ in range(25):
            seen, *_, info = env.step(gas)
        damage, over = info["damage"], False
        assert damage > 0.0
        while not over:
            seen, _, _, over, info = env.step(driver.predict(seen)[0])
        assert info["damage"] == damage
        assert info["best_lap_time"] == info["lap_time"] > 50.0


class TestAmongRobots:
    def test_opponents_are_seen_where_they_are(self, rng):
        backend = NativeBackend("aalborg", opponents=("inferno", "bt"), grid_place=2)
        own = backend.reset(rng, None)
        for other in (backend.engine.read(0), backend.engine.read(2)):
            away = math.hypot(other.x - own.x, other.y - own.y)
            bearing = math.atan2(other.y - own.y, other.x - own.x) - own.yaw
            clockwise = math.degrees(math.remainder(-bearing, 2.0 * math.pi)) + 180.0
            sector = int(clockwise // 10.0) % 36
            assert own.opponents[sector] == pytest.approx(away, abs=1e-6)
        assert np.count_nonzero(own.opponents < 200.0) == 2
        alone = NativeBackend("aalborg").reset(rng, None)
        assert alone.opponents.tolist() == [200.0] * 36

    def test_a_collision_damages_both(self):
        engine = race_of("aalborg", AMONG)
        engine.start_at(150.0, 0.0, 0.0, 40.0)
        for _ in range(300):
            own = engine.step(0.05, 0.0, 1.0, None, 1)
            if own.damage:
                break
        assert own.damage > 0
        assert own.opponents.min() < 6.0
        assert any(engine.read(i).damage > 0 for i in range(4) if i not in engine.agents)

    def test_the_wall_damages(self, rng):
        backend = NativeBackend("michigan")
        backend.reset(rng, Start(100.0, 0.0, 0.5, 50.0))
        car = backend.step(Controls(0.0, 0.0, 0.0), 200)
        assert car.damage > 0
        assert car.laps == 0

    def test_who_is_overtaken_loses_a_place(self, rng):
        backend = NativeBackend("michigan", opponents=("inferno", "bt"), grid_place=1)
        first = backend.reset(rng, None)
        assert first.race_position == 1
        assert backend.step(Controls(0.0, 0.0, 1.0), 500).race_position == 3
        assert backend.step(Controls(0.0, 1.0, 0.0), 200).fuel < first.fuel

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            *[({"opponents": wrong}, "opponents is .*; expected a list of names")
              for wrong in ("inferno", None, 5, [1], {"inferno", "bt"})],
            ({"opponents": ("inferno", "bt", "inferno:3")}, "inferno:3 is named twice"),
            *[({"opponents": ("inferno",), "laps": laps}, "a whole number from 1 to 1073741824")
              for laps in ("three", 2.5, 0, -5, 1 << 31)],
            *[({"opponents": ("inferno",), "grid_place": place}, "expected 1 to 2, or None")
              for place in (0, 3, -1, 1.5, True, "1")],
        ],
    )  # fmt: skip
    def test_what_is_no_race(self, options, message):
        with pytest.raises(InvalidOption, match=message):
            NativeBackend("aalborg", **options)

    def test_the_default_driver_has_the_agent_s_car(self, game):
        for name in ("inferno", "bt", "olethros"):
            assert game.find_robot(*game.parse_robot(name)).car == "car1-trb1"


NOISE = {"sensor_noise": True}


class TestNoise:
    def drive(self, seed, **options):
        """Range finders and opponents of a drive that ends beside the road."""
        env = gym.make("Torcs-v0", track="michigan", opponents=("bt",), **options)
        env.reset(seed=seed)
        cars = [env.unwrapped.backend.step(Controls(0.25, 0.6, 0.0), 5) for _ in range(120)]
        return np.array([[*car.range_finders, *car.opponents] for car in cars])

    def test_it_is_seeded(self):
        noisy = self.drive(1, conditions=NOISE)
        np.testing.assert_array_equal(noisy, self.drive(1, conditions=NOISE))
        assert not np.array_equal(noisy, self.drive(2, conditions=NOISE))

    def test_it_is_of_the_size_that_the_manual_says(self):
        clean, noisy = self.drive(1), self.drive(1, conditions=NOISE)
        off = clean[:, 0] == -1.0  # beside the road there is nothing to err about
        assert off.any()
        assert (clean[off, :19] == -1.0).all()
        assert (noisy[off, :19] == -1.0).all()
        seen = clean[:, :19] > 0.5
        ratio = noisy[:, :19][seen] / clean[:, :19][seen]
        assert ratio.mean() == pytest.approx(1.0, abs=0.02)
        assert ratio.std() == pytest.approx(0.1, rel=0.1)
        near = clean[:, 19:] < 200.0
        assert (noisy[:, 19:][near] / clean[:, 19:][near]).std() == pytest.approx(0.02, rel=0.25)

    def test_it_does_not_touch_the_drive(self):
        digests = []
        for noise in (False, True):
            backend = NativeBackend("michigan", sensor_noise=noise)
            backend.reset(np.random.default_rng(0), None)
            car = backend.step(GAS, 300)
            digests.append(hashlib.sha256(np.array(car[:23], float)).hexdigest())
        assert digests[0] == digests[1]


class TestFieldsAndWalls:
    @pytest.mark.parametrize(("place", "distance"), [(3, -5.0), (3, 0.0), (1, 5.0), (1, 0.0)])
    def test_a_field_across_the_line_keeps_its_order(self, rng, place, distance):
        backend = NativeBackend("g-track-1", opponents=("inferno", "berniw"), grid_place=place)
        backend.reset(rng, Start(distance % backend.track.length, speed=10.0))
        assert [backend.engine.read(car)[22] for car in range(3)] == [1, 2, 3]
        raced = [backend.engine.read(car)[13] for car in range(3)]
        assert np.allclose(raced, 0.0)

    def test_a_start_in_a_wall_is_refused(self, rng):
        backend = NativeBackend("e-track-2")
        with pytest.raises(InvalidOption, match="would stand in a wall"):
            backend.reset(rng, Start(53.87, 0.952))
        pickle.loads(pickle.dumps(backend))  # which has not begun
        assert np.isfinite(backend.engine.read(0).x)
        assert np.isfinite(backend.step(Controls(0.0, 1.0, 0.0), 5).x)
        assert np.isfinite(backend.reset(rng, Start(53.87, 0.3)).x)

    def test_an_agent_that_comes_last_drives_on(self, rng):
        """Its laps count after the robots have driven theirs."""
        backend = NativeBackend("g-track-1", opponents=("inferno", "berniw"), laps=1)
        car = backend.reset(rng, None)
        driver = ScriptedDriver()
        raced = car.distance_raced
        while car.laps < 1:
            car = backend.step(controls_from_action(driver.predict(encode(car))[0]), 5)
            assert car.distance_raced > raced - 1.0
            raced = car.distance_raced
        assert car.last_lap_time > 60.0
        assert not backend.engine.ended
