"""The occupancy index that the planner reads, as a replica of the ledger's reservations and constraints."""

from contextlib import suppress

import structlog

from app.flight_intents import State
from app.ledger import Transaction
from app.ledger.constraints import CONSTRAINT_KINDS
from planner.occupancy import OccupancyIndex

log = structlog.get_logger()

# The index forgets the past in steps of this length; forgetting looks at every block once.
_FORGET_EVERY_MS = 10_000
# A process that lags further behind than this many revisions loads the ledger afresh.
_CATCH_UP_REVISIONS = 5_000
_STATES = frozenset(State)


class OccupancyReplica:
    """The occupancy index as a replica of the ledger's reservations and constraints."""

    def __init__(self, index: OccupancyIndex) -> None:
        self._index = index
        self._forgotten_ms = 0

    def __len__(self) -> int:
        return len(self._index)

    def catch_up(self, transaction: Transaction, now: int, revision: int | None) -> None:
        """Bring the index from a revision (None: from nothing) to the transaction's; drop what has passed."""
        index = self._index
        # After a failover that lost commits, revisions are not what they were.
        known = revision is not None and revision <= transaction.revision and not transaction.on_new_connection
        lags = revision is not None and transaction.revision - revision > _CATCH_UP_REVISIONS
        if revision is None or not known or lags or revision < transaction.journal_removed:
            index.clear()
            held = transaction.held_after(now)
            index.reserve(held.block, held.enter_ms, held.exit_ms, held.sequence)
            self._close(transaction, now)
            self._forgotten_ms = now
            with suppress(OSError, ValueError):
                log.info("index loaded", revision=transaction.revision, reservations=len(held.block))
        elif transaction.revision > revision:
            entries = transaction.journal_after(revision)
            # What was remarked of aircraft changes no reservation.
            changes = [entry for entry in entries if entry.kind in _STATES]
            for entry in changes:
                index.release(*entry.released.T.copy())
            held = transaction.held_after(now, sorted({entry.sequence for entry in changes}))
            index.release(held.block, held.enter_ms, held.exit_ms)
            index.reserve(held.block, held.enter_ms, held.exit_ms, held.sequence)
            if any(entry.kind in CONSTRAINT_KINDS for entry in entries):
                self._close(transaction, now)
        transaction.seen()
        if now - self._forgotten_ms >= _FORGET_EVERY_MS:
            index.forget_before(now)
            self._forgotten_ms = now

    def _close(self, transaction: Transaction, now: int) -> None:
        """Close what the constraints in force close, and nothing else."""
        in_force = {constraint.number: constraint for constraint in transaction.constraints_after(now)}
        self._index.reopen(self._index.closed - in_force.keys())
        closures = {number: in_force[number].closure for number in in_force.keys() - self._index.closed}
        if closures:
            self._index.close(closures)
