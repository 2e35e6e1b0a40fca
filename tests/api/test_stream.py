"""The stream of the airspace: first everything, then what changes; whoever was away hears what was missed."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Engine, event
from sqlalchemy.exc import OperationalError

from app.main import create_app
from app.routes.stream import Board
from app.times import format_time
from tests.api.bodies import SUBMIT, TELEMETRY, position, problem, report
from tests.api.serving import Client, served, settings_for
from tests.api.streaming import STREAM, Event, streaming
from tests.api.test_telemetry import failing
from tests.api.watching import ALERTS, FLIGHTS, STATUS, activated, fly, look, see, submit
from tests.ledger.district import DEPARTURE_MS, LANES
from tests.ledger.locations import Ledgers, SqliteLedgers, on_sqlite
from tests.ledger.process import DAY_MS, FakeClock, until


@pytest.fixture
def ledgers(tmp_path: Path) -> Ledgers:
    """Keep to one kind of database: what is streamed is what the other routes answer, which both are asked for."""
    return SqliteLedgers(tmp_path)


@pytest.fixture
def lanes(ledger: str, tmp_path: Path, clock: FakeClock) -> Iterator[Client]:
    """Return a client of a service over two lanes that has looked once, when nobody was there."""
    with served(create_app(settings_for(LANES, ledger, tmp_path), clock, elapsed_ms=clock)) as client:
        look(client)
        yield client


def named(events: list[Event]) -> list[str | None]:
    return [each.name for each in events]


def of(name: str, events: list[Event]) -> Any:
    """Return the data of the one event with this name."""
    (data,) = [each.data for each in events if each.name == name]
    return data


def blocks(data: Any) -> list[list[int]]:
    return [entry["block"] for entry in data["blocks"]]


def test_the_answer_is_an_event_stream_that_nobody_keeps(lanes: Client) -> None:
    with streaming(lanes) as stream:
        stream.next()
        assert (stream.status, stream.headers["content-type"]) == (200, "text/event-stream; charset=utf-8")
        assert stream.headers["cache-control"] == "no-cache"


def test_it_begins_with_everything_that_the_other_routes_answer(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    see(lanes, "radar-1", 3.5, 1.5)
    look(lanes)
    with streaming(lanes) as stream:
        events = stream.news()
    assert named(events) == ["status", "flights", "alerts"]
    whole, *rest = events
    assert whole.data == {**lanes.get(STATUS).json(), "full": True}
    # Who loses the stream at once knows where to go on.
    assert (whole.id, [each.id for each in rest]) == (3, [None, None])
    assert {**of("flights", events), "items": []} == {**lanes.get(FLIGHTS).json(), "items": []}
    assert [item["track_id"] for item in of("flights", events)["items"]] == [None, "radar-1"]
    assert [item["track_id"] for item in of("alerts", events)["items"]] == ["radar-1"]


def test_then_it_sends_only_the_blocks_that_changed_and_those_that_are_idle_again(
    lanes: Client, clock: FakeClock
) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    see(lanes, "radar-1", 6.5, 1.5)
    look(lanes)
    with streaming(lanes) as stream:
        assert blocks(of("status", stream.news())) == [[6, 1, 0], [0, 2, 0], [1, 2, 0]]
        clock.advance(seconds=2)
        fly(lanes, flight)
        see(lanes, "radar-1", 6.6, 1.5)
        look(lanes)
        change = of("status", stream.news())
    assert (change["full"], blocks(change), change["idle"]) == (False, [[2, 2, 0]], [[0, 2, 0]])
    assert change["counts"] == {"green": 2, "yellow": 1, "red": 0}
    assert (change["at"], change["clock"]["now"]) == (format_time(DEPARTURE_MS + 2000),) * 2


def test_a_difference_to_the_whole_gives_the_next_whole(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    known: dict[tuple[int, ...], Any] = {}
    with streaming(lanes) as stream:
        stream.news()
        for seconds in range(14):
            clock.now_ms = DEPARTURE_MS + 1000 * seconds
            if seconds % 4 != 3:
                fly(lanes, flight)
            see(lanes, "radar-1", 7.5 - seconds / 2, 2.5)
            look(lanes)
            change = of("status", stream.news())
            known |= {tuple(entry["block"]): entry for entry in change["blocks"]}
            for block in change["idle"]:
                del known[tuple(block)]
            assert sorted(known) == sorted(tuple(block) for block in blocks(lanes.get(STATUS).json()))
            assert all(entry in known.values() for entry in lanes.get(STATUS).json()["blocks"])


def test_alerts_come_when_they_change(lanes: Client, clock: FakeClock) -> None:
    with streaming(lanes) as stream:
        assert of("alerts", stream.news())["items"] == []
        look(lanes)
        assert "alerts" not in named(stream.news())
        see(lanes, "radar-1", 3.5, 1.5)
        look(lanes)
        assert [item["track_id"] for item in of("alerts", stream.news())["items"]] == ["radar-1"]
        clock.advance(seconds=61)
        look(lanes)
        assert of("alerts", stream.news())["items"] == lanes.get(ALERTS).json()["items"] == []


def test_without_a_new_look_it_is_quiet(lanes: Client) -> None:
    with streaming(lanes) as stream:
        stream.news()
        submit(lanes)
        assert stream.is_quiet(0.3)


def test_changes_of_flight_intents_and_of_conformance_are_events_with_ids(lanes: Client, clock: FakeClock) -> None:
    with streaming(lanes) as stream:
        stream.news()
        flight = activated(lanes)
        clock.now_ms = DEPARTURE_MS
        see(lanes, flight, 0.5, 1.5)
        look(lanes)
        told = [each for each in stream.news() if each.id is not None]
    assert [(each.name, each.id, each.data["kind"]) for each in told] == [
        ("intent", 1, "accepted"),
        ("intent", 2, "activated"),
        ("intent", 3, "nonconforming"),
        ("conformance", 4, "deviating"),
    ]
    assert [each.data for each in told] == lanes.get("/v1/events").json()["items"]


def test_without_a_last_event_it_begins_now(lanes: Client) -> None:
    submit(lanes)
    look(lanes)
    with streaming(lanes) as stream:
        assert named(stream.news()) == ["status", "flights", "alerts"]


@pytest.mark.parametrize(("last", "revisions"), [(0, [1, 2, 3]), (1, [2, 3]), (2, [3]), (3, []), (2**62, [])])
def test_whoever_names_the_last_event_hears_all_since(lanes: Client, last: int, revisions: list[int]) -> None:
    flight = activated(lanes)
    lanes.post(f"{SUBMIT}/{flight}/end")
    look(lanes)
    with streaming(lanes, {"last-event-id": str(last)}) as stream:
        first = stream.news()
        assert [each.id for each in first if each.name == "intent"] == revisions
        # And nothing twice.
        look(lanes)
        assert "intent" not in named(stream.news())


def test_more_than_a_page_of_what_was_missed_comes_whole(lanes: Client, clock: FakeClock) -> None:
    crowd = [position((3, 1, 0), clock.now_ms, district=LANES, track_id=f"radar-{n}") for n in range(600)]
    lanes.post(TELEMETRY, json=report(*crowd))
    look(lanes)
    clock.advance(seconds=6)
    look(lanes)
    revision = lanes.service.ledger.revision()
    assert revision == 1200
    with streaming(lanes, {"last-event-id": "0"}) as stream:
        ids = [each.id for each in stream.news() if each.name == "conformance"]
    assert ids == list(range(1, revision + 1))


def test_what_retention_has_removed_is_a_gap(ledger: str, tmp_path: Path, clock: FakeClock) -> None:
    kept = settings_for(LANES, ledger, tmp_path, retention_days=1, idempotency_hours=1)
    with served(create_app(kept, clock, elapsed_ms=clock)) as client:
        submit(client)
        submit(client, "V", "F")
        clock.advance(ms=2 * DAY_MS)
        submit(client, earliest_ms=clock.now_ms + 60_000)
        asyncio.run(until(lambda: client.service.ledger.removed().journal_through == 2))
        look(client)
        with streaming(client, {"last-event-id": "1"}) as stream:
            assert stream.next() == Event("gap", {"removed_through": 2})
            assert [each.id for each in stream.news() if each.name == "intent"] == [3]
        with streaming(client, {"last-event-id": "2"}) as stream:
            assert "gap" not in named(stream.news())


@pytest.mark.parametrize("last", ["", "-1", "x", "1.5", str(2**62 + 1), "9" * 40])
def test_a_last_event_that_cannot_be_one_is_refused(lanes: Client, last: str) -> None:
    answer = problem(lanes.get(STREAM, headers={"Last-Event-ID": last}), 422, "validation-error")
    assert [error["loc"] for error in answer["errors"]] == [["header", "last-event-id"]]


def test_it_cannot_begin_without_the_ledger(lanes: Client) -> None:
    with failing("SELECT"):
        problem(lanes.get(STREAM), 503, "ledger-unavailable")


@contextmanager
def unreadable_to_streams(statement: str, *, after: int = 0) -> Iterator[list[str]]:
    """Fail the statements that begin like this, after some, in the threads in which streams read; yield all of them."""
    seen: list[str] = []

    def listener(_connection: object, _cursor: object, text: str, *_: object) -> None:
        if text.startswith(statement) and threading.current_thread().name == "AnyIO worker thread":
            seen.append(text)
            if len(seen) <= after:
                return
            raise OperationalError(text, {}, Exception("disk I/O error"))

    event.listen(Engine, "before_cursor_execute", listener)
    try:
        yield seen
    finally:
        event.remove(Engine, "before_cursor_execute", listener)


# The first is read before the journal, the second behind it, for the alerts.
@pytest.mark.parametrize("statement", ["SELECT counters", "SELECT reservations"])
def test_what_a_failing_ledger_kept_back_comes_with_the_next_look(
    lanes: Client, clock: FakeClock, statement: str
) -> None:
    with streaming(lanes) as stream:
        stream.news()
        flight = activated(lanes)
        clock.now_ms = DEPARTURE_MS
        see(lanes, flight, 0.5, 1.5)
        with unreadable_to_streams(statement):
            look(lanes)
            assert stream.next() == Event(None, comment="the ledger cannot be read: disk I/O error")
            # It is not asked again before there is something new.
            assert stream.is_quiet(0.3)
        look(lanes)
        news = stream.news()
    assert [each.id for each in news if each.id is not None] == [1, 2, 3, 4]
    assert blocks(of("status", news)) == blocks(lanes.get(STATUS).json()) != []
    assert [item["flight_intent_id"] for item in of("alerts", news)["items"]] == [flight]


@on_sqlite
def test_who_is_behind_in_the_journal_does_not_press_a_failing_ledger(lanes: Client) -> None:
    for _ in range(3):
        submit(lanes)
    look(lanes)
    # Whoever reads as much as it may asks once more for what belongs to the last revision.
    failing_soon = unreadable_to_streams("SELECT journal", after=2)
    with failing_soon as asked, streaming(lanes, {"last-event-id": "0"}, Board(entries_at_once=1)) as stream:
        assert [stream.next().name for _ in range(4)] == ["intent", "status", "flights", "alerts"]
        assert stream.next().comment == "the ledger cannot be read: disk I/O error"
        assert stream.is_quiet(0.3)
        assert len(asked) == 3


def test_it_ends_when_the_server_does(lanes: Client) -> None:
    with streaming(lanes) as stream:
        stream.news()
        lanes.service.closing.set()
        assert stream.has_ended()


@on_sqlite
def test_what_many_watch_is_rendered_once(lanes: Client) -> None:
    board, monitor = Board(), lanes.service.monitor
    view = monitor.look()
    assert board.bulletin(lanes.service, view) is board.bulletin(lanes.service, view)
    assert board.bulletin(lanes.service, monitor.look()).before is view


@on_sqlite
def test_a_long_journal_goes_out_in_parts_and_the_blocks_need_not_wait_for_it(lanes: Client) -> None:
    for _ in range(5):
        submit(lanes)
    look(lanes)
    with streaming(lanes, {"last-event-id": "0"}, Board(entries_at_once=2)) as stream:
        found = [stream.next().name for _ in range(8)]
    assert found == ["intent", "intent", "status", "flights", "alerts", "intent", "intent", "intent"]
