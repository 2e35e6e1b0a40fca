"""Closed airspace over HTTP: made, listed, removed; planned around, and red where somebody is in it."""

import asyncio
from typing import Any

import pytest

from app.constraints import MOST_CONSTRAINTS, Constraint
from app.main import create_app
from app.settings import Settings
from app.times import format_time
from tests.api.bodies import PROBLEM, SUBMIT, intent, problem
from tests.api.serving import Client, served
from tests.api.streaming import streaming
from tests.api.test_running import settings_with
from tests.api.watching import LINK_MS, STATUS, activated, alerts, colours, fly, look, see, state_of, submit, told
from tests.ledger.district import DEPARTURE_MS, LANES, START_MS
from tests.ledger.locations import on_sqlite
from tests.ledger.process import FakeClock, until

CONSTRAINTS = "/v1/constraints"
CONSTRAINT = {"id", "name", "polygon", "base_m", "top_m", "from", "until", "created", "removed", "blocks"}
NOBODY = "0199d1ad-0000-7000-8000-000000000000"
DAY_MS = 86_400_000


def area(west: float, south: float, east: float, north: float) -> dict[str, Any]:
    """Return a rectangle as GeoJSON, given in blocks from the south-west corner."""
    corners = [(west, south), (east, south), (east, north), (west, north), (west, south)]
    points = [LANES.point(*corner) for corner in corners]
    return {"type": "Polygon", "coordinates": [[[point.lon, point.lat] for point in points]]}


# The second to fifth blocks of the northern lane, and the street between the lanes beside them.
WAY = area(2.1, 1.1, 4.9, 2.9)


def body(polygon: dict[str, Any] = WAY, **members: Any) -> dict[str, Any]:
    return {"name": "Parade", "polygon": polygon, **members}


def close(
    client: Client, polygon: dict[str, Any] = WAY, *, begins_ms: int | None = None, **members: Any
) -> dict[str, Any]:
    """Close airspace, the lower layer unless told otherwise, and return the answer."""
    begins = {} if begins_ms is None else {"from": format_time(begins_ms)}
    answer = client.post(CONSTRAINTS, json=body(polygon, **{"top_m": 40, **begins, **members}))
    assert answer.status_code == 201, answer.text
    made: dict[str, Any] = answer.json()
    assert set(made) == CONSTRAINT | {"displaced", "unmoved"}
    return made


def listed(client: Client, **parameters: Any) -> list[str]:
    """Return the names of the constraints in a list."""
    answer = client.get(CONSTRAINTS, params=parameters).json()
    assert set(answer) == {"items", "next_cursor"}
    assert all(set(item) == CONSTRAINT for item in answer["items"])
    return [item["name"] for item in answer["items"]]


def blocks_of(client: Client, flight: str) -> set[tuple[int, ...]]:
    return {tuple(hold["block"]) for hold in client.get(f"{SUBMIT}/{flight}").json()["reservations"]}


# Made, listed, removed


def test_a_constraint_is_made_and_read(lanes: Client, clock: FakeClock) -> None:
    made = close(lanes, until=format_time(START_MS + 1000))
    assert {name: made[name] for name in made if name != "id"} == {
        "name": "Parade", "polygon": WAY, "base_m": 0.0, "top_m": 40.0,
        "from": format_time(clock.now_ms), "until": format_time(START_MS + 1000),
        "created": format_time(clock.now_ms), "removed": None, "blocks": 6, "displaced": [], "unmoved": [],
    }  # fmt: skip
    read = lanes.get(f"{CONSTRAINTS}/{made['id']}").json()
    assert read == {name: made[name] for name in CONSTRAINT}
    assert lanes.get(CONSTRAINTS).json() == {"items": [read], "next_cursor": None}


@on_sqlite
def test_the_answer_says_where_the_constraint_can_be_read(lanes: Client) -> None:
    answer = lanes.post(CONSTRAINTS, json=body())
    assert lanes.get(answer.headers["Location"]).json()["id"] == answer.json()["id"]


@on_sqlite
def test_of_members_that_nobody_knows_the_first_is_told(lanes: Client) -> None:
    for known in ({}, {"from": format_time(START_MS)}):
        answer = problem(lanes.post(CONSTRAINTS, json=body(colour="red", size=3) | known), 422, "validation-error")
        assert [error["loc"] for error in answer["errors"]] == [["body", "colour"]]


@on_sqlite
def test_a_constraint_is_for_good_and_without_a_top_unless_told(lanes: Client) -> None:
    made = lanes.post(CONSTRAINTS, json=body()).json()
    assert (made["base_m"], made["top_m"], made["until"], made["blocks"]) == (0.0, None, None, 12)


def test_the_list_has_those_in_force_and_to_come_in_their_order(lanes: Client, clock: FakeClock) -> None:
    close(lanes, name="over", until=format_time(START_MS + 1000))
    close(lanes, name="to come", begins_ms=START_MS + 3_600_000)
    removed = close(lanes, name="removed")["id"]
    close(lanes, name="in force")
    assert listed(lanes) == ["over", "to come", "removed", "in force"]
    clock.advance(seconds=1)
    assert lanes.delete(f"{CONSTRAINTS}/{removed}").json()["removed"] == format_time(clock.now_ms)
    assert listed(lanes) == ["to come", "in force"]


def test_the_list_of_another_time_has_those_in_force_then(lanes: Client, clock: FakeClock) -> None:
    close(lanes, name="over", until=format_time(START_MS + 1000))
    removed = close(lanes, name="removed", begins_ms=START_MS - 60_000)["id"]
    close(lanes, name="to come", begins_ms=START_MS + 3_600_000)
    assert listed(lanes, at=format_time(START_MS)) == ["over", "removed"]
    clock.advance(seconds=2)
    gone = lanes.delete(f"{CONSTRAINTS}/{removed}").json()
    assert gone in lanes.get(CONSTRAINTS, params={"at": format_time(START_MS)}).json()["items"]
    in_force = {ms: listed(lanes, at=format_time(START_MS + ms)) for ms in (-1, 0, 999, 1000, 1999, 2000, 3_600_000)}
    assert in_force == {
        -1: [],
        0: ["over", "removed"],
        999: ["over", "removed"],
        1000: ["removed"],
        1999: ["removed"],
        2000: [],
        3_600_000: ["to come"],
    }


@on_sqlite
@pytest.mark.parametrize("at", [{}, {"at": format_time(START_MS)}])
def test_the_list_comes_in_pages(lanes: Client, at: dict[str, str]) -> None:
    for name in "abc":
        close(lanes, name=name)
    first = lanes.get(CONSTRAINTS, params={"limit": 2, **at}).json()
    assert [item["name"] for item in first["items"]] == ["a", "b"]
    assert listed(lanes, cursor=first["next_cursor"], limit=2, **at) == ["c"]
    last = lanes.get(CONSTRAINTS, params={"cursor": first["next_cursor"], "limit": 1, **at}).json()
    assert last["next_cursor"] is None
    problem(lanes.get(CONSTRAINTS, params={"cursor": "x"}), 422, "invalid-cursor")


@on_sqlite
@pytest.mark.parametrize("asked", [{"params": {"f": "geojson"}}, {"headers": {"accept": "application/geo+json"}}])
def test_the_list_comes_as_geojson(lanes: Client, asked: dict[str, Any]) -> None:
    made = close(lanes)
    answer = lanes.get(CONSTRAINTS, **asked)
    assert answer.headers["content-type"] == "application/geo+json"
    (feature,) = answer.json()["features"]
    assert (feature["type"], feature["id"], feature["geometry"]) == ("Feature", made["id"], WAY)
    assert feature["properties"] == {name: made[name] for name in CONSTRAINT - {"polygon"}}


@on_sqlite
def test_a_removed_constraint_stays_to_be_read_and_removing_it_again_changes_nothing(
    lanes: Client, clock: FakeClock
) -> None:
    path = f"{CONSTRAINTS}/{close(lanes)['id']}"
    removed = lanes.delete(path).json()
    clock.advance(seconds=1)
    assert lanes.delete(path).json() == removed
    assert lanes.get(path).json() == removed
    assert [kind for kind, _, _ in told(lanes)] == ["constraint_created", "constraint_removed"]


@on_sqlite
@pytest.mark.parametrize("name", [NOBODY, "nothing", "%00"])
def test_an_unknown_constraint_is_404(lanes: Client, name: str) -> None:
    problem(lanes.get(f"{CONSTRAINTS}/{name}"), 404, "unknown-constraint")
    problem(lanes.delete(f"{CONSTRAINTS}/{name}"), 404, "unknown-constraint")


@on_sqlite
def test_retention_takes_those_that_are_long_over_but_for_the_newest(on_lanes: Settings, clock: FakeClock) -> None:
    kept = settings_with(on_lanes, retention_days=1, idempotency_hours=1)
    with served(create_app(kept, clock, elapsed_ms=clock)) as lanes:
        soon = format_time(START_MS + 1000)
        paths = [f"{CONSTRAINTS}/{close(lanes, until=ends)['id']}" for ends in (None, soon, None, soon)]
        lanes.delete(paths[0])
        clock.advance(ms=DAY_MS + 3_600_000)

        def left() -> list[int]:
            # Behind an answer the writer keeps house.
            lanes.delete(f"{CONSTRAINTS}/{NOBODY}")
            return [lanes.get(path).status_code for path in paths]

        asyncio.run(until(lambda: left() == [404, 404, 200, 200]))
        close(lanes, name="the next")
        assert listed(lanes) == ["Parade", "the next"]


# What is refused


MALFORMED: list[tuple[dict[str, Any], str]] = [
    ({"name": ""}, "name"),
    ({"name": None}, "name"),
    ({"base_m": "0"}, "base_m"),
    ({"top_m": True}, "top_m"),
    ({"until": format_time(START_MS)}, "until"),
    ({"from": format_time(START_MS + 2), "until": format_time(START_MS + 2)}, "until"),
    ({"from": format_time(START_MS - 2), "until": format_time(START_MS - 1)}, "until"),
    ({"from": format_time(START_MS - DAY_MS - 1)}, "from"),
    ({"polygon": {"type": "Point", "coordinates": [71.4, 51.1]}}, "polygon"),
    ({"polygon": {"type": "Polygon", "coordinates": [[[71.4, 51.1], [71.5, 51.1]]]}}, "polygon"),
    ({"polygon": {"type": "Polygon", "coordinates": [[[71.4, "51"]] * 4]}}, "polygon"),
    ({"polygon": {**WAY, "crs": "EPSG:32642"}}, "polygon"),
    ({"colour": "red"}, "colour"),
]


@on_sqlite
def test_malformed_bodies_are_refused(lanes: Client) -> None:
    for members, where in MALFORMED:
        document = problem(lanes.post(CONSTRAINTS, json=body(**members)), 422, "validation-error")
        assert {error["loc"][1] for error in document["errors"]} == {where}
    assert listed(lanes) == []


@on_sqlite
def test_a_constraint_may_have_begun_a_day_ago(lanes: Client) -> None:
    assert close(lanes, begins_ms=START_MS - DAY_MS)["from"] == format_time(START_MS - DAY_MS)


NO_VOLUMES: list[tuple[dict[str, Any], dict[str, float], str]] = [
    (area(9, 0, 10, 1), {}, "outside the airspace"),
    (WAY, {"base_m": 80.0}, "outside the airspace"),
    (WAY, {"base_m": 40.0, "top_m": 40.0}, "must lie above the base"),
    ({"type": "Polygon", "coordinates": [WAY["coordinates"][0][:-1]]}, {}, "malformed"),
    (area(1, 1, 1, 2), {}, "not valid"),
]


@on_sqlite
def test_what_is_no_volume_of_the_airspace_is_refused(lanes: Client) -> None:
    for polygon, members, words in NO_VOLUMES:
        document = problem(lanes.post(CONSTRAINTS, json=body(polygon, **members)), 422, "invalid-volume")
        assert words in document["detail"]


@on_sqlite
def test_there_may_be_no_more_than_so_many_in_force_and_to_come(lanes: Client) -> None:
    close(lanes, name="over soon", until=format_time(START_MS + 1))
    first = lanes.service.ledger.constraint(lanes.get(CONSTRAINTS).json()["items"][0]["id"])
    assert first is not None

    def another(number: int) -> Constraint:
        return Constraint(0, f"{number}", "more", first.polygon, 0.0, None, START_MS + 1, None, first.blocks[:1], 0)

    more = lanes.service.writer.enqueue(
        lambda transaction, now: [
            transaction.record_constraint(another(number), now) for number in range(MOST_CONSTRAINTS - 1)
        ],
        lambda: None,
    ).future.result()
    assert {(each.number, each.created_ms) for each in more} == {
        (number, START_MS) for number in range(2, MOST_CONSTRAINTS + 1)
    }
    problem(lanes.post(CONSTRAINTS, json=body()), 409, "too-many-constraints")
    lanes.service.clock.advance(ms=1)  # type: ignore[attr-defined]
    close(lanes)


# Planning around it


def test_nothing_is_planned_through_a_constraint_while_it_is_in_force(lanes: Client) -> None:
    made = close(lanes, until=format_time(DEPARTURE_MS + 600_000))
    around = blocks_of(lanes, submit(lanes))
    assert {block for block in around if 2 <= block[0] <= 4} & {(i, j, 0) for i in (2, 3, 4) for j in (1, 2)} == set()
    assert any(block[2] == 1 or block[1] == 0 for block in around)
    lanes.delete(f"{CONSTRAINTS}/{made['id']}")
    assert blocks_of(lanes, submit(lanes)) == {(i, 2, 0) for i in range(8)}


@on_sqlite
def test_who_can_wait_until_it_ends_departs_later(lanes: Client) -> None:
    ends_ms = DEPARTURE_MS + 20_000
    close(lanes, area(-1, -1, 9, 9), top_m=None, until=format_time(ends_ms))
    answer = lanes.post(SUBMIT, json=intent("W", "E", district=LANES)).json()
    assert answer["departure"] == format_time(ends_ms)


def test_a_refusal_names_the_constraints_in_the_way(lanes: Client) -> None:
    walls = [close(lanes, area(i, -1, i + 0.9, 9), top_m=None)["id"] for i in (3, 4)]
    document = problem(lanes.post(SUBMIT, json=intent("W", "E", district=LANES)), 409, "no-conflict-free-plan")
    assert set(document) == PROBLEM | {
        "reason", "conflicting_intents", "conflicting_constraints", "flight_intent_id", "sequence",
    }  # fmt: skip
    assert (document["conflicting_intents"], document["conflicting_constraints"]) == ([], walls[:1])
    kept = lanes.get(f"{SUBMIT}/{document['flight_intent_id']}").json()["refusal"]
    assert kept["conflicting_constraints"] == walls[:1]


def test_flights_in_its_way_are_planned_again_and_those_without_a_way_are_displaced(lanes: Client) -> None:
    southern, northern = submit(lanes, "V", "F"), submit(lanes, window_ms=1000)
    made = close(lanes, area(2.1, -1, 4.9, 1.9), top_m=None)
    (moved,) = made["displaced"]
    assert (moved["flight_intent_id"], moved["state"], moved["reason"]) == (southern, "accepted", None)
    assert moved["departure_moved_s"] >= 0
    assert moved["arrival_moved_s"] > 0
    held = blocks_of(lanes, southern)
    assert not {block for block in held if 2 <= block[0] <= 4 and block[1] < 2}
    assert blocks_of(lanes, northern) == {(i, 2, 0) for i in range(8)}

    rest = close(lanes, area(2.1, 1.9, 4.9, 9), top_m=None, name="the rest")
    assert {each["flight_intent_id"] for each in rest["displaced"]} == {southern, northern}
    assert {each["reason"] for each in rest["displaced"]} == {"no_conflict_free_path"}
    assert (state_of(lanes, southern), state_of(lanes, northern)) == ("displaced", "displaced")
    assert blocks_of(lanes, southern) == set()
    events = lanes.get("/v1/events").json()["items"]
    (created,) = [event for event in events if event["details"].get("constraint_id") == rest["id"]]
    assert created["kind"] == "constraint_created"
    told_of = [event for event in events if event["revision"] == created["revision"]]
    assert [event["kind"] for event in told_of] == ["constraint_created", "displaced", "displaced"]
    assert {event["details"]["cause"]["constraint_id"] for event in told_of[1:]} == {rest["id"]}


def test_of_each_flight_that_can_no_longer_move_the_journal_says_so_with_the_constraint(lanes: Client) -> None:
    stays, moves = activated(lanes), submit(lanes, "V", "F", earliest_ms=DEPARTURE_MS + 600_000)
    before = lanes.get(f"{SUBMIT}/{stays}").json()
    look(lanes)
    with streaming(lanes) as stream:
        stream.news()
        made = close(lanes, area(2.1, -1, 4.9, 9))
        look(lanes)
        streamed = [each for each in stream.news() if each.data.get("kind") == "unmoved"]
    assert made["unmoved"] == [stays]
    created, displaced, unmoved = lanes.get("/v1/events").json()["items"][-3:]
    assert (created["kind"], displaced["flight_intent_id"]) == ("constraint_created", moves)
    told_of = {name: unmoved[name] for name in ("revision", "kind", "flight_intent_id", "sequence", "details")}
    assert told_of == {
        "revision": created["revision"], "kind": "unmoved", "flight_intent_id": stays, "sequence": 1,
        "details": {"cause": {"constraint_id": made["id"]}},
    }  # fmt: skip
    assert [(each.name, each.data) for each in streamed] == [("intent", unmoved)]
    assert lanes.get(f"{SUBMIT}/{stays}").json() == before


@on_sqlite
def test_what_begins_after_a_flight_has_passed_leaves_it_alone(lanes: Client) -> None:
    flight = submit(lanes)
    made = close(lanes, begins_ms=DEPARTURE_MS + 8 * LINK_MS)
    assert (made["displaced"], made["unmoved"]) == ([], [])
    assert blocks_of(lanes, flight) == {(i, 2, 0) for i in range(8)}


def test_another_process_plans_around_it_too_and_where_it_was_removed_again(
    lanes: Client, on_lanes: Settings, clock: FakeClock
) -> None:
    with served(create_app(on_lanes, clock, elapsed_ms=clock)) as other:
        straight = {(i, 2, 0) for i in range(8)}
        made = close(lanes)
        assert blocks_of(other, submit(other)) != straight
        other.delete(f"{CONSTRAINTS}/{made['id']}")
        assert blocks_of(lanes, submit(lanes)) == straight
    close(lanes)
    # One that starts later loads it with the ledger.
    with served(create_app(on_lanes, clock, elapsed_ms=clock)) as later:
        assert blocks_of(later, submit(later, "V", "F")) == {(i, 0, 0) for i in range(8)}
        assert not {(3, 2, 0), (3, 1, 0)} & blocks_of(later, submit(later))


# Status


def test_flights_that_can_no_longer_move_stay_and_turn_it_red(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    made = close(lanes)
    assert (made["displaced"], made["unmoved"]) == ([], [flight])
    clock.now_ms = DEPARTURE_MS + 2 * LINK_MS
    fly(lanes, flight)
    look(lanes)
    closed = {"constraints": [made["id"]], "flight_intents": [flight], "track_ids": []}
    assert lanes.get(STATUS).json()["blocks"] == [
        {"block": [1, 2, 0], "status": "green", "reasons": [], "flight_intents": [flight], "track_ids": []},
        {"block": [2, 2, 0], "status": "red", "reasons": ["in_constraint"], **closed},
        {"block": [3, 2, 0], "status": "green", "reasons": [], **closed},
    ]
    assert state_of(lanes, flight) == "activated"
    (alert,) = alerts(lanes)
    assert (alert["severity"], alert["conformance"], alert["reasons"]) == ("red", "violating", ["in_constraint"])
    assert alert["message"].endswith("is in closed airspace.")


def test_an_intruder_turns_it_red_and_the_past_stays_as_it_was(lanes: Client, clock: FakeClock) -> None:
    see(lanes, "radar-1", 3.5, 1.5)
    unplanned = {(3, 1, 0): ("yellow", ["unplanned_use"])}
    assert colours(lanes) == unplanned
    clock.advance(seconds=1)
    made = close(lanes)
    red = {(3, 1, 0): ("red", ["in_constraint", "unplanned_use"])}
    assert colours(lanes) == red
    clock.advance(seconds=1)
    lanes.delete(f"{CONSTRAINTS}/{made['id']}")
    assert colours(lanes) == unplanned
    then = {ms: colours(lanes, at=format_time(START_MS + ms)) for ms in (999, 1000, 1999, 2000)}
    assert then == {999: unplanned, 1000: red, 1999: red, 2000: unplanned}


@on_sqlite
def test_above_and_beside_it_nobody_is_red_and_alone_it_is_idle(lanes: Client) -> None:
    close(lanes)
    see(lanes, "radar-1", 3.5, 1.5, alt_m=60.0)
    see(lanes, "radar-2", 5.5, 1.5)
    assert {status for status, _ in colours(lanes).values()} == {"yellow"}
    assert (3, 1, 0) not in colours(lanes)


@on_sqlite
def test_a_block_names_the_constraints_that_close_it_now_also_where_it_is_idle(lanes: Client, clock: FakeClock) -> None:
    path = "/v1/airspace/blocks/3/1/0"
    first, second = (close(lanes, until=format_time(START_MS + ms))["id"] for ms in (1000, 2000))
    close(lanes, begins_ms=START_MS + 5000)
    assert lanes.get("/v1/airspace/blocks/3/1/1").json()["constraints"] == []
    named = []
    for _ in range(3):
        answer = lanes.get(path).json()
        named.append(answer["constraints"])
        assert answer["status"] == "idle"
        clock.advance(seconds=1)
    assert named == [[first, second], [second], []]


@on_sqlite
def test_the_stream_tells_of_constraints(lanes: Client) -> None:
    look(lanes)
    with streaming(lanes) as stream:
        stream.news()
        made = close(lanes)
        look(lanes)
        (event,) = [each for each in stream.news() if each.name == "constraint"]
    assert (event.data["kind"], event.data["details"]) == ("constraint_created", {"constraint_id": made["id"]})
    assert event.data["flight_intent_id"] is None
