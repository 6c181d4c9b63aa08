"""``sb3-torcs compete``: an agent as an ordinary client in a race that runs elsewhere."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import pytest
from scr_loopback import Loopback

from sb3_torcs.cli import main
from sb3_torcs.scr.server import open_ports, start_server
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.race_setup import RaceSetup

pytestmark = pytest.mark.usefixtures("game")


@pytest.fixture
def race():
    """A race for one client, in real time; its port."""
    sockets = open_ports(1)
    setup = RaceSetup("a-speedway", [("scr_server", 0)], laps=1)
    # A busy machine may take its time here: what is late is tested where the server is.
    with start_server(find_game(), setup, sockets, deadline=2.0) as process:
        port = sockets[0].getsockname()[1]
        sockets[0].close()
        yield port, process


def test_an_agent_drives_to_the_end_and_says_how_long_it_took(race, capsys):
    port, process = race
    words = ["compete", "scripted", "--port", str(port), "--track", "a-speedway", "--json"]
    assert main(words) == 0
    figures = json.loads(capsys.readouterr().out)
    assert set(figures) == {
        "laps", "lap_times", "distance", "ticks", "lost_ticks", "latency_ms",
    }  # fmt: skip
    assert figures["laps"] == len(figures["lap_times"]) == 1
    assert figures["lost_ticks"] == 0
    assert figures["ticks"] == pytest.approx(figures["lap_times"][0] / 0.02, abs=60)
    latency = figures["latency_ms"]
    assert 0.0 < latency["median"] <= latency["p99"] <= latency["longest"]
    process.wait(10.0)
    (late,) = re.findall(r"control ticks, (\d+) late", process.words())
    assert late == "0"


def test_for_people_it_prints_three_lines(race, capsys):
    """Whoever sees nothing of the road ahead drives any, and has to be told no track."""
    port, process = race
    words = ["compete", "scripted", "--port", str(port)]
    assert main([*words, "--name", "Ann Other"]) == 0
    ready, awaiting, first, second, third = capsys.readouterr().out.splitlines()
    assert ready == f"scripted is being loaded for the race at 127.0.0.1, UDP port {port}"
    assert awaiting.startswith(f"waiting for the SCR server at 127.0.0.1, UDP port {port}")
    assert "calls itself Ann Other" in process.words()
    assert re.fullmatch(r"lap times s: [\d.]+; \d+ m", first)
    assert re.fullmatch(r"lost ticks: \d+; answers: \d+", second)
    assert re.fullmatch(r"answer ms: median .*, 99 % within .*, longest .*", third)


@pytest.mark.parametrize(("name", "instead"), [
    ("bad;name( Zoe", "bad_name_ Zoe"), ("x" * 32, "x" * 31), ("Zoë", "Zo_"), ("", "Ann Other"),
])  # fmt: skip
def test_a_name_that_the_game_cannot_draw_is_refused(name, instead, capsys):
    assert main(["compete", "scripted", "--name", name]) == 2
    out, err = capsys.readouterr()
    assert f"--name is '{name}'; expected 1 to 31 letters, digits, single spaces and -_.:+@" in err
    assert err.endswith(f"; type --name '{instead}'\n")
    assert out == ""


@pytest.mark.parametrize("words", [
    ["compete", "ppo-racer"], ["watch", "ppo-racer-roads", "--track", "aalborg"],
])  # fmt: skip
def test_an_agent_of_whose_sensors_the_server_tells_too_little_is_told_what_else_races_it(
    words, game, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    err = capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    told = r"'(ppo-[\w-]+)' drives with '\w+'.* tells too little; `(sb3-torcs race \1 |--video)"
    assert re.search(told, err)


def test_a_server_that_is_not_there_is_told(monkeypatch, capsys):
    monkeypatch.setattr("sb3_torcs.backends.scr.PATIENCE_WITH_OTHERS", 0.2)
    (bound,) = open_ports(1)
    port = bound.getsockname()[1]
    bound.close()
    assert main(["compete", "scripted", "--port", str(port)]) == 2
    out, err = capsys.readouterr()
    assert f"waiting for the SCR server at 127.0.0.1, UDP port {port}" in out
    assert f"no SCR server answers at 127.0.0.1:{port}" in err


def test_what_it_waits_for_is_told_before_anything_is_loaded():
    """The command says it with its first breath: torch and the model take seconds."""
    (bound,) = open_ports(1)
    port = bound.getsockname()[1]
    call = [sys.executable, "-X", "importtime", "-m", "sb3_torcs.cli", "compete", "scripted"]
    process = subprocess.Popen(
        [*call, "--port", str(port)], text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    loaded = []
    for line in process.stdout:
        if f"is being loaded for the race at 127.0.0.1, UDP port {port}" in line:
            break
        loaded.append(line.split("|")[-1].strip())
    bound.close()
    process.kill()
    process.communicate()
    assert "argparse" in loaded
    assert not {"torch", "stable_baselines3", "numba"} & set(loaded)


def test_an_agent_that_sees_the_road_tells_which_it_takes_the_track_to_be(monkeypatch, capsys):
    monkeypatch.setattr("sb3_torcs.backends.scr.PATIENCE_WITH_OTHERS", 0.2)
    (bound,) = open_ports(1)
    port = str(bound.getsockname()[1])
    bound.close()
    assert main(["compete", "ppo-aalborg", "--port", port]) == 2
    told = "ppo-aalborg takes aalborg to be the track; give another one with --track"
    assert told in capsys.readouterr().out
    for words in (["ppo-aalborg", "--track", "forza"], ["ppo-post-roads"]):
        assert main(["compete", *words, "--port", port]) == 2
        assert "to be the track" not in capsys.readouterr().out


class Dying(Loopback):
    """A server that ends without a word."""

    def send_state(self):
        self.ending = self.tick > 100
        if not self.ending:
            super().send_state()


def test_what_was_driven_is_told_though_the_server_is_lost(capsys):
    with Dying() as server:
        words = ["compete", "scripted", "--host", server.host, "--port", str(server.port), "--json"]
        assert main(words) == 2
    out, err = capsys.readouterr()
    assert json.loads(out)["distance"] >= 100.0
    assert "its port is closed" in err
