"""Clocks that are set forward and back, by seconds, hours and days, and processes that restart in between."""

import random

from tests.faults.audit import audit, book_of
from tests.faults.inside import AIRSPACE, Desk, index_complaints
from tests.faults.verdict import Report, Verdict
from tests.ledger.locations import Ledgers
from tests.ledger.process import FakeClock, Process

_STEPS = 12
_MINUTE_MS, _HOUR_MS, _DAY_MS = 60_000, 3_600_000, 86_400_000
_JUMPS_MS = [1, 500, 9_000, 11_000, _MINUTE_MS, 10 * _MINUTE_MS, _HOUR_MS, _DAY_MS]
# A clock that goes back by less is waited for, and what ended meanwhile may be forgotten.
_WAITED_FOR_MS = 10_000


def clock_steps(ledgers: Ledgers, rounds: int, report: Report, *, seed: int = 6) -> Verdict:
    """Let two processes share a ledger; the clock of one is set forward and back, and it may restart at any time.

    Each is asked for flights a little ahead of its own clock: it must decide on them all, let nobody depart before
    that clock, and have in its index what the ledger holds.
    """
    verdict = Verdict("clock steps")
    for _ in range(rounds):
        desk = Desk(f"round {verdict.rounds}", random.Random(seed * 1_000_003 + verdict.rounds))
        location = ledgers.migrated()
        verdict.broken += _play(desk, location)
        verdict.damage.add(audit(book_of(location), desk.told))
        verdict.told.add(desk.told)
        verdict.rounds += 1
        report(verdict.rounds)
    return verdict


def _play(desk: Desk, location: str) -> list[str]:
    chance, right, wrong = desk.chance, FakeClock(), FakeClock()
    complaints: list[str] = []
    with Process(location, AIRSPACE, right) as steady:
        stepped = Process(location, AIRSPACE, wrong)
        try:
            for _ in range(_STEPS):
                right.advance(ms=chance.randrange(20_000))
                wrong.now_ms = right.now_ms if chance.random() < 0.3 else wrong.now_ms + _jump(chance)
                if chance.random() < 0.2:
                    stepped.__exit__(None, None, None)
                    stepped = Process(location, AIRSPACE, wrong)
                for process, clock in ((stepped, wrong), (steady, right)):
                    complaints += _fly(desk, process, clock.now_ms)
        finally:
            stepped.__exit__(None, None, None)
    return complaints + [f"undecided: {said}" for said in desk.told.unrecorded.values()]


def _jump(chance: random.Random) -> int:
    return chance.choice(_JUMPS_MS) * chance.choice([-1, 1])


def _fly(desk: Desk, process: Process, now_ms: int) -> list[str]:
    accepted = desk.submit(process, *(desk.flight(now_ms) for _ in range(desk.chance.randrange(1, 4))))
    complaints = [
        f"{intent.submission.reference} departs {now_ms - intent.trajectory.departure_ms} ms ago"
        for intent in accepted
        if intent.trajectory is not None and intent.trajectory.departure_ms < now_ms
    ]
    if desk.chance.random() < 0.3:
        desk.cancel_one(process)
    return complaints + index_complaints(process, now_ms + _WAITED_FOR_MS)
