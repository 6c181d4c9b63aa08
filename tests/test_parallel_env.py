"""A race as PettingZoo's Parallel API has it."""

from __future__ import annotations

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

import sb3_torcs
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.errors import CarLost, EnvClosed, InvalidAction, InvalidOption

TRACK = "g-track-1"
GAS, TURN = np.float32([0.0, 1.0, 0.0]), np.float32([1.0, 1.0, 0.0])


@pytest.fixture(autouse=True)
def _game(game):
    """Nothing here works without it."""


@pytest.fixture
def make():
    """Make races, and close them afterwards."""
    made = []

    def make(agents=3, **options):
        made.append(sb3_torcs.parallel_env(agents=agents, **{"track": TRACK, **options}))
        return made[-1]

    yield make
    for env in made:
        env.close()


def drive(env, seed=0, steps=120):
    """Press at random, and note everything."""
    rng = np.random.default_rng(seed)
    notes = [repr(env.reset(seed=seed))]
    for _ in range(steps):
        if not env.agents:
            break
        asked = {name: rng.uniform([-0.3, 0.2, 0], [0.3, 1, 0]) for name in env.agents}
        notes.append(repr(env.step(asked)))
    return notes


def test_pettingzoo_s_own_tests_pass(make):
    parallel_api_test(make(opponents=["bt"], laps=1), num_cycles=60)
    parallel_seed_test(make, num_cycles=30)


def test_the_same_seed_and_actions_give_the_same_race(make):
    env = make(opponents=["bt"], sensors=("base", "rivals", "race"), start="random")
    assert drive(env) == drive(env) == drive(make(opponents=["bt"], start="random",
                                                  sensors=("base", "rivals", "race")))  # fmt: skip
    assert drive(env, 1) != drive(env)


def test_who_ends_leaves_and_the_others_race_on(make):
    env = make()
    env.reset(seed=0)
    while len(env.agents) == 3:
        actions = {name: TURN if name == "agent_0" else GAS for name in env.agents}
        observations, _, terminations, _, infos = env.step(actions)
    assert terminations == {"agent_0": True, "agent_1": False, "agent_2": False}
    assert infos["agent_0"]["end"] == "off_track"
    assert set(observations) == set(env.possible_agents), "its last observation is given"
    *answers, infos = env.step({name: GAS for name in env.agents})
    assert all(set(part) == {"agent_1", "agent_2"} for part in answers)
    while env.agents:
        env.step({name: TURN for name in env.agents})
    with pytest.raises(EnvClosed, match="after the race"):
        env.step({})
    assert set(env.reset(seed=0)[0]) == set(env.possible_agents)


def test_after_the_winner_all_finish_when_they_cross_the_line(make):
    """The agent has driven fewer laps than the robot, and no more are asked for."""
    env = make(1, opponents=["inferno"], laps=3, max_episode_steps=None)
    driver = ScriptedDriver()
    seen, _ = env.reset(seed=0)
    while env.agents:
        seen, _, _, truncations, infos = env.step({"agent_0": driver.predict(seen["agent_0"])[0]})
    info = infos["agent_0"]
    assert (info["end"], truncations["agent_0"]) == ("laps", True)
    assert info["laps"] <= 3
    assert info["place"] == 2


def test_info_tells_the_race(make):
    env = make(2)
    _, infos = env.reset(seed=0)
    assert [infos[name]["place"] for name in env.agents] == [1, 2]
    first, second = infos["agent_0"], infos["agent_1"]
    assert first["gap_behind"] == second["gap_ahead"] == pytest.approx(10.0, abs=0.1)
    assert (first["contacts"], first["faults"]) == (0, 0)


def test_a_time_limit_truncates_all(make):
    env = make(max_episode_steps=3)
    env.reset(seed=0)
    for _ in range(3):
        _, _, terminations, truncations, _ = env.step({name: GAS for name in env.agents})
    assert (any(terminations.values()), all(truncations.values()), env.agents) == (False, True, [])


def test_who_ends_is_seen_by_those_who_end_with_it(make):
    """Each car is on the road in the last observation of the others."""
    env = make(3, max_episode_steps=3, sensors=("base", "rivals"))
    env.reset(seed=0)
    for _ in range(3):
        *_, infos = env.step({name: GAS for name in env.possible_agents})
    assert env.agents == []
    nearest = [infos[name]["car"].opponents.min() for name in env.possible_agents]
    assert max(nearest) < 20.0


def test_a_race_that_is_lost_ends_for_all(make, monkeypatch):
    env = make(2)
    env.reset(seed=0)

    fleet = env._batch._fleet

    class Losing:
        def __getattr__(self, name):
            return getattr(fleet, name)

        def step(self, *order):
            return [0, 1]

        def failure(self, place):
            return CarLost("the car is nowhere")

    with monkeypatch.context() as patch:
        patch.setattr(env._batch, "_fleet", Losing())
        _, _, terminations, _, infos = env.step({name: GAS for name in env.agents})
    assert all(terminations.values())
    assert {info["end"] for info in infos.values()} == {"lost"}
    env.reset(seed=0)
    env.step({name: GAS for name in env.agents})


def test_a_refused_reset_leaves_the_race_as_it_is(make):
    env = make(2)
    env.reset(seed=0)
    env.agents.remove("agent_0")
    for options, message in (
        ({"speed": 1000.0}, "speed is 1000"),
        ({"spede": 20.0}, "unknown reset option 'spede'; allowed: distance"),
        (3, "options of reset is 3; expected a dict"),
    ):
        with pytest.raises(InvalidOption, match=message):
            env.reset(options=options)
    assert env.agents == ["agent_1"]
    env.step({"agent_1": GAS})


def test_after_a_reset_that_the_game_refuses_there_is_no_race(make):
    """Walls stand where the car should start."""
    env = make(2, track="e-track-3")
    env.reset(seed=0)
    with pytest.raises(InvalidOption, match="start"):
        env.reset(options={"distance": 0.0, "track_position": -1.0})
    assert env.agents == []
    with pytest.raises(EnvClosed, match="call reset first"):
        env.step({"agent_0": GAS, "agent_1": GAS})
    env.reset()
    env.step({name: GAS for name in env.agents})


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({"agent_0": GAS}, "no action of agent_1"),
        (None, "no action of agent_0, agent_1"),
        ({"agent_0": GAS, "agent_1": GAS * np.nan}, "agent_1: steering is nan"),
    ],
)
def test_a_wrong_action_drives_nobody(make, actions, message):
    env, untouched = make(2), make(2)
    for one in (env, untouched):
        one.reset(seed=0)
    with pytest.raises(InvalidAction, match=message):
        env.step(actions)
    both = {"agent_0": GAS, "agent_1": GAS}
    assert repr(env.step(both)) == repr(untouched.step(both))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"agents": 30}, "agents is 30, with 0 opponents"),
        ({"max_episode_steps": 0}, "max_episode_steps is 0.*or None for no limit"),
        ({"opponents": "bt"}, "opponents is 'bt'; expected a list"),
        ({"opponents": None}, "opponents is None; expected a list"),
        ({"flagged": "x"}, "flagged is 'x'; expected True or False"),
        ({"conditions": {"sensor_noise": 0.01}}, "sensor_noise is 0.01; expected True or False"),
        ({"picture": "game"}, "picture is .* for a race of one agent"),
        ({"backend": "scr"}, "backend is 'scr', which is for a race of one agent"),
        ({"render_mode": "rgb_array"}, "render_mode is for Torcs-v0"),
    ],
)
def test_a_wrong_option_is_told(make, options, message):
    with pytest.raises(InvalidOption, match=message):
        make(**options)


def test_closing_twice_does_no_harm(make):
    env = make(2)
    env.close()
    env.close()
    with pytest.raises(EnvClosed, match=r"step after close; .*with parallel_env"):
        env.step({})
    with pytest.raises(EnvClosed, match=r"reset after close; .*with parallel_env"):
        env.reset()


@pytest.mark.parametrize("seed", ["a", -1, 1.5, True])
def test_a_wrong_seed_is_told_and_the_race_goes_on(make, seed):
    env = make(2)
    env.reset(seed=np.int64(0))
    with pytest.raises(InvalidOption, match=f"seed is {seed!r}; expected a whole number >= 0"):
        env.reset(seed=seed)
    env.step({name: GAS for name in env.agents})
