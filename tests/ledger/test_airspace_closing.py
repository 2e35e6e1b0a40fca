"""Closing airspace that many flights hold: they are planned ahead, while others are served, and moved in one piece."""

import asyncio
import threading
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import replace
from typing import Any

import pytest

from app.airspace_closing import AirspaceClosing, Closed
from app.errors import TooManyConstraints
from app.flight_intents import FlightIntent, State
from app.scheduling import FEW, Foreseen, Scheduler
from planner.path import Plan
from tests.ledger.district import DEPARTURE_MS, STREET
from tests.ledger.locations import Ledgers
from tests.ledger.process import FakeClock, Process, assert_sound, closing
from tests.ledger.test_priorities import along, departures, described, everything, submitted

Meanwhile = Callable[[Callable[[], object]], list[dict[int, Foreseen]]]

FLIGHTS = 3
UNTIL_MS = DEPARTURE_MS + 60_000


@pytest.fixture
def street(ledger: str, clock: FakeClock) -> Iterator[Process]:
    """A street with flights one after another, where everybody who has to make way is planned ahead."""
    with Process(ledger, STREET.airspace, clock, few=0) as process:
        for _ in range(FLIGHTS):
            submitted(process, along())
        yield process


def close(process: Process, until_ms: int | None = UNTIL_MS) -> Closed:
    """Close the middle of the street."""
    shut = closing([STREET.block((3, 0, 0))], DEPARTURE_MS - 10_000, until_ms)
    return asyncio.run(process.airspace_closing.close(shut))


@pytest.fixture
def meanwhile(monkeypatch: pytest.MonkeyPatch) -> Meanwhile:
    """Let something happen after flights were planned ahead, and before they are moved; return what was foreseen."""

    def happens(what: Callable[[], object]) -> list[dict[int, Foreseen]]:
        foresee, found = Scheduler.foresee, []

        def and_then(*arguments: Any, **named: Any) -> dict[int, Foreseen]:
            found.append(foresee(*arguments, **named))
            what()
            return found[-1]

        monkeypatch.setattr(Scheduler, "foresee", and_then)
        return found

    return happens


def plan_of(known: Foreseen) -> Plan:
    assert isinstance(known.outcome, Plan)
    return known.outcome


def done(request: Coroutine[Any, Any, Any]) -> Any:
    """Return an answer that has to come although airspace is being closed."""
    return asyncio.run(asyncio.wait_for(request, 10))


def test_planned_ahead_or_not_everybody_gets_the_same(ledgers: Ledgers, clock: FakeClock) -> None:
    seen = []
    for few in (0, FLIGHTS):
        with Process(ledgers.migrated(), STREET.airspace, clock, few=few) as process:
            for priority in (0, 1, 0):
                submitted(process, along(priority, window_ms=70_000))
            closed = close(process)
            assert [flight.sequence for flight in closed.displaced] == [2, 1, 3]
            assert_sound(process)
            seen.append([described(flight)[:1] + described(flight)[2:5] for flight in everything(process).values()])
    assert seen[0] == seen[1]


def test_who_was_planned_ahead_is_moved_there(street: Process, meanwhile: Meanwhile) -> None:
    found = meanwhile(lambda: None)
    closed = close(street)
    [foreseen] = found
    assert [flight.state for flight in closed.displaced] == [State.ACCEPTED] * FLIGHTS
    assert departures(street) == {n: plan_of(known).departure_ms - DEPARTURE_MS for n, known in foreseen.items()}
    assert_sound(street)


def test_all_constraints_together_close_no_more_blocks_than_there_is_room_for(
    street: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.airspace_closing.MOST_CLOSED_BLOCKS", 2)
    for _ in range(2):
        close(street)
    before = [described(flight) for flight in everything(street).values()]
    with pytest.raises(TooManyConstraints, match="may close 2 blocks"):
        close(street)
    assert [described(flight) for flight in everything(street).values()] == before
    assert_sound(street)


def test_few_are_planned_by_the_writer(ledger: str, clock: FakeClock, meanwhile: Meanwhile) -> None:
    found = meanwhile(lambda: None)
    with Process(ledger, STREET.airspace, clock) as process:
        submitted(process, along())
        assert len(close(process).displaced) == 1 <= FEW
    assert found == []


def test_others_are_served_meanwhile_and_who_loses_a_place_to_them_gets_another(
    street: Process, meanwhile: Meanwhile
) -> None:
    request = STREET.submission("E", "W", earliest_ms=UNTIL_MS)
    others: list[FlightIntent] = []
    found = meanwhile(lambda: others.append(done(street.deconfliction.submit(request)).intent))
    closed = close(street)
    assert [flight.sequence for flight in closed.displaced] == [1, 2, 3]
    assert [other.state for other in others] == [State.ACCEPTED]
    assert (departures(street)[1] or 0) > plan_of(found[0][1]).departure_ms - DEPARTURE_MS
    assert_sound(street)


def test_who_came_or_went_or_was_changed_meanwhile_is_taken_as_it_is_by_then(
    street: Process, meanwhile: Meanwhile
) -> None:
    flights = everything(street)
    later = replace(flights[2].submission, earliest_departure_ms=UNTIL_MS + 5_000)

    def life_goes_on() -> None:
        done(street.deconfliction.cancel(flights[1].id))
        done(street.deconfliction.change(flights[2].id, later, None))
        done(street.deconfliction.activate(flights[3].id))
        done(street.deconfliction.submit(along()))

    meanwhile(life_goes_on)
    closed = close(street)
    assert [flight.sequence for flight in closed.displaced] == [4]
    assert closed.unmoved == (flights[3].id,)
    after = everything(street)
    assert [after[n].state for n in (1, 2, 3, 4)] == [
        State.CANCELLED,
        State.ACCEPTED,
        State.ACTIVATED,
        State.ACCEPTED,
    ]
    assert after[2].submission == later
    assert described(after[3])[3:5] == described(flights[3])[3:5]
    assert_sound(street)


def test_who_wants_something_else_by_then_does_not_get_what_was_foreseen(street: Process, meanwhile: Meanwhile) -> None:
    flight = everything(street)[1]
    nearer = replace(flight.submission, destination=STREET.centre((5, 0, 0)), destination_block=STREET.block((5, 0, 0)))
    meanwhile(lambda: done(street.deconfliction.change(flight.id, nearer, None)))
    assert [flight.sequence for flight in close(street).displaced] == [1, 2, 3]
    changed = everything(street)[1].trajectory
    assert changed is not None
    assert changed.block[-1] == STREET.block((5, 0, 0))
    assert_sound(street)


def test_notice_counts_from_when_they_are_moved(street: Process, clock: FakeClock, meanwhile: Meanwhile) -> None:
    """The last one is the only one that is left, and could fly earlier than it was planned to."""
    flights = everything(street)
    for sequence in (1, 2):
        done(street.deconfliction.cancel(flights[sequence].id))
    found = meanwhile(lambda: clock.advance(seconds=1))
    shut = closing([STREET.block((3, 0, 0))], DEPARTURE_MS + 10_000, DEPARTURE_MS + 12_000)
    assert len(asyncio.run(street.airspace_closing.close(shut)).displaced) == 1
    assert plan_of(found[0][3]).departure_ms == DEPARTURE_MS
    assert departures(street)[3] == 1_000
    assert_sound(street)


def test_who_is_not_planned_ahead_in_time_is_planned_by_the_writer(street: Process) -> None:
    seconds = iter(range(0, 100, 6))
    scheduler = street.airspace_closing._scheduler
    closer = AirspaceClosing(street.writer, street.ledger, scheduler, few=0, elapsed_s=lambda: float(next(seconds)))
    street.airspace_closing = closer
    closed = close(street)
    assert [flight.state for flight in closed.displaced] == [State.ACCEPTED] * FLIGHTS
    # Began, one flight was planned, and then it was too late.
    assert next(seconds) == 18
    assert_sound(street)


def test_who_finds_no_place_is_told_which_constraint_is_in_the_way(street: Process, meanwhile: Meanwhile) -> None:
    found = meanwhile(lambda: None)
    closed = close(street, None)
    assert {type(known.outcome).__name__ for known in found[0].values()} == {"NoConflictFreePath"}
    for flight in everything(street).values():
        assert flight.state is State.DISPLACED
        assert flight.refusal is not None
        assert flight.refusal.conflicting_constraints == (closed.constraint.id,)
    assert_sound(street)


def test_who_could_not_fly_because_of_somebody_who_has_left_since_is_planned_again(
    street: Process, meanwhile: Meanwhile
) -> None:
    for flight in everything(street).values():
        done(street.deconfliction.cancel(flight.id))
    hit = submitted(street, along(window_ms=UNTIL_MS + 1_000 - DEPARTURE_MS)).intent
    in_the_way = submitted(street, along(earliest_ms=UNTIL_MS, window_ms=0)).intent
    found = meanwhile(lambda: done(street.deconfliction.cancel(in_the_way.id)))
    asyncio.run(street.airspace_closing.close(closing([STREET.block("W")], DEPARTURE_MS - 10_000, UNTIL_MS)))
    assert not isinstance(found[0][hit.sequence].outcome, Plan)
    assert everything(street)[hit.sequence].state is State.ACCEPTED
    assert_sound(street)


def test_a_closing_that_hits_nobody_does_not_wait_for_one_that_plans_ahead(
    street: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes_on, foresee = threading.Event(), Scheduler.foresee

    def slowly(*arguments: Any, **named: Any) -> dict[int, Foreseen]:
        assert goes_on.wait(10)
        return foresee(*arguments, **named)

    monkeypatch.setattr(Scheduler, "foresee", slowly)

    async def both() -> tuple[Closed, Closed]:
        middle = closing([STREET.block((3, 0, 0))], DEPARTURE_MS - 10_000, UNTIL_MS)
        slow = asyncio.ensure_future(street.airspace_closing.close(middle))
        long_ago = closing([STREET.block((3, 0, 0))], DEPARTURE_MS - 20_000, DEPARTURE_MS - 19_000)
        quick = await asyncio.wait_for(street.airspace_closing.close(long_ago), 10)
        goes_on.set()
        return quick, await slow

    quick, slow = asyncio.run(both())
    assert (len(quick.displaced), len(slow.displaced)) == (0, FLIGHTS)
    assert quick.constraint.number < slow.constraint.number
    assert_sound(street)
