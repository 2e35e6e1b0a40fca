"""Debian's chromium with WebGL in software, driven by Playwright; and what a page has to say for itself."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from PIL import Image

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

_FLAGS = (
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
)  # fmt: skip
# Software WebGL on a busy machine takes its time.
PATIENCE_MS = 20_000

Theme = Literal["dark", "light"]


class NoBrowser(Exception):
    """There is no browser to be had; the text says how to get it."""


@contextmanager
def chromium() -> Iterator["Browser"]:
    """Run a browser; raises `NoBrowser`."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise NoBrowser(f"Playwright is not installed ({error}): make install") from error
    executable = shutil.which("chromium")
    if executable is None:
        raise NoBrowser("chromium is not installed: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=list(_FLAGS))
        yield browser
        browser.close()


class Watched:
    """The console in a page, and what went wrong in it."""

    def __init__(self, browser: "Browser", url: str, *, theme: Theme = "dark", size: tuple[int, int] = (1280, 800)):
        self._context = browser.new_context(
            viewport={"width": size[0], "height": size[1]}, color_scheme=theme, reduced_motion="reduce"
        )
        self._context.set_default_timeout(PATIENCE_MS)
        self.page: Page = self._context.new_page()
        self.complaints: list[str] = []
        self.hosts: set[str] = set()
        self.page.on("console", lambda said: self._note(said.type, said.text))
        self.page.on("pageerror", lambda error: self._note("error", str(error)))
        self.page.on("request", lambda request: self.hosts.add(request.url.split("/")[2]))
        self.page.goto(url)

    def close(self) -> None:
        """Close the page."""
        self._context.close()

    def live(self) -> None:
        """Wait until the stream is live."""
        self.page.wait_for_selector('#link[data-state="live"]')

    def run(self, script: str, argument: object = None) -> Any:
        """Run a function of JavaScript in the page and return what it returns; it may import the console's modules."""
        return self.page.evaluate(script, argument)

    def pixels(self) -> npt.NDArray[np.int64]:
        """Return what the map shows right of its cards, rows of red, green and blue."""
        # Name tags are coloured too.
        self.run("() => document.getElementById('tags').style.visibility = 'hidden'")
        picture = np.asarray(Image.open(BytesIO(self.page.locator("#map").screenshot())).convert("RGB"))
        self.run("() => document.getElementById('tags').style.visibility = ''")
        return picture[10:-60, 230:-70].astype(np.int64)

    def until(self, colour: Callable[[npt.NDArray[np.int64]], int], is_enough: Callable[[int], bool]) -> int:
        """Wait until the map shows enough of a colour and stands still, and return in how many pixels."""
        before, give_up = -1, time.monotonic() + PATIENCE_MS / 1000
        while True:
            number = colour(self.pixels())
            # Aircraft move on a little.
            if is_enough(number) and abs(number - before) <= 0.05 * number:
                return number
            assert time.monotonic() < give_up, f"{colour.__name__}: {number} pixels"
            before = number

    def _note(self, kind: str, text: str) -> None:
        if kind in ("error", "warning"):
            self.complaints.append(f"{kind}: {text}")


def yellow(pixels: npt.NDArray[np.int64]) -> int:
    """Return how many pixels are of the yellow of deviations, pure or seen through."""
    red, green, blue = np.moveaxis(pixels, -1, 0)
    return int(((red - blue > 50) & (green - blue > 40)).sum())


def vermilion(pixels: npt.NDArray[np.int64]) -> int:
    """Return how many pixels are of the red of conflicts, pure or seen through."""
    red, green, blue = np.moveaxis(pixels, -1, 0)
    return int(((red - green > 50) & (red - blue > 50)).sum())
