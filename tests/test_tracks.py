"""Tracks as geometry, the names they go by, and the compact file."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from conftest import segment

from sb3_torcs.errors import InvalidOption, OutputNotWritable, TrackFileError, TrackNotFound
from sb3_torcs.torcs import track_names
from sb3_torcs.tracks import catalogue
from sb3_torcs.tracks import track as tracks
from sb3_torcs.tracks.catalogue import available_tracks, load_track
from sb3_torcs.tracks.compact import read_track_file, write_track_file
from sb3_torcs.tracks.plot import edges, plot_track
from sb3_torcs.tracks.track import Track, closed, closing_gap

BUNDLED = ["aalborg", "alpine-1", "corkscrew", "g-track-1"]

SMALL = """sb3-torcs track,1
name,ring
category,oval
start,1.0,2.0,0.5
grid,7.0,-2.0
surface,tar,1.0,0.001,0.5,10.0
surface,"mud, deep",0.5,0.1,0.5,10.0
segment,157.07963267948966,0.02,10.0,10.0,1.0,2.0,3.0,4.0,tar,"mud, deep",tar,tar,tar
segment,157.07963267948966,0.02,10.0,10.0,2.0,1.0,4.0,3.0,tar,"mud, deep",tar,tar,tar
"""


def write(folder, text, name="ring.csv"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(autouse=True)
def no_installed_torcs(monkeypatch):
    """Only what the package brings counts here, whatever this machine has."""
    for module in (catalogue, track_names):
        monkeypatch.setattr(module, "torcs_folders", list)


class TestGeometry:
    def test_the_figures_of_an_oval_are_those_of_geometry(self, oval):
        assert oval.length == pytest.approx(600.0 + 100.0 * math.pi, abs=1e-12)
        assert oval.width == 10.0
        assert oval.tightest_radius == 50.0

    def test_a_straight_has_no_tightest_radius(self):
        assert Track("line", "road", (segment(100.0),)).tightest_radius == math.inf

    @pytest.mark.parametrize(
        ("distance", "offset", "expected"),
        [
            (0.0, 0.0, (0.0, 0.0, 0.0)),
            (100.0, 2.0, (100.0, 2.0, 0.0)),
            (300.0 + 25.0 * math.pi, 0.0, (350.0, 50.0, 0.5 * math.pi)),
            (300.0 + 25.0 * math.pi, 5.0, (345.0, 50.0, 0.5 * math.pi)),
            (300.0 + 50.0 * math.pi, -5.0, (300.0, 105.0, math.pi)),
            (-100.0, 0.0, (0.0 - 50.0 * math.sin(2.0), 50.0 - 50.0 * math.cos(2.0), None)),
        ],
    )
    def test_poses_on_an_oval_are_those_of_geometry(self, oval, distance, offset, expected):
        pose = oval.pose(distance, offset)
        assert pose[:2] == pytest.approx(expected[:2], abs=1e-9)
        if expected[2] is not None:
            assert pose.heading == pytest.approx(expected[2], abs=1e-12)

    def test_the_start_pose_moves_and_turns_the_whole_track(self, oval):
        turned = Track("t", "oval", oval.segments, "file", 10.0, 20.0, 0.5 * math.pi)
        assert turned.pose(100.0, 2.0) == pytest.approx((8.0, 120.0, 0.5 * math.pi), abs=1e-9)

    def test_the_table_has_the_segments_in_its_columns(self, oval):
        turn = oval.segments[1]._replace(left_end=7.0, width_end=9.0)
        track = Track("t", "oval", (oval.segments[0], turn, *oval.segments[2:]))
        row = track.table[1]
        assert track.table.shape == (4, tracks.COLUMNS)
        assert row[tracks.START] == 300.0
        assert row[tracks.LENGTH] == turn.length
        assert row[tracks.CURVATURE] == 0.02
        assert tuple(row[tracks.X : tracks.HEADING + 1]) == (300.0, 0.0, 0.0)
        assert (row[tracks.WIDTH_START], row[tracks.WIDTH_END]) == (10.0, 9.0)
        assert (row[tracks.LEFT_START], row[tracks.LEFT_END]) == (5.0, 7.0)
        assert (row[tracks.RIGHT_START], row[tracks.RIGHT_END]) == (5.0, 5.0)
        assert tuple(row[tracks.ROAD_FRICTION : tracks.LEFT_FRICTION]) == (1.2, 0.001)
        assert tuple(row[tracks.RIGHT_FRICTION : tracks.LEFT_WALL_FRICTION]) == (0.4, 0.01)
        assert tuple(row[tracks.RIGHT_WALL_FRICTION :]) == (0.1, 0.5, 10.0)

    def test_the_table_cannot_be_changed(self, oval):
        with pytest.raises(ValueError, match="read-only"):
            oval.table[0, 0] = 1.0

    def test_every_row_begins_where_pose_says(self):
        track = load_track("corkscrew")
        for row in track.table:
            pose = track.pose(row[tracks.START])
            assert pose == tuple(row[tracks.X : tracks.HEADING + 1])

    def test_tracks_are_equal_only_to_themselves(self, oval):
        twin = pickle.loads(pickle.dumps(oval))
        assert twin.segments == oval.segments
        assert twin != oval
        assert len({oval, twin}) == 2


class TestClosing:
    def test_a_closed_chain_comes_back_as_it_is(self, oval):
        assert closed(closed(oval.segments)) == closed(oval.segments)

    def test_a_small_gap_is_closed_by_small_changes_of_lengths_alone(self, oval):
        first, *others = oval.segments
        broken = (first._replace(length=300.2), *others)
        repaired = closed(broken)
        assert max(abs(value) for value in closing_gap(repaired)) <= 1e-9
        for before, after in zip(broken, repaired, strict=True):
            assert after.length == pytest.approx(before.length, abs=0.11)
            assert after._replace(length=before.length) == before
        # The least change shares the error between the two straights.
        assert repaired[0].length == pytest.approx(300.1, abs=1e-3)
        assert repaired[2].length == pytest.approx(300.1, abs=1e-3)

    def test_a_missing_turn_is_made_up_in_the_bends(self, oval):
        bend = oval.segments[1]
        broken = (*oval.segments[:3], bend._replace(length=bend.length - 0.5))
        assert abs(closing_gap(broken).heading) == pytest.approx(0.01)
        assert max(abs(value) for value in closing_gap(closed(broken))) <= 1e-9

    def test_a_circle_is_closed_though_only_its_whole_length_matters(self):
        """Its segments all change the end in one way, so the equations for it are one."""
        arc = 2.0 * math.pi * 50.0 / 8.0
        broken = (segment(arc + 0.1, 1.0 / 50.0), *[segment(arc, 1.0 / 50.0)] * 7)
        repaired = closed(broken)
        assert max(abs(value) for value in closing_gap(repaired)) <= 1e-9
        assert math.fsum(s.length for s in repaired) == pytest.approx(8.0 * arc, abs=1e-9)

    @pytest.mark.parametrize("length", [340.0, 200.0])
    def test_what_is_no_circuit_is_refused(self, oval, length):
        with pytest.raises(ValueError, match=r"the end lies .* m and .* degrees from the start"):
            closed((oval.segments[0]._replace(length=length), *oval.segments[1:]))

    def test_a_straight_line_is_refused(self):
        with pytest.raises(ValueError, match=r"the end lies 100.00 m"):
            closed((segment(100.0),))


class TestLoading:
    @pytest.mark.parametrize(
        ("name", "length", "width", "radius"),
        [
            ("aalborg", 2587.54, 10.0, 12.192),
            ("alpine-1", 6355.65, 12.0, 20.0),
            ("corkscrew", 3608.45, 12.0, 11.5),
            ("g-track-1", 2057.56, 15.0, 60.0),
        ],
    )
    def test_bundled_tracks_have_the_figures_of_the_game(self, name, length, width, radius):
        track = load_track(name)
        assert (track.name, track.category, track.source) == (name, "road", "bundled")
        # The game adds its lengths up in single precision.
        assert track.length == pytest.approx(length, abs=0.02)
        assert (track.width, track.tightest_radius) == (width, radius)

    @pytest.mark.parametrize("name", BUNDLED)
    def test_bundled_tracks_wrap_without_a_jump(self, name):
        track = load_track(name)
        assert max(abs(value) for value in closing_gap(track.segments)) <= 1e-9
        before, after = track.pose(track.length - 1e-6), track.pose(track.length + 1e-6)
        assert before[:2] == pytest.approx(after[:2], abs=2.1e-6)

    @pytest.mark.parametrize(
        ("name", "message"),
        [
            *[(name, r"did you mean '(road/)?aalborg'\? `sb3-torcs tr")
              for name in ("aalbrog", "road/aalbrog", "Aalborg")],
            ("road", r"'road' is a kind of .*; name one of the \d+, e"),
            ("zz", "`sb3-torcs tracks` lists them; those of the game .* `sb3-torcs install-torcs`"),
            ("mine.xml", r"there is no track file '.*mine\.xml'"),
        ],
    )  # fmt: skip
    def test_a_track_that_there_is_not(self, name, message):
        with pytest.raises(TrackNotFound, match=message):
            load_track(name)

    def test_a_track_is_loaded_once(self, oval):
        assert load_track("road/alpine-1") is load_track("alpine-1")
        assert load_track(oval) is oval

    def test_a_random_track_needs_a_generator(self):
        with pytest.raises(InvalidOption, match=r"pass rng=numpy\.random\.default_rng"):
            load_track("random")
        with pytest.raises(InvalidOption, match="rng is 3; pass rng=numpy"):
            load_track("random", 3)
        assert load_track("random", np.random.default_rng(1)).source == "random"

    def test_a_changed_file_is_read_again(self, tmp_path):
        path = write(tmp_path, SMALL)
        first = load_track(path)
        assert load_track(str(path)) is first
        write(tmp_path, SMALL.replace("name,ring", "name,circle"))
        assert load_track(path) is not first or load_track(path).name == "circle"

    def test_an_open_chain_in_a_file_is_refused(self, tmp_path):
        with pytest.raises(TrackFileError, match=r"ring\.csv: the end lies"):
            load_track(write(tmp_path, SMALL.replace("0.02,", "0.01,", 1)))

    def test_the_list_holds_the_bundled_tracks(self):
        listed = available_tracks()
        assert [entry.name for entry in listed] == BUNDLED
        assert {entry.source for entry in listed} == {"bundled"}
        assert listed[0].length_m == load_track("aalborg").length

    def test_installed_tracks_are_listed_and_bundled_ones_come_first(self, tmp_path, monkeypatch):
        xml = (
            '<params name="x"><section name="Header"><attnum name="version" val="4"/></section>'
            '<section name="Main Track"><section name="Track Segments"><section name="a">'
            '<attstr name="type" val="lft"/><attnum name="radius" val="50"/>'
            '<attnum name="arc" unit="deg" val="360"/></section></section></section></params>'
        )
        for name in ("aalborg", "loop"):
            folder = tmp_path / "tracks" / "road" / name
            folder.mkdir(parents=True)
            write(folder, xml, f"{name}.xml")
        for module in (catalogue, track_names):
            monkeypatch.setattr(module, "torcs_folders", lambda: [tmp_path])
        sources = {entry.name: entry.source for entry in available_tracks()}
        assert sources == {**dict.fromkeys(BUNDLED, "bundled"), "loop": "torcs"}
        assert load_track("loop").length == pytest.approx(100.0 * math.pi)
        write(tmp_path / "tracks/road/loop", "<params>", "loop.xml")
        with pytest.warns(UserWarning, match=r"left out: .*loop\.xml.*well-formed"):
            assert [entry.name for entry in available_tracks()] == BUNDLED


class TestCompactFile:
    def test_a_file_says_what_it_says(self, tmp_path):
        track = read_track_file(write(tmp_path, "\ufeff" + SMALL))  # as a spreadsheet writes it
        assert (track.name, track.category, track.source) == ("ring", "oval", "file")
        assert (track.start_x, track.start_y, track.start_heading) == (1.0, 2.0, 0.5)
        assert track.grid == (7.0, -2.0)
        assert track.segments[0][:8] == (50.0 * math.pi, 0.02, 10.0, 10.0, 1.0, 2.0, 3.0, 4.0)
        assert track.segments[0].left == ("mud, deep", 0.5, 0.1, 0.5, 10.0)

    @pytest.mark.parametrize("name", [*BUNDLED, "random"])
    def test_writing_and_reading_gives_the_same_numbers(self, name, tmp_path):
        track = load_track(name, np.random.default_rng(3))
        path = tmp_path / "copy.csv"
        write_track_file(track, str(path), "Source: this test.\nTwo lines.")
        copy = load_track(path)
        assert copy.segments == track.segments
        assert copy.grid == track.grid
        np.testing.assert_array_equal(copy.table, track.table)
        assert path.read_text().startswith("# Source: this test.\n# Two lines.\nsb3-torcs track,1")

    def test_a_file_that_cannot_be_written_is_told(self, oval, tmp_path):
        for write in (write_track_file, plot_track):
            with pytest.raises(OutputNotWritable, match=r"cannot write '.*no/x.png'.*choose"):
                write(oval, tmp_path / "no" / "x.png")

    def test_two_surfaces_of_one_name_cannot_be_written(self, oval, tmp_path):
        odd = segment(1.0)
        odd = odd._replace(road=odd.road._replace(friction=9.0))
        with pytest.raises(TrackFileError, match=r"two different surfaces .* are called 'asphalt'"):
            write_track_file(Track("t", "road", (*oval.segments, odd)), tmp_path / "t.csv")

    @pytest.mark.parametrize(
        ("old", "new", "line", "message"),
        [
            ("sb3-torcs track,1", "track,1", 1, "instead of the first record"),
            ("name,ring", "nmae,ring", 2, "unknown record 'nmae'; allowed are name, category"),
            ("category,oval", "name,ring", 3, "there is a second 'name'; expected one"),
            ('"mud, deep"', "tar", 7, "there is a second surface 'tar'; give it another name"),
            ("start,1.0,2.0,0.5", "start,1.0,2.0", 4, "'start' has 2 fields, expected 3"),
            ("start,1.0,2.0,0.5", "start,1.0,2.0,1e9", 4, "expected -2 pi to 2 pi"),
            ("7.0,-2.0", "seven,-2.0", 5, "'seven' is not a finite number"),
            ("7.0,-2.0", "nan,-2.0", 5, "'nan' is not a finite number"),
            ("tar,1.0", "tar,-1.0", 6, "may not be negative"),
            ("tar,1.0", "tra,1.0", 8, "surface 'tar' is not defined above; add a line"),
            ("segment,157", "segment,-157", 8, "it has to be above 0"),
            ("10.0,10.0,1.0", "10.0,0.0,1.0", 8, "the road's width has to be above 0"),
            ("1.0,2.0,3.0,4.0", "1.0,-2.0,3.0,4.0", 8, "may not be negative"),
            ("0.02,10", "-0.3,10", 8, "bend is 3.33 m, less than half the road's width, 5 m"),
        ],
    )
    def test_a_broken_line_is_named(self, tmp_path, old, new, line, message):
        path = write(tmp_path, SMALL.replace(old, new, 1))
        with pytest.raises(TrackFileError, match=rf"ring\.csv, line {line}: .*{message}"):
            load_track(path)

    @pytest.mark.parametrize(
        ("grid", "message"),
        [
            ("-1.0,0.0", "the grid is -1 m before the line; expected 0 to "),
            ("1e9,0.0", r"the grid is 1e\+09 m before the line; expected 0 to "),
            ("7.0,-5.5", "the grid is -5.5 m from the axis, and there the road ends at 5 m"),
        ],
    )
    def test_a_grid_beside_the_road_is_refused(self, tmp_path, grid, message):
        path = write(tmp_path, SMALL.replace("7.0,-2.0", grid))
        with pytest.raises(TrackFileError, match=message):
            load_track(path)

    def test_a_grid_beside_a_road_that_is_narrow_there_is_refused(self, tmp_path):
        """The road is 10 m wide elsewhere; 7 m before the line it has become narrower."""
        last = SMALL.splitlines()[-1]
        path = write(tmp_path, SMALL.replace(last, last.replace("10.0,10.0", "10.0,3.0", 1)))
        with pytest.raises(TrackFileError, match=r"and there the road ends at 1\.65597 m"):
            load_track(path)

    @pytest.mark.parametrize("text", ["", "sb3-torcs track,1\nname,ring\n", "# nothing\n"])
    def test_a_file_without_segments_is_refused(self, tmp_path, text):
        with pytest.raises(TrackFileError, match="the file ends without a segment"):
            load_track(write(tmp_path, text))
        (tmp_path / "ring.csv").write_bytes(b"\xff\xfe\x00")
        with pytest.raises(TrackFileError, match=r"ring\.csv: is not UTF-8 text"):
            load_track(tmp_path / "ring.csv")


class TestPlot:
    def test_the_drawn_edges_are_half_the_width_from_the_axis(self, oval):
        left, right = edges(oval)
        np.testing.assert_allclose(np.hypot(*(left - right).T), 10.0, atol=1e-9)
        np.testing.assert_allclose(left[0], left[-1], atol=1e-9)
        assert right[:, 1].min() == pytest.approx(-5.0)
        assert left[:, 1].max() == pytest.approx(95.0)

    @pytest.mark.parametrize("suffix", [".png", ".svg"])
    def test_a_picture_is_written(self, oval, tmp_path, suffix):
        path = tmp_path / f"oval{suffix}"
        line = np.array([oval.pose(d)[:2] for d in np.arange(0.0, 300.0, 10.0)])
        plot_track(oval, path, line, np.full(len(line), 20.0), title="a lap", fastest=50.0)
        assert path.stat().st_size > 1000
        for text in ("a lap", "180"):  # [km/h] of 50 m/s
            assert suffix == ".png" or f"<!-- {text} -->" in path.read_text(encoding="utf-8")
        plot_track(oval, tmp_path / "a.png")
        plot_track(oval, tmp_path / "b.png", np.zeros((2, 2)))
        assert len(list(tmp_path.iterdir())) == 3

    def test_the_name_of_a_track_is_no_track(self, tmp_path):
        with pytest.raises(InvalidOption, match="track is 'aalborg'; expected a track"):
            plot_track("aalborg", tmp_path / "a.png")
        assert list(tmp_path.iterdir()) == []

    def test_another_kind_of_picture_is_refused(self, oval, tmp_path):
        with pytest.raises(OutputNotWritable, match=r"should end in \.png or \.svg or \.pdf"):
            plot_track(oval, tmp_path / "a.jpg")


def test_torcs_own_format_could_not_keep_the_bundled_tracks():
    """It says radius and arc of a bend, whose product is its length."""
    bends = [s for name in BUNDLED for s in load_track(name).segments if s.curvature]
    lost = [s for s in bends if 1 / abs(s.curvature) * (s.length * abs(s.curvature)) != s.length]
    assert (len(lost), len(bends)) == (181, 804)
