"""Pilots of a service's accepted flights: they activate them, fly them, and report where their aircraft are.

Two threads share the work. `Dispatch` follows the journal and tells the operator's part; `Pilots` sends all positions
of a tick, in the caller's thread. Nothing is queued: while an answer is awaited, ticks pass and are counted.
"""

import heapq
import threading
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from itertools import count
from queue import Empty, SimpleQueue
from typing import Any, Protocol, TypeVar

import numpy as np

from app.client import Client, ProblemAnswer, ServiceUnreachable
from app.commands.deviations import Deviations, Flown
from app.commands.flight_model import Way, places, planned_way
from app.constraints import UNMOVED
from app.flight_intents import OPEN_STATES, State
from app.routes.answers import FlightIntentAnswer
from app.routes.events import Event
from app.times import format_time
from planner.airmatrix import AirMatrix

T = TypeVar("T")

# A request takes as many positions as this.
_BATCH = 5_000
# So long before its departure an aircraft reports from its pad, and its flight is activated; in the service's time.
_BEFORE_MS = 10_000
# Where a clock has gone back by more, it was set.
_SET_BACK_MS = 60_000
_POLL_S = 1.0
_GLANCE_S = 0.25
_RECONNECT_S = 0.5
_READ_CLOCK_S = 10.0


class ServiceTime:
    """The clock of a service, as it was last read; never ahead of it."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self.read()

    def read(self) -> None:
        """Read the service's clock; raises `ClientError`."""
        clock = self._client.alerts().clock
        # The clock was read before its answer arrived.
        self._read = (clock.now, clock.rate, time.monotonic())

    @property
    def rate(self) -> float:
        """Seconds of the service's time a second."""
        return self._read[1]

    def now(self) -> int:
        """Return the service's time."""
        then_ms, rate, read_s = self._read
        return then_ms + int((time.monotonic() - read_s) * rate * 1000)

    def seconds_until(self, time_ms: int) -> float:
        """Return how long it takes until then, 0 if it has passed."""
        return max(time_ms - self.now(), 0) / 1000 / self.rate


@dataclass(frozen=True, eq=False)
class Aircraft:
    """An aircraft of a flight intent or, where `is_track`, one that is only seen by surveillance."""

    id: str
    flown: Flown
    from_ms: int
    is_track: bool = False

    @property
    def way(self) -> Way:
        """Where it is."""
        return self.flown.way

    def is_airborne(self, time_ms: int) -> bool:
        """Tell whether it flies."""
        return self.way.begin_ms <= time_ms < self.way.end_ms

    def has_arrived(self, time_ms: int) -> bool:
        """Tell whether its way is over."""
        return time_ms >= self.way.end_ms


@dataclass(eq=False)
class Report:
    """What has been measured so far: of the service, and of what was flown."""

    accepted: int = 0
    most_at_once: int = 0
    in_air: int = 0
    most_in_air: int = 0
    arrived: int = 0
    skipped: int = 0
    latency_ms: "array[float]" = field(default_factory=lambda: array("d"))
    refused: Counter[str] = field(default_factory=Counter)
    flagged: Counter[str] = field(default_factory=Counter)
    unanswered: Counter[str] = field(default_factory=Counter)
    deviating: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0


class Works(Protocol):
    """Something to be done in a thread of its own."""

    def work(self) -> None:
        """Do it until told to stop."""

    def stop(self) -> None:
        """Let `work` return."""


@contextmanager
def at_work(worker: Works) -> Iterator[Future[None]]:
    """Let somebody work while the block runs, and wait for the end; what is yielded knows if it came early, and why."""
    with ThreadPoolExecutor(1) as pool:
        try:
            yield pool.submit(worker.work)
        finally:
            worker.stop()


class Dispatch:
    """Knows the flights, and does what their operators do: activates each, and ends what is never heard of again."""

    def __init__(
        self, client: Client, clock: ServiceTime, grid: AirMatrix, deviations: Deviations, operator: str | None
    ) -> None:
        self._client = client
        self._clock = clock
        self._grid = grid
        self._deviations = deviations
        self._operator = operator
        self._numbers: dict[str, int] = {}
        self._due: list[tuple[int, int, Callable[[str], object], str]] = []
        self._order = count()
        self._over = threading.Event()
        # Aircraft that are to fly, in place of what had that id before; None: the flight does not take place.
        self.found: SimpleQueue[tuple[str, Aircraft | None]] = SimpleQueue()
        self.refused: Counter[str] = Counter()
        # Before the list, so that nothing falls between the two.
        self._revision = client.readiness().revision
        for intent in client.flight_intents(operator=operator, from_ms=clock.now()):
            self._take(intent)

    def work(self) -> None:
        """Follow the journal and do what is due, until told to stop; raises `ClientError` for no AirMatrix."""
        next_poll = next_reading = time.monotonic()
        while not self._over.is_set():
            try:
                if time.monotonic() >= next_reading:
                    self._clock.read()
                    next_reading = time.monotonic() + _READ_CLOCK_S
                if time.monotonic() >= next_poll:
                    self._follow()
                    next_poll = time.monotonic() + _POLL_S
                self._do_what_is_due()
            except ServiceUnreachable:
                # The reports tell.
                self._over.wait(_RECONNECT_S)
                continue
            except ProblemAnswer as problem:
                self.refused[problem.reason] += 1
                self._over.wait(_RECONNECT_S)
                continue
            wait_s = next_poll - time.monotonic()
            if self._due:
                wait_s = min(wait_s, self._clock.seconds_until(self._due[0][0]))
            self._over.wait(max(wait_s, 0.0))

    def stop(self) -> None:
        """Let `work` return."""
        self._over.set()

    def _follow(self) -> None:
        """Take up the flights that were accepted or planned again since, and let go of those that have no place now."""
        while not self._over.is_set():
            page = self._client.events(self._revision)
            for event in page.items:
                # Who fails among the events of one revision reads all of them again.
                self._revision = event.revision - 1
                self._heed(event)
            if page.items:
                self._revision = page.items[-1].revision
            if page.next_cursor is None:
                return

    def _heed(self, event: Event) -> None:
        id_ = event.flight_intent_id
        if id_ is None:
            return
        if event.kind in (State.CANCELLED, State.DISPLACED):
            self._forget_what_is_due(id_)
            self.found.put((id_, None))
        elif (event.kind == State.ACCEPTED and id_ not in self._numbers) or (event.details and event.kind != UNMOVED):
            # Otherwise only what was planned again has details.
            self._forget_what_is_due(id_)
            self._read(id_)

    def _read(self, id_: str) -> None:
        try:
            intent = self._client.flight_intent(id_)
        except ProblemAnswer as problem:
            if problem.status == HTTPStatus.SERVICE_UNAVAILABLE:
                raise
            # It may have been removed by now.
            self.refused[f"flight intent: {problem.reason}"] += 1
            return
        if self._operator in (None, intent.operator):
            self._take(intent)

    def _take(self, intent: FlightIntentAnswer) -> None:
        if intent.state not in OPEN_STATES or not intent.trajectory:
            return
        blocks, arrive_ms, depart_ms = zip(
            *((self._grid.index(point.block), point.arrive, point.depart) for point in intent.trajectory), strict=True
        )
        plan = planned_way(self._grid.centres(np.array(blocks)), np.array(arrive_ms), np.array(depart_ms))
        number = self._numbers.setdefault(intent.id, len(self._numbers))
        flown = self._deviations.of(plan, intent.sequence, number, self._grid)
        # Who departs late stands on its pad for longer.
        self._put(Aircraft(intent.id, flown, plan.begin_ms - _BEFORE_MS))
        if flown.intruder is not None:
            crossing = Flown(flown.intruder)
            self._put(Aircraft(f"intruder-{intent.sequence}", crossing, crossing.way.begin_ms, is_track=True))
        if intent.state == State.ACCEPTED:
            self._plan(flown.way.begin_ms - _BEFORE_MS, self._client.activate, intent.id)
        if flown.is_lost_for_good:
            self._plan(flown.way.end_ms, self._client.end, intent.id)

    def _put(self, aircraft: Aircraft) -> None:
        self.found.put((aircraft.id, aircraft))

    def _forget_what_is_due(self, id_: str) -> None:
        self._due = [entry for entry in self._due if entry[3] != id_]
        heapq.heapify(self._due)

    def _plan(self, time_ms: int, what: Callable[[str], object], id_: str) -> None:
        heapq.heappush(self._due, (time_ms, next(self._order), what, id_))

    def _do_what_is_due(self) -> None:
        while self._due and self._due[0][0] <= self._clock.now() and not self._over.is_set():
            _, _, what, id_ = self._due[0]
            try:
                what(id_)
            except ProblemAnswer as problem:
                # What is only busy is asked again.
                if problem.status == HTTPStatus.SERVICE_UNAVAILABLE:
                    raise
                self.refused[f"activate or end: {problem.reason}"] += 1
            heapq.heappop(self._due)


class Pilots:
    """Fly what `Dispatch` finds, and report all positions once an interval of the service's time."""

    def __init__(
        self, client: Client, clock: ServiceTime, grid: AirMatrix, dispatch: Dispatch, interval_s: float
    ) -> None:
        self._client = client
        self._clock = clock
        self._grid = grid
        self._dispatch = dispatch
        self._interval_ms = max(int(interval_s * 1000), 1)
        self._queue: list[tuple[int, int, Aircraft]] = []
        self._waiting: dict[str, Aircraft] = {}
        self._order = count()
        self._flying: dict[str, Aircraft] = {}
        self._last_ms = clock.now()
        self.report = Report()

    @property
    def unfinished(self) -> int:
        """How many aircraft fly or will."""
        return len(self._waiting) + len(self._flying)

    def fly(self, is_over: Callable[[], bool], watch: Callable[[Report], None] = lambda _: None) -> None:
        """Fly until it is over; `watch` is shown the report after every tick. Raises `ClientError` for no AirMatrix."""
        began = time.perf_counter()
        try:
            with at_work(self._dispatch) as dispatching:
                while True:
                    self._take_up()
                    self.report.seconds = time.perf_counter() - began
                    watch(self.report)
                    if is_over():
                        return
                    if dispatching.done():
                        dispatching.result()
                    due = self._next_tick()
                    wait_s = self._clock.seconds_until(due)
                    time.sleep(min(wait_s, _GLANCE_S))
                    if wait_s <= _GLANCE_S:
                        self._tick(due)
        finally:
            self.report.refused += self._dispatch.refused

    def _next_tick(self) -> int:
        """Return the next multiple of the interval; where some have passed since the last, the newest of them."""
        now = self._clock.now()
        if now < self._last_ms - _SET_BACK_MS:
            self._last_ms = now
        return max(self._last_ms // self._interval_ms + 1, now // self._interval_ms) * self._interval_ms

    def _take_up(self) -> None:
        for id_, aircraft in _taken(self._dispatch.found):
            flying = self._flying.get(id_)
            if aircraft is None:
                self._waiting.pop(id_, None)
                if flying is not None and self._last_ms < flying.way.begin_ms:
                    del self._flying[id_]
            elif flying is not None:
                # In the air too: a new plan begins with what was flown of the old one.
                self._flying[id_] = aircraft
            else:
                self._waiting[id_] = aircraft
                heapq.heappush(self._queue, (aircraft.from_ms, next(self._order), aircraft))

    def _tick(self, time_ms: int) -> None:
        """Report where everybody is."""
        self.report.skipped += (time_ms - self._last_ms - 1) // self._interval_ms
        self._last_ms = time_ms
        while self._queue and self._queue[0][0] <= time_ms:
            aircraft = heapq.heappop(self._queue)[2]
            # Meanwhile it may have been planned again, or withdrawn.
            if self._waiting.get(aircraft.id) is not aircraft:
                continue
            del self._waiting[aircraft.id]
            self._flying[aircraft.id] = aircraft
            if aircraft.flown.kind is not None:
                self.report.deviating[aircraft.flown.kind.value] += 1
        heard = [aircraft for aircraft in self._flying.values() if aircraft.flown.is_heard(time_ms)]
        positions = self._positions(heard, time_ms)
        self.report.most_at_once = max(self.report.most_at_once, len(positions))
        told: set[str] = set()
        for start in range(0, len(heard), _BATCH):
            batch = slice(start, start + _BATCH)
            if self._send(positions[batch]):
                told.update(aircraft.id for aircraft in heard[batch])
        # Whoever has arrived goes once that was told.
        gone = [
            aircraft
            for aircraft in self._flying.values()
            if aircraft.has_arrived(time_ms) and (aircraft.id in told or aircraft.flown.is_lost_for_good)
        ]
        for aircraft in gone:
            del self._flying[aircraft.id]
        self.report.arrived += sum(not aircraft.is_track for aircraft in gone)
        self.report.in_air = sum(aircraft.is_airborne(time_ms) for aircraft in self._flying.values())
        self.report.most_in_air = max(self.report.most_in_air, self.report.in_air)

    def _send(self, positions: list[dict[str, Any]]) -> bool:
        """Send positions, and tell whether they were answered for."""
        began = time.perf_counter()
        try:
            answer = self._client.telemetry(positions)
        except ProblemAnswer as problem:
            self.report.refused[problem.reason] += len(positions)
            return False
        except ServiceUnreachable as error:
            self.report.unanswered[str(error)] += 1
            time.sleep(_RECONNECT_S)
            return False
        self.report.latency_ms.append((time.perf_counter() - began) * 1000)
        self.report.accepted += answer.accepted
        self.report.refused.update(problem.type.rpartition("/")[2] for problem in answer.problems)
        self.report.flagged.update(flagged.flag for flagged in answer.flagged)
        return True

    def _positions(self, heard: list[Aircraft], time_ms: int) -> list[dict[str, Any]]:
        x, y, alt_m = places([aircraft.way for aircraft in heard], time_ms).T
        lon, lat = self._grid.unproject(x, y)
        columns = zip(
            heard, np.round(lon, 9).tolist(), np.round(lat, 9).tolist(), np.round(alt_m, 3).tolist(), strict=True
        )
        at = format_time(time_ms)
        return [
            {
                "track_id" if aircraft.is_track else "flight_intent_id": aircraft.id,
                "time": at, "lon": lon, "lat": lat, "alt_m": alt_m, "airborne": aircraft.is_airborne(time_ms),
            }
            for aircraft, lon, lat, alt_m in columns
        ]  # fmt: skip


def _taken(waiting: "SimpleQueue[T]") -> Iterator[T]:
    """Yield what waits in a queue."""
    with suppress(Empty):
        while True:
            yield waiting.get_nowait()
