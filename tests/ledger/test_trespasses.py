"""Closed airspace that somebody holds: what is a fault of the service, and what is none or cannot be told."""

import asyncio
from collections.abc import Iterator, Sequence
from dataclasses import replace

import pytest

from app.constraints import Constraint
from app.deconfliction import Outcome
from app.flight_intents import FlightIntent, Submission
from app.ledger import Ledger
from app.ledger.rows import to_row
from app.scheduling import Limits
from app.trespasses import trespasses
from tests.ledger.district import DEPARTURE_MS, LANES, START_MS
from tests.ledger.locations import database, on_sqlite
from tests.ledger.process import DAY_MS, HORIZON_MS, FakeClock, Process, closing, departure, held
from tests.ledger.tampering import tampering

pytestmark = on_sqlite

# A column of blocks in the middle: whoever goes from west to east crosses it.
MIDDLE = [LANES.block((4, j, k)) for j in range(3) for k in range(2)]
PLANNED, MOVABLE = "it was planned after the constraint", "it could have made way for the constraint"


@pytest.fixture
def lanes(ledger: str, clock: FakeClock) -> Iterator[Process]:
    """Return a process of which those who depart within a minute are not moved."""
    with Process(ledger, LANES.airspace, clock, limits=Limits(HORIZON_MS, lead_ms=1_000)) as process:
        yield process


def found(process: Process) -> list[tuple[int, int, str]]:
    """Return sequence numbers, numbers of constraints, and what is wrong."""
    ledger: Ledger = process.ledger
    with ledger.snapshot() as snapshot:
        return [
            (each.overlap.intent.sequence, each.overlap.constraint.number, each.reason)
            for each in trespasses(snapshot, snapshot.intents()[0])
        ]


def crossing(after_ms: int = DEPARTURE_MS - START_MS, window_ms: int = 300_000) -> Submission:
    return LANES.submission("W", "E", earliest_ms=START_MS + after_ms, window_ms=window_ms)


def close(process: Process, from_ms: int = START_MS, until_ms: int | None = None) -> Constraint:
    return asyncio.run(process.airspace_closing.close(closing(MIDDLE, from_ms, until_ms))).constraint


def reopen(process: Process, constraint: Constraint) -> None:
    asyncio.run(process.airspace_closing.reopen(constraint.id))


def put_back(process: Process, intents: Sequence[FlightIntent]) -> None:
    """Bring intents back to what they were, as if nothing had been planned around anything."""
    with tampering(process.location) as book:
        for intent in intents:
            row = to_row(intent)
            columns = ("state", "departure", "arrival", "unconstrained", "trajectory", "refusal")
            book.execute(
                f"UPDATE flight_intents SET {', '.join(f'{name} = :{name}' for name in columns)} "  # noqa: S608
                "WHERE sequence = :sequence",
                row,
            )
            book.execute("DELETE FROM reservations WHERE intent = ?", (intent.sequence,))
            rows = [(*hold, intent.sequence) for hold in held(intent)]
            book.executemany('INSERT INTO reservations (block, enter, "exit", intent) VALUES (?, ?, ?, ?)', rows)


def test_who_was_planned_around_closed_airspace_holds_none_of_it(lanes: Process) -> None:
    close(lanes, until_ms=START_MS + 120_000)
    flight = lanes.submit(crossing())
    assert departure(flight) > DEPARTURE_MS
    assert found(lanes) == []


def test_who_holds_closed_airspace_and_was_planned_when_it_was_closed_is_named(lanes: Process) -> None:
    other = lanes.submit(crossing())
    lanes.cancel(other)
    close(lanes, until_ms=START_MS + 120_000)
    flight = lanes.submit(crossing())
    put_back(lanes, [replace(flight, reservations=other.reservations)])
    assert found(lanes) == [(flight.sequence, 1, PLANNED)]


def test_the_first_overlap_is_named_as_far_as_the_constraint_is_in_force(lanes: Process) -> None:
    other = lanes.submit(crossing())
    lanes.cancel(other)
    middle = sorted((enter, leave) for block, enter, leave in held(other) if block in MIDDLE)
    close(lanes, from_ms=middle[0][0] + 100, until_ms=middle[0][1] - 100)
    flight = lanes.submit(crossing())
    put_back(lanes, [replace(flight, reservations=other.reservations)])
    with lanes.ledger.snapshot() as snapshot:
        ((overlap, _),) = trespasses(snapshot, snapshot.intents()[0])
    assert (overlap.block in MIDDLE, overlap.from_ms, overlap.to_ms) == (True, middle[0][0] + 100, middle[0][1] - 100)


@pytest.mark.parametrize(("before_ms", "is_named"), [(DAY_MS, True), (DAY_MS - 1, False)])
def test_who_was_left_in_it_although_it_surely_could_move_is_named(
    lanes: Process, before_ms: int, is_named: bool
) -> None:
    flight = lanes.submit(crossing(after_ms=before_ms))
    close(lanes)
    assert held(lanes.ledger.find(flight.id) or flight) != held(flight)
    forget_moves(lanes, [flight])
    assert found(lanes) == ([(flight.sequence, 1, MOVABLE)] if is_named else [])


def forget_moves(process: Process, intents: Sequence[FlightIntent]) -> None:
    """Make a ledger in which a constraint moved all but some intents."""
    put_back(process, intents)
    with tampering(process.location) as book:
        for intent in intents:
            book.execute("DELETE FROM journal WHERE intent = ? AND place > 0", (intent.sequence,))


@pytest.mark.parametrize(("earlier_ms", "is_named"), [(0, True), (1, False)])
def test_who_departs_no_earlier_than_another_that_was_moved_could_have_moved_too(
    lanes: Process, earlier_ms: int, is_named: bool
) -> None:
    left = lanes.submit(crossing(after_ms=400_000 - earlier_ms))
    moved = lanes.submit(LANES.submission("V", "F", earliest_ms=START_MS + 400_000))
    assert (departure(moved) - departure(left)) == earlier_ms
    close(lanes)
    forget_moves(lanes, [left])
    assert found(lanes) == ([(left.sequence, 1, MOVABLE)] if is_named else [])


def test_who_could_not_be_moved_and_is_told_so_is_none_of_it(lanes: Process, clock: FakeClock) -> None:
    soon, activated, late = (lanes.submit(crossing(after_ms=after_ms)) for after_ms in (60_000, 400_000, DAY_MS))
    asyncio.run(lanes.deconfliction.activate(activated.id))
    clock.advance(ms=1)
    close(lanes)
    assert [held(lanes.ledger.find(each.id) or late) for each in (soon, activated)] == [held(soon), held(activated)]
    assert found(lanes) == []
    # Nor in a ledger from before that was told: whoever may have had no notice, and who was activated.
    with tampering(lanes.location) as book:
        book.execute("DELETE FROM journal WHERE kind = 'unmoved'")
    assert found(lanes) == []


def test_an_activated_flight_is_none_of_it_however_late_it_departs(lanes: Process) -> None:
    flight = lanes.submit(crossing(after_ms=2 * DAY_MS))
    asyncio.run(lanes.deconfliction.activate(flight.id))
    close(lanes)
    with tampering(lanes.location) as book:
        assert book.execute("DELETE FROM journal WHERE kind = 'unmoved'").rowcount == 1
    assert found(lanes) == []


def test_who_was_listed_as_unmoved_is_none_of_it(lanes: Process) -> None:
    flight = lanes.submit(crossing(after_ms=2 * DAY_MS))
    asyncio.run(lanes.deconfliction.activate(flight.id))
    close(lanes)
    with tampering(lanes.location) as book:
        assert book.execute("DELETE FROM journal WHERE kind = 'activated'").rowcount == 1
    assert found(lanes) == []


def test_what_was_planned_when_it_was_open_again_is_none_of_it(lanes: Process, clock: FakeClock) -> None:
    constraint = close(lanes)
    clock.advance(seconds=1)
    reopen(lanes, constraint)
    # A clock that lags says that it is still closed.
    clock.now_ms = START_MS
    flight = lanes.submit(crossing())
    with tampering(lanes.location) as book:
        book.execute("UPDATE constraints SET removed = ?", (START_MS + DAY_MS,))
    assert any(block in MIDDLE for block, _, _ in held(flight))
    assert found(lanes) == []


def test_what_is_held_after_it_was_opened_is_none_of_it(lanes: Process, clock: FakeClock) -> None:
    flight = lanes.submit(crossing(after_ms=2 * DAY_MS))
    constraint = close(lanes)
    forget_moves(lanes, [flight])
    assert found(lanes) == [(flight.sequence, 1, MOVABLE)]
    clock.advance(seconds=60)
    reopen(lanes, constraint)
    assert found(lanes) == []


def test_what_was_held_before_it_was_closed_is_none_of_it(lanes: Process, clock: FakeClock) -> None:
    first = lanes.submit(crossing())
    clock.now_ms = DEPARTURE_MS + 60_000
    close(lanes)
    assert any(block in MIDDLE for block, _, _ in held(first))
    assert found(lanes) == []


def test_a_flight_that_is_changed_in_the_air_keeps_what_it_had_of_closed_airspace(
    lanes: Process, clock: FakeClock
) -> None:
    flight = lanes.submit(crossing())
    asyncio.run(lanes.deconfliction.activate(flight.id))
    enters_ms = min(enter for block, enter, _ in held(flight) if block in MIDDLE)
    clock.now_ms = enters_ms - 500
    close(lanes, from_ms=START_MS)
    elsewhere = replace(flight.submission, destination=LANES.centre("F"), destination_block=LANES.block("F"))
    changed = asyncio.run(lanes.deconfliction.change(flight.id, elsewhere, None))
    intent = lanes.ledger.find(flight.id)
    assert intent is not None
    assert (intent.submission, isinstance(changed, Outcome)) == (elsewhere, True)
    assert {hold for hold in held(intent) if hold[0] in MIDDLE}
    assert found(lanes) == []
    # What it did not have before is its new plan's.
    later = max(leave for _, _, leave in held(intent))
    with tampering(lanes.location) as book:
        row = (MIDDLE[0], later + 1, later + 1000, intent.sequence)
        book.execute('INSERT INTO reservations (block, enter, "exit", intent) VALUES (?, ?, ?, ?)', row)
    assert found(lanes) == [(intent.sequence, 1, PLANNED)]


def test_what_it_should_not_have_had_is_named_after_a_change_in_the_air_too(lanes: Process, clock: FakeClock) -> None:
    other = lanes.submit(crossing())
    lanes.cancel(other)
    close(lanes, until_ms=START_MS + 120_000)
    flight = lanes.submit(crossing())
    put_back(lanes, [replace(flight, reservations=other.reservations, trajectory=other.trajectory)])
    asyncio.run(lanes.deconfliction.activate(flight.id))
    clock.now_ms = max(leave for block, _, leave in held(other) if block in MIDDLE)
    elsewhere = replace(flight.submission, destination=LANES.centre("F"), destination_block=LANES.block("F"))
    assert isinstance(asyncio.run(lanes.deconfliction.change(flight.id, elsewhere, None)), Outcome)
    assert found(lanes) == [(flight.sequence, 1, PLANNED)]


def test_before_it_was_made_a_constraint_was_not_in_force(lanes: Process, clock: FakeClock) -> None:
    other = lanes.submit(crossing())
    lanes.cancel(other)
    clock.now_ms = START_MS + 600_000
    close(lanes, until_ms=START_MS + 700_000)
    # A clock that lags says that it has yet to be made.
    clock.now_ms = START_MS
    flight = lanes.submit(crossing(window_ms=1_000_000))
    put_back(lanes, [replace(flight, reservations=other.reservations)])
    assert found(lanes) == []


def test_what_the_journal_has_no_more_was_before_the_rest(lanes: Process) -> None:
    other = lanes.submit(crossing())
    lanes.cancel(other)
    close(lanes, until_ms=START_MS + 120_000)
    flight = lanes.submit(crossing(after_ms=400_000))
    put_back(lanes, [replace(flight, reservations=other.reservations)])
    with tampering(lanes.location) as book:
        book.execute("DELETE FROM journal WHERE kind = 'constraint_created'")
    assert found(lanes) == []
    with tampering(lanes.location) as book:
        book.execute("DELETE FROM journal WHERE revision <= 3")
        book.execute("UPDATE counters SET journal_removed = 3")
    assert found(lanes) == [(flight.sequence, 1, PLANNED)]
    with tampering(lanes.location) as book:
        book.execute("DELETE FROM journal WHERE revision <= 4")
        book.execute("UPDATE counters SET journal_removed = 4")
    assert found(lanes) == []
    with database(lanes.location) as connection:
        assert connection.rows("SELECT count(*) FROM constraints") == [(1,)]
