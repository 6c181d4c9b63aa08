"""The search for a lap, and the ghosts that come out of it."""

from __future__ import annotations

import gc
import json
import shutil
import zipfile
from contextlib import suppress

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.buffers import ReplayBuffer

import sb3_torcs  # noqa: F401  registers the environments
from sb3_torcs.agents.drivers import find_driver
from sb3_torcs.agents.ghosts import GhostDriver, demonstration, read_ghost, shipped_ghosts
from sb3_torcs.agents.models import driver_name, driver_record, load_driver
from sb3_torcs.agents.remote import Agent
from sb3_torcs.backends.native import make_engine, make_rollouts
from sb3_torcs.cli import main
from sb3_torcs.errors import InvalidOption, ModelMismatch, OutputNotWritable
from sb3_torcs.evaluation import evaluate
from sb3_torcs.scr.server import open_ports, start_server
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.race_setup import RaceSetup
from sb3_torcs.torcs.starting_list import AGENT
from sb3_torcs.torcs.track_names import find_track
from sb3_torcs.training.lap_search import search
from sb3_torcs.training.lap_search.line import Line, lap_of, repeated
from sb3_torcs.training.lap_search.search import Budget, LapSearch
from sb3_torcs.training.lap_search.starts import find_starts, ghost_environment

pytestmark = pytest.mark.usefixtures("game")

TRACK = "a-speedway"
GAINS = (0.15, 2.0, 0.15)
ONE_RACE = 1_000  # rollouts: more than a race of the tiny search takes, less than two


@pytest.fixture(scope="module")
def tiny():
    """A search with few and short candidates."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "CANDIDATES", 2)
        patch.setattr(search, "GENERATIONS", 1)
        patch.setattr(search, "HORIZON", 2.0)
        patch.setattr(search, "STRIDE", 1.0)
        yield


@pytest.fixture(scope="module")
def starts(game):
    return find_starts(
        find_driver("scripted"), ghost_environment(find_driver("scripted"), {"track": TRACK})
    )


def searched(starts, threads=2, seed=0):
    kwargs = ghost_environment(find_driver("scripted"), {"track": TRACK})
    search = LapSearch("scripted", kwargs, starts, threads=threads, seed=seed)
    for _ in search.run(Budget(rollouts=ONE_RACE)):
        pass
    search.close()
    return search.ghost


@pytest.fixture(scope="module")
def ghost(tiny, starts):
    return searched(starts)


@pytest.fixture
def file(ghost, tmp_path):
    return ghost.write(tmp_path / "ghost.npz")


def cars_of(ghost):
    return [(*step.car[:23], *step.car.wheel_speeds) for step in ghost.drive()]


# ---- The search -----------------------------------------------------------------------------


def test_it_is_faster_than_what_it_began_with(ghost, starts):
    assert min(ghost.lap_times[1:]) < min(starts[0].lap_times[1:])
    assert len(ghost.lap_times) == 3


def test_a_seed_finds_the_same_ghost_on_any_number_of_threads(ghost, starts):
    again = searched(starts, threads=1)
    np.testing.assert_array_equal(again.actions, ghost.actions)
    assert again.lap_times == ghost.lap_times
    assert not np.array_equal(searched(starts, seed=1).actions, ghost.actions)


def test_a_ghost_drives_again_to_the_bit(ghost):
    assert cars_of(ghost) == cars_of(ghost)


def test_a_search_begins_with_the_fastest_driver_or_with_the_agent_alone(starts):
    assert [start.seconds for start in starts] == sorted(start.seconds for start in starts)
    assert "inferno:3" in [start.driver for start in starts]
    kwargs = ghost_environment(find_driver("scripted"), {"track": TRACK})
    (own,) = find_starts(find_driver("scripted"), kwargs, alone=True)
    assert own.driver == "scripted"


def test_a_driver_that_does_not_finish_alone_is_refused():
    kwargs = ghost_environment(find_driver("ddpg-aalborg"), {"track": "dirt-1"})
    with pytest.raises(InvalidOption, match=r"ddpg-aalborg finishes no race .* --alone"):
        find_starts(find_driver("ddpg-aalborg"), kwargs, alone=True)


def test_a_ghost_drives_in_the_environment_of_the_agent():
    kwargs = ghost_environment(find_driver("ddpg-aalborg"), {"track": "forza", "car": "155-DTM"})
    assert (kwargs["track"], kwargs["car"], kwargs["laps"]) == ("forza", "155-DTM", 3)
    kept = driver_record("ddpg-aalborg").env_kwargs
    assert all(kwargs[name] == kept[name] for name in ("reward", "action_repeat") if name in kept)


# ---- Candidates -----------------------------------------------------------------------------


@pytest.fixture
def engines():
    made = [make_engine(find_game(), TRACK, [AGENT]) for _ in range(2)]
    for engine in made:
        engine.start()
    yield made
    for engine in made:
        engine.close()


def test_without_offsets_a_candidate_repeats_a_drive_to_the_bit(engines, starts):
    rollouts = make_rollouts(engines)
    steps = 100
    (first,), (lasted,) = rollouts.follow(starts[0].rows, GAINS, np.zeros((1, steps, 3)), 5)
    paths, _ = rollouts.follow(first, GAINS, np.zeros((3, steps, 3)), 5)
    assert lasted == steps
    for path in paths:
        np.testing.assert_array_equal(path, first)


def test_a_candidate_lasts_until_it_leaves_the_road(engines, starts):
    rollouts = make_rollouts(engines)
    offsets = np.zeros((2, 150, 3))
    offsets[1, 100:, 0] = 1.0
    paths, lasted = rollouts.follow(starts[0].rows, GAINS, offsets, 5)
    assert lasted[0] == 150 > lasted[1] >= 100
    np.testing.assert_array_equal(paths[0, :101, :5], paths[1, :101, :5])


def test_drives_go_on_from_the_mark_and_back(engines, starts):
    rollouts = make_rollouts(engines)
    line = starts[0].rows
    (path,), _ = rollouts.follow(line, GAINS, np.zeros((1, 20, 3)), 5)
    for part in (path[:10], path[10:20]):
        rollouts.drive(part, 5)
    assert engines[0].read(0)[:23] == engines[1].read(0)[:23]
    assert engines[0].read(0).distance_raced == path[20, 1]
    rollouts.go_back(2)
    assert engines[1].read(0).distance_raced == path[0, 1]
    with pytest.raises(InvalidOption, match="going back 1 drives of 0"):
        rollouts.go_back(1)


def test_candidates_keep_their_engines():
    """Nothing is freed under them, whatever becomes of the list."""
    made = [make_engine(find_game(), TRACK, [AGENT])]
    made[0].start()
    rollouts = make_rollouts(made)
    made.clear()
    gc.collect()
    rollouts.go_back(0)


def test_a_gain_is_time_against_the_line():
    rows = np.zeros((5, 7))
    rows[:, 0], rows[:, 1], rows[:, 4] = np.arange(5) * 0.1, np.arange(5) * 2.0, 20.0
    line = Line(rows)
    end = np.array([[0.25, 6.0, 0.0, 0.0, 20.0, 0.0, 0.0]])
    assert line.gain(rows[0], end).tolist() == pytest.approx([0.05])
    beside = end + np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    assert line.gain(rows[0], beside).tolist() == pytest.approx([0.04])


def test_a_car_that_stands_on_the_way_finds_its_line():
    rows = np.zeros((9, 7))
    rows[:, 1], rows[:, 4] = np.arange(9) * 20.0, 20.0
    standing = np.array([5.0, 70.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert Line(rows).rows_from(standing, driven=50)[0, 1] == 60.0
    beyond = standing + np.array([0.0, 999.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert len(Line(rows).rows_from(beyond, driven=5)) == 2


def test_a_lap_is_put_behind_itself():
    rows = np.zeros((40, 7))
    rows[:, 0], rows[:, 1] = np.arange(40) * 0.1, np.arange(40) * 2.5
    lap = lap_of(rows, 20.0, 50.0)
    twice = repeated(lap, 50.0, (0, 1))
    np.testing.assert_allclose(np.diff(twice[:, 1]), 2.5)
    np.testing.assert_allclose(np.diff(twice[:, 0]), 0.1)


# ---- Files and drivers ----------------------------------------------------------------------


def test_a_ghost_is_read_as_it_was_written(ghost, file):
    read = read_ghost(file)
    np.testing.assert_array_equal(read.actions, ghost.actions)
    assert (read.env_kwargs, read.lap_times) == (ghost.env_kwargs, ghost.lap_times)
    assert (read.agent, read.start, read.rollouts) == ("scripted", "inferno:3", ghost.rollouts)
    assert [path.name for path in file.parent.iterdir()] == ["ghost.npz"]


def test_a_ghost_drives_no_more_laps_than_it_has(ghost, file):
    kwargs = {**ghost.env_kwargs, "laps": 4}
    with gym.make("Torcs-v0", **kwargs) as env:
        with pytest.raises(ModelMismatch, match="drove 3 laps, so it cannot drive 4"):
            load_driver(file, env)


def broken(kind, path):
    """Write a file that is no ghost."""
    if kind == "text":
        path.write_text("no ghost")
    elif kind == "pickle":
        np.savez(path, actions=np.array([{}], dtype=object), record=np.array("{}"))
    elif kind == "bomb":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("actions.npy", b"\0" * 2**25)
    else:
        record = {"version": 2 if kind == "newer" else 1, "env_kwargs": {}}
        np.savez(path, actions=np.zeros((1, 3), "f4"), record=np.array(json.dumps(record)))


@pytest.mark.parametrize("kind", ["text", "pickle", "bomb", "newer", "empty"])
def test_what_is_no_ghost_is_refused(tmp_path, kind):
    path = tmp_path / "x.npz"
    broken(kind, path)
    with pytest.raises(ModelMismatch, match=r"is not a ghost \(.+\); give one that"):
        read_ghost(path)
    with pytest.raises(InvalidOption, match="there is no ghost"):
        driver_record(tmp_path / "none.npz")


def test_damaged_ghosts_are_refused(file, tmp_path):
    whole = np.frombuffer(file.read_bytes(), np.uint8)
    rng = np.random.default_rng(0)
    path = tmp_path / "damaged.npz"
    for _ in range(60):
        damaged = whole.copy()
        damaged[rng.integers(0, len(whole), 8)] = rng.integers(0, 256, 8)
        path.write_bytes(damaged.tobytes())
        with suppress(ModelMismatch):
            read_ghost(path)


def test_a_full_disk_is_said_and_leaves_the_previous_ghost(ghost, file, monkeypatch):
    before = file.read_bytes()

    def fill(output, **_):
        output.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", fill)
    with pytest.raises(OutputNotWritable, match=r"No space left on device.*choose another file"):
        ghost.write(file)
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == [file]


def test_a_ghost_is_a_driver_like_others(file):
    record = driver_record(file)
    assert (record.env_id, record.env_kwargs["track"]) == ("Torcs-v0", TRACK)
    assert driver_name(file) == "ghost"
    with gym.make("Torcs-v0", track=TRACK) as env:
        assert isinstance(load_driver(file, env), GhostDriver)


@pytest.mark.parametrize(
    ("kwargs", "said"),
    [({"track": "b-speedway"}, "track 'a-speedway', not 'b-speedway'"),
     ({"track": TRACK, "action_repeat": 2}, "action_repeat 5, not 2"),
     ({"track": TRACK, "gearbox": "road_speed"}, "gearbox 'automatic', not 'road_speed'"),
     ({"track": TRACK, "conditions": {"grip": 0.8}}, "grip 1.0, not 0.8"),
     ({"track": TRACK, "conditions": {"delay": 3}}, "delay 0, not 3"),
     ({"track": TRACK, "opponents": ["bt"]}, "opponents")],
)  # fmt: skip
def test_a_ghost_drives_no_other_race(file, kwargs, said):
    with gym.make("Torcs-v0", **kwargs) as env, pytest.raises(ModelMismatch, match=said):
        load_driver(file, env)


def test_a_ghost_drives_on_no_other_road_of_the_same_name(file, tmp_path):
    own = tmp_path / f"{TRACK}.xml"
    shutil.copy(find_track("b-speedway", find_game()).path, own)
    with (
        gym.make("Torcs-v0", track=str(own)) as env,
        pytest.raises(ModelMismatch, match=rf"with track '.*{TRACK}.xml', not '{own}'"),
    ):
        load_driver(file, env)
    with gym.make("Torcs-v0", track=str(find_track(TRACK, find_game()).path), laps=3) as env:
        load_driver(file, env)


def test_a_ghost_drives_in_no_other_world(file, capsys):
    assert main(["evaluate", str(file), "--env", "TorcsLite-v0", "--track", TRACK]) == 2
    assert "was driven in Torcs-v0, not in TorcsLite-v0" in capsys.readouterr().err
    assert main(["watch", str(file), "--robots", "bt", "--video", "never.mp4"]) == 2
    assert "a ghost drives as it did" in capsys.readouterr().err


def test_after_its_last_action_a_ghost_brakes(ghost):
    action, state = GhostDriver(ghost).predict(np.zeros(29, "f4"), len(ghost.actions))
    assert (action[1], state) == (0.0, len(ghost.actions))
    assert action[2] > 0.0


def test_a_demonstration_fits_a_replay_buffer(ghost):
    rows = demonstration(ghost)
    env = ghost.make_env()
    buffer = ReplayBuffer(len(rows.rewards), env.observation_space, env.action_space, "cpu")
    env.close()
    for row in zip(*rows, strict=True):
        seen, after, action, reward, terminated, truncated = row
        buffer.add(seen, after, action, reward, terminated | truncated, [{}])
    assert buffer.full
    assert not rows.terminated.any()
    assert rows.truncated.tolist() == [False] * (len(rows.truncated) - 1) + [True]
    np.testing.assert_array_equal(rows.observations[1:], rows.next_observations[:-1])


def test_over_the_scr_protocol_a_ghost_drives_the_same_laps(ghost, file):
    sockets = open_ports(1)
    port = sockets[0].getsockname()[1]
    race = RaceSetup(TRACK, [("scr_server", 0)], 3)
    with start_server(find_game(), race, sockets):
        sockets[0].close()
        agent = Agent(str(file), {"track": TRACK, "scr": {"host": "127.0.0.1", "port": port}})
        agent.drive()
    assert tuple(agent.lap_times) == ghost.lap_times


@pytest.mark.parametrize("name", shipped_ghosts())
def test_a_shipped_ghost_is_small_and_drives_the_laps_that_it_says(name):
    shipped = read_ghost(name)
    assert len(shipped.actions) < 5_000
    with shipped.make_env() as env:
        (race,) = evaluate(env, load_driver(name, env))
    assert (race.end, race.damage, tuple(race.lap_times)) == ("laps", 0.0, shipped.lap_times)


# ---- The command ----------------------------------------------------------------------------


def words(path, *more):
    return ["optimize-lap", "scripted", "--track", TRACK, "--out", str(path), *more]


def test_the_command_writes_a_ghost_that_evaluate_drives(tiny, ghost, tmp_path, capsys):
    path = tmp_path / "lap.npz"
    assert main(words(path, "--rollouts", str(ONE_RACE), "--json")) == 0
    said = json.loads(capsys.readouterr().out)
    keys = "track car agent standing_lap flying_lap rollouts seconds ghost"
    assert list(said) == keys.split()
    laps = said["standing_lap"], said["flying_lap"]
    assert laps == (ghost.lap_times[0], min(ghost.lap_times[1:]))
    assert main(["evaluate", str(path), "--json"]) == 0
    (race,) = json.loads(capsys.readouterr().out)["episodes"]
    assert (race["end"], race["damage"]) == ("laps", 0.0)
    assert race["lap_times"] == list(ghost.lap_times)


def test_a_budget_without_a_whole_race_is_said(tiny, tmp_path, capsys):
    assert main(words(tmp_path / "lap.npz", "--rollouts", "3")) == 2
    assert "so no ghost is kept; give more --seconds" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_ctrl_c_before_a_whole_race_is_no_mistake(tiny, tmp_path, monkeypatch, capsys):
    def interrupted(search, budget):
        yield search.state()
        raise KeyboardInterrupt

    monkeypatch.setattr(LapSearch, "run", interrupted)
    assert main(words(tmp_path / "lap.npz")) == 130
    assert capsys.readouterr().err.rstrip().endswith("so no ghost is kept")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("by", [KeyboardInterrupt, SystemExit(143)])
def test_an_interrupted_search_keeps_what_it_found(tiny, ghost, tmp_path, monkeypatch, capsys, by):
    def interrupted(search, budget):
        search.ghost = ghost
        yield search.state()
        raise by

    monkeypatch.setattr(LapSearch, "run", interrupted)
    assert main(words(tmp_path / "lap.npz")) == getattr(by, "code", 130)
    assert "ghost: " in capsys.readouterr().out
    assert read_ghost(tmp_path / "lap.npz").lap_times == ghost.lap_times


def test_a_ghost_on_a_track_file_holds_in_another_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kwargs = ghost_environment(find_driver("scripted"), {"track": "mine.xml"})
    assert kwargs["track"] == str(tmp_path / "mine.xml")
