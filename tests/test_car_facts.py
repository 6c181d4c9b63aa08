"""Which car is driven, as numbers: what they are, and that everybody sees the same."""

from __future__ import annotations

import contextlib
import math

import gymnasium as gym
import numpy as np
import pytest
from vectors import assert_they_see_the_same, both_kinds

import sb3_torcs  # noqa: F401  # registers the ids
from sb3_torcs.envs.torcs_race import make_race
from sb3_torcs.errors import CarFileError, InvalidOption
from sb3_torcs.sensors import CAR, feature_slices
from sb3_torcs.torcs.car_file import CarFacts, car_facts

SENSORS = ("base", "car")
CARS = ["car1-trb1", "car1-ow1", "p406"]
ROADS = ["aalborg", "corkscrew"]
FACTS = slice(29, 35)


def point(number, rpm, torque):
    """A point of a motor's curve."""
    return f"""<section name="{number}"><attnum name="rpm" unit="rpm" val="{rpm}"/>
        <attnum name="Tq" unit="N.m" val="{torque}"/></section>"""


def wheel(place, mu):
    return f"""<section name="{place} Wheel"><attnum name="mu" val="{mu}"/>
        <attnum name="ride height" unit="mm" val="100"/></section>"""


CATEGORY = f"""
<params name="small" type="template">
  <section name="Car"><attnum name="mass" unit="kg" min="500" max="1500" val="900"/></section>
  <section name="Rear Wing"><attnum name="angle" unit="deg" val="30"/></section>
  <section name="Engine"><section name="data points">
    {point(4, 5000, 260)}{point(5, 9000, 700)}
  </section></section>
</params>
"""
OWN = f"""
<params name="tiny" type="template">
  <section name="Car">
    <attstr name="category" val="small"/>
    <attnum name="fuel tank" unit="l" val="60"/><attnum name="initial fuel" unit="l" val="100"/>
  </section>
  <section name="Aerodynamics">
    <attnum name="Cx" val="0.5"/>
    <attnum name="front Clift" val="0.3"/><attnum name="rear Clift" val="0.7"/>
  </section>
  <section name="Rear Wing"><attnum name="area" unit="m2" val="0.5"/></section>
  <section name="Engine">
    <attnum name="revs limiter" unit="rpm" val="8000"/>
    <attnum name="tickover" unit="rpm" val="1000"/>
    <section name="data points">
      {point(1, 0, 100)}{point(2, 2000, 300)}{point(3, 4000, 280)}
    </section>
  </section>
  <section name="Steer"><attnum name="steer lock" unit="deg" val="20"/></section>
  {wheel("Front Right", 1.4)}{wheel("Front Left", 1.4)}{wheel("Rear Right", 1.3)}
  <section name="Rear Left Wheel"><attnum name="mu" val="1.5"/></section>
</params>
"""


def write_car(folder, own=OWN, category=CATEGORY):
    """A car in a folder of data like the game's."""
    path = folder / "cars" / "tiny" / "tiny.xml"
    for file, text in ((path, own), (folder / "categories" / "small.xml", category)):
        file.parent.mkdir(parents=True)
        file.write_text(text)
    return path


# ------------------------------------------------------------------------------- what they are


def test_the_facts_of_a_known_car(tmp_path):
    """Units become SI, and what the file leaves out is its category's, or else the game's own."""
    facts = car_facts(write_car(tmp_path))
    mass = 900.0 + 60.0  # no more fuel than the tank holds
    wing = 1.23 * 0.5 * math.sin(math.radians(30.0))
    lift = 2.0 * math.exp(-3.0 * (1.5 * 0.5) ** 4)  # the fourth wheel has the game's 0.2 m
    expected = CarFacts(
        grip=1.3,
        downforce=(lift * 1.0 + 4.0 * wing) / mass,
        power=5000.0 * math.tau / 60.0 * 260.0 / mass,  # 9000 rpm are beyond the limiter
        drag=(0.645 * 0.5 * 2.5 + wing) / mass,
        mass=mass,
        steer=math.radians(20.0),
    )
    assert facts == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("mass", "taken"), [("1400", 1400.0), ("1600", 1500.0), ("400", 400.0)])
def test_the_category_s_upper_limit_counts_as_in_the_game(tmp_path, mass, taken):
    """The game's own merging of files cuts what is above it, and leaves what is below the lower."""
    own = OWN.replace("</section>", f'<attnum name="mass" unit="kg" val="{mass}"/></section>', 1)
    assert car_facts(write_car(tmp_path, own=own)).mass == taken + 60.0


@pytest.mark.parametrize(
    ("texts", "reason"),
    [
        ({"own": OWN.replace("</params>", "")}, "no element found"),
        ({"own": OWN.replace('"0.5"/>', '"half"/>', 1)}, "could not convert"),
        ({"own": OWN.replace('"0.5"/>', '"nan"/>', 1)}, "Cx is nan"),
        ({"own": OWN.replace('val="small"', 'val="large"')}, "large.xml"),
        ({"category": CATEGORY.replace('val="900"', 'val="-900"')}, "the mass is -840 kg"),
    ],
)
def test_a_broken_file_is_told(tmp_path, texts, reason):
    with pytest.raises(CarFileError, match=rf"tiny\.xml is broken .*{reason}.*install-torcs"):
        car_facts(write_car(tmp_path, **texts))


def test_all_cars_of_the_game_lie_within_the_table(game):
    """And the one of the SCR championship is near 1 in each number."""
    for name, path in game.cars().items():
        facts = car_facts(path)
        seen = [value * sensor.scale for value, sensor in zip(facts, CAR, strict=True)]
        for value, sensor in zip(facts, CAR, strict=True):
            assert sensor.low <= value <= 0.7 * sensor.high, (name, sensor.name)
        assert name != "car1-trb1" or seen == pytest.approx([1.0] * 6, abs=0.25)
    assert len({car_facts(path) for path in game.cars().values()}) == len(game.cars())


def test_the_names_are_those_of_the_facts():
    assert [sensor.name for sensor in CAR] == [f"car_{name}" for name in CarFacts._fields]


@pytest.mark.parametrize("car", CARS)
def test_the_mass_is_that_of_the_car_on_the_grid(game, car):
    """Its fuel is the game's own."""
    path = game.find_car(car)
    with contextlib.closing(gym.make("Torcs-v0", car=car)) as env:
        _, info = env.reset(seed=0)
    masses = {"car1-trb1": 1150.0, "car1-ow1": 600.0, "p406": 1500.0}
    assert car_facts(path).mass == pytest.approx(masses[car] + info["car"].fuel)


# -------------------------------------------------------------------------- everybody sees it so


def shown(game, car):
    """The group in an observation of a car."""
    numbers = [v * s.scale for v, s in zip(car_facts(game.find_car(car)), CAR, strict=True)]
    return np.array(numbers, np.float32)


def test_each_episode_shows_the_car_that_it_draws(game):
    """All through, also with another mass and grip."""
    options = {"car": CARS, "sensors": SENSORS, "conditions": {"mass": 1.5, "grip": 0.8}}
    with contextlib.closing(gym.make("Torcs-v0", **options)) as env:
        assert env.observation_space.shape == (35,)
        assert feature_slices(SENSORS)["car_grip"].start == FACTS.start
        drawn = set()
        for seed in range(12):
            seen, _ = env.reset(seed=seed)
            car = env.unwrapped.backend.car
            drawn.add(car)
            for _ in range(3):
                np.testing.assert_allclose(seen[FACTS], shown(game, car), rtol=1e-6)
                seen = env.step(np.array([0.0, 1.0, 0.0], np.float32))[0]
        assert drawn == set(CARS)


@pytest.mark.usefixtures("game")
def test_races_driven_at_once_see_what_single_ones_see():
    options = {"car": CARS, "start": "random", "max_episode_steps": 12, "sensors": SENSORS}
    with both_kinds("Torcs-v0", **options) as (ours, theirs):
        assert_they_see_the_same(ours, theirs)


def test_agents_of_one_race_see_their_car(game):
    envs = make_race(2, car="car1-ow1", sensors=SENSORS)
    for env in envs:
        seen, _ = env.reset(seed=0)
        np.testing.assert_allclose(seen[FACTS], shown(game, "car1-ow1"), rtol=1e-6)
    for env in envs:
        env.close()


@pytest.mark.parametrize(("env_id", "options"), [
    ("TorcsLite-v0", {}), ("Torcs-v0", {"backend": "scr"}),
])  # fmt: skip
def test_a_world_that_does_not_read_the_file_refuses(game, env_id, options):
    del game
    with pytest.raises(InvalidOption, match=r"sensors 'car' are of the car's file.*'native'"):
        gym.make(env_id, sensors=("base", "car"), **options)
