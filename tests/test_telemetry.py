"""Drives are Parquet files that anybody reads: every column with its unit, every number exact."""

from __future__ import annotations

import copy
import os

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from conftest import car_state
from made_drives import drive, log_of
from pyarrow import parquet

from sb3_torcs.agents.models import driver_name
from sb3_torcs.agents.robots import race
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.car import Controls
from sb3_torcs.cli import main
from sb3_torcs.errors import DriveFileError, InvalidOption, OutputNotWritable
from sb3_torcs.evaluation.protocol import evaluate, race_environment
from sb3_torcs.evaluation.ticks import log_drives
from sb3_torcs.sensors import SENSORS
from sb3_torcs.telemetry import STATE_FIELDS, DriveLabel, DriveLog, read_drives
from sb3_torcs.telemetry.drives import COLUMNS, LABELS, car_of, controls_of
from sb3_torcs.telemetry.laps import drives_of

LABEL = DriveLabel("ana", "aalborg", "car1-trb1", "Torcs-v0", 2)


def written(tmp_path, log):
    path = tmp_path / "drive.parquet"
    log.write(path)
    return path


def test_pandas_reads_what_was_driven(tmp_path):
    """Without anything of this package: labels, the car's state, its sensors and its controls."""
    log = DriveLog()
    car = car_state(speed_x=1.0 / 3.0, range_finders=np.arange(19.0), wheel_speeds=np.arange(4.0))
    log.add(LABEL, car, Controls(0.25, 0.5, 0.125, gear=3))
    (row,) = pd.read_parquet(written(tmp_path, log)).to_dict("records")
    assert tuple(row[name] for name in LABELS) == LABEL
    assert {name: row[name] for name in STATE_FIELDS} == {
        name: getattr(car, name) for name in STATE_FIELDS
    }
    assert [row[f"range_finder_{n}"] for n in range(19)] == list(range(19))
    assert (row["wheel_speed_front_right"], row["wheel_speed_rear_left"]) == (0.0, 3.0)
    asked = (row["steering"], row["throttle"], row["brake"], row["gear_asked"])
    assert asked == (0.25, 0.5, 0.125, 3)


def test_every_column_has_the_unit_of_the_sensor_table(tmp_path):
    path = written(tmp_path, log_without_gears())
    units = pd.read_parquet(path).attrs["units"]
    assert {s.name: units[s.name] for s in SENSORS if s.name in units} == {
        s.name: s.unit for s in SENSORS if s.name in STATE_FIELDS
    }
    assert (units["wheel_speed_front_left"], units["range_finder_18"]) == ("rad/s", "m")
    stored = {field.name: field.metadata[b"unit"].decode() for field in parquet.read_schema(path)}
    assert {name: stored[name] for name in COLUMNS} == units


def log_without_gears():
    log = DriveLog()
    log.add(LABEL, car_state(), Controls(0.0, 0.0, 0.0))
    return log


def test_a_log_refuses_other_labels_and_other_kinds_of_files(tmp_path):
    with pytest.raises(InvalidOption, match="label is 'x'; give a DriveLabel"):
        DriveLog().add("x", car_state(), Controls(0.0, 0.0, 0.0))
    with pytest.raises(OutputNotWritable, match=r"should end in \.parquet"):
        log_without_gears().write(tmp_path / "drive.csv")


def test_a_gear_that_nobody_asked_for_is_missing(tmp_path):
    assert np.isnan(read_drives(written(tmp_path, log_without_gears()))["gear_asked"][0])


def test_many_rows_stay_in_their_order(tmp_path, oval):
    log = drive(DriveLog(), oval, laps=3)
    time = read_drives(written(tmp_path, log))["time"].to_numpy()
    assert len(time) > 5000
    assert (np.diff(time) > 0.0).all()


def test_an_agents_drive_is_noted_tick_by_tick_and_stays_the_same():
    """The laps are those of an evaluation that nobody notes."""

    def laps(note):
        env = race_environment("TorcsLite-v0", {}, "g-track-1", laps=1)
        log = log_drives(env, "scripted") if note else None
        (episode,) = evaluate(env, ScriptedDriver())
        return episode, log

    alone, _ = laps(note=False)
    noted, log = laps(note=True)
    assert noted == alone
    frame = log.frame()
    assert np.diff(frame["time"]) == pytest.approx(0.02)
    assert len(frame) % 5 == 0
    assert set(frame["driver"]) | set(frame["world"]) == {"scripted", "TorcsLite-v0"}
    assert (set(frame["track"]), set(frame["episode"])) == ({"g-track-1"}, {1})


@pytest.mark.usefixtures("game")
def test_the_car_of_an_episode_is_noted():
    cars = ["car1-trb1", "155-DTM"]
    with gym.make("sb3_torcs:Torcs-v0", track="g-track-1", car=cars) as env:
        log = log_drives(env, "x")
        driven = []
        for seed in range(4):
            env.reset(seed=seed)
            driven.append(env.unwrapped.backend.car)
            env.step(env.action_space.sample())
    noted = log.frame().groupby("episode")["car"].first().tolist()
    assert noted == driven
    assert set(driven) == set(cars)


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize("env_id", ["Torcs-v0", "TorcsLite-v0"])
@pytest.mark.parametrize("start", [None, {"distance": 300.0, "speed": 20.0}])
def test_a_lap_is_cut_at_the_line_wherever_the_drive_begins(env_id, start):
    with race_environment(env_id, {}, "g-track-1", laps=1) as env:
        log, driver = log_drives(env, "x"), ScriptedDriver()
        seen, _ = env.reset(seed=0, options=start)
        over = False
        while not over:
            seen, _, _, over, _ = env.step(driver.predict(seen, deterministic=True)[0])
    ((lap,),) = (drive.laps for drive in drives_of(log.frame()))
    assert lap.standing is (start is None)
    assert (np.diff(lap.rows["lap_time"]) > 0.0).all()
    assert lap.rows["lap_time"].iloc[-1] == pytest.approx(lap.time, abs=0.021)


def test_an_environment_whose_drives_are_noted_can_be_copied():
    env = gym.make("sb3_torcs:TorcsLite-v0", track="g-track-1")
    log_drives(env, "x")
    env.reset(seed=0)
    action = env.action_space.sample()
    other = copy.deepcopy(env)
    assert np.array_equal(env.step(action)[0], other.step(action)[0])


def test_names_that_are_no_text_are_written(tmp_path):
    """A path may hold any bytes."""
    name = os.fsdecode(b"bad\xff")
    assert driver_name(f"{name}.zip") == r"bad\xff"
    with gym.make("sb3_torcs:TorcsLite-v0", track="g-track-1") as env:
        log = log_drives(env, name)
        env.reset(seed=0)
        env.step(env.action_space.sample())
    log.write(tmp_path / "x.parquet")
    assert set(read_drives(tmp_path / "x.parquet")["driver"]) == {r"bad\xff"}


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize("env_id", ["Torcs-v0", "TorcsLite-v0"])
@pytest.mark.parametrize("track", ["aalborg", "road/forza"])
def test_a_track_of_the_game_is_stored_by_its_name(env_id, track):
    with gym.make(f"sb3_torcs:{env_id}", track=track) as env:
        log = log_drives(env, "x")
        env.reset(seed=0)
        env.step(env.action_space.sample())
    assert set(log.frame()["track"]) == {track.removeprefix("road/")}


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize(
    "kwargs", [{}, {"conditions": {"delay": 2, "sensor_noise": True}}, {"opponents": ["scripted"]}]
)
def test_who_looks_on_draws_no_noise(kwargs):
    """What an agent sees is the same to the bit, where each control tick is noted."""
    made = {"track": "g-track-1", "conditions": {"sensor_noise": True}, **kwargs}
    alone, noted = (gym.make("sb3_torcs:Torcs-v0", **made) for _ in range(2))
    log_drives(noted, "x")
    seen = [env.reset(seed=3)[0] for env in (alone, noted)]
    for _ in range(10):
        assert np.array_equal(*seen)
        seen = [env.step(np.array([0.1, 0.8, 0.0], np.float32))[0] for env in (alone, noted)]
    for env in (alone, noted):
        env.close()


@pytest.mark.usefixtures("game")
def test_robots_write_their_drive(tmp_path):
    log = DriveLog()
    (result,) = race([("bt", 3)], "dirt-1", 1, log=log)
    log.write(tmp_path / "drive.parquet")
    drives = read_drives(tmp_path / "drive.parquet")
    assert set(drives["driver"]) == {"bt:3"}
    assert drives["last_lap_time"].iloc[-1] == result.laps[0].time


@pytest.mark.usefixtures("game")
def test_a_row_is_the_car_and_its_controls_again():
    log = DriveLog()
    race([("bt", 3)], "dirt-1", 1, log=log)
    ((label, rows),) = log.episodes().items()
    assert log.tracks[label].name == "dirt-1"
    assert car_of(rows[-1]).laps == 1
    assert car_of(rows[50])[:23] == tuple(rows[50, :23])
    assert controls_of(rows[50])[:3] == tuple(rows[50, -4:-1])


def test_a_file_appears_when_it_is_whole(tmp_path, oval):
    with pytest.raises(OutputNotWritable, match="choose another file"):
        log_of(oval, ("ana", 20.0)).write(tmp_path / "nowhere" / "drive.parquet")
    (tmp_path / "taken.parquet").mkdir()
    with pytest.raises(OutputNotWritable):
        log_of(oval, ("ana", 20.0)).write(tmp_path / "taken.parquet")
    assert [path.name for path in tmp_path.iterdir()] == ["taken.parquet"]


def test_what_is_no_drive_is_told(tmp_path, oval):
    path = written(tmp_path, log_of(oval, ("ana", 20.0)))
    whole = path.read_bytes()
    damaged = bytearray(whole)
    column = parquet.read_metadata(path).row_group(0).column(len(LABELS))
    damaged[column.data_page_offset + column.total_compressed_size - 1] ^= 1  # one bit of a number
    for content in (b"", b"PAR1", whole[: len(whole) // 2], whole[:-1], damaged):
        path.write_bytes(content)
        with pytest.raises(DriveFileError, match=r"cannot be read as a drive .*; write it anew"):
            read_drives(path)
    with pytest.raises(DriveFileError, match="there is no file"):
        read_drives(tmp_path / "none.parquet")
    pd.DataFrame({"time": [1.0]}).to_parquet(path)
    with pytest.raises(DriveFileError, match="it has no column driver, track, car; write"):
        read_drives(path)
    DriveLog().write(path)
    with pytest.raises(DriveFileError, match="holds no rows"):
        read_drives(path)


@pytest.mark.parametrize(("change", "says"), [
    (lambda frame: frame.assign(driver=None), "who drove where"),
    (lambda frame: frame.assign(distance_from_start=float("nan")), "distance is no number"),
    (lambda frame: frame.assign(speed_x=float("nan")), "column speed_x has rows without a number"),
    (lambda frame: frame.assign(x=float("inf")), "column x has rows without a number"),
    (lambda frame: frame.iloc[::-1], "out of order"),
    (lambda frame: frame.assign(driver=7), "world is no text that a terminal can show"),
    (lambda frame: frame.assign(driver="\x1b[31mana"), "a terminal can show"),
    (lambda frame: frame.assign(lap_time=None), "column lap_time holds no numbers"),
    (lambda frame: frame.assign(steering="left"), "column steering holds no numbers"),
])  # fmt: skip
def test_rows_that_are_no_drive_are_told(tmp_path, oval, change, says):
    path = written(tmp_path, log_of(oval, ("ana", 20.0)))
    change(pd.read_parquet(path)).to_parquet(path)
    with pytest.raises(DriveFileError, match=rf"is damaged: .*{says}; write it anew"):
        read_drives(path)


def test_a_car_that_the_physics_lost_is_still_a_drive(tmp_path):
    """Such a car stands somewhere, but its wheels and its engine may turn at no number."""
    state = car_state(wheel_speeds=np.full(4, np.nan), engine_speed=np.nan, fuel=np.nan)
    log = DriveLog()
    log.add(LABEL, state, Controls(0.0, 0.0, 0.0))
    assert len(read_drives(written(tmp_path, log))) == 1


def test_a_pipe_is_no_drive(tmp_path):
    os.mkfifo(tmp_path / "drive.parquet")
    with pytest.raises(DriveFileError, match="is no file"):
        read_drives(tmp_path / "drive.parquet")


def test_an_evaluation_writes_its_drives_as_parquet(tmp_path, capsys):
    path = tmp_path / "drive.parquet"
    words = "evaluate scripted --env TorcsLite-v0 --track g-track-1 --laps 1 --episodes 2"
    assert main([*words.split(), "--telemetry", str(path)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"telemetry: {path}"
    assert read_drives(path)["episode"].unique().tolist() == [1, 2]
