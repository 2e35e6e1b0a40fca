"""The console's pure parts, run where they live: in a browser."""

from typing import Any

import pytest

from tests.console.browser import Watched
from tests.console.quarter import GRID, Quarter, place

pytestmark = pytest.mark.compiled


@pytest.mark.parametrize("size", [1, 2, 3, 7, 1000])
def test_events_are_read_however_the_stream_is_cut(modules: Watched, size: int) -> None:
    text = (
        ": hello\n\nevent: status\ndata: {\"a\":\ndata: 1}\n\nid: 7\nevent: intent\ndata: x\r\n\r\n"
        "data:bare\rid: 8\r\rid: 9\ndata\n\ndata: one\r\ndata: two\r\n\r\nevent: unfinished\ndata: never\n"
    )  # fmt: skip
    parts = [text[start : start + size] for start in range(0, len(text), size)]
    read = modules.run(
        """async (parts) => {
            const { EventParser } = await import("/console/sse.js");
            const parser = new EventParser();
            const events = parts.flatMap((part) => parser.feed(part));
            return { events, lastId: parser.lastId };
        }""",
        parts,
    )
    assert read == {
        "events": [
            {"event": "status", "data": '{"a":\n1}'},
            {"event": "intent", "data": "x"},
            {"event": "message", "data": "bare"},
            {"event": "message", "data": ""},
            {"event": "message", "data": "one\ntwo"},
        ],
        "lastId": "9",
    }


def test_attempts_wait_longer_and_longer_but_not_for_ever(modules: Watched) -> None:
    waits = modules.run(
        """async () => {
            const { waitMs } = await import("/console/stream.js");
            return [1, 2, 3, 5, 50].map((failures) => [waitMs(failures, 0), waitMs(failures, 1)]);
        }"""
    )
    assert waits == [[250, 500], [500, 1000], [1000, 2000], [4000, 8000], [4000, 8000]]


def test_blocks_lie_where_the_service_says(modules: Watched, served: Quarter) -> None:
    blocks = [(0, 0, 0), (10, 0, 0), (3, 7, 1), (10, 10, 2)]
    found = modules.run(
        """async ([airspace, blocks]) => {
            const { Grid } = await import("/console/grid.js");
            const grid = new Grid(airspace);
            return blocks.map((block) => [grid.centre(block), grid.ring(block)]);
        }""",
        [served.get("/v1/airspace"), blocks],
    )
    for block, (centre, ring) in zip(blocks, found, strict=True):
        lon, lat, alt_m = place(block)
        assert (centre["lon"], centre["lat"], centre["alt_m"]) == pytest.approx((lon, lat, alt_m), abs=1e-8)
        i, j, _ = block
        x, y = GRID.project([corner[0] for corner in ring], [corner[1] for corner in ring])
        east = [(each - GRID.origin_x_m) / 20 for each in x]
        north = [(each - GRID.origin_y_m) / 20 for each in y]
        assert east == pytest.approx([i, i + 1, i + 1, i, i], abs=1e-4)
        assert north == pytest.approx([j, j, j + 1, j + 1, j], abs=1e-4)


def test_a_position_is_in_its_block_or_in_none(modules: Watched, served: Quarter) -> None:
    inside = [place((i, j, 0))[:2] for i, j in ((0, 0), (10, 0), (4, 9))]
    west, _, _, north = served.get("/v1/airspace")["bounds"]
    found = modules.run(
        """async ([airspace, positions]) => {
            const { Grid } = await import("/console/grid.js");
            const grid = new Grid(airspace);
            return positions.map(([lon, lat]) => grid.blockAt(lon, lat, 1));
        }""",
        [served.get("/v1/airspace"), [*inside, (west - 0.001, north)]],
    )
    assert found == [[0, 0, 1], [10, 0, 1], [4, 9, 1], None]


def test_times_are_said_in_words(modules: Watched) -> None:
    said = modules.run(
        """async () => {
            const { clockTime, date, relative, span } = await import("/console/time.js");
            const noon = Date.parse("2026-11-22T12:05:09.900Z");
            return [clockTime(noon), date(noon), span(9.4), span(185), span(7500),
                relative(noon, noon), relative(noon - 12000, noon), relative(noon + 61000, noon)];
        }"""
    )
    assert said == [
        "12:05:09", "22 Nov 2026", "9 s", "3 min 05 s", "2 h 05 min", "now", "12 s ago", "in 1 min 01 s",
    ]  # fmt: skip


def picture(modules: Watched, steps: str) -> Any:
    """Return what `show()` noted while these steps were taken with a picture of the airspace."""
    return modules.run(
        """async () => {
            const { Picture } = await import("/console/picture.js");
            let at = 0;
            const picture = new Picture(() => at);
            const clock = { now: "2026-11-22T08:00:00.000Z", rate: 4, simulated: true };
            const entry = (i, status) => ({ block: [i, 0, 0], status });
            const status = (full, blocks, idle = []) =>
                picture.take("status", { clock, full, counts: {}, blocks, idle });
            const wait = (ms) => { at += ms; };
            const log = [];
            const words = () => [...picture.blocks].map(([key, { status }]) => `${key} ${status}`);
            const show = () => log.push([words(), picture.state]);
            STEPS
            return log;
        }""".replace("STEPS", steps)
    )


def test_differences_change_the_picture_that_a_full_status_began(modules: Watched) -> None:
    seen = picture(
        modules,
        """
        picture.opened(); status(false, [entry(9, "red")]); show();
        status(true, [entry(1, "green"), entry(2, "green")]); show();
        status(false, [entry(2, "yellow"), entry(3, "red")], [[1, 0, 0]]); show();
        """,
    )
    assert seen == [
        [[], "connecting"],
        [["1/0/0 green", "2/0/0 green"], "live"],
        [["2/0/0 yellow", "3/0/0 red"], "live"],
    ]


def test_after_a_loss_the_first_full_status_replaces_the_picture(modules: Watched) -> None:
    seen = picture(
        modules,
        """
        picture.opened(); status(true, [entry(1, "green")]); picture.lost(); show();
        picture.opened(); status(false, [entry(2, "red")]); show();
        status(true, [entry(3, "green")]); show();
        """,
    )
    assert seen == [
        [["1/0/0 green"], "reconnecting"],
        [["1/0/0 green"], "live"],
        [["3/0/0 green"], "live"],
    ]


def test_a_silent_stream_is_stale_and_its_clock_stands_still(modules: Watched) -> None:
    seen = picture(
        modules,
        """
        picture.opened(); status(true, []); wait(3000); show(); log.push(picture.now);
        wait(2000); show(); log.push(picture.now); wait(60000); log.push(picture.now, picture.silentSeconds);
        """,
    )
    start = 1_795_334_400_000
    assert seen == [[[], "live"], start + 12_000, [[], "stale"], start + 14_000, start + 14_000, 65]


_MOTION = """async (ticks) => {
    const { Motion } = await import("/console/motion.js");
    const motion = new Motion();
    const seen = [];
    for (const { at, lon, velocity = { east: 0, north: 0, up: 0 }, conformance = "conforming", look } of ticks) {
        motion.take([{ flight_intent_id: "x", conformance, velocity_mps: velocity,
            position: { lon, lat: 0, alt_m: 50, age_s: 0, airborne: true } }], at, 1);
        seen.push(look.map((when) => motion.positions(when)[0].lon));
    }
    return seen;
}"""


def test_aircraft_glide_from_tick_to_tick(modules: Watched) -> None:
    ticks = [{"at": 0, "lon": 0.0, "look": [0, 500]}, {"at": 1000, "lon": 0.001, "look": [1000, 1500, 2000, 9000]}]
    assert modules.run(_MOTION, ticks) == [[0, 0], [0, pytest.approx(0.0005), 0.001, 0.001]]


def test_aircraft_are_drawn_where_they_will_be_but_not_far_ahead(modules: Watched) -> None:
    degree_m = 111_320
    east = {"east": 10.0, "north": 0.0, "up": 0.0}
    [[moving]] = modules.run(_MOTION, [{"at": 0, "lon": 0.0, "velocity": east, "look": [1000]}])
    assert moving == pytest.approx(10 / degree_m)
    [[lost]] = modules.run(_MOTION, [{"at": 0, "lon": 0.0, "velocity": east, "conformance": "lost", "look": [1000]}])
    assert lost == 0


def test_flights_are_placed_by_plan_at_any_time(modules: Watched) -> None:
    def waypoint(lon: float, arrive_s: int, depart_s: int) -> dict[str, Any]:
        time = "2026-11-22T08:00:{:02d}.000Z"
        return {"lon": lon, "lat": 0, "alt_m": 20, "arrive": time.format(arrive_s), "depart": time.format(depart_s)}

    found = modules.run(
        """async ([trajectory, seconds]) => {
            const { plannedAt } = await import("/console/planned.js");
            const start = Date.parse("2026-11-22T08:00:00Z");
            return seconds.map((second) => plannedAt(trajectory, start + second * 1000)?.lon ?? null);
        }""",
        [[waypoint(0, 2, 4), waypoint(1, 6, 8), waypoint(3, 10, 10)], [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]],
    )
    assert found == [None, 0, 0, 0, 0.5, 1, 1, 1, 2, 3, None]


def test_the_scene_counts_in_metres_from_its_origin(modules: Watched) -> None:
    local = modules.run(
        """async () => {
            const { LocalFrame } = await import("/console/frame.js");
            const frame = new LocalFrame(71.4, 51.1);
            const there = { lon: 71.41, lat: 51.11, alt_m: 0 };
            return [frame.local({ lon: 71.4, lat: 51.1, alt_m: 33 }), frame.local(there)];
        }"""
    )
    assert local[0] == pytest.approx([0, 0, 33], abs=1e-6)
    assert local[1] == pytest.approx([699, 1112, 0], rel=0.005)


def test_the_journal_says_of_a_flight_that_was_planned_again_what_became_of_it(modules: Watched) -> None:
    cause = {"flight_intent_id": "x"}
    entries = [
        {"kind": kind, "sequence": 7, "track_id": None, "time": "2026-11-22T08:00:00.000Z", "details": details}
        for kind, details in [
            ("accepted", {}),
            ("accepted", {"cause": None, "arrival_moved_s": 4.0}),
            ("accepted", {"cause": cause, "arrival_moved_s": 4.26}),
            ("accepted", {"cause": cause, "arrival_moved_s": -1.0}),
            ("displaced", {"cause": cause, "arrival_moved_s": None}),
            ("unmoved", {"cause": {"constraint_id": "y"}}),
        ]
    ]
    told = modules.run(
        """async (entries) => {
            const { journalWords } = await import("/console/words.js");
            return entries.map(journalWords);
        }""",
        entries,
    )
    assert [words.removesuffix(" at 08:00:00 UTC") for words in told] == [
        "#7 accepted",
        "#7 changed",
        "#7 made way, arrives 4.3 s later",
        "#7 made way, arrives 1.0 s sooner",
        "#7 displaced",
        "#7 can no longer make way",
    ]
