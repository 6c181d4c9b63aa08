"""``sb3-torcs serve``: the game for clients of every language, from the first word to the last."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from processes import PATIENCE, gone, processes_of
from third_party import ThirdParty

from sb3_torcs.cli import main
from sb3_torcs.torcs.display import VirtualDisplay

pytestmark = pytest.mark.usefixtures("game")


STARTED = []  # the commands of a test


def free_ports(number=1):
    """The first of some neighbouring ports that are free now."""
    for port in range(20000 + os.getpid() % 20000, 60000, 10):
        sockets = []
        try:
            for place in range(number):
                sockets.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                sockets[-1].bind(("127.0.0.1", port + place))
            return port
        except OSError:
            continue
        finally:
            for bound in sockets:
                bound.close()
    raise AssertionError("no free port")


@pytest.fixture
def folder(tmp_path):
    """Where everything private goes; nothing may be left in it, and no command runs on."""
    yield tmp_path
    for process in STARTED:
        process.kill()
        process.communicate()
    STARTED.clear()
    assert list(tmp_path.glob("sb3-torcs-*")) == []


def serve(folder, port, *words, **variables):
    call = [sys.executable, "-m", "sb3_torcs.cli", "serve", "--port", str(port), *words]
    STARTED.append(subprocess.Popen(
        call, env={**os.environ, "TMPDIR": str(folder), **variables}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ))  # fmt: skip
    return STARTED[-1]


def games_of(folder):
    """Processes of the game that run in a folder."""
    return processes_of(folder, b"torcs-bin")


def test_no_process_is_ended_by_pkill_torcs(folder):
    """Clients of gym_torcs call it before they start a game of their own."""
    port = free_ports()
    process = serve(folder, port)
    with ThirdParty(port) as client:
        client.identify()
        pids = [process.pid, *games_of(folder)]
        assert len(pids) == 2
        names = [Path(f"/proc/{pid}/comm").read_text().strip() for pid in pids]
    process.terminate()
    process.communicate(timeout=PATIENCE)
    assert names == ["sb3-racing", "racing-game"]


def test_a_client_drives_a_race_to_its_end(folder):
    port = free_ports()
    process = serve(folder, port, "--track", "a-speedway", "--laps", "1", "--wait")
    with ThirdParty(port) as client:
        client.identify()
        assert client.drive() == b"***shutdown***\0"
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, err
    assert f"waiting for SCR clients at 127.0.0.1, UDP port {port}; the game waits" in out
    assert f"scr_server 0: {client.address}: {client.answers} control ticks, 0 late" in out
    assert f"{client.address}, car1-trb1, a-speedway" in out


def test_the_race_goes_on_when_the_reader_leaves(folder):
    """As of `sb3-torcs serve | head -1`: the clients have come for the race."""
    port = free_ports()
    process = serve(folder, port, "--track", "a-speedway", "--laps", "1", "--wait")
    assert "waiting for SCR clients" in process.stdout.readline()
    process.stdout.close()
    with ThirdParty(port) as client:
        client.identify()
        assert client.drive() == b"***shutdown***\0"
    assert process.wait(PATIENCE) == 141
    assert process.stderr.read() == ""
    process.stderr.close()


def test_two_clients_race_against_a_robot(folder):
    port = free_ports(2)
    words = ("--track", "michigan", "--drivers", "2", "--robots", "inferno", "--laps", "1")
    process = serve(folder, port, *words, "--wait", "--car", "155-DTM")
    with ThirdParty(port) as one, ThirdParty(port + 1) as other:
        one.identify()
        other.identify()
        last = [b"", b""]
        while not all(message.startswith(b"***") for message in last):
            for place, client in enumerate((one, other)):
                if not last[place].startswith(b"***"):
                    last[place] = client.drive(1)
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, err
    assert f"UDP ports {port} to {port + 1}" in out
    assert "race on michigan" in out
    names = re.findall(r"^ +[123]  (\S+)(?: 3)? +(?:155-DTM|car1-trb1) ", out, re.MULTILINE)
    assert sorted(names) == sorted([one.address, other.address, "inferno:3"])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_whatever_ends_it_nothing_is_left(folder, number):
    port = free_ports()
    process = serve(folder, port, "--wait")
    with ThirdParty(port) as client:
        client.identify()
        client.drive(20)
        assert len(games_of(folder)) == 1
        process.send_signal(number)
        _, err = process.communicate(timeout=PATIENCE)
        if number != signal.SIGKILL:
            assert client.last() == b"***shutdown***\0"
        assert process.returncode == (130 if number == signal.SIGINT else -9)
        if number == signal.SIGINT:
            assert "sb3-torcs: interrupted" in err
    # A game without its owner ends itself.
    assert gone(lambda: games_of(folder), lambda: list(folder.iterdir()))


def test_a_client_that_thinks_too_long_loses_ticks_and_is_told(folder):
    port = free_ports()
    process = serve(folder, port, "--track", "a-speedway", "--laps", "1", "--deadline", "2")
    with ThirdParty(port) as client:
        client.identify()
        client.drive(40, think=0.012)
        process.send_signal(signal.SIGINT)  # by states this old nobody comes round
        out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, err
    assert "2 ms per answer" in out
    (told,) = re.findall(r"^scr_server 0: .*: (\d+) control ticks, (\d+) late", out, re.MULTILINE)
    ticks, late = map(int, told)
    assert late >= 40
    assert ticks > client.answers


def test_what_was_driven_until_it_is_ended_is_told(folder):
    port = free_ports(2)
    words = ("--track", "a-speedway", "--drivers", "2", "--robots", "inferno", "--laps", "9")
    process = serve(folder, port, *words, "--wait")
    with ThirdParty(port) as one, ThirdParty(port + 1) as other:
        one.identify()
        other.identify()
        for _ in range(100):
            one.drive(1)
            other.drive(1)
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=PATIENCE)
        assert one.last() == other.last() == b"***shutdown***\0"
    assert re.search(rf"scr_server 0: {one.address}: 10\d control ticks, 0 late", out)
    assert "the race was ended early:\nrace on a-speedway\n" in out
    results = out.partition("the race was ended early")[2]
    assert results.count(" no\n") == 3  # nobody is out
    assert other.address in results


def test_what_clients_do_wrong_is_told_while_the_race_runs(folder):
    port = free_ports()
    process = serve(folder, port, "--wait")
    assert "waiting for SCR clients" in process.stdout.readline()
    with ThirdParty(port) as client, ThirdParty(port) as stranger:
        client.identify()
        assert f"{client.address} drives" in process.stdout.readline()
        stranger.socket.sendto(b"XYZ(init)", stranger.server)
        client.drive(1)
        assert f"{stranger.address} says 'XYZ(init)', not SCR(init" in process.stdout.readline()
        stranger.socket.sendto(b"SCR(init)", stranger.server)
        client.drive(1)
        assert f"{stranger.address} wants to drive, but" in process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=PATIENCE)


def test_options_of_other_servers_are_there(folder):
    port = free_ports()
    words = ("--no-fuel", "--no-damage", "--no-lap-limit", "--noisy", "--track", "a-speedway")
    process = serve(folder, port, *words, "--laps", "1", "--wait")
    with ThirdParty(port) as client:
        client.identify()
        message = client.socket.recv(2000)
        fuel = re.search(rb"\(fuel \S+\)", message)[0]
        assert len(set(re.search(rb"\(track ([^)]*)\)", message)[1].split())) == 19  # they err
        client.socket.sendto(client.action(message), client.server)
        client.drive(400)
        assert fuel in client.socket.recv(2000)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=PATIENCE)


def test_a_window_shows_the_race(folder):
    port = free_ports()
    with VirtualDisplay((320, 240)) as display:
        words = ("--track", "a-speedway", "--laps", "1", "--wait", "--window")
        process = serve(folder, port, *words, DISPLAY=display.name)
        with ThirdParty(port) as client:
            client.identify()
            assert client.drive(100) != b""
            windows = subprocess.run(
                ["xwininfo", "-root", "-tree", "-display", display.name],
                capture_output=True, text=True, check=True,
            )  # fmt: skip
            assert "torcs" in windows.stdout.lower()
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, err
    assert games_of(folder) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--deadline", "0"], "--deadline is 0 ms; expected 0.001 to 3.6e+06, or --wait"),
        (["--deadline", "0.0001"], "--deadline is 0.0001 ms"),
        (["--deadline", "inf"], "--deadline is inf ms"),
        (["--drivers", "11"], "--drivers is 11; expected 1 to 10"),
        (["--track", "nowhere.xml"], "there is no track file"),
        (["--host", "::1"], "choose another with --port, or another address with --host"),
        (["--track", "forzza"], "no track 'forzza'; did you mean 'forza'?"),
        (["--robots", ""], "robot '': expected NAME"),
        (["--robots", "inferno:3,inferno:3"], "robot 'inferno:3' is named twice; name each"),
        (["--robots", "infernal"], "no robot 'infernal'; did you mean 'inferno'?"),
        (["--car", "car1-trb9"], "no car 'car1-trb9'; did you mean"),
        (["--port", "65530", "--drivers", "9"], "ports end at 65535"),
    ],
)
def test_what_cannot_be_served(words, message, capsys):
    assert main(["serve", *words]) == 2
    assert message in capsys.readouterr().err


def test_a_port_that_is_taken_is_named(capsys):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        assert main(["serve", "--port", str(port)]) == 2
    assert f"UDP port {port} at 127.0.0.1 cannot be had" in capsys.readouterr().err
