"""What a ledger holds, read as a stranger would, against what operators were told."""

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from planner.airmatrix import IntArray
from tests.faults.operators import Receipt, Told, in_order
from tests.ledger.locations import database


class Intent(NamedTuple):
    """A row of `flight_intents`."""

    sequence: int
    id: str
    version: int
    state: str
    reference: str


@dataclass(frozen=True, eq=False)
class Book:
    """All of a ledger at one moment. `holds` (n, 4): intent, block, enter, exit, sorted."""

    intents: list[Intent]
    holds: IntArray
    journal: list[tuple[int, str, int]]
    counters: tuple[int, int]


@dataclass
class Damage:
    """What is wrong with a ledger, in sentences; of the answers, by reference."""

    lost: set[str] = field(default_factory=set)
    doubled: set[str] = field(default_factory=set)
    half_written: set[str] = field(default_factory=set)
    wrongly_answered: set[str] = field(default_factory=set)

    def add(self, other: "Damage") -> None:
        """Take in what was found at another time."""
        self.lost |= other.lost
        self.doubled |= other.doubled
        self.half_written |= other.half_written
        self.wrongly_answered |= other.wrongly_answered

    @property
    def sentences(self) -> list[str]:
        """All of it."""
        return sorted(self.lost | self.doubled | self.half_written | self.wrongly_answered)


def book_of(ledger: str | Path) -> Book:
    """Read a ledger as of one moment."""
    with database(ledger) as stranger:
        stranger.execute("BEGIN" if stranger.is_sqlite else "BEGIN ISOLATION LEVEL REPEATABLE READ")
        intents = stranger.rows("SELECT sequence, id, version, state, reference FROM flight_intents ORDER BY sequence")
        holds = stranger.rows('SELECT intent, block, enter, "exit" FROM reservations')
        journal = stranger.rows("SELECT revision, kind, intent FROM journal ORDER BY revision")
        (counters,) = stranger.rows("SELECT sequence, revision FROM counters")
    return Book(
        [Intent(*row) for row in intents],
        in_order(np.array(holds, dtype=np.int64).reshape(-1, 4)),
        [(revision, kind, intent) for revision, kind, intent in journal],
        (counters[0], counters[1]),
    )


def audit(book: Book, told: Told) -> Damage:
    """Compare a ledger with what operators were told while nobody writes."""
    damage = Damage()
    _check_whole(book, damage)
    by_id = {intent.id: intent for intent in book.intents}
    by_reference = defaultdict(list)
    for intent in book.intents:
        by_reference[intent.reference].append(intent)
    damage.doubled |= {f"{name}: recorded {len(same)} times" for name, same in by_reference.items() if len(same) > 1}
    held = _by_intent(book)
    for reference, receipt in told.accepted.items():
        _check_receipt(reference, receipt, by_id.get(receipt.id), held, told, damage)
    for reference, id_ in told.rejected.items():
        if id_ not in by_id or by_id[id_].state != "rejected" or by_id[id_].reference != reference:
            damage.lost.add(f"{reference}: the recorded refusal {id_} is not there")
    for reference, said in told.unrecorded.items():
        if reference in by_reference:
            damage.wrongly_answered.add(f"{reference}: answered {said!r}, but it was recorded")
    damage.wrongly_answered |= set(told.unexpected)
    return damage


def _check_receipt(
    reference: str, receipt: Receipt, intent: Intent | None, held: dict[int, IntArray], told: Told, damage: Damage
) -> None:
    if intent is None:
        damage.lost.add(f"{reference}: the accepted intent {receipt.id} is not there")
        return
    if (intent.reference, intent.sequence) != (reference, receipt.sequence):
        damage.lost.add(f"{reference}: sequence {receipt.sequence} was answered, {intent} is there")
    accepted = intent.state == "accepted" and intent.version == receipt.version
    if reference in told.cancelled and intent.state != "cancelled":
        damage.lost.add(f"{reference}: its cancellation is not there")
    elif reference not in told.cancelled | told.perhaps_cancelled and not accepted:
        damage.lost.add(f"{reference}: version {receipt.version} was accepted, {intent} is there")
    if accepted and held.get(intent.sequence, _NONE).tobytes() != receipt.holds.tobytes():
        damage.half_written.add(f"{reference}: not the reservations that were answered")


def _check_whole(book: Book, damage: Damage) -> None:
    """Check what holds of every ledger, whoever was told what."""
    sequences = [intent.sequence for intent in book.intents]
    revisions = [revision for revision, *_ in book.journal]
    for name, numbers in (("sequence", sequences), ("revision", revisions)):
        if numbers != list(range(1, len(numbers) + 1)):
            damage.half_written.add(f"{name}s have gaps")
    if book.counters != (len(sequences), len(revisions)):
        damage.half_written.add(f"the counters say {book.counters}, there are {len(sequences), len(revisions)}")
    newest = {intent: (kind, revision) for revision, kind, intent in book.journal}
    counts = Counter(book.holds[:, 0].tolist())
    for intent in book.intents:
        if newest.get(intent.sequence) != (intent.state, intent.version):
            damage.half_written.add(f"{intent}: the journal says {newest.get(intent.sequence)}")
        held = counts.pop(intent.sequence, 0)
        # A flight that was cancelled in the air keeps them.
        if (intent.state == "accepted" and not held) or (intent.state == "rejected" and held):
            damage.half_written.add(f"{intent} holds {held} reservations")
    damage.half_written |= {f"{count} reservations of {intent}, which is no intent" for intent, count in counts.items()}
    block, enter, leave = in_order(book.holds[:, 1:]).T
    for at in np.flatnonzero((block[1:] == block[:-1]) & (enter[1:] < leave[:-1])).tolist():
        damage.doubled.add(f"block {block[at]} is reserved twice from {enter[at + 1]}")


_NONE = np.empty((0, 3), dtype=np.int64)


def _by_intent(book: Book) -> dict[int, IntArray]:
    """Return the holds of each intent that has any."""
    owners, first = np.unique(book.holds[:, 0], return_index=True)
    ends = [*first.tolist(), len(book.holds)]
    spans = pairwise(ends)
    return {owner: book.holds[start:end, 1:] for owner, (start, end) in zip(owners.tolist(), spans, strict=True)}
