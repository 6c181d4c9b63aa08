"""The video of a race: who is where, what the board says, and whom the camera follows."""

from __future__ import annotations

import signal
from types import SimpleNamespace

import numpy as np
import pytest
from stadium import COASTING, stadium, state

from sb3_torcs.agents.drivers import find_drivers
from sb3_torcs.cli import main
from sb3_torcs.cli.race import _followed
from sb3_torcs.races import protocol, standings, video
from sb3_torcs.races.protocol import run_race
from sb3_torcs.races.video import Footage, Moment, gaps
from sb3_torcs.rendering.board import Field, Row
from sb3_torcs.rendering.viewer import Viewer
from sb3_torcs.telemetry import STATE_FIELDS

BEND = stadium(0.025)
GREEN = (0, 255, 0)


def footage(ways, length=100.0, out=(False, False), finished_at=()):
    """Record cars at these places [m] from the line, the first one in front, moment by moment."""
    made = Footage()
    made.names = ["a", "b"]
    made.road = SimpleNamespace(length=length)
    made.behind = np.array([10.0, 20.0])
    for number, places in enumerate(ways):
        cars = np.zeros((2, len(STATE_FIELDS)))
        cars[:, STATE_FIELDS.index("time")] = 0.04 * number
        for slot, place in enumerate(places):
            cars[slot, STATE_FIELDS.index("distance_raced")] = place + made.behind[slot]
            cars[slot, STATE_FIELDS.index("race_position")] = slot + 1
            cars[slot, STATE_FIELDS.index("laps")] = max(place, 0.0) // length
        finished = np.full(2, number in finished_at)
        made.moments.append(Moment(cars, np.zeros((2, 5)), finished, np.array(out)))
    return made


def test_a_gap_is_the_time_since_the_leader_was_there():
    """The leader drives 4 m in each of the pictures, which are 0.04 s apart."""
    told = gaps(footage([(-4.0, -14.0), (0.0, -10.0), (4.0, -6.0), (8.0, 2.0)]), laps=1)
    assert told == [["", ""], ["", ""], ["", ""], ["", "+0.06"]]


def test_the_gap_of_a_car_that_stands_grows():
    told = gaps(footage([(0.0, -4.0), *[(4.0 * n, 2.0) for n in range(1, 5)]]), laps=1)
    assert [texts[1] for texts in told[1:]] == ["+0.02", "+0.06", "+0.10", "+0.14"]


def test_who_is_laps_behind_is_told_laps():
    told = gaps(footage([(0.0, -10.0), (150.0, 49.0), (290.0, 49.0)]), laps=5)
    assert [texts[1] for texts in told] == ["", "+1 LAP", "+2 LAPS"]


def test_a_gap_is_final_behind_the_flag():
    """The cars reach the line at 100 m in the second and in the fourth picture."""
    way = [(90.0, 80.0), (100.0, 90.0), (110.0, 95.0), (120.0, 100.0), (130.0, 140.0)]
    told = gaps(footage(way, finished_at=(3, 4)), laps=1)
    assert [texts[1] for texts in told[1:]] == ["+0.04", "+0.06", "+0.08", "+0.08"]


def test_who_is_out_is_told_so():
    assert gaps(footage([(10.0, 5.0)], out=(False, True)), laps=1) == [["", "out"]]


def test_the_last_gaps_are_those_of_the_standings(game):
    made = Footage()
    race = run_race(find_drivers(["tita", "bt"]), "g-track-1", laps=1, watchers=[made])
    first, second = race.standings
    assert sorted(gaps(made, 1)[-1]) == ["", f"+{second.time - first.time:.2f}"]


def test_the_other_cars_and_the_board_are_in_the_picture():
    car, other = state(BEND, 30.0), state(BEND, 45.0)
    rows = [Row("1", "bt", "", GREEN, False), Row("2", "ddpg-\N{GREEK SMALL LETTER PI}", "+0.42",
                                                  (214, 62, 44), True)]  # fmt: skip
    viewer = Viewer(size=(320, 320))
    alone = viewer.frame(BEND, car, COASTING, None)
    raced = viewer.frame(BEND, car, COASTING, None, Field([(other, GREEN)], "LAP 1 of 2", rows))
    assert np.array_equal(viewer.frame(BEND, car, COASTING, None), alone)

    def greens(picture):
        return (np.abs(picture.astype(int) - GREEN) < 60).all(axis=2).sum()

    assert greens(alone) == 0
    assert greens(raced[:, 140:180]) > 20, "the car ahead is on the road"
    assert greens(raced[66:150, :60]) > 20, "and its colour on the board"


@pytest.fixture
def written(monkeypatch):
    """The pictures of videos and how many they should be, instead of files."""
    videos = []
    monkeypatch.setattr(
        "sb3_torcs.rendering.encoder.write_video",
        lambda path, frames, fps, total, encoding: videos.append((path, list(frames), total)),
    )
    return videos


@pytest.mark.parametrize(("agents", "followed"), [({"a", "b"}, "b"), ({"a"}, "a"), (set(), "a")])
def test_the_camera_follows_the_best_agent_or_else_the_first_driver(agents, followed):
    drivers = [SimpleNamespace(name=n, robot=None if n in agents else (n, 0)) for n in "abc"]
    race = SimpleNamespace(standings=[SimpleNamespace(driver=name) for name in "cba"])
    assert _followed(drivers, race) == followed


def test_the_first_race_is_recorded_as_if_nobody_looked(
    written, monkeypatch, capsys, game, tmp_path
):
    monkeypatch.setattr(video, "FPS", 0.2)
    words = ["race", "scripted", "bt", "--track", "g-track-1", "--laps", "1", "--races", "2",
             "--json"]  # fmt: skip
    assert main(words) == 0
    unseen = capsys.readouterr().out
    assert main([*words, "--video", str(tmp_path / "race.mp4")]) == 0
    assert capsys.readouterr().out == unseen
    ((path, frames, total),) = written
    assert path == tmp_path / "race.mp4"
    assert len(frames) == total > video.LAST_PICTURE + 8
    assert {frame.shape for frame in frames} == {(720, 960, 3)}


@pytest.mark.parametrize(("ends", "said"), [
    (KeyboardInterrupt(), "drawing the video of the first race; Ctrl-C again leaves it out"),
    (SystemExit(143), "no video, since the command was told to end"),  # by SIGTERM
])  # fmt: skip
def test_ctrl_c_draws_and_sigterm_ends(ends, said, monkeypatch, capsys, game, tmp_path):
    held = protocol.run_race

    def run_race(*arguments, **options):
        if options["seed"] == 1:
            raise ends
        return held(*arguments, **options)

    drawn = []
    monkeypatch.setattr(protocol, "run_race", run_race)
    monkeypatch.setattr(video.Footage, "save", lambda self, path, *_: drawn.append(path))
    words = ["race", "scripted", "bt", "--track", "g-track-1", "--laps", "1", "--json"]
    file = tmp_path / "race.mp4"
    by_hand = isinstance(ends, KeyboardInterrupt)
    assert main([*words, "--video", str(file)]) == (130 if by_hand else 143)
    told = capsys.readouterr().err
    assert "sb3-torcs: 1 of 20 races were held\n" in told
    assert said in told
    assert drawn == ([file] if by_hand else [])


def test_a_signal_while_the_figures_are_computed_loses_none(monkeypatch, capsys, game):
    computed = standings.driver_figures

    def figures(races):
        signal.raise_signal(signal.SIGTERM)
        return computed(races)

    monkeypatch.setattr(standings, "driver_figures", figures)
    words = ["race", "bt", "lliaw", "--track", "g-track-1", "--laps", "1", "--races", "1"]
    with pytest.raises(SystemExit):
        main(words)
    assert "last race, seed 0" in capsys.readouterr().out


def test_the_game_draws_the_race_with_the_board(written, monkeypatch, capsys, game, tmp_path):
    """The camera follows the agent, who starts last; another view is another picture."""
    monkeypatch.setattr(video, "FPS", 0.05)
    monkeypatch.setattr(video, "LAST_PICTURE", 1)
    monkeypatch.setattr(video, "GAME_SIZE", (320, 240))
    words = ["race", "scripted", "bt", "--track", "g-track-1", "--laps", "1", "--races", "1"]
    for view in ("behind", "cockpit"):
        assert main([*words, "--view", view, "--video", str(tmp_path / "race.mp4")]) == 0
    for _, frames, total in written:
        assert len(frames) == total >= 4
        assert {frame.shape for frame in frames} == {(240, 320, 3)}
        assert not np.array_equal(frames[0], frames[1])
    assert not np.array_equal(written[0][1][1], written[1][1][1])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--video", "race.gif"], "'race.gif' should end in .mp4"),
        (["--view", "tv"], "--view is for videos; add --video FILE.mp4"),
        (["--view", "tv", "--video", "{}/x.mp4", "--track", "{}/own.xml"], "own.xml"),
    ],
)
def test_what_cannot_be_drawn_is_refused(words, message, monkeypatch, capsys, game, tmp_path):
    monkeypatch.setattr("sb3_torcs.races.protocol.run_race", None)
    assert main(["race", "bt", *(word.format(tmp_path) for word in words)]) == 2
    assert message in capsys.readouterr().err
