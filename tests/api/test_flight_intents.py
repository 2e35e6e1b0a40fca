"""Flight intents over HTTP: submit, preview, read, list, cancel."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from app.flight_intents import State
from app.main import create_app
from app.routes.answers import ChangedFlightIntentAnswer, FlightIntentAnswer, FlightIntentPage, PreviewAnswer
from app.times import format_time, parse_time
from planner.airspace import OccupancyRule
from tests.api.bodies import (
    CHANGED,
    FLIGHT_INTENT,
    PLANNED,
    PREVIEW,
    PREVIEWED,
    PROBLEM,
    SUBMIT,
    intent,
    problem,
    recorded,
)
from tests.api.serving import Client, served, settings_for
from tests.ledger.district import DEPARTURE_MS, OLD_TOWN, START_MS, STREET, district
from tests.ledger.locations import on_sqlite
from tests.ledger.process import DAY_MS, FakeClock

HORIZON_MS = 30 * DAY_MS
REFUSAL = PROBLEM | {"reason", "flight_intent_id", "sequence", "conflicting_intents", "earliest_feasible_departure"}


@pytest.fixture
def street(ledger: str, tmp_path: Path, clock: FakeClock) -> Iterator[Client]:
    """Return a client of a service over one street."""
    with served(create_app(settings_for(STREET, ledger, tmp_path), clock)) as client:
        yield client


def along(origin: str = "W", destination: str = "E", **members: object) -> dict[str, object]:
    """Return the body of a flight along the street."""
    return intent(origin, destination, district=STREET, **members)  # type: ignore[arg-type]


# Submitting


def test_an_accepted_intent_has_exactly_these_members(client: Client) -> None:
    answer = client.post(SUBMIT, json=intent()).json()
    assert set(answer) == CHANGED
    assert answer["displaced"] == []
    assert set(answer["origin"]) == {"lon", "lat", "alt_m", "block"}
    assert {frozenset(point) for point in answer["trajectory"]} == {
        frozenset({"block", "lon", "lat", "alt_m", "arrive", "depart"})
    }
    assert {frozenset(hold) for hold in answer["reservations"]} == {frozenset({"block", "enter", "exit"})}
    ChangedFlightIntentAnswer.model_validate(answer)


def test_an_accepted_intent_is_created_at_its_location_with_its_version_as_etag(client: Client) -> None:
    response = client.post(SUBMIT, json=intent())
    answer = response.json()
    assert response.status_code == 201
    assert response.headers["content-type"] == "application/json"
    assert response.headers["location"] == f"/v1/flight-intents/{answer['id']}"
    assert response.headers["etag"] == f'"{answer["version"]}"'
    assert client.get(response.headers["location"]).json() == recorded(answer)


def test_an_accepted_intent_repeats_what_was_asked(client: Client) -> None:
    body = intent(reference="ORD-7781", window_ms=120_000, priority=0)
    answer = client.post(SUBMIT, json=body).json()
    assert {name: answer[name] for name in body if name not in ("origin", "destination")} == {
        name: body[name] for name in body if name not in ("origin", "destination")
    }
    assert answer["origin"] == {**body["origin"], "block": [0, 4, 0]}
    assert answer["destination"] == {**body["destination"], "block": [7, 4, 0]}
    assert (answer["state"], answer["sequence"]) == ("accepted", 1)


def test_optional_members_have_their_defaults(client: Client) -> None:
    answer = client.post(SUBMIT, json=intent()).json()
    assert answer["reference"] is None
    assert answer["priority"] == 0
    assert answer["latest_departure"] == format_time(DEPARTURE_MS + 300_000)


def test_a_flight_down_the_empty_street_has_exactly_this_plan(street: Client) -> None:
    answer = street.post(SUBMIT, json=along()).json()
    # 20 m at 0.6 x 20 m/s, rounded up to an even millisecond: 1668 ms a block.
    arrivals = [DEPARTURE_MS + 1668 * n for n in range(8)]
    assert [point["block"] for point in answer["trajectory"]] == [[i, 0, 0] for i in range(8)]
    assert [point["arrive"] for point in answer["trajectory"]] == [format_time(time) for time in arrivals]
    assert [point["depart"] for point in answer["trajectory"]] == [format_time(time) for time in arrivals]
    assert answer["reservations"] == [
        {
            "block": [i, 0, 0],
            "enter": format_time(DEPARTURE_MS + 1668 * max(i - 1, 0)),
            "exit": format_time(DEPARTURE_MS + 1668 * min(i + 1, 7) + 1),
        }
        for i in range(8)
    ]
    assert {name: answer[name] for name in PLANNED} == {
        "departure": format_time(DEPARTURE_MS),
        "arrival": format_time(DEPARTURE_MS + 11_676),
        "flight_time_s": 11.676,
        "ground_hold_s": 0.0,
        "hover_s": 0.0,
        "delay_s": 0.0,
    }


def test_a_flight_behind_another_waits_on_the_ground_and_says_so(street: Client) -> None:
    street.post(SUBMIT, json=along())
    answer = street.post(SUBMIT, json=along("E", "W")).json()
    # The last block is free one millisecond after the first flight's arrival.
    assert (answer["ground_hold_s"], answer["delay_s"], answer["hover_s"]) == (11.677, 11.677, 0.0)
    assert answer["flight_time_s"] == 11.676


def test_times_are_the_same_in_the_trajectory_and_in_the_summary(client: Client) -> None:
    answer = client.post(SUBMIT, json=intent()).json()
    assert answer["departure"] == answer["trajectory"][0]["arrive"] == answer["reservations"][0]["enter"]
    assert answer["arrival"] == answer["trajectory"][-1]["depart"]
    assert parse_time(answer["arrival"]) - parse_time(answer["departure"]) == round(answer["flight_time_s"] * 1000)


def test_reservations_are_sorted_by_enter_then_by_block(client: Client) -> None:
    held = client.post(SUBMIT, json=intent("A", (7, 2, 1))).json()["reservations"]
    assert held == sorted(held, key=lambda hold: (hold["enter"], hold["block"]))


@on_sqlite
def test_waypoints_are_block_centres_with_nine_decimals(client: Client) -> None:
    answer = client.post(SUBMIT, json=intent()).json()
    for point in answer["trajectory"]:
        centre = OLD_TOWN.centre(tuple(point["block"]))
        assert (point["lon"], point["lat"]) == pytest.approx((centre.lon, centre.lat), rel=0, abs=5.1e-10)
        assert point["alt_m"] == centre.alt_m


def test_the_terminal_dwell_is_flight_time_but_no_hover(tmp_path: Path, clock: FakeClock) -> None:
    slow = district("W......E", terminal_dwell_ms=30_000)
    with served(create_app(settings_for(slow, str(tmp_path / "ledger.sqlite"), tmp_path), clock)) as client:
        answer = client.post(SUBMIT, json=along()).json()
    assert (answer["flight_time_s"], answer["hover_s"], answer["delay_s"]) == (71.676, 0.0, 0.0)
    first, last = answer["trajectory"][0], answer["trajectory"][-1]
    assert (first["arrive"], first["depart"]) == (format_time(DEPARTURE_MS), format_time(DEPARTURE_MS + 30_000))
    assert last["depart"] == answer["arrival"]


def test_positions_anywhere_in_a_block_are_kept_as_given(client: Client) -> None:
    body = intent()
    body["origin"] = {**body["origin"], "alt_m": 0.5}
    answer = client.post(SUBMIT, json=body).json()
    assert answer["origin"] == {**body["origin"], "block": [0, 4, 0]}
    assert answer["trajectory"][0]["alt_m"] == 20.0


def test_the_midpoint_rule_holds_less(tmp_path: Path, clock: FakeClock) -> None:
    midpoint = district("W.E", rule=OccupancyRule.MIDPOINT)
    with served(create_app(settings_for(midpoint, str(tmp_path / "ledger.sqlite"), tmp_path), clock)) as client:
        held = client.post(SUBMIT, json=intent("W", "E", district=district("W.E"))).json()["reservations"]
    assert [(parse_time(hold["enter"]), parse_time(hold["exit"])) for hold in held] == [
        (DEPARTURE_MS, DEPARTURE_MS + 835),
        (DEPARTURE_MS + 834, DEPARTURE_MS + 2503),
        (DEPARTURE_MS + 2502, DEPARTURE_MS + 3337),
    ]


# Refusals by traffic


def test_a_departure_while_the_first_block_is_reserved_is_refused_with_all_that_helps(street: Client) -> None:
    first = street.post(SUBMIT, json=along()).json()
    response = street.post(SUBMIT, json=along(window_ms=0))
    answer = problem(response, 409, "no-conflict-free-plan")
    assert set(answer) == REFUSAL
    assert (answer["reason"], answer["sequence"]) == ("no_departure_slot", 2)
    assert answer["conflicting_intents"] == [first["id"]]
    # As soon as the first block is free; it then hovers there until the second is.
    assert answer["earliest_feasible_departure"] == format_time(DEPARTURE_MS + 1669)


def test_a_flight_against_the_traffic_is_refused_for_want_of_a_path(street: Client) -> None:
    street.post(SUBMIT, json=along())
    answer = problem(street.post(SUBMIT, json=along("E", "W", window_ms=0)), 409, "no-conflict-free-plan")
    assert set(answer) == REFUSAL
    assert answer["reason"] == "no_conflict_free_path"
    assert answer["earliest_feasible_departure"] == format_time(DEPARTURE_MS + 11_677)


ENDURANCE = """
[[aircraft]]
id = "mayfly"
name = "Mayfly"
mass_kg = 1.375
max_vertical_speed_mps = 3.0
max_horizontal_speed_mps = 20.0
endurance_s = {seconds}
"""


@pytest.mark.parametrize(("endurance_s", "status"), [(11.676, 201), (11.675, 409)])
def test_an_aircraft_without_the_endurance_is_refused(
    endurance_s: float, status: int, tmp_path: Path, clock: FakeClock
) -> None:
    ledger, aircraft_types = str(tmp_path / "ledger.sqlite"), tmp_path / "aircraft.toml"
    aircraft_types.write_text(ENDURANCE.format(seconds=endurance_s))
    settings = settings_for(STREET, ledger, tmp_path, aircraft_types=aircraft_types)
    with served(create_app(settings, clock)) as client:
        response = client.post(SUBMIT, json=along(aircraft_type="mayfly"))
        assert response.status_code == status
        if status == 409:
            answer = problem(response, 409, "no-conflict-free-plan")
            assert set(answer) == REFUSAL - {"earliest_feasible_departure"}
            assert (answer["reason"], answer["conflicting_intents"]) == ("endurance_exceeded", [])


@on_sqlite
def test_of_those_in_the_way_a_refusal_names_a_hundred(street: Client) -> None:
    flights = [street.post(SUBMIT, json=along(window_ms=400_000)).json() for _ in range(102)]
    window_ms = parse_time(flights[-1]["departure"]) - DEPARTURE_MS
    refusal = problem(street.post(SUBMIT, json=along(window_ms=window_ms)), 409, "no-conflict-free-plan")
    named = set(refusal["conflicting_intents"])
    assert len(named) == len(refusal["conflicting_intents"]) == 100
    assert named < {flight["id"] for flight in flights}
    read = street.get(f"{SUBMIT}/{refusal['flight_intent_id']}").json()
    assert read["refusal"]["conflicting_intents"] == refusal["conflicting_intents"]


def test_a_refusal_is_recorded_with_its_reasons_and_reserves_nothing(street: Client) -> None:
    first = street.post(SUBMIT, json=along()).json()
    refusal = street.post(SUBMIT, json=along(window_ms=0)).json()
    read = street.get(f"{SUBMIT}/{refusal['flight_intent_id']}").json()
    assert set(read) == (FLIGHT_INTENT - PLANNED) | {"refusal"}
    assert (read["state"], read["sequence"]) == ("rejected", 2)
    assert (read["trajectory"], read["reservations"]) == ([], [])
    assert read["refusal"] == {
        "reason": "no_departure_slot",
        "detail": refusal["detail"],
        "conflicting_intents": [first["id"]],
        "conflicting_constraints": [],
        "earliest_feasible_departure": refusal["earliest_feasible_departure"],
    }
    FlightIntentAnswer.model_validate(read)


# Previews


def test_a_preview_has_the_members_of_an_intent_without_its_numbers(client: Client) -> None:
    response = client.post(PREVIEW, json=intent())
    assert response.status_code == 200
    assert set(response.json()) == PREVIEWED
    assert response.json()["state"] == "preview"
    assert {"location", "etag"} & set(response.headers) == set()
    PreviewAnswer.model_validate(response.json())


def test_a_preview_is_what_the_submission_then_gets(street: Client) -> None:
    street.post(SUBMIT, json=along())
    preview = street.post(PREVIEW, json=along()).json()
    submitted = street.post(SUBMIT, json=along()).json()
    assert preview.pop("displaces") == submitted.pop("displaced") == []
    assert submitted == {**submitted, **preview, "state": "accepted"}


def test_a_preview_records_nothing(client: Client) -> None:
    client.post(PREVIEW, json=intent())
    assert client.get(SUBMIT).json() == {"items": [], "next_cursor": None}
    assert client.get("/v1/events").json()["items"] == []
    assert client.get("/v1/airspace/status", params={"at": format_time(DEPARTURE_MS)}).json()["blocks"] == []


def test_a_preview_without_a_plan_says_why_and_records_no_refusal(street: Client) -> None:
    first = street.post(SUBMIT, json=along()).json()
    answer = problem(street.post(PREVIEW, json=along(window_ms=0)), 409, "no-conflict-free-plan")
    assert set(answer) == REFUSAL - {"flight_intent_id", "sequence"}
    assert (answer["reason"], answer["conflicting_intents"]) == ("no_departure_slot", [first["id"]])
    assert len(street.get(SUBMIT).json()["items"]) == 1


# The departure window


@pytest.mark.parametrize("window_ms", [0, 1])
def test_a_window_that_is_just_open_is_planned(client: Client, window_ms: int) -> None:
    answer = client.post(SUBMIT, json=intent(earliest_ms=START_MS - window_ms, window_ms=window_ms)).json()
    assert answer["departure"] == format_time(START_MS)
    assert answer["ground_hold_s"] == window_ms / 1000


def test_a_window_that_has_just_passed_is_refused(client: Client) -> None:
    response = client.post(SUBMIT, json=intent(earliest_ms=START_MS - 2, window_ms=1))
    detail = problem(response, 422, "departure-in-the-past")["detail"]
    assert detail == "the latest departure, 2026-11-22T07:59:59.999Z, has passed; it is 2026-11-22T08:00:00.000Z"


def test_the_last_millisecond_of_the_horizon_is_planned(client: Client) -> None:
    assert client.post(SUBMIT, json=intent(earliest_ms=START_MS + HORIZON_MS, window_ms=0)).status_code == 201


@on_sqlite
def test_a_millisecond_beyond_the_horizon_is_refused(client: Client) -> None:
    response = client.post(SUBMIT, json=intent(earliest_ms=START_MS + HORIZON_MS + 1, window_ms=0))
    assert "2026-12-22T08:00:00.000Z" in problem(response, 422, "beyond-horizon")["detail"]


@on_sqlite
def test_a_window_that_ends_beyond_the_horizon_is_refused(client: Client) -> None:
    problem(client.post(SUBMIT, json=intent(window_ms=HORIZON_MS)), 422, "beyond-horizon")


@on_sqlite
@pytest.mark.parametrize(
    ("time", "slug"),
    [("9999-12-31T23:59:59.999Z", "beyond-horizon"), ("1970-01-01T00:00:00Z", "departure-in-the-past")],
)
def test_absurd_times_are_refused_by_what_is_wrong_with_them(client: Client, time: str, slug: str) -> None:
    problem(client.post(SUBMIT, json=intent(earliest_departure=time)), 422, slug)


@on_sqlite
@pytest.mark.parametrize("path", [SUBMIT, PREVIEW])
def test_a_preview_is_refused_as_a_submission_is(client: Client, path: str) -> None:
    problem(client.post(path, json=intent(earliest_ms=START_MS - 2, window_ms=1)), 422, "departure-in-the-past")


# Reading


def test_an_unknown_intent_is_a_problem(client: Client) -> None:
    problem(client.get(f"{SUBMIT}/%00"), 404, "unknown-flight-intent")
    problem(client.get(SUBMIT, params={"operator": "\0"}), 422, "validation-error")
    answer = problem(client.get(f"{SUBMIT}/0193-no-such"), 404, "unknown-flight-intent")
    assert answer["detail"] == "there is no flight intent 0193-no-such"


def test_reading_has_the_etag_of_the_version(client: Client) -> None:
    location = client.post(SUBMIT, json=intent()).headers["location"]
    client.delete(location)
    assert client.get(location).headers["etag"] == '"2"'


# Cancelling


def test_cancelling_answers_with_the_cancelled_intent(client: Client) -> None:
    accepted = client.post(SUBMIT, json=intent())
    response = client.delete(accepted.headers["location"])
    assert response.status_code == 200
    assert response.headers["etag"] == '"2"'
    assert response.json() == {**recorded(accepted.json()), "state": "cancelled", "version": "2", "reservations": []}


def test_a_cancelled_intent_still_shows_the_path_it_had(client: Client) -> None:
    accepted = client.post(SUBMIT, json=intent()).json()
    client.delete(f"{SUBMIT}/{accepted['id']}")
    assert client.get(f"{SUBMIT}/{accepted['id']}").json()["trajectory"] == accepted["trajectory"]


def test_a_flight_cancelled_in_the_air_keeps_its_reservations(client: Client, clock: FakeClock) -> None:
    accepted = client.post(SUBMIT, json=intent()).json()
    clock.now_ms = DEPARTURE_MS
    answer = client.delete(f"{SUBMIT}/{accepted['id']}").json()
    assert (answer["state"], answer["reservations"]) == ("cancelled", accepted["reservations"])


def test_a_flight_that_has_arrived_cannot_be_cancelled(client: Client, clock: FakeClock) -> None:
    accepted = client.post(SUBMIT, json=intent()).json()
    clock.now_ms = parse_time(accepted["arrival"]) + 1
    problem(client.delete(f"{SUBMIT}/{accepted['id']}"), 409, "illegal-transition")
    assert client.get(f"{SUBMIT}/{accepted['id']}").json() == recorded(accepted)


def test_a_refused_intent_cannot_be_cancelled(street: Client) -> None:
    street.post(SUBMIT, json=along())
    refused = street.post(SUBMIT, json=along(window_ms=0)).json()
    problem(street.delete(f"{SUBMIT}/{refused['flight_intent_id']}"), 409, "illegal-transition")


def test_an_unknown_intent_cannot_be_cancelled(client: Client) -> None:
    for name in ("0193-no-such", "%00", "01a2025d-cf8d-7793-bfd6-fd7be76cdfea"):
        problem(client.delete(f"{SUBMIT}/{name}"), 404, "unknown-flight-intent")


# Listing


@pytest.fixture
def listed(street: Client) -> Client:
    """Return a client of a service that has recorded five intents.

    1: acme-air, flies 08:01:00 to 08:01:11.676; 2: acme-air, refused, asked for 08:01:00; 3: other-air, cancelled,
    would have flown 09:01:00 to 09:01:11.676; 4: other-air, the same, accepted; 5: acme-air, flies 10:01:00.
    """
    street.post(SUBMIT, json=along())
    street.post(SUBMIT, json=along(window_ms=0))
    hour_ms = 3_600_000
    third = street.post(SUBMIT, json=along(earliest_ms=DEPARTURE_MS + hour_ms, operator="other-air")).json()
    street.delete(f"{SUBMIT}/{third['id']}")
    street.post(SUBMIT, json=along(earliest_ms=DEPARTURE_MS + hour_ms, operator="other-air"))
    street.post(SUBMIT, json=along(earliest_ms=DEPARTURE_MS + 2 * hour_ms))
    return street


@pytest.mark.parametrize(
    ("parameters", "sequences"),
    [
        ({}, [1, 2, 3, 4, 5]),
        ({"operator": "acme-air"}, [1, 2, 5]),
        ({"operator": "other-air"}, [3, 4]),
        ({"operator": "acme"}, []),
        ({"state": "accepted"}, [1, 4, 5]),
        ({"state": "rejected"}, [2]),
        ({"state": "cancelled"}, [3]),
        ({"state": "ended"}, []),
        ({"from": "2026-11-22T08:01:00Z"}, [1, 2, 3, 4, 5]),
        ({"from": "2026-11-22T08:01:11.676Z"}, [1, 3, 4, 5]),
        ({"from": "2026-11-22T08:01:11.677Z"}, [3, 4, 5]),
        ({"to": "2026-11-22T09:01:00.000Z"}, [1, 2]),
        ({"to": "2026-11-22T09:01:00.001Z"}, [1, 2, 3, 4]),
        ({"from": "2026-11-22T09:00:00Z", "to": "2026-11-22T10:00:00Z"}, [3, 4]),
        ({"from": "2026-11-22T11:00:00Z"}, []),
        ({"to": "2026-11-22T08:00:00Z"}, []),
        ({"operator": "other-air", "state": "accepted", "from": "2026-11-22T09:00:00Z"}, [4]),
    ],
)
def test_a_list_has_exactly_what_its_filters_let_through(
    listed: Client, parameters: dict[str, str], sequences: list[int]
) -> None:
    page = listed.get(SUBMIT, params=parameters).json()
    assert [item["sequence"] for item in page["items"]] == sequences
    assert page["next_cursor"] is None


def test_the_items_of_a_list_are_the_intents_themselves(listed: Client) -> None:
    page = listed.get(SUBMIT).json()
    assert set(page) == {"items", "next_cursor"}
    FlightIntentPage.model_validate(page)
    for item in page["items"]:
        assert listed.get(f"{SUBMIT}/{item['id']}").json() == item
    assert {item["state"] for item in page["items"]} == {State.ACCEPTED, State.REJECTED, State.CANCELLED}


@pytest.mark.parametrize(("limit", "pages"), [(1, 5), (2, 3), (3, 2), (5, 1), (500, 1)])
def test_pages_together_are_the_whole_list(listed: Client, limit: int, pages: int) -> None:
    sequences, cursor, seen = [], None, 0
    while seen == 0 or cursor is not None:
        parameters = {"limit": str(limit)} | ({} if cursor is None else {"cursor": cursor})
        page = listed.get(SUBMIT, params=parameters).json()
        sequences += [item["sequence"] for item in page["items"]]
        cursor = page["next_cursor"]
        seen += 1
    assert sequences == [1, 2, 3, 4, 5]
    assert seen == pages


def test_a_page_by_default_has_fifty_items(client: Client) -> None:
    for n in range(51):
        client.post(SUBMIT, json=intent(earliest_ms=DEPARTURE_MS + 60_000 * n))
    page = client.get(SUBMIT).json()
    assert [item["sequence"] for item in page["items"]] == list(range(1, 51))
    rest = client.get(SUBMIT, params={"cursor": page["next_cursor"]}).json()
    assert [item["sequence"] for item in rest["items"]] == [51]


def test_filters_hold_on_the_next_page_too(listed: Client) -> None:
    first = listed.get(SUBMIT, params={"operator": "acme-air", "limit": "2"}).json()
    second = listed.get(SUBMIT, params={"operator": "acme-air", "limit": "2", "cursor": first["next_cursor"]}).json()
    assert [item["sequence"] for item in second["items"]] == [5]


@on_sqlite
@pytest.mark.parametrize(
    "cursor", ["", "garbage", "5", "YWZ0ZXI6", "YWZ0ZXI6LTE", "YWZ0ZXI6MS41", "YmVmb3JlOjE", "ä", "%00", "A" * 5000]
)
def test_a_cursor_of_somebody_elses_making_is_refused(listed: Client, cursor: str) -> None:
    problem(listed.get(SUBMIT, params={"cursor": cursor}), 422, "invalid-cursor")


@on_sqlite
@pytest.mark.parametrize(
    "parameters",
    [
        {"limit": "0"},
        {"limit": "501"},
        {"limit": "-1"},
        {"limit": "many"},
        {"state": "landed"},
        {"from": "yesterday"},
        {"from": "2026-11-22T08:00:00"},
        {"to": "1795334400000"},
    ],
)
def test_a_filter_that_makes_no_sense_is_refused_by_name(client: Client, parameters: dict[str, str]) -> None:
    answer = problem(client.get(SUBMIT, params=parameters), 422, "validation-error")
    assert [error["loc"] for error in answer["errors"]] == [["query", next(iter(parameters))]]
