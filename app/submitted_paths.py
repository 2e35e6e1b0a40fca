"""Why an operator's own path was refused: exactly where others are in its way, and a plan of ours that would do."""

from dataclasses import dataclass, fields

from app.flight_intents import Refusal
from app.ledger import Transaction
from planner.path import Plan
from planner.submitted import PathConflicts


@dataclass(frozen=True)
class NamedConflict:
    """A block (flat index) that another flight has, or a constraint closes, in [enter, exit), ms."""

    block: int
    enter_ms: int
    exit_ms: int
    flight_intent_id: str | None
    constraint_id: str | None


@dataclass(frozen=True)
class PathRefusal(Refusal):
    """A refusal with the first conflicts of a path, how many there are, and a plan from the path's first to its last
    block that would do, for which the flights `displaces` would have to make way. The ledger keeps the refusal only.
    """

    conflicts: tuple[NamedConflict, ...] = ()
    conflict_count: int = 0
    proposal: Plan | None = None
    displaces: tuple[str, ...] = ()


def path_refusal(base: Refusal, error: PathConflicts, transaction: Transaction) -> PathRefusal:
    """Return a refusal with what the error says, in ids."""
    found = error.found.first
    flights = transaction.ids({conflict.owner for conflict in found if conflict.owner > 0} | set(error.moves))
    numbers = sorted({-conflict.owner for conflict in found if conflict.owner < 0})
    closed = dict(zip(numbers, transaction.constraint_ids(numbers), strict=True))
    return PathRefusal(
        **{field.name: getattr(base, field.name) for field in fields(Refusal)},
        conflicts=tuple(
            NamedConflict(
                conflict.block,
                conflict.enter_ms,
                conflict.exit_ms,
                flights.get(conflict.owner),
                closed.get(-conflict.owner),
            )
            for conflict in found
        ),
        conflict_count=error.found.count,
        proposal=error.proposal,
        displaces=tuple(flights[sequence] for sequence in error.moves if sequence in flights),
    )
