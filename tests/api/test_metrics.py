"""Metrics: each moves when it should, by what it should, and no other does."""

import asyncio
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from threading import current_thread
from typing import Any

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import Connection, Engine, event
from sqlalchemy.exc import OperationalError

from app import problems
from app.deconfliction import Outcome, PreviewPlan
from app.errors import LedgerUnavailable
from app.flight_intents import FlightIntent, Refusal, Reservations, State
from app.ledger import CommitUncertain
from app.main import create_app
from app.metrics import Metrics
from app.settings import Settings
from app.tracing import _problem_in
from app.writer import BatchReport, Request
from planner.errors import NoDepartureSlot, NoPlan, NotPlannable, PathRefused
from tests.api.bodies import PREVIEW, SUBMIT, intent
from tests.api.serving import Client, served, serving
from tests.ledger.district import OLD_TOWN
from tests.ledger.locations import Ledgers, SqliteLedgers, write_lock
from tests.ledger.process import FakeClock, until

Samples = dict[str, float]

JSON = {"Content-Type": "application/json"}


@pytest.fixture
def ledgers(tmp_path: Path) -> Ledgers:
    """Keep to one kind of database: nothing here has to do with that."""
    return SqliteLedgers(tmp_path)


def samples_in(exposition: str) -> Samples:
    """Return every sample by its name and labels, as they are written."""
    found = {}
    for family in text_string_to_metric_families(exposition):
        for sample in family.samples:
            labels = ",".join(f'{name}="{value}"' for name, value in sorted(sample.labels.items()))
            found[f"{sample.name}{{{labels}}}" if labels else sample.name] = sample.value
    return found


def changes(before: Samples, after: Samples) -> Samples:
    """Return what has changed, and by how much."""
    assert set(before) <= set(after)
    moved = {name: value - before.get(name, 0) for name, value in after.items()}
    return {name: change for name, change in moved.items() if change}


def counts(moved: Samples) -> Samples:
    """Return what can be foretold: neither seconds nor the buckets they fall in."""
    return {name: change for name, change in moved.items() if "_bucket{" not in name and "_seconds_sum" not in name}


def read(client: Client) -> Samples:
    return samples_in(client.service.metrics.exposition().decode())


@contextmanager
def moving(client: Client) -> Iterator[Samples]:
    """Yield a dict that tells, in the end, what was counted. The writer is stopped first, so that it has told all."""
    before = read(client)
    moved: Samples = {}
    yield moved
    client.service.writer.stop()
    moved |= counts(changes(before, read(client)))


def http(method: str, route: str, status: int) -> Samples:
    """Return what an HTTP request moves."""
    return {
        f'airmatrix_http_requests_total{{method="{method}",route="{route}",status="{status}"}}': 1,
        f'airmatrix_http_request_duration_seconds_count{{method="{method}",route="{route}"}}': 1,
    }


def a_problem(slug: str, reason: str = "") -> Samples:
    return {f'airmatrix_problems_total{{reason="{reason}",type="{slug}"}}': 1}


def outcome(name: str) -> Samples:
    return {f'airmatrix_flight_intents_total{{outcome="{name}"}}': 1}


# A batch of one request, and what of it is counted even if it fails.
BATCH = {"airmatrix_batch_requests_count": 1.0, "airmatrix_batch_requests_sum": 1.0}
PLANNED = {"airmatrix_queue_seconds_count": 1.0, "airmatrix_plan_seconds_count": 1.0}
COMMITTED = {"airmatrix_write_seconds_count": 1.0, "airmatrix_commit_seconds_count": 1.0}
WRITTEN = {**BATCH, **PLANNED, **COMMITTED}

NO_SLOT = a_problem("no-conflict-free-plan", "no_departure_slot")


def total(*moves: Samples) -> Samples:
    """Return what several things move together."""
    together: Counter[str] = Counter()
    for moved in moves:
        together.update(moved)
    return dict(together)


def indexed(answer: httpx.Response) -> Samples:
    return {"airmatrix_index_reservations": len(answer.json()["reservations"])}


# What the writer did


def test_an_accepted_intent_is_counted_with_its_batch_and_reservations(client: Client) -> None:
    with moving(client) as moved:
        answer = client.post(SUBMIT, json=intent())
    assert moved == total(http("POST", SUBMIT, 201), outcome("accepted"), WRITTEN, indexed(answer))


def test_a_refused_intent_is_counted_with_its_reason(client: Client) -> None:
    with moving(client) as moved:
        first = client.post(SUBMIT, json=intent())
        client.post(SUBMIT, json=intent(window_ms=0))
    accepted = total(http("POST", SUBMIT, 201), outcome("accepted"), WRITTEN, indexed(first))
    assert moved == total(accepted, http("POST", SUBMIT, 409), outcome("rejected"), NO_SLOT, WRITTEN)


def test_a_replayed_answer_is_counted_as_that_alone(client: Client) -> None:
    with moving(client) as moved:
        for _ in range(3):
            answer = client.post(SUBMIT, json=intent(), headers={"Idempotency-Key": "k"})
    posts = total(*[http("POST", SUBMIT, 201), WRITTEN] * 3)
    replays = total(*[outcome("replayed")] * 2)
    assert moved == total(posts, outcome("accepted"), replays, indexed(answer))


def test_a_replayed_refusal_is_a_replay_and_a_problem_again(client: Client) -> None:
    with moving(client) as moved:
        first = client.post(SUBMIT, json=intent())
        for _ in range(2):
            client.post(SUBMIT, json=intent(window_ms=0), headers={"Idempotency-Key": "k"})
    accepted = total(http("POST", SUBMIT, 201), outcome("accepted"), WRITTEN, indexed(first))
    refused = total(*[http("POST", SUBMIT, 409), NO_SLOT, WRITTEN] * 2)
    assert moved == total(accepted, refused, outcome("rejected"), outcome("replayed"))


def test_a_cancelled_intent_is_counted_but_not_as_planned_and_leaves_the_index(client: Client) -> None:
    with moving(client) as moved:
        client.delete(client.post(SUBMIT, json=intent()).headers["location"])
    accepted = total(http("POST", SUBMIT, 201), outcome("accepted"), WRITTEN)
    cancelled = total(http("DELETE", f"{SUBMIT}/{{intent_id}}", 200), outcome("cancelled"), BATCH, COMMITTED)
    assert moved == total(accepted, cancelled)


def test_a_preview_is_counted_and_reserves_nothing(client: Client) -> None:
    with moving(client) as moved:
        client.post(PREVIEW, json=intent())
    assert moved == total(http("POST", PREVIEW, 200), outcome("previewed"), WRITTEN)


def test_a_refused_preview_is_counted_with_its_reason(client: Client) -> None:
    with moving(client) as moved:
        first = client.post(SUBMIT, json=intent())
        client.post(PREVIEW, json=intent(window_ms=0))
    accepted = total(http("POST", SUBMIT, 201), outcome("accepted"), WRITTEN, indexed(first))
    assert moved == total(accepted, http("POST", PREVIEW, 409), outcome("previewed"), NO_SLOT, WRITTEN)


def test_a_service_that_starts_tells_how_much_it_has_loaded(
    client: Client, settings: Settings, clock: FakeClock
) -> None:
    answer = client.post(SUBMIT, json=intent())
    with served(create_app(settings, clock)) as late:
        assert indexed(answer).items() <= read(late).items()


def test_requests_that_wait_together_are_one_batch(settings: Settings, clock: FakeClock) -> None:
    async def submit_three() -> Samples:
        async with serving(create_app(settings, clock)) as (http, service):
            before = samples_in(service.metrics.exposition().decode())
            with write_lock(settings.ledger):
                tasks = [asyncio.create_task(http.post(SUBMIT, json=intent())) for _ in range(3)]
                await until(lambda: service.writer.waiting == 2)
            await asyncio.gather(*tasks)
            service.writer.stop()
            return changes(before, samples_in(service.metrics.exposition().decode()))

    moved = asyncio.run(submit_three())
    assert moved['airmatrix_flight_intents_total{outcome="accepted"}'] == 3
    assert (moved["airmatrix_batch_requests_count"], moved["airmatrix_batch_requests_sum"]) == (1, 3)
    assert 'airmatrix_batch_requests_bucket{le="2.0"}' not in moved
    assert moved['airmatrix_batch_requests_bucket{le="4.0"}'] == 1
    assert {name: moved[name] for name in PLANNED} == total(PLANNED, PLANNED, PLANNED)
    assert {name: moved[name] for name in COMMITTED} == COMMITTED


def test_the_queue_is_as_long_as_requests_wait(settings: Settings, clock: FakeClock) -> None:
    async def queue_up() -> list[float]:
        async with serving(create_app(settings, clock)) as (http, service):

            async def length() -> float:
                return samples_in((await http.get("/metrics")).text)["airmatrix_queue_length"]

            lengths = [await length()]
            with write_lock(settings.ledger):
                tasks = [asyncio.create_task(http.post(SUBMIT, json=intent())) for _ in range(3)]
                await until(lambda: service.writer.waiting == 2)
                lengths.append(await length())
            await asyncio.gather(*tasks)
            lengths.append(samples_in(service.metrics.exposition().decode())["airmatrix_queue_length"])
            return lengths

    assert asyncio.run(queue_up()) == [0, 2, 0]


@contextmanager
def failing_once(moment: str) -> Iterator[None]:
    """Let the writer's next transaction fail at its begin or its commit."""
    failed: list[str] = []

    def fail(_: Connection) -> None:
        if current_thread().name == "ledger-writer" and not failed:
            failed.append(moment)
            raise OperationalError(moment, {}, Exception("disk I/O error"))

    event.listen(Engine, moment, fail)
    try:
        yield
    finally:
        event.remove(Engine, moment, fail)


@pytest.mark.parametrize(
    ("moment", "kind", "reached"), [("begin", "batch_failed", {}), ("commit", "commit_uncertain", PLANNED)]
)
def test_a_batch_that_fails_is_counted_with_how_and_no_commit(
    client: Client, moment: str, kind: str, reached: Samples
) -> None:
    with moving(client) as moved, failing_once(moment):
        client.post(SUBMIT, json=intent())
    moved.pop("airmatrix_index_reservations", None)
    answer = total(http("POST", SUBMIT, 503), a_problem("ledger-unavailable"))
    assert moved == total(answer, {f'airmatrix_ledger_failures_total{{kind="{kind}"}}': 1}, BATCH, reached)


SUBMISSION = OLD_TOWN.submission("A", "B")
REFUSAL = Refusal("no_departure_slot", "why")


def flight_intent(state: State, refusal: Refusal | None = None) -> FlightIntent:
    return FlightIntent("id", 1, 1, state, SUBMISSION, 0, refusal=refusal)


def report(answers: list[object], failure: Exception | None = None, **members: Any) -> BatchReport:
    """Return the report of a batch with these answers."""
    request = Request(run=lambda *_: None, look_up=lambda: None, plans=True, future=Future(), context={}, arrived=0.0)
    members = {"queue_s": [], "plan_s": [], "write_s": 0.0, "commit_s": 0.0, "index_size": 0, **members}
    return BatchReport(requests=[request] * len(answers), answers=answers, failure=failure, **members)


def moved_by(batch: BatchReport) -> Samples:
    """Return what a batch moves in new metrics."""
    metrics = Metrics()
    before = samples_in(metrics.exposition().decode())
    metrics.batch(batch)
    return changes(before, samples_in(metrics.exposition().decode()))


@pytest.mark.parametrize(
    ("answer", "outcomes"),
    [
        (Outcome(flight_intent(State.ACCEPTED)), outcome("accepted")),
        (Outcome(flight_intent(State.REJECTED, REFUSAL)), outcome("rejected")),
        (Outcome(flight_intent(State.ACCEPTED), replayed=b"{}"), outcome("replayed")),
        (Outcome(flight_intent(State.REJECTED, REFUSAL), replayed=b"{}"), outcome("replayed")),
        (flight_intent(State.CANCELLED), outcome("cancelled")),
        (PreviewPlan(SUBMISSION, None, Reservations.none(), ()), outcome("previewed")),  # type: ignore[arg-type]
        (REFUSAL, outcome("previewed")),
        (NoDepartureSlot("why"), {}),
        (LedgerUnavailable("why"), {}),
    ],
)
def test_each_answer_of_the_writer_has_its_outcome(answer: object, outcomes: Samples) -> None:
    moved = moved_by(report([answer]))
    assert {name: change for name, change in moved.items() if "flight_intents" in name} == outcomes


def test_seconds_are_taken_down_as_they_were_reported() -> None:
    moved = moved_by(
        report([None, None], queue_s=[0.0002, 0.25], plan_s=[0.001, 0.004], write_s=0.03, commit_s=20.0, index_size=7)
    )
    assert moved["airmatrix_queue_seconds_sum"] == pytest.approx(0.2502)
    assert moved["airmatrix_plan_seconds_sum"] == pytest.approx(0.005)
    assert moved["airmatrix_write_seconds_sum"] == pytest.approx(0.03)
    assert moved["airmatrix_commit_seconds_sum"] == pytest.approx(20.0)
    assert moved["airmatrix_index_reservations"] == 7
    assert 'airmatrix_queue_seconds_bucket{le="0.0001"}' not in moved
    assert moved['airmatrix_queue_seconds_bucket{le="0.00025"}'] == 1
    assert moved['airmatrix_queue_seconds_bucket{le="0.25"}'] == 2
    assert 'airmatrix_commit_seconds_bucket{le="10.0"}' not in moved
    assert moved['airmatrix_commit_seconds_bucket{le="+Inf"}'] == 1


@pytest.mark.parametrize(("failure", "planned"), [(LedgerUnavailable("why"), False), (CommitUncertain("why"), True)])
def test_seconds_that_a_failed_batch_did_not_reach_are_not_taken_down(failure: Exception, planned: bool) -> None:
    moved = moved_by(report([failure], failure, queue_s=[0.1], plan_s=[-5.0], write_s=0.3, commit_s=0.4))
    stages = {name for name in moved if name.endswith("_seconds_count")}
    assert stages == (set(PLANNED) if planned else set())


# HTTP


@pytest.mark.parametrize(
    ("method", "path", "route", "status"),
    [
        ("GET", SUBMIT, SUBMIT, 200),
        ("GET", "/v1/airspace/blocks/1/1/0", "/v1/airspace/blocks/{i}/{j}/{k}", 200),
        ("GET", "/health/live", "/health/live", 200),
        ("GET", "/metrics", "/metrics", 200),
    ],
)
def test_a_read_is_counted_under_its_route_and_moves_nothing_else(
    client: Client, method: str, path: str, route: str, status: int
) -> None:
    with moving(client) as moved:
        assert client.request(method, path).status_code == status
    assert moved == http(method, route, status)


@pytest.mark.parametrize(
    ("method", "path", "options", "counted", "problem"),
    [
        ("GET", f"{SUBMIT}/swordfish", {}, ("GET", f"{SUBMIT}/{{intent_id}}", 404), ("unknown-flight-intent",)),
        ("GET", "/swordfish", {}, ("GET", "other", 404), ("not-found",)),
        ("DELETE", "/swordfish/1", {}, ("DELETE", "other", 404), ("not-found",)),
        ("PATCH", SUBMIT, {}, ("PATCH", SUBMIT, 405), ("method-not-allowed",)),
        ("SWORDFISH", SUBMIT, {}, ("other", SUBMIT, 405), ("method-not-allowed",)),
        ("GET", "/v1/events?limit=0", {}, ("GET", "/v1/events", 422), ("validation-error",)),
        ("POST", SUBMIT, {"content": b"swordfish", "headers": JSON}, ("POST", SUBMIT, 400), ("malformed-request",)),
        ("POST", SUBMIT, {"content": b"x" * 1_048_577}, ("POST", "other", 413), ("body-too-large",)),
        ("GET", "/health/live", {"headers": {"Host": "swordfish"}}, ("GET", "other", 421), ("host-not-allowed",)),
        ("POST", SUBMIT, {"json": intent("A", "A")}, ("POST", SUBMIT, 422), ("not-plannable", "same_block")),
        ("POST", SUBMIT, {"json": intent("A", "Y")}, ("POST", SUBMIT, 422), ("not-plannable", "disconnected")),
        ("POST", PREVIEW, {"json": intent((3, 2, 0))}, ("POST", PREVIEW, 422), ("not-plannable", "origin_blocked")),
    ],
)
def test_a_request_that_is_refused_is_counted_as_its_problem_and_under_no_words_of_its_own(
    client: Client,
    method: str,
    path: str,
    options: dict[str, Any],
    counted: tuple[str, str, int],
    problem: tuple[str, ...],
) -> None:
    with moving(client) as moved:
        client.request(method, path, **options)
    assert moved == {**http(*counted), **a_problem(*problem)}
    assert "swordfish" not in client.get("/metrics").text.lower()


def test_a_request_that_a_stopped_writer_cannot_take_is_counted(client: Client) -> None:
    client.service.writer.stop()
    with moving(client) as moved:
        client.post(SUBMIT, json=intent())
    assert moved == {**http("POST", SUBMIT, 503), **a_problem("ledger-unavailable")}


def test_the_reasons_of_readiness_are_no_labels(client: Client) -> None:
    client.service.writer.stop()
    with moving(client) as moved:
        client.get("/health/ready")
    assert moved == {**http("GET", "/health/ready", 503), **a_problem("not-ready")}


def test_a_problem_is_told_from_its_beginning_however_it_goes_on() -> None:
    kind = problems.KINDS[NoPlan]
    begun = problems.body(kind, 'a "reason":"that is none" \\', {"reason": "no_departure_slot", "more": 1})
    assert _problem_in(begun[:-10] + b"...") == (kind.slug, "no_departure_slot")
    assert _problem_in(problems.body(kind, "none", {"cause": {"reason": "another's"}})) == (kind.slug, None)


def test_an_unexpected_error_is_counted(settings: Settings, clock: FakeClock) -> None:
    app = create_app(settings, clock)

    @app.get("/bug/{name}")
    async def bug() -> None:
        raise ZeroDivisionError

    with served(app) as client, moving(client) as moved:
        client.get("/bug/7")
    assert moved == {**http("GET", "/bug/{name}", 500), **a_problem("internal-error")}


def test_seconds_of_a_request_fall_into_one_bucket(client: Client) -> None:
    before = read(client)
    client.get("/health/live")
    moved = changes(before, read(client))
    name = "airmatrix_http_request_duration_seconds"
    assert moved[f'{name}_bucket{{le="+Inf",method="GET",route="/health/live"}}'] == 1
    assert 0 < moved[f'{name}_sum{{method="GET",route="/health/live"}}'] < 10


# What is served


def test_metrics_are_prometheus_text(client: Client) -> None:
    response = client.get("/metrics")
    assert response.status_code == 200
    assert response.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"


def test_metrics_are_documented_as_text(client: Client) -> None:
    document = client.get("/openapi.json").json()
    assert document["paths"]["/metrics"]["get"]["responses"]["200"]["content"] == {
        "text/plain": {"schema": {"type": "string"}}
    }


def test_every_metric_is_named_as_prometheus_asks(client: Client) -> None:
    client.post(SUBMIT, json=intent())
    for family in text_string_to_metric_families(client.get("/metrics").text):
        assert family.name.startswith("airmatrix_")
        assert family.documentation.endswith(".")
        assert family.type in ("counter", "gauge", "histogram")
        assert (family.type == "counter") == all(sample.name.endswith("_total") for sample in family.samples)


def test_what_can_be_refused_is_there_before_it_is(client: Client) -> None:
    reasons = {
        "not-plannable": [error.reason for error in NotPlannable.__subclasses__()],
        "path-refused": [error.reason for error in PathRefused.__subclasses__()],
        "no-conflict-free-plan": [error.reason for error in NoPlan.__subclasses__() if error not in problems.KINDS],
    }
    kinds = [*problems.KINDS.values(), *problems.HTTP_ERRORS.values(), problems.VALIDATION, problems.INTERNAL]
    expected = {
        name for kind in kinds for reason in reasons.get(kind.slug, [""]) for name in a_problem(kind.slug, reason)
    }
    assert {name: value for name, value in read(client).items() if "problems" in name} == dict.fromkeys(expected, 0)


def test_two_services_in_one_process_count_for_themselves(client: Client, settings: Settings, tmp_path: Path) -> None:
    other = Settings.model_validate({**settings.model_dump(), "ledger": str(tmp_path / "other.sqlite")})
    with served(create_app(other)) as second:
        second.get("/health/live")
        assert http("GET", "/health/live", 200).items() <= read(second).items()
    assert not set(http("GET", "/health/live", 200)) & set(read(client))


# Several workers


WORKER = """
import os, sys
from app import metrics
taken = metrics.Metrics()
for line in sys.stdin:
    command, *arguments = line.split()
    match command:
        case "answered": taken.answered("GET", "/health/live", 200, 0.001)
        case "waiting": taken.waiting(int(arguments[0]))
        case "index": taken.index_loaded(int(arguments[0]))
        case "forget": metrics.forget_process(int(arguments[0]))
    print(taken.exposition().decode() + "# EOF", flush=True)
"""


class Worker:
    """A process that takes metrics down, and shows them after each command."""

    def __init__(self, folder: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", WORKER],
            env={**os.environ, "PROMETHEUS_MULTIPROC_DIR": str(folder)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __call__(self, command: str) -> Samples:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{command}\n")
        self.process.stdin.flush()
        lines: list[str] = []
        while (line := self.process.stdout.readline()) != "# EOF\n":
            assert line, "the worker has ended"
            lines.append(line)
        return samples_in("".join(lines))

    def end(self) -> None:
        """Let it end."""
        self.process.communicate("")


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[Callable[[], Worker]]:
    workers = []

    def start() -> Worker:
        workers.append(Worker(tmp_path))
        return workers[-1]

    yield start
    for started in workers:
        started.end()


def test_any_worker_answers_for_all_and_for_those_that_have_ended(worker: Callable[[], Worker]) -> None:
    first, second = worker(), worker()
    requests, seconds = http("GET", "/health/live", 200)
    first("answered")
    first("waiting 3")
    for ask in (first, second):
        samples = ask("answered")
    assert (samples[requests], samples[seconds]) == (3, 3)
    assert second("waiting 4")["airmatrix_queue_length"] == 7
    # Every worker has the same index, but for what it has not caught up with yet.
    second("index 50")
    assert first("index 40")["airmatrix_index_reservations"] == 40
    first.end()
    after = second(f"forget {first.process.pid}")
    assert (after[requests], after[seconds], after["airmatrix_queue_length"]) == (3, 3, 4)
