"""Closed airspace in the console: on the map and in the list, as it comes and goes."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from app.times import format_time
from tests.console.browser import Watched, vermilion
from tests.console.quarter import GRID, SLOW, Quarter, quarter

pytestmark = pytest.mark.compiled

if TYPE_CHECKING:
    from playwright.sync_api import Browser

WEST, SOUTH, EAST, NORTH = 1, 7, 4, 10


@contextmanager
def closed(served: Quarter, **members: Any) -> Iterator[None]:
    """Close a corner of the quarter for a while."""
    corners = [(WEST, SOUTH), (EAST, SOUTH), (EAST, NORTH), (WEST, NORTH), (WEST, SOUTH)]
    lon, lat = GRID.unproject(
        [GRID.origin_x_m + 20 * i for i, _ in corners], [GRID.origin_y_m + 20 * j for _, j in corners]
    )
    ring = [list(vertex) for vertex in zip(lon.tolist(), lat.tolist(), strict=True)]
    polygon = {"type": "Polygon", "coordinates": [ring]}
    made = served.post("/v1/constraints", {"name": "<b>Parade</b>", "polygon": polygon, "top_m": 80, **members})
    try:
        yield
    finally:
        served.delete(f"/v1/constraints/{made['id']}")


def test_closed_airspace_comes_and_goes_on_the_map_and_in_the_list(browser: "Browser", tmp_path: Path) -> None:
    # Of its own: what flies for other tests is red in closed airspace too.
    with quarter(tmp_path, **SLOW) as served:
        console = Watched(browser, served.url)
        console.live()
        page = console.page
        before = console.until(vermilion, lambda _: True)
        with closed(served):
            item = page.locator("#constraints-list button", has_text="<b>Parade</b>")
            item.wait_for()
            assert item.locator("span").inner_text() == "0–80 m, for good"
            console.until(vermilion, lambda number: number > before + 1000)
            assert page.locator("#latest").inner_text().startswith("airspace closed at 08:0")
            item.click()
            page.locator("#map canvas.maplibregl-canvas").hover()
            page.locator('canvas[title="<b>Parade</b>"]').wait_for()
            page.locator("#map canvas.maplibregl-canvas").click()
            page.locator("#details .hint", has_text="Closed: <b>Parade</b>.").wait_for()
        item.wait_for(state="detached")
        page.locator("#latest", has_text="closed airspace opened at 08:0").wait_for()
        console.until(vermilion, lambda number: number < before + 200)
        assert console.complaints == []
        console.close()


def test_what_closes_later_is_listed_and_shown_where_the_timeline_is_then(console: Watched, served: Quarter) -> None:
    page, now_ms = console.page, served.now_ms()
    times = {"from": format_time(now_ms + 90_000), "until": format_time(now_ms + 600_000)}
    with closed(served, **times):
        page.locator('#constraints-list [data-in-force="false"]', has_text="closes in 1 min").wait_for()
        page.keyboard.press("]")
        page.locator("#moment-text", has_text="in 1 min 00 s").wait_for()
        page.locator("#constraints").wait_for(state="hidden")
        page.keyboard.press("]")
        page.locator('#constraints-list [data-in-force="true"]', has_text="until 08:").wait_for()
