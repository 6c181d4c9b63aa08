"""The game's own picture of what the engine drives: complete, of this very moment, and gone again.

The pixels are those of one machine; what is compared here was drawn on the same one.
"""

from __future__ import annotations

import inspect
import os
import pickle
import re
import signal
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium
from gymnasium.wrappers import AddRenderObservation, RecordVideo
from processes import children, gone
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecVideoRecorder

from sb3_torcs.envs.torcs import TorcsEnv
from sb3_torcs.envs.torcs_lite import TorcsLiteEnv
from sb3_torcs.errors import (
    DisplayUnavailable,
    EnvClosed,
    GameFailed,
    GameTimeout,
    InvalidOption,
)
from sb3_torcs.evaluation.ticks import log_drives
from sb3_torcs.rendering import game_camera
from sb3_torcs.rendering.game_camera import HEADER, read_frame
from sb3_torcs.rendering.gap import side_by_side
from sb3_torcs.torcs.window import VIEWS

TORCS = "sb3_torcs:Torcs-v0"
SIZE = (160, 120)
GAME = {"render_mode": "rgb_array", "picture": {"size": SIZE}}
GAS = np.array([0.0, 1.0, 0.0], np.float32)
CORNER = {"distance": 600.0, "speed": 20.0, "heading_error": 0.1}

pytestmark = pytest.mark.usefixtures("game")


def make(**options):
    return gym.make(TORCS, **{**GAME, **options}).unwrapped


@pytest.fixture
def env():
    env = make()
    yield env
    env.close()


def drive(env, timesteps):
    for _ in range(timesteps):
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


@pytest.mark.parametrize("size", [(333, 217), (640, 480)])
def test_a_picture_has_the_size_that_was_asked_for(size):
    env = make(picture={"size": size})
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
    later = drive(env, 10)
    assert is_a_picture(later)
    assert np.abs(shot(later) - shot(first)).mean() > 3.0


@pytest.mark.parametrize("view", [
    view if view in ("behind", "tv") else pytest.param(view, marks=pytest.mark.rare)
    for view in VIEWS
])  # fmt: skip
def test_a_picture_shows_this_moment_and_nothing_before_it(view):
    """Neither camera nor needles lag behind, and no smoke, marks or dents stay."""
    picture = {"size": SIZE, "view": view}
    env = make(picture=picture, opponents=("inferno",))  # a director would cut to it
    env.reset(options=CORNER)
    moment, before = env.backend.save(), env.render()
    later = [drive(env, 15) for _ in range(5)]
    env.reset(seed=1)  # on the grid
    env.render()
    env.backend.restore(moment)
    after = env.render()
    env.close()
    np.testing.assert_array_equal(after, before)
    assert all((picture != before).any() for picture in later)


def test_each_view_is_another_picture():
    pictures = {}
    for view in VIEWS:
        env = make(picture={"size": SIZE, "view": view})
        env.reset(options=CORNER)
        pictures[view] = env.render().tobytes()
        env.close()
    assert pictures.pop("tv") == pictures["track"]
    assert len(set(pictures.values())) == len(VIEWS) - 1


def test_without_boards_there_is_only_the_scene():
    """The boards in three corners and below are gone; what is between them stays."""
    pictures = {}
    for boards in (True, False):
        env = make(picture={"boards": boards, "size": (320, 240)})
        env.reset(options=CORNER)
        pictures[boards] = env.render()
        env.close()
    np.testing.assert_array_equal(pictures[True][100:180, 80:200], pictures[False][100:180, 80:200])
    changed = (pictures[True] != pictures[False]).any(axis=2)
    for corner in (changed[:60, :70], changed[20:70, 250:], changed[180:, 100:200]):
        assert corner.mean() > 0.1


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
    """At the speed of the drive, also if there is less than one picture in a second."""
    env = RecordVideo(gym.make(TORCS, **GAME, action_repeat=100), str(tmp_path / "videos"))
    env.reset(seed=1)
    for _ in range(3):
        env.step(GAS)
    env.close()
    video = str(*tmp_path.glob("videos/*.mp4"))
    assert imageio_ffmpeg.count_frames_and_secs(video) == (4, 8.0)


def test_an_evaluation_that_notes_its_drive_draws_it(env):
    log_drives(env, "anybody")
    env.reset(seed=0)
    assert is_a_picture(drive(env, 5))


def test_a_wrapper_observes_it():
    options = {"render_mode": "rgb_array", "picture": {"size": SIZE, "boards": False}}
    env = AddRenderObservation(gym.make(TORCS, **options), render_only=False)
    observations = [env.reset(seed=1)[0], *(env.step(GAS)[0] for _ in range(3))]
    pictures = [observation["pixels"] for observation in observations]
    assert all(observation in env.observation_space for observation in observations)
    assert {(each.shape, str(each.dtype)) for each in pictures} == {((120, 160, 3), "uint8")}
    np.testing.assert_array_equal(pictures[-1], env.render())
    assert (pictures[0] != pictures[-1]).any()
    env.close()


@pytest.mark.parametrize("vectorize", [DummyVecEnv, SubprocVecEnv])
def test_stable_baselines3_records_it(vectorize, tmp_path):
    before = children()
    made = vectorize([partial(gym.make, TORCS, **GAME)] * 2)
    env = VecVideoRecorder(made, str(tmp_path), lambda step: step == 0, video_length=4)
    env.reset()
    for _ in range(6):
        env.step([GAS, GAS])
    env.close()
    video = str(*tmp_path.glob("*.mp4"))
    # That of the reset, and one for each of four timesteps.
    assert imageio_ffmpeg.count_frames_and_secs(video) == (5, 0.5)
    assert next(imageio_ffmpeg.read_frames(video))["size"] == (160, 240)  # one above the other
    assert children() == before


def test_races_on_threads_draw_it():
    envs = gym.make_vec(TORCS, 2, **GAME)
    envs.reset(seed=1)
    one, other = envs.render()
    np.testing.assert_array_equal(one, other)
    assert is_a_picture(one)
    envs.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"picture": "game"}, "picture is 'game'.*so it is for Torcs-v0"),
        ({"scr": {"port": 3001}}, "scr is .*, which needs the installed game"),
        ({"conditions": {"mass": 1.1}}, "mass is 1.1, which this world cannot change"),
    ],
)
def test_the_world_without_a_game_refuses(options, message):
    with pytest.raises(InvalidOption, match=message):
        TorcsLiteEnv(**options)


def test_the_world_without_a_game_knows_what_is_for_the_other():
    torcs, lite = (
        {n for n, p in inspect.signature(env).parameters.items() if p.kind is p.KEYWORD_ONLY}
        for env in (TorcsEnv, TorcsLiteEnv)
    )
    assert torcs - lite == {"backend", "opponents", "grid_place", "picture", "scr"}


@pytest.mark.parametrize("kind", [TorcsEnv, TorcsLiteEnv])
def test_the_argument_that_was_meant_is_named(kind):
    asked = f"{kind.__name__}.__init__() got an unexpected keyword argument 'trak'"
    with pytest.raises(TypeError, match=re.escape(f"{asked}; did you mean 'track'?")):
        kind(trak="aalborg")
    with pytest.raises(TypeError, match="'trak'; did you mean 'track'"):
        gym.make_vec("Torcs-v0", num_envs=2, trak="aalborg")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"picture": "gme"}, "picture is 'gme'; did you mean 'game'"),
        ({"picture": None}, "picture is None; expected 'above' or 'game'"),
        ({"picture": {"view": "cokpit"}}, "view is 'cokpit'; did you mean 'cockpit'"),
        ({"picture": {"view": 3}}, "view is 3"),
        ({"picture": {"veiw": "tv"}}, "picture has no key 'veiw'; did you mean 'view'"),
        ({"picture": {"boards": "no"}}, "boards is 'no'; expected True or False"),
        ({"render_mode": "human"}, "`sb3-torcs watch` shows the game's own window"),
        ({"backend": "scr"}, "`sb3-torcs serve --window`"),
        ({"track": ["aalborg", "forza"]}, "picture 'game' is for one track"),
        *[({"picture": {"size": size}}, "size is") for size in
          ((640,), 640, ("a", "b"), (640.5, 480), (10, 480), (640, 10000), [(1, 2), 3])],
    ],
)  # fmt: skip
def test_what_cannot_be_drawn_is_refused_at_once(options, message):
    with pytest.raises(InvalidOption, match=message):
        make(**options)


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
    assert gone(*(path.exists for path in paths)), paths


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
        "options = {'render_mode': 'rgb_array', 'picture': 'game'}\n"
        "env = gym.make('sb3_torcs:Torcs-v0', **options).unwrapped\n"
        "env.reset(seed=1)\n"
        "env.render()\n"
        "children = open(f'/proc/{os.getpid()}/task/{os.getpid()}/children').read()\n"
        "print(children, env._viewer._game.folder, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    *pids, folder = run.stdout.split()
    assert len(pids) == 2, run.stderr
    wait_until_gone([Path(f"/proc/{pid}") for pid in pids] + [Path(folder)])


def test_without_a_virtual_display_it_says_what_to_type(env, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    env.reset(seed=1)
    with pytest.raises(DisplayUnavailable, match="sudo apt install xvfb"):
        env.render()


def test_a_game_that_hangs_is_an_error(monkeypatch):
    monkeypatch.setattr(game_camera, "PATIENCE", 0.1)
    game = SimpleNamespace(last_words=lambda: "Ready.")
    receiver, sender = os.pipe()
    with pytest.raises(GameTimeout, match=r"no picture for 0\.1 s; it last said: Ready\."):
        read_frame(receiver, game)
    os.close(sender)
    assert read_frame(receiver, game) is None
    os.close(receiver)


@pytest.mark.parametrize(
    "sent",
    [
        HEADER.pack(b"SB3F", 2, 2, 0, 0.0, 0.0) + b"short",
        HEADER.pack(b"what", 2, 2, 0, 0.0, 0.0) + bytes(12),
        b"SB3F",
    ],
)
def test_half_a_frame_is_an_error(sent):
    game = SimpleNamespace(epitaph=lambda: "the game ended")
    receiver, sender = os.pipe()
    os.write(sender, sent)
    os.close(sender)
    with pytest.raises(GameFailed, match="the game ended"):
        read_frame(receiver, game)
    os.close(receiver)


def test_videos_go_side_by_side():
    def plain(level, width, count):
        return (np.full((4, width, 3), level + n, np.uint8) for n in range(count))

    joint = list(side_by_side(plain(0, 2, 3), plain(100, 6, 2)))
    assert [picture.shape for picture in joint] == [(4, 8, 3)] * 3
    assert [(p[0, 0, 0], p[0, 7, 0]) for p in joint] == [(0, 100), (1, 101), (2, 101)]
