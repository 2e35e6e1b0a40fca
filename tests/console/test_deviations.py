"""An aircraft leaves its track: the console shows where, how badly, and why."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.console.browser import PATIENCE_MS, Watched, vermilion, yellow
from tests.console.quarter import SLOW, quarter

pytestmark = pytest.mark.compiled

if TYPE_CHECKING:
    from playwright.sync_api import Browser

# Of a block that is near, more than its outline has; the rest of the map has none of these colours.
_MANY, _FEW = 3_000, 15


def test_a_deviation_turns_its_block_yellow_then_red(browser: "Browser", tmp_path: Path) -> None:
    with quarter(tmp_path, **SLOW) as served:
        stray = served.fly((0, 2, 0), (10, 2, 0), reference="STRAY")
        victim = served.fly((2, 8, 0), (10, 8, 0), reference="VICTIM")
        for intent, block in ((stray, (0, 2, 0)), (victim, (2, 8, 0))):
            served.activate(intent)
            served.report(block, flight_intent_id=intent["id"])
        console = Watched(browser, served.url)
        page = console.page
        console.live()
        page.locator("#count-green b").filter(has_not_text="0").wait_for()
        page.locator("#alerts-list", has_text="No alerts").wait_for()
        calm = console.pixels()
        assert (yellow(calm), vermilion(calm)) < (_FEW, _FEW)
        assert page.locator("#count-yellow b").inner_text() == "0"

        served.report((0, 5, 0), flight_intent_id=stray["id"])
        page.locator("#count-yellow b").filter(has_not_text="0").wait_for()
        console.until(yellow, lambda number: number > _MANY)
        assert vermilion(console.pixels()) < _FEW

        served.report((2, 8, 0), flight_intent_id=stray["id"])
        page.locator("#count-red b").filter(has_not_text="0").wait_for()
        console.until(vermilion, lambda number: number > _MANY)
        assert page.locator("#announcer").inner_text().startswith(("red alert", "2 new alerts"))

        # The alert leads there; a click on the block says why.
        page.locator('#alerts-list button[data-status="red"]', has_text="STRAY").click()
        page.get_by_role("heading", name="STRAY").wait_for()
        assert page.locator(".conformance").get_attribute("data-conformance") == "violating"
        page.wait_for_timeout(500)
        box = page.locator("#map").bounding_box()
        assert box is not None
        page.locator("#map").click(position={"x": box["width"] / 2, "y": box["height"] / 2})
        page.get_by_role("heading", name="Block [2, 8, 0]").wait_for()
        reasons = page.locator("#details .reasons")
        assert reasons.locator('[data-reason="several_aircraft"]').inner_text() == "several aircraft are here at once"
        assert reasons.locator('[data-reason="reserved_by_another"]').count() == 1
        page.locator("#details td", has_text="VICTIM").wait_for(timeout=PATIENCE_MS)
        page.locator("#details .users").get_by_role("button", name="STRAY").click()
        page.get_by_role("heading", name="STRAY").wait_for()
        assert console.complaints == []
        console.close()
