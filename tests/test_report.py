"""The report says what the table of results says: every seed, failures too, and always the same."""

import csv
import json
import math
import re

import numpy as np
import pytest
from browser import opened, requested, told

from sb3_torcs.cli import main
from sb3_torcs.studies.config import FIELDS
from sb3_torcs.studies.estimates import estimate, share
from sb3_torcs.studies.report import read_results, write_report

LAPS = (97.0, 84.0, 83.5)


def row(seed, phase="train", timesteps=100, track="aalborg", laps=LAPS, ladder="finishes", **more):
    whole = len(laps) == 3
    return {
        "study": "demo", "variant": "base", "seed": seed, "phase": phase, "decisions": timesteps,
        "episodes": timesteps // 10, "wall_s": timesteps / 2, "cpu_s": timesteps / 3,
        "track": track, "laps": len(laps), "completes": int(whole),
        "lap_times_s": " ".join(map(str, laps)), "best_flying_lap_s": min(laps[1:], default=""),
        "race_time_s": sum(laps) if whole else "", "distance_m": 7000.0 if whole else 900.0,
        "end": "laps" if whole else "off_track", "damage": 0.0, "return": 1.0, "kept": int(whole),
        "ladder": ladder if whole else "", **more,
    }  # fmt: skip


def written(folder, rows):
    folder.mkdir(exist_ok=True)
    with (folder / "results.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, FIELDS)
        table.writeheader()
        table.writerows(rows)
    return folder


@pytest.fixture
def study(tmp_path):
    """Two seeds that complete, one of them elsewhere too, and one that never laps."""
    rows = []
    for seed in (0, 1):
        rows += [row(seed, laps=()), row(seed, timesteps=200, laps=LAPS[:2])]
        rows += [row(seed, timesteps=300)]
        rows += [row(seed, "final", 300, ladder=("finishes", "beats bt")[seed])]
        rows += [row(seed, "final", 300, "alpine-1", laps=LAPS if seed else ())]
    rows += [row(2, laps=(), kept=1)]
    rows += [row(2, timesteps=timesteps, laps=()) for timesteps in (200, 300)]
    rows += [row(2, "final", 100, laps=()), row(2, "final", 100, "alpine-1", laps=())]
    return written(tmp_path / "study", rows)


def complaint(folder, capsys, *words):
    assert main(["study", "--report", str(folder), *words]) == 2
    return capsys.readouterr().err


def lines_of(report, start):
    return [line for line in report.read_text().splitlines() if line.startswith(start)]


def test_every_seed_is_in_the_report_failures_too(study, tmp_path):
    report = write_report(study, tmp_path / "out")
    (summary,) = lines_of(report, "| base |")
    assert "| 2 of 3 | 83.500 | 83.500 |" in summary
    assert summary.endswith("| 200 | 20 | 1.7 |")
    one, _, failed = [line for line in lines_of(report, "| base, ") if "of 300" in line]
    assert "| base, 0 | yes | 97.000, 84.000, 83.500 | 7000 | laps | 300 of 300 | 1 of 3 |" in one
    assert "| base, 2 | no | - | 900 | off_track | 100 of 300 | 0 of 3 | never | - | - |" in failed
    assert lines_of(report, "| base, aalborg") == ["| base, aalborg | 3 | 2 | 1 | 1 | 0 | 83.500 |"]
    assert lines_of(report, "| base, alpine-1")[0].startswith("| base, alpine-1 | 3 | 1 | 0 |")
    assert "| base, 1 | 2 of 2 (100 %) | 1 of 1 (100 %) |" in report.read_text()
    assert "| base, 2 | 0 of 2 (0 %) | 0 of 1 (0 %) |" in report.read_text()


def test_the_same_results_give_the_same_report_to_the_byte(study, tmp_path, capsys):
    assert main(["study", "--report", str(study), "--output", str(tmp_path / "one")]) == 0
    assert capsys.readouterr().out == f"{tmp_path}/one/report.md\n{tmp_path}/one/report.html\n"
    np.random.default_rng().random()
    write_report(study, tmp_path / "two")
    names = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert names == ["learning-base.png", "report.html", "report.md"]
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_a_study_that_still_runs_can_be_reported(tmp_path):
    """One seed is two evaluations ahead, and nothing is measured yet."""
    rows = [row(0), row(0, timesteps=200), row(0, timesteps=300), row(1, laps=(), kept=1)]
    report = write_report(written(tmp_path / "study", rows), tmp_path / "out")
    assert lines_of(report, "| base, 0 | not measured |")
    assert lines_of(report, "| base | not measured yet |")
    assert not lines_of(report, "## The ladder")
    assert [len(trial.train) for trial in read_results(tmp_path / "study")] == [3, 1]


def test_rows_of_several_machines_may_be_mixed(study, tmp_path):
    write_report(study, tmp_path / "whole")
    heading, *rows = (study / "results.csv").read_text().splitlines(keepends=True)
    mixed = [row for which in (0, 1, 2) for row in rows[which::5]] + rows[3::5] + rows[4::5]
    (study / "results.csv").write_text("".join([heading, *mixed]))
    write_report(study, tmp_path / "mixed")
    for name in ("report.md", "learning-base.png"):
        assert (tmp_path / "mixed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_every_variant_has_a_colour_and_a_dash_of_its_own(tmp_path):
    rows = [row(0, variant=f"variant {number}") for number in range(9)]
    write_report(written(tmp_path / "study", rows), tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', page)[1])
    looks = [
        (curve["colour"], curve["dash"])
        for curve in data["panels"][0]["curves"] if curve.get("bold")
    ]  # fmt: skip
    assert len(set(looks)) == 9
    assert page.count('<span class="chip dash"') == 2


def test_few_seeds_have_no_interval(tmp_path):
    rows = [row(seed, phase) for seed in (0, 1) for phase in ("train", "final")]
    (summary,) = lines_of(write_report(written(tmp_path / "study", rows), tmp_path), "| base |")
    assert summary.startswith("| base | 2 of 2 | 83.500 | 83.500 | - |")


def test_who_was_never_evaluated_is_named(study, tmp_path):
    for name, rows in (("base-seed0", True), ("base-seed3", False), ("base-seed4", False)):
        (study / name).mkdir()
        (study / name / "recipe.yml").touch()
        if rows:
            (study / name / "rows.json").touch()
    (said,) = lines_of(write_report(study, tmp_path / "out"), "Not evaluated yet")
    assert said == "Not evaluated yet, and in no figure: base-seed3, base-seed4."


def test_the_track_that_chose_the_models_is_named(tmp_path):
    rows = [row(0), row(0, "final"), row(0, variant="other", track="forza")]
    report = write_report(written(tmp_path / "study", rows[:2]), tmp_path / "out")
    assert lines_of(report, "## ")[:2] == ["## Summary, on aalborg", "## Every seed, on aalborg"]
    report = write_report(written(tmp_path / "study", rows), tmp_path / "out")
    (said,) = lines_of(report, "## Sum")
    assert said == "## Summary, each on the first track that chose its model"
    rows = [row(0), row(0, track="forza"), row(0, "final")]
    report = write_report(written(tmp_path / "study", rows), tmp_path / "out")
    (said,) = lines_of(report, "## Sum")
    assert said == "## Summary, on aalborg, the first of those that chose the models"


def test_a_name_is_no_table(tmp_path):
    rows = [row(0, variant="a | b"), row(0, "final", variant="a | b")]
    report = write_report(written(tmp_path / "study", rows), tmp_path / "out")
    assert lines_of(report, "| a \\| b |")[0].replace("\\|", "").count("|") == 9


@pytest.mark.parametrize(
    "change",
    [
        {"phase": "final"}, {"phase": "trian"}, {"kept": False}, {"ladder": "flies"},
        {"decisions": -1}, {"wall_s": "nan"}, {"lap_times_s": "97.0 -84.0 83.5"},
    ],
)  # fmt: skip
def test_rows_that_say_nothing_are_told(tmp_path, capsys, change):
    said = complaint(written(tmp_path / "study", [{**row(0), **change}]), capsys)
    assert "results.csv cannot be read as results (ValueError" in said


@pytest.mark.parametrize("text", ["garbage,1\n", "a,b\n1,2\n", "{}\nbase,0\n", "\xff"])
def test_a_table_that_is_damaged_is_told(tmp_path, capsys, text):
    heading = ",".join(FIELDS)
    (tmp_path / "results.csv").write_bytes(text.format(heading).encode("latin-1"))
    assert "results.csv cannot be read as results (" in complaint(tmp_path, capsys)


def test_what_is_no_study_is_told(tmp_path, capsys):
    assert "holds no results.csv; give the folder" in complaint(tmp_path, capsys)
    (tmp_path / "folder" / "results.csv").mkdir(parents=True)
    assert "(IsADirectoryError" in complaint(tmp_path / "folder", capsys)
    said = complaint(written(tmp_path / "empty", []), capsys)
    assert "no agent was evaluated yet" in said


@pytest.mark.parametrize("taken", ["out", "out/report.md"])
def test_a_report_that_cannot_be_written_is_told(study, tmp_path, capsys, taken):
    if taken == "out":
        (tmp_path / "out").touch()
    else:
        (tmp_path / taken).mkdir(parents=True)
    said = complaint(study, capsys, "--output", str(tmp_path / "out"))
    assert f"cannot write '{tmp_path}/out/" in said


def test_the_page_shows_every_seed_and_sorts_its_tables(study, tmp_path):
    """In a browser: a curve per seed and two of the mean, no error, and no network."""
    write_report(study, tmp_path / "out")
    page = tmp_path / "out" / "report.html"
    with opened(page) as browser:
        assert told(browser) == []
        assert requested(browser) == [page.as_uri()]
        curves = browser.execute_script("return data.panels[0].curves.map((c) => c.text)")
        assert curves[:3] == ["base, seed 0", "base, seed 1", "base, seed 2"]
        column = (
            "const [table] = [...document.querySelectorAll('table.sortable')].filter("
            "  (t) => t.tHead.textContent.includes('model kept at'));"
            "const header = table.tHead.rows[0].cells[3];"
            "header.querySelector('button').click();"
            "const rows = [...table.tBodies[0].rows];"
            "return [header.ariaSort, rows.map((row) => row.cells[3].textContent)]"
        )
        assert browser.execute_script(column) == ["ascending", ["900", "7000", "7000"]]
        assert browser.execute_script(column) == ["descending", ["7000", "7000", "900"]]


def test_the_page_links_what_lies_beside_a_seed(study, tmp_path):
    (study / "base-seed1").mkdir()
    (study / "base-seed1" / "lap.html").touch()
    write_report(study, tmp_path / "out")
    text = (tmp_path / "out" / "report.html").read_text()
    assert text.count("<a href=") == 1
    assert '<a href="../study/base-seed1/lap.html">lap report</a>' in text
    assert f"sb3-torcs evaluate {study}/base-seed0 --report" in text


INF = math.inf
SECONDS = [74.55, 75.1, 76.32, 74.9, 80.4, 75.7, 79.2, 77.0, 74.6, 75.3, INF, 78.8, 76.1, 75.9, INF]
"""Best laps of fifteen seeds [s], two of which have none."""

# Value, low and high that rliable 1.2.0 has computed with the same 2,000 draws.
OF_RLIABLE = {
    2: ([74.82499999999999, 74.55, 75.1], [1.0, 1.0, 1.0]),
    3: ([75.32333333333332, 74.55, 76.32], [0.6666666666666666, 0.0, 1.0]),
    5: ([75.44, 74.66666666666667, 79.04], [0.6, 0.2, 1.0]),
    8: ([76.03, 75.05, 78.4], [0.5, 0.125, 0.875]),
    10: ([75.72, 74.925, 77.53333333333333], [0.6, 0.3, 0.9]),
    15: ([76.60222222222222, 75.44666666666666, INF], [0.4666666666666667, 0.2, 11 / 15]),
}  # fmt: skip


@pytest.mark.parametrize("seeds", OF_RLIABLE)
def test_figures_are_those_of_rliable(seeds):
    """Sums in another order differ in the last bit, which no table shows."""
    laps = np.array(SECONDS[:seeds])[:, None]
    quick = (laps < 76.0).astype(float)
    lap, share_of_quick = OF_RLIABLE[seeds]
    assert np.ravel(estimate(laps)) == pytest.approx(lap, rel=4e-16, abs=0.0)
    assert np.ravel(estimate(quick, share)) == pytest.approx(share_of_quick, rel=4e-16, abs=0.0)


def test_each_point_of_a_curve_is_estimated_as_it_is_alone():
    curves = np.random.default_rng(0).random((9, 4))
    together = estimate(curves)
    for point in range(4):
        alone = estimate(curves[:, point : point + 1])
        assert [float(part[point]) for part in together] == [float(part[0]) for part in alone]


def test_one_seed_has_no_spread():
    assert [part.tolist() for part in estimate(np.array([[80.0, 3.0]]))] == [[80.0, 3.0]] * 3


def test_a_seed_without_a_lap_counts_as_infinitely_slow():
    laps = np.array([[80.0], [81.0], [82.0], [math.inf]])
    assert estimate(laps).value.tolist() == [81.5]  # the best and the worst quarter are cut
    assert estimate(laps).high.tolist() == [math.inf]
    assert 80.0 <= estimate(laps).low[0] <= 81.5
    two = np.array([[80.0], [81.0], [math.inf], [math.inf]])
    assert estimate(two).value.tolist() == [math.inf]


def test_an_interval_lies_around_its_figure_and_is_the_same_each_time():
    scores = np.random.default_rng(0).random((15, 4)).round()
    first, again = estimate(scores, share), estimate(scores, share)
    assert (first.low <= first.value).all()
    assert (first.value <= first.high).all()
    assert first.low.tolist() == again.low.tolist()
    assert (first.high - first.low > 0.1).all()


def test_a_study_in_which_nobody_laps_is_reported_too(tmp_path):
    rows = [row(seed, laps=(), kept=1, timesteps=n) for seed in (0, 1) for n in (100, 200)]
    report = write_report(written(tmp_path / "study", rows), tmp_path / "out")
    assert lines_of(report, "| base |") == ["| base | not measured yet | - | - | - | - | - | - |"]


def test_one_picture_shows_all_variants(tmp_path):
    rows = [
        row(seed, variant=variant, timesteps=timesteps)
        for variant in ("base", "wide")
        for seed in (0, 1, 2)
        for timesteps in (100, 200)
    ]
    folder = written(tmp_path / "study", rows)
    text = write_report(folder, tmp_path / "out").read_text()
    assert sorted(path.name for path in (tmp_path / "out").glob("*.png")) == [
        "learning-base.png", "learning-wide.png", "learning.png",
    ]  # fmt: skip
    assert text.index("![all variants](learning.png)") < text.index("![base](learning-base.png)")
    assert (tmp_path / "out" / "learning.png").read_bytes()[:4] == b"\x89PNG"


def test_the_whole_distance_is_in_the_picture(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        "matplotlib.figure.Figure.savefig",
        lambda figure, *_, **__: seen.append([axes.get_ylim() for axes in figure.axes]),
    )
    rows = [row(seed) for seed in (0, 1)]
    write_report(written(tmp_path / "study", rows), tmp_path / "out")
    (low, high) = seen[0][0]
    assert low == 0.0
    assert high > 7000.0
