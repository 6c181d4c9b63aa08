"""The loop: what ends an episode, what info holds, what reset does."""

from __future__ import annotations

import math
import warnings
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from conftest import ScriptedBackend

from sb3_torcs.car import Controls, Start
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.envs.starts import Starts
from sb3_torcs.errors import CarLost, EnvClosed, InvalidAction, InvalidOption, StartBlocked
from sb3_torcs.rewards import TERMS, safe_speed

GAS = np.array([0.0, 1.0, 0.0], np.float32)


def begun(track, *states, **options):
    """An environment whose first episode has begun."""
    env = RacingEnv(ScriptedBackend(track, *states), **options)
    env.reset(seed=0)
    return env


def run(track, *states, **options):
    """Reset, then one step per given state; return the last step's answer."""
    env = begun(track, *states, **options)
    return [env.step(GAS) for _ in states][-1]


@pytest.mark.parametrize(
    ("state", "end"),
    [
        ({"distance_from_axis": 5.01}, "off_track"),
        ({"distance_from_axis": -5.01}, "off_track"),
        ({"heading_error": 1.6}, "backwards"),
        ({"damage": 10000.0}, "damage"),
    ],
)
def test_a_crash_terminates_and_says_why(oval, state, end):
    _, _, terminated, truncated, info = run(oval, state)
    assert (terminated, truncated, info["end"]) == (True, False, end)
    assert info["reward_terms"]["crash"] == -1.0


def test_the_laps_asked_for_truncate(oval):
    _, _, terminated, truncated, info = run(oval, {"laps": 2, "last_lap_time": 80.0}, laps=2)
    assert (terminated, truncated, info["end"], info["lap_time"]) == (False, True, "laps", 80.0)
    assert info["reward_terms"]["crash"] == 0.0


def test_the_edge_of_the_road_is_still_on_it(oval):
    _, _, terminated, _, info = run(oval, {"distance_from_axis": 5.0})
    assert not terminated
    assert not info["off_track"]


@pytest.mark.parametrize(("axis", "end"), [(7.0, ""), (-7.0, ""), (7.01, "off_track")])
def test_a_car_may_be_beside_the_road_where_there_is_runoff(oval, axis, end):
    _, _, terminated, _, info = run(oval, {"distance_from_axis": axis}, ends={"runoff": 2.0})
    assert (terminated, info["end"]) == (end != "", end)
    assert info["off_track"]


RECOVERY = {"ends": {"recovery": 4.0}}
BACK = {"heading_error": math.pi, "speed_x": -10.0}  # the right way along the road, backwards


@pytest.mark.parametrize(
    ("first", "then", "options", "steps"),
    [
        ([{"speed_x": 20.0}], {"heading_error": 3.0}, RECOVERY, 42),
        ([{"speed_x": 20.0}], {"speed_x": 1.0}, RECOVERY, 42),
        ([], BACK, RECOVERY, 41),
        ([], {"speed_x": 0.0}, {}, 31),  # 3.0 s of 0.1 s timesteps may pass
        ([{"speed_x": 20.0}], {"speed_x": 1.0}, {}, 17),  # 1.5 s after the one fast timestep
    ],
)
def test_who_makes_no_headway_is_stuck_after_a_time(oval, first, then, options, steps):
    env = begun(oval, *first, *[then] * 50, **options)
    answers = [env.step(GAS) for _ in range(steps)]
    assert [answer[2] for answer in answers] == [False] * (steps - 1) + [True]
    assert answers[-1][4]["end"] == "stuck"


def test_lap_time_is_0_unless_a_lap_was_just_completed(oval):
    first = {"laps": 1, "last_lap_time": 70.5, "best_lap_time": 70.5}
    env = begun(oval, first, first)
    assert env.step(GAS)[4]["lap_time"] == 70.5
    info = env.step(GAS)[4]
    assert info["lap_time"] == 0.0
    assert info["best_lap_time"] == 70.5


@pytest.mark.parametrize("reward", ["progress", dict.fromkeys([*TERMS, "crash"], -1.0)])
def test_a_car_that_is_lost_ends_the_episode_only(oval, reward):
    """Where the timestep before has left it, as a crash; the next episode is like any other."""

    class Losing(ScriptedBackend):
        def step(self, controls, ticks):
            raise CarLost("the car is nowhere")

    env = RacingEnv(Losing(oval), reward=reward)
    before, _ = env.reset(seed=0)
    observation, _, terminated, truncated, info = env.step(GAS)
    assert observation.tolist() == before.tolist()
    assert (terminated, truncated, info["end"]) == (True, False, "lost")
    assert info["reward_terms"]["crash"] == -1.0
    assert env.reset()[0].tolist() == before.tolist()


def test_controls_are_held_for_the_action_repeat(oval):
    env = begun(oval, action_repeat=7)
    env.step(np.array([0.5, 2.0, -1.0], np.float32))
    assert env.backend.calls[-1] == ("step", Controls(0.5, 1.0, 0.0), 7)


def test_numbers_of_numpy_are_numbers(oval):
    env = RacingEnv(ScriptedBackend(oval), action_repeat=np.int64(3), laps=np.int32(2))
    place = {"distance": np.int64(100), "speed": np.float32(20.0), "track_position": 0.5}
    env.reset(options=place)
    assert env.backend.calls[-1] == ("reset", Start(100.0, 0.5, 0.0, 20.0))


def test_random_starts_are_on_the_road_and_follow_the_seed(oval):
    def starts(seed):
        env = RacingEnv(ScriptedBackend(oval), start="random")
        env.reset(seed=seed)
        for _ in range(50):
            env.reset()
        return [call[1] for call in env.backend.calls]

    assert starts(1) == starts(1)
    assert starts(1) != starts(2)
    moving = [start for start in starts(1) if start is not None]
    assert 30 < len(moving) < 51  # some are on the grid
    for start in moving:
        assert 0.0 <= start.distance < oval.length
        assert abs(start.track_position) < 1.0
        assert start.speed >= 0.0


def test_setting_the_start_returns_the_one_before(oval):
    env = RacingEnv(ScriptedBackend(oval))
    assert env.set_start("random") == "grid"
    env.reset(seed=0)
    for _ in range(5):
        env.reset()
    assert any(call[1] is not None for call in env.backend.calls)


def test_random_starts_are_as_fast_as_asked(oval):
    env = RacingEnv(ScriptedBackend(oval), start="random")
    assert env.set_random_speed(90.0) == 40.0
    env.reset(seed=0)
    for _ in range(50):
        env.reset()
    speeds = [call[1].speed for call in env.backend.calls if call[1] is not None]
    assert 80.0 < max(speeds) <= 90.0
    with pytest.raises(InvalidOption, match="expected 0 to 150 m/s"):
        env.set_random_speed(-1.0)


def test_hard_starts_lie_before_places_where_episodes_ended_badly(oval):
    """At most at a speed that can be lost on the way there."""
    left = {"distance_from_axis": 6.0, "distance_from_start": 120.0}
    env = RacingEnv(ScriptedBackend(oval, left), start="random")
    env.set_random_speed(90.0)
    assert env.set_hard_starts(1.0) == 0.0
    env.reset(seed=0)
    assert env.step(GAS)[2]
    before = len(env.backend.calls)
    for _ in range(50):
        env.reset()
    moving = [call[1] for call in env.backend.calls[before:] if call[1] is not None]
    assert 30 < len(moving) < 51  # some are on the grid
    for start in moving:
        ahead = (120.0 - start.distance) % oval.length
        assert 20.0 <= ahead <= 300.0
        assert start.speed <= safe_speed(ahead)
    for share in (-0.1, 1.1, float("nan"), "half"):
        with pytest.raises(InvalidOption, match="expected 0 to 1"):
            env.set_hard_starts(share)


def test_an_episode_whose_drawn_place_is_a_wall_begins_on_the_grid(oval):
    """A training does not end of it; who asked for the place is told."""

    class Walled(ScriptedBackend):
        def reset(self, rng, start):
            if start is not None:
                raise StartBlocked("agent would stand in a wall")
            return super().reset(rng, start)

    env = RacingEnv(Walled(oval), start="random")
    env.reset(seed=0)
    for _ in range(5):
        env.reset()
    assert env.backend.calls == [("reset", None)] * 6
    with pytest.raises(InvalidOption, match="in a wall"):
        env.reset(options={"distance": 5.0})


def test_without_hard_starts_mishaps_change_no_start(oval):
    """To the bit: no random number is drawn for them."""
    drawn = []
    for mishaps in (0, 3):
        starts = Starts("random")
        for _ in range(mishaps):
            starts.remember(oval, 120.0)
        rng = np.random.default_rng(0)
        drawn.append([starts.draw(rng, oval) for _ in range(20)])
    assert drawn[0] == drawn[1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"action_repeat": 0}, "action_repeat is 0; expected a whole number from 1 to 50000"),
        ({"action_repeat": 1 << 31}, "action_repeat is 2147483648"),
        ({"laps": 0}, "laps is 0"),
        ({"laps": True}, "laps is True"),
        ({"ends": {"runoff": -1.0}}, "runoff is -1.0; expected a number of metres from 0 to 100"),
        ({"ends": {"runoff": "wide"}}, "runoff is 'wide'"),
        ({"ends": {"recovery": -1.0}}, "recovery is -1.0; expected a number of seconds from 0"),
        ({"ends": {"recovery": "long"}}, "recovery is 'long'"),
        ({"ends": {"runof": 1.0}}, "ends has no key 'runof'; did you mean 'runoff'"),
        ({"ends": 8.0}, "ends is 8.0; expected a dict with any of runoff, recovery"),
        ({"start": "pits"}, "start is 'pits'; expected 'grid' or 'random'"),
        ({"start": "gird"}, "start is 'gird'; did you mean 'grid'"),
        ({"render_mode": "ansi"}, "render_mode is 'ansi'"),
    ],
)
def test_a_bad_option_says_what_is_allowed(oval, options, message):
    with pytest.raises(InvalidOption, match=message):
        RacingEnv(ScriptedBackend(oval), **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"place": 3.0}, "unknown reset option 'place'"),
        (["distance"], "options of reset is .* expected a dict"),
        (np.array([1, 2]), "options of reset is .* expected a dict"),
        ({"speed": math.nan}, "reset option speed is nan"),
        ({"speed": -1.0}, "expected 0 to 150"),
        ({"speed": 5000.0}, "speed is 5000 m/s; expected 0 to 150"),
        ({"heading_error": 1e300}, "expected -pi to pi"),
        ({"speed": True}, "expected a number"),
        ({"track_position": 2.0}, "expected -1"),
    ],
)
def test_a_bad_reset_option_says_what_is_allowed(oval, options, message):
    with pytest.raises(InvalidOption, match=message):
        RacingEnv(ScriptedBackend(oval)).reset(options=options)


def test_a_place_just_before_the_line_is_on_the_lap():
    """Rounding would put it a whole lap further on, where the world begins to count elsewhere."""
    with gym.make("sb3_torcs:TorcsLite-v0") as env:
        cars = []
        for distance in (0.0, -1e-14):
            env.reset(seed=0, options={"distance": distance, "speed": 20.0})
            cars.append(env.unwrapped.car)
    assert cars[0].laps == cars[1].laps
    assert cars[0].distance_from_start == cars[1].distance_from_start


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([np.nan, 0.0, 0.0], "steering is nan"),
        ([0.0, np.nan, 0.0], "throttle is nan"),
        ([0.0, 0.0, np.nan], "brake is nan"),
        ([0.0, 0.0], r"shape \(2,\), expected \(3,\)"),
        (["a", "b", "c"], "expected three numbers"),
    ],
)
def test_what_is_no_action_is_told(oval, action, message):
    env = begun(oval)
    with pytest.raises(InvalidAction, match=message):
        env.step(np.array(action))


def test_after_a_reset_that_failed_there_is_no_step(oval, monkeypatch):
    env = begun(oval)

    def reset(rng, start):
        raise InvalidOption("start elsewhere")

    monkeypatch.setattr(env.backend, "reset", reset)
    with pytest.raises(InvalidOption, match="start elsewhere"):
        env.reset(options={"distance": 10.0})
    with pytest.raises(EnvClosed, match="call reset first"):
        env.step(GAS)


def test_a_wrong_option_of_a_reset_leaves_the_episode_as_it_is(oval):
    env = begun(oval)
    before = env.np_random.bit_generator.state
    with pytest.raises(InvalidOption, match="unknown reset option 'speeed'"):
        env.reset(seed=1, options={"speeed": 1.0})
    assert env.np_random.bit_generator.state == before
    env.step(GAS)


def test_a_window_that_fails_to_close_does_not_keep_the_world_open(oval):
    env = RacingEnv(ScriptedBackend(oval))
    env._viewer = SimpleNamespace(close=lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        env.close()
    assert env.backend.closed == 1


def test_a_timestep_after_the_end_warns_once(oval):
    """But not one from a moment before it, to which somebody has gone back."""
    lost, fine = {"distance_from_axis": 20.0}, {}
    env = begun(oval, lost, fine, lost, lost, lost)
    assert [env.step(GAS)[2] for _ in range(3)] == [True, False, True]
    with pytest.warns(UserWarning, match="step after the end of an episode"):
        assert env.step(GAS)[2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert env.step(GAS)[2]


def test_whoever_means_to_drive_on_is_not_warned(oval):
    lost = {"distance_from_axis": 20.0}
    env = RacingEnv(ScriptedBackend(oval, lost, lost))
    env.warns_after_end = False
    env.reset(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [env.step(GAS)[2] for _ in range(2)] == [True, True]


def test_an_environment_out_of_use_says_what_to_do(oval):
    env = RacingEnv(ScriptedBackend(oval))
    with pytest.raises(EnvClosed, match="call reset first"):
        env.step(GAS)
    env.close()
    env.close()
    assert env.backend.closed == 1
    with pytest.raises(EnvClosed, match="after close"):
        env.reset()
    with pytest.raises(EnvClosed, match="after close"):
        env.step(GAS)
