"""Promise: an emergency gets through at once, whoever is about; who has to make way hears of it, and nobody collides.

The busiest minute of a delivery rush in the middle of the shipped city. Hundreds of drones are in the air, or about
to be, when an ambulance drone asks to cross all of it in half a minute. Those in its way that have not been told to go
depart or fly a little differently. Those that are in the air or about to depart stay exactly as they are, and so does
another ambulance, which is to land at the same hospital at the same moment: it goes around them.
"""

import random
from contextlib import closing
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from app.commands.verify import checked
from app.flight_intents import Position
from app.ledger import open_ledger
from app.main import create_app
from app.settings import Settings
from app.times import format_time, parse_time
from planner.airspace import Airspace
from planner.buildings import shipped_airspace
from planner.separation import verify
from tests.api.bodies import PREVIEW, SUBMIT, recorded
from tests.api.serving import Client, served
from tests.ledger.district import START_MS
from tests.ledger.locations import on_sqlite
from tests.ledger.process import FakeClock

DELIVERIES, URGENT, NOTICE_MS = 240, 100, 60_000
# Deliveries depart over three minutes from here on; the emergency comes in their midst.
RUSH_BEGINS_MS, RUSH_MS = START_MS + 60_000, 180_000
EMERGENCY_MS = RUSH_BEGINS_MS + 80_000
# Columns of blocks from the middle: where the deliveries are, and between which ends the ambulances fly.
RUSH_REACH, AMBULANCE_REACH = 16, 24

pytestmark = [pytest.mark.compiled, on_sqlite]


@pytest.fixture
def city() -> Airspace:
    return shipped_airspace()


def flight(airspace: Airspace, origin: int, destination: int, earliest_ms: int, **members: Any) -> dict[str, Any]:
    """Return the body of a flight from one block's centre to another's."""

    def centre(block: int) -> dict[str, float]:
        x, y, alt_m = airspace.grid.centres(np.array([block]))[0]
        lon, lat = airspace.grid.unproject(x, y)
        return asdict(Position(float(lon), float(lat), float(alt_m)))

    return {
        "operator": "acme-air",
        "aircraft_type": "dji-matrice-600-pro",
        "origin": centre(origin),
        "destination": centre(destination),
        "earliest_departure": format_time(earliest_ms),
        **members,
    }


def pads(airspace: Airspace, reach: int) -> list[int]:
    """Return the lowest free block of each column around the middle, by row from the south: where drones stand."""
    count_i, count_j, count_k = airspace.grid.dimensions
    free = ~airspace.occupied.reshape(count_k, count_j, count_i)
    middle_i, middle_j = count_i // 2, count_j // 2
    return [
        int(airspace.grid.index((i, j, int(free[:, j, i].argmax()))))
        for j in range(middle_j - reach, middle_j + reach)
        for i in range(middle_i - reach, middle_i + reach)
        if free[:, j, i].any()
    ]


def everybody(client: Client) -> dict[str, dict[str, Any]]:
    """Return all flight intents by id."""
    items = client.get(SUBMIT, params={"limit": "500"}).json()
    assert items["next_cursor"] is None
    return {item["id"]: item for item in items["items"]}


def rush_hour(client: Client, airspace: Airspace, clock: FakeClock) -> None:
    """Fill the sky, and let time come to the emergency: operators activate their flights half a minute ahead."""
    chance, places = random.Random(7), pads(airspace, RUSH_REACH)
    for _ in range(DELIVERIES):
        origin, destination = chance.sample(places, 2)
        earliest_ms = RUSH_BEGINS_MS + chance.randrange(RUSH_MS)
        client.post(SUBMIT, json=flight(airspace, origin, destination, earliest_ms))
    clock.now_ms = EMERGENCY_MS
    for item in everybody(client).values():
        is_over = "departure" not in item or parse_time(item["arrival"]) < EMERGENCY_MS
        if not is_over and parse_time(item["departure"]) <= EMERGENCY_MS + NOTICE_MS / 2:
            assert client.post(f"{SUBMIT}/{item['id']}/activate").status_code == 200


def rival(client: Client, airspace: Airspace, hospital: int, arrival_ms: int) -> dict[str, Any]:
    """Submit an ambulance that comes from near by to arrive at a moment; return the answer."""
    pad = pads(airspace, AMBULANCE_REACH)[-8]
    members = {"operator": "hospital", "priority": URGENT}
    soon = client.post(PREVIEW, json=flight(airspace, pad, hospital, arrival_ms, **members)).json()
    earliest_ms = arrival_ms - round(soon["flight_time_s"] * 1000)
    response = client.post(SUBMIT, json=flight(airspace, pad, hospital, earliest_ms, **members))
    assert response.status_code == 201
    answer: dict[str, Any] = response.json()
    return answer


def test_an_ambulance_drone_crosses_the_city_at_the_busiest_minute(
    ledger: str, clock: FakeClock, city: Airspace
) -> None:
    settings = Settings.model_validate({"ledger": ledger, "monitor_every_s": 3600})
    with served(create_app(settings, clock)) as client:
        rush_hour(client, city, clock)
        home, *_, hospital = pads(city, AMBULANCE_REACH)
        body = flight(city, home, hospital, EMERGENCY_MS + 30_000, operator="ambulance")
        first = client.post(PREVIEW, json={**body, "priority": URGENT}).json()
        other = rival(client, city, hospital, parse_time(first["arrival"]))
        before = everybody(client)
        ordinary, urgent, most_urgent = (
            client.post(PREVIEW, json={**body, "priority": priority}).json() for priority in (0, URGENT, URGENT + 1)
        )
        response = client.post(SUBMIT, json={**body, "priority": URGENT})
        assert response.status_code == 201
        ambulance = response.json()
        after = everybody(client)
        told = client.get("/v1/events", params={"after": str(int(ambulance["version"]) - 1)}).json()["items"]

    # It is there sooner than a delivery would be. Who comes first among ambulances lands first.
    assert ambulance["delay_s"] < ordinary["delay_s"]
    assert most_urgent["delay_s"] == first["delay_s"] < ambulance["delay_s"]
    assert other["id"] in most_urgent["displaces"]
    assert after[other["id"]] == before[other["id"]] == recorded(other)

    # Who made way: deliveries on the ground, with notice, a little later or even sooner; all of them still fly.
    moved = {item["flight_intent_id"]: item for item in ambulance["displaced"]}
    assert set(urgent["displaces"]) == set(moved)
    for flight_id, item in moved.items():
        old, new = before[flight_id], after[flight_id]
        assert (old["state"], new["state"], item["state"]) == ("accepted", "accepted", "accepted")
        assert old["priority"] == 0
        assert parse_time(old["departure"]) >= EMERGENCY_MS + NOTICE_MS
        assert parse_time(new["departure"]) >= EMERGENCY_MS + NOTICE_MS
        for end in ("departure", "arrival"):
            assert item[f"{end}_moved_s"] == (parse_time(new[end]) - parse_time(old[end])) / 1000

    assert {item["sequence"]: item["arrival_moved_s"] for item in moved.values()} == {
        3: 4.298, 66: 1.084, 221: 1.95, 237: 0.985,
    }  # fmt: skip

    # Who did not: everybody else, to the millisecond.
    assert {n: item for n, item in after.items() if n not in {*moved, ambulance["id"]}} == {
        n: item for n, item in before.items() if n not in moved
    }

    # The journal tells it as one.
    assert [(event["flight_intent_id"], event["revision"]) for event in told] == [
        (flight_id, int(ambulance["version"])) for flight_id in (ambulance["id"], *moved)
    ]

    # Nothing overlaps, says who shares no code with the planner.
    with closing(open_ledger(ledger, city)) as opened:
        held = [checked(intent) for intent in opened.everything()[0] if intent.trajectory is not None]
    report = verify(city, held)
    assert report.violations == ()
    assert report.flights == sum("departure" in item for item in after.values())
