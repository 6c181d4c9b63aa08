"""Sections of TORCS's files, as far as the game brought or wrote them, or shall read them."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_torcs.torcs.nodes import Node

RACE = """<?xml version="1.0" encoding="UTF-8"?>
<params name="race" type="param">
  <section name="Drivers">
    <attnum name="maximum number" val="40"/>
    <section name="1"><attstr name="module" val="human"/></section>
    <section name="2"><attstr name="module" val="bt"/></section>
  </section>
  <section name="Engine">
    <attnum name="revs limiter" unit="rpm" val="9000"/>
    <attnum name="cylinders" unit="none" val="8"/>
    <attnum name="laps" min="1" max="20" val="3"/>
  </section>
</params>
"""


@pytest.fixture
def race(tmp_path):
    path = tmp_path / "race.xml"
    path.write_text(RACE, encoding="utf-8")
    return Node.read(path)


def test_sections_are_found_by_their_names(race):
    assert race.find("Drivers", "2").text("module") == "bt"
    assert [section.name for section in race.sections()] == ["Drivers", "Engine"]


def test_what_is_not_there_is_named_or_empty_or_made(race):
    with pytest.raises(LookupError, match="no section '3'"):
        race.find("Drivers", "3")
    assert race.child("Drivers", "3").text("module", "nobody") == "nobody"
    race.make("Drivers", "3").set("module", "tita")
    assert race.find("Drivers", "3").text("module") == "tita"


def test_numbers_are_in_si_units_and_unknown_ones_as_they_are(race):
    engine = race.find("Engine")
    assert engine.number("cylinders") == 8.0
    assert engine.number("valves", 4.0) == 4.0
    assert engine.number("revs limiter") == 9000 * 0.104719755


def test_numbers_can_be_computed_as_the_game_does(race):
    single = float(np.float32(9000) * np.float32(0.104719755))
    assert race.find("Engine").number("revs limiter", real=np.float32) == single


def test_a_value_that_is_set_forgets_its_limits_and_its_unit(race):
    race.find("Engine").set("laps", 50)
    assert race.as_text().count('"laps"') == 1
    assert '<attnum name="laps" val="50" />' in race.as_text()


def test_numbered_sections_take_the_place_of_those_before(race):
    drivers = race.find("Drivers")
    for entry, module in zip(drivers.number_sections(3), "abc", strict=True):
        entry.set("module", module)
    assert [section.text("module") for section in drivers.sections()] == ["a", "b", "c"]
    assert drivers.number("maximum number") == 40.0


def test_what_is_written_reads_back(tmp_path):
    written = Node.new("scr_server", "robotdef")
    written.make("Robots", "index", "0").set("name", 'A "B" <ü>')
    written.write(tmp_path / "robot.xml")
    read = Node.read(tmp_path / "robot.xml")
    assert read.find("Robots", "index", "0").text("name") == 'A "B" <ü>'


def test_a_file_that_is_not_well_formed_is_a_value_error(tmp_path):
    (tmp_path / "cut.xml").write_text("<params")
    with pytest.raises(ValueError, match="line 1"):
        Node.read(tmp_path / "cut.xml")
