"""Many agents in one race: the engine drives them at once, and each has its own episodes."""

from __future__ import annotations

import itertools
import math
import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, PPO

from sb3_torcs.actions import controls_from_action
from sb3_torcs.agents import driver_record
from sb3_torcs.agents.saved.writing import RecordCallback
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.backends.native import NativeFleet, make_engine
from sb3_torcs.backends.seats import REJOIN_SPEED
from sb3_torcs.car import CAR_RECORD, CONTROL_TICK, RIVALS
from sb3_torcs.envs.batch import Replay
from sb3_torcs.envs.parallel_env import parallel_env
from sb3_torcs.envs.torcs_race import load_shared_race, make_race
from sb3_torcs.errors import CarLost, InvalidAction, InvalidOption
from sb3_torcs.evaluation.ticks import log_drives
from sb3_torcs.policies.mirror import mirror_image, mirror_observations
from sb3_torcs.sensors import View, encode, feature_slices
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.vec_env import JoinedVecEnv, TorcsVecEnv

pytestmark = pytest.mark.usefixtures("game")

TRACK = "g-track-1"
TWO = [("bt", 2), ("", 0), ("inferno", 3), ("", 1)]
GAS, TURN = [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]


@pytest.fixture
def race():
    """Load races, and close them afterwards."""
    made = []

    def load(entries=TWO, **options):
        made.append(make_engine(find_game(), TRACK, entries, session="race", **options))
        made[-1].start()
        return made[-1]

    yield load
    for engine in made:
        engine.close()


@pytest.fixture
def begun(make):
    """Make vector environments whose races have begun."""

    def begin(*args, seed=0, **options):
        envs = make(*args, **options)
        envs.seed(seed)
        envs.reset()
        return envs

    return begin


@pytest.fixture
def make():
    """Make vector environments, and close them afterwards."""
    made = []

    def make(*args, **options):
        made.append(TorcsVecEnv(*args, **{"track": TRACK, **options}))
        return made[-1]

    yield make
    for envs in made:
        envs.close()


def seen(engine, cars=4):
    """Everything that can be read of a race, to the bit."""
    return [np.hstack(engine.read(car)).tobytes() for car in range(cars)]


def hold(engine, controls):
    for car, row in zip(engine.agents, controls, strict=True):
        engine.hold(car, *row)


def random_controls(ticks, agents=2):
    rng = np.random.default_rng(0)
    return [
        [(*rng.uniform([-0.2, 0.3, 0.0], [0.2, 1.0, 0.1]), None) for _ in range(agents)]
        for _ in range(ticks)
    ]


def drive(engine, controls):
    """Hold controls for a tick each; return what was seen after each."""
    answers = []
    for row in controls:
        hold(engine, row)
        engine.drive(1)
        answers.append(seen(engine))
    return answers


class TestEngine:
    def test_recorded_controls_give_the_recorded_race(self, race):
        """With the gears, too, which gearboxes chose the first time."""
        first = race()
        controls, recorded = random_controls(300), []
        repeated = []
        for row in controls:
            hold(first, row)
            first.drive(1)
            recorded.append(seen(first))
            gears = [first.controls(car)[3] for car in first.agents]
            repeated.append([(*asked[:3], gear) for asked, gear in zip(row, gears, strict=True)])
        assert {gear for row in repeated for *_, gear in row} >= {1, 2}
        assert drive(race(), repeated) == recorded

    def test_a_fleet_drives_all_agents_of_a_race_as_one_by_one(self, race):
        one, other = race(), race()
        controls = random_controls(60)
        states = np.empty((2, CAR_RECORD.itemsize // 8))
        grid = [_Seat(other, car) for car in other.agents]
        fleet = NativeFleet(grid, threads=2)
        for row in controls:
            hold(one, row)
            one.drive(5)
            asked = np.array([[*numbers[:3], np.nan, 0.0] for numbers in row])
            assert fleet.step(np.arange(2), asked, np.full(2, 5), states) == []
            found = [states[agent].tobytes() for agent in range(2)]
            assert found == [seen(one)[car] for car in one.agents]

    def test_agents_have_a_car_and_a_gearbox_each(self, race):
        cars = {"car": ["car1-trb1", "baja-bug"], "gearbox": ["road_speed", "automatic"]}
        engine = race([("", 0), ("", 1)], **cars)
        assert [engine.car_name(car) for car in engine.agents] == ["car1-trb1", "baja-bug"]
        hold(engine, [(0.0, 1.0, 0.0, None)] * 2)
        engine.drive(10)
        clutches = [engine.controls(car)[4] for car in engine.agents]
        assert clutches[0] > 0.0 == clutches[1]

    def test_a_snapshot_holds_what_agents_hold_and_who_has_left(self, race):
        engine = race()
        drive(engine, random_controls(100))
        engine.retire(1)
        engine.rejoin(3, 0.2, 0.0, 15.0)
        moment = engine.save()
        after = drive(engine, random_controls(50))
        engine.rejoin(1, 0.0, 0.0, 30.0)
        engine.restore(moment)
        assert drive(engine, random_controls(50)) == after

    def test_no_one_is_flagged_off_unless_asked(self, race):
        """In a race that is flagged, the others are when they cross the line after the winner."""
        for flagged in (False, True):
            engine = race([("", 0), ("bt", 2)], laps=1, flagged=flagged)
            while engine.read(1).laps < 2 and not engine.finished(1):
                hold(engine, [(0.0, 0.0, 1.0, None)])
                engine.drive(50)
            assert (engine.finished(1), engine.finished(0)) == (flagged, False)


class _Seat:
    """What a fleet has to know of a car."""

    def __init__(self, engine, seat):
        self.engine, self.seat = engine, seat


class TestLeavingAndRejoining:
    def test_nobody_sees_or_hits_a_car_that_has_retired(self, race):
        """The car behind drives straight through where it stands."""
        engine = race([("", 0), ("", 1)])
        hold(engine, [(0.0, 0.0, 1.0, None), (0.0, 0.5, 0.0, None)])
        engine.drive(5)
        assert engine.read(1).opponents.min() < 20.0
        before = seen(engine, 1)
        engine.retire(0)
        assert engine.read(1).opponents.min() == 200.0
        hold(engine, [(0.0, 1.0, 0.0, None), (0.1, 0.5, 0.0, None)])
        engine.drive(300)
        assert engine.read(0).distance_raced == np.frombuffer(before[0])[13]
        assert (engine.read(1).damage, engine.read(1).race_position) == (0.0, 1)
        engine.retire(0)  # a second time changes nothing

    def test_it_is_in_the_middle_of_the_longest_free_stretch(self, race):
        engine = race()
        drive(engine, random_controls(400))
        others = sorted(engine.read(car).distance_from_start for car in (0, 1, 2))
        length = engine.track_summary()["length"]
        engine.rejoin(3, 0.25, 0.1, 12.0)
        car = engine.read(3)
        gaps = np.diff([*others, others[0] + length])
        middle = others[int(gaps.argmax())] + 0.5 * gaps.max()
        assert car.distance_from_start == pytest.approx(middle % length, abs=0.01)  # floats
        assert car.track_position == pytest.approx(0.25, abs=1e-4)
        assert car.heading_error == pytest.approx(0.1, abs=1e-4)
        assert (car.speed_x, car.damage, car.laps, car.last_lap_time) == (12.0, 0.0, 0, 0.0)
        assert (car.distance_raced, car.race_position, car.fuel) == (0.0, 4, 94.0)

    def test_the_others_race_on_as_if_nothing_had_happened(self, race):
        """But for the standings, and what they see."""
        engine = race()
        drive(engine, random_controls(100))
        before = [engine.read(car)[:13] for car in (0, 1, 2)]
        engine.rejoin(3, 0.0, 0.0, 20.0)
        assert [engine.read(car)[:13] for car in (0, 1, 2)] == before

    @pytest.mark.parametrize("speed", [0.0, 20.0, 60.0])
    def test_it_stands_on_its_springs_and_drives_off(self, race, speed):
        engine = race()
        drive(engine, random_controls(50))
        rest = engine.read(3).height
        for _ in range(20):
            engine.rejoin(3, 0.0, 0.0, speed)
            begin = engine.read(3)
            for _ in range(10):
                engine.hold(3, 0.0, 0.5, 0.0, None)
                engine.drive(1)
                car = engine.read(3)
                assert abs(car.height - rest) < 0.1  # [m] wings press it down
                assert abs(car.speed_x - begin.speed_x) < 3.0  # [m/s] no gear brakes it
        assert car.damage == 0.0
        assert car.distance_raced == pytest.approx(10 * CONTROL_TICK * speed, rel=0.1, abs=0.1)

    def test_its_laps_begin_anew(self, race):
        engine = race([("", 0)], laps=5)
        engine.start_at(engine.track_summary()["length"] - 100.0, 0.0, 0.0, 50.0)
        while engine.read(0).laps < 1:
            engine.rejoin(0, 0.0, 0.0, 50.0) if engine.read(0).off_track else None
            step_of_script(engine)
        engine.rejoin(0, 0.0, 0.0, 20.0)
        assert (engine.read(0).laps, engine.laps(0)) == (0, [])

    def test_who_was_too_slow_is_let_back(self, race):
        """The rules take out a car whose lap takes longer than a stop and its length at 10 m/s."""
        engine = race([("", 0)])
        hold(engine, [(0.0, 0.0, 1.0, None)])
        engine.drive(int((90.0 + engine.track_summary()["length"] / 10.0) / CONTROL_TICK))
        (out,) = (result[-1] for result in engine.results())
        engine.rejoin(0, 0.0, 0.0, 20.0)
        hold(engine, [(0.0, 0.3, 0.0, None)])
        engine.drive(50)
        (back,) = (result[-1] for result in engine.results())
        assert (out, back) == (True, False)
        assert engine.read(0).distance_raced > 10.0


def step_of_script(engine):
    action, _ = ScriptedDriver().predict(encode(engine.read(0)))
    engine.hold(0, *controls_from_action(action))
    engine.drive(5)


class TestMistakes:
    @pytest.mark.parametrize("entries", [[("", 1)], [("", 0), ("", 2)], [("", -1)], [("", 0)] * 2])
    def test_agents_are_numbered_from_zero(self, race, entries):
        with pytest.raises(InvalidOption, match=r"expected one driver or more|named twice|no car"):
            race(entries)

    @pytest.mark.parametrize("call", ["hold", "rejoin"])
    def test_a_robot_drives_itself(self, race, call):
        numbers = (0.0, 0.0, 0.0, None) if call == "hold" else (0.0, 0.0, 0.0)
        with pytest.raises(InvalidOption, match="car 0 is a robot's"):
            getattr(race(), call)(0, *numbers)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"conditions": {"delay": 3}}, "delay is 3, which is for a race of one agent"),
            ({"opponents": ["infermo"]}, "infermo"),
            ({"opponents": ["ddpg-aalborg"], "action_repeat": 3}, "is 3, .* were trained with 5"),
        ],
    )
    def test_what_races_of_many_agents_cannot_do(self, options, message):
        with pytest.raises(InvalidOption, match=message):
            make_race(2, **options)

    def test_more_cars_than_grid_slots(self):
        with pytest.raises(InvalidOption, match=r"agents is 19, with 2 opponents; .* 20 cars"):
            load_shared_race(TRACK, "car1-trb1", agents=19, opponents=["bt", "inferno"])

    @pytest.mark.parametrize("agents", [0, -1, 1.5, True, None])
    def test_no_number_of_agents(self, agents):
        with pytest.raises(InvalidOption, match="agents is"):
            TorcsVecEnv(1, agents)

    @pytest.mark.parametrize(
        "option",
        [
            {"backend": "scr"}, {"scr": {"host": "localhost"}}, {"conditions": {"grip": 0.9}},
            {"conditions": {"mass": (0.9, 1.1)}}, {"picture": "game"}, {"picture": {"view": "tv"}},
        ],
    )  # fmt: skip
    def test_options_of_a_race_of_one_agent(self, option):
        (name,) = option.get("conditions", option)
        with pytest.raises(InvalidOption, match=f"{name} is .*, which is for a race of one agent"):
            TorcsVecEnv(1, 2, **option)

    def test_no_option_at_all(self):
        with pytest.raises(TypeError, match="'oponents'; did you mean 'opponents'"):
            make_race(2, oponents=["bt"])

    def test_their_usual_values_are_no_mistake(self, make):
        usual = {"picture": "above", "backend": "native", "scr": {"host": None}}
        assert make(1, 2, conditions={"grip": 1.0, "mass": 1.0}, **usual).num_envs == 2

    def test_worlds_with_one_car(self):
        with pytest.raises(InvalidOption, match=r"TorcsLite-v0 has one car in each race"):
            TorcsVecEnv(1, 2, env_id="TorcsLite-v0")
        with pytest.raises(InvalidOption, match=r"flagged is True, .* sb3_torcs\.parallel_env"):
            TorcsVecEnv(agents=2, laps=1, flagged=True)
        with pytest.raises(InvalidOption, match="flagged is True"):
            TorcsVecEnv([partial(next, iter(make_race(2, laps=1, flagged=True)))] * 2)
        with pytest.raises(InvalidOption, match="environments of one; give the number of races"):
            TorcsVecEnv([lambda: gym.make("Torcs-v0")], 2)

    def test_one_car_alone_cannot_be_driven_or_copied(self, begun):
        envs = begun(1, 2)
        env = envs.envs[0]
        with pytest.raises(InvalidOption, match="2 agents of this race drive at once"):
            env.step(np.array(GAS, np.float32))
        with pytest.raises(InvalidOption, match="cannot be copied"):
            pickle.dumps(env.unwrapped)

    def test_a_wrong_start_leaves_all_races(self, make):
        """Who leaves the road ends its own episode, as if nobody had asked for a reset."""
        envs = make(1, 3)
        envs.reset()
        envs.set_options({"distance": "x"})
        with pytest.raises(InvalidOption, match="distance"):
            envs.reset()
        envs.set_options([{}])
        with pytest.raises(InvalidOption, match="a list of 1 for 3 environments; give one dict"):
            envs.reset()
        with pytest.raises(InvalidOption, match="seed is 'x'"):
            envs.seed("x")
        envs.set_options()
        dones = np.zeros(3, np.bool_)
        while not dones.any():
            *_, dones, infos = envs.step(np.array([TURN, GAS, GAS], np.float32))
        assert [info.get("end") for info in infos] == ["off_track", "", ""]

    def test_no_number_drives_nobody(self, begun):
        envs = begun(1, 3)
        before = [car.time for car in envs.get_attr("car")]
        with pytest.raises(InvalidAction, match="environment 1: steering is nan"):
            envs.step(np.array([GAS, [np.nan, 0.0, 0.0], GAS], np.float32))
        assert [car.time for car in envs.get_attr("car")] == before
        envs.step(np.array([GAS] * 3, np.float32))

    def test_the_order_of_the_cars_changes_nothing(self, game):
        """Who drives into the grass is the second of the list, then the first."""

        def ends(order):
            envs = make_race(2, track="aalborg")
            cars = TorcsVecEnv([lambda env=envs[seat]: env for seat in order], threads=1)
            cars.seed(0)
            cars.reset()
            actions = np.array([[[1.0, 1.0, 0.0], [0.0, 0.2, 0.0]][seat] for seat in order])
            found = []
            for timestep in range(60):
                _, _, dones, infos = cars.step(actions)
                found += [
                    (timestep, seat, info["end"])
                    for seat, done, info in zip(order, dones, infos, strict=True)
                    if done
                ]
            cars.close()
            return sorted(found)

        assert ends([0, 1]) == ends([1, 0])

    def test_cars_of_one_race_are_beside_each_other_in_the_list(self, game):
        one, two = make_race(2, track=TRACK), make_race(2, track=TRACK)
        mixed = [lambda env=env: env for env in (one[0], two[0], one[1], two[1])]
        with pytest.raises(InvalidOption, match="list the agents of each race one after the other"):
            TorcsVecEnv(mixed, threads=1)


def by_hand(agents, actions, **options):
    """What a vector environment is held to: each car asked and valued alone, until one ends."""
    envs = make_race(agents, track=TRACK, **options)
    observations = [[env.reset(seed=seed)[0] for seed, env in enumerate(envs)]]
    engine = envs[0].backend.world.engine
    rewards, ended = [], False
    for row in actions:
        for env, action in zip(envs, row, strict=True):
            env.hold(action)
        engine.drive(5)
        answers = []
        for env, action in zip(envs, row, strict=True):
            seat = env.backend
            env.backend = Replay(seat, seat.read())
            answers.append(env.step(action))
            env.backend = seat
        rewards.append([np.float32(answer[1]) for answer in answers])
        ended = any(answer[2] or answer[3] for answer in answers)
        if ended:
            break
        observations.append([answer[0] for answer in answers])
    for env in envs:
        env.close()
    assert ended, "no episode ended: little was compared"
    return observations, rewards


def random_actions(steps, cars):
    rng = np.random.default_rng(5)
    low, high = [-0.3, 0.2, 0.0], [0.3, 1.0, 0.2]
    return [rng.uniform(low, high, (cars, 3)).astype(np.float32) for _ in range(steps)]


class TestVectorEnvironment:
    @pytest.mark.parametrize("options", [{}, {"opponents": ["bt"], "start": "random"}])
    def test_it_is_each_car_driven_by_hand(self, make, options):
        actions = random_actions(200, 3)
        observations, rewards = by_hand(3, actions, **options)
        envs = make(1, 3, **options)
        envs.seed(0)
        assert np.array_equal(envs.reset(), observations[0])
        for step, action in enumerate(actions[: len(rewards)]):
            found = envs.step(action)
            assert np.array_equal(found[1], rewards[step]), f"step {step}"
            if step + 1 < len(observations):
                assert np.array_equal(found[0], observations[step + 1]), f"step {step}"

    def test_threads_change_nothing(self, make):
        answers = []
        for threads in (1, 2):
            envs = make(2, 3, threads=threads, opponents=["bt"], conditions={"sensor_noise": True})
            envs.seed(1)
            digest = [envs.reset().tobytes()]
            for action in random_actions(150, 6):
                observations, rewards, dones, _ = envs.step(action)
                digest += [observations.tobytes(), rewards.tobytes(), dones.tobytes()]
            answers.append(digest)
        assert answers[0] == answers[1]

    def test_a_car_whose_episode_ends_rejoins_and_the_others_race_on(self, begun):
        envs = begun(1, 3)
        dones = np.zeros(3, bool)
        while not dones.any():
            before = envs.get_attr("car")
            _, _, dones, infos = envs.step(np.array([TURN, GAS, GAS], np.float32))
        assert dones.tolist() == [True, False, False]
        first, *others = envs.get_attr("car")
        assert infos[0]["end"] == "off_track"
        assert infos[0]["terminal_observation"].shape == (29,)
        assert (first.distance_raced, first.speed_x) == (0.0, REJOIN_SPEED)
        assert [car.time for car in others] == [first.time] * 2
        assert all(car.time > was.time for car, was in zip(others, before[1:], strict=True))

    def test_all_cars_of_a_race_end_before_one_begins_anew(self, begun):
        """The next race may be on another road, and the last observation is of this one."""
        envs = begun(1, 2, track=["aalborg", "wheel-2"], sensors=["base", "preview"])
        for _ in range(6):
            dones = np.zeros(2, bool)
            while not dones.all():
                tracks = [env.unwrapped.track.name for env in envs.envs]
                before = [dict(env.unwrapped.mishaps()) for env in envs.envs]
                _, _, dones, infos = envs.step(np.array([GAS, GAS], np.float32))
                for i in np.flatnonzero(dones):
                    mishaps = envs.envs[i].unwrapped.mishaps()
                    grown = [name for name in mishaps if mishaps[name] != before[i].get(name)]
                    assert grown in ([tracks[i]], []), infos[i]["end"]

    def test_a_race_is_over_when_all_have_ended_what_they_began_it_with(self, make):
        """Who has rejoined is truncated then, and the next race begins on the grid for all."""
        envs = make(1, 3)
        envs.seed(0)
        on_grid = envs.reset()
        ends = []
        for step in range(400):
            late = TURN if step > 60 else GAS
            observations, _, dones, infos = envs.step(np.array([TURN, late, late], np.float32))
            ends += [(i, infos[i]["end"]) for i in np.flatnonzero(dones)]
            if dones.all():
                break
        assert {i for i, end in ends if end == "off_track"} >= {1, 2}
        assert ends[-3][1] == "race" or ends[-1][1] != "race"
        truncated = [infos[i]["TimeLimit.truncated"] for i in range(3)]
        assert truncated == [infos[i]["end"] == "race" for i in range(3)]
        assert any(truncated)
        assert np.array_equal(observations, on_grid)

    def test_a_time_limit_ends_an_episode_like_any_other(self, make):
        usual = make(1, 2, max_episode_steps=None)  # of Torcs-v0, as in gym.make
        assert usual.get_attr("_max_episode_steps") == [3000, 3000]
        envs = make(1, 2, max_episode_steps=7)
        envs.reset()
        for step in range(1, 15):
            _, _, dones, infos = envs.step(np.array([GAS] * 2, np.float32))
            assert dones.tolist() == [step % 7 == 0] * 2
        assert [info["TimeLimit.truncated"] for info in infos] == [True, True]
        assert [info["episode"]["l"] for info in infos] == [7, 7]

    def test_a_field_may_be_empty_wherever_it_stands(self, begun):
        for fields in ([[], ["bt"]], [["bt"], []]):
            envs = begun(1, 2, opponents=fields, max_episode_steps=1)
            places = set()
            for _ in range(12):
                places.add(envs.get_attr("car")[0].race_position)
                envs.step(np.array([GAS] * 2, np.float32))
            assert places == {1, 2}  # behind nobody, or behind the robot

    def test_tracks_fields_and_grid_slots_are_drawn_for_each_race(self, begun):
        envs = begun(
            1, 2, track=[TRACK, "aalborg"], opponents=[["bt"], ["inferno", "berniw"]],
            grid_place=[1, 2], max_episode_steps=1,
        )  # fmt: skip
        drawn = set()
        for _ in range(40):
            first, second = (env.unwrapped.backend for env in envs.envs)
            assert first.world.engine is second.world.engine
            drawn.add((first.track.name, envs.get_attr("car")[0].race_position))
            envs.step(np.array([GAS] * 2, np.float32))
        assert drawn == {(track, place) for track in (TRACK, "aalborg") for place in (1, 2)}

    def test_a_race_that_is_lost_ends_for_its_cars_only(self, begun):
        envs = begun(2, 2)
        fleet = envs._batch._fleet

        class Losing:
            close, put = fleet.close, fleet.put

            def step(self, races, controls, ticks, cars):
                fleet.step(races, controls, ticks, cars)
                return [0, 1]

            def failure(self, race):
                return CarLost("the car is nowhere")

        envs._batch._fleet = Losing()
        _, _, dones, infos = envs.step(np.array([GAS] * 4, np.float32))
        envs._batch._fleet = fleet
        assert dones.tolist() == [True, True, False, False]
        assert [info["end"] for info in infos] == ["lost", "lost", "", ""]
        envs.step(np.array([GAS] * 4, np.float32))

    @pytest.mark.parametrize("kind", [PPO, DDPG])
    def test_stock_algorithms_learn_from_all_cars(self, make, kind):
        envs = make(2, 2, start="random", max_episode_steps=50)
        options = {"n_steps": 32, "batch_size": 32} if kind is PPO else {"learning_starts": 64}
        model = kind("MlpPolicy", envs, seed=0, device="cpu", **options)
        model.learn(256)
        assert model.num_timesteps == 256
        assert all(np.isfinite(p.detach().numpy()).all() for p in model.policy.parameters())

    def test_a_model_records_how_its_cars_were_made(self, make, tmp_path):
        envs = make(1, 2, track="g-track-1", action="pedal", max_episode_steps=50)
        both = JoinedVecEnv([envs, make(1, 2, track="g-track-1", action="pedal")])
        for number, learned in enumerate([envs, both]):
            model = PPO("MlpPolicy", learned, n_steps=16, batch_size=32, device="cpu")
            model.learn(16 * learned.num_envs, callback=RecordCallback())
            model.save(tmp_path / f"{number}.zip")
            record = driver_record(tmp_path / f"{number}.zip")
            assert record.env_id == "Torcs-v0"
            assert record.env_kwargs["track"] == "g-track-1"
            assert record.env_kwargs["action"] == "pedal"


class TestSensorsOfARace:
    """Held to what is read of each car alone."""

    @pytest.fixture
    def field(self, race):
        engine = race([("bt", 2), ("inferno", 3), ("", 0), ("", 1), ("", 2), ("", 3)], laps=3)
        for controls in random_controls(250, agents=4):
            hold(engine, controls)
            engine.drive(1)
        return [engine.read(car) for car in range(6)], engine.track_summary()["length"]

    def test_rivals_are_the_nearest_along_the_road(self, field):
        cars, length = field
        for car in cars:
            ahead = {
                math.remainder(other.distance_from_start - car.distance_from_start, length): other
                for other in cars
                if other is not car
            }
            nearest = sorted(ahead, key=abs)[:RIVALS]
            along, across, speed_along, _, long, wide = car.race[5:].reshape(6, RIVALS)
            assert along == pytest.approx(nearest, abs=1e-3)  # the game's floats
            others = [ahead[place] for place in nearest]
            beside = [other.distance_from_axis - car.distance_from_axis for other in others]
            assert across == pytest.approx(beside)
            assert speed_along == pytest.approx(
                [speed_on(other) - speed_on(car) for other in others],
                abs=0.01,  # it rolls, too
            )
            assert (long > 4.0).all()
            assert (wide > 1.5).all()

    def test_the_race_is_told_as_it_stands(self, field):
        cars, _ = field
        order = sorted(cars, key=lambda car: car.race_position)
        assert [car.race_position for car in order] == [1, 2, 3, 4, 5, 6]
        assert order[0].gap_ahead == order[-1].gap_behind == 200.0
        for first, second in itertools.pairwise(order):
            assert first.gap_behind == second.gap_ahead > 0.0
        assert {car.laps_left for car in cars} == {3.0}

    def test_who_is_alone_has_no_rival(self, race, make):
        car = race([("", 0)]).read(0)
        assert car.race[5:].reshape(6, RIVALS).tolist() == [[200.0] * RIVALS, *[[0.0] * RIVALS] * 5]
        assert (make(1, 1, sensors=("base", "rivals")).reset()[0, 29:] == 0.0).all()

    def test_who_hits_another_with_the_front_is_at_fault(self, race):
        """The second agent drives into the first, which stands on its brake in front of it."""
        engine = race([("", 0), ("", 1)])
        engine.start_at(300.0, engine.read(1).track_position, 0.0, 0.0)
        ahead, behind = engine.read(0), engine.read(1)
        for _ in range(300):
            if behind.contacts:
                break
            hold(engine, [(0.0, 0.0, 1.0, None), (0.5 * behind.heading_error, 0.5, 0.0, None)])
            engine.drive(1)
            ahead, behind = engine.read(0), engine.read(1)
        assert (ahead.contacts, ahead.faults) == (1.0, 0.0)
        assert (behind.contacts, behind.faults) == (1.0, 1.0)

    def test_an_agent_sees_what_it_is_asked_to_show(self, make):
        sensors = ("base", "opponents", "rivals", "race")
        envs = make(1, 3, sensors=sensors, opponents=["bt"])
        envs.seed(0)
        seen = envs.reset()
        where = feature_slices(sensors)
        for _ in range(30):
            for row, car in zip(seen, envs.get_attr("car"), strict=True):
                assert row[where["opponents"]] == pytest.approx(car.opponents / 200.0)
                along, across, speed_along = car.race[5:].reshape(6, RIVALS)[:3]
                clarity = np.clip(1.0 - np.abs(along) / 80.0, 0.0, 1.0)
                for name, shown in (
                    ("along", along / (10.0 + np.abs(along))),
                    ("across", across / (3.0 + np.abs(across))),
                    ("speed_along", np.clip(speed_along / 10.0, -6.0, 6.0)),
                ):
                    seen_as = pytest.approx(clarity * shown, abs=1e-6)
                    assert row[where[f"rivals_{name}"]] == seen_as
                assert row[where["race_position"]] == pytest.approx(car.race_position / 20.0)
            assert envs.observation_space.contains(seen[0])
            seen = envs.step(np.array([GAS] * 3, np.float32))[0]

    @pytest.mark.parametrize("sensors", [("base", "rivals"), ("base", "race")])
    def test_a_world_without_races_cannot_tell_of_one(self, sensors):
        with pytest.raises(InvalidOption, match="this world does not tell of other cars"):
            gym.make("TorcsLite-v0", sensors=sensors)

    def test_in_the_mirror_who_was_left_is_right(self):
        """Places along the road stay, places across it change their sign."""
        sensors = ("base", "opponents", "rivals")
        where = feature_slices(sensors)
        row = th.arange(29.0 + 36 + 6 * RIVALS)[None]
        image = mirror_observations(row, mirror_image(View(sensors)))[0]
        assert image[where["opponents"]].tolist() == row[0][where["opponents"]].tolist()[::-1]
        for name, sign in (("rivals_along", 1.0), ("rivals_across", -1.0)):
            assert (image[where[name]] == sign * row[0][where[name]]).all()


def speed_on(car):
    return car.speed_x * math.cos(car.heading_error) + car.speed_y * math.sin(car.heading_error)


class TestAgentsAsOpponents:
    def test_they_drive_as_they_were_trained(self, begun):
        """Off the grid in the first seconds, while the other agent stands on its brake."""
        envs = begun(1, 1, opponents=["ddpg-aalborg"], grid_place=2, track="aalborg")
        (backend,) = envs.get_attr("seat")
        engine = backend.world.engine
        for _ in range(28):
            envs.step(np.array([[0.0, 0.0, 1.0]], np.float32))
        opponent = engine.read(0)
        assert (opponent.off_track, opponent.damage) == (False, 0.0)
        assert opponent.distance_raced > 10.0
        assert engine.read(1).race_position == 2

    def test_they_race_beside_robots_and_several_agents_and_again_after_a_reset(self, make):
        envs = make(1, 2, opponents=["bt", "scripted"])
        seen = []
        for _ in range(2):
            envs.seed(0)
            digest = [envs.reset().tobytes()]
            digest += [envs.step(action)[0].tobytes() for action in random_actions(40, 2)]
            engine = envs.envs[0].unwrapped.backend.world.engine
            seen.append((digest, [np.hstack(engine.read(car)).tobytes() for car in range(4)]))
        assert seen[0] == seen[1]

    def test_one_environment_against_them_is_a_vector_of_one(self, make):
        """To the bit; also as one of a vector, and where each control tick is noted."""
        kwargs = {"track": TRACK, "opponents": ["bt", "scripted"], "grid_place": 2}
        alone, noted = (gym.make("sb3_torcs:Torcs-v0", **kwargs) for _ in range(2))
        log = log_drives(noted, "x")
        own = TorcsVecEnv([lambda: gym.make("sb3_torcs:Torcs-v0", **kwargs)])
        vectors = make(1, **kwargs), own
        for _ in range(2):
            for vector in vectors:
                vector.seed(0)
            seen = [env.reset(seed=0)[0] for env in (alone, noted)]
            seen += [vector.reset()[0] for vector in vectors]
            for action in random_actions(20, 1):
                assert all(np.array_equal(seen[0], other) for other in seen[1:])
                seen = [env.step(action[0])[0] for env in (alone, noted)]
                seen += [vector.step(action)[0][0] for vector in vectors]
        opponent = alone.unwrapped.backend.world.engine.read(2)
        assert opponent.distance_raced > 1.0, "the agent behind has set off, too"
        assert len(log.frame()) == 2 * 20 * 5
        for env in (alone, noted, own):
            env.close()

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"action_repeat": 2}, "action_repeat is 2, .* were trained with 5"),
            ({"conditions": {"grip": 0.9}}, "grip is .* which this world cannot change"),
            ({"picture": "game", "render_mode": "rgb_array"}, "'scripted' is an agent"),
            ({"opponents": ["infermo"]}, "no driver 'infermo'; did you mean 'inferno'"),
            ({"opponents": ["inferno"] * 20}, "opponents has 20 names; expected at most 19"),
        ],
    )
    def test_what_one_environment_against_them_cannot_do(self, options, message):
        with pytest.raises(InvalidOption, match=message):
            gym.make("sb3_torcs:Torcs-v0", **{"opponents": ["scripted"], **options})

    def test_they_race_in_a_vector_of_gymnasium(self):
        """To the bit as against each alone, across the ends of episodes."""
        kwargs = {"track": TRACK, "opponents": ["bt", "scripted"], "max_episode_steps": 15}
        kinds = [
            gym.make_vec("sb3_torcs:Torcs-v0", 2, vectorization_mode=mode, **kwargs)
            for mode in (None, "sync")
        ]
        seen = [envs.reset(seed=0)[0] for envs in kinds]
        for action in random_actions(40, 2):
            assert np.array_equal(*seen)
            seen = [envs.step(action)[0] for envs in kinds]
        for envs in kinds:
            envs.close()

    def test_they_race_in_a_parallel_environment(self):
        env = parallel_env(2, track=TRACK, opponents=["scripted"])
        env.reset(seed=0)
        for action in random_actions(20, 2):
            *_, infos = env.step(dict(zip(env.agents, action, strict=True)))
        assert {infos[name]["place"] for name in env.possible_agents} < {1, 2, 3}
        assert env._envs["agent_0"].seat.world.engine.read(0).distance_raced > 1.0
        env.close()
