"""Fixtures: a browser, a quarter that is served once for all tests that leave it as it was, a console on it."""

import os
from collections.abc import Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest

from tests.console.browser import NoBrowser, Watched, chromium
from tests.console.quarter import SLOW, Quarter, quarter

if TYPE_CHECKING:
    from playwright.sync_api import Browser


# Not for the whole session: an event loop runs in this thread for as long as Playwright does.
@pytest.fixture(scope="package")
def browser() -> Iterator["Browser"]:
    """Return a browser; without one the test is skipped, but on CI it fails."""
    with ExitStack() as stack:
        try:
            running = stack.enter_context(chromium())
        except NoBrowser as error:
            if os.environ.get("CI") == "true":
                raise
            pytest.skip(str(error))
        yield running


@pytest.fixture(scope="package")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Quarter]:
    with quarter(tmp_path_factory.mktemp("quarter"), **SLOW) as running:
        yield running


@pytest.fixture
def console(browser: "Browser", served: Quarter) -> Iterator[Watched]:
    """Return the console, live."""
    watched = Watched(browser, served.url)
    watched.live()
    yield watched
    watched.close()


@pytest.fixture(scope="package")
def modules(browser: "Browser", served: Quarter) -> Iterator[Watched]:
    """Return a page that is next to nothing, in which the console's modules can be imported."""
    watched = Watched(browser, f"{served.url}/console/icon.svg")
    yield watched
    watched.close()
