"""Promise: a flight gives up only what nobody can need any more, and `airmatrix verify` finds the rest in order.

Flights end before they depart, in the air and after they have landed; others fly through what they gave up.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from app.commands.verify import verify
from app.main import create_app
from app.settings import Settings
from tests.api.bodies import SUBMIT, TELEMETRY, intent, position, report
from tests.api.serving import Client, served, settings_for
from tests.ledger.district import DEPARTURE_MS, LANES, START_MS
from tests.ledger.locations import database
from tests.ledger.process import FakeClock, assert_no_overlaps

LINK_MS = 1668


@pytest.fixture
def on_lanes(ledger: str, tmp_path: Path) -> Settings:
    return settings_for(LANES, ledger, tmp_path)


@pytest.fixture
def lanes(on_lanes: Settings, clock: FakeClock) -> Iterator[Client]:
    with served(create_app(on_lanes, clock, elapsed_ms=clock)) as client:
        yield client


def submit(client: Client, origin: str, destination: str, **members: Any) -> str:
    answer = client.post(SUBMIT, json=intent(origin, destination, district=LANES, **members))
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def land(client: Client, flight: str, i: int, j: int) -> None:
    """Report an aircraft on the ground."""
    where = position((i, j, 0), client.service.clock(), district=LANES, flight_intent_id=flight, airborne=False)
    assert client.post(TELEMETRY, json=report(where)).json()["accepted"] == 1


def give_up(client: Client, flight: str, way: str) -> int:
    """End or cancel a flight; return how many reservations it keeps."""
    path = f"{SUBMIT}/{flight}"
    response = client.delete(path) if way == "cancel" else client.post(f"{path}/end")
    assert response.status_code == 200, response.text
    return len(response.json()["reservations"])


def assert_in_order(settings: Settings) -> None:
    """Fail if the independent checker finds a violation."""
    assert_no_overlaps(settings.ledger)
    verify(ledger=settings.ledger, airspace=settings.airspace)


@pytest.mark.parametrize("way", ["cancel", "end"])
def test_a_flight_that_never_departed_is_in_order_without_any_reservation(
    lanes: Client, on_lanes: Settings, way: str
) -> None:
    assert give_up(lanes, submit(lanes, "W", "E"), way) == 0
    assert_in_order(on_lanes)


@pytest.mark.parametrize("way", ["cancel", "end"])
@pytest.mark.parametrize(("links", "kept"), [(0, 2), (3, 5), (6.5, 8)])
def test_a_flight_that_landed_early_is_in_order_until_then(
    lanes: Client, on_lanes: Settings, clock: FakeClock, way: str, links: float, kept: int
) -> None:
    flight = submit(lanes, "W", "E")
    clock.now_ms = DEPARTURE_MS + int(links * LINK_MS)
    land(lanes, flight, int(links), 2)
    assert give_up(lanes, flight, way) == kept
    submit(lanes, "E", "W", earliest_ms=clock.now_ms + 1, window_ms=0)
    assert_in_order(on_lanes)


@pytest.mark.parametrize("way", ["cancel", "end"])
def test_a_flight_that_was_given_up_in_the_air_is_in_order_whole(
    lanes: Client, on_lanes: Settings, clock: FakeClock, way: str
) -> None:
    flight = submit(lanes, "W", "E")
    clock.now_ms = DEPARTURE_MS + LINK_MS
    assert give_up(lanes, flight, way) == 8
    assert_in_order(on_lanes)


def test_what_nobody_gave_up_is_still_missed(lanes: Client, on_lanes: Settings, clock: FakeClock) -> None:
    flight = submit(lanes, "W", "E")
    clock.now_ms = DEPARTURE_MS + 3 * LINK_MS
    land(lanes, flight, 3, 2)
    give_up(lanes, flight, "end")
    with database(on_lanes.ledger) as connection:
        connection.execute("DELETE FROM reservations WHERE enter = ?", [DEPARTURE_MS + LINK_MS])
    with pytest.raises(typer.Exit):
        assert_in_order(on_lanes)


def test_a_day_of_flights_that_end_in_every_way_is_in_order(
    lanes: Client, on_lanes: Settings, clock: FakeClock
) -> None:
    ends = [("W", "E", 2), ("E", "W", 2), ("V", "F", 0), ("F", "V", 0)]
    for n in range(24):
        clock.now_ms = START_MS + 20_000 * n
        origin, destination, lane = ends[n % 4]
        flight = submit(lanes, origin, destination, earliest_ms=clock.now_ms)
        departs = lanes.get(f"{SUBMIT}/{flight}").json()["departure"]
        assert departs
        clock.advance(ms=(n % 8) * LINK_MS)
        if n % 3:
            land(lanes, flight, 3, lane)
        give_up(lanes, flight, "end" if n % 2 else "cancel")
        submit(lanes, destination, origin, earliest_ms=clock.now_ms + 1)
    assert_in_order(on_lanes)
