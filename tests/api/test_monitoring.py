"""Conformance monitoring over HTTP: states that move by themselves, status, flights, alerts, the journal.

Two lanes lie 40 m apart, and between them one that nobody has reserved.
"""

import asyncio
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from app.main import create_app
from app.routes.flights import AlertList, FlightList
from app.routes.status import StatusAnswer
from app.settings import Settings
from app.times import format_time
from app.writer import Writer
from tests.api.bodies import SUBMIT, TELEMETRY, intent, position, problem, report
from tests.api.serving import Client, served, settings_for
from tests.api.test_running import settings_with
from tests.api.test_telemetry import failing
from tests.ledger.district import AIRCRAFT, DEPARTURE_MS, LANES, OLD_TOWN
from tests.ledger.locations import on_sqlite, write_lock
from tests.ledger.process import FakeClock, until

STATUS, FLIGHTS, ALERTS = "/v1/airspace/status", "/v1/flights", "/v1/airspace/alerts"
LINK_MS = 1668
ARRIVAL_MS = DEPARTURE_MS + 7 * LINK_MS
TOLERANCE_MS, FRESHNESS_MS = 2000, 5000
NONE = {"green": 0, "yellow": 0, "red": 0}


@pytest.fixture
def on_lanes(ledger: str, tmp_path: Path) -> Settings:
    return settings_for(LANES, ledger, tmp_path)


@pytest.fixture
def lanes(on_lanes: Settings, clock: FakeClock) -> Iterator[Client]:
    """Return a client of a service over two lanes."""
    with served(create_app(on_lanes, clock, elapsed_ms=clock)) as client:
        yield client


def submit(client: Client, origin: str = "W", destination: str = "E", **members: Any) -> str:
    body = intent(origin, destination, district=LANES, **members)
    return str(client.post(SUBMIT, json=body).json()["id"])


def activated(client: Client, origin: str = "W", destination: str = "E") -> str:
    flight = submit(client, origin, destination)
    assert client.post(f"{SUBMIT}/{flight}/activate").status_code == 200
    return flight


def see(client: Client, who: str, i: float, j: float, **members: Any) -> None:
    """Report where an aircraft is now, in blocks from the south-west corner; what is called radar is a track."""
    name = "track_id" if who.startswith("radar") else "flight_intent_id"
    where = LANES.point(i, j, members.pop("alt_m", 20.0))
    seen = position(where, client.service.clock(), **{name: who, "airborne": True, **members})
    assert client.post(TELEMETRY, json=report(seen)).json()["accepted"] == 1


def fly(client: Client, who: str, *, lane: int = 2) -> None:
    """Report a flight where it should be now."""
    see(client, who, 0.5 + (client.service.clock() - DEPARTURE_MS) / LINK_MS, lane + 0.5)


def look(client: Client) -> None:
    client.service.monitor.look()


def state_of(client: Client, flight: str) -> str:
    return str(client.get(f"{SUBMIT}/{flight}").json()["state"])


def colours(client: Client, **parameters: str) -> dict[tuple[int, ...], tuple[str, list[str]]]:
    """Return status and reasons of each block in use."""
    answer = client.get(STATUS, params=parameters).json()
    StatusAnswer.model_validate(answer)
    return {tuple(entry["block"]): (entry["status"], entry["reasons"]) for entry in answer["blocks"]}


def flights(client: Client) -> dict[str, dict[str, Any]]:
    """Return who flies now, by flight intent or track."""
    answer = client.get(FLIGHTS).json()
    FlightList.model_validate(answer)
    return {item["flight_intent_id"] or item["track_id"]: item for item in answer["items"]}


def alerts(client: Client) -> list[dict[str, Any]]:
    answer = client.get(ALERTS).json()
    AlertList.model_validate(answer)
    items: list[dict[str, Any]] = answer["items"]
    return items


def told(client: Client) -> list[tuple[str, str | None, list[str]]]:
    """Return what the journal tells: kind, whose, and why."""
    items = client.get("/v1/events").json()["items"]
    return [(item["kind"], item["flight_intent_id"] or item["track_id"], item["reasons"]) for item in items]


# States that move by themselves


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
        "sequence": None, "track_id": "radar-1", "reasons": ["no_flight_intent"],
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


# Status


@on_sqlite
def test_a_flight_on_its_reservations_is_green(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    assert colours(lanes) == {(0, 2, 0): ("green", []), (1, 2, 0): ("green", [])}


@on_sqlite
def test_a_flight_beside_its_reservations_is_yellow_there_and_here(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    see(lanes, flight, 0.5, 1.5)
    answer = lanes.get(STATUS).json()
    assert answer["counts"] == {"green": 0, "yellow": 3, "red": 0}
    ours = {"flight_intents": [flight], "track_ids": []}
    assert answer["blocks"] == [
        {"block": [0, 1, 0], "status": "yellow", "reasons": ["unplanned_use"], **ours},
        {"block": [0, 2, 0], "status": "yellow", "reasons": ["off_track"], **ours},
        {"block": [1, 2, 0], "status": "yellow", "reasons": ["off_track"], **ours},
    ]


@on_sqlite
@pytest.mark.parametrize(
    ("after_ms", "where", "reason"),
    [
        (1000, {"i": 1.1, "j": 2.5, "alt_m": 60}, "wrong_layer"),
        (0, {"i": 3.5, "j": 2.5}, "early"),
        (5 * LINK_MS, {"i": 1.5, "j": 2.5}, "late"),
        (0, None, None),
        (TOLERANCE_MS + 1, None, "not_seen"),
    ],
)
def test_a_reservation_is_yellow_for_the_reason_its_flight_gives(
    lanes: Client, clock: FakeClock, after_ms: int, where: dict[str, float] | None, reason: str | None
) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS + after_ms
    if where is not None:
        see(lanes, flight, **where)
    reserved = {tuple(hold["block"]) for hold in lanes.get(f"{SUBMIT}/{flight}").json()["reservations"]}
    found = {entry for block, (_, reasons) in colours(lanes).items() if block in reserved for entry in reasons}
    assert found == (set() if reason is None else {reason}) | (
        {"unplanned_use"} if reason in ("early", "late") else set()
    )


def test_a_stranger_on_a_reservation_makes_it_red(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    see(lanes, "radar-1", 1.5, 2.5)
    see(lanes, "radar-2", 0.6, 2.5)
    answer = lanes.get(STATUS).json()
    assert answer["counts"] == {"green": 0, "yellow": 0, "red": 2}
    assert answer["blocks"] == [
        {
            "block": [0, 2, 0], "status": "red", "reasons": ["several_aircraft", "reserved_by_another"],
            "flight_intents": [flight], "track_ids": ["radar-2"],
        },
        {
            "block": [1, 2, 0], "status": "red", "reasons": ["reserved_by_another"],
            "flight_intents": [flight], "track_ids": ["radar-1"],
        },
    ]  # fmt: skip


@on_sqlite
def test_an_aircraft_in_a_building_makes_it_red(client: Client) -> None:
    # The house in the middle of the old town.
    where = position(OLD_TOWN.centre((3, 2, 0)), client.service.clock(), track_id="radar-1", airborne=True)
    client.post(TELEMETRY, json=report(where))
    assert colours(client) == {(3, 2, 0): ("red", ["in_building", "unplanned_use"])}


@pytest.fixture
def mixed(lanes: Client, clock: FakeClock) -> Client:
    """Return a client of a service with green, yellow and red blocks, one of the red ones in the upper layer."""
    first, second = activated(lanes), activated(lanes, "V", "F")
    clock.now_ms = DEPARTURE_MS
    fly(lanes, first)
    see(lanes, second, 0.5, 0.5)
    see(lanes, "radar-1", 1.5, 0.5)
    see(lanes, "radar-2", 6.5, 1.5, alt_m=60.0)
    return lanes


@on_sqlite
@pytest.mark.parametrize(
    ("parameters", "blocks"),
    [
        ({}, [(0, 0, 0), (1, 0, 0), (0, 2, 0), (1, 2, 0), (6, 1, 1)]),
        ({"status": "green"}, [(0, 0, 0), (0, 2, 0), (1, 2, 0)]),
        ({"status": "yellow"}, [(6, 1, 1)]),
        ({"status": "red"}, [(1, 0, 0)]),
        ({"layer": "1"}, [(6, 1, 1)]),
        ({"layer": "0", "status": "yellow"}, []),
    ],
)
def test_filters_leave_out_and_do_not_count_the_rest(
    mixed: Client, parameters: dict[str, str], blocks: list[tuple[int, ...]]
) -> None:
    assert list(colours(mixed, **parameters)) == blocks
    assert sum(mixed.get(STATUS, params=parameters).json()["counts"].values()) == len(blocks)


@on_sqlite
def test_status_as_geojson_has_the_colours_too(mixed: Client) -> None:
    answer = mixed.get(STATUS, params={"f": "geojson", "status": "red"}).json()
    assert answer["counts"] == {"green": 0, "yellow": 0, "red": 1}
    (feature,) = answer["features"]
    assert {name: feature["properties"][name] for name in ("block", "status", "reasons", "track_ids")} == {
        "block": [1, 0, 0],
        "status": "red",
        "reasons": ["reserved_by_another"],
        "track_ids": ["radar-1"],
    }


@on_sqlite
def test_a_block_has_the_colour_and_the_reasons_that_status_says(mixed: Client) -> None:
    answer = mixed.get("/v1/airspace/blocks/1/0/0").json()
    assert (answer["status"], answer["reasons"]) == ("red", ["reserved_by_another"])


# The past and the future


def test_the_past_is_as_it_was_when_it_was_the_present(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    present = {}
    for seconds in range(-3, 25):
        clock.now_ms = DEPARTURE_MS + 1000 * seconds
        if seconds == 0:
            fly(lanes, flight)
        elif seconds == 1:
            see(lanes, flight, 1.2, 1.5)
            see(lanes, "radar-1", 1.3, 1.5)
        elif seconds == 2:
            see(lanes, "radar-1", 1.8, 2.5)
        elif seconds == 14:
            see(lanes, flight, 7.5, 2.5, airborne=False)
        look(lanes)
        present[format_time(clock.now_ms)] = lanes.get(STATUS).json()["blocks"]
    assert state_of(lanes, flight) == "ended"
    clock.advance(seconds=300)
    past = {at: lanes.get(STATUS, params={"at": at}).json()["blocks"] for at in present}
    assert past == present
    assert {entry["status"] for blocks in past.values() for entry in blocks} == {"green", "yellow", "red"}


@on_sqlite
def test_in_the_past_a_flight_has_the_state_that_it_had_then(on_lanes: Settings, clock: FakeClock) -> None:
    with served(create_app(settings_with(on_lanes, freshness_s=1, contingent_after_s=2), clock)) as client:
        flight = activated(client)
        clock.now_ms = DEPARTURE_MS
        fly(client, flight)
        for _ in range(5):
            clock.advance(seconds=1)
            look(client)
        client.post(f"{SUBMIT}/{flight}/end")
        then = [colours(client, at=format_time(DEPARTURE_MS + ms)) for ms in (3999, 4000, 5000)]
    reasons = [[reasons for _, reasons in blocks.values()] for blocks in then]
    assert reasons == [[["lost"]] * 2, [["lost", "contingent"]] * 2, [["lost"]] * 2]


def test_the_future_comes_from_reservations_alone(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    see(lanes, flight, 0.5, 1.5)
    see(lanes, "radar-1", 1.5, 2.5)
    look(lanes)
    assert colours(lanes, at=format_time(DEPARTURE_MS + 1)) == {(0, 2, 0): ("green", []), (1, 2, 0): ("green", [])}
    assert lanes.get(STATUS, params={"at": format_time(DEPARTURE_MS + 1)}).json()["clock"]["now"] == format_time(
        DEPARTURE_MS
    )


def test_the_past_says_which_positions_have_been_removed(lanes: Client, clock: FakeClock) -> None:
    see(lanes, "radar-1", 3.5, 1.5)
    at = format_time(clock.now_ms)
    clock.advance(seconds=3660)
    see(lanes, "radar-1", 3.5, 1.5)
    asyncio.run(until(lambda: lanes.get(STATUS).json()["positions_removed_before"] is not None))
    answer = lanes.get(STATUS, params={"at": at}).json()
    assert (answer["positions_removed_before"], answer["removed_before"]) == (
        format_time(clock.now_ms - 3_600_000),
        None,
    )
    assert answer["blocks"] == []


def test_where_positions_have_been_removed_nobody_is_missed(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    clock.advance(seconds=4)
    there = format_time(clock.now_ms)
    assert colours(lanes) == {(i, 2, 0): ("green", []) for i in (2, 3)}
    clock.advance(seconds=3 * 3600)
    see(lanes, "radar-1", 3.5, 1.5)
    asyncio.run(until(lambda: lanes.get(STATUS).json()["positions_removed_before"] is not None))
    assert colours(lanes, at=there) == {(i, 2, 0): ("green", []) for i in (2, 3)}


# Flights


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


# Two processes


def _wait(writers: list[Writer], count: int) -> bool:
    """Tell whether so many pieces of work wait, with as many writers as there are."""
    return all(writer.waiting for writer in writers[:count]) and sum(writer.waiting for writer in writers) >= count


def all_at_once(ledger: str, writers: list[Writer], *work: Callable[[], object]) -> None:
    """Do work in threads of their own, whose writers find the ledger locked until all of it waits to be recorded."""
    for writer in writers:
        # After the first of two answers it keeps house, which needs the lock too.
        for _ in range(2):
            writer.enqueue(lambda *_: None, lambda: None).future.result()
    with write_lock(ledger):
        for writer in writers:
            # The writer takes this and waits for the lock; what comes then waits behind it.
            writer.enqueue(lambda *_: None, lambda: None)
        asyncio.run(until(lambda: not any(writer.waiting for writer in writers)))
        threads = [threading.Thread(target=task) for task in work]
        for count, thread in enumerate(threads, start=1):
            thread.start()
            asyncio.run(until(partial(_wait, writers, count)))
    for thread in threads:
        thread.join()


def test_two_processes_answer_the_same(lanes: Client, on_lanes: Settings, clock: FakeClock) -> None:
    with served(create_app(on_lanes, clock)) as other:
        flight = activated(lanes)
        clock.now_ms = DEPARTURE_MS
        see(other, flight, 0.5, 1.5)
        see(lanes, "radar-1", 5.5, 2.5)
        look(other)
        for path in (STATUS, FLIGHTS, ALERTS, "/v1/events", f"{SUBMIT}/{flight}"):
            assert lanes.get(path).json() == other.get(path).json()
        assert colours(lanes)[0, 1, 0] == ("yellow", ["unplanned_use"])
        clock.advance(seconds=1)
        fly(lanes, flight)
        assert flights(other)[flight]["conformance"] == "conforming"


def test_two_monitors_that_look_at_once_record_each_change_once(
    lanes: Client, on_lanes: Settings, clock: FakeClock
) -> None:
    with served(create_app(on_lanes, clock)) as other:
        flight, unseen = submit(lanes), submit(lanes, "V", "F")
        clock.now_ms = DEPARTURE_MS
        see(lanes, flight, 0.5, 1.5)
        see(other, "radar-1", 3.5, 1.5)
        looks = [partial(look, client) for client in (lanes, other)]
        all_at_once(on_lanes.ledger, [lanes.service.writer, other.service.writer], *looks)
        recorded = told(lanes)[2:]
        assert sorted(recorded, key=str) == sorted(
            [
                ("nonconforming", flight, []),
                ("deviating", flight, ["off_track"]),
                ("deviating", "radar-1", ["no_flight_intent"]),
            ],
            key=str,
        )
        clock.now_ms = ARRIVAL_MS + TOLERANCE_MS + 1
        looks = [partial(look, client) for client in (lanes, other)]
        all_at_once(on_lanes.ledger, [lanes.service.writer, other.service.writer], *looks)
        assert [kind for kind, whose, _ in told(lanes) if whose == unseen] == ["accepted", "ended"]


@on_sqlite
def test_what_is_seen_is_shown_although_it_cannot_be_recorded_yet(
    lanes: Client, on_lanes: Settings, clock: FakeClock
) -> None:
    monitor = lanes.service.monitor
    see(lanes, "radar-1", 3.5, 1.5)
    with write_lock(on_lanes.ledger):
        first = monitor.look(patience_s=0.0)
        clock.advance(seconds=1)
        second = monitor.look(patience_s=0.0)
        assert (monitor.latest, second.at_ms - first.at_ms) == (second, 1000)
    look(lanes)
    assert told(lanes) == [("deviating", "radar-1", ["no_flight_intent"])]


@pytest.mark.parametrize(("action", "state"), [("activate", "activated"), ("end", "ended")])
def test_a_change_that_an_operator_made_meanwhile_is_not_undone(
    lanes: Client, on_lanes: Settings, clock: FakeClock, action: str, state: str
) -> None:
    flight = submit(lanes)
    clock.now_ms = DEPARTURE_MS
    fly(lanes, flight)
    answers: list[int] = []
    all_at_once(
        on_lanes.ledger,
        [lanes.service.writer],
        lambda: answers.append(lanes.post(f"{SUBMIT}/{flight}/{action}").status_code),
        partial(look, lanes),
    )
    assert answers == [200]
    assert state_of(lanes, flight) == state
