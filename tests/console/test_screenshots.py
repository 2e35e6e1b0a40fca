"""The README's pictures, made anew on request:

AIRMATRIX_SCREENSHOTS=1 .venv/bin/pytest tests/console/test_screenshots.py
"""

import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.cli.serving import AIRMATRIX, environment
from tests.console.browser import Theme, Watched

if TYPE_CHECKING:
    from playwright.sync_api import Browser

_DOCS = Path(__file__).parents[2] / "docs"
_SIZE = (1440, 900)
_TRAFFIC_MS = 180_000
_ATTEMPTS = 20

pytestmark = pytest.mark.skipif(
    "AIRMATRIX_SCREENSHOTS" not in os.environ, reason="pictures are made where AIRMATRIX_SCREENSHOTS is set"
)


def test_screenshots(browser: "Browser", tmp_path: Path) -> None:
    with demonstration(tmp_path) as url:
        draw(browser, url, "dark", close=True)
        draw(browser, url, "light", close=False)


@contextmanager
def demonstration(folder: Path) -> Iterator[str]:
    """Run `airmatrix demo` and yield its address."""
    log = folder / "demo.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [AIRMATRIX, "demo", "--port", "0", "--flights", "160", "--rate", "2"],
            cwd=folder, env=environment(), stdout=output, stderr=output,
        )  # fmt: skip
    try:
        while not (named := re.search(r"http://127\.0\.0\.1:\d+", log.read_text())):
            assert process.poll() is None, log.read_text()
        yield named[0]
    finally:
        process.terminate()
        process.wait(30)


def draw(browser: "Browser", url: str, theme: Theme, *, close: bool) -> None:
    """Write a picture of the whole airspace, or of the place of a violation that threatens another flight."""
    console = Watched(browser, url, theme=theme, size=_SIZE)
    console.live()
    page = console.page
    page.locator("#count-flights b").filter(has_text=re.compile(r"^\d{3}")).wait_for(timeout=_TRAFFIC_MS)
    page.locator("#count-red b").filter(has_not_text="0").wait_for(timeout=_TRAFFIC_MS)
    if close:
        settle(console)
    page.wait_for_timeout(1_000)
    page.screenshot(path=_DOCS / f"console-{theme}.png")
    assert console.complaints == []
    console.close()


def settle(console: Watched) -> None:
    """Go to a flight off its track whose violation lasts until the camera is there."""
    page = console.page
    violation = page.locator('#alerts-list button[data-status="red"]', has_text="violating · off its track")
    for _ in range(_ATTEMPTS):
        page.click("#tab-alerts")
        violation.first.wait_for(timeout=_TRAFFIC_MS)
        violation.first.click()
        page.locator(".conformance").wait_for()
        page.wait_for_timeout(1_500)
        if page.locator(".conformance").get_attribute("data-conformance") == "violating":
            break
    page.click("#tab-alerts")
    page.locator('#alerts-list [aria-current="true"]').scroll_into_view_if_needed()
