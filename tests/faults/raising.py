"""The writer's parts raising once, at a random call, before or after they have done their work."""

import random
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import count
from typing import Any
from unittest.mock import patch

from sqlalchemy import Connection
from sqlalchemy.exc import OperationalError

from app.ledger import Ledger, Transaction
from planner.cfa_star import Planner
from planner.occupancy import OccupancyIndex
from tests.faults.audit import audit, book_of
from tests.faults.inside import AIRSPACE, Desk, index_complaints
from tests.faults.verdict import Report, Verdict
from tests.ledger.locations import Ledgers
from tests.ledger.process import FakeClock, Process

_OF_DRIVER = ("begin", "begin_nested", "execute", "exec_driver_sql", "commit", "rollback", "close")
_SPOTS: list[tuple[type, str]] = [
    (owner, name)
    for owner in (Planner, OccupancyIndex, Transaction, Ledger)
    for name, part in vars(owner).items()
    if callable(part) and not name.startswith("_")
] + [(Connection, name) for name in _OF_DRIVER]
_STEPS = 6
_WHICH_CALL = [1, 1, 2, 3, 5]


@dataclass
class Sabotage:
    """One call that raises, and whether it has."""

    owner: type
    name: str
    call: int
    error: Callable[[], Exception]
    when_done: bool
    happened: bool = False

    def __str__(self) -> str:
        when = "after" if self.when_done else "instead of"
        return f"{type(self.error()).__name__} {when} {self.owner.__name__}.{self.name}, call {self.call}"


def raising(ledgers: Ledgers, rounds: int, report: Report, *, seed: int = 7) -> Verdict:
    """Let one part of the writer raise, or two, while flights are asked for: nothing is lost, and it goes on.

    Two processes share the ledger, so that each has to catch up with the other.
    """
    verdict = Verdict("the writer raising")
    planned = happened = 0
    for _ in range(rounds):
        chance = random.Random(seed * 1_000_003 + verdict.rounds)
        desk = Desk(f"round {verdict.rounds}", chance)
        location = ledgers.migrated()
        spots = chance.sample(_SPOTS, 2)
        sabotages = [_sabotage(spot, chance) for spot in spots[: chance.randrange(1, 3)]]
        complaints = _play(desk, location, sabotages)
        damage = audit(book_of(location), desk.told)
        planned += len(sabotages)
        happened += sum(sabotage.happened for sabotage in sabotages)
        causes = " and ".join(map(str, sabotages))
        verdict.broken += [f"{causes}: {complaint}" for complaint in complaints + damage.sentences]
        verdict.damage.add(damage)
        verdict.told.add(desk.told)
        verdict.rounds += 1
        report(verdict.rounds)
    verdict.remarks.append(f"{happened} of {planned} calls came about and raised")
    return verdict


def _sabotage(spot: tuple[type, str], chance: random.Random) -> Sabotage:
    owner, name = spot
    # Each time a new one: an exception keeps alive what its traceback has seen, connections included.
    error = chance.choice([RuntimeError, MemoryError, OSError, _database_is_gone])
    # What holds a connection for ever is not a part that raises.
    when_done = name == "close" or chance.random() < 0.5
    return Sabotage(owner, name, chance.choice(_WHICH_CALL), error, when_done)


def _play(desk: Desk, location: str, sabotages: list[Sabotage]) -> list[str]:
    chance, clock = desk.chance, FakeClock()
    complaints = []
    with Process(location, AIRSPACE, clock) as one, Process(location, AIRSPACE, clock) as other:
        desk.submit(one, *(desk.flight(clock.now_ms) for _ in range(3)))
        with ExitStack() as sabotaged:
            for sabotage in sabotages:
                sabotaged.enter_context(_sabotaged(sabotage))
            for _ in range(_STEPS):
                process = chance.choice([one, one, other])
                desk.submit(process, *(desk.flight(clock.now_ms) for _ in range(chance.choice([1, 1, 3]))))
                desk.cancel_one(process)
                clock.advance(ms=chance.randrange(12_000))
        undecided = len(desk.told.unrecorded)
        for process in (one, other):
            desk.submit_again(process)
            desk.submit(process, desk.flight(clock.now_ms))
            complaints += index_complaints(process, clock.now_ms)
        if len(desk.told.unrecorded) > undecided or desk.told.unknown:
            complaints.append("it does not go on")
    return complaints


def _database_is_gone() -> Exception:
    return OperationalError("statement", {}, Exception("the database is gone"))


@contextmanager
def _sabotaged(sabotage: Sabotage) -> Iterator[None]:
    original, calls = getattr(sabotage.owner, sabotage.name), count(1)

    def call(*arguments: Any, **named: Any) -> Any:
        if next(calls) != sabotage.call:
            return original(*arguments, **named)
        sabotage.happened = True
        if sabotage.when_done:
            original(*arguments, **named)
        raise sabotage.error()

    with patch.object(sabotage.owner, sabotage.name, call):
        yield
