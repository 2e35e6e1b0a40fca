"""`airmatrix load`: what it counts, when it stops, and what it makes of a service in trouble.

Most of it runs against a stand-in that answers for the town as it is told to.
"""

import json
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import httpx
import pytest

from app.client import Client
from app.times import now_ms, parse_time
from tests.cli.conftest import Outcome, Run, numbers
from tests.cli.serving import AIRMATRIX, Server, environment

HOUR_MS = 3_600_000
# No answer here takes that long, unless something hangs.
PATIENCE_S = 20.0


@dataclass(frozen=True)
class Reply:
    """What the stand-in answers; without a status it breaks the connection off."""

    status: int | None = 201
    headers: dict[str, str] = field(default_factory=dict)
    content: bytes = b"{}"


def problem(status: int, slug: str, headers: dict[str, str] | None = None, **members: object) -> Reply:
    """Return a problem as the service answers it."""
    return Reply(status, headers or {}, json.dumps({"type": f"/problems/{slug}", "title": slug, **members}).encode())


ACCEPTED = Reply()
QUEUE_FULL = "queue-full"


@dataclass(eq=False)
class StandIn:
    """A stand-in for the service: `answer` is called with the number, from 1, of each flight intent that comes."""

    answer: Callable[[int], Reply]
    url: str = ""
    bodies: list[dict[str, Any]] = field(default_factory=list)
    arrived_s: list[float] = field(default_factory=list)
    connections: int = 0

    @property
    def received(self) -> int:
        return len(self.bodies)


StandingIn = Callable[..., Any]


@pytest.fixture(scope="session")
def town_answers(town: Server) -> dict[str, bytes]:
    """What the town's service answers to the questions that come before the load."""
    return {path: httpx.get(town.url + path).content for path in _ASKED}


_ASKED = ("/v1/airspace", "/v1/airspace/static", "/v1/aircraft-types")


@pytest.fixture
def standing_in(town_answers: dict[str, bytes]) -> StandingIn:
    """Return a function that starts a stand-in: a context manager."""

    @contextmanager
    def standing_in(
        answer: Callable[[int], Reply] = lambda _: ACCEPTED, hang_up_after_s: float | None = None
    ) -> Iterator[StandIn]:
        stand_in = StandIn(answer)
        lock = threading.Lock()

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            disable_nagle_algorithm = True
            timeout = hang_up_after_s

            def setup(self) -> None:
                super().setup()
                self.counted = False

            def do_GET(self) -> None:
                self.reply(Reply(200, content=town_answers[self.path]))

            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                with lock:
                    stand_in.connections += not self.counted
                    stand_in.arrived_s.append(time.monotonic())
                    stand_in.bodies.append(body)
                    number = stand_in.received
                self.counted = True
                assert self.path == "/v1/flight-intents"
                self.reply(stand_in.answer(number))

            def reply(self, reply: Reply) -> None:
                if reply.status is None:
                    self.close_connection = True
                    return
                self.send_response(reply.status)
                for name, value in (reply.headers | {"Content-Length": str(len(reply.content))}).items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(reply.content)

            def log_message(self, *_: object) -> None:
                """Say nothing."""

        class Listener(ThreadingHTTPServer):
            request_queue_size = 128

            def handle_error(self, *_: object) -> None:
                """Clients that hang up are part of the tests."""

        with Listener(("127.0.0.1", 0), Handler) as server:
            stand_in.url = f"http://127.0.0.1:{server.server_port}"
            serving = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
            serving.start()
            try:
                yield stand_in
            finally:
                server.shutdown()
                serving.join()

    return standing_in


def loaded(airmatrix: Run, url: str, *options: object, status: int = 0) -> Outcome:
    """Run the command without a warm-up, unless the options name one."""
    outcome = airmatrix("load", "--url", url, "--warm-up", 0, *options)
    assert outcome.status == status, outcome.err
    return outcome


def requests(outcome: Outcome) -> int:
    return int(numbers(outcome.table["requests"])[0])


def accepted(outcome: Outcome) -> int:
    return int(numbers(outcome.table["accepted"])[0])


def labels(outcome: Outcome, beginning: str) -> list[str]:
    return [label for label in outcome.table if label.startswith(beginning)]


def test_the_table_says_what_the_service_recorded(airmatrix: Run, town: Server) -> None:
    outcome = loaded(
        airmatrix, town.url, "--operator", "loaded", "--clients", 8, "--limit", 150, "--duration", 600,
        "--window", 0, "--od", "lowest",
    )  # fmt: skip
    with Client(town.url) as client:
        intents = list(client.flight_intents(operator="loaded"))
    reasons = Counter(intent.refusal.reason for intent in intents if intent.refusal is not None)
    assert len(intents) == requests(outcome) == 150
    assert sum(intent.state == "accepted" for intent in intents) == accepted(outcome) > 0
    assert reasons.total() > 0
    refused = {label.removeprefix("refused: "): int(outcome.table[label]) for label in labels(outcome, "refused: ")}
    assert refused == dict(reasons)
    assert labels(outcome, "problem") == labels(outcome, "connection") == []
    assert labels(outcome, "of it") == ["of it queue", "of it plan", "of it commit", "of it serialise"]
    assert outcome.out.startswith("town, containment, safe-interval")


def test_the_rate_is_what_was_accepted_by_the_time_it_took(airmatrix: Run, standing_in: StandingIn) -> None:
    with standing_in() as service:
        outcome = loaded(airmatrix, service.url, "--duration", 0.5, "--clients", 2)
    count, seconds, clients = numbers(outcome.table["requests"])
    assert count == service.received
    assert clients == 2
    assert seconds >= 0.5
    assert numbers(outcome.table["accepted"]) == [count, pytest.approx(count / seconds, rel=0.02)]


def test_the_slices_add_up_to_what_was_accepted(airmatrix: Run, standing_in: StandingIn) -> None:
    with standing_in() as service:
        outcome = loaded(airmatrix, service.url, "--duration", 1, "--clients", 2)
    seconds = numbers(outcome.table["requests"])[1]
    slices = {numbers(label)[0]: numbers(outcome.table[label]) for label in labels(outcome, "from ")}
    assert list(slices) == pytest.approx([number * seconds / 10 for number in range(10)], abs=0.051)
    counts = [rate[0] * seconds / 10 for rate in slices.values()]
    assert sum(counts) == pytest.approx(accepted(outcome), rel=0.02)


def test_a_slice_shows_its_own_slow_answers(airmatrix: Run, standing_in: StandingIn) -> None:
    def answer(number: int) -> Reply:
        time.sleep(0.4 if number == 1 else 0.02)
        return ACCEPTED

    with standing_in(answer) as service:
        outcome = loaded(airmatrix, service.url, "--duration", 1, "--clients", 1)
    p99_ms = [numbers(outcome.table[label])[-1] for label in labels(outcome, "from ") if "p99" in outcome.table[label]]
    # The first answer falls into the fourth slice at the earliest; nothing is shown of slices without any.
    assert outcome.table["from 0.0 s"] == "0.0/s"
    assert p99_ms[0] >= 300
    assert min(p99_ms) < 300


def test_every_request_is_a_flight_of_its_own(airmatrix: Run, standing_in: StandingIn) -> None:
    with standing_in() as service:
        loaded(airmatrix, service.url, "--limit", 40, "--clients", 1, "--operator", "somebody", "--seed", 3)
    assert [body["reference"] for body in service.bodies] == [f"seed 3, flight {number}" for number in range(1, 41)]
    assert {body["operator"] for body in service.bodies} == {"somebody"}


def test_a_seed_asks_for_the_same_flights_however_many_clients_there_are(
    airmatrix: Run, standing_in: StandingIn
) -> None:
    def flights(seed: int, clients: int) -> dict[str, tuple[object, object, object]]:
        with standing_in() as service:
            loaded(airmatrix, service.url, "--limit", 20, "--seed", seed, "--clients", clients)
        return {
            body["reference"].partition(", ")[2]: (body["origin"], body["destination"], body["aircraft_type"])
            for body in service.bodies
        }

    assert flights(5, 1) == flights(5, 4) != flights(6, 1)


def test_departures_are_spread_over_the_window(airmatrix: Run, standing_in: StandingIn) -> None:
    before_ms = now_ms() + 60_000
    with standing_in() as service:
        loaded(airmatrix, service.url, "--limit", 200, "--window", 3)
    after_ms = now_ms() + 60_000
    departures = [parse_time(body["earliest_departure"]) for body in service.bodies]
    assert before_ms <= min(departures) < before_ms + HOUR_MS
    assert after_ms + 2 * HOUR_MS < max(departures) <= after_ms + 3 * HOUR_MS


def test_the_limit_holds_to_the_request_and_the_warm_up_does_not_count(airmatrix: Run, standing_in: StandingIn) -> None:
    with standing_in() as service:
        outcome = loaded(airmatrix, service.url, "--limit", 25, "--clients", 4, "--warm-up", 0.3)
    assert requests(outcome) == accepted(outcome) == 25
    assert service.received > 25


def test_fewer_requests_than_clients_are_possible(airmatrix: Run, standing_in: StandingIn) -> None:
    with standing_in() as service:
        outcome = loaded(airmatrix, service.url, "--limit", 3, "--clients", 16)
    assert requests(outcome) == service.received == 3


def test_as_many_requests_are_under_way_as_there_are_clients(airmatrix: Run, standing_in: StandingIn) -> None:
    together = threading.Barrier(4)

    def answer(_: int) -> Reply:
        # Passes only four at a time: were there fewer, none would be answered; were there more, some would be left.
        together.wait(PATIENCE_S)
        return ACCEPTED

    with standing_in(answer) as service:
        outcome = loaded(airmatrix, service.url, "--limit", 20, "--clients", 4)
    assert accepted(outcome) == 20
    assert service.connections == 4


def test_connections_are_kept_from_the_warm_up_on(airmatrix: Run, standing_in: StandingIn) -> None:
    with standing_in() as service:
        loaded(airmatrix, service.url, "--limit", 30, "--clients", 3, "--warm-up", 0.3)
    assert service.received > 30
    assert service.connections <= 3


def test_latency_runs_from_the_request_to_the_answer(airmatrix: Run, standing_in: StandingIn) -> None:
    def answer(number: int) -> Reply:
        time.sleep(0.3 if number == 1 else 0.03)
        return ACCEPTED

    with standing_in(answer) as service:
        outcome = loaded(airmatrix, service.url, "--limit", 10, "--clients", 1)
    median, _, _, _, _, longest = numbers(outcome.table["latency"])
    assert 30 <= median < 300 <= longest


def test_the_services_own_times_are_summed_up(airmatrix: Run, standing_in: StandingIn) -> None:
    def answer(number: int) -> Reply:
        parts = f"queue;dur={number}.5, plan;dur=0.25, commit;dur={1000 + number}, serialise;dur=3, total;dur=9"
        return Reply(headers={"Server-Timing": parts})

    with standing_in(answer) as service:
        outcome = loaded(airmatrix, service.url, "--limit", 101, "--clients", 2)
    assert labels(outcome, "of it") == ["of it queue", "of it plan", "of it commit", "of it serialise"]
    assert outcome.table["of it queue"] == "median 51.5 ms, p95 96.5 ms, p99 100.5 ms, max 101.5 ms"
    assert outcome.table["of it plan"] == "median 0.2 ms, p95 0.2 ms, p99 0.2 ms, max 0.2 ms"
    assert outcome.table["of it commit"] == "median 1051.0 ms, p95 1096.0 ms, p99 1100.0 ms, max 1101.0 ms"


def test_a_service_that_does_not_tell_its_times_has_no_rows_for_them(airmatrix: Run, standing_in: StandingIn) -> None:
    with standing_in() as service:
        outcome = loaded(airmatrix, service.url, "--limit", 5)
    assert labels(outcome, "of it") == []


def test_a_busy_service_is_left_alone_for_as_long_as_it_asks(airmatrix: Run, standing_in: StandingIn) -> None:
    def answer(number: int) -> Reply:
        return problem(503, QUEUE_FULL, {"Retry-After": "1"}) if number == 1 else ACCEPTED

    with standing_in(answer) as service:
        outcome = loaded(airmatrix, service.url, "--limit", 3, "--clients", 1)
    assert service.arrived_s[1] - service.arrived_s[0] >= 1
    assert (requests(outcome), accepted(outcome)) == (3, 2)
    count, median, _, _, _, p99, longest = numbers(outcome.table[f"problem: 503 {QUEUE_FULL}"].replace("p95", "95"))
    assert count == 1
    assert 0 < median == p99 == longest


def test_nobody_waits_beyond_the_end(airmatrix: Run, standing_in: StandingIn) -> None:
    with standing_in(lambda _: problem(503, QUEUE_FULL, {"Retry-After": "86400"})) as service:
        outcome = loaded(airmatrix, service.url, "--duration", 0.5, "--clients", 3, status=1)
    assert service.received == requests(outcome) == 3
    assert accepted(outcome) == 0
    assert numbers(outcome.table["requests"])[1] >= 0.5


def test_nobody_waits_once_the_limit_is_reached(airmatrix: Run, standing_in: StandingIn) -> None:
    def answer(number: int) -> Reply:
        return problem(503, QUEUE_FULL, {"Retry-After": "86400"}) if number == 1 else ACCEPTED

    with standing_in(answer) as service:
        outcome = loaded(airmatrix, service.url, "--limit", 10, "--clients", 2, "--duration", 3600)
    assert (requests(outcome), accepted(outcome)) == (10, 9)


def test_a_date_to_retry_after_is_no_reason_to_wait(airmatrix: Run, standing_in: StandingIn) -> None:
    date = {"Retry-After": "Fri, 31 Dec 2100 23:59:59 GMT"}
    with standing_in(lambda number: problem(503, QUEUE_FULL, date) if number == 1 else ACCEPTED) as service:
        outcome = loaded(airmatrix, service.url, "--limit", 2, "--clients", 1, "--duration", 3600)
    assert accepted(outcome) == 1


def test_a_connection_that_idled_away_is_no_error(airmatrix: Run, standing_in: StandingIn) -> None:
    def answer(number: int) -> Reply:
        return problem(503, QUEUE_FULL, {"Retry-After": "5"}) if number == 1 else ACCEPTED

    with standing_in(answer, hang_up_after_s=1.0) as service:
        outcome = loaded(airmatrix, service.url, "--limit", 2, "--clients", 1)
    assert service.connections == 2
    assert accepted(outcome) == 1
    assert labels(outcome, "connection errors") == []


def test_refusals_are_counted_by_reason_and_everything_else_by_status_and_problem(
    airmatrix: Run, standing_in: StandingIn
) -> None:
    replies = [
        *[problem(409, "no-conflict-free-plan", reason="no_departure_slot")] * 3,
        problem(422, "not-plannable", reason="disconnected"),
        problem(409, "illegal-transition"),
        *[problem(422, "departure-in-the-past")] * 2,
        problem(503, "not-ready", reason="the disk is full"),
        Reply(502, content=b"<html>"),
        Reply(500, content=b"[]"),
        Reply(200),
        ACCEPTED,
    ]
    with standing_in(lambda number: replies[number - 1]) as service:
        outcome = loaded(airmatrix, service.url, "--limit", len(replies), "--clients", 1)
    counts = {label: int(numbers(outcome.table[label])[0]) for label in outcome.table if ": " in label}
    assert counts == {
        "refused: no_departure_slot": 3,
        "refused: disconnected": 1,
        "problem: 409 illegal-transition": 1,
        "problem: 422 departure-in-the-past": 2,
        "problem: 503 not-ready": 1,
        "problem: 502 Bad Gateway": 1,
        "problem: 500 Internal Server Error": 1,
        "problem: 200 OK": 1,
    }
    assert (requests(outcome), accepted(outcome)) == (len(replies), 1)


def test_lost_connections_are_counted_and_opened_again(airmatrix: Run, standing_in: StandingIn) -> None:
    with standing_in(lambda number: Reply(None) if number in (2, 3) else ACCEPTED) as service:
        outcome = loaded(airmatrix, service.url, "--limit", 6, "--clients", 1)
    assert outcome.table["connection errors"] == "2 RemoteDisconnected"
    assert (requests(outcome), accepted(outcome)) == (6, 4)
    assert service.connections == 3


def test_a_service_that_goes_away_is_not_stormed(airmatrix: Run, standing_in: StandingIn) -> None:
    with standing_in(lambda number: ACCEPTED if number == 1 else Reply(None)) as service:
        outcome = loaded(airmatrix, service.url, "--duration", 0.4, "--clients", 1)
    assert service.received == 2
    assert accepted(outcome) == 1


def test_nothing_accepted_is_a_failure(airmatrix: Run, standing_in: StandingIn) -> None:
    refusal = problem(409, "no-conflict-free-plan", reason="no_departure_slot")
    with standing_in(lambda _: refusal) as service:
        outcome = loaded(airmatrix, service.url, "--limit", 4, status=1)
    assert outcome.table["accepted"] == "0, 0.0/s"
    assert outcome.table["refused: no_departure_slot"] == "4"
    assert "latency" not in outcome.table


@contextmanager
def interrupted(standing_in: StandingIn, answered: int, *options: str) -> Iterator[Outcome]:
    """Interrupt a load of two clients once the service has answered so many requests and holds back two more."""
    held, release = threading.Semaphore(0), threading.Event()

    def answer(number: int) -> Reply:
        if number > answered:
            held.release()
            release.wait(PATIENCE_S)
        return ACCEPTED

    with standing_in(answer) as service:
        process = subprocess.Popen(
            [AIRMATRIX, "load", "--url", service.url, "--clients", "2", *options],
            env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            for _ in range(2):
                assert held.acquire(timeout=PATIENCE_S)
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=PATIENCE_S / 2)
        finally:
            release.set()
            process.kill()
            process.wait()
        yield Outcome(process.returncode, out, err)


def test_an_interrupted_load_gives_the_figures_so_far_at_once(standing_in: StandingIn) -> None:
    with interrupted(standing_in, 10, "--warm-up", "0") as outcome:
        assert outcome.status == 0, outcome.err
        assert outcome.err.strip() == ("interrupted: 2 requests were not waited for; what was accepted stays reserved")
        assert (requests(outcome), accepted(outcome)) == (10, 10)
        assert labels(outcome, "connection errors") == []


def test_a_warm_up_that_is_interrupted_has_no_figures(standing_in: StandingIn) -> None:
    with interrupted(standing_in, 10, "--warm-up", "60", "--duration", "1") as outcome:
        assert outcome.status == 1
        assert outcome.out == ""
        assert outcome.err.strip() == "interrupted: in the warm-up; what was accepted stays reserved"


def test_the_help_warns_that_what_is_accepted_stays_reserved(airmatrix: Run) -> None:
    outcome = airmatrix("load", "--help")
    assert "What is accepted STAYS RESERVED: load a service that has a ledger of its own" in outcome.out


def test_a_service_that_does_not_answer_is_named(airmatrix: Run) -> None:
    airmatrix("load", "--url", "http://127.0.0.1:9").assert_refused("no answer from http://127.0.0.1:9")


def test_an_operator_without_a_name_is_refused(airmatrix: Run, standing_in: StandingIn) -> None:
    with standing_in() as service:
        airmatrix("load", "--url", service.url, "--operator", "", "--limit", 1).assert_refused("operator")
    assert service.received == 0


@pytest.mark.parametrize(
    ("option", "value"),
    [("--clients", "0"), ("--clients", "1001"), ("--duration", "0"), ("--duration", "3601"), ("--duration", "nan"),
     ("--limit", "0"), ("--limit", "10000001"), ("--warm-up", "-1"), ("--warm-up", "3601"), ("--warm-up", "nan"),
     ("--window", "-1"), ("--window", "inf"), ("--seed", "-1"), ("--od", "anywhere")],
)  # fmt: skip
def test_an_option_outside_its_bounds_is_refused(airmatrix: Run, option: str, value: str) -> None:
    airmatrix("load", option, value).assert_misused(option)
