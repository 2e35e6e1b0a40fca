"""A process without HTTP, asked as operators ask, so that its clock and its parts can be made to fail."""

import asyncio
import random
from collections.abc import Coroutine
from dataclasses import replace
from typing import Any

import numpy as np

from app.deconfliction import IdempotencyKey
from app.errors import OutcomeUnknown
from app.flight_intents import FlightIntent, State, Submission
from tests.faults.operators import Receipt, Told, in_order
from tests.faults.traffic import Request
from tests.ledger.district import SQUARE
from tests.ledger.process import Process, reserved

AIRSPACE = SQUARE.airspace
_BLOCKS = [AIRSPACE.grid.block(index) for index in range(AIRSPACE.grid.block_count)]


class Desk:
    """Asks processes for flights over the square, every one with a key, and keeps what they answer."""

    def __init__(self, name: str, chance: random.Random) -> None:
        self.told = Told()
        self._name = name
        self.chance = chance
        self._asked: dict[str, Submission] = {}
        self._accepted: list[FlightIntent] = []

    def flight(self, now_ms: int) -> str:
        """Think of a flight that can wait for a clock set back by ten seconds, and return its reference."""
        reference = f"{self._name}, flight {len(self._asked) + 1}"
        origin, destination = self.chance.sample(_BLOCKS, 2)
        earliest_ms = now_ms + self.chance.randrange(10_000, 60_000)
        window_ms = self.chance.choice([0, 20_000, 300_000])
        submission = SQUARE.submission(origin, destination, earliest_ms=earliest_ms, window_ms=window_ms)
        self._asked[reference] = replace(submission, reference=reference)
        return reference

    def submit(self, process: Process, *references: str) -> list[FlightIntent]:
        """Submit flights at once and return those that were accepted."""
        requests = [process.deconfliction.submit(self._asked[name], _key(name)) for name in references]
        accepted = []
        for reference, answer in zip(references, _answers(requests), strict=True):
            self.told.unknown.pop(reference, None)
            if isinstance(answer, OutcomeUnknown) or (
                isinstance(answer, BaseException) and reference in self.told.repeated
            ):
                self.told.unknown[reference] = Request(reference, b"", is_cancelled=False)
            elif isinstance(answer, BaseException):
                self.told.unrecorded[reference] = repr(answer)
            elif answer.intent.state is State.REJECTED:
                self.told.rejected[reference] = answer.intent.id
            else:
                self.told.accepted[reference] = _receipt(answer.intent)
                accepted.append(answer.intent)
        self._accepted += accepted
        return accepted

    def submit_again(self, process: Process) -> None:
        """Ask for everything of unknown outcome with the same keys."""
        for reference in list(self.told.unknown):
            self.told.repeated.add(reference)
            self.submit(process, reference)

    def cancel_one(self, process: Process) -> None:
        """Cancel one of the accepted flights, if there is any."""
        if not self._accepted:
            return
        intent = self._accepted.pop(self.chance.randrange(len(self._accepted)))
        (answer,) = _answers([process.deconfliction.cancel(intent.id)])
        reference = intent.submission.reference
        assert reference is not None
        if isinstance(answer, OutcomeUnknown):
            self.told.perhaps_cancelled.add(reference)
        elif not isinstance(answer, BaseException):
            self.told.cancelled.add(reference)


def index_complaints(process: Process, now_ms: int) -> list[str]:
    """Compare a process's index with the ledger from a moment on."""
    indexed, booked = process.indexed(now_ms), reserved(process.location, now_ms)
    if indexed == booked:
        return []
    missing, strange = len(booked.items() - indexed.items()), len(indexed.items() - booked.items())
    return [f"the index lacks {missing} reservations of the ledger and has {strange} that are not there"]


def _answers(requests: list[Coroutine[Any, Any, Any]]) -> list[Any]:
    async def together() -> list[Any]:
        return await asyncio.gather(*requests, return_exceptions=True)

    return asyncio.run(together())


def _key(reference: str) -> IdempotencyKey:
    return IdempotencyKey(reference, reference, lambda outcome: outcome.intent.id.encode())


def _receipt(intent: FlightIntent) -> Receipt:
    held = intent.reservations
    holds = np.stack([held.block, held.enter_ms, held.exit_ms], axis=-1)
    return Receipt(intent.id, intent.sequence, intent.version, in_order(holds))
