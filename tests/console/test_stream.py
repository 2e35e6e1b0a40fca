"""The event stream is lost and comes back: the console says so, and shows what is true then."""

import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.cli.serving import started
from tests.console.browser import PATIENCE_MS, Watched
from tests.console.quarter import quarter

pytestmark = pytest.mark.compiled

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Request

# The service starts meanwhile, and the console waits up to eight seconds between its attempts.
_RETURN_MS = 3 * PATIENCE_MS


def missed_from(request: "Request") -> list[str | None]:
    """Return after what a request takes the stream up again; nothing for requests of something else."""
    return [request.headers.get("last-event-id")] if request.url.endswith("/v1/airspace/stream") else []


def test_loss_and_return_of_the_stream_are_shown(browser: "Browser", tmp_path: Path) -> None:
    with quarter(tmp_path) as served:
        served.fly((0, 2, 0), (10, 2, 0), reference="STAYS")
        console = Watched(browser, served.url)
        page = console.page
        console.live()
        page.click("#tab-flights")
        page.locator("#flights-list strong", has_text="STAYS").wait_for()
        assert page.locator("#stale").is_hidden()
        served_revision = served.get("/v1/events")["items"][-1]["revision"]
        port = served.url.rpartition(":")[2]
        served.server.stop(signal.SIGTERM)

        page.wait_for_selector('#link[data-state="reconnecting"]')
        page.locator("#stale", has_text="Stale since").wait_for()
        assert "connecting again" in page.locator("#stale").inner_text()
        # What was known last is still there.
        assert page.locator("#flights-list strong", has_text="STAYS").count() == 1

        asked: list[str | None] = []
        page.on("request", lambda request: asked.extend(missed_from(request)))
        airspace = str(tmp_path / "quarter.geojson")
        with started(tmp_path, "--port", port, "--airspace", airspace, log="again.log"):
            page.wait_for_selector('#link[data-state="live"]', timeout=_RETURN_MS)
            page.locator("#stale").wait_for(state="hidden")
            # It asks for what it has missed.
            assert asked
            assert asked[-1] == str(served_revision)
            served.fly((0, 9, 0), (10, 9, 0), reference="COMES")
            page.locator("#flights-list strong", has_text="COMES").wait_for()
        console.close()
