"""Status over HTTP: now, in the past and in the future."""

import asyncio

import pytest

from app.main import create_app
from app.settings import Settings
from app.times import format_time
from tests.api.bodies import SUBMIT, TELEMETRY, position, report
from tests.api.serving import Client, served
from tests.api.test_running import settings_with
from tests.api.watching import (
    LINK_MS,
    STATUS,
    TOLERANCE_MS,
    activated,
    colours,
    fly,
    look,
    see,
    state_of,
)
from tests.ledger.district import DEPARTURE_MS, OLD_TOWN
from tests.ledger.locations import on_sqlite
from tests.ledger.process import FakeClock, until


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
