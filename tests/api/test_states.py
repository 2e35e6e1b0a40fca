"""States that move by themselves, and what the journal tells of aircraft."""

import pytest

from app.main import create_app
from app.settings import Settings
from tests.api.serving import Client, served
from tests.api.test_running import settings_with
from tests.api.test_telemetry import failing
from tests.api.watching import (
    ARRIVAL_MS,
    FRESHNESS_MS,
    LINK_MS,
    TOLERANCE_MS,
    activated,
    flights,
    fly,
    look,
    see,
    state_of,
    submit,
    told,
)
from tests.ledger.district import DEPARTURE_MS
from tests.ledger.locations import on_sqlite
from tests.ledger.process import FakeClock


def test_a_flight_in_the_air_without_activation_is_nonconforming(lanes: Client, clock: FakeClock) -> None:
    flight = submit(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    assert state_of(lanes, flight) == "accepted"
    look(lanes)
    assert state_of(lanes, flight) == "nonconforming"
    assert flights(lanes)[flight]["reasons"] == ["not_activated"]


@on_sqlite
def test_a_flight_that_keeps_to_its_plan_stays_activated_and_makes_no_event(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    for now in range(DEPARTURE_MS, ARRIVAL_MS, 1000):
        clock.now_ms = now
        fly(lanes, flight)
        look(lanes)
        assert state_of(lanes, flight) == "activated"
    assert [kind for kind, _, _ in told(lanes)] == ["accepted", "activated"]


def test_a_flight_that_leaves_its_lane_and_comes_back_is_nonconforming_meanwhile(
    lanes: Client, clock: FakeClock
) -> None:
    flight = activated(lanes)
    states = []
    for offset in (0.0, -1.0, 0.0):
        clock.now_ms = max(clock.now_ms + 1000, DEPARTURE_MS)
        see(lanes, flight, 0.5, 2.5 + offset)
        look(lanes)
        states.append(state_of(lanes, flight))
    assert states == ["activated", "nonconforming", "activated"]
    assert told(lanes) == [
        ("accepted", flight, []),
        ("activated", flight, []),
        ("nonconforming", flight, []),
        ("deviating", flight, ["off_track"]),
        ("activated", flight, []),
        ("conforming", flight, []),
    ]


def test_a_flight_that_has_landed_at_its_destination_is_over(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = ARRIVAL_MS
    see(lanes, flight, 7.5, 2.5, airborne=False)
    look(lanes)
    assert state_of(lanes, flight) == "ended"
    assert flight not in flights(lanes)


def test_a_lost_flight_is_contingent_after_half_a_minute(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    states = []
    for pass_ms in (FRESHNESS_MS, 1, 29_999, 1):
        clock.advance(ms=pass_ms)
        look(lanes)
        states.append(state_of(lanes, flight))
    assert states == ["activated", "nonconforming", "nonconforming", "contingent"]
    assert flights(lanes)[flight]["conformance"] == "lost"


@on_sqlite
def test_a_flight_that_violates_for_half_a_minute_is_contingent(lanes: Client, clock: FakeClock) -> None:
    # Somebody hovers in the lane between while a flight that has left its own hovers there too.
    flight = activated(lanes)
    states = []
    clock.now_ms = DEPARTURE_MS
    for _ in range(8):
        see(lanes, flight, 0.5, 1.5)
        see(lanes, "radar-1", 0.6, 1.5)
        look(lanes)
        states.append((state_of(lanes, flight), flights(lanes)[flight]["conformance"]))
        clock.advance(seconds=5)
    assert states[:6] == [("nonconforming", "violating")] * 6
    assert states[6:] == [("contingent", "violating")] * 2


@on_sqlite
def test_being_lost_and_violating_count_together(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    clock.advance(ms=FRESHNESS_MS + 1)
    look(lanes)
    for _ in range(5):
        # Back, but in a block that somebody else is in.
        clock.advance(seconds=6)
        see(lanes, flight, 0.5, 1.5)
        see(lanes, "radar-1", 0.6, 1.5)
        look(lanes)
    assert (state_of(lanes, flight), flights(lanes)[flight]["conformance"]) == ("contingent", "violating")


@on_sqlite
def test_a_flight_that_only_deviates_is_never_contingent(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    for _ in range(8):
        see(lanes, flight, 0.5, 1.5)
        look(lanes)
        clock.advance(seconds=5)
    assert state_of(lanes, flight) == "nonconforming"


@on_sqlite
def test_who_is_met_on_its_own_reservation_is_violating_but_not_to_blame(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    see(lanes, "radar-1", 0.6, 2.5)
    look(lanes)
    item = flights(lanes)[flight]
    assert (item["state"], item["conformance"]) == ("activated", "violating")
    assert item["reasons"] == ["several_aircraft", "reserved_by_another"]


@pytest.mark.parametrize("is_activated", [False, True])
def test_a_flight_that_nobody_ever_saw_ends_when_it_should_have_arrived(
    lanes: Client, clock: FakeClock, is_activated: bool
) -> None:
    flight = activated(lanes) if is_activated else submit(lanes)
    clock.now_ms = ARRIVAL_MS + TOLERANCE_MS
    look(lanes)
    assert state_of(lanes, flight) == ("activated" if is_activated else "accepted")
    clock.advance(ms=1)
    look(lanes)
    assert state_of(lanes, flight) == "ended"


def test_flights_that_nobody_saw_end_also_if_nobody_looked_for_long(lanes: Client, clock: FakeClock) -> None:
    first, second = submit(lanes), submit(lanes, "V", "F")
    later = submit(lanes, earliest_ms=DEPARTURE_MS + 90_000_000)
    clock.now_ms = DEPARTURE_MS + 86_400_000
    look(lanes)
    assert [state_of(lanes, flight) for flight in (first, second, later)] == ["ended", "ended", "accepted"]
    assert [(kind, whose) for kind, whose, _ in told(lanes)[3:]] == [("ended", first), ("ended", second)]


def test_what_has_not_changed_is_not_recorded_again(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    see(lanes, "radar-1", 3.5, 1.5)
    see(lanes, flight, 0.5, 1.5)
    look(lanes)
    before = told(lanes)
    clock.advance(ms=500)
    look(lanes)
    assert told(lanes) == before


def test_a_track_comes_and_is_lost_in_the_journal_and_goes_without_having_conformed(
    lanes: Client, clock: FakeClock
) -> None:
    see(lanes, "radar-1", 3.5, 1.5)
    for seconds in (0, 6, 60):
        clock.advance(seconds=seconds)
        look(lanes)
    assert told(lanes) == [
        ("deviating", "radar-1", ["no_flight_intent"]),
        ("lost", "radar-1", ["lost"]),
    ]
    (first, *_) = lanes.get("/v1/events").json()["items"]
    assert first == {
        "revision": 1, "time": "2026-11-22T08:00:00.000Z", "kind": "deviating", "flight_intent_id": None,
        "sequence": None, "track_id": "radar-1", "reasons": ["no_flight_intent"], "details": {},
    }  # fmt: skip


@on_sqlite
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, [("activated", "conforming"), ("nonconforming", "lost"), ("nonconforming", "lost")]),
        ({"freshness_s": 8}, [("activated", "conforming"), ("activated", "conforming"), ("nonconforming", "lost")]),
        ({"contingent_after_s": 4}, [("activated", "conforming"), ("nonconforming", "lost"), ("contingent", "lost")]),
    ],
    ids=["defaults", "freshness", "contingent after"],
)
def test_thresholds_are_settings(
    on_lanes: Settings, clock: FakeClock, options: dict[str, float], expected: list[tuple[str, str]]
) -> None:
    with served(create_app(settings_with(on_lanes, **options), clock)) as client:
        flight = activated(client)
        clock.now_ms = DEPARTURE_MS
        fly(client, flight)
        found = []
        for pass_ms in (5000, 1000, 4000):
            clock.advance(ms=pass_ms)
            look(client)
            found.append((state_of(client, flight), flights(client)[flight]["conformance"]))
    assert found == expected


@on_sqlite
@pytest.mark.parametrize(("tolerance_s", "reasons"), [(0, ["late"]), (2, [])])
def test_the_tolerance_is_a_setting(
    on_lanes: Settings, clock: FakeClock, tolerance_s: float, reasons: list[str]
) -> None:
    with served(create_app(settings_with(on_lanes, tolerance_s=tolerance_s), clock)) as client:
        flight = activated(client)
        # The first block is held until 1669 ms after departure.
        clock.now_ms = DEPARTURE_MS + LINK_MS + 1000
        see(client, flight, 0.9, 2.5)
        assert flights(client)[flight]["reasons"] == reasons


@on_sqlite
def test_a_server_that_only_reads_judges_but_records_nothing(on_lanes: Settings, clock: FakeClock) -> None:
    with served(create_app(on_lanes, clock)) as client:
        flight = submit(client)
        clock.now_ms = DEPARTURE_MS
        fly(client, flight)
    with served(create_app(settings_with(on_lanes, read_only=True), clock)) as reader:
        look(reader)
        assert [kind for kind, _, _ in told(reader)] == ["accepted"]
        assert flights(reader)[flight]["reasons"] == ["not_activated"]


def test_what_a_look_cannot_record_the_next_one_records_once(lanes: Client, clock: FakeClock) -> None:
    flight = submit(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    with failing("INSERT INTO remarks"), pytest.raises(Exception, match="disk I/O error"):
        look(lanes)
    assert told(lanes) == [("accepted", flight, [])]
    assert state_of(lanes, flight) == "accepted"
    look(lanes)
    assert [kind for kind, _, _ in told(lanes)] == ["accepted", "nonconforming", "conforming"]
