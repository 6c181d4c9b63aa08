"""The lap report in a real browser: it opens alone, moves every car, and says the right times."""

from __future__ import annotations

import pytest
from browser import NARROW, WIDE, opened, point, requested, told, wait

from sb3_torcs.evaluation.comparing import compare

ROBOTS = ("inferno", "berniw:3", "bt:3")


@pytest.fixture(scope="module")
def report(game):
    return compare(*ROBOTS, track="aalborg", laps=2)


@pytest.fixture(scope="module")
def page(report, tmp_path_factory):
    return report.save(tmp_path_factory.mktemp("report") / "report.html")


@pytest.fixture(scope="module")
def browser(page):
    with opened(page) as found:
        yield found


def cars(browser):
    """Where the cars are on the map [m], the first driver's last."""
    return browser.execute_script("const t = map.data[cars]; return t.x.map((x, n) => [x, t.y[n]])")


def readout(browser, driver, column):
    return browser.execute_script(
        "return document.getElementById(arguments[0]).cells[arguments[1]].textContent",
        f"driver-{driver}", column,
    )  # fmt: skip


@pytest.mark.parametrize("size", [WIDE, NARROW])
def test_it_opens_without_an_error_and_without_a_network(page, size):
    with opened(page, size) as browser:
        assert told(browser) == []
        assert requested(browser) == [page.as_uri()]
        assert browser.execute_script("return document.documentElement.scrollWidth") <= size[0]


def test_the_pointer_moves_every_car(browser):
    browser.execute_script("scrollTo(0, 0)")
    point(browser, 200, 400)
    first = wait(lambda: readout(browser, 1, 5)) and cars(browser)
    point(browser, 600, 400)
    wait(lambda: cars(browser) != first)
    moved = zip(first, cars(browser), strict=True)
    assert all(before != after for before, after in moved)
    assert len(first) == len(ROBOTS)


def test_the_first_car_is_where_the_pointer_points(browser):
    point(browser, 500, 300)
    share = browser.execute_script(
        "return (500 - charts.getBoundingClientRect().left - MARGIN.l) / inner()"
    )
    length = browser.execute_script("return lapLength")
    wait(lambda: browser.execute_script("return byId('where').textContent").endswith(" m"))
    where = float(browser.execute_script("return byId('where').textContent").split()[2])
    assert abs(where - share * length) <= 1.0  # [m] what is shown is rounded


def test_the_time_behind_at_the_end_is_the_difference_of_the_lap_times(browser, report):
    """To 2 ms: the page holds numbers of 32 bits."""
    times = [one.lap.time for one in report.comparison.drivers]
    ends = browser.execute_script("return drivers.map((d) => d.delta[d.delta.length - 1])")
    assert ends == pytest.approx([time - times[0] for time in times], abs=0.002)
    browser.execute_script("show(longest)")
    wait(lambda: readout(browser, 1, 5) == f"{times[1] - times[0]:+.3f}".replace("-", "−"))


def test_it_plays_the_lap(browser):
    browser.execute_script("show(0)")
    browser.find_element("id", "play").click()
    wait(lambda: browser.execute_script("return moment > 0.2"))
    browser.find_element("id", "play").click()
    assert browser.execute_script("return before") is None


def test_a_corner_is_shown_from_near_and_the_whole_lap_again(browser, report):
    corner = report.comparison.corners[2]
    browser.execute_script("document.querySelectorAll('tbody.group')[2].click()")
    near = "return charts.layout.xaxis.range"
    wait(lambda: browser.execute_script(near)[0] == pytest.approx(corner.begin - 120.0))
    browser.execute_script("scrollTo(0, 0)")
    browser.find_element("id", "whole").click()
    wait(lambda: browser.execute_script(near)[0] == 0)


def test_the_map_follows_the_first_car(browser):
    browser.execute_script("scrollTo(0, 0)")
    browser.find_element("id", "follow").click()
    point(browser, 500, 300)
    wide = "const [low, high] = map.layout.xaxis.range; return high - low"
    wait(lambda: browser.execute_script(wide) < 300.0)
    browser.find_element("id", "follow").click()
    wait(lambda: browser.execute_script(wide) > 500.0)


def test_it_is_printed_on_pages_of_paper(browser):
    printed = browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
    assert len(printed["data"]) > 10_000
    assert told(browser) == []


def test_two_drivers_of_aalborg_take_little_room(report):
    assert len(report.html.encode()) < 6_000_000
