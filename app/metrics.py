"""What Prometheus reads: counts and seconds of HTTP requests, batches and plans; sizes of queue and index.

Several workers of one server add up: each keeps its values in files of the folder that PROMETHEUS_MULTIPROC_DIR names
when this module is imported, and whichever is asked answers for all.
"""

import os
from collections.abc import Iterable, Iterator

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    disable_created_metrics,
    generate_latest,
)
from prometheus_client.multiprocess import MultiProcessCollector, mark_process_dead

from app import problems
from app.deconfliction import Moved, Outcome, PreviewPlan, Recorded
from app.errors import PositionRefused
from app.flight_intents import FlightIntent, Refusal, State
from app.ledger import CommitUncertain
from app.webhook_delivery import OUTCOMES
from app.writer import BATCH_REQUESTS, BatchReport
from planner.errors import NoPlan, NotPlannable, PathRefused

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
# Paths without a route of the API, and methods that HTTP does not know: any client can think of more.
OTHER = "other"

_FOLDER = os.environ.get("PROMETHEUS_MULTIPROC_DIR")
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
_SECONDS = (0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
_SIZES = [2**power for power in range(BATCH_REQUESTS.bit_length())]
_OUTCOMES = ("accepted", "rejected", "cancelled", "activated", "ended", "replayed", "previewed")
# States that a flight moves to by itself.
_MOVES = (State.ACTIVATED, State.NONCONFORMING, State.CONTINGENT, State.ENDED)
_ACCEPTED = "accepted"
_POSITIONS = (
    _ACCEPTED,
    *(
        problems.KINDS[kind].slug
        for kind in (PositionRefused, *PositionRefused.__subclasses__())
        if kind in problems.KINDS
    ),
)
_COMMIT_UNCERTAIN, _BATCH_FAILED = "commit_uncertain", "batch_failed"


def _reasons(base: type[NotPlannable] | type[PathRefused] | type[NoPlan]) -> set[str]:
    """Return the reasons of all errors of a kind, but for those that are a kind of their own."""
    own = {base.reason} if "reason" in vars(base) else set()
    return own.union(*(_reasons(error) for error in base.__subclasses__() if error not in problems.KINDS))


_REASONS = {problems.KINDS[base].slug: sorted(_reasons(base)) for base in (NotPlannable, PathRefused, NoPlan)}

# Without this, every counter has a twin with the time of its creation.
disable_created_metrics()  # type: ignore[no-untyped-call]


class Metrics:
    """The metrics of one service. What can be counted is there from the start, so that the first increase shows."""

    def __init__(self) -> None:
        self._registry = registry = CollectorRegistry()
        self._http_requests = Counter(
            "airmatrix_http_requests_total", "HTTP requests answered.", ["method", "route", "status"], registry=registry
        )
        self._http_seconds = Histogram(
            "airmatrix_http_request_duration_seconds",
            "From a request's head to the end of its answer.",
            ["method", "route"],
            buckets=_SECONDS,
            registry=registry,
        )
        self._problems = Counter(
            "airmatrix_problems_total",
            "Answers that are problem documents, by type, and by reason where the type has reasons.",
            ["type", "reason"],
            registry=registry,
        )
        self._flight_intents = Counter(
            "airmatrix_flight_intents_total",
            "Flight intents that the writer answered, by what it answered.",
            ["outcome"],
            registry=registry,
        )
        self._queue_length = Gauge(
            "airmatrix_queue_length",
            "Requests that wait for the writer.",
            registry=registry,
            multiprocess_mode="livesum",
        )
        self._index_size = Gauge(
            "airmatrix_index_reservations",
            "Reservations in the occupancy index.",
            registry=registry,
            multiprocess_mode="livemostrecent",
        )
        self._batch_size = Histogram(
            "airmatrix_batch_requests", "Requests of a batch.", buckets=_SIZES, registry=registry
        )
        self._queue_seconds = _seconds(
            "queue", "From the arrival of a request for a plan until its planning began.", registry
        )
        self._plan_seconds = _seconds("plan", "Planning of a request.", registry)
        self._write_seconds = _seconds("write", "Writing the rows of a batch, before its commit.", registry)
        self._commit_seconds = _seconds("commit", "The commit of a batch.", registry)
        self._positions = Counter(
            "airmatrix_positions_total", "Reported positions, by what became of them.", ["outcome"], registry=registry
        )
        self._moves = Counter(
            "airmatrix_state_moves_total",
            "Flights that moved to another state by themselves, by state.",
            ["state"],
            registry=registry,
        )
        self._monitor_seconds = _seconds("monitor", "A look at all that is in the air, with what it records.", registry)
        self._webhook_deliveries = Counter(
            "airmatrix_webhook_deliveries_total",
            "Attempts to deliver an event to a webhook, by outcome.",
            ["outcome"],
            registry=registry,
        )
        self._ledger_failures = Counter(
            "airmatrix_ledger_failures_total", "Batches that failed, by how.", ["kind"], registry=registry
        )
        for outcome in _OUTCOMES:
            self._flight_intents.labels(outcome)
        for kind in (_COMMIT_UNCERTAIN, _BATCH_FAILED):
            self._ledger_failures.labels(kind)
        for outcome in _POSITIONS:
            self._positions.labels(outcome)
        for outcome in OUTCOMES:
            self._webhook_deliveries.labels(outcome)
        for state in _MOVES:
            self._moves.labels(state.value)
        for slug, reason in _kinds_of_problems():
            self._problems.labels(slug, reason)

    def answered(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count an answered HTTP request; `route` is a template, never a path."""
        method = method if method in _METHODS else OTHER
        self._http_requests.labels(method, route, status).inc()
        self._http_seconds.labels(method, route).observe(seconds)

    def problem(self, slug: str, reason: str | None) -> None:
        """Count a problem document; only reasons of a closed list become labels."""
        self._problems.labels(slug, reason if slug in _REASONS else "").inc()

    def waiting(self, requests: int) -> None:
        """Take down how many requests wait for this process's writer."""
        self._queue_length.set(requests)

    def index_loaded(self, reservations: int) -> None:
        """Take down the size of the index before there was a batch."""
        self._index_size.set(reservations)

    def batch(self, report: BatchReport) -> None:
        """Take down what became of a batch. Safe in any thread."""
        self._batch_size.observe(len(report.requests))
        self._index_size.set(report.index_size)
        uncertain = isinstance(report.failure, CommitUncertain)
        if report.failure is not None:
            self._ledger_failures.labels(_COMMIT_UNCERTAIN if uncertain else _BATCH_FAILED).inc()
        if report.failure is None:
            self._write_seconds.observe(report.write_s)
            self._commit_seconds.observe(report.commit_s)
        # A batch that failed before its commit may have planned none of its requests.
        if report.failure is None or uncertain:
            for seconds in report.queue_s:
                self._queue_seconds.observe(seconds)
            for seconds in report.plan_s:
                self._plan_seconds.observe(seconds)
        for answer in report.answers:
            if isinstance(answer, Moved):
                for _, _, state in answer.flights:
                    self._moves.labels(state.value).inc()
            for outcome in map(_outcome, answer.intents if isinstance(answer, Recorded) else [answer]):
                if outcome is not None:
                    self._flight_intents.labels(outcome).inc()

    def positions(self, refused: Iterable[PositionRefused], accepted: int) -> None:
        """Take down what became of reported positions."""
        self._positions.labels(_ACCEPTED).inc(accepted)
        for error in refused:
            self._positions.labels(problems.kind_of(error).slug).inc()

    def webhook(self, outcome: str) -> None:
        """Count an attempt to deliver an event."""
        self._webhook_deliveries.labels(outcome).inc()

    def looked(self, seconds: float) -> None:
        """Take down how long a look at the air took."""
        self._monitor_seconds.observe(seconds)

    def exposition(self) -> bytes:
        """Return all metrics, those of the other workers included, in Prometheus' text format."""
        registry = self._registry
        if _FOLDER is not None:
            registry = CollectorRegistry()
            MultiProcessCollector(registry, _FOLDER)  # type: ignore[no-untyped-call]
        return generate_latest(registry)


def forget_process(pid: int) -> None:
    """Drop the gauges of a worker that has ended; its counts stay, so that no sum goes down. The parent calls this."""
    mark_process_dead(pid)  # type: ignore[no-untyped-call]


def _seconds(stage: str, meaning: str, registry: CollectorRegistry) -> Histogram:
    return Histogram(f"airmatrix_{stage}_seconds", meaning, buckets=_SECONDS, registry=registry)


def _kinds_of_problems() -> Iterator[tuple[str, str]]:
    for kind in (*problems.KINDS.values(), *problems.HTTP_ERRORS.values(), problems.VALIDATION, problems.INTERNAL):
        for reason in _REASONS.get(kind.slug, [""]):
            yield kind.slug, reason


def _outcome(answer: object) -> str | None:
    """Return what the writer answered; None for an error, which is counted as a problem."""
    match answer:
        case Outcome(replayed=bytes()):
            return "replayed"
        case Outcome(intent=FlightIntent(refusal=Refusal())):
            return "rejected"
        case Outcome():
            return "accepted"
        case FlightIntent(state=State.CANCELLED | State.ENDED | State.ACCEPTED | State.REJECTED as state):
            return state.value
        case FlightIntent():
            return State.ACTIVATED.value
        case PreviewPlan() | Refusal():
            return "previewed"
        case _:
            return None
