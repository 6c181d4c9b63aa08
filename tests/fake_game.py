"""A folder that looks like an installed game, and programs that behave as one tells them."""

from __future__ import annotations

import sys
from pathlib import Path

ROBOT = """<params name="{name}"><section name="Robots"><section name="index">
<section name="10"><attstr name="name" val="Ten"/><attstr name="car name" val="big"/></section>
<section name="3"><attstr name="name" val="Three"/><attstr name="car name" val="small"/></section>
</section></section></params>"""
SESSION = """<params name="{name}"><section name="Tracks"><section name="1"/></section>
<section name="Races"><section name="1"><attstr name="name" val="{name}"/></section></section>
<section name="{name}"><attnum name="laps" val="20"/><attstr name="type" val="practice"/></section>
<section name="Drivers"><section name="1"><attstr name="module" val="human"/></section></section>
</params>"""
LIBRARIES = (
    "lib/libtxml.so",
    "lib/libtgf.so",
    "lib/librobottools.so",
    "modules/track/track.so",
    "modules/simu/simuv2.so",
    "drivers/racer/racer.so",
    "drivers/human/human.so",
)
TEXTS = {
    "data/tracks/surfaces.xml": "<section/>",
    "tracks/road/loop/loop.xml": "<params/>",
    "tracks/dirt/mud-1/mud-1.xml": "<params/>",
    "cars/big/big.xml": "<params/>",
    "cars/small/small.xml": "<params/>",
    "drivers/racer/racer.xml": ROBOT.format(name="racer"),
    "drivers/human/human.xml": ROBOT.format(name="human"),
    "drivers/unbuilt/unbuilt.xml": ROBOT.format(name="unbuilt"),
    "config/raceengine.xml": "<params/>",
    "config/raceman/practice.xml": SESSION.format(name="Practice"),
    "config/raceman/quickrace.xml": SESSION.format(name="Quick Race"),
}


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def write_game(root: Path, libraries: str = "lib/torcs", data: str = "share/games/torcs") -> Path:
    """Lay out the files of a game, most of them empty."""
    for name in LIBRARIES:
        write(root / libraries / name, "")
    for name, text in TEXTS.items():
        write(root / data / name, text)
    return root


def write_program(path: Path, code: str) -> Path:
    """Write a program in Python."""
    write(path, f"#!{sys.executable} -S\n{code}")
    path.chmod(0o755)
    return path
