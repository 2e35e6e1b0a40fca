"""Promise: whatever operators ask for at once, what the ledger holds keeps every two aircraft a block apart.

Proven with the independent checker, which shares no code with the planner, over what the ledger says after the
requests were answered over HTTP; and again after a restart.
"""

import random
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from app.flight_intents import FlightIntent
from app.ledger import open_ledger
from app.main import create_app
from app.settings import Settings
from planner.airspace import Airspace
from planner.errors import Block
from planner.separation import CheckedFlight, Report, verify
from tests.api.bodies import SUBMIT, intent
from tests.api.serving import Client, served, settings_for
from tests.ledger.district import START_MS, district
from tests.ledger.process import FakeClock, assert_gapless, assert_no_overlaps

CITY = district(
    """
    ...............
    .##....#....##.
    .##....#....##.
    .......#.......
    ....#......#...
    ....#......#...
    ....#..##..#...
    .......##......
    ....#......#...
    ....#......#...
    ....#......#...
    .......#.......
    .##....#....##.
    .##....#....##.
    ...............
    """,
    """
    ...............
    .##....#....##.
    .#.....#.....#.
    .......#.......
    ...............
    ...............
    .......##......
    .......##......
    ...............
    ...............
    ...............
    .......#.......
    .#.....#.....#.
    .##....#....##.
    ...............
    """,
    "\n".join(["." * 15] * 15),
)
FLIGHTS = 60

pytestmark = pytest.mark.compiled


def checked(intent: FlightIntent) -> CheckedFlight:
    """Return an accepted intent as the checker wants it."""
    path, held = intent.trajectory, intent.reservations
    assert path is not None
    return CheckedFlight(intent.id, path.block, path.arrive_ms, path.depart_ms, held.block, held.enter_ms, held.exit_ms)


def verified(ledger: str, airspace: Airspace) -> Report:
    """Return what the checker says of a ledger's accepted flights."""
    with closing(open_ledger(ledger, airspace)) as opened:
        return verify(airspace, [checked(found) for found in opened.everything()[0] if found.state == "accepted"])


def submit_at_random(client: Client, chance: random.Random) -> list[dict[str, Any]]:
    """Submit flights between random free blocks within one minute; return the answers."""
    airspace = CITY.airspace
    free: list[Block] = [airspace.grid.block(n) for n in range(airspace.grid.block_count) if not airspace.occupied[n]]
    answers = []
    for _ in range(FLIGHTS):
        origin, destination = chance.sample(free, 2)
        body = intent(
            origin, destination, district=CITY, earliest_ms=START_MS + chance.randrange(60_000),
            window_ms=chance.choice([0, 60_000]),
        )  # fmt: skip
        answers.append(client.post(SUBMIT, json=body))
    assert {answer.status_code for answer in answers} == {201, 409}
    return [answer.json() for answer in answers]


@pytest.fixture
def city(ledger: str, tmp_path: Path) -> Settings:
    return settings_for(CITY, ledger, tmp_path)


def test_a_busy_district_stays_separated_also_after_a_restart(city: Settings, clock: FakeClock) -> None:
    chance = random.Random(1)
    ledger = city.ledger
    with served(create_app(city, clock)) as client:
        before = submit_at_random(client, chance)
        states = Counter(item["state"] for item in client.get(SUBMIT, params={"limit": "500"}).json()["items"])
    assert states.total() == FLIGHTS
    assert states["accepted"] == sum("departure" in answer for answer in before)
    report = verified(ledger, CITY.airspace)
    assert report.violations == ()
    assert (report.flights, report.released, report.cut) == (states["accepted"], 0, 0)
    assert report.closest is not None
    assert report.closest.horizontal_m >= 20 - 1e-6
    assert report.flight_pairs > FLIGHTS

    with served(create_app(city, clock)) as client:
        after = submit_at_random(client, chance)
    report = verified(ledger, CITY.airspace)
    assert report.violations == ()
    assert report.flights == sum("departure" in answer for answer in before + after)
    assert_no_overlaps(ledger)
    assert_gapless(ledger)


def test_the_checker_would_have_seen_two_flights_on_one_path(city: Settings, clock: FakeClock) -> None:
    with served(create_app(city, clock)) as client:
        client.post(SUBMIT, json=intent((0, 0, 0), (14, 14, 0), district=CITY))
        (flight,) = (checked(found) for found in client.service.ledger.everything()[0])
    twin = CheckedFlight(
        "twin", flight.block, flight.arrive_ms, flight.depart_ms, flight.hold_block, flight.hold_enter_ms,
        flight.hold_exit_ms,
    )  # fmt: skip
    assert {violation.kind.name for violation in verify(CITY.airspace, [flight, twin]).violations} == {
        "OVERLAP",
        "TOO_NEAR",
    }
