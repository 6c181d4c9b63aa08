"""Races that the installed game holds itself: the standings of the engine's, from other hands."""

from __future__ import annotations

import json
import os
import signal
import tempfile

import pytest

from sb3_torcs.agents.models import TrainingRecord
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.cli import main
from sb3_torcs.errors import GameFailed, InvalidAction, InvalidOption, ModelMismatch
from sb3_torcs.races import in_the_game
from sb3_torcs.races.entrants import find_entrants
from sb3_torcs.races.in_the_game import run_game_race
from sb3_torcs.races.protocol import run_race

TRACK = "g-track-1"
NOT_TOLD = {"contacts": None}


@pytest.fixture
def alone(monkeypatch, tmp_path):
    """A folder for what is temporary, which is empty again when a race is over."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def as_the_game_tells(race):
    """The standings of a race of the engine, with the gaps of the game."""
    return [{**standing.as_dict(), **NOT_TOLD} for standing in race.standings]


def told(race):
    return [standing.as_dict() for standing in race.standings]


@pytest.mark.parametrize("drivers", [
    ["bt", "inferno", "tita"], ["inferno", "ddpg-aalborg", "bt", "scripted"],
])  # fmt: skip
def test_engine_and_game_come_to_the_same_standings(drivers, game, alone):
    """Cars touch in the second one, and the agents are the game's clients."""
    order = find_entrants(drivers, game)
    raced = run_game_race(order, TRACK, laps=1)
    assert told(raced) == as_the_game_tells(run_race(order, TRACK, laps=1))
    assert list(alone.iterdir()) == []


def test_each_agent_has_the_car_of_its_training(game):
    order = find_entrants(["scripted", "bt", "ddpg-aalborg"], game)
    order[2].agent.car = "car1-ow1"
    assert told(run_game_race(order, TRACK, laps=1)) == as_the_game_tells(
        run_race(order, TRACK, laps=1)
    )


def test_the_command_prints_what_it_prints_of_the_engine(capsys, game):
    words = ["race", "scripted", "bt", "--track", TRACK, "--laps", "1", "--races", "2"]
    assert main([*words, "--json"]) == 0
    engine = json.loads(capsys.readouterr().out)
    assert main([*words, "--json", "--game"]) == 0
    printed = json.loads(capsys.readouterr().out)
    for race in engine["races"]:
        for standing in race["standings"]:
            standing.update(NOT_TOLD)
    for driver in engine["drivers"]:
        driver["damage_per_km"] = None
    assert printed == engine
    assert main([*words, "--game"]) == 0
    bt, scripted = capsys.readouterr().out.splitlines()[-2:]
    assert bt.split()[-1] == scripted.split()[-1] == "-"


def test_more_agents_than_seats_are_refused(game, alone):
    (scripted,) = find_entrants(["scripted"], game)
    with pytest.raises(InvalidOption, match=r"11 agents.*10 seats.*leave out --game"):
        run_game_race([scripted] * 11, TRACK, laps=1)
    assert list(alone.iterdir()) == []


def test_an_agent_that_sees_more_than_the_server_tells_is_refused(game, alone):
    order = find_entrants(["bt", "scripted"], game)
    order[1].agent.record = TrainingRecord(
        env_kwargs={"sensors": ["base", "rivals", "race", "car"]}
    )
    with pytest.raises(
        ModelMismatch, match=r"drives with 'car', 'race', 'rivals', for which.*leave out --game"
    ):
        run_game_race(order, TRACK, laps=1)
    assert list(alone.iterdir()) == []


def test_aids_that_look_at_other_cars_are_refused(game, alone):
    order = find_entrants(["bt", "scripted"], game, ["unstick", "keep_clear"])
    with pytest.raises(ModelMismatch, match=r"'scripted' drives with 'keep_clear', for which"):
        run_game_race(order, TRACK, laps=1)
    assert list(alone.iterdir()) == []


def test_aids_work_in_the_game_as_in_the_engine(game):
    order = find_entrants(["scripted", "bt"], game, ["unstick", "catch_slides"])
    assert told(run_game_race(order, TRACK, laps=1)) == as_the_game_tells(
        run_race(order, TRACK, laps=1)
    )


def test_what_the_game_does_not_tell_cannot_be_drawn(capsys, tmp_path, game):
    picture = tmp_path / "race.png"
    assert main(["race", "bt", "inferno", "--game", "--picture", str(picture)]) == 2
    assert "--picture is for races of the engine; leave out --game" in capsys.readouterr().err


@pytest.fixture
def after_a_while(monkeypatch):
    """Let the scripted driver do something else from its 50th answer in the race on."""

    def replace(deed):
        asked = []
        predict = ScriptedDriver.predict

        def other(self, observation, *words, **options):
            action, state = predict(self, observation, *words, **options)
            asked.append(1)
            return (deed(action) if len(asked) > 50 else action), state

        monkeypatch.setattr(ScriptedDriver, "predict", other)

    return replace


def test_an_agent_that_answers_no_number_ends_the_race(after_a_while, game, alone):
    after_a_while(lambda action: action * float("nan"))
    with pytest.raises(InvalidAction, match="steering is nan"):
        run_game_race(find_entrants(["scripted", "bt", "ddpg-aalborg"], game), TRACK, laps=1)
    assert list(alone.iterdir()) == []


def test_a_game_that_dies_says_so(monkeypatch, after_a_while, game, alone):
    started = []
    start_server = in_the_game.start_server

    def start(*words):
        started.append(start_server(*words))
        return started[0]

    monkeypatch.setattr(in_the_game, "start_server", start)

    def kill(action):
        os.kill(started[0].pid, signal.SIGKILL)
        return action

    after_a_while(kill)
    with pytest.raises(GameFailed, match="the game ended with SIGKILL"):
        run_game_race(find_entrants(["scripted", "bt"], game), TRACK, laps=1)
    assert list(alone.iterdir()) == []


def test_the_way_of_a_race_is_told(game):
    """From 0 to 1, and never back."""
    shares = []
    order = find_entrants(["scripted", "bt"], game)
    for hold in (run_race, run_game_race):
        shares.clear()
        hold(order, TRACK, laps=1, progress=shares.append)
        assert 0.0 <= shares[0] <= shares[-1] <= 1.0
        assert shares == sorted(shares)
