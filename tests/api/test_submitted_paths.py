"""Paths that operators bring: reserved as they are, or refused with who is in the way and what would do."""

import json
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any, cast

import httpx
import pytest

from app.flight_intents import FlightIntent, Refusal
from app.ledger import Ledger
from app.main import create_app
from app.settings import Settings
from app.times import format_time, parse_time
from planner.separation import CheckedFlight, verify
from tests.api.bodies import PREVIEW, SUBMIT, intent, problem
from tests.api.serving import Client, served
from tests.api.test_running import settings_with
from tests.ledger.district import AIRCRAFT, DEPARTURE_MS, LANES, START_MS
from tests.ledger.locations import on_sqlite
from tests.ledger.process import FakeClock

KEY = {"Idempotency-Key": "first try"}
_VOLUME = {"block": [0, 0, 0], "enter": format_time(START_MS), "exit": format_time(DEPARTURE_MS)}


def planned(client: Client, origin: str = "W", destination: str = "E", **members: Any) -> dict[str, Any]:
    """Return what our own planner would do."""
    response = client.post(PREVIEW, json=intent(origin, destination, district=LANES, **members))
    assert response.status_code == 200, response.json()
    answer: dict[str, Any] = response.json()
    return answer


def own(trajectory: list[dict[str, Any]], **members: Any) -> dict[str, Any]:
    """Return the body with a trajectory of one's own."""
    return {"operator": "own-planner", "aircraft_type": AIRCRAFT, "trajectory": trajectory, **members}


def volumes(held: list[dict[str, Any]], **members: Any) -> dict[str, Any]:
    """Return the body with volumes from W to E."""
    body = intent("W", "E", district=LANES, volumes=held, **members)
    del body["earliest_departure"]
    return body


def later(trajectory: list[dict[str, Any]], slower_ms: int, by_ms: int = 0) -> list[dict[str, Any]]:
    """Return a trajectory that begins later and takes so much longer for each link."""
    return [
        {
            "block": entry["block"],
            **{name: format_time(parse_time(entry[name]) + by_ms + n * slower_ms) for name in ("arrive", "depart")},
        }
        for n, entry in enumerate(trajectory)
    ]


def accepted(client: Client, body: dict[str, Any]) -> dict[str, Any]:
    response = client.post(SUBMIT, json=body)
    assert response.status_code == 201, response.json()
    answer: dict[str, Any] = response.json()
    return answer


def assert_separated(client: Client) -> None:
    """Judge all that is reserved by the independent checker."""
    flights = []
    for found in client.service.ledger.everything()[0]:
        if found.trajectory is not None:
            path, held = found.trajectory, found.reservations
            flights.append(
                CheckedFlight(
                    found.id, path.block, path.arrive_ms, path.depart_ms, held.block, held.enter_ms, held.exit_ms
                )
            )
    assert verify(LANES.airspace, flights).violations == ()


# Trajectories


def test_a_trajectory_as_an_answer_gave_it_is_reserved_as_it_is(lanes: Client) -> None:
    plan = planned(lanes)
    answer = accepted(lanes, own(plan["trajectory"], reference="R-1"))
    assert (plan["submitted"], answer["submitted"], answer["reference"]) == (False, True, "R-1")
    for name in ("trajectory", "reservations", "departure", "arrival", "delay_s", "hover_s", "ground_hold_s"):
        assert answer[name] == plan[name], name
    assert answer["origin"]["block"] == plan["trajectory"][0]["block"]
    assert answer["earliest_departure"] == answer["departure"]
    assert parse_time(answer["latest_departure"]) == parse_time(answer["departure"]) + 300_000
    read = lanes.get(f"{SUBMIT}/{answer['id']}").json()
    assert read == {name: value for name, value in answer.items() if name != "displaced"}


@on_sqlite
def test_who_flies_slower_than_planned_is_late_by_so_much(lanes: Client) -> None:
    plan = planned(lanes)
    answer = accepted(lanes, own(later(plan["trajectory"], slower_ms=1001)))
    assert answer["delay_s"] == pytest.approx(1.001 * (len(plan["trajectory"]) - 1))
    assert answer["hover_s"] == 0
    assert_separated(lanes)


@on_sqlite
def test_a_path_in_the_way_of_others_is_refused_with_every_overlap_and_a_plan_that_works(lanes: Client) -> None:
    first = accepted(lanes, own(planned(lanes)["trajectory"]))
    refusal = problem(lanes.post(SUBMIT, json=own(first["trajectory"])), 409, "path-conflicts")
    assert refusal["reason"] == "path_conflicts"
    assert refusal["conflicting_intents"] == [first["id"]]
    assert refusal["conflicts"] == [{**held, "flight_intent_id": first["id"]} for held in first["reservations"]]
    assert refusal["conflict_count"] == len(first["reservations"])
    recorded = lanes.get(f"{SUBMIT}/{refusal['flight_intent_id']}").json()
    assert (recorded["state"], recorded["sequence"], recorded["submitted"]) == ("rejected", 2, False)
    assert recorded["refusal"]["reason"] == "path_conflicts"
    proposal = refusal["proposal"]
    assert (proposal["state"], proposal["submitted"], proposal["displaces"]) == ("preview", False, [])
    assert accepted(lanes, own(proposal["trajectory"]))["reservations"] == proposal["reservations"]
    assert_separated(lanes)


@on_sqlite
def test_overlaps_are_exact(lanes: Client) -> None:
    first = accepted(lanes, own(planned(lanes)["trajectory"]))
    behind = own(later(first["trajectory"], slower_ms=0, by_ms=100))
    refusal = problem(lanes.post(SUBMIT, json=behind), 409, "path-conflicts")
    (beginning, *_) = refusal["conflicts"]
    assert beginning["enter"] == behind["trajectory"][0]["arrive"]
    assert beginning["exit"] == first["reservations"][0]["exit"]


@on_sqlite
def test_closed_blocks_in_the_way_are_named_by_their_constraint_and_where_nothing_would_do_nothing_is_proposed(
    lanes: Client,
) -> None:
    trajectory = planned(lanes)["trajectory"]
    west, south, east, north = LANES.airspace.grid.bounds
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    body = {"name": "closed", "polygon": {"type": "Polygon", "coordinates": [ring]}, "base_m": 0, "top_m": 120}
    closed = lanes.post("/v1/constraints", json=body)
    assert closed.status_code == 201, closed.json()
    refusal = problem(lanes.post(SUBMIT, json=own(trajectory)), 409, "path-conflicts")
    assert {conflict["constraint_id"] for conflict in refusal["conflicts"]} == {closed.json()["id"]}
    assert (refusal["conflicting_intents"], refusal["proposal"]) == ([], None)


@on_sqlite
def test_a_repeated_submission_gets_the_first_answer_again(lanes: Client) -> None:
    body = own(planned(lanes)["trajectory"])
    first, again = (lanes.post(SUBMIT, json=body, headers=KEY) for _ in range(2))
    assert (first.status_code, again.status_code, again.content) == (201, 201, first.content)
    body["reference"] = "the same way"
    refused, repeated = (lanes.post(SUBMIT, json=body, headers={"Idempotency-Key": "another"}) for _ in range(2))
    assert (refused.status_code, repeated.headers["Idempotent-Replayed"]) == (409, "true")
    assert repeated.json() == refused.json()
    assert repeated.json()["conflicts"]


@on_sqlite
def test_a_preview_of_a_trajectory_reserves_nothing(lanes: Client) -> None:
    plan = planned(lanes)
    preview = lanes.post(PREVIEW, json=own(plan["trajectory"]))
    assert (preview.status_code, preview.json()["submitted"]) == (200, True)
    assert preview.json()["reservations"] == plan["reservations"]
    assert lanes.get(SUBMIT).json()["items"] == []


def to_and_fro(entries: int) -> list[dict[str, Any]]:
    """Return a trajectory between two blocks, written as answers write it."""
    grid = LANES.airspace.grid
    ends = [{"block": list(grid.block(block)), **asdict(LANES.centre(grid.block(block)))} for block in (0, 1)]
    times = (format_time(DEPARTURE_MS + 10_000 * n) for n in range(entries))
    return [{**ends[n % 2], "arrive": time, "depart": time} for n, time in enumerate(times)]


@on_sqlite
def test_a_path_may_have_five_thousand_entries_written_as_generously_as_answers_are(
    on_lanes: Settings, clock: FakeClock
) -> None:
    body = own(to_and_fro(5_000))
    assert len(json.dumps(body)) > 700_000
    with served(create_app(settings_with(on_lanes, path_limit_s=86_400), clock, elapsed_ms=clock)) as lanes:
        first = lanes.post(SUBMIT, json=body)
        assert (first.status_code, len(first.json()["trajectory"])) == (201, 5_000)
        preview = lanes.post(PREVIEW, json=own(first.json()["trajectory"]))
    assert problem(preview, 409, "path-conflicts")["conflict_count"] == len(first.json()["reservations"])


@dataclass(frozen=True)
class Repeated:
    """In place of a ledger: whatever is asked for, there is the same flight again and again."""

    intent: FlightIntent

    def page(self, *, after_sequence: int, limit: int, **_: object) -> list[FlightIntent]:
        return [replace(self.intent, sequence=after_sequence + 1 + n) for n in range(limit)]


@on_sqlite
def test_a_page_of_very_long_flights_ends_early_and_the_next_goes_on_from_there(lanes: Client) -> None:
    intent = lanes.service.ledger.find(accepted(lanes, own(to_and_fro(2)))["id"])
    assert intent is not None
    # As long as a dozen of the longest, and sooner written down.
    long = replace(intent, refusal=Refusal("of_length", "x" * 10 * 2**20))
    service = replace(lanes.service, ledger=cast(Ledger, Repeated(long)))
    with served(create_app(service.settings, running=service)) as client:
        first = client.get(SUBMIT, params={"limit": 500}).json()
        second = client.get(SUBMIT, params={"limit": 2, "cursor": first["next_cursor"]}).json()
    assert [item["sequence"] for item in first["items"]] == [1, 2, 3, 4]
    assert [item["sequence"] for item in second["items"]] == [5, 6]


@on_sqlite
def test_it_may_have_as_many_volumes(lanes: Client) -> None:
    times = [format_time(DEPARTURE_MS + 1_000 * n) for n in range(626)]
    blocks = [entry["block"] for entry in planned(lanes)["trajectory"]]
    slices = [{"block": block, "enter": enter, "exit": exit_} for block in blocks for enter, exit_ in pairwise(times)]
    assert len(slices) == 5_000
    answer = accepted(lanes, volumes(slices))
    assert {(held["enter"], held["exit"]) for held in answer["reservations"]} == {(times[0], times[-1])}


@on_sqlite
@pytest.mark.parametrize("name", ["trajectory", "volumes"])
def test_one_entry_more_is_refused(lanes: Client, name: str) -> None:
    body = own(to_and_fro(5_001)) if name == "trajectory" else volumes([_VOLUME] * 5_001)
    answer = problem(lanes.post(SUBMIT, json=body), 422, "validation-error")
    (error,) = answer["errors"]
    assert (error["loc"], error["type"]) == (["body", name], "too_long")
    assert "5000" in error["msg"]


@on_sqlite
def test_of_entries_that_are_none_the_first_is_told(lanes: Client) -> None:
    for body in (own([*to_and_fro(2), {}, {}]), volumes([_VOLUME, _VOLUME, {}, {}])):
        answer = problem(lanes.post(SUBMIT, json=body), 422, "validation-error")
        assert {error["loc"][2] for error in answer["errors"]} == {2}
        assert answer["error_count"] == len(answer["errors"]) == 3


# Refusals that no traffic could change


@on_sqlite
def test_a_path_that_cannot_be_flown_is_refused_for_its_first_wrong_entry_and_not_recorded(lanes: Client) -> None:
    trajectory = planned(lanes)["trajectory"]
    del trajectory[3]
    refusal = problem(lanes.post(SUBMIT, json=own(trajectory)), 422, "path-refused")
    assert (refusal["reason"], refusal["entry"]) == ("not_a_chain", 3)
    held = planned(lanes)["reservations"]
    refusal = problem(lanes.post(SUBMIT, json=volumes(held[:-1])), 422, "path-refused")
    assert (refusal["reason"], refusal["entry"]) == ("not_flyable", None)
    assert lanes.get(SUBMIT).json()["items"] == []


@on_sqlite
def test_a_path_lasts_an_hour_at_most(lanes: Client) -> None:
    trajectory = planned(lanes)["trajectory"]
    begins_ms, lands = parse_time(trajectory[0]["arrive"]), trajectory[-1]
    ends = [format_time(begins_ms + 3_600_000 + beyond_ms) for beyond_ms in (0, 1)]
    too_long = problem(
        lanes.post(SUBMIT, json=own([*trajectory[:-1], {**lands, "depart": ends[1]}])), 422, "path-refused"
    )
    assert (too_long["reason"], too_long["entry"]) == ("too_long", len(trajectory) - 1)
    assert "more than 3600 s" in too_long["detail"]
    held = [{**one, "enter": trajectory[0]["arrive"], "exit": ends[0]} for one in planned(lanes)["reservations"]]
    too_long = problem(lanes.post(SUBMIT, json=volumes([*held, {**held[-1], "exit": ends[1]}])), 422, "path-refused")
    assert (too_long["reason"], too_long["entry"]) == ("too_long", len(held))
    assert lanes.post(PREVIEW, json=volumes(held)).status_code == 200
    assert accepted(lanes, own([*trajectory[:-1], {**lands, "depart": ends[0]}]))["arrival"] == ends[0]


@on_sqlite
def test_how_long_a_path_lasts_is_a_setting(on_lanes: Settings, clock: FakeClock) -> None:
    with served(create_app(settings_with(on_lanes, path_limit_s=10), clock, elapsed_ms=clock)) as lanes:
        refusal = problem(lanes.post(SUBMIT, json=own(planned(lanes)["trajectory"])), 422, "path-refused")
    assert (refusal["reason"], "more than 10 s" in refusal["detail"]) == ("too_long", True)


@on_sqlite
def test_volumes_that_the_flight_does_not_come_to_are_refused_for_the_first_of_them(lanes: Client) -> None:
    held = planned(lanes)["reservations"]
    far = [{**held[0], "block": list(LANES.airspace.grid.block(LANES.block(sign)))} for sign in "VF"]
    refusal = problem(lanes.post(SUBMIT, json=volumes([*held, *far])), 422, "path-refused")
    assert (refusal["reason"], refusal["entry"]) == ("out_of_reach", len(held))
    assert lanes.get(SUBMIT).json()["items"] == []


@on_sqlite
def test_a_trajectory_ends_in_another_block_than_it_began(lanes: Client) -> None:
    there = planned(lanes)["trajectory"][:2]
    home = {**there[0], "arrive": format_time(DEPARTURE_MS + 60_000), "depart": format_time(DEPARTURE_MS + 60_000)}
    refusal = problem(lanes.post(SUBMIT, json=own([*there, home])), 422, "not-plannable")
    assert refusal["reason"] == "same_block"


@on_sqlite
def test_a_path_that_has_begun_is_too_late(lanes: Client, clock: FakeClock) -> None:
    trajectory = planned(lanes)["trajectory"]
    clock.now_ms = DEPARTURE_MS + 1
    problem(lanes.post(SUBMIT, json=own(trajectory)), 422, "departure-in-the-past")


@on_sqlite
@pytest.mark.parametrize(
    ("changes", "loc"),
    [
        ({"origin": {"lon": 0, "lat": 0, "alt_m": 0}}, ["body", "origin"]),
        ({"earliest_departure": format_time(START_MS)}, ["body", "earliest_departure"]),
        ({"volumes": []}, ["body", "volumes"]),
        ({"trajectory": []}, ["body", "trajectory"]),
        ({"latest_departure": format_time(START_MS)}, ["body"]),
        ({"trajectory": None}, ["body", "trajectory"]),
    ],
)
def test_of_the_three_forms_a_body_has_one(lanes: Client, changes: dict[str, Any], loc: list[str]) -> None:
    trajectory = [{"block": [i, 0, 0], "arrive": at, "depart": at} for i, at in enumerate(
        (format_time(DEPARTURE_MS), format_time(DEPARTURE_MS + 60_000))
    )]  # fmt: skip
    assert lanes.post(PREVIEW, json=own(trajectory)).status_code == 200
    refusal = lanes.post(SUBMIT, json=own(trajectory) | changes)
    errors = problem(refusal, 422, "validation-error")["errors"]
    assert [error["loc"] for error in errors] == [loc]


# Volumes


@on_sqlite
def test_volumes_are_reserved_as_they_are_with_a_flight_inside_them(lanes: Client) -> None:
    held = planned(lanes)["reservations"]
    late = format_time(parse_time(held[-1]["exit"]) + 30_000)
    generous = [{**one, "enter": held[0]["enter"], "exit": late} for one in held]
    answer = accepted(lanes, volumes(generous))
    assert answer["submitted"] is True
    assert sorted(answer["reservations"], key=str) == sorted(
        (
            {"block": list(block), "enter": held[0]["enter"], "exit": late}
            for block in {tuple(one["block"]) for one in held}
        ),
        key=str,
    )
    assert (answer["departure"], answer["arrival"]) == (held[0]["enter"], format_time(parse_time(late) - 1))
    assert_separated(lanes)
    refusal = problem(lanes.post(SUBMIT, json=volumes(generous)), 409, "path-conflicts")
    assert refusal["conflict_count"] == len(answer["reservations"])


# Making way


@on_sqlite
def test_a_path_of_higher_priority_moves_others_and_one_that_is_moved_is_ours_from_then_on(lanes: Client) -> None:
    trajectory = planned(lanes)["trajectory"]
    low = accepted(lanes, own(later(trajectory, slower_ms=500, by_ms=120_000)))
    high = accepted(lanes, own(later(trajectory, slower_ms=0, by_ms=120_000), priority=10))
    (moved,) = high["displaced"]
    assert (moved["flight_intent_id"], moved["state"]) == (low["id"], "accepted")
    assert high["trajectory"][0]["arrive"] == low["departure"]
    after = lanes.get(f"{SUBMIT}/{low['id']}").json()
    assert after["submitted"] is False
    assert low["departure"] < after["departure"] <= low["latest_departure"]
    assert_separated(lanes)
    problem(lanes.post(SUBMIT, json=own(high["trajectory"], priority=10)), 409, "path-conflicts")


@on_sqlite
def test_an_intent_can_be_changed_to_a_path_of_ones_own_before_its_departure(lanes: Client) -> None:
    first = accepted(lanes, intent("W", "E", district=LANES, operator="own-planner"))
    body = own(later(first["trajectory"], slower_ms=200))
    changed = lanes.request("PUT", f"{SUBMIT}/{first['id']}", json=body, headers={"If-Match": f'"{first["version"]}"'})
    assert (changed.status_code, changed.json()["submitted"], changed.json()["sequence"]) == (200, True, 1)


def changed_in_the_air(client: Client, clock: FakeClock, flight: dict[str, Any]) -> httpx.Response:
    """Activate a flight from W and, ten seconds later, ask for F as its destination."""
    assert client.post(f"{SUBMIT}/{flight['id']}/activate").status_code == 200
    clock.now_ms = DEPARTURE_MS + 10_000
    body = intent("W", "F", district=LANES, operator=flight["operator"], earliest_ms=DEPARTURE_MS, window_ms=300_000)
    return client.request("PUT", f"{SUBMIT}/{flight['id']}", json=body, headers={"If-Match": "*"})


@on_sqlite
def test_a_flight_on_its_own_trajectory_goes_on_from_there_by_ours(lanes: Client, clock: FakeClock) -> None:
    flight = accepted(lanes, own(later(planned(lanes)["trajectory"], slower_ms=9_000)))
    changed = changed_in_the_air(lanes, clock, flight).json()
    flown = [entry for entry in changed["trajectory"] if entry["arrive"] <= format_time(clock.now_ms + 5_000)]
    assert [entry["block"] for entry in flown] == [entry["block"] for entry in flight["trajectory"][: len(flown)]]
    assert [entry["arrive"] for entry in flown] == [entry["arrive"] for entry in flight["trajectory"][: len(flown)]]
    assert (len(flown) > 1, changed["submitted"]) == (True, False)
    assert changed["trajectory"][-1]["block"] == list(LANES.airspace.grid.block(LANES.block("F")))
    assert_separated(lanes)


@on_sqlite
def test_nobody_knows_where_in_its_volumes_a_flight_is(lanes: Client, clock: FakeClock) -> None:
    held = planned(lanes)["reservations"]
    generous = [{**entry, "exit": format_time(parse_time(entry["exit"]) + 60_000)} for entry in held]
    flight = accepted(lanes, volumes(generous))
    problem(changed_in_the_air(lanes, clock, flight), 422, "not-changeable")
