"""The conversation with a server: in order, with losses, and when the server is gone."""

from __future__ import annotations

import socket
import time
from array import array
from contextlib import closing, contextmanager

import numpy as np
import pytest
from scr_loopback import COUNTDOWN, Errant, Loopback

from sb3_torcs.backends.scr import ScrBackend
from sb3_torcs.car import Start
from sb3_torcs.errors import MessageBroken, ServerLost, ServerNotFound
from sb3_torcs.scr.client import ScrClient
from sb3_torcs.scr.protocol import ScrAction, format_action, parse_state

ANGLES = np.radians(np.arange(-90.0, 91.0, 10.0))


@contextmanager
def client_of(server, **options):
    """A client whose server has identified it."""
    with closing(ScrClient(server.host, server.port, ANGLES, **options)) as client:
        client.identify()
        yield client


def answer(client, message, steering=0.0):
    client.send(format_action(ScrAction(steering, lap_time=parse_state(message).lap_time)))


def drive(client, ticks):
    """Answer as many states; return what they say."""
    distances = []
    for tick in range(ticks):
        message = client.receive()
        distances.append(parse_state(message).distance_from_start)
        answer(client, message, 0.001 * tick)
    return distances


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        return bound.getsockname()[1]


def test_one_state_follows_each_action():
    with Loopback() as server, client_of(server) as client:
        assert drive(client, COUNTDOWN + 4) == [0.0] * COUNTDOWN + [0.0, 1.0, 2.0, 3.0]
    assert server.inits[0].angles == pytest.approx(ANGLES)
    assert [action.steering for action in server.actions] == [0.001 * n for n in range(7)]


def test_the_end_of_the_race_is_told_once_its_last_state_was():
    with Loopback(ticks=2) as server, client_of(server) as client:
        drive(client, COUNTDOWN + 2)
        assert client.receive() is None
        assert client.over
        assert client.receive() is None
        client.identify()  # the next race
        assert drive(client, COUNTDOWN + 1)[-1] == 0.0


def test_a_restart_begins_anew_where_it_was_asked_for():
    with Loopback() as server, client_of(server) as client:
        drive(client, 20)
        client.restart(Start(100.0, 0.5))
        assert drive(client, COUNTDOWN + 2)[-2:] == [0.0, 1.0]
    assert server.inits[-1].start == Start(100.0, 0.5)


def test_of_several_states_the_newest_is_taken():
    with Loopback() as server, client_of(server) as client:
        first = client.receive()
        for tick in (5, 6, 7):
            server.tick = tick
            server.send_state()
        assert parse_state(client.receive()).distance_from_start == 7.0
        assert first != client._taken


def test_ticks_that_were_lost_are_counted():
    """A state that another one followed, before it was answered or without ever being."""
    with Loopback() as server, client_of(server, latencies=array("d")) as client:
        message = client.receive()
        answer(client, message)  # in time
        message = client.receive()
        for tick in (5, 6, 7):
            server.tick = tick
            server.send_state()
            server.send_state()  # doubled
        answer(client, message)  # late, and 5 and 6 are passed over
        assert parse_state(client.receive()).distance_from_start == 7.0
    assert client.lost == 3


def test_a_state_that_comes_twice_is_taken_once():
    with Loopback() as server, client_of(server) as client:
        message = client.receive()
        server.say(message)
        answer(client, message)
        assert client.receive() != message


def test_an_action_is_said_again_when_no_state_follows():
    with Loopback(mute={0, 2, 3}) as server, client_of(server, pause=0.02) as client:
        assert drive(client, COUNTDOWN + 6)[COUNTDOWN:] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert server.late == 3
    assert len(server.actions) == COUNTDOWN + 6


def test_one_in_twenty_datagrams_lost_and_as_many_doubled_changes_nothing():
    with Loopback() as server, Errant((server.host, server.port)) as network:
        client = ScrClient(network.host, network.port, ANGLES, pause=0.02)
        for _ in range(3):
            client.identify()
            driven = drive(client, 300)
            assert driven[COUNTDOWN:] == list(range(300 - COUNTDOWN))
            client.restart()
        client.close()
    assert network.lost > 50
    assert network.doubled > 50


def test_no_server_is_told_with_what_to_type():
    client = ScrClient("127.0.0.1", free_port(), ANGLES, patience=1.0)
    with pytest.raises(ServerNotFound, match=r"no SCR server answers at 127\.0\.0\.1:\d+.*serve"):
        client.identify()
    client.close()


def test_a_silent_server_is_told_too():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        client = ScrClient(*silent.getsockname(), ANGLES, patience=1.0)
        with pytest.raises(ServerNotFound, match="tried for 1 s"):
            client.identify()
        client.close()


def test_a_host_without_an_address_is_told():
    for host in ("no such host", "b\u00fccher..de"):
        with pytest.raises(ServerNotFound, match=f"{host}:3001 cannot be reached"):
            ScrClient(host, 3001, ANGLES)


def test_a_server_may_come_later():
    servers = []

    def begin():
        if not servers:
            servers.append(Loopback(port=port).__enter__())

    port = free_port()
    client = ScrClient("127.0.0.1", port, ANGLES, watch=begin)
    client.identify()
    drive(client, 5)
    client.close()
    servers[0].stop()


def test_a_server_that_ends_is_noticed_at_once():
    server = Loopback().__enter__()
    with client_of(server, patience=60.0, pause=30.0) as client:
        message = client.receive()
        server.stop()
        with pytest.raises(ServerLost, match="its port is closed"):  # noqa: PT012
            answer(client, message)
            client.receive()


def test_a_server_that_falls_silent_is_given_up_in_time():
    with Loopback() as server, client_of(server, patience=2.0, pause=0.05) as client:
        message = client.receive()
        server.say = lambda message: None
        answer(client, message)
        with pytest.raises(ServerLost, match="nothing came for"):
            client.receive()


def test_a_race_that_somebody_pauses_is_waited_for():
    with Loopback() as server, client_of(server, patience=1.0, silence=60.0, pause=0.02) as client:
        message = client.receive()
        say, until = server.say, time.monotonic() + 2.0
        server.say = lambda message: say(message) if time.monotonic() > until else None
        answer(client, message)
        assert client.receive() != message
        assert time.monotonic() > until


def test_what_watches_the_server_has_the_last_word():
    def watch():
        raise RuntimeError("it has burnt down")

    client = ScrClient("127.0.0.1", free_port(), ANGLES, patience=5.0, watch=watch)
    with pytest.raises(RuntimeError, match="burnt down"):
        client.identify()
    client.close()


class Garbling(Loopback):
    """Sends other bytes instead of states."""

    def __init__(self, words, places):
        super().__init__()
        self.words, self.places, self.sent = words, places, 0

    def send_state(self):
        self.sent += 1
        if self.sent in self.places:
            self.say(self.words)
        else:
            super().send_state()


NAN = b"(angle 0)(curLapTime 0.02)(gear 1)(rpm 10)(speedX nan)(trackPos 0)\0"


@pytest.mark.parametrize("words", [NAN, b"(angle", b"\xff\x00\x01", b""])
def test_a_broken_state_is_left_out_with_one_warning(words):
    with (
        Garbling(words, {4, 7, *range(10, 19)}) as server,
        client_of(server, skips_broken=True, pause=0.01) as client,
    ):
        with pytest.warns(UserWarning, match="is left out") as warned:
            distances = drive(client, 20)
    assert distances[-1] == 20 - COUNTDOWN - 1
    assert len(warned) == 1


def test_a_server_that_sends_nothing_else_is_given_up():
    with Garbling(NAN, range(4, 999)) as server:
        world = ScrBackend("aalborg", host=server.host, port=server.port)
        warns = pytest.warns(UserWarning, match="left out")
        with warns, pytest.raises(MessageBroken, match="speedX"):
            world.reset(np.random.default_rng(0), None)
