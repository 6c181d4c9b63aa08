"""The agents of the package: small, loadable by stock SB3, and as good as their cards say."""

from __future__ import annotations

import copy
import csv
import json
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_torcs.agents import models
from sb3_torcs.agents.saved import record as model_record
from sb3_torcs.agents.saved.policy import build_policy
from sb3_torcs.cli import main
from sb3_torcs.evaluation.ladder import REFERENCE_FILE

MAX_SIZE = 400_000  # [bytes]
SECTIONS = ("## How it was made", "## What it drives", "## Limits")
AGENTS = models.shipped_agents()
ROOT = Path(__file__).parent.parent
DRIVE = re.compile(r"\n(sb3-torcs evaluate .*)\n```\n\nLaps: ([\d., ]*) s\.")  # in a card
RACE = re.compile(r"\n(sb3-torcs race .*) --races \d+\n```\n\nPlaces: ([\d, ]*)\.")
LINE = re.compile(  # of the leaderboard: driver, flying lap, standing lap, how it was made
    r"^\| \[?([\w-]+).*? \| ([\d.]+) \| ([\d.]+) \|.*`(sb3-torcs .*? --track (\S+).*)` \|$", re.M
)


def card_of(name):
    return (models.AGENTS / name / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", AGENTS)
def test_it_is_small_and_has_a_card(name):
    files = list((models.AGENTS / name).iterdir())
    assert sum(file.stat().st_size for file in files) <= MAX_SIZE
    for section in SECTIONS:
        assert section in card_of(name)


@pytest.mark.parametrize("name", AGENTS)
def test_the_page_of_the_agents_has_it(name):
    """One row each: what it sees, by the record of its training, and how long it learned."""
    (row,) = re.findall(rf"^\| \[`{name}`\].*$", (ROOT / "docs/agents.md").read_text("utf-8"), re.M)
    _, _, _, sees, learned, _ = row.split("|")
    record = models.training_record(models.AGENTS / name / "best_model.zip")
    groups = [group for group in record.env_kwargs.get("sensors", ()) if group != "base"]
    assert sees.partition(", the last")[0].strip() == (", ".join(groups) or "the 29 numbers")
    told = card_of(name) + (ROOT / "LEADERBOARD.md").read_text("utf-8")
    assert learned.replace("timesteps", "").strip() in told


LOAD_EACH = """
import os, sys, stable_baselines3, torch._dynamo
for algo, file in zip(sys.argv[1::2], sys.argv[2::2]):
    if os.fork() == 0:  # a process that has loaded none of the others
        model = getattr(stable_baselines3, algo).load(file)
        action, _ = model.predict(model.observation_space.sample(), deterministic=True)
        print(file, action.shape, flush=True)
        os._exit(0)
    os.wait()
"""


def test_stock_sb3_loads_one_of_each_algorithm():
    files = [models.AGENTS / name / "best_model.zip" for name in AGENTS]
    algorithms = {models.training_record(file).algo.upper(): file for file in files}
    command, told = [sys.executable, "-W", "error", "-c", LOAD_EACH], []
    for algo, file in algorithms.items():
        command += [algo, str(file)]
        told.append(f"{file} {'(3,)' if algo == 'DDPG' else '(2,)'}")
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    assert run.stdout.splitlines() == told, run.stderr


@pytest.mark.parametrize("name", AGENTS)
def test_its_policy_can_be_pickled_and_copied(name):
    """For drivers in other processes."""
    record = models.training_record(models.AGENTS / name / "best_model.zip")
    policy = build_policy(record.policy, record.spaces)
    seen = record.spaces[0].sample()
    for copied in (pickle.loads(pickle.dumps(policy)), copy.deepcopy(policy)):
        action, _ = copied.predict(seen, deterministic=True)
        np.testing.assert_array_equal(action, policy.predict(seen, deterministic=True)[0])


@pytest.mark.parametrize("name", AGENTS)
def test_it_holds_only_what_drives_and_says_so(name, capsys):
    """Its own file tells how it was trained, also under another name elsewhere."""
    record = models.training_record(models.AGENTS / name / "best_model.zip")
    beside = model_record.record_beside(models.AGENTS / name / "best_model.zip")
    assert record.driver_only
    for field in ("algo", "env_id", "hyperparameters"):
        assert getattr(record, field) == getattr(beside, field)
    actor_sensors = record.policy["kwargs"].get("actor_sensors")  # only the critic saw the others
    sees = {} if actor_sensors is None else {"sensors": actor_sensors}
    assert record.env_kwargs == {**beside.env_kwargs, **sees}
    assert main(["train", "--resume", name, "--timesteps", "1"]) == 2
    assert "holds what drives and not what learns" in capsys.readouterr().err


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize("name", AGENTS)
def test_it_drives_what_its_card_says(name, capsys):
    """To the digit, whatever the machine: every command of the card with the laps beneath it."""
    drives = DRIVE.findall(card_of(name))
    assert drives or RACE.search(card_of(name))
    for command, said in drives:
        assert main([*command.split()[1:], "--json"]) == 0
        (episode,) = json.loads(capsys.readouterr().out)["episodes"]
        assert said == ", ".join(f"{seconds:.3f}" for seconds in episode["lap_times"]), command


RACES = [(name, race) for name in AGENTS for race in RACE.findall(card_of(name))]


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize(("races", "number"), [
    (RACES[:1], 1), pytest.param(RACES, 2, marks=pytest.mark.rare),
], ids=["one", "all"])  # fmt: skip
def test_they_race_as_their_cards_say(races, number, capsys):
    """The first races of each command, to save time."""
    for name, (command, said) in races:
        told = [int(place) for place in said.split(", ")][:number]
        assert main([*command.split()[1:], "--races", str(len(told)), "--json"]) == 0
        races = json.loads(capsys.readouterr().out)["races"]
        places = [
            standing["place"]
            for race in races
            for standing in race["standings"]
            if standing["driver"] == name
        ]
        assert places == told, command


def test_the_leaderboard_says_what_cards_and_reference_laps_say():
    """Which the engine drives, as other tests see."""
    text = (Path(__file__).parent.parent / "LEADERBOARD.md").read_text(encoding="utf-8")
    known = {}
    with REFERENCE_FILE.open(encoding="utf-8") as file:
        for row in csv.DictReader(line for line in file if not line.startswith("#")):
            known[row["driver"], row["track"]] = row["best_flying_lap_s"], row["standing_lap_s"]
    for name in AGENTS:
        for command, said in DRIVE.findall(card_of(name)):
            standing, *flying = said.split(", ")
            track = re.findall(r"--track (\S+)", command)
            known.update({(name, *track): (min(flying, key=float), standing)})
    ours = {driver for driver, *_ in known}
    lines = {
        (driver, track): laps
        for driver, *laps, command, track in LINE.findall(text)
        if ":" not in command  # other cars of the robots have no reference laps
    }
    told = {key: tuple(laps) for key, laps in lines.items() if key[0] in ours}
    racers = {name for name in AGENTS if "--env Torcs-v0" in card_of(name)}
    assert {driver for driver, _ in told} >= {"inferno", "scripted", *racers}
    assert told == {key: known.get(key) for key in told}


def test_the_leaderboard_says_the_class_of_each_agent():
    """By what its record says that it sees: rule 2."""
    text = (Path(__file__).parent.parent / "LEADERBOARD.md").read_text(encoding="utf-8")
    told = re.findall(r"^\| \[([\w-]+)\].* \| (post|open) \| `sb3-torcs", text, re.M)
    assert {name for name, _ in told} <= set(AGENTS)
    assert len(told) == len(re.findall(r"^\| \[", text, re.M))
    for name, kind in told:
        sensors = models.driver_record(name).env_kwargs.get("sensors", ["base"])
        assert (kind == "post") == (list(sensors) == ["base"]), name
