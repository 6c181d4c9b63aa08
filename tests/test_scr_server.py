"""The game's driver module, by what goes over the wire: clients here are bare UDP sockets.

They wait in lock-step for the game, so that nothing here depends on the speed of a machine, but for
what is about deadlines.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import random
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import PATIENCE, gone

from sb3_torcs import _engine
from sb3_torcs.backends.native import make_engine
from sb3_torcs.scr.server import open_ports, start_server
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.race_setup import RaceSetup
from sb3_torcs.torcs.starting_list import AGENT
from sb3_torcs.tracks.trial import check_track

INIT = "SCR(init " + " ".join(str(angle) for angle in range(-90, 91, 10)) + ")"
STAND = "(accel 0)(brake 1)(gear 0)(steer 0)"  # as cars do before a start
DRIVER = ("scr_server", 0)


class Client:
    """One end of the conversation."""

    def __init__(self, port):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(PATIENCE)
        self.socket.connect(("127.0.0.1", port))

    def send(self, text):
        self.socket.send(text if isinstance(text, bytes) else text.encode())

    def receive(self):
        return self.socket.recv(4096)

    def ask(self, text):
        self.send(text)
        return self.receive()

    def identify(self, start=""):
        assert self.ask(INIT + start) == b"***identified***\0"

    def begin(self, start=""):
        """Introduce itself, and return the first state."""
        self.identify(start)
        return self.receive()

    def insist(self):
        """Introduce itself once a second, as clients do, until the server takes it."""
        self.socket.settimeout(1.0)
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            with contextlib.suppress(TimeoutError):
                assert self.ask(INIT) == b"***identified***\0"
                self.socket.settimeout(PATIENCE)
                return
        raise AssertionError("nobody answers")

    def restart(self, start=""):
        assert self.ask("(meta 1)") == b"***restart***\0"
        return self.begin(start)

    def nothing_comes(self, seconds=0.05):
        self.socket.settimeout(seconds)
        try:
            with pytest.raises(TimeoutError):
                self.socket.recv(4096)
        finally:
            self.socket.settimeout(PATIENCE)


@pytest.fixture
def serve(game):
    """Start a game and its clients, in the order of the drivers."""
    started = []

    def start(drivers=(DRIVER,), track="aalborg", deadline=None, options=(), **race):
        clients = [index for name, index in drivers if name == "scr_server"]
        session = "practice" if len(drivers) == 1 else "race"
        sockets = open_ports(len(clients))
        setup = RaceSetup(track, drivers, session=session, **race)
        process = start_server(game, setup, sockets, deadline=deadline, options=options)
        ends = [Client(bound.getsockname()[1]) for bound in sockets]
        started.extend([*sockets, *(end.socket for end in ends), process])
        return process, *ends

    yield start
    for each in started:
        each.stop() if isinstance(each, GameProcess) else each.close()


@pytest.fixture
def pair(serve):
    """Two clients in one race, of whom the first has its first state."""
    process, first, second = serve([DRIVER, ("scr_server", 1)])
    first.identify()
    second.identify()
    return process, first, second, first.receive()


@pytest.fixture
def another():
    """Make other clients of the server that a client talks to."""
    with contextlib.ExitStack() as stack:

        def make(client, kind=Client):
            made = kind(client.socket.getpeername()[1])
            stack.callback(made.socket.close)
            return made

        yield make


def await_words(process, words):
    until = time.monotonic() + PATIENCE
    while words not in process.words() and time.monotonic() < until:
        time.sleep(0.05)
    return words in process.words()


def results(process):
    return "".join(f.read_text() for f in (process.folder / "results").rglob("*.xml"))


def numbers(state, tag):
    """Read the numbers of a tag."""
    found = re.search(rf"\({tag} ([^()]*)\)", state.decode())
    assert found, f"no {tag} in {state!r}"
    return [float(word) for word in found[1].split()]


def number(state, tag):
    (value,) = numbers(state, tag)
    return value


def controls(state):
    """Drive by what is seen: steering, throttle, brake and gear."""
    speed, ahead = number(state, "speedX"), numbers(state, "track")[9]
    steering = 1.5 * number(state, "angle") - 0.3 * number(state, "trackPos")
    gear, rpm = int(number(state, "gear")), number(state, "rpm")
    if gear < 1:
        gear = 1
    elif rpm > 8500 and gear < 6:
        gear += 1
    elif rpm < 4000 and gear > 1:
        gear -= 1
    target = min(250.0, 40.0 + ahead)
    return max(-1.0, min(1.0, steering)), float(speed < target), 0.5 * (speed > target + 10), gear


def action(state):
    steering, throttle, brake, gear = controls(state)
    return f"(accel {throttle!r})(brake {brake!r})(gear {gear})(steer {steering!r})"


def skip_countdown(client):
    state = client.receive()
    while number(state, "curLapTime") < 0.0:
        state = client.ask(STAND)
    return state


def drive(client, state, ticks):
    """Return the states of so many timesteps."""
    states = []
    for _ in range(ticks):
        states.append(state)
        state = client.ask(action(state))
    client.send(action(state))
    return states


# ---- The texts ----------------------------------------------------------------------------------


class TestTexts:
    def test_a_state(self):
        si = [0.1, 12.345678, 3.0, 100.0, 1234.567, 94.0, -1.0, 81.474]
        si += [200.0] * 35 + [7.5]
        si += [2.0, 915.2, 10.0, -1.0, 0.0]
        si += [-1.0] * 19
        si += [-0.25, 1.0, 2.0, 3.0, 4e-7, 0.345, *[-1.0] * 5, 0.125]
        opponents = " ".join(["200"] * 35 + ["7.5"])
        text, exact = (_engine.scr_format_state(si, exact=full).decode() for full in (False, True))
        assert exact.startswith("(angle 0.1)(curLapTime 12.345678)(damage 3)")
        assert exact.endswith("(focus -1 -1 -1 -1 -1)(yawRate 0.125)\0")
        assert text == (
            "(angle 0.1)(curLapTime 12.3457)(damage 3)(distFromStart 100)(distRaced 1234.57)"
            f"(fuel 94)(gear -1)(lastLapTime 81.474)(opponents {opponents})(racePos 2)(rpm 9152)"
            f"(speedX 36)(speedY -3.6)(speedZ 0)(track {' '.join(['-1'] * 19)})(trackPos -0.25)"
            "(wheelSpinVel 1 2 3 4e-07)(z 0.345)(focus -1 -1 -1 -1 -1)\0"
        )

    def test_it_takes_microseconds(self):
        values = [math.pi * i for i in range(80)]
        began = time.process_time()
        for _ in range(10000):
            _engine.scr_format_state(values)
        assert (time.process_time() - began) / 10000 < 20e-6

    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            (b"", (0.0, 0.0, 1, 0.0, 0.0, False, 0.0, None)),
            (
                b"(accel 0.5)(brake 0.25)(gear 3)(steer -0.1)(clutch 0.75)(focus 90)(meta 1)\0",
                (0.5, 0.25, 3, -0.1, 0.75, True, math.pi / 2, None),
            ),
            (b"(meta 0)(steer 1e-3) (gear -1)\n", (0.0, 0.0, -1, 1e-3, 0.0, False, 0.0, None)),
            (b"(accel 7)(brake -1)(steer -3)(clutch 2)(gear 99)",
             (1.0, 0.0, 8, -1.0, 1.0, False, 0.0, None)),
            (b"(accel nan)(brake inf)(steer x)(gear)", (0.0, 0.0, 1, 0.0, 0.0, False, 0.0, None)),
            (b"(accel +1)(steer .5)(gear 2.0)", (1.0, 0.0, 2, 0.5, 0.0, False, 0.0, None)),
            (b"(focus -91)", (0.0, 0.0, 1, 0.0, 0.0, False, None, None)),
            (b"(focus -90 -45 0)", (0.0, 0.0, 1, 0.0, 0.0, False, -math.pi / 2, None)),
            (b"(accel 1)\0(brake 1)", (1.0, 0.0, 1, 0.0, 0.0, False, 0.0, None)),
            (b"((accel 1)(steering 1)(Accel 0", (1.0, 0.0, 1, 0.0, 0.0, False, 0.0, None)),
            (b"(accel 1)(curLapTime 12.34)", (1.0, 0.0, 1, 0.0, 0.0, False, 0.0, 12.34)),
        ],
    )  # fmt: skip
    def test_an_action(self, text, expected):
        assert _engine.scr_parse_action(text) == expected

    @pytest.mark.parametrize("angles", [range(19), (), (1, 2, 3), ("x",)])
    def test_an_introduction(self, angles):
        """Whose angles are 19 numbers, or the usual ones."""
        text = b"SCR(init " + " ".join(map(str, angles)).encode() + b")"
        expected = angles if len(angles) == 19 else range(-90, 91, 10)
        for start in (None, (1.5, -0.5, 0.1, 20.0)):
            found = _engine.scr_parse_init(text + (b" (start 1.5 -0.5 0.1 20)" if start else b""))
            assert found[:2] == ([math.radians(angle) for angle in expected], start)

    @pytest.mark.parametrize(
        ("text", "name"),
        [
            (b"SCR(init)(name ddpg-aalborg)", "ddpg-aalborg"),
            (b"SCR(init)(name  Ann  Other )", "Ann  Other"),
            (b"SCR(init)(name <a&b>/\xff)", "_a_b___"),
            (b"SCR(init)(name " + b"x" * 40 + b")", "x" * 31),  # as many as the game has room for
            (b"SCR(init)", ""),
        ],
    )
    def test_an_introduction_with_a_name(self, text, name):
        assert _engine.scr_parse_init(text)[3] == name

    def test_whatever_comes_has_a_meaning(self):
        source = random.Random(2)
        words = [b"(", b")", b" ", b"accel", b"steer", b"gear", b"focus", b"init", b"start", b"\0",
                 b"1e999", b"-nan", b"0.5", b"-", b"+", b"\xff", b"1" * 400]  # fmt: skip
        for _ in range(20000):
            text = b"".join(source.choices(words, k=source.randrange(40)))
            throttle, brake, gear, steering, clutch, *_ = _engine.scr_parse_action(text)
            assert 0.0 <= throttle <= 1.0
            assert 0.0 <= brake <= 1.0
            assert 0.0 <= clutch <= 1.0
            assert -1.0 <= steering <= 1.0
            assert -1 <= gear <= 8
            angles, *_ = _engine.scr_parse_init(text)
            assert len(angles) == 19
            assert all(math.isfinite(angle) for angle in angles)


# ---- A race -------------------------------------------------------------------------------------


class TestRace:
    def test_the_countdown(self, serve):
        _, client = serve()
        state = client.begin()
        assert state.startswith(b"(angle ")
        assert state.endswith(b")\0")
        assert number(state, "curLapTime") == pytest.approx(-0.98, abs=0.021)
        assert number(state, "distFromStart") == pytest.approx(2487.54, abs=0.1)
        assert (number(state, "gear"), number(state, "racePos")) == (0, 1)
        assert number(state, "fuel") == 94
        assert len(numbers(state, "track")) == 19
        assert len(numbers(state, "opponents")) == 36
        before = number(state, "distFromStart")
        for _ in range(20):
            state = client.ask("(accel 1)(gear 1)")
        assert number(state, "distFromStart") == before

    def test_the_angles_of_the_range_finders(self, serve):
        _, client = serve()
        half = "SCR(init " + " ".join(str(angle / 2) for angle in range(-90, 91, 10)) + ")"
        assert client.ask(half) == b"***identified***\0"
        narrow = numbers(client.receive(), "track")
        wide = numbers(client.restart(), "track")
        assert narrow[1::2] == wide[5:14]  # -40, -30, ... degrees

    @pytest.mark.parametrize(
        ("track", "ticks"), [("aalborg", 5000), ("corkscrew", 1500), ("michigan", 3500)]
    )
    def test_its_senses_are_those_of_the_engine(self, serve, game, track, ticks):
        _, client = serve(track=track)
        client.identify()
        follow(client, make_engine(game, track, [AGENT]), 0, ticks)

    def test_among_robots_too(self, serve, game):
        robots = [("inferno", 3), ("berniw", 3), ("bt", 2)]
        _, client = serve([*robots, DRIVER])
        client.identify()
        engine = make_engine(game, "aalborg", [*robots, AGENT], session="race")
        follow(client, engine, 3, 800)

    def test_focus_rests_for_a_second(self, serve):
        _, client = serve()
        assert numbers(client.begin(), "focus") == [-1] * 5  # nobody has asked yet
        seen = []
        state = client.ask(STAND)
        for _ in range(160):
            if numbers(state, "focus") != [-1] * 5:
                seen.append((number(state, "curLapTime"), numbers(state, "focus")))
            state = client.ask(STAND + "(focus 30)")
        assert len(seen) == 3
        assert seen[0][0] == pytest.approx(0.0, abs=0.021)
        assert seen[1][0] - seen[0][0] == pytest.approx(1.0, abs=0.021)
        assert seen[0][1][2] == pytest.approx(numbers(state, "track")[12], rel=1e-3)
        for _ in range(120):
            state = client.ask(STAND + "(focus 91)")
        assert numbers(state, "focus") == [-1] * 5

    def test_off_the_road(self, serve):
        _, client = serve()
        client.identify(" (start 300 1.2 0 0)")
        state = client.ask(STAND)
        assert numbers(state, "track") == [-1] * 19
        assert numbers(state, "focus") == [-1] * 5

    def test_two_drivers(self, serve):
        _, first, second = serve([("scr_server", 1), DRIVER])
        first.send(INIT)  # driver 0, at the second place: its turn comes last
        second.identify()
        assert first.receive() == b"***identified***\0"
        states = []
        for _ in range(60):
            states = [second.receive()]
            second.send(STAND)
            states.append(first.receive())
            first.send(STAND)
        assert [number(state, "racePos") for state in states] == [1, 2]
        assert min(numbers(states[0], "opponents")) == min(numbers(states[1], "opponents")) < 20

    def test_the_end(self, serve):
        process, client = serve(track="michigan", laps=1)
        states = [client.begin()]
        while not states[-1].startswith(b"***"):
            states.append(client.ask(action(states[-1])))
        assert states[-1] == b"***shutdown***\0"
        assert number(states[-2], "lastLapTime") > 60
        client.nothing_comes()
        process.wait(PATIENCE)
        told = re.search(r"scr_server 0: [\d.:]+: (\d+) control ticks, 0 late", process.words())
        assert told
        assert int(told[1]) == pytest.approx(len(states), abs=2)

    def test_a_car_that_is_out_still_sees(self, serve):
        """Who is too slow is taken out of the race; its client may ask for another one."""
        _, client = serve()
        first = state = client.begin()
        while number(state, "z") < 1.0:  # until a crane lifts it
            state = client.ask(STAND)
            assert not state.startswith(b"***")
        assert client.restart() == first


def follow(client, engine, car, ticks, start=None):
    """Drive the same in the game and in the engine; all that is sensed must be written the same."""
    engine.start_at(*start) if start else engine.start()
    state = skip_countdown(client)
    for tick in range(ticks):
        expected, seen = as_text(engine.read(car)), state.decode().split("(focus")[0]
        assert seen == expected, f"at tick {tick}"
        steering, throttle, brake, gear = controls(state)
        engine.step(steering, throttle, brake, gear, 1)
        state = client.ask(action(state))


def as_text(car):
    """What the SCR server would say of a car, but for the focus."""
    km_per_hour = 3.6
    values = {
        "angle": [car.heading_error], "curLapTime": [car.lap_time], "damage": [car.damage],
        "distFromStart": [car.distance_from_start], "distRaced": [car.distance_raced],
        "fuel": [car.fuel], "gear": [car.gear], "lastLapTime": [car.last_lap_time],
        "opponents": car.opponents, "racePos": [car.race_position],
        "rpm": [10 * car.engine_speed], "speedX": [km_per_hour * car.speed_x],
        "speedY": [km_per_hour * car.speed_y], "speedZ": [km_per_hour * car.speed_z],
        "track": car.range_finders,
        "trackPos": [2 * car.distance_from_axis / car.track_width],
        "wheelSpinVel": car.wheel_speeds, "z": [car.height],
    }  # fmt: skip
    return "".join(
        f"({name} {' '.join(f'{value:g}' for value in row)})" for name, row in values.items()
    )


class TestStarts:
    STARTS = (
        (500.0, 0.0, 0.0, 0.0),
        (1200.0, 0.4, 0.1, 25.0),
        (0.0, 0.0, 0.0, 30.0),
        (2580.0, -0.2, -0.1, 40.0),  # the line is crossed at once
    )

    @pytest.mark.parametrize("start", STARTS)
    @pytest.mark.parametrize("robots", [[], [("inferno", 3), ("bt", 2)]])
    def test_as_the_engine_does_it(self, serve, game, start, robots):
        _, client = serve([*robots, DRIVER])
        client.identify(" (start " + " ".join(repr(value) for value in start) + ")")
        session = "race" if robots else "practice"
        engine = make_engine(game, "aalborg", [*robots, AGENT], session=session)
        follow(client, engine, len(robots), 300, start)

    def test_by_turns(self, serve):
        _, client = serve()
        grid = client.begin()
        starts = ("(start 700 0 0 20)", "", "(start 700 0 0 20)")
        places = [client.restart(start) for start in starts]
        assert places[0] == places[2]
        assert places[1] == grid
        assert number(places[0], "distFromStart") == pytest.approx(700, abs=0.1)
        assert number(places[0], "speedX") == pytest.approx(72)
        assert number(places[0], "curLapTime") == 0

    @pytest.mark.parametrize("start", ["(start 99999 0 0 0)", "(start 300 4.9 0 0)"])
    def test_a_place_that_cannot_be_had(self, serve, start):
        process, client = serve()
        state = client.begin(start)
        assert number(state, "curLapTime") < 0
        assert number(state, "damage") == 0
        assert number(state, "distFromStart") == pytest.approx(2487.54, abs=0.1)
        assert "no start at" in process.words()
        assert client.restart() == state


class TestRestart:
    ROBOTS = (("inferno", 3), ("berniw", 3), ("bt", 2))

    @pytest.mark.parametrize("robots", [(), ROBOTS])
    def test_the_same_drive_again(self, serve, robots):
        _, client = serve([*robots, DRIVER])
        first = drive(client, client.begin(), 400)
        client.receive()
        for _ in range(2):
            assert drive(client, client.restart(), 400) == first
            client.receive()
        _, fresh = serve([*robots, DRIVER])
        assert drive(fresh, fresh.begin(), 400) == first

    def test_robots_that_learn_begin_anew(self, serve):
        """bt would write down what it learned, and drive otherwise from its first corner on."""
        _, client = serve([("bt", 1), DRIVER], track="g-track-1", laps=3)
        start = " (start 100 0 0 10)"
        first = drive(client, client.begin(start), 1500)
        client.receive()
        assert drive(client, client.restart(start), 450) == first[:450]

    def test_asked_for_while_another_driver_thinks(self, pair):
        _, first, second, _ = pair
        first.send(STAND)
        second.receive()
        first.send("(meta 1)")  # before the state that it might answer
        second.send(STAND)
        while not second.receive().startswith(b"***restart***"):
            second.send(STAND)
        assert first.receive() == b"***restart***\0"

    def test_the_server_names_who_asks_and_who_does_not_come_back(self, pair):
        """A client that ends at a restart would stop the race without a sign."""
        process, first, second, _ = pair
        first.send("(meta 1)")
        assert first.receive() == second.receive() == b"***restart***\0"
        first.identify()
        assert await_words(process, "restarts the race, for all clients")
        gone = f"127.0.0.1:{second.socket.getsockname()[1]}"
        assert await_words(process, f"scr_server 1: the race waits for {gone}")
        second.identify()
        second.send(STAND)
        assert first.receive().startswith(b"(angle ")

    def test_often(self, serve):
        process, client = serve()
        first = client.begin()
        for i in range(300):
            assert client.restart() == first
            if i == 50:
                before = memory(process.pid)
        assert memory(process.pid) - before < 500
        assert process.poll() is None

    def test_one_asks_and_all_begin_anew(self, pair):
        _, first, second, state = pair
        began = [state]
        first.send(STAND)
        began.append(second.receive())
        second.send("(meta 1)")
        assert first.receive() == second.receive() == b"***restart***\0"
        second.send(INIT)  # in any order
        first.identify()
        assert second.receive() == b"***identified***\0"
        assert first.receive() == began[0]
        first.send(STAND)
        assert second.receive() == began[1]

    def test_who_missed_the_word_asks_again(self, serve):
        _, client = serve()
        client.begin()
        assert client.ask("(meta 1)") == client.ask("(meta 1)") == b"***restart***\0"
        client.identify()


class Original:
    """
    A client as the first Python programs for this protocol have it, one object for each episode.

    It asks for a restart by ``meta``, opens another socket without closing the one before, and
    introduces itself once a second until it is heard. It does not wait for ``***restart***``.
    """

    ANGLES = "-45 -19 -12 -7 -4 -2.5 -1.7 -1 -.5 0 .5 1 1.7 2.5 4 7 12 19 45"

    def __init__(self, port):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(1.0)
        self.server = ("127.0.0.1", port)

    def introduce(self):
        self.socket.sendto(f"SCR(init {self.ANGLES})".encode(), self.server)

    def connect(self):
        message = b""
        until = time.monotonic() + PATIENCE
        while b"***identified***" not in message:
            assert time.monotonic() < until, "nobody answers"
            self.introduce()
            with contextlib.suppress(TimeoutError):
                message = self.socket.recv(2**17)
        return self.state()

    def state(self):
        """The next state: words are passed over, but for those that end the episode."""
        while b"***identified***" in (message := self.socket.recv(2**17)):
            pass
        assert not message.startswith(b"***"), f"a new episode began with {message}"
        return message

    def answer(self, meta=0):
        text = f"(accel 0.200)(brake 0.000)(clutch 0.000)(gear 1)(steer 0.000)(meta {meta})"
        self.socket.sendto(text.encode(), self.server)


@contextlib.contextmanager
def stopped(process):
    """Let what is sent meanwhile wait for the game, all at once."""
    os.kill(process.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(process.pid, signal.SIGCONT)


class TestOriginalClients:
    """A restart, and at once another socket that introduces itself: always the new race."""

    EPISODES = 20

    @pytest.mark.parametrize("deadline", [None, 0.2])
    @pytest.mark.parametrize("metas", [1, 2])  # at the end of `step`, and again in `reset`
    @pytest.mark.parametrize("at_once", [True, False])
    def test_each_episode_begins_on_the_grid(self, serve, another, deadline, metas, at_once):
        process, known = serve(deadline=deadline)
        client = another(known, Original)
        first = state = client.connect()
        for _ in range(self.EPISODES):
            assert state == first
            for _ in range(3):
                client.answer()
                client.state()
            with stopped(process) if at_once else contextlib.nullcontext():
                for _ in range(metas):
                    client.answer(meta=1)
                client = another(known, Original)
                if at_once:
                    client.introduce()
            state = client.connect()
        assert process.poll() is None

    def test_also_of_a_client_that_owes_answers(self, serve, another):
        """The game awaits the late answers to older states, but none after a wish to restart."""
        process, known = serve(deadline=0.2)
        client = another(known, Original)
        first = client.connect()
        assert client.state() != first  # is not answered in time
        with stopped(process):
            client.answer(meta=1)
            client = another(known, Original)
            client.introduce()
        assert client.connect() == first


def memory(pid):
    """Read what a process has in memory [kB]."""
    return int(re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())[1])


class TestOptions:
    """What other servers call -nofuel, -nodamage, -nolaptime and -noisy."""

    INTO_THE_WALL = " (start 300 0.9 0.5 60)"

    def test_without_them_cars_use_fuel_and_take_damage(self, serve):
        _, client = serve()
        last = drive(client, client.begin(self.INTO_THE_WALL), 100)[-1]
        assert number(last, "fuel") < 94
        assert number(last, "damage") > 0

    def test_no_fuel_is_used(self, serve):
        _, client = serve(options=["nofuel"])
        states = drive(client, client.begin(), 400)
        assert {number(state, "fuel") for state in states} == {94.0}
        assert number(states[-1], "distRaced") > 50.0

    def test_damage_is_told_but_not_taken(self, serve):
        """Clients learn from it; the car stays as it was, and so say the results."""
        process, client = serve([DRIVER, ("inferno", 3)], options=["nodamage"], laps=1)
        last = drive(client, client.begin(self.INTO_THE_WALL), 100)[-1]
        assert number(last, "damage") > 0
        client.receive()
        assert number(client.restart(), "damage") == 0
        client.identify()
        process.end_race()
        assert set(re.findall(r'"dammages" val="(\d+)"', results(process))) == {"0"}

    def test_a_slow_lap_goes_on(self, serve):
        """Who stands is taken out of the race after 343 s on this track; see above."""
        _, client = serve(options=["nolaptime"])
        state = client.begin()
        height = number(state, "z")
        while number(state, "curLapTime") < 400.0:
            state = client.ask(STAND)
        assert number(state, "z") == pytest.approx(height, abs=0.01)
        while number(state, "distRaced") < 100.0:  # and the lap ends as any other one
            state = client.ask(action(state))
        while number(state, "distRaced") < 250.0:
            state = client.ask(action(state))
            assert not state.startswith(b"***")
        assert number(state, "speedX") > 10.0

    def test_noise_is_new_in_each_race_and_the_same_in_each_session(self, serve):
        def readings():
            _, client = serve(options=["noisy"])
            return [numbers(state, "track") for state in (client.begin(), client.restart())]

        _, exact = serve()
        true = numbers(exact.begin(), "track")
        first, second = readings()
        assert first != second
        ratios = [noisy / value for noisy, value in zip(first + second, true + true, strict=True)]
        assert all(0.5 < ratio < 1.5 for ratio in ratios)
        assert len(set(ratios)) > 30
        assert readings() == [first, second]

    def test_one_that_there_is_not(self, serve):
        process, _ = serve(options=["nodamage", "nobrakes"])
        process._process.wait(PATIENCE)
        assert "names 'nobrakes'; it may name nofuel" in process.words()


class TestTheEnd:
    """The owner ends the race: SIGTERM."""

    @pytest.mark.parametrize("deadline", [None, 0.5])
    def test_clients_are_told_and_results_are_kept(self, serve, deadline):
        process, client = serve([DRIVER, ("inferno", 3)], deadline=deadline)
        drive(client, client.begin(" (name Ann Other)"), 50)
        process.end_race()
        assert process.poll() == 0
        while not (message := client.receive()).startswith(b"***"):
            pass
        assert message == b"***shutdown***\0"
        assert re.search(r"scr_server 0: Ann Other at 127.0.0.1:\d+: 5\d control ticks, ",
                         process.words())  # fmt: skip
        assert '<attstr name="name" val="Ann Other"/>' in results(process)

    def test_also_before_the_race(self, serve):
        process, first, second = serve([("scr_server", 1), DRIVER])
        second.send(INIT)
        assert second.receive() == b"***identified***\0"
        process.end_race()
        assert process.poll() == 0
        assert second.receive() == b"***shutdown***\0"
        assert "scr_server 0: nobody: 0 control ticks, 0 late" in process.words()
        del first

    def test_who_has_no_name_goes_by_the_address(self, serve):
        process, client = serve()
        client.begin()
        process.end_race()
        address = f"127.0.0.1:{client.socket.getsockname()[1]}"
        assert f'"driver name" val="{address}"' in results(process)


class TestThinking:
    """Clients that wait for the game and let it wait for them."""

    def test_a_game_that_waits_is_driven_the_same_at_any_speed(self, serve):
        def driven(pauses):
            state = client.receive()
            states = []
            for pause in pauses:
                time.sleep(pause)
                states.append(state)
                state = client.ask(action(state))
            client.ask("(meta 1)")
            client.identify(" (start 100 0 0 20)")
            return states

        _, client = serve()
        client.identify(" (start 100 0 0 20)")
        quick = driven([0.0] * 40)
        assert driven([0.012] * 40) == quick
        assert driven([0.2] * 5) == quick[:5]


# ---- What goes wrong ----------------------------------------------------------------------------


class TestLostAndDoubled:
    def test_introductions_that_queued_are_one(self, serve):
        process, client = serve()
        with stopped(process):
            for _ in range(3):
                client.send(INIT)
        assert client.receive() == b"***identified***\0"
        assert client.receive().startswith(b"(angle ")

    def test_a_doubled_action_is_taken_once(self, serve):
        """By a client that says which state it answers."""
        _, client = serve()
        client.identify()
        state = skip_countdown(client)
        for _ in range(50):
            answer = f"{STAND}(curLapTime {number(state, 'curLapTime'):g})"
            client.send(answer)
            client.send(answer)
            following = client.receive()
            while following == state:  # was sent again, to who seemed to have missed it
                following = client.receive()
            step = number(following, "curLapTime") - number(state, "curLapTime")
            assert 0.019 < step < 0.023
            state = following

    def test_a_lost_state_is_sent_again(self, serve):
        _, client = serve()
        state = client.begin()
        answer = f"{STAND}(curLapTime {number(state, 'curLapTime'):g})"
        lost = client.ask(answer)
        assert client.ask(answer) == lost

    def test_strangers_are_not_heard(self, serve, another):
        _, client = serve()
        client.begin()
        stranger = another(client)
        stranger.send("(meta 1)")
        client.nothing_comes()
        assert client.ask(STAND).startswith(b"(angle ")

    def test_a_client_that_comes_back(self, serve, another):
        process, client = serve()
        before = drive(client, client.begin(), 30)[-1]
        last = client.receive()
        other = another(client)
        other.insist()
        assert other.receive() == last != before
        assert other.ask(STAND).startswith(b"(angle ")
        client.nothing_comes()
        assert "takes over from 127.0.0.1:" in process.words()

    @pytest.mark.parametrize("deadline", [None, 0.5])
    def test_a_second_client_waits_until_the_first_one_is_silent(self, serve, another, deadline):
        process, client = serve(deadline=deadline)
        state = client.begin()
        other = another(client)
        for _ in range(30):
            other.send(INIT)
            state = client.ask(action(state))
            assert state.startswith(b"(angle ")
        other.nothing_comes()
        own, strange = (f"127.0.0.1:{c.socket.getsockname()[1]}" for c in (client, other))
        told = f"scr_server 0: {strange} wants to drive, but {own} does; end one of them"
        assert process.words().count(told) == 1
        other.insist()  # while the first one says nothing

    def test_a_restart_is_no_chance_for_a_second_client(self, serve, another):
        _, client = serve()
        first = client.begin()
        other = another(client)
        other.send(INIT)
        client.ask(STAND)
        assert client.ask("(meta 1)") == b"***restart***\0"
        other.send(INIT)
        other.nothing_comes()
        assert client.begin() == first
        assert client.ask("(meta 1)") == b"***restart***\0"
        other.insist()  # while the first one does not come back

    def test_who_is_not_asked_is_not_silent(self, pair, another):
        """The other driver thinks longer than a client may be silent."""
        _, first, second, _ = pair
        first.send(STAND)
        second.receive()
        stranger = another(first)
        time.sleep(2.5)
        stranger.send(INIT)
        second.send(STAND)
        assert first.receive().startswith(b"(angle ")
        stranger.nothing_comes()

    @pytest.mark.parametrize("word", ["XYZ", "championship2011", "scr", "\x01\x02"])
    def test_a_wrong_identifier_is_told(self, serve, another, word):
        process, client = serve()
        stranger = another(client)
        for _ in range(3):
            stranger.send(f"{word}(init)")
        client.begin()
        address = f"127.0.0.1:{stranger.socket.getsockname()[1]}"
        said = f"{word}(init)".replace("\x01", "?").replace("\x02", "?")[:20]
        told = f"scr_server 0: {address} says '{said}', not SCR(init ...), and is not heard"
        assert process.words().count(told) == 1

    def test_no_stranger_fills_the_disk(self, serve, another):
        process, client = serve()
        state = client.begin()
        for number in range(150):
            stranger = another(client)
            stranger.send(f"hello {number}")
            state = client.ask(action(state))
        assert (process.folder / "words").read_text().count("is not heard") < 100

    def test_garbage(self, serve):
        process, client = serve()
        client.send(b"\xff" * 900)
        client.send("hello")
        state = client.begin()
        for text in (b"\xff\0(" * 300, b"", b"(" * 1000, b"(steer " * 1000, b"\0"):
            state = client.ask(text)
            assert state.startswith(b"(angle ")
        assert process.poll() is None


class TestDeadline:
    def test_answers_that_are_missing_are_counted(self, serve):
        process, client = serve(deadline=2.0, track="michigan", laps=1)
        drive(client, client.begin(), 100)
        for _ in range(3):
            client.receive()
        state = client.receive()
        while not state.startswith(b"***"):
            state = client.ask(action(state))
        process.wait(PATIENCE)
        assert re.search(r"\d+ control ticks, 3 late", process.words())

    def test_a_slow_client_is_reported_while_it_drives(self, serve):
        process, client = serve(deadline=0.001)
        client.identify()
        assert await_words(process, " is too slow: 10 of ")

    def test_late_answers_are_counted_and_used(self, serve):
        """A client that thinks for three deadlines: the game goes on meanwhile."""
        process, client = serve(deadline=0.02)
        client.identify()
        times, speeds = [], []
        state = client.receive()
        for _ in range(12):
            time.sleep(0.06)
            state = newest(client, state)
            times.append(number(state, "curLapTime"))
            speeds.append(number(state, "rpm"))
            client.send(f"(accel 1)(gear 1)(curLapTime {times[-1]:g})")
        steps = [after - before for before, after in itertools.pairwise(times)]
        assert min(steps) > 0.03
        assert speeds[0] < 1000
        assert max(speeds) > 3000
        assert process.poll() is None

    def test_who_was_late_once_does_not_lag_behind(self, serve):
        """A client that answers state after state, and does not say which."""
        process, client = serve(deadline=2.0)
        state = client.begin()
        time.sleep(2.2)
        for _ in range(20):
            before, state = state, client.ask(STAND)
            time.sleep(0.005)
        assert state != before
        client.nothing_comes()
        assert process.poll() is None

    def test_a_silent_client_stands_on_the_brake(self, serve):
        _, client = serve(deadline=0.001)
        state = client.begin()
        before = number(state, "distFromStart")
        while number(state, "curLapTime") < 2.0:
            state = client.receive()
        assert number(state, "distFromStart") == pytest.approx(before, abs=0.1)


def newest(client, state):
    """Read all that has come."""
    client.socket.setblocking(False)
    try:
        while True:
            state = client.receive()
    except BlockingIOError:
        return state
    finally:
        client.socket.settimeout(PATIENCE)


START_AND_WAIT = """
import sys, time
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.race_setup import RaceSetup
from sb3_torcs.scr.server import open_ports, start_server
sockets = open_ports(1)
game = start_server(find_game(), RaceSetup("aalborg", [("scr_server", 0)]), sockets)
print(game.pid, game.folder, sockets[0].getsockname()[1], flush=True)
time.sleep(600)
"""


class TestOrphans:
    @pytest.mark.parametrize("racing", [False, True])
    def test_a_game_ends_with_who_started_it(self, game, racing):
        owner = subprocess.Popen([sys.executable, "-c", START_AND_WAIT], stdout=subprocess.PIPE)
        pid, folder, port = owner.stdout.readline().split()
        client = Client(int(port))
        if racing:
            client.begin()
        owner.kill()
        owner.wait()
        owner.stdout.close()
        client.socket.close()
        assert gone(Path(folder.decode()).exists, Path(f"/proc/{int(pid)}/fd").exists)


class TestAlone:
    """The module as a user's own game has it: it binds the usual ports itself."""

    def test_a_port_that_is_taken(self, game):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            with contextlib.suppress(OSError):  # then somebody else has it: just as well
                taken.bind(("0.0.0.0", 3001))
            with GameProcess(game, RaceSetup("aalborg", [DRIVER]), check=check_track) as process:
                process._process.wait(PATIENCE)
                assert process.poll() == 1
                assert "UDP port 3001 cannot be had" in process.words()

    @pytest.mark.parametrize("deadline", ["soon", "-1", "0", "10ms", ""])
    def test_a_deadline_that_is_none(self, game, deadline):
        variables = {"SB3_TORCS_SCR_DEADLINE": deadline}
        race = RaceSetup("aalborg", [DRIVER])
        with GameProcess(game, race, check=check_track, environment=variables) as process:
            process._process.wait(PATIENCE)
            assert "set it to wait or to microseconds" in process.words()
