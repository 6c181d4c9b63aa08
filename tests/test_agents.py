"""The agents of the package: small, loadable by stock SB3, and as good as their cards say."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import pytest

from sb3_torcs import models
from sb3_torcs.cli import main

MAX_SIZE = 8_000_000  # [bytes]
SECTIONS = ("## How it was made", "## What it drives", "## Limits")
AGENTS = models.shipped_agents()


def card_of(name):
    return (models.AGENTS / name / "README.md").read_text(encoding="utf-8")


def test_there_are_some():
    assert "ddpg-aalborg" in AGENTS


@pytest.mark.parametrize("name", AGENTS)
def test_it_is_small_and_has_a_card(name):
    files = list((models.AGENTS / name).iterdir())
    assert sum(file.stat().st_size for file in files) <= MAX_SIZE
    for section in SECTIONS:
        assert section in card_of(name)


@pytest.mark.parametrize("name", AGENTS)
def test_stock_sb3_loads_it(name):
    code = (
        "import sys; from stable_baselines3 import DDPG; model = DDPG.load(sys.argv[1]);"
        "print(model.predict(model.observation_space.sample(), deterministic=True)[0].shape)"
    )
    file = models.AGENTS / name / "best_model.zip"
    command = [sys.executable, "-W", "error", "-c", code, str(file)]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    assert run.stdout == "(3,)\n"


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize("name", AGENTS)
def test_it_drives_what_its_card_says(name, capsys):
    """To the digit, whatever the machine: every command of the card with the laps beneath it."""
    drives = re.findall(r"\n(sb3-torcs evaluate .*)\n```\n\n(.*)", card_of(name))
    assert drives
    for command, said in drives:
        assert main([*command.split()[1:], "--json"]) == 0
        (episode,) = json.loads(capsys.readouterr().out)["episodes"]
        laps = ", ".join(f"{seconds:.3f}" for seconds in episode["lap_times"])
        assert said.startswith(f"Laps: {laps} s."), command
