"""Write tracks as files of TORCS, so that the real game drives roads of one's own."""

from __future__ import annotations

from pathlib import Path

from sb3_torcs.errors import InvalidOption
from sb3_torcs.files import IN_A_FOLDER, atomic_file
from sb3_torcs.torcs.nodes import Node
from sb3_torcs.tracks.compact import surfaces_of
from sb3_torcs.tracks.track import Segment, Track

__all__ = ["write_track_xml"]

VERSION = 4  # of the format
WALL = {"width": 0.1, "height": 1.0}  # [m]


def write_track_xml(track: Track, path: str | Path) -> None:
    """
    Write a track as a file of TORCS; the road is flat.

    ``sb3_torcs.tracks.load_track`` reads it, and so does ``Torcs-v0``. The game turns and moves the
    road: it begins along the x-axis, and all of it has positive coordinates. The game knows some
    first grid slots only, and gets the nearest one. Its own window needs a model of the scenery
    besides.

    :param track: whose road has one width
    :param path: of the file, which ends in ``.xml``
    :raises InvalidOption: if the road's width changes, or the file's name has another ending
    :raises TrackFileError: if two surfaces have one name
    :raises OutputNotWritable: if the file cannot be written; the previous one is kept
    """
    path = Path(path)
    if path.suffix != ".xml":
        raise InvalidOption(f"'{path}' is no name of a track's file; choose one that ends in .xml")
    widths = {width for one in track.segments for width in (one.width_start, one.width_end)}
    if len(widths) > 1:
        raise InvalidOption(
            f"the road of '{track.name}' is {min(widths):g} to {max(widths):g} m wide, but a road "
            "of TORCS has one width; write_track_file of sb3_torcs.tracks.compact keeps both"
        )
    root = Node.new(path.stem, "param")
    _set(root.make("Header"), name=path.stem, category=track.category, version=VERSION)
    for surface in surfaces_of(track):
        own = root.make("Surfaces", surface.name)
        _set(own, friction=surface.friction, rebound=surface.rebound, dammage=surface.damage)
        own.set("rolling resistance", surface.rolling_resistance)
    main = root.make("Main Track")
    (width,) = widths
    main.set("width", width)
    for side in ("Left", "Right"):
        main.make(f"{side} Border").set("width", 0.0)
    for number, segment in enumerate(track.segments, start=1):
        _write(segment, main.make("Track Segments", f"segment {number}"))
    grid = root.make("Starting Grid")
    grid.set("distance to start", track.grid.distance)
    grid.set("pole position side", "left" if track.grid.offset > 0.0 else "right")
    grid.set("rows", max(round(width / (0.5 * width - abs(track.grid.offset))) - 1, 1))
    with atomic_file(path, IN_A_FOLDER) as aside:
        root.write(aside)


def _write(segment: Segment, section: Node) -> None:
    """Write a segment into its section."""
    bend = abs(segment.curvature)
    section.set("surface", segment.road.name)
    if bend:
        section.set("type", "lft" if segment.curvature > 0.0 else "rgt")
        _set(section, radius=1.0 / bend, arc=segment.length * bend)
    else:
        _set(section, type="str", lg=segment.length)
    for side, start, end, ground, wall in (
        ("Left", segment.left_start, segment.left_end, segment.left, segment.left_wall),
        ("Right", segment.right_start, segment.right_end, segment.right, segment.right_wall),
    ):
        verge = section.make(f"{side} Side")
        verge.set("start width", start)
        verge.set("end width", end)
        verge.set("surface", ground.name)
        _set(section.make(f"{side} Barrier"), style="wall", surface=wall.name, **WALL)


def _set(section: Node, **values: str | float) -> None:
    """Set several values of a section."""
    for name, value in values.items():
        section.set(name, value)
