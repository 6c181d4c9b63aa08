"""The picture: what is where, that it repeats, and that it needs no display."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from stadium import ANGLES, COASTING, stadium, state

from sb3_torcs.car import Controls
from sb3_torcs.errors import EnvClosed, InvalidOption
from sb3_torcs.rendering.hud import lap_clock
from sb3_torcs.rendering.scenery import GRASS_FAR, ROAD, Scenery, colour
from sb3_torcs.rendering.viewer import BEAM_END, CAR_HEIGHT, Viewer
from sb3_torcs.torcs.display import VirtualDisplay
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.track import Surface

LEFT_BEND, RIGHT_BEND = stadium(0.025), stadium(-0.025)
HEADLESS = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}


@pytest.fixture(scope="module")
def viewer():
    viewer = Viewer()
    yield viewer
    viewer.close()


def shares(picture, wanted, tolerance=6):
    """Share of the pixels of a colour in the left and in the right half of the picture."""
    found = (np.abs(picture.astype(int) - wanted) <= tolerance).all(axis=2)
    middle = picture.shape[1] // 2
    return found[:, :middle].mean(), found[:, middle:].mean()


def test_a_frame_is_an_array_of_height_width_and_colour():
    picture = Viewer(size=(320, 200)).frame(LEFT_BEND, state(LEFT_BEND, 0.0), COASTING, ANGLES)
    assert picture.shape == (200, 320, 3)
    assert picture.dtype == np.uint8
    assert picture.flags.writeable
    assert picture.flags.c_contiguous


@pytest.mark.parametrize("bend", [LEFT_BEND, RIGHT_BEND])
def test_a_bend_goes_to_its_side_of_the_picture(viewer, bend):
    picture = viewer.frame(bend, state(bend, 185.0), COASTING, ANGLES)
    left, right = shares(picture[:320], ROAD)
    assert left > 3.0 * right if bend is LEFT_BEND else right > 3.0 * left


def test_a_car_left_of_the_axis_is_on_the_left_of_the_road(viewer):
    picture = viewer.frame(LEFT_BEND, state(LEFT_BEND, 100.0, offset=3.0), COASTING, ANGLES)
    row = picture[round(CAR_HEIGHT * 640) + 40]  # behind the car and its beams
    road = np.flatnonzero((np.abs(row.astype(int) - ROAD) <= 6).all(axis=1))
    assert road.mean() > 320 + 20


def test_a_car_that_points_left_of_the_road_is_drawn_so(viewer):
    pictures = [
        viewer.frame(LEFT_BEND, state(LEFT_BEND, 100.0, heading_error=error), COASTING, ANGLES)
        for error in (0.5, -0.5)
    ]
    fronts = []
    for picture in pictures:
        ahead = picture[round(CAR_HEIGHT * 640) - 24 : round(CAR_HEIGHT * 640) - 8, 280:360]
        red = (ahead[..., 0].astype(int) - ahead[..., 2] > 100) & (ahead[..., 1] < 140)
        fronts.append(np.argwhere(red)[:, 1].mean() + 280 - 320)
    assert fronts[0] > 3.0  # the road calls for left: the car points right
    assert fronts[1] < -3.0


def test_beams_end_where_they_meet_the_edge(viewer):
    beams = np.full(19, 200.0)
    beams[0], beams[18] = 20.0, 25.0  # left and right of the car
    car = state(LEFT_BEND, 100.0, speed=(0.0, 0.0))._replace(range_finders=beams)
    picture = viewer.frame(LEFT_BEND, car, COASTING, ANGLES)
    dots = np.argwhere((np.abs(picture.astype(int) - BEAM_END) <= 6).all(axis=2))
    scale = 640 * CAR_HEIGHT / 42.0  # [px/m] of a standing car
    assert sorted({0 if x < 320 else 1 for _, x in dots}) == [0, 1]
    for side, expected in ((dots[dots[:, 1] < 320], -20.0), (dots[dots[:, 1] >= 320], 25.0)):
        # Half a pixel each for the dot's middle and for the halves of its supersampled pixels.
        assert side[:, 1].mean() == pytest.approx(320 + expected * scale, abs=1.0)


def test_no_beams_are_drawn_off_the_road(viewer):
    car = state(LEFT_BEND, 100.0, offset=8.0)._replace(range_finders=np.full(19, -1.0))
    picture = viewer.frame(LEFT_BEND, car, COASTING, ANGLES)
    assert shares(picture, BEAM_END) == (0.0, 0.0)


@pytest.mark.parametrize(
    "change",
    [
        {"speed_x": 31.0}, {"gear": 5}, {"engine_speed": 800.0}, {"laps": 3}, {"lap_time": 2.0},
        {"last_lap_time": 80.0}, {"best_lap_time": 70.0},
    ],
)  # fmt: skip
def test_the_instruments_show(viewer, change):
    car = state(LEFT_BEND, 100.0)
    before = viewer.frame(LEFT_BEND, car, COASTING, ANGLES)
    after = viewer.frame(LEFT_BEND, car._replace(**change), COASTING, ANGLES)
    assert not np.array_equal(before, after)


@pytest.mark.parametrize(
    "controls",
    [Controls(0.5, 0, 0), Controls(-0.5, 0, 0), Controls(0, 0.5, 0), Controls(0, 0, 0.5)],
)
def test_the_pedals_and_the_steering_show(viewer, controls):
    car = state(LEFT_BEND, 100.0)
    before = viewer.frame(LEFT_BEND, car, COASTING, ANGLES)
    after = viewer.frame(LEFT_BEND, car, controls, ANGLES)
    assert not np.array_equal(before[540:], after[540:])


def test_the_same_state_gives_the_same_picture_whatever_was_drawn_before():
    car = state(LEFT_BEND, 185.0, offset=1.0, heading_error=0.2)
    first = Viewer().frame(LEFT_BEND, car, COASTING, ANGLES)
    used = Viewer()
    used.frame(RIGHT_BEND, state(RIGHT_BEND, 20.0), Controls(1, 1, 1), ANGLES)
    used.frame(LEFT_BEND, state(LEFT_BEND, 400.0), Controls(-1, 0, 1), ANGLES)
    np.testing.assert_array_equal(used.frame(LEFT_BEND, car, COASTING, ANGLES), first)


def test_two_viewers_do_not_share_a_picture():
    one, two = Viewer(), Viewer(size=(240, 240))
    first = one.frame(LEFT_BEND, state(LEFT_BEND, 0.0), COASTING, ANGLES)
    kept = first.copy()
    two.frame(RIGHT_BEND, state(RIGHT_BEND, 185.0), COASTING, ANGLES)
    one.frame(LEFT_BEND, state(LEFT_BEND, 300.0), COASTING, ANGLES)
    np.testing.assert_array_equal(first, kept)


def test_a_viewer_outlives_the_end_of_pygame():
    """highway-env's own viewer calls pygame.quit() when it closes; ours goes on."""
    import pygame

    viewer, car = Viewer(), state(LEFT_BEND, 0.0)
    before = viewer.frame(LEFT_BEND, car, COASTING, ANGLES)
    pygame.quit()
    np.testing.assert_array_equal(viewer.frame(LEFT_BEND, car, COASTING, ANGLES), before)


@pytest.mark.parametrize("name", ["aalborg", "alpine-1", "corkscrew", "g-track-1"])
def test_every_bundled_track_is_drawn_under_the_car(viewer, name):
    track = load_track(name)
    for distance in np.linspace(0.0, track.length, 9):
        car = state(track, float(distance))._replace(range_finders=np.full(19, -1.0))
        picture = viewer.frame(track, car, COASTING, ANGLES)
        ahead = picture[round(CAR_HEIGHT * 640) - 30, 320].astype(int)
        assert np.abs(ahead - ROAD).max() <= 6 or ahead.min() < 30 or ahead.min() > 200, distance


def test_what_is_far_away_is_not_drawn():
    scenery = Scenery(load_track("alpine-1"))
    chunks, bands = scenery.near(scenery.chunks[0].points[0, 1], 60.0)
    assert 0 < len(chunks) < 0.1 * len(scenery.chunks)
    assert 0 < len(bands) < 0.1 * len(scenery.bands)


def test_a_small_picture_holds_the_road_and_no_figures():
    picture = Viewer(size=(64, 48)).frame(LEFT_BEND, state(LEFT_BEND, 50.0), COASTING, ANGLES)
    assert picture.shape == (48, 64, 3)
    assert picture[0, 0].tolist() == list(GRASS_FAR)


@pytest.mark.parametrize(
    ("name", "default", "expected"),
    [
        ("grass7", ROAD, (84, 132, 66)),
        ("asphalt2-sand", ROAD, (198, 176, 128)),
        ("unheard-of", GRASS_FAR, GRASS_FAR),
    ],
)
def test_a_ground_has_the_colour_of_its_name(name, default, expected):
    assert colour(Surface(name, 1.0, 0.0, 0.0, 0.0), default) == expected


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.0, "0:00.00"), (83.456, "1:23.46"), (59.999, "1:00.00")]
)
def test_lap_times_read_as_on_a_stopwatch(seconds, text):
    assert lap_clock(seconds) == text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "ansi"}, "mode is 'ansi'; expected 'rgb_array' or 'human'"),
        ({"size": (640, 0)}, "at least 16 pixels"),
    ],
)
def test_what_cannot_be_drawn_is_an_error(options, message):
    with pytest.raises(InvalidOption, match=message):
        Viewer(**options)


def test_a_closed_viewer_says_so_and_closes_twice():
    viewer = Viewer()
    viewer.close()
    viewer.close()
    with pytest.raises(EnvClosed, match=r"make a new environment with gym\.make"):
        viewer.frame(LEFT_BEND, state(LEFT_BEND, 0.0), COASTING, ANGLES)


PRELUDE = """
import os
before = dict(os.environ)
from stadium import ANGLES, COASTING, stadium, state
from sb3_torcs.rendering.viewer import Viewer
from sb3_torcs.errors import EnvClosed, InvalidOption
import pygame
track = stadium(0.025)
car = state(track, 0.0)
"""


def run_python(code, **environment):
    """Run code in a process of its own, without a display."""
    settings = {**HEADLESS, **environment, "PYTHONPATH": str(Path(__file__).parent)}
    call = [sys.executable, "-c", code]
    done = subprocess.run(call, env=settings, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_a_picture_needs_no_display_and_leaves_the_environment_alone():
    run_python(
        PRELUDE + "assert Viewer().frame(track, car, COASTING, ANGLES).std() > 10.0\n"
        "assert not pygame.display.get_init()\n"
        "assert dict(os.environ) == before\n"
    )


def test_a_window_that_nobody_can_see_says_what_to_do_and_draws_on():
    """Checkers of environments open every render mode, also where there is no display."""
    run_python(
        PRELUDE + "import logging\n"
        "said = []\n"
        "logger = logging.getLogger('sb3_torcs.rendering.viewer')\n"
        "logger.addFilter(lambda record: said.append(record.getMessage()))\n"
        "viewer = Viewer(mode='human', fps=1000)\n"
        "viewer.frame(track, car, COASTING, ANGLES)\n"
        "viewer.close()\n"
        "assert len(said) == 1 and 'rgb_array' in said[0] and '--video' in said[0], said\n"
    )


def test_a_window_shows_the_picture_and_ends_cleanly_when_it_is_closed():
    run_python(
        PRELUDE + "viewer = Viewer(mode='human', fps=1000)\n"
        "picture = viewer.frame(track, car, COASTING, ANGLES)\n"
        "shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)\n"
        "assert (shown == picture).all()\n"
        "try:\n    Viewer(mode='human')\n"
        "except InvalidOption as error:\n    assert 'already' in str(error)\n"
        "else:\n    raise AssertionError('two windows')\n"
        "pygame.event.post(pygame.event.Event(pygame.QUIT))\n"
        "try:\n    viewer.frame(track, car, COASTING, ANGLES)\n"
        "except EnvClosed as error:\n    assert 'window was closed' in str(error)\n"
        "else:\n    raise AssertionError('the window was not closed')\n"
        "viewer.close()\n"
        "assert not pygame.display.get_init()\n",
        SDL_VIDEODRIVER="dummy",
    )


def test_a_model_can_be_built_beside_a_window():
    with VirtualDisplay((1280, 720)) as display:
        run_python(
            PRELUDE + "viewer = Viewer(mode='human', fps=1000)\n"
            "viewer.frame(track, car, COASTING, ANGLES)\n"
            "assert pygame.display.get_driver() == 'x11'\n"
            "from stable_baselines3 import PPO\n"
            "PPO('MlpPolicy', 'Pendulum-v1', device='cpu')\n"
            "viewer.close()\n",
            DISPLAY=display.name,
        )


def test_nothing_graphical_is_imported_before_the_first_picture():
    run_python(
        "import sys, sb3_torcs, sb3_torcs.envs.racing, sb3_torcs.backends.lite.backend\n"
        "loaded = {'pygame', 'highway_env', 'matplotlib', 'pandas'} & set(sys.modules)\n"
        "assert not loaded, loaded"
    )
