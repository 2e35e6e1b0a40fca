"""The console in a real browser: what it shows, and what can be done with it."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from app.times import format_time
from tests.console.browser import Watched, yellow
from tests.console.quarter import ATTRIBUTION, SLOW, Quarter, quarter

pytestmark = pytest.mark.compiled

if TYPE_CHECKING:
    from playwright.sync_api import Browser


def test_the_console_loads_without_complaint_and_from_this_server_alone(console: Watched, served: Quarter) -> None:
    page = console.page
    page.wait_for_timeout(1500)
    assert page.title() == "The Quarter · AirMatrix"
    assert page.locator("#simulated").inner_text() == "simulated clock ×0.1"
    assert re.fullmatch(r"08:0\d:\d\d", page.locator("#clock-time").inner_text())
    assert console.complaints == []
    assert console.hosts == {served.url.removeprefix("http://")}


def test_the_attribution_is_shown_as_text(console: Watched) -> None:
    assert ATTRIBUTION in console.page.locator("#attribution").inner_text()
    assert console.page.locator(".attribution a").inner_text() == "MapLibre"


def test_what_operators_write_is_text(console: Watched, served: Quarter) -> None:
    wicked = '<img src="/nowhere" onerror="document.title=1">'
    served.fly((0, 0, 2), (10, 0, 2), reference=wicked)
    console.page.click("#tab-flights")
    row = console.page.locator("#flights-list button", has_text="onerror")
    row.wait_for()
    assert row.locator("strong").inner_text() == wicked
    row.click()
    console.page.get_by_role("heading", name=wicked).wait_for()
    console.page.locator("#details tbody button").first.click()
    console.page.locator("#details td button", has_text=wicked).first.wait_for()
    assert console.page.locator("main img, aside img").count() == 0


def test_a_flight_is_planned_between_two_clicks(console: Watched, served: Quarter) -> None:
    page = console.page
    page.keyboard.press("4")
    page.select_option("#origin-layer", "2")
    page.select_option("#destination-layer", "2")
    page.fill("#new-reference", "BY-CLICK")
    page.click("#pick-origin")
    map_ = page.locator("#map")
    map_.click(position={"x": 380, "y": 330})
    page.locator("#origin-place", has_text="block [").wait_for()
    # The destination is next by itself; who presses its button all the same wants to choose it, too.
    page.click("#pick-destination")
    map_.click(position={"x": 600, "y": 480})
    page.locator("#destination-place", has_text="block [").wait_for()
    page.click("#new-submit")
    page.locator("#new-outcome strong", has_text="Accepted as #").wait_for()

    [intent] = [
        each for each in served.get("/v1/flight-intents", limit=100)["items"] if each["reference"] == "BY-CLICK"
    ]
    for end in ("origin", "destination"):
        assert page.locator(f"#{end}-place").inner_text().startswith(f"block {intent[end]['block']}")
    page.get_by_role("button", name="Show the flight").click()
    page.get_by_role("heading", name="BY-CLICK").wait_for()
    assert page.locator("#details tbody tr").count() == min(60, len(intent["reservations"]))
    page.keyboard.press("2")
    page.locator("#flights-list strong", has_text="BY-CLICK").wait_for()


def test_a_refusal_is_explained_and_a_way_out_offered(console: Watched, served: Quarter) -> None:
    page = console.page
    served.report((5, 5, 2), track_id="over-the-tower")
    page.locator("#alerts-list button", has_text="over-the-tower").click()
    page.keyboard.press("4")
    page.select_option("#destination-layer", "2")
    page.click("#pick-origin")
    # The keyboard takes the centre of the map, which is over the tower now; then a click.
    page.locator("#map canvas.maplibregl-canvas").focus()
    page.keyboard.press("Enter")
    page.locator("#origin-place", has_text="block [5, 5, 0]").wait_for()
    page.locator("#map").click(position={"x": 560, "y": 560})
    page.click("#new-submit")
    outcome = page.locator("#new-outcome")
    outcome.get_by_text("A building stands in the origin's block.").wait_for()
    outcome.get_by_role("button", name="Use the nearest free block").click()
    page.click("#new-preview")
    outcome.get_by_text("preview, nothing reserved").wait_for()
    # A refused request is an error to the browser, and the only one.
    assert [complaint for complaint in console.complaints if "422" not in complaint] == []


def test_the_timeline_shows_the_future_and_returns(console: Watched, served: Quarter) -> None:
    page, count = console.page, console.page.locator("#count-flights b")
    served.fly((0, 10, 1), (10, 10, 1), earliest_departure=format_time(served.now_ms() + 55_000))
    page.keyboard.press("]")
    page.locator("#moment-text", has_text="in 1 min 00 s, as reserved").wait_for()
    count.filter(has_text=re.compile(r"^[1-9]")).wait_for()
    assert page.locator("#live").get_attribute("aria-pressed") == "false"
    for _ in range(9):
        page.keyboard.press("]")
    count.filter(has_text=re.compile(r"^0$")).wait_for()
    assert page.locator("#count-green b").inner_text() == "0"
    page.keyboard.press("l")
    page.locator("#moment-text", has_text="Showing the present").wait_for()


def test_the_heat_map_says_what_its_colours_mean(console: Watched, served: Quarter) -> None:
    served.fly((0, 9, 1), (10, 9, 1))
    console.page.keyboard.press("h")
    console.page.locator("#heat-most", has_text=re.compile(r"^[1-9]\d* s$")).wait_for()


def test_everything_is_reached_by_keyboard(console: Watched) -> None:
    page = console.page
    page.keyboard.press("?")
    page.get_by_role("dialog").wait_for()
    page.keyboard.press("Escape")
    assert page.get_by_role("dialog").count() == 0
    page.keyboard.press("1")
    page.locator("#tab-alerts").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    assert page.locator("#tab-flights").get_attribute("aria-selected") == "true"
    page.keyboard.press("/")
    page.keyboard.type("l4?")
    assert page.locator("#flights-search").input_value() == "l4?"
    page.locator("#live").focus()
    reached = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.add(console.run("() => document.activeElement.id || document.activeElement.className"))
    assert {"theme", "help", "earlier", "moment", "later", "heat", "maplibregl-canvas", "tab-flights"} <= reached


@pytest.mark.parametrize("size", [(1440, 900), (1024, 768)], ids=["laptop", "tablet"])
def test_nothing_is_cut_off(browser: "Browser", served: Quarter, size: tuple[int, int]) -> None:
    watched = Watched(browser, served.url, theme="light", size=size)
    watched.live()
    for tab in ("alerts", "flights", "details", "new"):
        watched.page.click(f"#tab-{tab}")
        cut = watched.run(
            """() => [...document.querySelectorAll("header > *, .tabs, .tabs > *, .timeline > *, .panel, footer > *")]
                .filter((node) => node.offsetParent && node.scrollWidth > node.clientWidth + 1 && node.clientWidth > 0)
                .map((node) => node.id || node.className)"""
        )
        assert cut == []
    assert watched.run("() => document.documentElement.dataset.theme") == "light"
    assert watched.run("() => document.documentElement.scrollHeight <= innerHeight")
    watched.close()


def test_a_graphics_context_that_is_lost_comes_back(browser: "Browser", tmp_path: Path) -> None:
    # Of its own: flights of other tests become yellow meanwhile, in what lies over the map too.
    with quarter(tmp_path, **SLOW) as served:
        console = Watched(browser, served.url)
        console.live()
        served.report((2, 9, 2), track_id="lasting")
        console.page.locator("#alerts-list button", has_text="lasting").wait_for()
        before = console.until(yellow, lambda number: number > 0)
        console.run(
            """() => {
                globalThis.context = document.querySelector("canvas.scene").getContext("webgl2")
                    .getExtension("WEBGL_lose_context");
                context.loseContext();
            }"""
        )
        console.until(yellow, lambda number: number < before / 2)
        console.run("() => context.restoreContext()")
        console.until(yellow, lambda number: number == pytest.approx(before, rel=0.2))
        assert console.complaints == []
        console.close()
