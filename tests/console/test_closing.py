"""Ops close airspace from the console, see whom that moved, and open it again."""

import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from app.times import format_time
from tests.cli.serving import AIRMATRIX, environment
from tests.console.browser import Watched
from tests.console.quarter import GRID, SLOW, Quarter, quarter

pytestmark = pytest.mark.compiled

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Request


def lines(*corners: tuple[float, float]) -> str:
    """Return corners of the grid, in block sides from its south-west corner, as they are typed."""
    lon, lat = GRID.unproject(
        [GRID.origin_x_m + 20 * i for i, _ in corners], [GRID.origin_y_m + 20 * j for _, j in corners]
    )
    return "\n".join(f"{x:.7f}, {y:.7f}" for x, y in zip(lon.tolist(), lat.tolist(), strict=True))


def drawn(console: Watched) -> list[str]:
    """Return the corners that are in the form."""
    return console.page.input_value("#closing-corners").split("\n")[:-1]


def sent(console: Watched) -> list[Any]:
    """Return the bodies that are posted from now on."""
    bodies: list[Any] = []

    def note(request: "Request") -> None:
        if request.method == "POST":
            bodies.append(request.post_data_json)

    console.page.on("request", note)
    return bodies


def test_an_area_is_drawn_corner_by_corner_and_closed(console: Watched, served: Quarter) -> None:
    page, map_, bodies = console.page, console.page.locator("#map"), sent(console)
    page.keyboard.press("c")
    page.keyboard.type("Drawn")
    page.click("#closing-draw")
    assert page.locator("#closing-draw").is_disabled()
    for count, (x, y) in enumerate([(400, 300), (520, 300), (700, 560)], 1):
        map_.click(position={"x": x, "y": y})
        page.locator("#picking", has_text=f"{count} corner").wait_for()
    page.keyboard.press("Backspace")
    page.locator("#picking", has_text="2 corners.").wait_for()
    # The first click of two sets the corner, the second ends the outline: it neither adds a corner nor zooms.
    map_.click(position={"x": 520, "y": 420})
    scale = page.locator(".maplibregl-ctrl-scale").inner_text()
    map_.dblclick(position={"x": 400, "y": 420})
    page.locator("#picking").wait_for(state="hidden")
    page.wait_for_timeout(500)
    corners = drawn(console)
    assert len(corners) == 4
    assert page.locator(".maplibregl-ctrl-scale").inner_text() == scale
    page.locator("#closing-size", has_text="4 corners, ").wait_for()

    # Nothing of it is kept that is drawn before Esc.
    page.click("#closing-draw")
    map_.click(position={"x": 600, "y": 500})
    page.locator("#picking", has_text="5 corners.").wait_for()
    page.keyboard.press("Escape")
    page.locator("#picking").wait_for(state="hidden")
    assert drawn(console) == corners

    page.fill("#closing-top", "50")
    page.locator("#closing-layers", has_text="Closes whole blocks: 0–80 m.").wait_for()
    page.fill("#closing-until", "+30")
    page.click("#closing-submit")
    page.locator("#closing-outcome strong", has_text="Drawn: closed").wait_for()
    [body] = bodies
    [ring] = body["polygon"]["coordinates"]
    assert [f"{lon:.6f}, {lat:.6f}" for lon, lat in ring] == [*corners, corners[0]]
    assert (body["base_m"], body["top_m"], body["from"]) == (0, 50, None)
    assert body["until"].startswith("2026-11-22T08:3")
    assert console.complaints == []

    page.get_by_role("button", name="Reopen Drawn").click()
    page.click("#reopen-keep")
    assert [each["name"] for each in served.get("/v1/constraints")["items"]] == ["Drawn"]
    page.get_by_role("button", name="Reopen Drawn").click()
    page.get_by_role("dialog", name="Reopen Drawn?").get_by_role("button", name="Reopen").click()
    page.locator("#closing-outcome strong", has_text="Drawn: open again").wait_for()
    page.locator("#closures-none").wait_for()
    assert served.get("/v1/constraints")["items"] == []


def test_whom_it_moved_is_told_and_named(browser: "Browser", tmp_path: Path) -> None:
    with quarter(tmp_path, **SLOW) as served:
        later = format_time(served.now_ms() + 600_000)
        stays = served.fly((0, 1, 0), (10, 1, 0), reference="STAYS")
        moves = served.fly((0, 2, 1), (10, 2, 1), reference="MOVES", earliest_departure=later)
        lands = served.fly((0, 0, 2), (5, 0, 2), reference="LANDS", earliest_departure=later)
        console = Watched(browser, served.url, theme="light")
        console.live()
        page = console.page
        page.locator("#flights-count", has_text="1").wait_for()
        # By keyboard alone.
        page.keyboard.press("5")
        page.keyboard.press("Enter")
        page.keyboard.type("Parade")
        for _ in range(2):
            page.keyboard.press("Tab")
        page.keyboard.type(lines((4, 0), (7, 0), (7, 4), (4, 4)))
        page.keyboard.press("Tab")
        while page.evaluate("document.activeElement.id") != "closing-submit":
            page.keyboard.press("Tab")
        page.keyboard.press("Enter")
        outcome = page.locator("#closing-outcome")
        outcome.locator("strong", has_text="Parade: closed").wait_for()
        kinds = {
            kind: outcome.locator(f'[data-kind="{kind}"]').inner_text().replace("\n", " ")
            for kind in ("unmoved", "gone", "moved")
        }
        assert kinds["unmoved"].split(" it ") == ["1 flight can no longer move and will fly through", "STAYS"]
        assert kinds["gone"].startswith(f"1 flight displaced: no plan is left #{lands['sequence']} ")
        assert "Within the departure window" in kinds["gone"]
        assert kinds["moved"].startswith(f"1 flight made way #{moves['sequence']} arrives ")
        assert page.evaluate("document.activeElement.id") == "closing-outcome"
        outcome.get_by_role("button", name="STAYS").click()
        page.get_by_role("heading", name="STAYS").wait_for()
        assert stays["state"] == "accepted"
        assert console.complaints == []
        console.close()


@pytest.mark.parametrize(
    ("field", "text", "said"),
    [
        ("closing-name", " ", "Give the closed airspace a name."),
        ("closing-corners", "71.1, 51.1\n71.2, 51.1", "at least three corners"),
        ("closing-corners", "71.1, 51.1\n71.2; fifty", "Line 2 of the corners is not"),
        ("closing-base", "", "Say from which altitude"),
        ("closing-top", "-5", "The area must end above where it begins."),
        ("closing-until", "tomorrow", "“tomorrow” is not a time."),
        ("closing-until", "2026-11-22 07:00", "It must open later than it closes"),
    ],
)
def test_what_is_not_right_is_said_and_not_sent(console: Watched, field: str, text: str, said: str) -> None:
    page, bodies = console.page, sent(console)
    page.keyboard.press("c")
    page.fill("#closing-name", "Never")
    page.fill("#closing-corners", lines((4, 4), (6, 4), (6, 6)))
    page.fill(f"#{field}", text)
    page.click("#closing-submit")
    page.locator("#closing-outcome", has_text=said).wait_for()
    assert page.locator(f'#{field}[aria-invalid="true"]:focus').count() == 1
    assert bodies == []


def test_an_altitude_that_is_no_number_is_not_taken_for_no_top(console: Watched) -> None:
    page, bodies = console.page, sent(console)
    page.keyboard.press("c")
    page.fill("#closing-name", "Never")
    page.fill("#closing-corners", lines((4, 4), (6, 4), (6, 6)))
    page.focus("#closing-top")
    page.keyboard.type("5e")
    page.click("#closing-submit")
    page.locator("#closing-outcome", has_text="no number of metres").wait_for()
    assert bodies == []


def test_an_outline_that_crosses_itself_is_not_sent(console: Watched) -> None:
    page, bodies = console.page, sent(console)
    page.keyboard.press("c")
    page.fill("#closing-name", "Never")
    page.fill("#closing-corners", lines((4, 4), (6, 6), (6, 4), (4, 6)))
    page.click("#closing-submit")
    page.locator("#closing-outcome", has_text="The outline crosses itself.").wait_for()
    assert bodies == []


def test_a_time_is_written_out_when_it_is_typed(console: Watched) -> None:
    page = console.page
    page.keyboard.press("c")
    page.fill("#closing-from", "7:30")
    page.fill("#closing-until", "7:15")
    page.keyboard.press("Tab")
    # Both have passed today, and it opens after it closes.
    assert page.input_value("#closing-from") == "2026-11-23 07:30"
    assert page.input_value("#closing-until") == "2026-11-24 07:15"
    page.locator("#closing-times", has_text="Closes 23 Nov 2026, 07:30:00 UTC, in 23 h").wait_for()


def test_a_problem_is_shown_and_the_form_kept(console: Watched) -> None:
    page = console.page
    page.keyboard.press("c")
    page.fill("#closing-name", "Elsewhere")
    page.fill("#closing-corners", "10, 20\n10.1, 20\n10.1, 20.1")
    page.click("#closing-submit")
    outcome = page.locator("#closing-outcome")
    outcome.locator("strong", has_text="Not a volume of this airspace").wait_for()
    assert page.input_value("#closing-name") == "Elsewhere"
    assert page.locator("#closing-submit").is_enabled()
    # A refused request is an error to the browser, and the only one.
    assert [complaint for complaint in console.complaints if "422" not in complaint] == []


def test_a_token_that_may_not_close_airspace_is_told_so(browser: "Browser", tmp_path: Path) -> None:
    def run(*options: str | Path) -> str:
        command = [AIRMATRIX, "token", *options]
        made = subprocess.run(command, env=environment(), check=True, capture_output=True, text=True)
        return made.stdout.strip()

    run("--init", tmp_path)
    watching = ("--key", tmp_path / "private.pem", "--operator", "ops", "--scope", "airmatrix.monitor")
    with quarter(tmp_path, AIRMATRIX_JWKS=str(tmp_path / "jwks.json")) as served:
        for scopes, may in (((), False), (("--scope", "airmatrix.admin"), True)):
            console = Watched(browser, served.url)
            page = console.page
            page.fill("#session-token", run(*watching, *scopes))
            page.press("#session-token", "Enter")
            console.live()
            page.keyboard.press("c")
            access = page.locator("#closing-access", has_text="Your token lacks the scope airmatrix.admin")
            access.wait_for(state="hidden" if may else "visible")
            page.fill("#closing-name", "Parade")
            page.fill("#closing-corners", lines((4, 4), (6, 4), (6, 6)))
            page.click("#closing-submit")
            told = "Parade: closed" if may else "Your token does not allow this."
            page.locator("#closing-outcome", has_text=told).wait_for()
            console.close()


@pytest.mark.parametrize("size", [(1280, 720), (1024, 768), (700, 900)])
def test_the_form_is_not_cut_off(browser: "Browser", served: Quarter, size: tuple[int, int]) -> None:
    console = Watched(browser, served.url, theme="light", size=size)
    console.live()
    console.page.keyboard.press("c")
    cut = console.run(
        """() => [...document.querySelectorAll(".tabs, .tabs > *, .panel, #airspace, #closing, #closing *")]
            .filter((node) => node.offsetParent && node.scrollWidth > node.clientWidth + 1 && node.clientWidth > 0)
            .map((node) => node.id || node.className)"""
    )
    assert cut == []
    assert console.run("() => document.documentElement.scrollWidth <= innerWidth")
    unnamed = console.run(
        """() => [...document.querySelectorAll("#airspace input, #airspace textarea")]
            .filter((field) => field.labels.length === 0).map((field) => field.id)"""
    )
    assert unnamed == []
    console.close()


def test_corners_are_read_as_people_write_them(modules: Watched) -> None:
    read = modules.run(
        """async (texts) => {
            const { readCorners } = await import("/console/area.js");
            return texts.map((text) => readCorners(text));
        }""",
        ["", "1, 2\n\n 3 4 \n-5;6.5\n", "1,2\n3,4\n5,6\n1,2", "1,2\n3", "1,2\n3,4,5", "1,2\n1,91", "x,1"],
    )
    assert [each["corners"] for each in read[:3]] == [
        [], [[1, 2], [3, 4], [-5, 6.5]], [[1, 2], [3, 4], [5, 6]],
    ]  # fmt: skip
    assert [each["wrong"] and each["wrong"][:6] for each in read] == [
        None, None, None, "Line 2", "Line 2", "Line 2", "Line 1",
    ]  # fmt: skip


def test_an_area_is_measured(modules: Watched) -> None:
    text = lines((1, 1), (6, 1), (6, 3), (1, 3))
    size = modules.run(
        """async (text) => {
            const { readCorners, sizeOf } = await import("/console/area.js");
            return sizeOf(readCorners(text).corners);
        }""",
        text,
    )
    # The grid is turned a little against the meridian.
    assert size["hectares"] == pytest.approx(0.4, rel=0.01)
    assert (size["east"], size["north"]) == pytest.approx((100, 40), rel=0.15)


def test_times_are_read_as_people_write_them(modules: Watched) -> None:
    texts = [
        "2026-11-22 10:00", "2026-11-22T10:00:30Z", "9:05", "08:00", "07:59", "+30", "+ 5 min",
        "2026-02-30 10:00", "24:00", "10", "10:60", "soon",
    ]  # fmt: skip
    read = modules.run(
        """async (texts) => {
            const { readTime } = await import("/console/time.js");
            const after = Date.parse("2026-11-22T08:00:20Z");
            return texts.map((text) => readTime(text, after)).map((ms) => ms && new Date(ms).toISOString());
        }""",
        texts,
    )
    assert [each and each[5:19] for each in read] == [
        "11-22T10:00:00", "11-22T10:00:30", "11-22T09:05:00", "11-23T08:00:00", "11-23T07:59:00",
        "11-22T08:31:00", "11-22T08:06:00", None, None, None, None, None,
    ]  # fmt: skip
