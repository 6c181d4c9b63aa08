"""``Torcs-v0`` over the SCR protocol: the same drive, and what happens when things break."""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import re
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from processes import PATIENCE, Program, gone, runs
from scr_loopback import Errant, Loopback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_torcs.actions import GEARBOXES
from sb3_torcs.agents.remote import Agent
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.backends import scr
from sb3_torcs.backends.native import NativeBackend
from sb3_torcs.backends.scr import ScrBackend
from sb3_torcs.car import Controls, Start
from sb3_torcs.errors import (
    CarFileError,
    EngineForked,
    GameFailed,
    InvalidOption,
    ServerLost,
    ServerNotFound,
    TrackNotFound,
    UnknownCar,
    UnknownRobot,
)
from sb3_torcs.scr.car_reader import UNKNOWN_ROAD, CarReader
from sb3_torcs.scr.gearbox import read_gearbox
from sb3_torcs.scr.protocol import RESTART, SHUTDOWN, ScrState, parse_state
from sb3_torcs.scr.server import open_ports, start_server
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.race_setup import RaceSetup
from sb3_torcs.tracks.catalogue import load_track

pytestmark = pytest.mark.usefixtures("game")

STRAIGHT_ON = Controls(0.0, 0.5, 0.0)
COMPARE = runpy.run_path(str(Path(__file__).parent.parent / "tools" / "compare_scr.py"))


def rng():
    return np.random.default_rng(0)


@contextlib.contextmanager
def both(track, **options):
    """The same world in the engine and over the protocol."""
    with contextlib.closing(NativeBackend(track, **options)) as native:
        with contextlib.closing(ScrBackend(track, **options)) as over_scr:
            yield native, over_scr


@contextlib.contextmanager
def driven(server, track="aalborg"):
    """A world whose server is somebody else's."""
    with contextlib.closing(ScrBackend(track, host=server.host, port=server.port)) as world:
        world.reset(rng(), None)
        yield world


@pytest.fixture
def backend():
    """A world of its own on a short track, with the game already there."""
    with contextlib.closing(ScrBackend("g-track-1")) as world:
        world.reset(rng(), None)
        yield world


# ---- The same drive ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("track", "start"), [("g-track-1", "grid"), ("dirt-1", Start(300.0, -0.4, 0.1, 25.0))]
)
def test_a_lap_is_that_of_the_engine(track, start):
    answer = COMPARE["compare"](track, ScriptedDriver(), None if start == "grid" else start)
    assert answer.timesteps > 300
    assert answer.laps[0]
    assert answer.equal


@pytest.mark.parametrize("model", ["scripted", "ppo-aalborg"])
def test_the_example_says_what_is_equal(monkeypatch, capsys, model):
    """Also for an agent that sees how fast the car turns, and leaves this road."""
    monkeypatch.setattr(sys, "argv", ["compare_scr.py", model, "--tracks", "g-track-1"])
    with pytest.raises(SystemExit) as ended:
        COMPARE["main"]()
    assert ended.value.code == 0
    assert "g-track-1  yes" in capsys.readouterr().out


@pytest.mark.parametrize("start", [None, Start(100.0, 0.3, -0.1, 30.0)])
def test_a_car_is_that_of_the_engine(start):
    controls = Controls(0.01, 0.9, 0.0)
    # The game's frame is up to a third of a metre beside the track's.
    tolerances = {"x": 0.4, "y": 0.4, "yaw": 1e-3}
    tolerances |= {"distance_from_start": 0.006, "distance_raced": 0.006}  # six digits
    with both("alpine-1") as worlds:
        cars = [world.reset(rng(), start) for world in worlds]
        for _ in range(60):
            one, other = (car._asdict() for car in cars)
            for name, tolerance in tolerances.items():
                assert other.pop(name) == pytest.approx(one.pop(name), abs=tolerance), name
            del one["race"]  # the server does not tell
            one["time"] = one["lap_time"]  # the engine's clock is one step ahead at the start
            for name, value in one.items():
                np.testing.assert_allclose(other[name], value, rtol=1e-5, atol=2e-5, err_msg=name)
            cars = [world.step(controls, 3) for world in worlds]


@pytest.mark.parametrize("gearbox", GEARBOXES)
@pytest.mark.parametrize("name", ["car1-trb1", "car1-ow1", "155-DTM", "p406"])
def test_the_gearbox_shifts_as_that_of_the_engine(name, gearbox):
    """Rear, all and front wheels are driven."""
    throttle = 0.8 if gearbox == "automatic" else 0.5  # car1-ow1 spins round in first gear
    gears = set()
    with both("michigan", car=name, gearbox=gearbox) as worlds:
        for world in worlds:
            world.reset(rng(), Start(100.0, 0.0, 0.0, 15.0))
        for tick in range(800):
            controls = Controls(0.0, throttle, 0.0) if tick < 600 else Controls(0.0, 0.0, 0.3)
            one, other = (world.step(controls, 1) for world in worlds)
            assert one.gear == other.gear, tick
            assert one.speed_x == pytest.approx(other.speed_x, rel=1e-4, abs=1e-4), tick
            gears.add(one.gear)
    assert len(gears) >= 3


def test_opponents_race_as_in_the_engine():
    seen = set()
    with both("aalborg", opponents=("inferno", "berniw"), grid_place=1, laps=2) as worlds:
        one, other = (world.reset(rng(), None) for world in worlds)
        for _ in range(100):
            np.testing.assert_allclose(one.opponents, other.opponents, rtol=1e-5)
            assert one.race_position == other.race_position
            seen.add(one.race_position)
            one, other = (world.step(Controls(0.0, 0.3, 0.0), 5) for world in worlds)
    assert len(seen) > 1


def test_a_lost_or_doubled_datagram_changes_nothing(backend):
    def drive():
        cars = [backend.reset(rng(), Start(50.0, 0.0, 0.0, 20.0))]
        cars += [backend.step(Controls(0.001 * n, 0.6, 0.0), 3) for n in range(60)]
        return [(car.x, car.y, car.time, *car.range_finders) for car in cars]

    alone = drive()
    with Errant(backend._address) as network:
        backend._client.close()
        backend._client = scr.ScrClient(
            network.host, network.port, backend.range_finder_angles, pause=scr.PAUSE
        )
        backend._client.identify()
        backend._client.receive()
        for _ in range(2):
            assert drive() == alone
    assert network.lost > 10
    assert network.doubled > 10


# ---- Options -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"track": "nowhere"}, TrackNotFound, "nowhere"),
        ({"car": "trabant"}, UnknownCar, "trabant"),
        ({"opponents": ["nobody"]}, UnknownRobot, "nobody"),
        ({"opponents": ["ppo-any-road"]}, UnknownRobot, "agents are opponents with backend 'nat"),
        ({"opponents": "inferno"}, InvalidOption, "expected a list of names"),
        ({"grid_place": 2}, InvalidOption, "expected 1, since there are no opponents, or None"),
        ({"conditions": {"sensor_noise": True}}, InvalidOption, "-noisy"),
        ({"scr": {"port": 3001}}, InvalidOption, r"add scr=\{'host'"),
        ({"scr": {"host": 5}}, InvalidOption, "host is 5; expected a name, e.g. 'localhost'"),
        ({"scr": {"host": ""}}, InvalidOption, "host is ''; expected a name"),
        ({"scr": {"host": "localhost", "port": 99999}}, InvalidOption, "expected 1 to 65535"),
        ({"scr": {"host": "localhost"}, "opponents": ["inferno"]}, InvalidOption, "serve --robots"),
        ({"backend": "native", "scr": {"host": "localhost"}}, InvalidOption, "add backend='scr'"),
        ({"picture": "game"}, InvalidOption, "--window"),
    ],
)
def test_what_cannot_be_is_told_before_anything_starts(options, error, message):
    with pytest.raises(error, match=message):
        gym.make("Torcs-v0", **{"backend": "scr", **options})


@pytest.mark.parametrize("world", [NativeBackend, ScrBackend])
def test_a_start_in_a_wall_is_told(world):
    with contextlib.closing(world("e-track-2")) as backend:
        with pytest.raises(InvalidOption, match="nearer to the middle of the road"):
            backend.reset(rng(), Start(53.87, 0.952))
        assert backend.reset(rng(), Start(53.87, 0.3)).distance_raced == pytest.approx(0.0)


def test_races_on_threads_are_for_the_engine():
    with pytest.raises(InvalidOption, match="vectorization_mode='async'"):
        gym.make_vec("Torcs-v0", num_envs=2, backend="scr")


def test_a_broken_car_is_told(tmp_path):
    file = tmp_path / "car.xml"
    for text, message in (
        ("<params", "is broken"),
        ("<params/>", "has no gears"),
        ('<params><section name="Engine"><attnum name="revs limiter" val="x"/></section></params>',
         "is broken"),
    ):  # fmt: skip
        file.write_text(text)
        with pytest.raises(CarFileError, match=message):
            read_gearbox(file)


# ---- Somebody else's server ----------------------------------------------------------------------


def test_a_server_that_runs_already_is_driven():
    with Loopback() as server:
        env = gym.make("Torcs-v0", backend="scr", scr=server.address)
        env.reset(seed=0)
        for _ in range(10):
            *_, info = env.step(np.array([0.5, 0.25, 0.0], np.float32))
        assert info["distance"] == 50.0
        assert server.actions[-1].steering == 0.5
        env.reset()
        with pytest.raises(InvalidOption, match="begins on the grid"):
            env.reset(options={"distance": 10.0})
        with pytest.raises(InvalidOption, match="cannot be driven twice"):
            pickle.dumps(env.unwrapped)
        env.unwrapped.set_start("random")
        with pytest.raises(InvalidOption, match="begins on the grid"):
            env.reset()
        env.close()
    assert len(server.inits) == 2


def test_a_car_beyond_the_end_of_the_lap_is_on_another_track(monkeypatch):
    with Loopback() as server, driven(server) as world:
        server.tick = 2700
        with pytest.raises(InvalidOption, match="give the server's track"):
            world.step(STRAIGHT_ON, 2)


def test_without_a_track_the_car_has_the_place_on_the_road_that_the_server_tells():
    """And laps, of any length, by the two distances that it tells."""
    lap = 3000.0
    states = [
        ScrState(
            lap_time=0.1 * (step % 150), last_lap_time=15.0 * (step >= 150), track_position=0.37,
            distance_from_start=(lap - 20.0 + 20.0 * step) % lap, distance_raced=20.0 * step,
            heading_error=0.05, speed_x=50.0,
        )
        for step in range(300)
    ]  # fmt: skip
    reader = CarReader(UNKNOWN_ROAD)
    cars = [reader.begin(states[0]), *(reader.read(state, 5) for state in states[1:])]
    assert [car.track_position for car in cars] == pytest.approx([0.37] * 300)
    assert {car.heading_error for car in cars} == {0.05}
    assert [car.distance_raced for car in cars] == [20.0 * step for step in range(300)]
    assert cars[-1].laps == 1
    assert cars[-1].best_lap_time == 15.0


def test_a_yaw_rate_that_is_not_told_is_that_of_the_last_tick():
    """A server that is not ours does not tell it."""
    over_scr = ScrBackend("aalborg")
    over_scr.reset(rng(), Start(600.0, 0.0, 0.0, 20.0))
    reader, told, found = CarReader(over_scr.track), [], []
    reader.begin(parse_state(over_scr._message))
    for _ in range(30):
        car = over_scr.step(Controls(0.3, 0.5, 0.0), 5)
        state = parse_state(over_scr._message)._replace(yaw_rate=None)
        told.append(car.yaw_rate)
        found.append(reader.read(state, 5, over_scr._earlier).yaw_rate)
    assert max(told) > 0.2
    assert found == pytest.approx(told, abs=0.05)
    over_scr.close()


def test_without_a_track_nothing_of_the_road_is_told():
    with pytest.raises(InvalidOption, match=r"add scr=\{'host'"):
        ScrBackend(None)
    with Loopback() as server:
        settings = {"backend": "scr", "track": None, "scr": server.address}
        with pytest.raises(InvalidOption, match="'line' and 'motion' need the track of the race"):
            gym.make("sb3_torcs:Torcs-v0", sensors=["base", "line", "motion"], **settings)
        env = gym.make("sb3_torcs:Torcs-v0", **settings)
        with pytest.raises(InvalidOption, match="give the track of the race"):
            _ = env.unwrapped.backend.profile
        env.close()


def test_no_server_is_told(monkeypatch):
    monkeypatch.setattr(scr, "PATIENCE_WITH_OTHERS", 1.0)
    world = ScrBackend("aalborg", host="127.0.0.1", port=9)
    with pytest.raises(ServerNotFound, match="sb3-torcs serve"):
        world.reset(rng(), None)
    with pytest.raises(ServerLost, match="call reset"):
        world.step(STRAIGHT_ON, 1)
    world.close()


def test_a_server_that_ends_and_comes_back_is_driven_again(monkeypatch):
    monkeypatch.setattr(scr, "PATIENCE_WITH_OTHERS", 3.0)
    with Loopback() as server:
        world = ScrBackend("aalborg", host=server.host, port=server.port)
        world.reset(rng(), None)
    with pytest.raises(ServerLost, match="port is closed"):
        world.step(STRAIGHT_ON, 5)
    with Loopback(port=server.port):
        world.reset(rng(), None)
        world.step(STRAIGHT_ON, 5)
        world.close()


def test_a_car_that_was_taken_out_stands():
    with Loopback(ticks=10) as server, driven(server) as world:
        cars = [world.step(STRAIGHT_ON, 5) for _ in range(4)]
    assert [round(car.time, 6) for car in cars] == [0.1, 0.2, 0.3, 0.4]
    assert cars[-1].speed_x == 0.0
    assert cars[-1].distance_raced == cars[-2].distance_raced


class Anew(Loopback):
    """A race that another client has begin anew, once in the countdown and once later."""

    restarts = (-1, 60)

    def say(self, message):
        if self.restarts and self.tick == self.restarts[0]:
            self.restarts = self.restarts[1:]
            message = RESTART
        super().say(message)


def test_an_agent_drives_on_in_a_race_that_begins_anew():
    with Anew(ticks=100) as server:
        agent = Agent("scripted", {"scr": server.address})
        agent.drive()
    assert len(server.inits) == 3
    assert agent.distance == 99.0


class LastLap(Loopback):
    """A race that ends at the line: its last state tells the lap's time."""

    def state(self):
        state = super().state()
        return state if self.tick < self.ticks else state._replace(lap_time=0.0, last_lap_time=70.0)

    def say(self, message):
        if message.startswith(SHUTDOWN):
            self.send_state()
        super().say(message)


def test_the_last_lap_counts_though_the_race_ends_in_mid_step():
    with LastLap(ticks=8) as server, driven(server) as world:
        cars = [world.step(STRAIGHT_ON, 5) for _ in range(3)]
    assert [car.laps for car in cars] == [0, 1, 1]
    assert cars[1].last_lap_time == 70.0


LOADED_BEFORE_THE_RACE = """
import sys
import gymnasium as gym
from numba.core.dispatcher import Dispatcher
from processes import PATIENCE, Program, gone, runs
from scr_loopback import Loopback
import sb3_torcs.actions, sb3_torcs.envs.ends, sb3_torcs.sensors
from sb3_torcs.agents.remote import Agent

def loaded():
    compiled = {
        (name, function): len(value.signatures)
        for name, module in list(sys.modules.items()) if name.startswith("sb3_torcs")
        for function, value in vars(module).items() if isinstance(value, Dispatcher)
    }
    return set(sys.modules), compiled

class Watching(Loopback):
    seen = None

    def take(self, message, sender):
        self.seen = self.seen or loaded()
        super().take(message, sender)

with Watching(ticks=300) as server:
    address = {"scr": server.address}
    if sys.argv[1:]:
        Agent(sys.argv[1], {"track": "aalborg", **address}).drive()
    else:
        env = gym.make("sb3_torcs:Torcs-v0", backend="scr", **address)
        env.reset()
        for _ in range(20):
            env.step([0.0, 1.0, 0.0])
        env.close()
    modules, compiled = loaded()
    assert not modules - server.seen[0], modules - server.seen[0]
    assert compiled == server.seen[1], (compiled, server.seen[1])
    assert compiled["sb3_torcs.envs.ends", "end_episodes"] == 1
"""


@pytest.mark.parametrize("driver", [[], ["scripted"], ["ddpg-aalborg"]])
def test_nothing_is_loaded_or_compiled_once_a_race_has_begun(driver):
    """It takes up to a second, and a race does not wait so long for an answer."""
    paths = {"PYTHONPATH": str(Path(__file__).parent)}
    call = [sys.executable, "-c", LOADED_BEFORE_THE_RACE, *driver]
    done = subprocess.run(
        call, env={**os.environ, **paths}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_rehearsal_leaves_nothing_behind():
    with Loopback(ticks=5) as server:
        world = ScrBackend("aalborg", host=server.host, port=server.port)
        assert world.over
        assert (list(world.latencies), world.lost_ticks) == ([], 0)
        agent = Agent("scripted", {"track": "aalborg", "scr": server.address})
        assert (agent.lap_times, agent.distance, agent.end) == ([], 0.0, None)
        assert not server.inits
        world.close()
        agent.env.close()


@pytest.mark.parametrize("think", [0.012, 0.2])
def test_both_sides_count_the_same_lost_ticks(think):
    """In real time; an answer that crosses the next state on its way may count on one side only."""
    (bound,) = open_ports(1)
    race = RaceSetup("a-speedway", [("scr_server", 0)], laps=1)
    with start_server(find_game(), race, [bound], deadline=0.01) as game:
        host, port = bound.getsockname()
        bound.close()
        settings = {"track": "a-speedway", "scr": {"host": host, "port": port}, "action_repeat": 1}
        agent = Agent("scripted", settings)
        pauses = [think] * 10
        decide = agent.driver.predict

        def predict(*words, **named):
            time.sleep(pauses.pop() if pauses else 0.0)
            return decide(*words, **named)

        agent.driver = SimpleNamespace(predict=predict)
        agent.drive()
        game.wait(PATIENCE)
        (told,) = re.findall(r"control ticks, (\d+) late", game.words())
    assert agent.backend.lost_ticks > 0
    assert abs(int(told) - agent.backend.lost_ticks) <= max(2, 0.2 * int(told))


def test_the_time_goes_on_at_the_first_line_after_a_flying_start():
    """The lap clock begins anew there, and no lap tells how long the tick was."""
    reader = CarReader(load_track("aalborg"))
    reader.begin(ScrState(lap_time=70.0))
    cars = [reader.read(ScrState(lap_time=clock), 5) for clock in (70.11, 0.05, 0.16)]
    assert [car.time for car in cars] == pytest.approx([70.11, 70.22, 70.33])


# ---- When things break ---------------------------------------------------------------------------


def test_a_game_that_is_killed_in_mid_lap_is_told_and_replaced(backend):
    first = backend.step(STRAIGHT_ON, 50)
    pid = backend._process.pid
    folder = backend._process.folder
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(GameFailed, match=r"SIGKILL.*call reset"):
        backend.step(STRAIGHT_ON, 5000)
    assert not folder.exists()
    with pytest.raises(ServerLost, match="call reset"):
        backend.step(STRAIGHT_ON, 1)
    backend.reset(rng(), None)
    again = backend.step(STRAIGHT_ON, 50)
    np.testing.assert_array_equal(again.range_finders, first.range_finders)
    assert backend._process.pid != pid


def test_a_car_that_stands_too_long_is_taken_out_and_a_reset_begins_anew(backend):
    """By the game's own rule, after the race; the game then ends."""
    car = backend.reset(rng(), None)
    while not backend._client.over:
        car = backend.step(Controls(0.0, 0.0, 1.0), 500)
        assert car.time < 1000.0
    assert backend.step(STRAIGHT_ON, 5).speed_x == 0.0
    assert backend.reset(rng(), None).time < 0.1


@pytest.mark.parametrize("closed", [True, False])
def test_nothing_is_left_of_a_closed_or_forgotten_world(closed):
    world = ScrBackend("g-track-1")
    world.reset(rng(), None)
    pid, folder = world._process.pid, world._process.folder
    if closed:
        world.close()
    else:
        del world
        gc.collect()
    assert gone(lambda: runs(pid))
    assert not folder.exists()


WAIT = """
import sys, time, numpy as np
from sb3_torcs.backends.scr import ScrBackend
from sb3_torcs.car import Controls
world = ScrBackend("g-track-1")
world.reset(np.random.default_rng(0), None)
print(world._process.pid, world._process.folder, flush=True)
while True:
    world.step(Controls(0.0, 0.1, 0.0), 100)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_dead_client_leaves_no_game(number):
    with Program(sys.executable, "-c", WAIT) as client:
        pid, folder = client.wait_for(lambda: client.printed()[0].partition("\n")[0].split())
        client.end(number)
        _, words = client.printed()
    assert gone(lambda: runs(int(pid)))
    assert not Path(folder).exists()
    assert ("KeyboardInterrupt" in words) == (number == signal.SIGINT)


def test_a_fork_leaves_the_game_to_its_parent(backend):
    before = backend.step(STRAIGHT_ON, 5)
    child = os.fork()
    if child == 0:
        try:
            backend.step(STRAIGHT_ON, 5)
        except EngineForked:
            os._exit(0)
        os._exit(1)
    assert os.waitpid(child, 0)[1] == 0
    assert backend.step(STRAIGHT_ON, 5).time > before.time


def test_two_worlds_do_not_hear_each_other():
    worlds = [ScrBackend("g-track-1"), ScrBackend("dirt-1")]
    alone = []
    for world in worlds:
        world.reset(rng(), None)
        alone.append([world.step(STRAIGHT_ON, 5) for _ in range(30)])
    for world in worlds:
        world.reset(rng(), None)
    together = [[], []]
    for _ in range(30):
        for world, cars in zip(worlds, together, strict=True):
            cars.append(world.step(STRAIGHT_ON, 5))
    for one, other in zip(alone, together, strict=True):
        for car, same in zip(one, other, strict=True):
            np.testing.assert_array_equal(car.range_finders, same.range_finders)
            assert car[:20] == same[:20]
    for world in worlds:
        world.close()


def test_resets_keep_the_game_and_leak_nothing(backend):
    def descriptors():
        return len(os.listdir("/proc/self/fd"))

    def game_memory():
        status = Path(f"/proc/{backend._process.pid}/statm").read_text()
        return int(status.split()[1])  # [pages]

    pid, first = backend._process.pid, backend.step(STRAIGHT_ON, 20)
    for _ in range(50):
        backend.reset(rng(), None)
    again = backend.step(STRAIGHT_ON, 20)
    np.testing.assert_array_equal(again.range_finders, first.range_finders)
    assert backend._process.pid == pid
    descriptors_before, pages_before = descriptors(), game_memory()
    for n in range(200):
        backend.reset(rng(), Start(10.0 * n, 0.0, 0.0, 20.0) if n % 2 else None)
    assert descriptors() == descriptors_before
    assert game_memory() - pages_before < 2500  # 10 MB


def test_relaunches_leak_nothing():
    world = ScrBackend("g-track-1")
    for n in range(8):
        world.reset(rng(), None)
        os.kill(world._process.pid, signal.SIGKILL)
        if n == 1:
            before = len(os.listdir("/proc/self/fd"))
    world.reset(rng(), None)
    assert len(os.listdir("/proc/self/fd")) == before
    world.close()


@pytest.mark.slow
def test_four_worlds_in_processes_drive_as_one_alone():
    options = {"backend": "scr", "track": "g-track-1", "start": "random"}
    vector = make_vec_env(
        "sb3_torcs:Torcs-v0", 4, seed=5, env_kwargs=options, vec_env_cls=SubprocVecEnv
    )
    single = gym.make("Torcs-v0", **options)
    try:
        observations, expected = vector.reset(), single.reset(seed=7)[0]
        for step in range(400):
            np.testing.assert_array_equal(observations[2], expected)
            action = np.array([0.2 * np.sin(0.1 * step), 0.8, 0.0], np.float32)
            observations = vector.step(np.stack([action] * 4))[0]
            expected, _, terminated, truncated, _ = single.step(action)
            if terminated or truncated:
                expected = single.reset()[0]
    finally:
        vector.close()
        single.close()
