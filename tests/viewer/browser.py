"""A headless browser with software WebGL, where one is installed."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def open_browser(width: int = 800, height: int = 560):
    """A driver of Chromium. Skips the test where browser or driver is missing."""
    from selenium import webdriver

    program = os.environ.get("CHROME") or next(filter(None, map(shutil.which, NAMES)), None)
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip(
            "no browser: install chromium and chromium-driver (Debian: apt-get install chromium chromium-driver)"
        )
    options = webdriver.ChromeOptions()
    options.binary_location = program
    size = f"--window-size={width},{height}"
    for argument in ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", size):
        options.add_argument(argument)
    options.add_argument("--disable-dev-shm-usage")
    options.add_argument("--force-device-scale-factor=0.5")  # a quarter of the pixels, which the processor draws
    for argument in (
        "--disable-gpu-compositing",
        "--disable-gpu-rasterization",
    ):  # of what is no WebGL: a third of the time
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    browser.set_script_timeout(60)
    return browser


def wait_until(browser, condition: str, seconds: float = 60.0):
    """The value of a JavaScript expression, once it is true."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = browser.execute_script(f"return {condition}")
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError(f"never true: {condition}; {browser.get_log('browser')}")


def opened(browser, path: Path):
    """The page, loaded and drawn."""
    browser.get(path.as_uri())
    failed = wait_until(browser, "window.viewerFailed || (window.viewer && viewer.settled && 'drawn')")
    assert failed == "drawn", failed
    return browser
