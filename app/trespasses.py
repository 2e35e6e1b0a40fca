"""Flights that hold closed airspace and should not: they were planned when it was closed, or could have made way.

For `airmatrix verify`: from what the ledger holds and its journal, as far as that reaches back, with none of the code
that plans. What nobody can tell is no fault.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from app.constraints import Constraint
from app.flight_intents import FlightIntent, State
from app.ledger import JournalEntry, Snapshot
from app.ledger.constraints import CREATED

# The notice that operators have before a flight is moved is no longer than that (`app.settings`).
_LONGEST_NOTICE_MS = 86_400_000
_EVER_MS = 1 << 62
_STATES = frozenset(State)

_Place = tuple[int, int]
_Span = tuple[int, int]


class Overlap(NamedTuple):
    """A hold of a flight in a block of a constraint, for as long as that is in force meanwhile: [from, to)."""

    intent: FlightIntent
    constraint: Constraint
    block: int
    from_ms: int
    to_ms: int


class Trespass(NamedTuple):
    """The first overlap of a flight and a constraint that should not be, and why it should not."""

    overlap: Overlap
    reason: str


@dataclass(frozen=True, eq=False)
class _Records:
    """What the journal tells of flights, by sequence number, and of constraints, by id.

    `settled`: all that was recorded in a constraint's revision. The journal has nothing up to `removed_through`.
    """

    flights: Mapping[int, Sequence[JournalEntry]]
    created: Mapping[str, JournalEntry]
    removed: Mapping[str, JournalEntry]
    settled: Mapping[str, Sequence[JournalEntry]]
    removed_through: int

    @classmethod
    def of(cls, snapshot: Snapshot, found: Sequence[Overlap]) -> "_Records":
        """Read what there is of some overlaps."""
        flights: dict[int, list[JournalEntry]] = defaultdict(list)
        for entry in snapshot.journal_of_intents(overlap.intent.sequence for overlap in found):
            flights[entry.sequence].append(entry)
        hit = {overlap.constraint.id for overlap in found}
        created: dict[str, JournalEntry] = {}
        removed: dict[str, JournalEntry] = {}
        for entry in snapshot.journal_of_constraints():
            if (constraint_id := entry.details["constraint_id"]) in hit:
                (created if entry.kind == CREATED else removed)[constraint_id] = entry
        settled = {id_: snapshot.journal_at(entry.revision) for id_, entry in created.items()}
        return cls(flights, created, removed, settled, snapshot.journal_removed())


def trespasses(snapshot: Snapshot, intents: Sequence[FlightIntent]) -> list[Trespass]:
    """Return for each flight of all and each constraint the first overlap that should not be, if there is one."""
    found = list(_overlaps(intents, snapshot.constraints()))
    records = _Records.of(snapshot, found)
    faults: dict[tuple[int, int], Trespass] = {}
    for overlap in found:
        key = overlap.intent.sequence, overlap.constraint.number
        if key not in faults and (reason := _fault(overlap, records)) is not None:
            faults[key] = Trespass(overlap, reason)
    return list(faults.values())


def _overlaps(intents: Sequence[FlightIntent], constraints: Iterable[Constraint]) -> Iterator[Overlap]:
    """Yield what flights hold of constraints while these are in force, by constraint, then by enter."""
    none = np.empty(0, dtype=np.int64)
    owner = np.repeat(np.arange(len(intents)), [len(intent.reservations) for intent in intents])
    block = np.concatenate([none, *(intent.reservations.block for intent in intents)])
    enter_ms = np.concatenate([none, *(intent.reservations.enter_ms for intent in intents)])
    exit_ms = np.concatenate([none, *(intent.reservations.exit_ms for intent in intents)])
    for constraint in constraints:
        begins_ms = max(constraint.created_ms, constraint.from_ms)
        ends_ms = min(_or_ever(constraint.until_ms), _or_ever(constraint.removed_ms))
        meanwhile = np.flatnonzero((enter_ms < ends_ms) & (exit_ms > begins_ms) & (begins_ms < ends_ms))
        within = meanwhile[constraint.covers(block[meanwhile])]
        for hold in within[np.argsort(enter_ms[within], kind="stable")].tolist():
            span = max(begins_ms, int(enter_ms[hold])), min(ends_ms, int(exit_ms[hold]))
            yield Overlap(intents[owner[hold]], constraint, int(block[hold]), *span)


def _fault(overlap: Overlap, records: _Records) -> str | None:
    """Return why a flight should not hold this, None where it may or nobody can tell.

    A flight is judged by its newest plan; what it had before a change in the air, and kept, by the plan before that.
    """
    constraint, entries = overlap.constraint, records.flights.get(overlap.intent.sequence, ())
    created, removed = records.created.get(constraint.id), records.removed.get(constraint.id)
    if created is None and not records.removed_through:
        return None
    # What the journal has no more was before all that it has.
    closed = (records.removed_through, 0) if created is None else _place(created)
    spans = [(overlap.from_ms, overlap.to_ms)]
    for plan in reversed([entry for entry in entries if _is_plan(entry)]):
        if _place(plan) < closed:
            could_move = created is not None and _could_move(overlap, created, entries, records.settled[constraint.id])
            return "it could have made way for the constraint" if could_move else None
        kept = _kept(plan, overlap.block)
        is_closed = removed is None or _place(plan) < _place(removed)
        if is_closed and _without(_within(spans, (plan.time_ms, _EVER_MS)), kept):
            return "it was planned after the constraint"
        spans = [part for span in kept for part in _within(spans, span)]
    return None


def _is_plan(entry: JournalEntry) -> bool:
    """Tell whether an entry is of a flight's plan: recorded, or planned again."""
    return entry.kind == State.ACCEPTED or "departure_moved_s" in entry.details


def _kept(plan: JournalEntry, block: int) -> list[_Span]:
    """Return when a flight that was planned again has a block as it had it before, for it may have been in the air."""
    if plan.kind != State.ACTIVATED:
        return []
    had = [(enter, leave) for held, enter, leave in plan.released.tolist() if held == block]
    return [(-_EVER_MS, plan.time_ms), *had]


def _could_move(
    overlap: Overlap, created: JournalEntry, entries: Sequence[JournalEntry], settled: Sequence[JournalEntry]
) -> bool:
    """Tell whether a flight, planned before, surely could have made way for a constraint, and nobody says otherwise."""
    path, hit = overlap.intent.trajectory, [entry for entry in settled if _is_hit(entry, overlap.constraint)]
    if path is None or overlap.intent.sequence in {entry.sequence for entry in hit}:
        return False
    before = [entry for entry in entries if entry.kind in _STATES and _place(entry) < _place(created)]
    # The notice is a setting; but who was moved had it.
    moved = [int(entry.released[:, 1].min()) - created.time_ms for entry in hit if len(entry.released)]
    is_late_enough = path.departure_ms - created.time_ms >= min([_LONGEST_NOTICE_MS, *moved])
    return before[-1].kind == State.ACCEPTED and is_late_enough


def _is_hit(entry: JournalEntry, constraint: Constraint) -> bool:
    """Tell whether an entry is of a flight that had to make way for a constraint, or could not."""
    return entry.sequence > 0 and (entry.details.get("cause") or {}).get("constraint_id") == constraint.id


def _place(entry: JournalEntry) -> _Place:
    return entry.revision, entry.place


def _within(spans: Iterable[_Span], bounds: _Span) -> list[_Span]:
    clipped = ((max(begin, bounds[0]), min(end, bounds[1])) for begin, end in spans)
    return [(begin, end) for begin, end in clipped if begin < end]


def _without(spans: list[_Span], others: Iterable[_Span]) -> list[_Span]:
    for begin, end in others:
        spans = [part for bounds in ((-_EVER_MS, begin), (end, _EVER_MS)) for part in _within(spans, bounds)]
    return spans


def _or_ever(time_ms: int | None) -> int:
    return _EVER_MS if time_ms is None else time_ms
