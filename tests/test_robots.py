"""The engine drives as the game does: every time to the millisecond, every damage.

This is a choice that takes seconds; ``tools/compare_with_game.py`` compares them all.
"""

from __future__ import annotations

import ctypes

import numpy as np
import pytest
from text_mode import run as run_game

from sb3_torcs.agents.robots import _result, race
from sb3_torcs.backends.native import make_engine
from sb3_torcs.car import CONTROL_TICK
from sb3_torcs.errors import InvalidOption, TrackNotFound, UnknownRobot
from sb3_torcs.telemetry import COLUMNS, DriveLog
from sb3_torcs.torcs import process
from sb3_torcs.torcs.starting_list import AGENT

COLUMN = {name: number for number, name in enumerate(COLUMNS)}

ROBOTS = ["inferno", "berniw", "bt", "olethros", "tita", "lliaw"]
EVERYBODY_ON = ["road/aalborg", "oval/michigan", "dirt/dirt-1"]
ONE_MORE = [
    ("inferno", "road/corkscrew"),  # the steepest
    ("inferno", "road/wheel-2"),  # a figure of eight, with a bridge
    ("berniw", "road/e-track-6"),
    ("berniw", "dirt/mixed-2"),  # two surfaces
    ("bt", "road/alpine-1"),  # it refuels
    ("bt", "oval/b-speedway"),
    ("olethros", "road/g-track-3"),
    ("olethros", "dirt/dirt-3"),
    ("tita", "oval/e-track-5"),
    ("tita", "road/street-1"),  # walls beside the road
    ("lliaw", "dirt/dirt-4"),
    ("lliaw", "road/e-track-2"),
]
FIELDS = [
    (["inferno", "berniw", "bt", "olethros"], "road/aalborg"),
    (["lliaw", "tita", "inferno", "berniw"], "oval/michigan"),
    (["bt", "olethros", "tita", "lliaw"], "dirt/dirt-2"),
    (["bt:1", "bt:3", "inferno:3", "inferno:4"], "road/g-track-1"),  # modules with two drivers
]

# Functions, arguments and correct results that older systems miss; the last one is as glibc has it
# on a processor with fused operations.
HARD = [
    ("tanf", "0x1.d4326cp-6", "0x1.d4530ep-6"),
    ("atanf", "0x1.7b4c24p-4", "0x1.7a3802p-4"),
    ("asinf", "0x1.11542ap-6", "0x1.115768p-6"),
    ("sinf", "0x1.52e6cp+6", "0x1.8f6114p-4"),
]


def milliseconds(seconds):
    """The game writes six digits: those that are milliseconds are exact."""
    return None if seconds is None else round(1000 * seconds)


def laps_of(result):
    return [(milliseconds(lap.time), lap.damage) for lap in result.laps]


def standing(result):
    """What the game writes down about a race: no laps of it."""
    return (
        result.rank,
        result.robot,
        result.index,
        result.car,
        result.laps_completed,
        milliseconds(result.total_time),
        milliseconds(result.best_lap),
        result.damage,
        result.out,
    )


class TestEqualToTheGame:
    @pytest.mark.parametrize(
        ("robot", "track"), [(r, t) for t in EVERYBODY_ON for r in ROBOTS] + ONE_MORE
    )
    def test_a_practice(self, game, robot, track):
        driver = game.parse_robot(robot)
        (theirs,) = run_game(game, track, [driver], 3)
        (ours,) = race([driver], track, 3)
        assert len(ours.laps) == 3
        assert laps_of(ours) == laps_of(theirs)
        assert milliseconds(ours.best_lap) == milliseconds(theirs.best_lap)
        assert milliseconds(ours.total_time) == milliseconds(theirs.total_time)
        assert (ours.damage, ours.out, ours.car) == (theirs.damage, theirs.out, theirs.car)

    @pytest.mark.parametrize(("field", "track"), FIELDS)
    def test_a_race(self, game, field, track):
        drivers = [game.parse_robot(name) for name in field]
        theirs = run_game(game, track, drivers, 3, "race")
        ours = race(drivers, track, 3, session="race")
        assert [standing(result) for result in ours] == [standing(result) for result in theirs]

    def test_a_car_of_another_category(self, game):
        """The agent's car is not everybody's."""
        (theirs,) = run_game(game, "g-track-1", [("sparkle", 0)], 2)
        (ours,) = race([("sparkle", 0)], "g-track-1", 2)
        assert ours.car == "baja-bug"
        assert laps_of(ours) == laps_of(theirs)


class TestEqualToTheUntouchedGame:
    """Where the system's functions are ours at hard places, and not where they differ there."""

    @pytest.mark.parametrize(
        ("robot", "track"),
        [("inferno", "road/aalborg"), ("bt", "road/aalborg"), ("lliaw", "dirt/dirt-1")],
    )
    def test_a_practice(self, game, robot, track, monkeypatch):
        monkeypatch.setattr(process, "mathematics", list)
        driver = game.parse_robot(robot)
        (theirs,) = run_game(game, track, [driver], 3)
        (ours,) = race([driver], track, 3)
        assert (laps_of(ours) == laps_of(theirs)) == system_computes_as_we_do()


def system_computes_as_we_do():
    """Whether the C library rounds correctly, as from glibc 2.41 on, and uses fused operations."""
    libm = ctypes.CDLL("libm.so.6")
    for name, argument, expected in HARD:
        function = getattr(libm, name)
        function.restype, function.argtypes = ctypes.c_float, [ctypes.c_float]
        if function(float.fromhex(argument)) != float.fromhex(expected):
            return False
    return True


class TestItself:
    def test_who_still_drives_when_the_race_is_over_has_not_finished(self, game):
        """The winner has driven one more lap by then; the game says no more of such a car."""
        entries = [game.parse_robot("inferno"), AGENT]
        engine = make_engine(game, "g-track-1", entries, session="race", laps=1, flagged=True)
        engine.start()
        while not engine.ended:
            engine.advance(50)  # the agent stands on its brake
        winner, other = (_result(engine, entries, 1, row) for row in engine.results())
        assert (winner.out, other.out) == (False, True)

    def test_a_race_is_the_same_again(self, game):
        drivers = [game.parse_robot(name) for name in ("bt", "olethros", "inferno")]
        first = race(drivers, "dirt-2", 2, session="race")
        race([("lliaw", 3)], "michigan", 1)  # whose modules the next one may get
        assert race(drivers, "dirt-2", 2, session="race") == first

    def test_laps_add_up_to_the_total(self, game):
        for result in race([("inferno", 3), ("bt", 3)], "g-track-1", 2, session="race"):
            assert len(result.laps) == result.laps_completed
            times = sum(lap.time for lap in result.laps)
            assert result.total_time == pytest.approx(times, abs=1e-6)


class TestLog:
    def test_it_has_a_row_per_robot_and_control_tick(self, game):
        log = DriveLog()
        results = race([("inferno", 3), ("berniw", 3)], "michigan", 1, session="race", log=log)
        inferno, berniw = log.episodes().values()
        assert [label.driver for label in log.episodes()] == ["inferno", "berniw"]
        assert inferno.shape == berniw.shape
        *steps, last = np.round(np.diff(inferno[:, COLUMN["time"]]), 3)
        assert set(steps) == {0.02, 0.022} or set(steps) == {0.02}
        assert 0.0 < last <= 0.022  # the race ends where the second car has finished
        for result, rows in zip(results, (inferno, berniw), strict=True):
            reached = rows[:, COLUMN["last_lap_time"]].max()
            assert reached == pytest.approx(result.laps[-1].time, abs=1e-9)

    def test_to_note_it_changes_nothing(self, game):
        noted = race([("bt", 3)], "dirt-1", 1, log=DriveLog())
        assert race([("bt", 3)], "dirt-1", 1) == noted


class TestStartsElsewhere:
    @pytest.mark.parametrize("robot", ROBOTS)
    @pytest.mark.parametrize("track", ["aalborg", "michigan"])
    def test_robots_drive_on_from_there(self, game, robot, track):
        """They look on the whole road for their place when a race begins, and later only nearby."""
        engine = make_engine(game, track, [game.parse_robot(robot), AGENT], session="race")
        length = engine.track_summary()["length"]
        engine.start()
        while not engine.laps(0):
            engine.step(0.0, 0.0, 1.0, None, 50)
        ((lap, _),) = engine.laps(0)
        for share in (0.4, 0.9):
            engine.start_at(share * length, 0.0, 0.0, 0.0)
            engine.step(0.0, 0.0, 1.0, None, int(lap / CONTROL_TICK))
            assert engine.read(0).distance_raced > 0.9 * length

    def test_every_start_is_the_same_race(self, game):
        field = [("inferno", 3), ("inferno", 4), ("berniw", 3), ("bt", 2), AGENT]
        engine = make_engine(game, "alpine-1", field, session="race")
        drives = []
        for start in [(900.0, 0.0, 0.0, 20.0), (4000.0, 0.0, 0.0, 0.0), (900.0, 0.0, 0.0, 20.0)]:
            engine.start_at(*start)
            engine.step(0.0, 0.5, 0.0, None, 200)
            drives.append([engine.read(car).x for car in range(len(field))])
        assert drives[0] == drives[2] != drives[1]

    def test_a_robot_is_pushed_back(self, game):
        """Its plan is a ring, whose index gets below zero where it begins."""
        field = [AGENT, ("inferno", 3)]
        engine = make_engine(game, "dirt-1", field, car="155-DTM", session="race")
        engine.start_at(0.0, 0.0, 0.0, 0.0)
        engine.step(0.0, 1.0, 0.0, -1, 900)
        assert engine.read(1).distance_raced < -100.0


class TestRefusals:
    @pytest.mark.parametrize(
        ("robots", "laps", "message"),
        [
            ([], 1, "no robot is named; name at least one"),
            ([("inferno", slot) for slot in range(21)], 1, "21 cars are named; a grid .* for 20"),
            ([("inferno", 3)], 0, "laps is 0; expected a whole number from 1 to 1073741824"),
            ([("inferno", 3)], 1 << 31, "laps is 2147483648"),
            ([("inferno", 3)] * 2, 1, "robot 'inferno:3' is named twice; name each robot once"),
            ([("inferno", 3)], 1.5, "laps is 1.5"),
            ([("inferno", 3)], True, "laps is True"),
        ],
    )
    def test_a_race_that_is_none(self, robots, laps, message):
        with pytest.raises(InvalidOption, match=message):
            race(robots, "aalborg", laps, session="race" if len(robots) > 1 else "practice")

    def test_a_session_that_is_none(self, game):
        with pytest.raises(
            InvalidOption, match="session is 'rally'; expected 'practice' or 'race'"
        ):
            race([("inferno", 3)], "aalborg", 1, session="rally")

    @pytest.mark.parametrize(
        ("robot", "message"),
        [
            (("infenro", 3), "no robot 'infenro'; did you mean 'inferno'"),
            (("inferno", 99), "robot 'inferno' has no index 99; it has 1, 2"),
            (("human", 1), "no robot 'human'"),
        ],
    )
    def test_a_robot_that_is_none(self, game, robot, message):
        with pytest.raises(UnknownRobot, match=message):
            race([robot], "aalborg", 1)

    def test_a_track_that_is_none(self, game):
        with pytest.raises(TrackNotFound, match="no track 'aalbrog'; did you mean 'aalborg'"):
            race([("inferno", 3)], "aalbrog", 1)

    @pytest.mark.parametrize("name", ["inferno:", "inferno:x", "inferno:-1", "inferno:3:4", "bt:²"])
    def test_the_name_of_an_opponent_has_a_form(self, game, name):
        with pytest.raises(InvalidOption, match="expected NAME or NAME:INDEX"):
            game.parse_robot(name)
