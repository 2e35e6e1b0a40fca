"""Promise: one corridor, many who want it. First come, first served; never two at once; what is freed can be had.

The street is one block wide: whoever flies against the traffic must wait until it is over.
"""

import threading
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.main import create_app
from app.times import parse_time
from planner.separation import verify
from tests.api.bodies import SUBMIT, intent, problem
from tests.api.serving import Client, served, settings_for
from tests.ledger.district import STREET
from tests.ledger.process import FakeClock, assert_gapless, assert_no_overlaps
from tests.scenarios.test_busy_district import checked

CLIENTS, FLIGHTS = 8, 6


@pytest.fixture
def street(ledger: str, tmp_path: Path, clock: FakeClock) -> Iterator[Client]:
    with served(create_app(settings_for(STREET, ledger, tmp_path), clock)) as client:
        yield client


def ask(client: Client, origin: str, destination: str, **members: Any) -> httpx.Response:
    return client.post(SUBMIT, json=intent(origin, destination, district=STREET, **members))


def test_eight_operators_racing_for_one_corridor_get_it_one_after_the_other(street: Client, ledger: str) -> None:
    answers: list[httpx.Response] = []
    barrier = threading.Barrier(CLIENTS)

    def operator(number: int) -> None:
        barrier.wait()
        for _ in range(FLIGHTS):
            ends = ("W", "E") if number % 2 else ("E", "W")
            answers.append(ask(street, *ends, operator=f"operator-{number}", window_ms=3_600_000))

    threads = [threading.Thread(target=operator, args=[number]) for number in range(CLIENTS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [answer.status_code for answer in answers] == [201] * CLIENTS * FLIGHTS
    planned = sorted((answer.json() for answer in answers), key=lambda answer: answer["sequence"])
    assert [answer["sequence"] for answer in planned] == list(range(1, CLIENTS * FLIGHTS + 1))
    # Each is planned after everything before it, so nobody who came later delayed it: the first departs at once.
    assert planned[0]["delay_s"] == 0.0
    report = verify(STREET.airspace, [checked(found) for found in street.service.ledger.everything()[0]])
    assert report.violations == ()
    assert_no_overlaps(ledger)
    assert_gapless(ledger)


def test_flights_against_each_other_are_never_in_the_street_together(street: Client) -> None:
    planned = [ask(street, *ends, window_ms=3_600_000).json() for ends in ("WE", "EW", "WE", "EW")]
    spans = sorted((parse_time(answer["departure"]), parse_time(answer["arrival"])) for answer in planned)
    assert all(arrival < departure for (_, arrival), (departure, _) in pairwise(spans))


@pytest.mark.parametrize("ends", ["WE", "EW"])
def test_cancelling_a_flight_frees_the_corridor_for_the_one_it_was_refused_for(street: Client, ends: str) -> None:
    first = ask(street, "W", "E").json()
    refusal = problem(ask(street, *ends, window_ms=0), 409, "no-conflict-free-plan")
    assert refusal["conflicting_intents"] == [first["id"]]
    assert street.delete(f"{SUBMIT}/{refusal['conflicting_intents'][0]}").status_code == 200
    again = ask(street, *ends, window_ms=0)
    assert again.status_code == 201
    assert (again.json()["delay_s"], again.json()["sequence"]) == (0.0, 3)


@pytest.mark.parametrize("ends", ["WE", "EW"])
def test_the_departure_that_a_refusal_calls_feasible_is_feasible_and_no_earlier_one_is(
    street: Client, ends: str
) -> None:
    ask(street, "W", "E")
    refusal = problem(ask(street, *ends, window_ms=0), 409, "no-conflict-free-plan")
    feasible_ms = parse_time(refusal["earliest_feasible_departure"])
    problem(ask(street, *ends, earliest_ms=feasible_ms - 1, window_ms=0), 409, "no-conflict-free-plan")
    answer = ask(street, *ends, earliest_ms=feasible_ms, window_ms=0)
    assert answer.status_code == 201
    assert parse_time(answer.json()["departure"]) == feasible_ms


def test_a_cancelled_flight_in_the_air_keeps_the_corridor_until_it_arrives(street: Client, clock: FakeClock) -> None:
    first = ask(street, "W", "E").json()
    clock.now_ms = parse_time(first["departure"]) + 1
    street.delete(f"{SUBMIT}/{first['id']}")
    against = ask(street, "E", "W", earliest_ms=clock.now_ms).json()
    assert parse_time(against["departure"]) == parse_time(first["arrival"]) + 1
