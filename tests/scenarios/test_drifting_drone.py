"""Promise: ops staff see a deviation at once, whom it threatens before it happens, and that it is over.

Two drones fly east in parallel lanes, 40 m apart. The northern one is blown south, out of its lane and into the other's
way, and comes back. Everything is seen over HTTP, as the console sees it.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app.main import create_app
from app.times import format_time
from tests.api.bodies import SUBMIT, TELEMETRY, intent, position, report
from tests.api.serving import Client, served, settings_for
from tests.ledger.district import DEPARTURE_MS, LANES
from tests.ledger.process import FakeClock

LINK_MS = 1668
NORTH, SOUTH = 2.5, 0.5


@pytest.fixture
def lanes(ledger: str, tmp_path: Path, clock: FakeClock) -> Iterator[Client]:
    with served(create_app(settings_for(LANES, ledger, tmp_path), clock, elapsed_ms=clock)) as client:
        yield client


def planned(client: Client, origin: str, destination: str) -> str:
    """Submit a flight and activate it."""
    flight = client.post(SUBMIT, json=intent(origin, destination, district=LANES)).json()["id"]
    assert client.post(f"{SUBMIT}/{flight}/activate").json()["state"] == "activated"
    return str(flight)


def after(client: Client, clock: FakeClock, ms: int, lanes_flown: dict[str, float], *, airborne: bool = True) -> None:
    """Let each flight be seen so long after departure, as far east as planned and in these lanes; let it be judged."""
    clock.now_ms = DEPARTURE_MS + ms
    positions = [
        position(
            LANES.point(0.5 + min(ms / LINK_MS, 7), lane), clock.now_ms, district=LANES, flight_intent_id=flight,
            airborne=airborne,
        )
        for flight, lane in lanes_flown.items()
    ]  # fmt: skip
    answer = client.post(TELEMETRY, json=report(*positions)).json()
    assert answer == {"accepted": len(positions), "problem_count": 0, "problems": [], "flagged": []}
    client.service.monitor.look()


def colours(client: Client, status: str) -> list[tuple[list[int], list[str]]]:
    """Return the blocks of one colour, with their reasons."""
    answer = client.get("/v1/airspace/status", params={"status": status}).json()
    return [(entry["block"], entry["reasons"]) for entry in answer["blocks"]]


def conformance(client: Client) -> dict[str, tuple[str, str]]:
    """Return each flight's state and how it conforms."""
    return {
        item["flight_intent_id"]: (item["state"], item["conformance"])
        for item in client.get("/v1/flights").json()["items"]
    }


def alerts(client: Client) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = client.get("/v1/airspace/alerts").json()["items"]
    return items


def test_a_drone_drifts_into_another_s_way_and_comes_back(lanes: Client, clock: FakeClock) -> None:
    drifter, other = planned(lanes, "W", "E"), planned(lanes, "V", "F")

    # Both fly as planned: all green, and nothing to say.
    after(lanes, clock, 0, {drifter: NORTH, other: SOUTH})
    after(lanes, clock, 2000, {drifter: NORTH, other: SOUTH})
    assert conformance(lanes) == {drifter: ("activated", "conforming"), other: ("activated", "conforming")}
    assert [block for block, _ in colours(lanes, "green")] == [[1, 0, 0], [2, 0, 0], [1, 2, 0], [2, 2, 0]]
    assert (colours(lanes, "yellow"), colours(lanes, "red"), alerts(lanes)) == ([], [], [])

    # A gust: out of its lane within a second, into the one that nobody has reserved. Yellow where it is, and where it
    # should be.
    after(lanes, clock, 3000, {drifter: 1.9, other: SOUTH})
    assert conformance(lanes) == {drifter: ("nonconforming", "deviating"), other: ("activated", "conforming")}
    assert colours(lanes, "yellow") == [
        ([2, 1, 0], ["unplanned_use"]),
        ([1, 2, 0], ["off_track"]),
        ([2, 2, 0], ["off_track"]),
    ]
    assert colours(lanes, "red") == []

    # Going on like this it meets the other flight: the alert says where, and that a second and a half are left.
    (alert,) = alerts(lanes)
    assert (alert["flight_intent_id"], alert["severity"], alert["reasons"]) == (drifter, "red", ["off_track"])
    assert alert["message"] == "acme-air no. 1 is off its reserved blocks."
    threat = alert["threatens"][0]
    assert (threat["flight_intent_id"], threat["block"]) == (other, [3, 0, 0])
    assert threat["enter"] == format_time(DEPARTURE_MS + 2 * LINK_MS)
    assert threat["reach_s"] == pytest.approx(1.5, abs=0.1)
    raised = alert["raised"]

    # And it does: two drones in one block. Both are violating; the alert is about the one that has left its plan.
    after(lanes, clock, 4500, {drifter: 0.9, other: SOUTH})
    assert colours(lanes, "red") == [([3, 0, 0], ["several_aircraft", "reserved_by_another"])]
    assert conformance(lanes) == {drifter: ("nonconforming", "violating"), other: ("activated", "violating")}
    (alert,) = alerts(lanes)
    assert (alert["flight_intent_id"], alert["severity"], alert["conformance"]) == (drifter, "red", "violating")
    assert alert["reasons"] == ["off_track", "several_aircraft", "reserved_by_another"]
    assert alert["raised"] == raised == format_time(DEPARTURE_MS + 3000)

    # Back in its lane, on time: as if nothing had been.
    after(lanes, clock, 6500, {drifter: NORTH, other: SOUTH})
    assert conformance(lanes) == {drifter: ("activated", "conforming"), other: ("activated", "conforming")}
    assert (colours(lanes, "yellow"), colours(lanes, "red"), alerts(lanes)) == ([], [], [])

    # Both land, and the lanes are free.
    after(lanes, clock, 7 * LINK_MS, {drifter: NORTH, other: SOUTH}, airborne=False)
    assert conformance(lanes) == {}
    clock.advance(ms=1)
    assert lanes.get("/v1/airspace/status").json()["blocks"] == []

    # What happened can be read in the journal, and looked at again.
    events = lanes.get("/v1/events", params={"after": "4"}).json()["items"]
    told = [(event["time"], event["flight_intent_id"], event["kind"]) for event in events]
    assert {ms: {(who, kind) for time, who, kind in told if time == format_time(DEPARTURE_MS + ms)} for ms in (
        3000, 4500, 6500, 7 * LINK_MS,
    )} == {
        3000: {(drifter, "nonconforming"), (drifter, "deviating")},
        4500: {(drifter, "violating"), (other, "violating")},
        6500: {(drifter, "activated"), (drifter, "conforming"), (other, "conforming")},
        7 * LINK_MS: {(drifter, "ended"), (other, "ended")},
    }  # fmt: skip
    assert len(told) == 9
    past = lanes.get("/v1/airspace/status", params={"at": format_time(DEPARTURE_MS + 4500)}).json()
    assert past["counts"]["red"] == 1
