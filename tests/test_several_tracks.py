"""A list of tracks: each episode is on one of them, drawn from the seed."""

from __future__ import annotations

import pickle
from contextlib import closing, nullcontext

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

import sb3_torcs  # noqa: F401  # registers the ids
from sb3_torcs.backends import several
from sb3_torcs.backends.several import Turn, WorldPool
from sb3_torcs.errors import InvalidOption, TrackNotFound
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.vec_env import TorcsVecEnv

TRACKS = ("aalborg", "alpine-1", "g-track-1")
GAS = np.array([0.0, 1.0, 0.0], np.float32)


@pytest.fixture(params=["TorcsLite-v0", "Torcs-v0"])
def make(request):
    if request.param == "Torcs-v0":
        request.getfixturevalue("game")
    return lambda **options: gym.make(request.param, **{"track": TRACKS, **options}).unwrapped


def drive(env, seed, episodes=12):
    """Some episodes: where each was, and what was seen."""
    seen = []
    for number in range(episodes):
        observation, _ = env.reset(seed=seed if number == 0 else None)
        seen.append((env.track.name, env.car.distance_from_start, observation.tobytes()))
        seen += [(env.track.name, *env.step(GAS)[:2])[2:] for _ in range(3)]
    return seen


def test_every_track_has_its_turn_and_the_seed_says_which(make):
    env, other = make(start="random"), make(start="random")
    seen = drive(env, seed=5)
    assert {item[0] for item in seen if len(item) == 3} == set(TRACKS)
    assert drive(other, seed=5) == seen
    assert drive(env, seed=5) == seen, "what was driven before must not matter"
    assert drive(env, seed=6) != seen


def test_a_refused_reset_leaves_the_episode_and_what_is_drawn_next(make):
    drives = []
    for refused in (False, True):
        env = make()
        env.reset(seed=0)
        if refused:
            with pytest.raises(InvalidOption, match="speeed"):
                env.reset(options={"speeed": 1.0})
        seen = [env.step(GAS)[0], env.reset()[0]]
        drives.append((env.unwrapped.backend.track.name, np.array(seen).tobytes()))
    assert drives[0] == drives[1]


def test_a_start_is_anywhere_on_the_track_that_was_drawn(make):
    """Not within the length of the track of the episode before."""
    env = make(track=["alpine-1", "g-track-1"], start="random")
    env.reset(seed=0)
    farthest = {}
    for _ in range(60):
        env.reset()
        name, distance = env.track.name, env.car.distance_from_start
        farthest[name] = max(farthest.get(name, 0.0), distance)
    for name, distance in farthest.items():
        assert distance > 0.85 * load_track(name).length


def test_an_episode_is_what_it_is_on_that_track_alone(make):
    env = make()
    env.reset(seed=1)
    alone = make(track=env.track.name)
    alone.reset(seed=1)
    for _ in range(20):
        one, two = env.step(GAS), alone.step(GAS)
        np.testing.assert_array_equal(one[0], two[0])
        assert one[1:4] == two[1:4]


def test_a_pickled_one_goes_on_where_it_was(make):
    env = make(start="random")
    env.reset(seed=3)
    env.step(GAS)
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(6):
        np.testing.assert_array_equal(env.step(GAS)[0], copy.step(GAS)[0])
        assert env.reset()[0].tobytes() == copy.reset()[0].tobytes()
        assert env.track.name == copy.track.name


def test_processes_take_it(make):
    kwargs = {"track": TRACKS, "start": "random"}
    env_id = f"sb3_torcs:{make().spec.id}"
    envs = make_vec_env(env_id, 2, seed=0, env_kwargs=kwargs, vec_env_cls=SubprocVecEnv)
    assert envs.reset().shape == (2, 29)
    envs.close()


def test_an_id_may_name_its_package_as_in_gym_make():
    with closing(TorcsVecEnv(2, env_id="sb3_torcs:TorcsLite-v0", track=TRACKS)) as envs:
        assert envs.get_attr("spec")[0].id == "TorcsLite-v0"


def test_what_cannot_be_is_told(make):
    with pytest.raises(InvalidOption, match="empty list"):
        make(track=[])
    with pytest.raises(TrackNotFound, match="aalborg"):
        make(track=["aalborg", "alborg"])


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize("options", [{"backend": "scr"}, {"picture": "game"}])
def test_what_has_one_track_refuses_a_list(options):
    with pytest.raises(InvalidOption, match="one track"):
        gym.make("Torcs-v0", track=TRACKS, **options)
    with pytest.raises(InvalidOption, match="one car"):
        gym.make("Torcs-v0", car=["car1-trb1"], **options)


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize("options", [{"track": TRACKS}, {"opponents": ("ppo-any-road",)}])
def test_each_mode_that_is_offered_can_be_made(options):
    """Gymnasium's check makes one of each; the game's picture shows one track and one agent."""
    env = gym.make("Torcs-v0", **options).unwrapped
    assert env.metadata["render_modes"] == ["rgb_array", "human"]
    check_env(env)
    env.close()


@pytest.mark.usefixtures("game")
def test_every_car_has_its_turn_on_every_track():
    env = gym.make("Torcs-v0", track=["aalborg", "dirt-1"], car=["car1-trb1", "baja-bug"]).unwrapped
    seen = []
    for number in range(40):
        env.reset(seed=0 if number == 0 else None)
        seen.append((env.track.name, env.backend.car))
    assert len(set(seen)) == 4
    again = gym.make("Torcs-v0", track="dirt-1", car="baja-bug").unwrapped
    again.reset()
    while (env.track.name, env.backend.car) != ("dirt-1", "baja-bug"):
        env.reset()
    assert env.step(GAS)[0].tobytes() == again.step(GAS)[0].tobytes()


@pytest.mark.usefixtures("game")
def test_a_list_of_cars_may_not_be_empty():
    with pytest.raises(InvalidOption, match="car is an empty list"):
        gym.make("Torcs-v0", car=[])


class Loaded:
    """A world that a pool has loaded."""

    def __init__(self, name, everything):
        self.name, self.closed = name, False
        everything.append(self)

    def close(self):
        assert not self.closed, "closed twice"
        self.closed = True


class TestWorldPool:
    def test_a_world_is_loaded_when_there_is_no_spare_one(self):
        everything = []
        pool = WorldPool([lambda: Loaded("a", everything), lambda: Loaded("b", everything)])
        assert [world.name for world in pool.examples] == ["a", "b"]
        first, second = pool.take(0), pool.take(0)
        assert first is pool.examples[0]
        assert second is not first
        assert [world.name for world in everything] == ["a", "b", "a"]
        pool.give_back(0, first)
        assert pool.take(0) is first
        assert len(everything) == 3

    def test_the_last_user_closes_all(self):
        everything = []
        pool = WorldPool([lambda: Loaded("a", everything), lambda: Loaded("b", everything)])
        taken = []
        for choice in (0, 0, 1):
            pool.join()
            taken.append((choice, pool.take(choice)))
        for choice, world in taken:
            assert not any(world.closed for world in everything)
            pool.give_back(choice, world)
            pool.leave()
        assert all(world.closed for world in everything)

    def test_who_gets_no_world_is_not_waited_for(self):
        everything, fails = [], []

        def load():
            if fails:
                raise MemoryError
            return Loaded("a", everything)

        pool = WorldPool([load])
        first = Turn(pool)
        fails.append(True)
        with pytest.raises(MemoryError):
            Turn(pool)
        first.close()
        assert [world.closed for world in everything] == [True]

    def test_what_was_loaded_before_a_wrong_choice_is_closed(self):
        everything = []
        with pytest.raises(ZeroDivisionError):
            WorldPool([lambda: Loaded("a", everything), lambda: 1 // 0])
        assert [world.closed for world in everything] == [True]


class TestRacesAtOnce:
    """Races of one vector environment share their worlds, which nobody can tell."""

    RACES = 12

    @pytest.fixture(params=["TorcsLite-v0", "Torcs-v0"])
    def functions(self, request):
        """Make functions that make the environments; each has a grip of its own."""
        if request.param == "Torcs-v0":
            request.getfixturevalue("game")
        env_id = f"sb3_torcs:{request.param}"

        def make(grip):
            return gym.make(
                env_id, track=TRACKS, start="random", conditions={"grip": grip}, max_episode_steps=4
            )

        grips = [1.0, 0.6, [0.5, 0.9]] * (self.RACES // 3)
        return [lambda grip=grip: make(grip) for grip in grips]

    @pytest.mark.parametrize("threads", [1, 2])
    def test_what_another_race_left_does_not_matter(self, functions, threads):
        alone, together = DummyVecEnv(functions), TorcsVecEnv(functions, threads=threads)
        drives = []
        for envs in (alone, together):
            envs.seed(0)
            drive = [envs.reset().tobytes()]
            for _ in range(40):
                observations, rewards, dones, _ = envs.step(np.stack([GAS] * self.RACES))
                drive.append((observations.tobytes(), rewards.tobytes(), dones.tobytes()))
            drives.append(drive)
            envs.close()
        assert drives[0] == drives[1]

    @pytest.mark.usefixtures("game")
    def test_a_field_that_raced_before_does_not_matter(self, monkeypatch):
        """Robots, damage and places are those of a field that was loaded for this race alone."""
        options = {
            "track": ["aalborg", "g-track-1"], "opponents": [["bt", "tita"], ["inferno"]],
            "action": "pedal", "max_episode_steps": [60, 100],
        }  # fmt: skip
        drives = []
        for share in (True, False):
            if not share:
                monkeypatch.setattr("sb3_torcs.vec_env.torcs.shared_worlds", nullcontext)
            envs = TorcsVecEnv(4, agents=2, threads=2, **options)
            envs.seed(0)
            drive = [envs.reset().tobytes()]
            for step in range(250):
                actions = np.tile(np.float32([0.02 * (step % 3 - 1), 1.0]), (8, 1))
                observations, rewards, dones, infos = envs.step(actions)
                cars = [np.hstack(info["car"]).tobytes() for info in infos]
                drive.append((observations.tobytes(), rewards.tobytes(), dones.tobytes(), cars))
            drives.append(drive)
            envs.close()
        assert drives[0] == drives[1]

    @pytest.mark.usefixtures("game")
    def test_an_option_that_cannot_be_pickled_is_told_as_any_other_wrong_one(self):
        with pytest.raises(InvalidOption, match="range_finders"):
            TorcsVecEnv(2, track=TRACKS, range_finders=lambda: "narrow")

    @pytest.mark.parametrize("made_by", ["number", "functions"])
    @pytest.mark.usefixtures("game")
    def test_few_worlds_are_loaded(self, monkeypatch, made_by):
        pools = []

        class Watched(WorldPool):
            def __init__(self, makers):
                super().__init__(makers)
                self.loaded = list(self.examples)
                pools.append(self)

            def take(self, choice):
                world = super().take(choice)
                self.loaded += [world] if world not in self.loaded else []
                return world

        monkeypatch.setattr(several, "WorldPool", Watched)
        options = {"track": TRACKS, "max_episode_steps": 2}
        if made_by == "number":
            envs = TorcsVecEnv(self.RACES, **options)
        else:
            env_id = "sb3_torcs:Torcs-v0"
            envs = make_vec_env(env_id, self.RACES, env_kwargs=options, vec_env_cls=TorcsVecEnv)
        envs.seed(0)
        envs.reset()
        for _ in range(60):
            envs.step(np.stack([GAS] * self.RACES))
        (pool,) = pools
        assert self.RACES <= len(pool.loaded) < 3 * self.RACES
        envs.close()
        for world in pool.loaded:
            with pytest.raises(Exception, match="close"):
                world.engine.read(0)
