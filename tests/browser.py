"""A real browser for tests of pages: Debian's Chromium, driven by Selenium."""

from __future__ import annotations

import json
import shutil
import time
from contextlib import contextmanager

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.actions.action_builder import ActionBuilder

PATIENCE = 600.0  # [s] for a page to be ready, on a busy machine
WIDE, NARROW = (1440, 900), (390, 844)  # a desk, a phone


def program(*names):
    """The first of the programs that is installed."""
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        pytest.fail(f"this test needs {names[0]}; type: make browser")
    return found


@contextmanager
def opened(page, size=WIDE):
    """A page that is open and ready."""
    options = webdriver.ChromeOptions()
    options.binary_location = program("chromium", "google-chrome")
    for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(word)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(program("chromedriver")))
    try:
        metrics = dict(zip(("width", "height"), size, strict=True))
        metrics |= {"deviceScaleFactor": 1, "mobile": size == NARROW}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        browser.get(page.as_uri())
        wait(lambda: browser.execute_script("return document.body.dataset.ready"))
        yield browser
    finally:
        browser.quit()


def wait(true):
    """Wait until something is true, and return it."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        value = true()
        if value:
            return value
        time.sleep(0.05)
    pytest.fail("the page is not ready")


def point(browser, x, y):
    """Move the pointer to a place of the window."""
    builder = ActionBuilder(browser)
    builder.pointer_action.move_to_location(int(x), int(y))
    builder.perform()


def told(browser):
    """What the console says."""
    return [entry["message"] for entry in browser.get_log("browser")]


def requested(browser):
    """The addresses that the page has asked for."""
    events = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    urls = [
        event["params"]["request"]["url"]
        for event in events
        if event["method"] == "Network.requestWillBeSent"
    ]
    return [url for url in urls if not url.startswith("data:")]
