"""The game's own picture of what the engine drives: complete, of this very moment, and gone again.

The pixels are those of one machine; what is compared here was drawn on the same one.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import warnings
from pathlib import Path
from time import monotonic, sleep

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium
from gymnasium.wrappers import RecordVideo
from processes import children
from stable_baselines3.common.env_checker import check_env as check_sb3

from sb3_torcs.envs.torcs_lite import TorcsLiteEnv
from sb3_torcs.errors import DisplayUnavailable, EnvClosed, GameFailed, InvalidOption

TORCS = "sb3_torcs:Torcs-v0"
SIZE = (160, 120)
GAS = np.array([0.0, 1.0, 0.0], np.float32)
CORNER = {"distance": 600.0, "speed": 20.0, "heading_error": 0.1}

pytestmark = pytest.mark.usefixtures("game")


def make(**options):
    return gym.make(TORCS, **{"render_mode": "game", "render_size": SIZE, **options}).unwrapped


@pytest.fixture
def env():
    env = make()
    yield env
    env.close()


def drive(env, decisions):
    for _ in range(decisions):
        env.step(GAS)
    return env.render()


def is_a_picture(frame):
    """Not black, not torn, not a loading screen: sky above a road, in many colours."""
    sky, road = frame[: len(frame) // 8, 60:100].mean(), frame[-30:, :40].mean()
    return len(np.unique(frame.reshape(-1, 3), axis=0)) > 500 and sky > 1.3 * road > 30.0


def shot(frame):
    """The picture without the board, the map and the clocks."""
    return frame[45:90].astype(float)


# ---- What a picture shows -----------------------------------------------------------------------


@pytest.mark.parametrize("size", [(160, 120), (333, 217), (640, 480)])
def test_a_picture_has_the_size_that_was_asked_for(size):
    env = make(render_size=size)
    env.reset(seed=1)
    frame = env.render()
    env.close()
    assert frame.shape == (size[1], size[0], 3)
    assert frame.dtype == np.uint8
    assert frame.flags.writeable
    assert len(np.unique(frame)) > 100


def test_the_first_picture_is_already_that_of_the_race(env):
    env.reset(seed=1)
    first = env.render()
    assert is_a_picture(first)
    np.testing.assert_array_equal(env.render(), first)


def test_a_picture_follows_the_car(env):
    env.reset(seed=1)
    at_first = env.render()
    later = drive(env, 10)
    assert is_a_picture(later)
    assert np.abs(shot(later) - shot(at_first)).mean() > 3.0


def test_a_picture_shows_this_moment_and_nothing_before_it(env):
    """Neither camera nor needles lag behind, and no smoke, marks or dents stay."""
    env.reset(options=CORNER)
    moment, before = env.backend.save(), env.render()
    drive(env, 15)
    env.reset(seed=1)  # on the grid
    env.render()
    env.backend.restore(moment)
    np.testing.assert_array_equal(env.render(), before)


def test_a_start_elsewhere_is_drawn_there(env):
    frames = []
    for distance in (300.0, 900.0, 1500.0):
        env.reset(options={**CORNER, "distance": distance})
        frames.append(env.render())
        assert is_a_picture(frames[-1])
    assert np.abs(shot(frames[0]) - shot(frames[1])).mean() > 3.0
    assert np.abs(shot(frames[1]) - shot(frames[2])).mean() > 3.0


def test_opponents_are_drawn_where_they_are():
    """The red car of inferno stands before the agent, and is gone when it has driven away."""
    env = make(opponents=("inferno",))
    env.reset(seed=1)

    def red(frame):
        r, g, b = np.moveaxis(frame[38:54, 90:125].astype(int), 2, 0)
        return int(((r > 100) & (g < 60) & (b < 60)).sum())

    near = red(env.render())
    for _ in range(30):
        env.step(np.array([0.0, 0.0, 1.0], np.float32))
    far = red(env.render())
    env.close()
    assert near > 20
    assert far < near / 4


def test_looking_changes_nothing():
    def driven(look):
        env = make(opponents=("berniw",), start="random")
        observations = [env.reset(seed=3)[0]]
        for _ in range(20):
            observations.append(env.step(GAS)[0])
            if look:
                env.render()
        env.close()
        return np.stack(observations)

    np.testing.assert_array_equal(driven(True), driven(False))


def test_equal_moments_look_equal_in_every_game():
    """Also side by side, and in a copy that came out of a pickle."""
    one, other = make(), make()
    one.reset(options=CORNER)
    other.reset(seed=1)
    alone = one.render()
    grid = other.render()
    copy = pickle.loads(pickle.dumps(one))
    other.reset(options=CORNER)
    np.testing.assert_array_equal(other.render(), alone)
    np.testing.assert_array_equal(copy.render(), alone)
    assert (grid != alone).any()
    for env in (one, other, copy):
        env.close()


def test_what_the_engine_hands_out_is_a_value():
    """No addresses and nothing left over from before: equal moments are equal bytes."""
    one, other = make(opponents=("inferno",)), make(opponents=("inferno",))
    one.reset(seed=1)
    first = one.backend.engine.appearance()
    for _ in range(5):
        one.step(GAS)
    assert one.backend.engine.appearance() != first
    one.reset(seed=1)
    other.reset(seed=2)
    assert one.backend.engine.appearance() == other.backend.engine.appearance() == first
    one.close()
    other.close()


# ---- Used as environments are -------------------------------------------------------------------


def test_both_checkers_find_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="We recommend you to use a symmetric")
        for check in (check_gymnasium, check_sb3):
            env = make()
            check(env)
            env.close()


def test_a_wrapper_records_it(tmp_path):
    pytest.importorskip("moviepy")
    env = RecordVideo(
        gym.make(TORCS, render_mode="game", render_size=SIZE), str(tmp_path / "films")
    )
    env.reset(seed=1)
    for _ in range(5):
        env.step(GAS)
    env.close()
    (film,) = tmp_path.glob("films/*.mp4")
    assert film.stat().st_size > 1000


def test_the_world_without_a_game_refuses():
    with pytest.raises(InvalidOption, match="that is for Torcs-v0"):
        TorcsLiteEnv(render_mode="game")


@pytest.mark.parametrize("size", [(640,), 640, ("a", "b"), (640.5, 480), (10, 480), (640, 10000)])
def test_sizes_that_cannot_be_drawn_are_refused_at_once(size):
    with pytest.raises(InvalidOption, match="size is"):
        make(render_size=size)


def test_there_is_no_picture_before_and_after():
    env = make()
    with pytest.raises(EnvClosed, match="reset"):
        env.render()
    env.reset(seed=1)
    env.close()
    with pytest.raises(EnvClosed, match="close"):
        env.render()


# ---- Faults, and what is left -------------------------------------------------------------------


def traces(env, before):
    """The processes and the folder of the game that draws."""
    view = env._viewer
    pids = children() - before
    folder = view._game.folder
    assert view._game.pid in pids
    assert len(pids) == 2
    assert folder.is_dir()
    return [Path(f"/proc/{pid}") for pid in pids] + [folder]


def wait_until_gone(paths):
    end = monotonic() + 20.0
    while any(path.exists() for path in paths) and monotonic() < end:
        sleep(0.05)
    assert [path for path in paths if path.exists()] == []


def test_nothing_runs_before_the_first_picture():
    before = children()
    env = make()
    env.reset(seed=1)
    env.step(GAS)
    assert children() == before
    env.close()


def test_close_leaves_nothing(env):
    descriptors, before = len(os.listdir("/proc/self/fd")), children()
    env.reset(seed=1)
    env.render()
    left = traces(env, before)
    env.close()
    env.close()
    assert [path for path in left if path.exists()] == []
    assert len(os.listdir("/proc/self/fd")) <= descriptors


def test_a_game_that_dies_is_told_and_replaced(env):
    before = children()
    env.reset(seed=1)
    picture = env.render()
    left = traces(env, before)
    os.kill(env._viewer._game.pid, signal.SIGKILL)
    with pytest.raises(GameFailed, match="SIGKILL"):
        env.render()
    assert [path for path in left if path.exists()] == []
    np.testing.assert_array_equal(env.render(), picture)


def test_a_killed_owner_leaves_nothing(tmp_path):
    code = (
        "import gymnasium as gym, os, signal\n"
        "env = gym.make('sb3_torcs:Torcs-v0', render_mode='game').unwrapped\n"
        "env.reset(seed=1)\n"
        "env.render()\n"
        "children = open(f'/proc/{os.getpid()}/task/{os.getpid()}/children').read()\n"
        "print(children, env._viewer._game.folder, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    *pids, folder = run.stdout.split()
    assert len(pids) == 2, run.stderr
    wait_until_gone([Path(f"/proc/{pid}") for pid in pids] + [Path(folder)])


def test_without_a_virtual_display_it_says_what_to_type(env, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    env.reset(seed=1)
    with pytest.raises(DisplayUnavailable, match="sudo apt install xvfb"):
        env.render()
