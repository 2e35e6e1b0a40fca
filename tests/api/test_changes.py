"""Changes over HTTP: which version of which flight, in which state, and what one in the air can still do."""

from typing import Any

import httpx
import pytest

from app.commands.verify import checked
from app.flight_intents import State
from app.main import create_app
from app.routes.answers import ChangedFlightIntentAnswer
from app.settings import Settings
from app.times import format_time, parse_time
from planner.errors import Block
from planner.separation import verify
from tests.api.bodies import CHANGED, SUBMIT, intent, problem, recorded
from tests.api.serving import Client, served
from tests.api.test_running import settings_with
from tests.api.watching import ARRIVAL_MS, LINK_MS, activated, fly, look, see, submit, told
from tests.ledger.district import DEPARTURE_MS, LANES, START_MS
from tests.ledger.locations import on_sqlite
from tests.ledger.process import FakeClock

LEAD_MS = 5_000


def body(origin: str = "W", destination: str | Block = "E", **members: Any) -> dict[str, Any]:
    return intent(origin, destination, district=LANES, **members)


def put(client: Client, flight: str, content: dict[str, Any], if_match: str | None = "*") -> httpx.Response:
    headers = {} if if_match is None else {"If-Match": if_match}
    return client.request("PUT", f"{SUBMIT}/{flight}", json=content, headers=headers)


def read(client: Client, flight: str) -> dict[str, Any]:
    answer: dict[str, Any] = client.get(f"{SUBMIT}/{flight}").json()
    return answer


def blocks(answer: dict[str, Any]) -> list[tuple[int, ...]]:
    return [tuple(point["block"]) for point in answer["trajectory"]]


def assert_separated(client: Client) -> None:
    """Fail unless the independent checker finds nothing on all that is held."""
    flights = [checked(found) for found in client.service.ledger.everything()[0] if found.trajectory is not None]
    assert verify(LANES.airspace, flights).violations == ()


# Which version


def test_a_change_answers_with_the_flight_as_it_is_now(lanes: Client) -> None:
    before = lanes.post(SUBMIT, json=body())
    response = put(lanes, before.json()["id"], body("W", "F", reference="new"), before.headers["etag"])
    answer = response.json()
    assert response.status_code == 200
    assert set(answer) == CHANGED
    ChangedFlightIntentAnswer.model_validate(answer)
    assert (answer["id"], answer["sequence"], answer["version"]) == (before.json()["id"], 1, "2")
    assert (answer["reference"], answer["destination"]["block"], answer["displaced"]) == ("new", [7, 0, 0], [])
    assert response.headers["etag"] == '"2"'
    assert read(lanes, answer["id"]) == recorded(answer)


@on_sqlite
@pytest.mark.parametrize(
    "if_match", ['"1"', '"7", "1"', '"7","1" , "9"', "*", " * "], ids=["tag", "list", "spaces", "any", "any, spaced"]
)
def test_a_change_of_the_version_that_it_names_is_made(lanes: Client, if_match: str) -> None:
    assert put(lanes, submit(lanes), body("W", "F"), if_match).status_code == 200


@on_sqlite
@pytest.mark.parametrize(
    "if_match",
    ['"2"', 'W/"1"', '"01x"', '""', f'"{10**30}"'],
    ids=["other", "weak", "garbage", "empty tag", "huge"],
)
def test_a_change_of_another_version_is_not_made(lanes: Client, if_match: str) -> None:
    flight = submit(lanes)
    before = read(lanes, flight)
    problem(put(lanes, flight, body("W", "F"), if_match), 412, "precondition-failed")
    assert read(lanes, flight) == before


@on_sqlite
@pytest.mark.parametrize(
    "if_match", ["1", "", '"1', '"1", 2', "**"], ids=["bare", "empty", "open", "one bare", "stars"]
)
def test_what_is_no_entity_tag_is_refused_as_such(lanes: Client, if_match: str) -> None:
    flight = submit(lanes)
    answer = problem(put(lanes, flight, body("W", "F"), if_match), 422, "validation-error")
    assert answer["errors"][0]["loc"] == ["header", "If-Match"]
    assert "in its quotes" in answer["detail"]


@on_sqlite
def test_a_change_has_to_say_of_which_version(lanes: Client) -> None:
    flight = submit(lanes)
    problem(put(lanes, flight, body("W", "F"), None), 428, "precondition-required")
    assert read(lanes, flight)["version"] == "1"


@on_sqlite
def test_who_changes_what_another_has_just_changed_hears_of_it(lanes: Client) -> None:
    flight = submit(lanes)
    assert put(lanes, flight, body("W", "F"), '"1"').status_code == 200
    problem(put(lanes, flight, body("W", "E"), '"1"'), 412, "precondition-failed")


@on_sqlite
def test_what_there_is_not_cannot_be_changed(lanes: Client) -> None:
    for name in ("0193-no-such", "01a2025d-cf8d-7793-bfd6-fd7be76cdfea"):
        problem(put(lanes, name, body()), 404, "unknown-flight-intent")


# What stands


def test_where_there_is_no_new_plan_the_old_one_stands(lanes: Client) -> None:
    for _ in range(2):
        submit(lanes, window_ms=10_000)
    other = submit(lanes, "V", "F")
    before = read(lanes, other)
    response = put(lanes, other, body("W", "E", window_ms=0), f'"{before["version"]}"')
    answer = problem(response, 409, "no-conflict-free-plan")
    assert answer["reason"] == "no_departure_slot"
    assert "etag" not in response.headers
    assert read(lanes, other) == before
    assert [kind for kind, _, _ in told(lanes)] == ["accepted"] * 3


@on_sqlite
@pytest.mark.parametrize(
    ("members", "status", "slug"),
    [
        ({"operator": "other-air"}, 422, "not-changeable"),
        ({"earliest_ms": START_MS - 400_000}, 422, "departure-in-the-past"),
        ({"earliest_ms": START_MS + 40 * 86_400_000}, 422, "beyond-horizon"),
        ({"aircraft_type": "broom"}, 422, "unknown-aircraft-type"),
    ],
    ids=["operator", "past", "horizon", "aircraft"],
)
def test_what_cannot_be_asked_for_changes_nothing(
    lanes: Client, members: dict[str, Any], status: int, slug: str
) -> None:
    flight = submit(lanes)
    before = read(lanes, flight)
    problem(put(lanes, flight, body(**members)), status, slug)
    assert read(lanes, flight) == before
    assert len(told(lanes)) == 1


def test_a_change_frees_what_the_flight_held_before(lanes: Client) -> None:
    flight = submit(lanes)
    assert put(lanes, flight, body("V", "F")).status_code == 200
    assert lanes.post(SUBMIT, json=body(window_ms=0)).status_code == 201
    assert_separated(lanes)


# Which state


def in_state(client: Client, clock: FakeClock, state: State) -> str:
    """Return a flight in a state; those that fly are in the air."""
    flight = submit(client)
    match state:
        case State.REJECTED:
            return str(client.post(SUBMIT, json=body(window_ms=0)).json()["flight_intent_id"])
        case State.CANCELLED:
            client.delete(f"{SUBMIT}/{flight}")
        case State.DISPLACED:
            flight = submit(client, "V", "F", window_ms=0)
            assert submit(client, "V", "F", priority=1, window_ms=0)
        case State.ENDED:
            client.post(f"{SUBMIT}/{flight}/end")
        case State.ACTIVATED:
            client.post(f"{SUBMIT}/{flight}/activate")
            clock.now_ms = DEPARTURE_MS
        case State.NONCONFORMING | State.CONTINGENT:
            clock.now_ms = DEPARTURE_MS
            fly(client, flight)
            look(client)
            if state is State.CONTINGENT:
                clock.advance(seconds=5.001)
                look(client)
                clock.advance(seconds=30)
                look(client)
        case State.ACCEPTED:
            pass
    assert read(client, flight)["state"] == state
    return flight


VERBS = {"change": "PUT", "cancel": "DELETE", "activate": "POST", "end": "POST"}
# What each state becomes by each verb; what is missing is an illegal transition.
TABLE = {
    (State.ACCEPTED, "change"): "accepted",
    (State.ACCEPTED, "cancel"): "cancelled",
    (State.ACCEPTED, "activate"): "activated",
    (State.ACCEPTED, "end"): "ended",
    (State.ACTIVATED, "change"): "activated",
    (State.ACTIVATED, "activate"): "activated",
    (State.ACTIVATED, "end"): "ended",
    (State.NONCONFORMING, "activate"): "nonconforming",
    (State.NONCONFORMING, "end"): "ended",
    (State.CONTINGENT, "end"): "ended",
    (State.ENDED, "end"): "ended",
    (State.CANCELLED, "cancel"): "cancelled",
    (State.DISPLACED, "change"): "accepted",
    (State.DISPLACED, "cancel"): "cancelled",
}


@on_sqlite
@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("state", State)
def test_each_state_allows_some_verbs_and_refuses_the_others(
    lanes: Client, clock: FakeClock, state: State, verb: str
) -> None:
    flight = in_state(lanes, clock, state)
    before = read(lanes, flight)
    path = f"{SUBMIT}/{flight}" + ("" if verb in ("change", "cancel") else f"/{verb}")
    content = {"json": body("V" if state is State.DISPLACED else "W", "F"), "headers": {"If-Match": "*"}}
    response = lanes.request(VERBS[verb], path, **(content if verb == "change" else {}))
    expected = TABLE.get((state, verb))
    if expected is None:
        problem(response, 409, "illegal-transition")
        assert read(lanes, flight) == before
    else:
        assert response.status_code == 200
        assert read(lanes, flight)["state"] == expected


def test_who_was_displaced_can_be_brought_back_by_a_change(lanes: Client, clock: FakeClock) -> None:
    flight = in_state(lanes, clock, State.DISPLACED)
    before = read(lanes, flight)
    answer = put(lanes, flight, body("V", "F"), f'"{before["version"]}"').json()
    assert (answer["state"], answer["sequence"]) == ("accepted", before["sequence"])
    assert "refusal" not in answer
    assert answer["reservations"]
    assert_separated(lanes)


@on_sqlite
def test_who_comes_back_counts_among_the_open_flights_of_its_operator(on_lanes: Settings, clock: FakeClock) -> None:
    with served(create_app(settings_with(on_lanes, open_intents_limit=1), clock)) as client:
        flight = submit(client, "V", "F", window_ms=0)
        assert submit(client, "V", "F", window_ms=0, priority=1, operator="ambulance")
        other = submit(client)
        problem(put(client, flight, body("V", "F")), 429, "too-many-open-intents")
        client.delete(f"{SUBMIT}/{other}")
        assert put(client, flight, body("V", "F")).json()["state"] == "accepted"


# On the ground


def test_a_flight_on_the_ground_stays_activated(lanes: Client) -> None:
    flight = activated(lanes)
    answer = put(lanes, flight, body("V", "F", earliest_ms=DEPARTURE_MS + 1)).json()
    assert (answer["state"], answer["departure"]) == ("activated", format_time(DEPARTURE_MS + 1))


@on_sqlite
def test_a_flight_that_is_late_on_its_pad_can_wait_longer(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS + 1_000
    see(lanes, flight, 0.5, 2.5, airborne=False)
    answer = put(lanes, flight, body(earliest_ms=DEPARTURE_MS + 60_000)).json()
    assert (answer["state"], answer["departure"]) == ("activated", format_time(DEPARTURE_MS + 60_000))


@on_sqlite
def test_a_flight_that_should_have_departed_and_was_not_seen_is_not_sent_back_to_its_pad(
    lanes: Client, clock: FakeClock
) -> None:
    flight = submit(lanes)
    # A millisecond before its departure it cannot have left.
    clock.now_ms = DEPARTURE_MS - 1
    assert put(lanes, flight, body("W", "F")).status_code == 200
    clock.now_ms = DEPARTURE_MS
    answer = problem(put(lanes, flight, body("W", "E")), 409, "illegal-transition")
    assert "may be in the air" in answer["detail"]


@on_sqlite
def test_a_flight_that_has_landed_is_not_sent_off_again(lanes: Client, clock: FakeClock) -> None:
    flight = activated(lanes)
    clock.now_ms = ARRIVAL_MS
    see(lanes, flight, 7.5, 2.5, airborne=False)
    answer = problem(put(lanes, flight, body("W", "F")), 409, "illegal-transition")
    assert "has landed" in answer["detail"]


@on_sqlite
def test_a_flight_that_is_seen_in_the_air_before_its_departure_is_not_planned_from_its_pad(
    lanes: Client, clock: FakeClock
) -> None:
    flight = activated(lanes)
    clock.now_ms = DEPARTURE_MS - 1_000
    see(lanes, flight, 0.6, 2.5)
    answer = put(lanes, flight, body("W", "F")).json()
    assert blocks(answer)[:3] == [(0, 2, 0), (1, 2, 0), (2, 2, 0)]
    assert answer["departure"] == format_time(DEPARTURE_MS)


# In the air


def in_the_air(client: Client, clock: FakeClock, ms: int) -> tuple[str, dict[str, Any]]:
    """Return a flight that departed so long ago and keeps to its plan."""
    flight = activated(client)
    clock.now_ms = DEPARTURE_MS + ms
    fly(client, flight)
    return flight, read(client, flight)


def test_a_flight_in_the_air_keeps_to_its_path_for_the_lead_and_goes_on_from_there(
    lanes: Client, clock: FakeClock
) -> None:
    flight, before = in_the_air(lanes, clock, 1_000)
    answer = put(lanes, flight, body("W", "F"), f'"{before["version"]}"').json()
    # 1 s after departure and 5 s of lead: the fifth centre is reached after 6.672 s.
    assert [point["arrive"] for point in answer["trajectory"][:5]] == [
        point["arrive"] for point in before["trajectory"][:5]
    ]
    assert blocks(answer)[:5] == blocks(before)[:5] == [(i, 2, 0) for i in range(5)]
    assert blocks(answer)[5] != (5, 2, 0)
    assert blocks(answer)[-1] == (7, 0, 0)
    assert (answer["state"], answer["departure"]) == ("activated", before["departure"])
    assert answer["destination"]["block"] == [7, 0, 0]
    assert_separated(lanes)


@on_sqlite
def test_a_flight_that_goes_on_holds_all_that_it_flew(lanes: Client, clock: FakeClock) -> None:
    flight, before = in_the_air(lanes, clock, 1_000)
    answer = put(lanes, flight, body("W", "F")).json()
    ahead = {tuple(hold["block"]): hold["enter"] for hold in before["reservations"] if hold["block"][0] < 4}
    again = {tuple(hold["block"]): hold["enter"] for hold in answer["reservations"]}
    assert {block: again[block] for block in ahead} == ahead
    # What lies behind where it turns off is free at once.
    assert lanes.post(SUBMIT, json=body("E", (6, 2, 0), earliest_ms=clock.now_ms, window_ms=0)).status_code == 201
    assert_separated(lanes)


@on_sqlite
def test_delay_and_flight_time_of_a_flight_that_goes_on_count_from_its_departure(
    lanes: Client, clock: FakeClock
) -> None:
    flight, _ = in_the_air(lanes, clock, 0)
    answer = put(lanes, flight, body("W", "F")).json()
    elapsed_ms = parse_time(answer["arrival"]) - DEPARTURE_MS
    assert answer["flight_time_s"] == elapsed_ms / 1000
    # Nobody is in its way: where it is sent later makes it no later than it could be.
    assert (answer["delay_s"], answer["hover_s"], answer["ground_hold_s"]) == (0.0, 0.0, 0.0)


def test_a_flight_that_goes_on_is_followed_where_it_flies_now(lanes: Client, clock: FakeClock) -> None:
    flight, _ = in_the_air(lanes, clock, 1_000)
    answer = put(lanes, flight, body("W", "F")).json()
    point = answer["trajectory"][-2]
    clock.now_ms = parse_time(point["depart"])
    see(lanes, flight, point["block"][0] + 0.5, point["block"][1] + 0.5, alt_m=point["alt_m"])
    look(lanes)
    assert read(lanes, flight)["state"] == "activated"


@on_sqlite
@pytest.mark.parametrize(
    ("members", "name"),
    [
        ({"earliest_ms": DEPARTURE_MS + 1, "window_ms": 299_999}, "earliest_departure"),
        ({"window_ms": 300_001}, "latest_departure"),
        ({"aircraft_type": "dji-mavic-air"}, "aircraft_type"),
    ],
)
def test_what_a_flight_in_the_air_cannot_change_any_more_is_named(
    lanes: Client, clock: FakeClock, members: dict[str, Any], name: str
) -> None:
    flight, before = in_the_air(lanes, clock, 1_000)
    answer = problem(put(lanes, flight, body("W", "F", **members)), 422, "not-changeable")
    assert f"`{name}`" in answer["detail"]
    assert read(lanes, flight) == before


@on_sqlite
def test_a_flight_in_the_air_cannot_have_come_from_elsewhere(lanes: Client, clock: FakeClock) -> None:
    flight, _ = in_the_air(lanes, clock, 1_000)
    answer = problem(put(lanes, flight, body("V", "F")), 422, "not-changeable")
    assert "`origin`" in answer["detail"]


@on_sqlite
def test_reference_and_priority_can_change_in_the_air(lanes: Client, clock: FakeClock) -> None:
    flight, before = in_the_air(lanes, clock, 1_000)
    answer = put(lanes, flight, body(reference="new", priority=4)).json()
    assert (answer["reference"], answer["priority"]) == ("new", 4)
    assert answer["trajectory"] == before["trajectory"]


@on_sqlite
@pytest.mark.parametrize(("ms", "status"), [(ARRIVAL_MS - DEPARTURE_MS - LINK_MS - LEAD_MS, 200), (1, 409)])
def test_a_flight_that_is_about_to_land_lands(lanes: Client, clock: FakeClock, ms: int, status: int) -> None:
    # The last centre before its destination is the last where it can turn off.
    last_ms = ARRIVAL_MS - DEPARTURE_MS - LINK_MS - LEAD_MS
    flight, _ = in_the_air(lanes, clock, ms if status == 200 else last_ms + ms)
    response = put(lanes, flight, body("W", "F"))
    assert response.status_code == status
    if status == 409:
        assert "about to land" in problem(response, 409, "illegal-transition")["detail"]


@on_sqlite
def test_the_lead_is_a_setting(on_lanes: Settings, clock: FakeClock) -> None:
    with served(create_app(settings_with(on_lanes, replan_lead_s=0), clock)) as client:
        flight, _ = in_the_air(client, clock, 1_000)
        answer = put(client, flight, body("W", (3, 0, 0))).json()
    assert blocks(answer) == [(0, 2, 0), (1, 2, 0), (2, 1, 0), (3, 0, 0)]


def test_where_there_is_no_way_on_it_flies_as_planned(lanes: Client, clock: FakeClock) -> None:
    flight, before = in_the_air(lanes, clock, 1_000)
    close(lanes, 7, 0)
    answer = problem(put(lanes, flight, body("W", "F")), 409, "no-conflict-free-plan")
    assert answer["reason"] == "no_conflict_free_path"
    assert read(lanes, flight) == before


@on_sqlite
def test_a_flight_does_not_turn_off_where_it_is_closed_by_then(lanes: Client, clock: FakeClock) -> None:
    flight, before = in_the_air(lanes, clock, 1_000)
    # The fifth centre would be the first after the lead.
    close(lanes, 4, 2)
    answer = put(lanes, flight, body("W", "F")).json()
    assert blocks(answer)[:6] == blocks(before)[:6]
    assert blocks(answer)[6] == (6, 1, 0)
    assert_separated(lanes)


def close(client: Client, i: int, j: int) -> None:
    """Close a column of blocks for good."""
    polygon = {"type": "Polygon", "coordinates": [square_around(i, j)]}
    assert client.post("/v1/constraints", json={"name": "a fire", "polygon": polygon, "base_m": 0}).status_code == 201


def square_around(i: int, j: int) -> list[list[float]]:
    """Return the ring of a square within a block."""
    corners = [(0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.2, 0.8), (0.2, 0.2)]
    points = [LANES.point(i + x, j + y) for x, y in corners]
    return [[point.lon, point.lat] for point in points]


def test_a_change_is_told_with_how_far_the_flight_moved(lanes: Client) -> None:
    flight = submit(lanes)
    put(lanes, flight, body("W", "E", earliest_ms=DEPARTURE_MS + 1_500))
    event = lanes.get("/v1/events").json()["items"][-1]
    assert (event["kind"], event["flight_intent_id"], event["revision"]) == ("accepted", flight, 2)
    assert event["details"] == {
        "cause": None, "departure_moved_s": 1.5, "arrival_moved_s": 1.5, "reason": None,
    }  # fmt: skip
