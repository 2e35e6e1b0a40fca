"""Operators at work: clients that each wait for an answer before they ask again, and keep all that they are told."""

import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

import httpx
import numpy as np
import orjson

from planner.airmatrix import IntArray
from tests.faults.traffic import Request, city

_FLIGHT_INTENTS = "/v1/flight-intents"
_PATIENCE_S = 30.0
# After a refusal or a lost connection; the service asks for a second, which an impatient client does not give it.
_PAUSE_S = 0.02
_NOTHING_RECORDED = ("queue-full", "ledger-unavailable", "not-plannable")


@dataclass(frozen=True, eq=False)
class Receipt:
    """A 201: `holds` (n, 3) are block, enter, exit of its reservations, sorted."""

    id: str
    sequence: int
    version: int
    holds: IntArray


@dataclass
class Told:
    """What operators were told, by the references of their requests; `seconds` are those of answers, by status."""

    accepted: dict[str, Receipt] = field(default_factory=dict)
    rejected: dict[str, str] = field(default_factory=dict)
    unrecorded: dict[str, str] = field(default_factory=dict)
    # No answer, or one that says itself that nobody knows.
    unknown: dict[str, Request] = field(default_factory=dict)
    # Asked again with the same key: "nothing was recorded" then speaks of the repetition only.
    repeated: set[str] = field(default_factory=set)
    cancelled: set[str] = field(default_factory=set)
    perhaps_cancelled: set[str] = field(default_factory=set)
    unexpected: list[str] = field(default_factory=list)
    slugs: Counter[str] = field(default_factory=Counter)
    seconds: defaultdict[int, list[float]] = field(default_factory=lambda: defaultdict(list))

    def add(self, other: "Told") -> None:
        """Take in what was told about other requests."""
        self.accepted |= other.accepted
        self.rejected |= other.rejected
        self.unrecorded |= other.unrecorded
        self.unknown |= other.unknown
        self.repeated |= other.repeated
        self.cancelled |= other.cancelled
        self.perhaps_cancelled |= other.perhaps_cancelled
        self.unexpected += other.unexpected

    def problems(self, slug: str) -> int:
        """Return how many requests were answered with this problem."""
        return self.slugs[slug]


class Operators:
    """So many clients of one service; at work as long as the context lasts, or until the requests end."""

    def __init__(self, url: str, requests: Iterator[Request], told: Told, clients: int) -> None:
        self._url = url
        self._requests = requests
        self._told = told
        self._next = threading.Lock()
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._work, daemon=True) for _ in range(clients)]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self.wait()

    def wait(self) -> None:
        """Wait until the requests end."""
        for thread in self._threads:
            thread.join()

    def _work(self) -> None:
        # Without the certificates of half the world, whose loading takes as long as ten requests.
        with httpx.Client(base_url=self._url, timeout=_PATIENCE_S, verify=False) as http:  # noqa: S501
            while not self._stop.is_set():
                with self._next:
                    request = next(self._requests, None)
                if request is None:
                    return
                if not self._ask(http, request):
                    self._stop.wait(_PAUSE_S)

    def _ask(self, http: httpx.Client, request: Request) -> bool:
        """Submit a flight, keep the answer, cancel it if it is one of those; return whether it was decided."""
        headers = {"Content-Type": "application/json", "Idempotency-Key": request.reference}
        began = time.perf_counter()
        try:
            answer = http.post(_FLIGHT_INTENTS, content=request.body, headers=headers)
        except httpx.ConnectError:
            self._told.unrecorded[request.reference] = "no connection"
            return False
        except httpx.TransportError:
            self._told.unknown[request.reference] = request
            return False
        self._told.seconds[answer.status_code].append(time.perf_counter() - began)
        self._keep(request, answer)
        receipt = self._told.accepted.get(request.reference)
        if receipt is not None and request.is_cancelled:
            self._cancel(http, request.reference, receipt)
        return answer.status_code in (201, 409)

    def _keep(self, request: Request, answer: httpx.Response) -> None:
        body: dict[str, Any] = orjson.loads(answer.content)
        slug = str(body.get("type", "")).removeprefix("/problems/")
        self._told.slugs[slug] += 1
        if answer.status_code == 201:
            self._told.accepted[request.reference] = _receipt(body)
        elif answer.status_code == 409 and "flight_intent_id" in body:
            self._told.rejected[request.reference] = body["flight_intent_id"]
        elif slug == "outcome-unknown" or (slug in _NOTHING_RECORDED and request.reference in self._told.repeated):
            self._told.unknown[request.reference] = request
        elif slug in _NOTHING_RECORDED and (answer.status_code != 503 or "Retry-After" in answer.headers):
            self._told.unrecorded[request.reference] = f"{slug}: {body['detail']}"
        else:
            self._told.unexpected.append(f"{request.reference}: {answer.status_code} {answer.text[:200]}")

    def _cancel(self, http: httpx.Client, reference: str, receipt: Receipt) -> None:
        try:
            answer = http.delete(f"{_FLIGHT_INTENTS}/{receipt.id}")
        except httpx.ConnectError:
            return
        except httpx.TransportError:
            self._told.perhaps_cancelled.add(reference)
            return
        slug = "" if answer.is_success else answer.json()["type"].removeprefix("/problems/")
        if answer.is_success:
            self._told.cancelled.add(reference)
        elif slug == "outcome-unknown":
            self._told.perhaps_cancelled.add(reference)
        elif slug not in _NOTHING_RECORDED:
            self._told.unexpected.append(f"cancelling {reference}: {answer.status_code} {answer.text[:200]}")


def again(told: Told) -> Iterator[Request]:
    """Yield the requests of unknown outcome, to be asked again with the same keys."""
    while told.unknown:
        reference, request = told.unknown.popitem()
        told.repeated.add(reference)
        yield request


def _receipt(body: dict[str, Any]) -> Receipt:
    held = body["reservations"]
    grid = city().grid
    block = [grid.index(hold["block"]) for hold in held]
    enter, leave = (
        np.array([hold[end].removesuffix("Z") for hold in held], dtype="datetime64[ms]").astype(np.int64)
        for end in ("enter", "exit")
    )
    holds = np.stack([np.array(block, dtype=np.int64), enter, leave], axis=-1)
    return Receipt(body["id"], body["sequence"], int(body["version"]), in_order(holds))


def in_order(holds: IntArray) -> IntArray:
    """Return rows sorted by their columns, the first first."""
    ordered: IntArray = holds[np.lexsort(holds.T[::-1])]
    return ordered
