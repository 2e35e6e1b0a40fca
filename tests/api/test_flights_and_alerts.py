"""Flights and alerts over HTTP."""

import pytest

from app.main import create_app
from app.settings import Settings
from app.times import format_time
from tests.api.bodies import problem
from tests.api.serving import Client, served
from tests.api.test_running import settings_with
from tests.api.test_telemetry import failing
from tests.api.watching import (
    ALERTS,
    ARRIVAL_MS,
    FLIGHTS,
    FRESHNESS_MS,
    LINK_MS,
    activated,
    alerts,
    flights,
    fly,
    look,
    see,
    submit,
)
from tests.ledger.district import AIRCRAFT, DEPARTURE_MS, LANES
from tests.ledger.locations import on_sqlite
from tests.ledger.process import FakeClock


def test_a_flight_says_everything_about_itself(lanes: Client, clock: FakeClock) -> None:
    flight = submit(lanes, reference="ORD-7781")
    clock.now_ms = DEPARTURE_MS
    see(lanes, flight, 0.5, 2.5)
    look(lanes)
    clock.advance(ms=800)
    answer = lanes.get(FLIGHTS).json()
    where = LANES.point(0.5, 2.5)
    assert answer == {
        "at": format_time(DEPARTURE_MS + 800),
        "clock": {"now": format_time(DEPARTURE_MS + 800), "rate": 1.0, "simulated": False},
        "items": [
            {
                "flight_intent_id": flight, "track_id": None, "sequence": 1, "operator": "acme-air",
                "reference": "ORD-7781", "aircraft_type": AIRCRAFT, "state": "nonconforming",
                "conformance": "conforming", "reasons": ["not_activated"], "since": format_time(DEPARTURE_MS),
                "departure": format_time(DEPARTURE_MS), "arrival": format_time(ARRIVAL_MS),
                "position": {
                    "time": format_time(DEPARTURE_MS), "lon": where.lon, "lat": where.lat, "alt_m": 20.0,
                    "airborne": True, "block": [0, 2, 0], "age_s": 0.8, "flagged": False,
                },
                "velocity_mps": None,
            }
        ],
        "next_cursor": None,
    }  # fmt: skip


@on_sqlite
def test_a_track_says_what_is_known_of_it(lanes: Client, clock: FakeClock) -> None:
    see(lanes, "radar-1", 3.5, 1.5)
    clock.advance(seconds=1)
    see(lanes, "radar-1", 4.0, 1.5)
    item = flights(lanes)["radar-1"]
    nothing = (
        "flight_intent_id",
        "sequence",
        "operator",
        "reference",
        "aircraft_type",
        "state",
        "departure",
        "arrival",
    )
    assert [item[name] for name in nothing] == [None] * len(nothing)
    assert (item["conformance"], item["reasons"], item["since"]) == ("deviating", ["no_flight_intent"], None)
    assert item["velocity_mps"] == pytest.approx({"east": 10.0, "north": 0.0, "up": 0.0}, abs=0.5)


def test_since_when_is_known_once_somebody_has_looked(lanes: Client, clock: FakeClock) -> None:
    found = []
    see(lanes, "radar-1", 3.5, 1.5)
    for pass_ms in (0, FRESHNESS_MS + 1):
        clock.advance(ms=pass_ms)
        for _ in range(2):
            item = flights(lanes)["radar-1"]
            found.append((item["conformance"], item["since"]))
            look(lanes)
    assert found == [
        ("deviating", None),
        ("deviating", "2026-11-22T08:00:00.000Z"),
        ("lost", None),
        ("lost", "2026-11-22T08:00:05.001Z"),
    ]


@pytest.mark.parametrize(
    ("before_ms", "listed"), [(60_001, False), (60_000, False), (59_999, True), (0, True), (-11_000, True)]
)
def test_a_flight_is_listed_from_a_minute_before_it_departs(
    lanes: Client, clock: FakeClock, before_ms: int, listed: bool
) -> None:
    flight = submit(lanes, earliest_ms=DEPARTURE_MS + 60_000)
    clock.now_ms = DEPARTURE_MS + 60_000 - before_ms
    assert (flight in flights(lanes)) == listed


@pytest.mark.parametrize(("after_ms", "listed"), [(60_000, True), (60_001, False)])
def test_a_track_is_listed_for_a_minute_after_it_was_seen(
    lanes: Client, clock: FakeClock, after_ms: int, listed: bool
) -> None:
    see(lanes, "radar-1", 3.5, 1.5)
    clock.advance(ms=after_ms)
    assert ("radar-1" in flights(lanes)) == listed


@on_sqlite
@pytest.mark.parametrize("path", [FLIGHTS, ALERTS])
def test_who_flies_cannot_be_said_without_the_ledger(lanes: Client, path: str) -> None:
    with failing("SELECT"):
        problem(lanes.get(path), 503, "ledger-unavailable")


# Alerts


@on_sqlite
def test_without_deviations_there_are_no_alerts(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    assert alerts(lanes) == []


def test_an_alert_names_whom_an_aircraft_threatens_and_when(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes, "V", "F")
    # Over the fourth block of the southern lane's side, and with two metres a second towards it.
    clock.now_ms = DEPARTURE_MS - 1000
    see(lanes, "radar-1", 3.5, 1.6)
    clock.advance(seconds=1)
    see(lanes, "radar-1", 3.5, 1.5)
    look(lanes)
    (alert,) = alerts(lanes)
    (threat,) = alert.pop("threatens")
    assert alert.pop("position")["block"] == [3, 1, 0]
    assert alert == {
        "id": f"radar-1@{DEPARTURE_MS}", "raised": format_time(DEPARTURE_MS), "severity": "red",
        "flight_intent_id": None, "track_id": "radar-1", "conformance": "deviating", "reasons": ["no_flight_intent"],
        "message": "Track radar-1 has no flight intent.",
    }  # fmt: skip
    assert threat.pop("reach_s") == pytest.approx(5.0, abs=0.2)
    assert threat == {
        "flight_intent_id": flight,
        "block": [3, 0, 0],
        "enter": format_time(DEPARTURE_MS + 2 * LINK_MS),
        "exit": format_time(DEPARTURE_MS + 4 * LINK_MS + 1),
    }


@on_sqlite
@pytest.mark.parametrize(("projection_s", "severity", "threats"), [(4, "yellow", 0), (6, "red", 1)])
def test_an_aircraft_that_reaches_nobody_in_time_is_yellow(
    on_lanes: Settings, clock: FakeClock, projection_s: float, severity: str, threats: int
) -> None:
    with served(create_app(settings_with(on_lanes, projection_s=projection_s), clock)) as client:
        activated(client, "V", "F")
        clock.now_ms = DEPARTURE_MS - 1000
        see(client, "radar-1", 3.5, 1.6)
        clock.advance(seconds=1)
        see(client, "radar-1", 3.5, 1.5)
        (alert,) = alerts(client)
    assert (alert["severity"], len(alert["threatens"])) == (severity, threats)


@on_sqlite
def test_the_newest_alert_comes_first_and_keeps_its_time(lanes: Client, clock: FakeClock) -> None:
    for n in range(3):
        for track in range(n + 1):
            see(lanes, f"radar-{track}", 2.5 * track + 0.5, 1.5)
        look(lanes)
        clock.advance(seconds=1)
    assert [(alert["track_id"], alert["raised"]) for alert in alerts(lanes)] == [
        ("radar-2", "2026-11-22T08:00:02.000Z"),
        ("radar-1", "2026-11-22T08:00:01.000Z"),
        ("radar-0", "2026-11-22T08:00:00.000Z"),
    ]


@on_sqlite
def test_an_alert_goes_with_its_cause(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    see(lanes, flight, 0.5, 1.5)
    look(lanes)
    assert [(alert["severity"], alert["message"]) for alert in alerts(lanes)] == [
        ("yellow", "acme-air no. 1 is off its reserved blocks.")
    ]
    clock.advance(seconds=1)
    fly(lanes, flight)
    look(lanes)
    assert alerts(lanes) == []
