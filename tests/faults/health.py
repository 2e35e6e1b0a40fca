"""What a service says of itself while a fault lasts, and how soon it is well again."""

import time
from collections.abc import Iterator

import httpx

from tests.faults.operators import Operators, Told
from tests.faults.traffic import Request

_POLL_S = 0.01
_PATIENCE_S = 30.0
_WELL_WITHIN_S = 60.0
_CLIENTS = 4


def undisturbed(url: str, requests: Iterator[Request], told: Told) -> list[str]:
    """Submit flights; return a complaint if not all of them are decided, as they must be without a fault."""
    asked = list(requests)
    with Operators(url, iter(asked), told, _CLIENTS) as operators:
        operators.wait()
    undecided = [request for request in asked if request.reference in told.unrecorded.keys() | told.unknown.keys()]
    return [f"{len(undecided)} requests were not decided, though nothing was wrong"] if undecided else []


def await_refusals(told: Told, slug: str = "ledger-unavailable") -> None:
    """Wait until an operator is told so."""
    before, until = told.problems(slug), time.monotonic() + _WELL_WITHIN_S
    while told.problems(slug) == before:
        if time.monotonic() > until:
            raise AssertionError(f"no request was answered {slug}")
        time.sleep(_POLL_S)


def complaints_while_unwritable(url: str, intent_id: str) -> list[str]:
    """Ask a service whose ledger cannot be written: it must be alive, say why it is not ready, and answer reads."""
    paths = [f"/v1/flight-intents/{intent_id}", "/v1/flight-intents", "/v1/airspace/status", "/v1/events"]
    with httpx.Client(base_url=url, timeout=_PATIENCE_S) as http:
        statuses = {path: http.get(path).status_code for path in (*paths, "/health/live")}
        readiness = http.get("/health/ready")
    found = [f"{path} answered {status}" for path, status in statuses.items() if status != 200]
    if readiness.status_code != 503 or not readiness.json().get("reason"):
        found.append(f"readiness says {readiness.status_code} {readiness.text}")
    return found


def seconds_until_ready(url: str) -> float:
    """Wait until a service says that it is ready again."""
    since = time.monotonic()
    said = "nothing"
    while time.monotonic() < since + _WELL_WITHIN_S:
        try:
            readiness = httpx.get(f"{url}/health/ready", timeout=_PATIENCE_S)
        except httpx.TransportError as error:
            said = repr(error)
        else:
            if readiness.status_code == 200:
                return time.monotonic() - since
            said = readiness.text
        time.sleep(_POLL_S)
    raise AssertionError(f"the service did not become ready again: {said}")
