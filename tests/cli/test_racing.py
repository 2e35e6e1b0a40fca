"""Servers race for the same blocks of one ledger: whoever gets the write lock first flies, and the books stay right."""

import random
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import httpx
import orjson
import pytest

from app.times import now_ms, parse_time
from tests.cli.serving import Server, serving
from tests.cli.town import GRID, along_row, flight
from tests.ledger.locations import Ledgers, database
from tests.ledger.process import assert_gapless, assert_journal_tells_states, assert_no_overlaps

CLIENTS = 8
ROUNDS = 80
# What each client asks for between two rounds, at its own pace.
BETWEEN = 3
# So many rounds, then over another connection, to another process.
CONNECTION = 20
JSON = {"Content-Type": "application/json"}


@dataclass
class Operator:
    """One client, which remembers what it was answered, in order."""

    urls: Sequence[str]
    bodies: list[bytes]
    barrier: threading.Barrier
    accepted: list[dict[str, Any]] = field(default_factory=list)
    sequences: list[int] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)

    def fly(self) -> None:
        """Submit everything; every round together with the others, over connections that do not last."""
        remaining = iter(self.bodies)
        for url in cycle(self.urls):
            part = list(islice(remaining, CONNECTION * (1 + BETWEEN)))
            if not part:
                return
            with httpx.Client(base_url=url, headers=JSON, timeout=30) as http:
                for number, body in enumerate(part):
                    if number % (1 + BETWEEN) == 0:
                        self.barrier.wait(60)
                    self._submit(http, body)

    def _submit(self, http: httpx.Client, body: bytes) -> None:
        answer = http.post("/v1/flight-intents", content=body)
        content = orjson.loads(answer.content)
        self.statuses.append(answer.status_code)
        self.sequences.append(content["sequence"])
        if answer.status_code == 201:
            self.accepted.append(content)


def bodies(seed: int, begin_ms: int) -> Iterator[bytes]:
    """Yield what one client asks for: each round's flight, the same for all, then some of its own."""
    chance = random.Random(seed)
    for number in range(ROUNDS):
        at_ms = begin_ms + 60_000 * number
        yield encoded(along_row(number % 4, 0, at_ms, at_ms))
        for _ in range(BETWEEN):
            # Two layers above the rounds, where everybody crosses everybody's way.
            (i, j), (other_i, other_j) = chance.sample([(0, 0), (9, 9), (0, 9), (9, 0), (5, 0), (0, 5)], 2)
            earliest_ms = begin_ms + chance.randrange(60_000 * ROUNDS)
            yield encoded(flight((i, j, 2), (other_i, other_j, 2), earliest_ms, earliest_ms + 5_000))


def encoded(body: Any) -> bytes:
    return orjson.dumps(body.model_dump(mode="json", exclude_none=True))


def held(intent: dict[str, Any]) -> set[tuple[int, int, int]]:
    """Return an answer's reservations as block, enter, exit."""
    return {
        (GRID.index(tuple(item["block"])), parse_time(item["enter"]), parse_time(item["exit"]))
        for item in intent["reservations"]
    }


@pytest.mark.compiled
def test_servers_that_race_for_the_same_blocks_never_overlap_and_leave_no_gaps(
    ledgers: Ledgers, tmp_path: Path, town_file: Path
) -> None:
    location, begin_ms = ledgers.vacant(), now_ms() + 3_600_000
    options = ("--airspace", str(town_file), "--ledger", location)
    logs = {"AIRMATRIX_LOG_FORMAT": "json"}
    barrier = threading.Barrier(CLIENTS)
    with (
        serving(tmp_path, *options, "--workers", "2", log="several.log", **logs) as several,
        serving(tmp_path, *options, log="single.log", **logs) as single,
        ThreadPoolExecutor(CLIENTS) as threads,
    ):
        operators = [
            Operator([several.url, single.url][:: 1 - 2 * (seed % 2)], list(bodies(seed, begin_ms)), barrier)
            for seed in range(CLIENTS)
        ]
        flying = [threads.submit(operator.fly) for operator in operators]
        with serving(tmp_path, *options, log="late.log", **logs) as late:
            for flown in flying:
                flown.result()
            again = operators[0].bodies[-1 - BETWEEN]
            refusal = httpx.post(f"{late.url}/v1/flight-intents", content=again, headers=JSON)
        shares = [*shares_of(several), *shares_of(single)]
        told = [line for server in (several, single, late) for line in server.entries() if line["level"] != "info"]
    # Of each round's equal flights exactly one is accepted.
    rounds = [operator.statuses[:: 1 + BETWEEN] for operator in operators]
    assert [sorted(together) for together in zip(*rounds, strict=True)] == [[201] + [409] * (CLIENTS - 1)] * ROUNDS
    assert {status for operator in operators for status in operator.statuses} == {201, 409}
    assert refusal.status_code == 409
    # Every index knew what the others had written: the database had nothing to refuse.
    assert told == []
    assert len(shares) == 3
    assert min(shares) >= 100
    assert_ledger_holds(location, operators)


def shares_of(server: Server) -> list[int]:
    """Return how many flight intents each process of a server recorded."""
    writers = [line.get("worker") for line in server.entries("flight intent accepted", "flight intent rejected")]
    return [writers.count(writer) for writer in set(writers)]


def assert_ledger_holds(location: str, operators: list[Operator]) -> None:
    """Fail unless a ledger holds exactly what the operators were answered, and one more refusal."""
    accepted = {intent["sequence"]: intent for operator in operators for intent in operator.accepted}
    answered = [sequence for operator in operators for sequence in operator.sequences]
    with database(location) as connection:
        ids = dict(connection.rows("SELECT sequence, id FROM flight_intents WHERE state = 'accepted'"))
        reservations = connection.rows('SELECT intent, block, enter, "exit" FROM reservations')
        recorded = [row[0] for row in connection.rows("SELECT intent FROM journal ORDER BY revision")]
    assert sorted(answered) == list(range(1, len(answered) + 1))
    assert recorded == list(range(1, len(answered) + 2))
    assert all(operator.sequences == sorted(operator.sequences) for operator in operators)
    assert ids == {sequence: intent["id"] for sequence, intent in accepted.items()}
    assert len(reservations) == sum(len(intent["reservations"]) for intent in accepted.values())
    assert set(reservations) == {(sequence, *hold) for sequence, intent in accepted.items() for hold in held(intent)}
    assert_no_overlaps(location)
    assert_gapless(location)
    assert_journal_tells_states(location)
