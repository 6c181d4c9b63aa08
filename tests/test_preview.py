"""The road ahead as numbers: what they are, and that everybody sees the same."""

from __future__ import annotations

import contextlib
from itertools import chain, combinations

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import ScriptedBackend, car_state
from gymnasium.spaces import Box
from stable_baselines3 import DDPG
from vectors import assert_they_see_the_same, both_kinds

import sb3_torcs  # noqa: F401  # registers the ids
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.callbacks.replay import MirrorCallback
from sb3_torcs.envs.batch import Batch
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import InvalidOption
from sb3_torcs.evaluation.protocol import race_environment
from sb3_torcs.policies.mirror import mirror_image, mirror_observations, sensors_of
from sb3_torcs.sensors import GROUPS, View, choices_of_size, feature_slices
from sb3_torcs.tracks.profile import road_profile
from sb3_torcs.tracks.track import Segment, Track
from sb3_torcs.tracks.view_ahead import DISTANCES, INTERVALS, look_ahead, speed_margins

BOTH = ("base", "preview")
BENDS, WIDTHS, SLOPES = list(feature_slices(BOTH).values())[-3:]


@pytest.fixture(params=["TorcsLite-v0", "Torcs-v0"])
def env_id(request):
    if request.param == "Torcs-v0":
        request.getfixturevalue("game")
    return request.param


def flat(lengths, curvatures, widths, climbs):
    """A road of usual asphalt without banking."""
    rows = (lengths, curvatures, widths, climbs, [1.1] * len(lengths), [0.0] * len(lengths))
    return road_profile(*map(np.array, rows))


def ahead(profile, distance):
    """Mean curvatures, widths and slopes."""
    means = np.empty((3, INTERVALS))
    look_ahead(profile.sums, profile.step, distance, means)
    return means


def seen(track, distance):
    return View(BOTH).encode(car_state(distance_from_start=distance), ScriptedBackend(track))


# ------------------------------------------------------------------------------- what they are


def test_the_numbers_are_means_over_intervals_that_begin_at_the_car():
    """A kilometre: straight and wide, then a bend, then another one that climbs."""
    road = ([300.0, 500.0, 200.0], [0.0, 0.01, -0.02], [12.0, 8.0, 8.0], [0.0, 0.0, 10.0])
    curvature, width, slope = ahead(flat(*road), 235.0)
    assert np.allclose(curvature[:4], 0.0, atol=1e-15)
    assert curvature[4] == pytest.approx(0.01 * 15.0 / 20.0)  # 60 to 80 m ahead: 15 m of the bend
    assert np.allclose(curvature[5:], 0.01)
    assert width[4] == pytest.approx(12.0 - 4.0 * 15.0 / 20.0)
    assert np.allclose(width[:4], 12.0)
    assert np.allclose(slope, 0.0)
    assert np.allclose(ahead(flat(*road), 800.0)[2, :9], 0.05)


def test_widths_are_told_as_differences(oval):
    """From 12 m to 8 m: 4 m less, of which 10 m are 1."""
    wide = oval.segments[0]._replace(width_start=12.0, width_end=12.0)
    narrow = [s._replace(width_start=8.0, width_end=8.0) for s in oval.segments[1:]]
    track = Track("narrowing", "oval", (wide, *narrow), grid=oval.grid)
    widths = seen(track, 250.0)[WIDTHS]
    assert np.allclose(widths[:3], 0.0)
    assert np.allclose(widths[4:], -0.4)


def test_the_view_goes_on_across_the_start_line(oval):
    """Also if the road is shorter than the view is far."""
    whole = oval.length
    assert np.allclose(ahead(oval.profile, whole - 1e-9), ahead(oval.profile, 0.0))
    lap = flat([90.0], [2.0 * np.pi / 90.0], [10.0], [0.0])
    assert np.allclose(ahead(lap, 45.0)[0], 2.0 * np.pi / 90.0)


def test_a_bend_is_seen_by_its_radius(oval):
    """50 m to the left is 0.5."""
    observation = seen(oval, 301.0)
    assert np.allclose(observation[BENDS][:8], 0.5)
    assert np.allclose(observation[WIDTHS], 0.0)
    assert np.array_equal(observation[SLOPES], np.zeros(INTERVALS))


def test_the_numbers_change_smoothly_while_the_car_moves_on(oval):
    """By no more in 10 cm than a bend's share of the shortest interval."""
    rows = np.array([seen(oval, d)[29:] for d in np.arange(0.0, oval.length, 0.1)])
    assert np.abs(np.diff(rows, axis=0)).max() < 0.015


def test_the_game_has_hills_and_the_fallback_none(game):
    """What climbs comes down again, and the axis turns once around."""
    del game
    with contextlib.closing(gym.make("Torcs-v0", track="alpine-2", sensors=BOTH)) as env:
        observation, _ = env.reset(seed=0, options={"distance": 1000.0})
        profile = env.unwrapped.backend.profile
    assert np.abs(observation[SLOPES]).max() > 0.05
    assert profile.sums[-1, 2] == pytest.approx(0.0, abs=0.01)
    assert profile.sums[-1, 0] == pytest.approx(2.0 * np.pi, abs=1e-3)
    with contextlib.closing(gym.make("TorcsLite-v0", track="alpine-2", sensors=BOTH)) as env:
        flat, _ = env.reset(seed=0, options={"distance": 1000.0})
    assert not flat[SLOPES].any()
    np.testing.assert_allclose(flat[BENDS], observation[BENDS], atol=1e-3)


# ---------------------------------------------------------------------------- limits of speed


def margins(profile, distance, speed):
    numbers = np.empty(INTERVALS)
    speed_margins(profile.sums, profile.step, distance, speed, numbers)
    return numbers


def test_a_limit_is_a_speed_that_can_be_lost_before_the_bend():
    """300 m of straight, then a bend of 40 m, which is taken at the root of 15 times 40 m/s."""
    road = ([300.0, 300.0, 200.0], [0.0, 0.025, 0.0], [10.0] * 3, [0.0] * 3)
    profile = flat(*road)
    for distance in (150.0, 230.0, 277.0):
        free = [a < 300.0 - distance - 15.0 for a in DISTANCES[1:]]
        found = margins(profile, distance, 30.0)
        first = free.index(False)
        assert np.all(found[:first] == 70.0)  # of 100 m/s, which is no limit
        way = 300.0 - distance
        assert min(found) == pytest.approx(np.sqrt(600.0 + 20.0 * way) - 30.0, abs=2.5)
    in_bend = margins(profile, 400.0, 30.0)
    assert in_bend[0] == pytest.approx(np.sqrt(600.0) - 30.0)
    np.testing.assert_allclose(margins(profile, 400.0, 20.0), in_bend + 10.0)
    np.testing.assert_allclose(margins(profile, 150.0 + 800.0, 30.0), margins(profile, 150.0, 30.0))


def test_limits_are_seen_in_steps_of_20_metres_per_second(oval):
    """Clipped beyond 40 m/s."""
    state = car_state(distance_from_start=350.0, speed_x=20.0)
    sensors = ("base", "limits")
    shown = View(sensors).encode(state, ScriptedBackend(oval))[
        feature_slices(sensors)["speed_margins_ahead"]
    ]
    found = margins(oval.profile, 350.0, 20.0)
    np.testing.assert_array_equal(shown, np.clip(found / 20.0, -2.0, 2.0).astype(np.float32))
    assert shown[0] == pytest.approx((np.sqrt(15.0 * 50.0) - 20.0) / 20.0)


# -------------------------------------------------------------------------- everybody sees it so


def test_the_first_numbers_are_those_of_the_default(env_id):
    with gym.make(env_id) as plain, gym.make(env_id, sensors=BOTH) as more:
        assert more.observation_space.shape == (68,)
        driver, action = ScriptedDriver(), None
        for step in range(50):
            if action is None:
                one, other = plain.reset(seed=3)[0], more.reset(seed=3)[0]
            else:
                one, other = plain.step(action)[0], more.step(action)[0]
            assert one.tobytes() == other[:29].tobytes(), step
            assert more.observation_space.contains(other)
            action, _ = driver.predict(other)


@pytest.mark.parametrize("track", ["aalborg", ["alpine-1", "g-track-1"], "random"])
def test_races_driven_at_once_see_what_single_ones_see(env_id, track):
    """To the bit, across the ends of episodes; a random track has a new road each time."""
    if env_id == "Torcs-v0" and track == "random":
        track = ["wheel-1", "e-track-5"]
    options = {"track": track, "start": "random", "max_episode_steps": 12, "sensors": BOTH}
    with both_kinds(env_id, **options) as (ours, theirs):
        assert_they_see_the_same(ours, theirs)


@pytest.mark.usefixtures("game")
def test_a_vector_of_gymnasium_sees_the_same():
    options = {"sensors": BOTH, "start": "random"}
    together = gym.make_vec("Torcs-v0", num_envs=2, **options)
    alone = gym.make("Torcs-v0", **options)
    seen, _ = together.reset(seed=[4, 5])
    action = np.array([0.1, 1.0, 0.0], np.float32)
    expected, _ = alone.reset(seed=5)
    assert seen.shape == (2, 68)
    for _ in range(5):
        assert seen[1].tobytes() == expected.tobytes()
        seen, expected = together.step([action, action])[0], alone.step(action)[0]
    together.close()
    alone.close()


@pytest.mark.usefixtures("game")
def test_a_client_of_the_game_sees_the_same():
    """But for the six digits of the place that the server sends."""
    with (
        contextlib.closing(gym.make("Torcs-v0", track="alpine-2", sensors=BOTH)) as ours,
        contextlib.closing(
            gym.make("Torcs-v0", track="alpine-2", sensors=BOTH, backend="scr")
        ) as client,
    ):
        drives = []
        for env in (ours, client):
            rows = [env.reset(seed=0)[0]]
            rows += [env.step(np.array([0.0, 1.0, 0.0], np.float32))[0] for _ in range(10)]
            drives.append(np.array(rows))
    np.testing.assert_allclose(drives[0], drives[1], atol=1e-3)


def test_races_with_different_sensors_cannot_be_driven_at_once():
    envs = [gym.make("TorcsLite-v0", sensors=sensors) for sensors in (BOTH, ("base",))]
    with pytest.raises(InvalidOption, match="give all the same sensors"):
        Batch([env.unwrapped for env in envs])


# --------------------------------------------------------------------------- naming, mirror, file


@pytest.mark.parametrize(
    "choice", ["base", (), ("preview",), ("base", "previews"), ("base", "base"), 3, ["base", []]]
)
def test_other_sensors_are_refused(choice):
    with pytest.raises(InvalidOption, match=r"expected a list with 'base', and any of 'preview'"):
        gym.make("TorcsLite-v0", sensors=choice)


def test_a_mistyped_sensor_is_told_the_near_miss():
    with pytest.raises(InvalidOption, match=r"did you mean 'preview'\? expected a list"):
        gym.make("TorcsLite-v0", sensors=["base", "previev"])


def test_the_order_of_names_does_not_matter(oval):
    env = RacingEnv(ScriptedBackend(oval), sensors=["preview", "base"])
    assert env.sensors == BOTH


def test_each_choice_of_groups_has_a_space_of_its_own():
    """So a policy knows from the space of observations how to mirror them."""
    more = [name for name in GROUPS if name != "base"]
    for chosen in chain.from_iterable(combinations(more, n) for n in range(len(more) + 1)):
        view = View(("base", *chosen))
        assert sensors_of(view) == tuple(chain(*(GROUPS[name] for name in view.sensors)))
    assert choices_of_size(30) == ()
    assert sensors_of(Box(-1.0, 1.0, (30,))) == ()
    assert sensors_of(Box(-1.0, 1.0, (2, 29))) == ()


def test_only_its_bounds_tell_a_choice_from_another_of_its_size():
    """Where they are lost, none is guessed."""
    size = View(("base", "line", "car")).size
    assert len(choices_of_size(size)) > 1
    lost = Box(-10.0, 10.0, (size,))
    assert sensors_of(lost) == ()
    with pytest.raises(InvalidOption, match=rf"of shape \({size},\).*changes their bounds or size"):
        mirror_image(lost)


def test_the_road_ahead_of_a_mirrored_track_is_the_mirror_image(oval):
    """Bends change sides, widths and slopes stay."""

    def turned(segment):
        return segment._replace(curvature=-segment.curvature)

    image = Track("image", "oval", tuple(map(turned, oval.segments)), grid=oval.grid)
    assert isinstance(image.segments[0], Segment)
    there, here = (th.from_numpy(seen(track, 250.0)[None]) for track in (image, oval))
    assert mirror_observations(here, mirror_image(View(BOTH)))[0, 29:].equal(there[0, 29:])
    assert not here[0, BENDS].equal(there[0, BENDS])


def test_a_symmetric_policy_learns_from_mirrored_batches():
    """With all that the policy and the callback ask of the sensors."""
    with gym.make("TorcsLite-v0", sensors=BOTH, start="random") as env:
        small = {"net_arch": {"pi": [8], "qf": [8, 8]}, "symmetric": True}
        model = DDPG("SplitHeadPolicy", env, policy_kwargs=small, learning_starts=20, seed=0)
        model.learn(60, callback=MirrorCallback())
        observation = env.reset(seed=0)[0]
        action, _ = model.predict(observation, deterministic=True)
        image = mirror_image(env.observation_space)
        image = mirror_observations(th.from_numpy(observation[None]), image).numpy()[0]
        other, _ = model.predict(image, deterministic=True)
    np.testing.assert_allclose(other * [-1.0, 1.0, 1.0], action, atol=1e-6)


def test_an_evaluation_shows_what_was_learned_from():
    with race_environment("TorcsLite-v0", {"sensors": ["base", "preview"]}) as env:
        assert env.observation_space.shape == (68,)
