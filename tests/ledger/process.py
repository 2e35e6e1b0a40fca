"""One process's worth of the service without HTTP, so that tests can run several on one ledger."""

import asyncio
import time
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from uuid import uuid4

import numpy as np

from app.airspace_closing import AirspaceClosing
from app.batches import Batches
from app.constraints import Constraint
from app.deconfliction import Deconfliction, IdempotencyKey, Outcome
from app.flight_intents import FlightIntent, Reservations, Submission
from app.ledger import open_ledger
from app.replica import OccupancyReplica
from app.scheduling import FEW, Limits, Scheduler
from app.writer import BatchReport, Policy, Writer
from planner.aircraft import shipped_aircraft_types
from planner.airspace import Airspace
from planner.cfa_star import Performance, Planner, Search
from planner.kernels import intervals
from planner.occupancy import OccupancyIndex
from tests.ledger.district import START_MS
from tests.ledger.locations import Stranger, database, write_lock

Hold = tuple[int, int, int]  # block, enter, exit

DAY_MS = 86_400_000
HORIZON_MS = 30 * DAY_MS
POLICY = Policy(idempotency_ms=DAY_MS, queue_limit=1024)
PERIODS = Limits(HORIZON_MS)


@dataclass
class FakeClock:
    """A clock that stands still until it is told."""

    now_ms: int = START_MS

    def __call__(self) -> int:
        """Return the time."""
        return self.now_ms

    def advance(self, *, seconds: float = 0, ms: int = 0) -> None:
        """Let time pass."""
        self.now_ms += round(seconds * 1000) + ms


class Process:
    """Ledger connections, planner, index and writer on one migrated ledger.

    What `clock` says has passed, unless `elapsed_ms` knows better.
    """

    def __init__(
        self,
        location: str,
        airspace: Airspace,
        clock: Callable[[], int],
        *,
        elapsed_ms: Callable[[], int] | None = None,
        observers: Sequence[Callable[[BatchReport], None]] = (),
        on_death: Callable[[], None] = lambda: None,
        policy: Policy = POLICY,
        limits: Limits = PERIODS,
        search: Search = Search.SAFE_INTERVAL,
        few: int = FEW,
        activation_lead_ms: int | None = None,
    ) -> None:
        self.location = location
        self.ledger = open_ledger(location, airspace, claim=True)
        self.planner = Planner(airspace, search, detour_limit_ms=300_000)
        performances = {type_.id: Performance.of(type_, airspace.grid) for type_ in shipped_aircraft_types()}
        self.writer = Writer(
            self.ledger,
            OccupancyReplica(self.planner.index),
            clock,
            policy,
            elapsed_ms=elapsed_ms or clock,
            observers=observers,
            on_death=on_death,
        )
        scheduler = Scheduler(self.planner, performances, limits)
        self.deconfliction = Deconfliction(
            self.writer, self.ledger, scheduler, freshness_ms=5_000, activation_lead_ms=activation_lead_ms
        )
        self.airspace_closing = AirspaceClosing(self.writer, self.ledger, scheduler, few=few)
        self.batches = Batches(self.writer, self.ledger, scheduler, self.deconfliction)
        self.writer.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.writer.stop()
        self.ledger.close()

    def submit(self, submission: Submission, key: IdempotencyKey | None = None) -> FlightIntent:
        """Return what is recorded of a submission."""
        return asyncio.run(self.deconfliction.submit(submission, key)).intent

    def cancel(self, intent: FlightIntent) -> FlightIntent:
        """Cancel an intent."""
        return asyncio.run(self.deconfliction.cancel(intent.id))

    def together(self, *requests: Coroutine[Any, Any, Any]) -> list[Any]:
        """Return the answers, or errors, of requests that have to be written as one batch."""
        return asyncio.run(self._together(requests))

    async def _together(self, requests: tuple[Coroutine[Any, Any, Any], ...]) -> list[Any]:
        with write_lock(self.location):
            tasks = [asyncio.create_task(request) for request in requests]
            await until(lambda: self.writer.waiting == len(requests) - 1)
        return await asyncio.gather(*tasks, return_exceptions=True)

    def indexed(self, now_ms: int) -> dict[Hold, int]:
        """Return the reservations of the index that end after `now_ms`, with the sequence numbers of their intents."""
        return {hold: owner for hold, owner in content(self.planner.index).items() if owner > 0 and hold[2] > now_ms}


def content(index: OccupancyIndex) -> dict[Hold, int]:
    """Return what an index has, closures too, with the owners."""
    table, pool, _ = index.slabs
    held = {}
    for block, (first, count) in enumerate(table[:, : intervals.SIZE_CLASS].tolist()):
        for enter, leave, owner in pool[first : first + count].tolist() if count else ():
            held[block, enter, leave] = owner
    return held


def outcomes(process: Process, *submissions: Submission) -> list[Outcome | BaseException]:
    """Submit in one batch; return outcomes and errors."""
    return process.together(*(process.deconfliction.submit(submission) for submission in submissions))


async def until(reached: Callable[[], bool]) -> None:
    """Wait for another thread."""
    deadline = time.monotonic() + 10
    while not reached():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.001)


def reserved(ledger: str | Path | Stranger, after_ms: int = 0) -> dict[Hold, int]:
    """Return the ledger's reservations that end after a time, with the sequence numbers of their intents."""
    with database(ledger) as connection:
        rows = connection.rows('SELECT block, enter, "exit", intent FROM reservations WHERE "exit" > ?', [after_ms])
    return {(block, enter, leave): intent for block, enter, leave, intent in rows}


def assert_no_overlaps(ledger: str | Path | Stranger) -> None:
    """Fail if two reservations of a block overlap, or one is empty."""
    holds = sorted(reserved(ledger))
    for (block, _, leave), (other_block, enter, _) in pairwise(holds):
        assert block != other_block or leave <= enter
    assert all(enter < leave for _, enter, leave in holds)


def assert_gapless(ledger: str | Path | Stranger) -> None:
    """Fail if a sequence number or revision is missing, or the counters lag behind."""
    with database(ledger) as connection:
        sequences = [row[0] for row in connection.rows("SELECT sequence FROM flight_intents ORDER BY sequence")]
        revisions = [row[0] for row in connection.rows("SELECT DISTINCT revision FROM journal ORDER BY revision")]
        counters = connection.rows("SELECT sequence, revision FROM counters")
    assert sequences == list(range(1, len(sequences) + 1))
    assert revisions == list(range(1, len(revisions) + 1))
    assert counters == [(len(sequences), len(revisions))]


def assert_journal_tells_states(ledger: str | Path | Stranger) -> None:
    """Fail unless every intent's state and version are those of its newest journal entry, but for being unmoved."""
    with database(ledger) as connection:
        states = dict(connection.rows("SELECT sequence, state || version FROM flight_intents"))
        entries = connection.rows(
            "SELECT intent, kind || revision FROM journal WHERE intent > 0 AND kind <> 'unmoved' ORDER BY revision"
        )
    assert states == dict(entries)


def assert_sound(process: Process, now_ms: int = 0) -> None:
    """Fail unless table, index, counters and journal agree and nothing overlaps."""
    assert_no_overlaps(process.location)
    assert_gapless(process.location)
    assert_journal_tells_states(process.location)
    assert process.indexed(now_ms) == reserved(process.location, now_ms)


def held(intent: FlightIntent) -> set[Hold]:
    """Return an intent's reservations."""
    columns: Reservations = intent.reservations
    return set(zip(columns.block.tolist(), columns.enter_ms.tolist(), columns.exit_ms.tolist(), strict=True))


def closing(blocks: Sequence[int], from_ms: int, until_ms: int | None) -> Constraint:
    """Return a constraint over some blocks."""
    return Constraint(
        0, str(uuid4()), "a fire", {}, 0.0, None, from_ms, until_ms, np.array(sorted(blocks), dtype=np.int64), 0
    )


def departure(intent: FlightIntent) -> int:
    assert intent.trajectory is not None
    return intent.trajectory.departure_ms


def arrival(intent: FlightIntent) -> int:
    assert intent.trajectory is not None
    return intent.trajectory.arrival_ms


def key(name: str, digest: str = "one body") -> IdempotencyKey:
    """Return a key whose answers are rendered as their sequence numbers."""
    return IdempotencyKey(name, digest, lambda outcome: str(outcome.intent.sequence).encode())
