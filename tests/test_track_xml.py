"""The reader of TORCS track files: inline files, and all that an installed game has."""

from __future__ import annotations

import math

import pytest

from sb3_torcs.errors import TrackFileError
from sb3_torcs.torcs.track_names import BUNDLED_FOLDER
from sb3_torcs.tracks import torcs_xml
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.torcs_xml import read_track_xml
from sb3_torcs.tracks.track import closed, closing_gap

HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<!DOCTYPE params SYSTEM "params.dtd" [
<!ENTITY default-surfaces SYSTEM "../../../data/tracks/surfaces.xml">
<!ENTITY default-objects SYSTEM "../../../data/tracks/objects.xml">
]>
<params name="tiny" type="trackdef" mode="mw">
"""

SURFACES = """<?xml version="1.0" encoding="UTF-8"?>
<section name="asphalt"><attnum name="friction" val="1.2"/></section>
<section name="grass"><attnum name="friction" val="0.4"/>
<attnum name="rolling resistance" val="0.01"/></section>
"""

VERSION_4 = (
    HEAD
    + """
<section name="Surfaces">&default-surfaces;
  <section name="kerb"><attnum name="friction" val="1.4"/></section>
  <section name="tyres"><attnum name="friction" val="0.2"/><attnum name="rebound" val="0.3"/>
    <attnum name="dammage" val="5"/></section>
</section>
<section name="Objects">&default-objects;</section>
<section name="Header">
  <attstr name="name" val="Tiny"/><attstr name="category" val="oval"/>
  <attnum name="version" val="4"/>
</section>
<section name="Main Track">
  <attnum name="width" unit="m" val="12"/>
  <attnum name="profil steps length" unit="m" val="4"/>
  <attstr name="surface" val="asphalt"/>
  <section name="Left Side">
    <attnum name="width" val="3"/><attstr name="surface" val="grass"/></section>
  <section name="Right Side"><attnum name="width" val="4"/></section>
  <section name="Right Barrier"><attstr name="surface" val="tyres"/></section>
  <section name="Track Segments">
    <section name="straight">
      <attstr name="type" val="str"/><attnum name="lg" unit="km" val="0.1"/>
      <attstr name="surface" val="asphalt"/><attstr name="surface" val="grass"/>
      <section name="Left Side"><attnum name="end width" val="8"/></section>
    </section>
    <section name="no segment"><attnum name="lg" val="5"/></section>
    <section name="bend">
      <attstr name="type" val="lft"/><attstr name="surface" val="kerb"/>
      <attnum name="radius" unit="ft" val="100"/><attnum name="arc" unit="deg" val="90"/>
      <section name="Left Side"><attnum name="start width" val="1"/></section>
      <section name="Left Border">
        <attnum name="width" val="2"/><attstr name="surface" val="kerb"/></section>
      <section name="Left Barrier"><attstr name="surface" val="tyres"/></section>
    </section>
    <section name="spiral">
      <attstr name="type" val="rgt"/>
      <attnum name="radius" val="50"/><attnum name="end radius" val="20"/>
      <attnum name="arc" unit="rad" val="1"/><attnum name="profil steps" val="4"/>
      <section name="Right Side"><attnum name="width" val="8"/></section>
    </section>
  </section>
</section>
</params>
"""
)

VERSION_3 = (
    HEAD
    + """
<section name="Surfaces"><section name="List">&default-surfaces;</section></section>
<section name="Header"><attnum name="version" val="3"/></section>
<section name="Main Track">
  <attnum name="lside width" val="3"/><attnum name="rside width" val="5"/>
  <attstr name="lside surface" val="asphalt"/><attstr name="rbarrier surface" val="tyres"/>
  <section name="segments">
    <section name="a"><attstr name="type" val="str"/><attnum name="lg" val="100"/>
      <attnum name="lside end width" val="7"/><attnum name="rborder width" val="0.5"/></section>
    <section name="b"><attstr name="type" val="rgt"/><attnum name="radius" val="50"/>
      <attnum name="arc" val="1"/><attnum name="rside width" val="99"/>
      <attnum name="rside start width" val="1"/><attstr name="rbarrier surface" val="grass"/>
    </section>
  </section>
</section>
</params>
"""
)


@pytest.fixture
def read(tmp_path, monkeypatch):
    """Write a track into an installation that has only the shared surfaces, and read it."""
    monkeypatch.setattr(torcs_xml, "torcs_folders", list)
    shared = tmp_path / "data" / "tracks"
    shared.mkdir(parents=True)
    (shared / "surfaces.xml").write_text(SURFACES)
    folder = tmp_path / "tracks" / "road" / "tiny"
    folder.mkdir(parents=True)

    def read_text(text):
        (folder / "tiny.xml").write_text(text, encoding="utf-8")
        return read_track_xml(folder / "tiny.xml")

    return read_text


class TestVersion4:
    def test_the_header_and_the_file_name_the_track(self, read):
        track = read(VERSION_4)
        assert (track.name, track.category, track.source) == ("tiny", "oval", "torcs")
        assert track.width == 12.0

    def test_units_become_si(self, read):
        straight, bend, *_ = read(VERSION_4).segments
        assert straight.length == 100.0
        assert straight.curvature == 0.0
        assert 1.0 / bend.curvature == pytest.approx(30.4801)
        assert bend.length == pytest.approx(30.4801 * math.pi / 2.0)

    def test_straights_and_arcs_are_not_cut_but_spirals_are(self, read):
        assert len(read(VERSION_4).segments) == 2 + 4

    def test_a_spiral_is_a_row_of_arcs_of_equal_length_that_turn_by_its_arc(self, read):
        spiral = read(VERSION_4).segments[2:]
        assert [1.0 / s.curvature for s in spiral] == pytest.approx([-50.0, -40.0, -30.0, -20.0])
        assert len({s.length for s in spiral}) == 1
        assert sum(s.length * s.curvature for s in spiral) == pytest.approx(-1.0)

    def test_sides_are_handed_on_from_segment_to_segment(self, read):
        straight, bend, *spiral = read(VERSION_4).segments
        assert (straight.left_start, straight.left_end) == (3.0, 8.0)
        assert (straight.right_start, straight.right_end) == (4.0, 4.0)
        assert (bend.left_start, bend.left_end) == (3.0, 3.0)
        assert {(s.left_start, s.left_end) for s in spiral} == {(3.0, 3.0)}

    def test_a_width_without_a_start_width_begins_at_the_last_one(self, read):
        spiral = read(VERSION_4).segments[2:]
        assert [s.right_start for s in spiral] == [4.0, 5.0, 6.0, 7.0]
        assert [s.right_end for s in spiral] == [5.0, 6.0, 7.0, 8.0]

    def test_the_wider_of_border_and_side_names_the_ground(self, read):
        straight, bend, *_ = read(VERSION_4).segments
        assert straight.left.name == "grass"
        assert bend.left.name == "kerb"

    def test_surfaces_are_looked_up_here_then_shared_then_by_default(self, read):
        straight, bend, *_ = read(VERSION_4).segments
        assert straight.left == ("grass", 0.4, 0.01, 0.5, 10.0)
        assert straight.left_wall == ("barrier", 0.8, 0.001, 0.5, 10.0)
        assert straight.right_wall == ("tyres", 0.2, 0.001, 0.3, 5.0)
        assert bend.road == ("kerb", 1.4, 0.001, 0.5, 10.0)
        assert bend.left_wall == straight.right_wall

    def test_of_two_values_with_one_name_the_first_counts(self, read):
        assert read(VERSION_4).segments[0].road.name == "asphalt"

    def test_the_origin_is_the_corner_of_the_map(self, read):
        track = read(VERSION_4)
        # The right wall of the first straight is the lowest; nothing lies left of its beginning.
        assert track.start_y == pytest.approx(6.0 + 4.0)
        assert track.start_x == 0.0


class TestVersion3:
    def test_the_first_segment_takes_the_defaults(self, read):
        first, _ = read(VERSION_3).segments
        assert first.width_start == 15.0
        assert (first.left_start, first.left_end) == (3.0, 7.0)
        assert (first.right_start, first.right_end) == (5.5, 5.5)
        assert (first.left.name, first.right.name) == ("asphalt", "grass")
        assert first.right_wall == ("tyres", 0.8, 0.001, 1.0, 10.0)

    def test_a_segment_has_no_width_and_no_barrier_of_its_own(self, read):
        _, second = read(VERSION_3).segments
        assert (second.left_start, second.left_end) == (7.0, 7.0)
        assert (second.right_start, second.right_end) == (1.5, 1.5)
        assert second.right_wall.name == "tyres"
        assert second.curvature == -0.02


class TestGrid:
    def test_the_pole_is_on_the_side_of_the_first_bend(self, read):
        assert read(VERSION_4).grid == (10.0, 2.0)
        assert read(VERSION_3).grid == (10.0, -2.5)

    def test_the_track_can_say_otherwise(self, read):
        grid = (
            '<section name="Starting Grid"><attstr name="pole position side" val="right"/>'
            '<attnum name="rows" val="3"/><attnum name="distance to start" val="4"/></section>'
        )
        assert read(VERSION_4.replace("</params>", grid + "</params>")).grid == (4.0, -3.0)


class TestErrors:
    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("</section>\n</params>", "</params>", r"line \d+: this is not well-formed XML"),
            ("&default-surfaces;", "&nothing;", r"line 8: entity 'nothing' is not declared"),
            ('val="lft"', 'val="left"', r"unknown type 'left' of a segment; it is str, lft or rgt"),
            ('val="0.1"', 'val="wide"', r"line \d+: 'wide' is not a finite number"),
            ('val="0.1"', 'val="-1"', r"needs 'lg' above 0"),
            ('name="radius" unit="ft"', 'name="r" unit="ft"', r"needs 'radius' above 0, it is 0"),
            ('unit="ft"', 'unit="ell"', r"line \d+: unknown unit 'ell'; known are m, "),
            ('attstr name="name"', "attstr", r"line 15: <attstr> without 'name'"),
            ('name="bend"', 'name="straight"', r"section 'straight' is already at .*, line \d+"),
            ('name="version" val="4"', 'name="version" val="5"', r"version 5 .* known are 0 to 4"),
            ('name="version" val="4"', 'name="version" val="-1"', r"version -1 of the format"),
            (
                'name="width" unit="m" val="12"',
                'name="width" val="0"',
                "road.s width is 0 m; it has",
            ),
            ('name="profil steps" val="4"', 'name="profil steps" val="1e9"', "1000000000 steps"),
            ('"Track Segments"', '"Segments"', "there are no track segments"),
        ],
    )
    def test_a_broken_file_is_named_with_what_is_wrong(self, read, old, new, message):
        assert old in VERSION_4
        with pytest.raises(TrackFileError, match=rf"tiny\.xml.*{message}"):
            read(VERSION_4.replace(old, new, 1))

    def test_a_segment_is_named_by_its_line(self, read):
        line = VERSION_4[: VERSION_4.index('<section name="bend"')].count("\n") + 1
        with pytest.raises(TrackFileError, match=rf"tiny\.xml, line {line}: unknown type"):
            read(VERSION_4.replace('val="lft"', 'val="up"'))

    def test_missing_shared_surfaces_are_told_where_they_should_be(self, read, tmp_path):
        (tmp_path / "data" / "tracks" / "surfaces.xml").unlink()
        with pytest.raises(TrackFileError, match=r"needs the file data/tracks/surfaces\.xml"):
            read(VERSION_4)

    def test_a_broken_shared_file_is_named_itself(self, read, tmp_path):
        (tmp_path / "data" / "tracks" / "surfaces.xml").write_text("<section")
        with pytest.raises(TrackFileError, match=r"surfaces\.xml, line 1: this is not well-formed"):
            read(VERSION_4)

    @pytest.mark.parametrize("place", ["/etc/passwd", "http://example.org/track.xml"])
    def test_nothing_else_is_ever_opened(self, read, place):
        text = VERSION_4.replace("../../../data/tracks/surfaces.xml", place)
        with pytest.raises(TrackFileError, match=r"only surfaces\.xml and objects\.xml can be"):
            read(text)

    def test_scenery_is_passed_over_even_if_it_is_not_declared(self, read):
        kept = [line for line in VERSION_4.splitlines() if "ENTITY default-objects" not in line]
        assert read("\n".join(kept)).segments == read(VERSION_4).segments


KNOWN_LENGTHS = {  # [m] as the game prints them
    "aalborg": 2587.54,
    "alpine-1": 6355.65,
    "g-track-1": 2057.56,
    "g-track-2": 3185.83,
    "g-track-3": 2843.10,
    "eroad": 3260.43,
    "ruudskogen": 3274.20,
    "a-speedway": 1908.32,
}


class TestInstalledTracks:
    def test_all_of_them_load_and_close(self, game):
        assert len(game.tracks()) >= 38
        for path in game.tracks().values():
            laid = read_track_xml(path)
            track = load_track(path)
            gap = closing_gap(laid.segments)
            assert math.hypot(gap.x, gap.y) < 0.3, path.stem
            assert max(abs(value) for value in closing_gap(track.segments)) <= 1e-9, path.stem
            # A circuit keeps the length that the game gives it, to a part in 100,000.
            assert track.length == pytest.approx(laid.length, rel=1e-5), path.stem
            assert track.category == path.parent.parent.name

    def test_lengths_are_those_of_the_game(self, game):
        for path in game.tracks().values():
            if path.stem in KNOWN_LENGTHS:
                # The game adds up in single precision; its own sum is a centimetre off.
                expected = pytest.approx(KNOWN_LENGTHS[path.stem], abs=0.02)
                assert read_track_xml(path).length == expected, path.stem

    def test_the_bundled_tracks_are_these_to_the_last_bit(self, game):
        bundled = {path.stem: path for path in BUNDLED_FOLDER.glob("*/*.csv")}
        for path in game.tracks().values():
            if path.stem in bundled:
                laid = read_track_xml(path)
                track = load_track(bundled[path.stem])
                assert track.segments == closed(laid.segments), path.stem
                assert track.grid == laid.grid
                assert (track.start_x, track.start_y) == (laid.start_x, laid.start_y)


class TestBombs:
    """Small or large, what could keep a parser busy for long is refused, and how is said."""

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            (HEAD + '<section name="n">' * 100_000, "line 7: <section> lies 17 tags deep, at most"),
            (HEAD + "<a>" * 1_000_000, "<a> lies 17 tags deep"),
            (
                "<params {}/>".format(" ".join(f"a{i}=''" for i in range(200_000))),
                "<params> has 200000 attributes, at most 16",
            ),
            (HEAD + " " * (5 << 20), "has more than 4 MB, which no track has"),
            (
                HEAD.replace("]>", '<!ATTLIST attnum a CDATA "b">]>'),
                "line 5: declares the attribute",
            ),
            (HEAD.replace("]>", '<!ENTITY a "b">]>'), "entity 'a' has a text of its own"),
            (
                VERSION_4.replace('"profil steps" val="4"', '"profil steps" val="1e8"'),
                "cut into 100000000 steps, at most 20000 of the whole road",
            ),
            (VERSION_4.replace('val="0.1"', f'val="{"9" * 100_000}"'), "is not a finite number"),
        ],
    )
    def test_it_is_an_error(self, read, text, message):
        with pytest.raises(TrackFileError, match=message):
            read(text)


@pytest.mark.parametrize("name", ["klingon", "utf-7", "big5", "idna", "hex"])
def test_an_encoding_that_is_not_known_is_an_error_with_a_remedy(read, name):
    text = VERSION_4.replace("UTF-8", name)
    with pytest.raises(TrackFileError, match=r"line 1: .*write the file in UTF-8"):
        read(text)


class TestAsTheGame:
    """What the game's loader makes of odd files."""

    def test_a_text_that_is_empty_is_none(self, read):
        straight, *_ = read(
            VERSION_4.replace('"surface" val="asphalt"/><att', '"surface" val=""/><att')
        ).segments
        assert straight.road.name == "asphalt"

    def test_of_a_number_and_a_text_with_one_name_the_first_counts(self, read):
        kept = '<attstr name="lg" val="long"/><attnum name="lg" unit="km" val="0.1"/>'
        text = VERSION_4.replace('<attnum name="lg" unit="km" val="0.1"/>', kept)
        with pytest.raises(TrackFileError, match="the segment needs 'lg' above 0"):
            read(text)

    @pytest.mark.parametrize("number", ["1_0", "٣", "1e", "0x", "0x1p3", "infinity", "1,5", ""])
    def test_what_c_does_not_read_as_a_whole_is_no_number(self, read, number):
        with pytest.raises(TrackFileError, match=f"'{number}' is not a finite number"):
            read(VERSION_4.replace('val="0.1"', f'val="{number}"'))

    @pytest.mark.parametrize("name", ["", "a/b", "a" * 101])
    @pytest.mark.parametrize("tag", ["section", "attnum", "attstr"])
    def test_a_name_by_which_nothing_is_found_is_refused(self, read, tag, name):
        text = VERSION_4.replace('<section name="bend">', f'<{tag} name="{name}" val="1"/>')
        with pytest.raises(TrackFileError, match=f"<{tag}> is named .* expected 1 to 100 letters"):
            read(text)

    def test_a_radius_that_rounding_swallows_is_refused(self, read):
        text = VERSION_4.replace('"end radius" val="20"', '"end radius" val="1e-30"')
        with pytest.raises(TrackFileError, match=r"needs 'end radius' above 0, .* at least 1e-06"):
            read(text)

    def test_steps_are_counted_in_single_precision(self, read):
        """0.3 / 0.1 is a little less than 3 in double precision, and 3 in the game's."""
        text = VERSION_4.replace('unit="km" val="0.1"', 'val="0.3"')
        text = text.replace(
            '"profil steps length" unit="m" val="4"', '"profil steps length" val="0.1"'
        )
        steps = read(text).steps
        assert [step.length for step in steps[:5]] == pytest.approx([0.075] * 4 + [steps[4].length])
