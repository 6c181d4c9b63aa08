"""Laps laid on each other: the figures are those that one computes by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from conftest import segment
from made_drives import drive, log_of

from sb3_torcs.errors import DriveFileError
from sb3_torcs.evaluation.comparing import _numbered
from sb3_torcs.telemetry import DriveLog
from sb3_torcs.telemetry.comparison import compare_drives
from sb3_torcs.telemetry.corners import Corner, corners_of, stretches
from sb3_torcs.telemetry.laps import drives_of, grid_of, sample
from sb3_torcs.telemetry.page import _signed, lap_report, missing, summary
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.track import Track

TURN = math.pi * 50.0  # [m] of the oval's half circles


def compared(log, track):
    return compare_drives(drives_of(log.frame()), track)


def test_corners_are_segments_that_turn_to_one_side(oval):
    assert corners_of(oval) == [
        Corner(300.0, 300.0 + TURN, pytest.approx(math.pi), 50.0),
        Corner(600.0 + TURN, pytest.approx(600.0 + 2.0 * TURN), pytest.approx(math.pi), 50.0),
    ]


def test_two_bends_are_one_corner_if_little_lies_between_them():
    quarter = segment(0.5 * TURN, 1.0 / 50.0)

    def corners(gap):
        pieces = (quarter, segment(gap), quarter, segment(100.0), segment(TURN, 1.0 / 50.0))
        return len(corners_of(Track("bent", "road", pieces)))

    assert (corners(10.0), corners(30.0)) == (2, 3)


def test_a_road_that_hardly_turns_has_no_corner():
    wide, short = segment(100.0, 1.0 / 400.0), segment(10.0, 1.0 / 50.0)  # 14°, 11°
    assert corners_of(Track("bent", "road", (wide, segment(50.0), short))) == []


@pytest.mark.parametrize(("track", "count"), [("aalborg", 17), ("g-track-1", 6)])
def test_the_corners_of_tracks_that_people_know(track, count):
    assert len(corners_of(load_track(track))) == count


def test_the_stretches_of_corners_are_the_lap():
    corners = [Corner(100.0, 200.0, 1.0, 50.0), Corner(300.0, 350.0, -1.0, 50.0)]
    assert stretches(corners, 1000.0) == [(0.0, 250.0), (250.0, 1000.0)]
    assert stretches([], 1000.0) == []


def test_a_constant_lead_grows_evenly(oval):
    comparison = compared(log_of(oval, ("ana", 25.0), ("ben", 20.0)), oval)
    first, second = comparison.drivers
    assert first.lap.time == pytest.approx(oval.length / 25.0)
    wanted = comparison.distance * (1.0 / 20.0 - 1.0 / 25.0)
    assert second.delta == pytest.approx(wanted, abs=1e-9)
    assert first.delta.tolist() == [0.0] * len(wanted)
    assert second.delta[-1] == pytest.approx(second.lap.time - first.lap.time, abs=1e-12)


def test_the_time_lost_in_corners_adds_up_to_the_laps_difference(oval):
    log = DriveLog()
    drive(log, oval, "ana", speed=lambda place: 30.0 if place < 400.0 else 22.0)
    drive(log, oval, "ben", speed=lambda place: 24.0)
    first, second = compared(log, oval).drivers
    behind = second.lap.time - first.lap.time
    assert sum(corner.time_lost for corner in second.corners) == pytest.approx(behind, abs=1e-9)
    assert [corner.time_lost for corner in first.corners] == [0.0, 0.0]
    assert sum(second.sectors) == pytest.approx(second.lap.time)


def test_a_corner_is_measured_where_it_is(oval):
    """The car brakes from 250 to 320 m and is slow until 400 m, in the first half circle."""
    log = drive(
        DriveLog(), oval,
        speed=lambda place: 15.0 if 320.0 <= place < 400.0 else 30.0,
        brake=lambda place: 1.0 if 250.0 <= place < 320.0 else 0.0,
    )  # fmt: skip
    corner, other = compared(log, oval).drivers[0].corners
    assert corner.distance == 300.0
    assert corner.braking_point == pytest.approx(250.0, abs=1.0)  # [m] a tick at 30 m/s
    assert (corner.entry_speed, corner.apex_speed, corner.exit_speed) == (30.0, 15.0, 30.0)
    assert other.braking_point is None


def test_the_slip_is_what_a_wheel_turns_more_than_the_car_moves(oval):
    (drive_of_ana,) = drives_of(log_of(oval, ("ana", 20.0)).frame())
    lap = drive_of_ana.laps[1]
    assert sample(lap, grid_of(oval)).channels["slip"] == pytest.approx(0.0, abs=1e-12)
    spins = lap.rows.copy()
    spins.loc[spins["distance_from_start"] > 500.0, "wheel_speed_rear_left"] *= 1.25
    lap.__dict__["rows"] = spins
    sampled = sample(lap, grid_of(oval)).channels["slip"]
    assert sampled[[100, 800]] == pytest.approx([0.0, 0.25], abs=1e-9)


def test_flying_laps_are_compared_if_everybody_has_one(oval):
    flying, standing = DriveLog(), DriveLog()
    for log, laps in ((flying, 2), (standing, 1)):
        drive(log, oval, "ana", laps=2)
        drive(log, oval, "ben", laps=laps, speed=lambda place: 21.0)
    assert [one.lap.standing for one in compared(flying, oval).drivers] == [False, False]
    comparison = compared(standing, oval)
    assert comparison.drivers[1].lap.standing
    assert missing(comparison)[-1].startswith("From the grid, not flying: the lap of ")


def test_a_lap_from_the_grid_begins_behind_the_line(oval):
    """The 100 m before the line count for its time, and not as its last ones."""
    frame = log_of(oval, ("ana", 20.0)).frame()
    length = oval.length
    early = frame["distance_raced"] + length - 100.0
    frame["distance_from_start"] = early % length
    begun = frame[frame["distance_raced"] < length + 100.0].copy()
    begun["laps"] = (begun["distance_raced"] > length).astype(int)
    begun["last_lap_time"] = np.where(begun["laps"] > 0, length / 20.0, 0.0)
    begun.loc[begun["distance_raced"] < 100.0, "laps"] = 0
    (whole,) = drives_of(begun)
    sampled = sample(whole.laps[0], grid_of(oval))
    assert sampled.time[0] == pytest.approx(5.0, abs=0.05)  # 100 m at 20 m/s
    assert (np.diff(sampled.time) >= 0.0).all()


def test_a_start_on_the_line_at_speed_is_no_start_from_the_grid(oval):
    frame = log_of(oval, ("ana", 20.0)).frame()
    (standing,) = drives_of(frame)
    assert standing.laps[0].standing
    frame.loc[:0, "speed_x"] = 20.0
    (rolling,) = drives_of(frame)
    assert not rolling.laps[0].standing


def test_drivers_of_one_name_are_numbered(oval):
    (one,) = drives_of(log_of(oval, ("a", 20.0)).frame())
    drives = [dataclasses.replace(one, driver=name) for name in ("a", "a (2)", "a")]
    assert [each.driver for each in _numbered(drives)] == ["a", "a (2)", "a (3)"]


def test_a_difference_that_is_none_has_no_sign():
    assert [_signed(each) for each in (-0.0001, 0.02, -0.02)] == ["±0.000", "+0.020", "−0.020"]


def test_nobody_with_a_whole_lap_is_an_error(oval):
    log = drive(DriveLog(), oval, laps=0, end=120.0)
    with pytest.raises(DriveFileError, match=r"no driver completed a lap of oval.*ana drove 120 m"):
        compared(log, oval)


def test_a_lap_of_another_road_of_that_name_is_an_error(oval):
    log = log_of(oval, ("ana", 20.0))
    longer = dataclasses.replace(oval, segments=oval.segments * 2)
    with pytest.raises(DriveFileError, match=r"ana drove laps of 91\d m, but oval has 1828 m"):
        compared(log, longer)


def test_a_page_says_who_drove_no_whole_lap_and_what_differs(oval):
    log = log_of(oval, ("ana", 25.0))
    drive(log, oval, "ben", car="buggy", world="Torcs-v0")
    drive(log, oval, "cleo", laps=0, end=120.0)
    comparison = compared(log, oval)
    assert missing(comparison) == [
        "cleo drove no whole lap: it came 120 m far.",
        "The cars differ: ana in car1-trb1, ben in buggy.",
        "The worlds differ: ana in TorcsLite-v0, ben in Torcs-v0.",
    ]
    assert "cleo drove no whole lap" in lap_report(comparison)
    figures = comparison.as_dict("page.html")["drivers"]
    assert [driver["driver"] for driver in figures] == ["ana", "ben", "cleo"]
    assert figures[2] == {
        "driver": "cleo", "lap_time": None, "delta_at_end": None, "corners": [],
    }  # fmt: skip


def test_one_driver_alone_has_a_page_that_asks_for_another(oval):
    comparison = compared(log_of(oval, ("ana", 25.0)), oval)
    assert missing(comparison) == [
        "There is one lap only: name another driver to see time gained and lost."
    ]
    assert summary(comparison) == []


def test_who_named_another_driver_is_not_asked_for_one(oval):
    log = log_of(oval, ("ana", 25.0))
    drive(log, oval, "cleo", laps=0, end=120.0)
    comparison = compared(log, oval)
    assert [told for told in missing(comparison) if "one lap" in told] == ["There is one lap only."]


def test_the_summary_says_who_is_faster_and_where(oval):
    comparison = compared(log_of(oval, ("ana", 25.0), ("ben", 20.0)), oval)
    (sentence,) = summary(comparison)
    behind = oval.length / 20.0 - oval.length / 25.0
    assert sentence.startswith(f"ben is {behind:.3f} s slower than ana: it loses most at corner ")


def test_names_are_text_in_the_page(oval):
    page = lap_report(compared(log_of(oval, ("</script><b>", 25.0), ("ben", 20.0)), oval))
    assert "</script><b>" not in page


def test_the_same_drives_give_the_same_page(oval):
    log = log_of(oval, ("ana", 25.0), ("ben", 20.0))
    assert lap_report(compared(log, oval)) == lap_report(compared(log, oval))


def test_rows_may_lie_far_apart(oval):
    """As those of an agent with long timesteps."""
    frame = log_of(oval, ("ana", 80.0)).frame()
    assert compare_drives(drives_of(frame.iloc[::25]), oval).drivers  # 40 m
