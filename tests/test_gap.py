"""The time between two drivers on a video: measured at one place, exact at the end."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_torcs.rendering.gap import Passing, draw_gap, time_behind


def driven(speed, until, start=0.0, fps=30.0):
    """Frames of a car that drives a share of the race per second."""
    passing = Passing()
    for number in range(int(until * fps) + 1):
        time = number / fps
        passing.note(time, min(max(speed * (time - start), 0.0), 1.0))
    return passing


def test_nobody_is_behind_before_the_line():
    assert time_behind(driven(0.1, 2.0), driven(0.1, 2.0, start=3.0)) is None


@pytest.mark.parametrize(("first", "second", "behind"), [(0.0, 0.5, 0.5), (0.5, 0.0, -0.5)])
def test_who_starts_later_is_behind_by_as_much(first, second, behind):
    passings = driven(0.1, 5.0, first), driven(0.1, 5.0, second)
    assert time_behind(*passings) == pytest.approx(behind, abs=1e-9)


def test_at_the_end_it_is_the_difference_of_the_times():
    """Also where the end lies between two frames."""
    first, second = driven(0.1, 12.0), driven(1.0 / 10.01234, 12.0)
    assert time_behind(first, second) == pytest.approx(0.01234, abs=1e-6)


def test_a_car_that_stands_stays_where_it_was():
    first, second = driven(0.1, 5.0), Passing()
    for time, share in ((1.0, 0.1), (2.0, 0.15), (3.0, 0.15), (4.0, 0.14)):
        second.note(time, share)
    assert (second.share, second.time) == (0.15, 2.0)
    assert time_behind(first, second) == pytest.approx(0.5)


def test_it_is_written_in_the_middle_above():
    picture = np.full((120, 320, 3), 90, np.uint8)
    changed = np.any(draw_gap(picture, "inferno", -0.25) != picture, axis=2)
    rows, columns = np.nonzero(changed)
    assert rows.min() > 0
    assert rows.max() < 20
    assert abs(columns.min() + columns.max() - 319) <= 2
    assert (picture == 90).all()
