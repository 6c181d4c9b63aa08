"""Races of agents and robots: the game's rules, seeded grids, honest figures."""

from __future__ import annotations

import errno
import json
import os
import re
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch as th
from made_agents import copied_agent
from stable_baselines3 import PPO

from sb3_torcs.agents.drivers import find_drivers
from sb3_torcs.agents.models import find_model
from sb3_torcs.agents.pilots import AgentOpponents
from sb3_torcs.agents.robots import race as robots_race
from sb3_torcs.agents.saved.writing import recipe, write_record
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.cli import main
from sb3_torcs.envs.options import AIDS
from sb3_torcs.errors import InvalidOption, OutputNotWritable
from sb3_torcs.evaluation.comparing import saved_drives
from sb3_torcs.races import protocol
from sb3_torcs.races.picture import draw_race
from sb3_torcs.races.protocol import Race, Standing, run_race, run_races
from sb3_torcs.races.ratings import ratings
from sb3_torcs.races.standings import driver_figures, mean_interval, wilson
from sb3_torcs.races.video import Footage

SHORT = "g-track-1"


def standing(driver, place, **changes):
    values = {"laps": 1, "time": 80.0, "best_lap": None, "damage": 0.0, "contacts": 0, "out": False}
    return Standing(driver, place, place, **{**values, **changes}, distance=2000.0)


def held(*orders):
    """Races that came out as said."""
    return [
        Race(seed, [standing(name, place) for place, name in enumerate(order, 1)], {}, [], 0, 0)
        for seed, order in enumerate(orders)
    ]


def test_a_win_rate_is_wilson_s():
    """3 of 20, by hand: the centre is (3 + 1.92) / (20 + 3.84)."""
    low, rate, high = wilson(3, 20)
    assert rate == 0.15
    assert (low + high) / 2 == pytest.approx((3 + 1.920729) / (20 + 3.841459), rel=1e-5)
    assert wilson(0, 5)[0] == 0.0
    assert wilson(5, 5)[2] == 1.0


class TestTheIntervalOfAMeanPlace:
    def test_it_is_that_of_the_normal_distribution_nearly(self):
        """For many races: the mean ± 1.96 standard errors."""
        places = [1, 2, 3, 4] * 50
        low, high = mean_interval(places)
        error = np.std(places) / len(places) ** 0.5
        assert low == pytest.approx(2.5 - 1.96 * error, abs=0.03)
        assert high == pytest.approx(2.5 + 1.96 * error, abs=0.03)

    def test_it_is_the_same_each_time(self):
        assert mean_interval([1, 4, 2, 7]) == mean_interval([1, 4, 2, 7])

    @pytest.mark.parametrize("places", [[2], [3, 3, 3]])
    def test_places_that_are_all_the_same_tell_nothing(self, places):
        assert mean_interval(places) is None


def test_who_wins_more_has_the_higher_rating():
    rated = ratings([["a", "b", "c"], ["a", "c", "b"], ["b", "a", "c"]])
    assert rated["a"][0] > rated["b"][0] > rated["c"][0]
    assert all(deviation < 25.0 / 3.0 for _, deviation in rated.values())


def test_figures_are_sums_over_the_races_of_a_driver():
    races = held(["a", "b"], ["b", "a"], ["a", "c"])
    races[1].standings[1] = standing("a", 2, damage=600.0, out=True)
    figures = {figure["driver"]: figure for figure in driver_figures(races)}
    a = figures["a"]
    assert (a["races"], a["wins"], a["finished"], a["mean_place"]) == (3, 2, 2, 4 / 3)
    assert a["damage_per_km"] == 600.0 / 6.0
    assert a["mean_place_interval"] == mean_interval([1, 2, 1])
    assert (figures["c"]["races"], figures["c"]["mean_place_interval"]) == (1, None)


def test_who_is_out_has_not_won():
    (race,) = held(["a", "b"])
    race.standings[0] = standing("a", 1, out=True)
    assert {f["driver"]: f["wins"] for f in driver_figures([race])} == {"a": 0, "b": 0}


class TestGrid:
    @pytest.fixture
    def grids(self, game):
        """Hold races in which all come in as they start; return who started where."""

        def hold(order, seed):
            (race,) = held([driver.name for driver in order])
            return race

        def grids(drivers, **options):
            races = run_races(find_drivers(drivers), hold, **{"races": 8, **options})
            return [[s.driver for s in race.standings] for race in races]

        return grids

    DRIVERS = ("inferno", "bt", "tita", "lliaw")

    def test_the_first_driver_starts_last_and_the_others_are_drawn(self, grids):
        found = grids(self.DRIVERS, grid="last")
        assert {order[-1] for order in found} == {"inferno"}
        assert len({tuple(order) for order in found}) > 2

    def test_a_seed_is_a_grid(self, grids):
        for grid in ("last", "random"):
            found = grids(self.DRIVERS, grid=grid, seed=3)
            assert found == grids(self.DRIVERS, grid=grid, seed=3)
            assert found[1:] == grids(self.DRIVERS, grid=grid, seed=4, races=7)

    def test_random_puts_the_first_driver_anywhere(self, grids):
        found = grids(self.DRIVERS, grid="random")
        assert len({order.index("inferno") for order in found}) > 1

    def test_reverse_turns_the_standings_round(self, grids):
        found = grids(self.DRIVERS, grid="reverse", races=3)
        assert found[1] == found[0][::-1]
        assert found[2] == found[0]

    def test_a_field_is_drawn_of_the_others(self, grids):
        found = grids(self.DRIVERS, field_size=2)
        assert {len(order) for order in found} == {2}
        assert {order[-1] for order in found} == {"inferno"}
        assert len({order[0] for order in found}) > 1

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"field_size": 5}, "5 drivers in each race, by --field .*from 1 to 4, as many"),
            ({"grid": "front"}, "grid is 'front'; expected 'last', 'reverse' or 'random'"),
        ],
    )
    def test_what_cannot_be_held(self, grids, options, message):
        with pytest.raises(InvalidOption, match=message):
            grids(self.DRIVERS, **options)


@pytest.mark.parametrize(
    ("drivers", "message"),
    [
        (["bt", "bt:2"], "driver 'bt' is named twice"),
        (["ddpg-aalborg", "ddpg-aalborg"], "driver 'ddpg-aalborg' is named twice"),
        (["infermo"], "no driver 'infermo'; did you mean 'inferno'"),
    ],
)
def test_a_driver_that_cannot_take_part(drivers, message, game):
    with pytest.raises(InvalidOption, match=message):
        find_drivers(drivers)


def test_more_cars_than_a_grid_has_room_for_are_refused(game):
    (bt,) = find_drivers(["bt"])
    crowd = [replace(bt, name=str(number)) for number in range(21)]
    with pytest.raises(InvalidOption, match=r"21 drivers in a race; .* room for 20: .*--field 20"):
        run_races(crowd, lambda order, seed: None, races=1)
    sizes = []

    def hold(order, seed):
        sizes.append(len(order))
        return held("ab")[0]

    list(run_races(crowd, hold, races=2, field_size=20))
    assert sizes == [20, 20]


def test_races_that_cannot_be_held_are_refused_at_once(game):
    drivers = find_drivers(["bt", "inferno"])
    for wrong in ({"races": 0}, {"races": 1, "grid": "x"}, {"races": 1, "field_size": 3}):
        with pytest.raises(InvalidOption):
            run_races(drivers, lambda order, seed: None, **wrong)


def test_models_of_one_file_name_are_told_apart_by_their_folders(game, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = find_model("ddpg-aalborg").read_bytes()
    paths = ["r1/model.zip", "a/r2/model.zip", "b/r2/model.zip", "bt.zip", "r1/other.zip"]
    paths += ["c/run/best_model.zip", "d/run/best_model.zip", "r1/ddpg-aalborg.zip"]
    for path in paths:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(shipped)
    drivers = find_drivers([*paths, "bt", "ddpg-aalborg"])
    assert [driver.name for driver in drivers] == [
        "r1/model", "a/r2/model", "b/r2/model", f"{tmp_path.name}/bt", "other",
        "c/run", "d/run", "r1/ddpg-aalborg", "bt", "ddpg-aalborg",
    ]  # fmt: skip
    with pytest.raises(InvalidOption, match=r"driver 'r1/model\.zip' is named twice"):
        find_drivers(["r1/model.zip", "a/../r1/model", "bt"])


def test_the_error_is_one_wherever_robots_and_agents_can_be_named(capsys, game):
    message = "there is no driver 'infermo'; did you mean 'inferno'"
    for find in (lambda: find_drivers(["infermo"]), lambda: AgentOpponents(["infermo"])):
        with pytest.raises(InvalidOption, match=message):
            find()
    for command in (["compare", "infermo", "bt"], ["watch", "infermo"], ["race", "infermo"]):
        assert main(command) == 2
        assert message in capsys.readouterr().err


def test_robots_race_as_by_the_game_s_rules(game):
    """The same order, times and damage as ``sb3-torcs robots``, which equals the game."""
    robots = [("bt", 2), ("inferno", 3)]
    race = run_race(find_drivers(["bt", "inferno"]), SHORT, laps=2)
    for one, other in zip(
        race.standings, robots_race(robots, SHORT, 2, session="race"), strict=True
    ):
        assert (one.driver, one.laps) == (other.robot, other.laps_completed)
        assert (one.time, one.best_lap, one.damage) == (
            other.total_time, other.best_lap, other.damage,
        )  # fmt: skip
        assert not one.out


def test_a_race_is_the_same_race_twice(game):
    drivers = find_drivers(["scripted", "bt"])
    one, other = (run_race(drivers, SHORT, laps=1) for _ in range(2))
    assert one.standings == other.standings
    assert np.array_equal(one.distances, other.distances)
    assert [standing.driver for standing in one.standings] == ["bt", "scripted"]
    assert one.places[-1].tolist() == [2, 1]


def test_distances_count_from_the_line_and_not_from_each_car_s_slot(game):
    """After a second, before anybody has overtaken: as they stood, and behind the line."""
    race = run_race(find_drivers(["bt", "inferno"]), SHORT, laps=1)
    first, second = race.distances[0]
    assert second < first - 5.0
    assert first < 0.0


def test_an_agent_that_answers_no_number_is_out_and_the_others_race_on(monkeypatch, game):
    asked = []
    predict = ScriptedDriver.predict

    def failing(self, observation, *words, **options):
        action, state = predict(self, observation, *words, **options)
        asked.append(1)
        return (action * np.nan if len(asked) > 50 else action), state

    monkeypatch.setattr(ScriptedDriver, "predict", failing)
    race = run_race(find_drivers(["scripted", "bt"]), SHORT, laps=1)
    first, second = race.standings
    assert (first.driver, first.out, second.driver, second.out) == ("bt", False, "scripted", True)
    assert "steering is nan" in race.failures["scripted"]
    assert len(asked) == 51


def test_a_policy_that_refuses_to_draw_from_no_numbers_is_out_too(game, tmp_path):
    """PyTorch's distributions raise where a deterministic policy answers NaN."""
    env = gym.make("Torcs-v0", track=SHORT)
    model = PPO("MlpPolicy", env, device="cpu")
    env.close()
    with th.no_grad():
        for weights in model.policy.parameters():
            weights.copy_(3e38 * th.sign(weights + 1e-9))
    write_record(model, recipe("ppo", "Torcs-v0", {}))
    model.save(tmp_path / "astray")
    drivers = find_drivers([str(tmp_path / "astray.zip"), "bt"])
    race = run_race(drivers, SHORT, laps=1)
    assert [standing.out for standing in race.standings] == [False, True]
    assert "computes no numbers" in next(iter(race.failures.values()))


@pytest.mark.slow
def test_a_race_with_hard_contacts_ends_with_numbers(game, tmp_path):
    """A contact may put a car nowhere: then its driver is out, and the others race on."""
    racer = copied_agent("ppo-racer", tmp_path / "racer.zip", aids=["unstick", "keep_distance"])
    drivers = find_drivers(["inferno", racer])
    race = run_race(drivers, "aalborg", laps=3)
    assert {one.driver for one in race.standings if one.out} == set(race.failures)
    assert np.isfinite(race.distances).all()


@pytest.mark.parametrize("laps", [0, 1 << 31])
def test_a_race_of_no_laps_or_too_many_is_refused(game, laps):
    with pytest.raises(InvalidOption, match=f"laps is {laps}; expected a whole number"):
        run_race(find_drivers(["bt"]), SHORT, laps=laps)


def test_no_report_is_made_of_a_race_without_a_whole_lap(capsys, game, monkeypatch, tmp_path):
    """What else was asked for is there."""
    monkeypatch.setattr(protocol, "SLOWEST", 1e4)  # the race ends after the time for a pit stop
    monkeypatch.setattr(protocol, "PIT_STOP", 1.0)
    report, picture = tmp_path / "race.html", tmp_path / "race.png"
    words = ["race", "bt", "inferno", "--track", SHORT, "--laps", "1", "--races", "1"]
    assert main([*words, "--report", str(report), "--picture", str(picture)]) == 0
    printed = capsys.readouterr()
    assert "no report: no driver completed a lap" in printed.err
    assert (report.exists(), picture.is_file()) == (False, True)
    assert f"picture: {picture}" in printed.out
    assert "report:" not in printed.out


def test_an_agent_that_learned_alone_may_get_aids(tmp_path, game):
    """It races as one whose record has them, to the bit."""
    alone = "ppo-any-road"
    with_aids = copied_agent(alone, tmp_path / "agent.zip", aids=AIDS)
    races = [
        run_race(find_drivers(["bt", "inferno", agent], aids), SHORT, laps=1)
        for agent, aids in ((alone, AIDS), (with_aids, ()), (alone, ()))
    ]
    aided, shipped, alone = (
        [{**standing.as_dict(), "driver": None} for standing in race.standings] for race in races
    )
    assert aided == shipped != alone


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ("keep_clea", "aids has 'keep_clea'; did you mean 'keep_clear'"),
        ("unstick,", "aids has ''; the driver aids are unstick"),
    ],
)
def test_no_such_aid(capsys, game, names, message):
    assert main(["race", "scripted", "bt", "--aids", names]) == 2
    assert re.search(message, capsys.readouterr().err)


def test_robots_get_no_aids(capsys, game):
    assert main(["race", "inferno", "bt", "--aids", "all"]) == 2
    assert "--aids is for agents, and all drivers are robots" in capsys.readouterr().err


def test_an_agent_with_aids_and_without_a_record_is_still_told(game, tmp_path):
    file = tmp_path / "plain.zip"
    PPO("MlpPolicy", "sb3_torcs:TorcsLite-v0", n_steps=2, batch_size=2, device="cpu").save(file)
    (driver,) = find_drivers([str(file)], ["unstick"])
    assert not driver.record.known
    assert driver.options(["action"]) == {"aids": ("unstick",)}


def test_policies_of_one_driver_are_asked_at_once(monkeypatch, game):
    """A row for each of its cars."""
    shapes = []
    predict = ScriptedDriver.predict
    monkeypatch.setattr(
        ScriptedDriver,
        "predict",
        lambda self, seen, *words, **options: (
            shapes.append(seen.shape) or predict(self, seen, *words, **options)
        ),
    )
    (driver,) = find_drivers(["scripted"])
    run_race([driver, driver, driver], SHORT, laps=1)
    assert set(shapes) == {(3, 29)}


def test_the_command_prints_one_object(capsys, game, tmp_path):
    picture = tmp_path / "race.svg"
    words = ["race", "scripted", "bt", "--track", SHORT, "--laps", "1", "--races", "2", "--json"]
    assert main([*words, "--picture", str(picture)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert list(printed) == ["track", "laps", "grid", "races", "drivers"]
    assert [race["seed"] for race in printed["races"]] == [0, 1]
    assert list(printed["races"][0]["standings"][0]) == [
        "driver", "place", "grid_slot", "laps", "time", "best_lap", "damage", "contacts", "out",
    ]  # fmt: skip
    assert printed["races"][0]["standings"][1]["grid_slot"] == 2
    best = printed["drivers"][0]
    assert (best["driver"], best["races"], best["wins"], best["win_rate"][1]) == ("bt", 2, 2, 1.0)
    assert picture.stat().st_size > 1000


def test_the_picture_ends_with_the_race_and_a_line_where_its_car_stops(tmp_path, monkeypatch):
    drawn = []

    def savefig(figure, file):
        drawn.append(figure)
        file.touch()

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", savefig)
    standings = [standing("a", 1), standing("b", 2, out=True)]
    distances = np.array([[0.0, -10.0], [60.0, 42.0], [90.0, 40.5], [105.0, 40.0]])
    draw_race(
        Race(0, standings, {}, ["a", "b"], distances, np.ones((4, 2)), 100.0), tmp_path / "r.png"
    )
    _, gaps = drawn[0].axes
    behind = [[0.0, 0.0, 0.0], [10.0, 18.0, 49.5]]
    assert [line.get_ydata().tolist() for line in gaps.lines] == behind
    assert [line.get_marker() for line in gaps.lines] == ["None", "x"]
    assert gaps.yaxis_inverted()


def test_a_full_disk_keeps_the_picture_of_before(tmp_path, monkeypatch):
    race = replace(held("ab")[0], drivers=["a", "b"], distances=np.eye(2), places=np.eye(2))
    picture = tmp_path / "race.svg"
    draw_race(race, picture)
    before = picture.read_bytes()
    assert before.startswith(b"<?xml")

    def savefig(figure, file):
        file.write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", savefig)
    with pytest.raises(OutputNotWritable, match=rf"{re.escape(str(picture))}': No space left"):
        draw_race(race, picture)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [before]


def test_ctrl_c_keeps_the_races_that_are_over(capsys, game, tmp_path, monkeypatch):
    held = protocol.run_race

    def run_race(*arguments, **options):
        if options["seed"] == 2:
            raise KeyboardInterrupt
        return held(*arguments, **options)

    monkeypatch.setattr(protocol, "run_race", run_race)
    picture, drives = tmp_path / "race.svg", tmp_path / "race.parquet"
    words = ["race", "scripted", "bt", "--track", SHORT, "--laps", "1", "--races", "3", "--json"]
    assert main([*words, "--picture", str(picture), "--telemetry", str(drives)]) == 130
    assert [race["seed"] for race in json.loads(capsys.readouterr().out)["races"]] == [0, 1]
    assert picture.is_file()
    assert not drives.exists()
    assert main(["race", "scripted", "bt", "--track", SHORT, "--seed", "2"]) == 130
    assert capsys.readouterr().out == ""


def test_a_video_that_fails_takes_nothing_else_with_it(capsys, game, tmp_path, monkeypatch):
    def fail(*_):
        raise OutputNotWritable("ffmpeg stopped writing")

    monkeypatch.setattr(Footage, "save", fail)
    words = ["race", "scripted", "bt", "--track", SHORT, "--laps", "1", "--races", "1"]
    files = {"--video": "a.mp4", "--picture": "a.png", "--telemetry": "a.parquet"}
    for option, name in files.items():
        words += [option, str(tmp_path / name)]
    assert main(words) != 0
    assert "ffmpeg" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.parquet", "a.png"]


def test_the_last_race_is_written_and_reported(capsys, game, tmp_path):
    """Tick by tick, which changes nothing: the standings are those of a race that nobody notes."""
    words = ["race", "scripted", "bt", "--track", SHORT, "--laps", "2", "--races", "1", "--json"]
    drives, page = tmp_path / "race.parquet", tmp_path / "race.html"
    assert main([*words, "--telemetry", str(drives), "--report", str(page)]) == 0
    noted = capsys.readouterr().out
    assert main(words) == 0
    assert capsys.readouterr().out == noted
    best = {one["driver"]: one["best_lap"] for one in json.loads(noted)["races"][0]["standings"]}
    saved = {drive.driver: min(lap.time for lap in drive.laps) for drive in saved_drives(drives)}
    assert {driver: round(seconds, 3) for driver, seconds in saved.items()} == best
    moments = pq.read_table(drives, columns=["driver", "time"]).to_pandas()
    assert not moments.duplicated().any()
    assert "<title>g-track-1: scripted " in page.read_text()
