"""Closing airspace, and opening it again.

Who holds some of what is closed has to make way. Where those are many, most of the work is done before the writer is
held up: they are planned again around a copy of what is reserved, in a thread of its own. Then, in one piece of the
writer's work, the constraint is recorded and they move, those for whom that plan no longer holds to another one.
"""

import asyncio
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from anyio import to_thread

from app.constraints import MOST_CLOSED_BLOCKS, Constraint
from app.errors import TooManyConstraints, UnknownConstraint
from app.flight_intents import Displacement
from app.ledger import Ledger, Transaction
from app.scheduling import FEW, Cause, Foreseen, Scheduler
from app.writer import Writer
from planner.occupancy import OccupancyIndex

# Until it is closed nobody knows, so there is an end to it; who was not planned by then is planned by the writer.
_AHEAD_S = 10.0
# The number of a constraint in the copy: it has none of its own before it is recorded.
_TO_COME = 1 << 48


@dataclass(frozen=True, eq=False)
class Closed:
    """A constraint, the flights that had to make way for it, and the ids of those that no longer could."""

    constraint: Constraint
    displaced: tuple[Displacement, ...] = ()
    unmoved: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Picture:
    """What will be reserved and closed without the flights that have to make way, and their sequence numbers."""

    now: int
    revision: int
    index: OccupancyIndex
    movable: tuple[int, ...]


class AirspaceClosing:
    """Closes and opens airspace by way of the writer. Beyond `few` flights that make way are planned ahead."""

    def __init__(
        self,
        writer: Writer,
        ledger: Ledger,
        scheduler: Scheduler,
        *,
        few: int = FEW,
        elapsed_s: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._writer = writer
        self._ledger = ledger
        self._scheduler = scheduler
        self._few = few
        self._elapsed_s = elapsed_s
        self._turn = asyncio.Lock()

    async def close(self, constraint: Constraint) -> Closed:
        """Record a constraint, and plan those anew whom it hits and who can still make way.

        Raises
        ------
        TooManyConstraints, QueueFull, LedgerUnavailable, OutcomeUnknown
        """
        foreseen = await self._foreseen(constraint)
        # What the last attempt did, which is what was done if the constraint is in the ledger.
        done: list[Closed] = []

        def run(transaction: Transaction, now: int) -> Closed:
            done[:] = [self._close(transaction, now, constraint, foreseen)]
            return done[0]

        def look_up() -> Closed | None:
            return done[0] if done and self._ledger.constraint(constraint.id) is not None else None

        return await self._writer.perform(run, look_up)

    async def _foreseen(self, constraint: Constraint) -> Mapping[int, Foreseen]:
        """Plan those ahead who will have to make way, if they are many; return nothing where they are few."""

        async def look() -> _Picture | None:
            return await self._writer.perform(
                lambda transaction, now: self._picture(transaction, now, constraint), lambda: None
            )

        if await look() is None:
            return {}
        async with self._turn:
            # Anew, for another one may just have moved them.
            picture = await look()
            return {} if picture is None else await to_thread.run_sync(self._foresee, picture)

    async def reopen(self, constraint_id: str) -> Constraint:
        """Remove a constraint. Who made way for it stays where it is now.

        Raises
        ------
        UnknownConstraint, QueueFull, LedgerUnavailable, OutcomeUnknown
        """

        def run(transaction: Transaction, now: int) -> Constraint:
            constraint = transaction.constraint(constraint_id)
            if constraint is None:
                raise UnknownConstraint(f"there is no constraint {constraint_id}")
            if constraint.removed_ms is None:
                constraint = transaction.remove_constraint(constraint, now)
                self._scheduler.index.reopen([constraint.number])
            return constraint

        def look_up() -> Constraint | None:
            constraint = self._ledger.constraint(constraint_id)
            return constraint if constraint is not None and constraint.removed_ms is not None else None

        return await self._writer.perform(run, look_up)

    def _picture(self, transaction: Transaction, now: int, constraint: Constraint) -> _Picture | None:
        """Return what to plan ahead around, None where few have to make way."""
        scheduler = self._scheduler
        self._check_room(constraint)
        movable = scheduler.within(transaction, now, constraint.closure).movable
        if len(movable) <= self._few:
            return None
        index = scheduler.index.without(np.array(movable, dtype=np.int64))
        index.close({_TO_COME: constraint.closure})
        return _Picture(now, transaction.revision, index, movable)

    def _foresee(self, picture: _Picture) -> dict[int, Foreseen]:
        """Plan those who have to make way around a picture, with a planner of its own."""
        began = self._elapsed_s()
        return self._scheduler.foresee(
            self._ledger.find_all(picture.movable),
            picture.index,
            picture.now,
            picture.revision,
            should_stop=lambda: self._elapsed_s() - began >= _AHEAD_S,
        )

    def _close(
        self, transaction: Transaction, now: int, constraint: Constraint, foreseen: Mapping[int, Foreseen]
    ) -> Closed:
        scheduler = self._scheduler
        self._check_room(constraint)
        revision = transaction.revision
        with transaction.one_revision():
            recorded = transaction.record_constraint(constraint, now)
            hit = scheduler.within(transaction, now, recorded.closure)
            vacated = scheduler.vacate(transaction, now, hit.movable)
            scheduler.index.close({recorded.number: recorded.closure})
            numbered = {
                sequence: found.renumbered(_TO_COME, recorded.number)
                for sequence, found in foreseen.items()
                if found.holds_at(revision)
            }
            cause = Cause(constraint_id=recorded.id)
            displaced = scheduler.settle(transaction, now, vacated, cause, numbered)
            ids = transaction.ids(hit.unmovable)
            unmoved = {sequence: ids[sequence] for sequence in hit.unmovable}
            transaction.tell_unmoved(unmoved, cause.member(), now)
        return Closed(recorded, displaced, tuple(unmoved.values()))

    def _check_room(self, constraint: Constraint) -> None:
        if self._scheduler.index.closed_count + len(constraint.blocks) > MOST_CLOSED_BLOCKS:
            raise TooManyConstraints(
                f"all constraints together may close {MOST_CLOSED_BLOCKS:,} blocks, each counted as often as it is "
                "closed: make this one smaller, or remove others"
            )
