"""Telemetry over HTTP: what is taken, what is refused and why, and that a report may be repeated."""

import asyncio
import json
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import httpx
import pytest
from sqlalchemy import Engine, event
from sqlalchemy.exc import OperationalError

from app.main import create_app
from app.routes.telemetry import MAX_POSITIONS, TelemetryAnswer
from app.settings import Settings
from app.times import format_time
from tests.api.bodies import SUBMIT, TELEMETRY, intent, position, problem, report
from tests.api.serving import Client, served
from tests.api.test_running import settings_with
from tests.ledger.district import DEPARTURE_MS, OLD_TOWN, START_MS
from tests.ledger.locations import database, on_sqlite, write_lock
from tests.ledger.process import FakeClock, until

NOBODY = "01a2025d-cf8d-7793-bfd6-fd7be76cdfea"
HOUR_MS = 3_600_000
TAKEN = {"accepted": 1, "problem_count": 0, "problems": [], "flagged": []}


def send(client: Client, *positions: Any) -> dict[str, Any]:
    """Report positions; return what became of them."""
    response = client.post(TELEMETRY, json=report(*positions))
    assert response.status_code == 202, response.text
    answer: dict[str, Any] = response.json()
    TelemetryAnswer.model_validate(answer)
    return answer


def send_raw(client: Client, content: str | bytes) -> httpx.Response:
    return client.post(TELEMETRY, content=content, headers={"Content-Type": "application/json"})


def seen(time_ms: int = START_MS, place: Any = "A", **members: Any) -> dict[str, Any]:
    """Return a position of a track."""
    return position(place, time_ms, **{"track_id": "radar-1", **members})


def slugs(answer: dict[str, Any]) -> dict[int, str]:
    """Return which positions were refused, and as what."""
    return {item["index"]: item["type"].removeprefix("/problems/") for item in answer["problems"]}


def refusal(client: Client, bad: Any, slug: str) -> str:
    """Report a position between two good ones, which are taken; return the detail of its refusal."""
    answer = send(client, seen(track_id="before"), bad, seen(track_id="after"))
    assert (answer["accepted"], slugs(answer)) == (2, {1: slug})
    return str(answer["problems"][0]["detail"])


def recorded(settings: Settings) -> list[tuple[Any, ...]]:
    """Return everything that a ledger knows of positions."""
    with database(settings.ledger) as connection:
        history = connection.rows("SELECT * FROM position_history ORDER BY intent, track_id, time")
        return [*history, *connection.rows("SELECT * FROM newest_positions ORDER BY intent, track_id")]


def tracks(client: Client) -> dict[str, Any]:
    return {item["track_id"]: item for item in client.get("/v1/flights").json()["items"]}


def flown(client: Client, **members: Any) -> str:
    return str(client.post(SUBMIT, json=intent(**members)).json()["id"])


# What is taken


def test_a_position_is_taken_and_known_at_once(client: Client) -> None:
    assert send(client, seen(airborne=True)) == TAKEN
    where = OLD_TOWN.centre("A")
    assert tracks(client)["radar-1"]["position"] == {
        "time": format_time(START_MS), "lon": where.lon, "lat": where.lat, "alt_m": where.alt_m, "airborne": True,
        "block": [0, 4, 0], "age_s": 0.0, "flagged": False,
    }  # fmt: skip


def test_a_position_may_name_a_flight(client: Client, clock: FakeClock) -> None:
    flight = flown(client)
    clock.now_ms = DEPARTURE_MS
    assert send(client, position("A", DEPARTURE_MS, flight_intent_id=flight)) == TAKEN
    (item,) = client.get("/v1/flights").json()["items"]
    assert (item["flight_intent_id"], item["track_id"], item["position"]["block"]) == (flight, None, [0, 4, 0])
    assert item["position"]["airborne"] is None


@on_sqlite
def test_an_id_is_the_same_flight_however_it_is_spelled(client: Client) -> None:
    flight = flown(client)
    answer = send(
        client,
        position("A", START_MS, flight_intent_id=flight.upper()),
        position("A", START_MS, flight_intent_id=flight.replace("-", "")),
    )
    assert answer == {**TAKEN, "accepted": 2}


@on_sqlite
@pytest.mark.parametrize("airborne", [True, False, None])
def test_whether_an_aircraft_flies_is_kept_as_it_was_said(client: Client, airborne: bool | None) -> None:
    assert send(client, seen(airborne=airborne)) == TAKEN
    assert tracks(client)["radar-1"]["position"]["airborne"] is airborne


@on_sqlite
def test_an_empty_report_is_taken(client: Client) -> None:
    assert send(client) == {**TAKEN, "accepted": 0}


@on_sqlite
@pytest.mark.parametrize("time_ms", [START_MS + 2000, START_MS - HOUR_MS])
def test_a_clock_may_be_a_little_ahead_and_a_report_an_hour_late(client: Client, time_ms: int) -> None:
    assert send(client, seen(time_ms)) == TAKEN


@on_sqlite
@pytest.mark.parametrize(
    "elsewhere",
    [{"alt_m": 20_000}, {"alt_m": -20_000}, {"lat": 51.29}, {"lon": 71.69}],
    ids=["high", "deep", "north", "east"],
)
def test_an_aircraft_may_be_some_kilometres_away(client: Client, elsewhere: dict[str, Any]) -> None:
    assert send(client, seen(**elsewhere)) == TAKEN
    assert tracks(client)["radar-1"]["position"]["block"] is None


@on_sqlite
@pytest.mark.parametrize("state", ["rejected", "cancelled", "ended"])
def test_an_aircraft_that_flies_without_an_accepted_plan_is_still_seen(client: Client, state: str) -> None:
    flight = flown(client)
    if state == "rejected":
        flight = str(client.post(SUBMIT, json=intent(window_ms=0)).json()["flight_intent_id"])
    elif state == "cancelled":
        client.delete(f"{SUBMIT}/{flight}")
    else:
        client.post(f"{SUBMIT}/{flight}/end")
    assert send(client, position("A", START_MS, flight_intent_id=flight, airborne=True)) == TAKEN
    (item,) = [item for item in client.get("/v1/flights").json()["items"] if item["flight_intent_id"] == flight]
    assert (item["state"], item["conformance"], item["reasons"]) == (state, "deviating", ["not_accepted"])


# Each for itself: what is refused, by name


def test_a_refused_position_is_named_explained_and_harms_no_other(client: Client) -> None:
    answer = send(client, seen(), position("A", START_MS, flight_intent_id=NOBODY), seen(track_id="radar-2"))
    assert answer == {
        "accepted": 2,
        "problem_count": 1,
        "problems": [
            {
                "index": 1,
                "type": "/problems/unknown-flight",
                "title": "Unknown flight",
                "status": 404,
                "detail": f"there is no flight intent {NOBODY}",
            }
        ],
        "flagged": [],
    }
    assert client.get("/problems/unknown-flight").status_code == 200
    assert set(tracks(client)) == {"radar-1", "radar-2"}


@on_sqlite
def test_a_position_of_the_future_is_refused(client: Client) -> None:
    detail = refusal(client, seen(START_MS + 2001), "position-in-the-future")
    assert detail == "taken at 2026-11-22T08:00:02.001Z, but it is 2026-11-22T08:00:00.000Z"


@on_sqlite
def test_a_position_that_would_not_be_kept_is_refused(client: Client) -> None:
    detail = refusal(client, seen(START_MS - HOUR_MS - 1), "position-too-old")
    assert detail == "taken at 2026-11-22T06:59:59.999Z; positions are kept for 1 h"


@on_sqlite
@pytest.mark.parametrize(
    "elsewhere",
    [{"lat": 51.3}, {"lon": 71.71}, {"lon": -180}, {"lat": 90}, {"lat": -90}, {"alt_m": 20_001}, {"alt_m": -1e308}],
    ids=["north", "east", "antimeridian", "north pole", "south pole", "orbit", "core"],
)
def test_a_position_nowhere_near_is_refused(client: Client, elsewhere: dict[str, Any]) -> None:
    refusal(client, seen(**elsewhere), "position-remote")


@on_sqlite
@pytest.mark.parametrize("member", ["lon", "lat", "alt_m"])
@pytest.mark.parametrize("value", ["NaN", "Infinity", "-Infinity", "1e999", "-1e999"])
def test_a_position_that_is_not_finite_is_refused(client: Client, member: str, value: str) -> None:
    content = json.dumps(report(seen(), seen(**dict[str, Any](track_id="radar-2") | {member: 12345})))
    answer = send_raw(client, content.replace("12345", value))
    assert answer.status_code == 202
    assert (answer.json()["accepted"], slugs(answer.json())) == (1, {1: "position-not-finite"})


@on_sqlite
@pytest.mark.parametrize("missing", ["track_id", "time", "lon", "lat", "alt_m"])
def test_a_position_with_something_missing_is_refused(client: Client, missing: str) -> None:
    bad = {name: value for name, value in seen().items() if name != missing}
    detail = refusal(client, bad, "invalid-position")
    expected = "name either a flight_intent_id or a track_id" if missing == "track_id" else f"{missing}: Field required"
    assert detail == expected


@on_sqlite
@pytest.mark.parametrize(
    "members",
    [
        {"flight_intent_id": NOBODY},
        {"flight_intent_id": "ORD-7781", "track_id": None},
        {"flight_intent_id": 7, "track_id": None},
        {"track_id": ""},
        {"track_id": " "},
        {"track_id": "x" * 201},
        {"track_id": "radar\u0000one"},
        {"track_id": "radar\none"},
        {"track_id": 17},
        {"time": "2026-11-22T08:00:00"},
        {"time": 1_795_334_400_000},
        {"time": None},
        {"lon": "71.4"},
        {"lon": 180.1},
        {"lon": True},
        {"lon": 10**400},
        {"lat": -90.1},
        {"alt_m": None},
        {"alt_m": [20]},
        {"airborne": "yes"},
        {"airborne": 1},
        {"speed_mps": 12},
    ],
    ids=str,
)
def test_what_is_no_position_is_refused(client: Client, members: dict[str, Any]) -> None:
    refusal(client, seen(**members), "invalid-position")


@on_sqlite
@pytest.mark.parametrize("item", [None, [], "here", 7, True])
def test_what_is_not_even_an_object_is_refused(client: Client, item: object) -> None:
    refusal(client, item, "invalid-position")


# Order


def test_an_older_position_than_the_newest_is_refused(client: Client) -> None:
    send(client, seen())
    answer = send(client, seen(START_MS - 1))
    assert slugs(answer) == {0: "position-out-of-order"}
    assert answer["problems"][0]["detail"] == (
        "taken at 2026-11-22T07:59:59.999Z; one taken at 2026-11-22T08:00:00.000Z is known"
    )
    assert tracks(client)["radar-1"]["position"]["time"] == format_time(START_MS)


def test_another_position_of_the_same_moment_is_refused(client: Client) -> None:
    send(client, seen())
    answer = send(client, seen(place="B"))
    assert slugs(answer) == {0: "position-out-of-order"}
    assert answer["problems"][0]["detail"] == "another position taken at 2026-11-22T08:00:00.000Z is known"
    assert tracks(client)["radar-1"]["position"]["block"] == [0, 4, 0]


def test_positions_of_a_clock_that_was_ahead_and_was_set_back_do_not_keep_out_newer_ones(
    client: Client, clock: FakeClock
) -> None:
    clock.advance(seconds=3_600)
    send(client, seen(START_MS + 3_600_000))
    clock.advance(seconds=-3_600)
    assert send(client, seen(START_MS))["accepted"] == 1
    assert slugs(send(client, seen(START_MS - 1))) == {0: "position-out-of-order"}
    assert tracks(client)["radar-1"]["position"]["time"] == format_time(START_MS)


def test_positions_of_one_report_count_in_their_order(client: Client) -> None:
    answer = send(client, seen(START_MS - 2), seen(START_MS), seen(START_MS - 1), seen(START_MS, "B"))
    assert (answer["accepted"], slugs(answer)) == (2, {2: "position-out-of-order", 3: "position-out-of-order"})


@on_sqlite
def test_the_order_is_each_aircraft_s_own(client: Client) -> None:
    flight = flown(client)
    answer = send(
        client,
        seen(START_MS),
        seen(START_MS - 1, track_id="radar-2"),
        position("A", START_MS - 2, flight_intent_id=flight),
        position("A", START_MS - 3, track_id=flight),
    )
    assert answer == {**TAKEN, "accepted": 4}


# Repetition


def test_a_repeated_position_is_answered_as_before_and_not_recorded_again(client: Client, settings: Settings) -> None:
    send(client, seen(START_MS - 1000))
    first = send(client, seen(place="B"))
    before = recorded(settings)
    assert send(client, seen(place="B")) == first
    assert recorded(settings) == before


def test_a_position_said_twice_in_one_report_is_recorded_once(client: Client, settings: Settings) -> None:
    assert send(client, seen(), seen()) == {**TAKEN, "accepted": 2}
    assert len(recorded(settings)) == 2  # one in the history, one as the newest


def test_a_repeated_report_changes_nothing(client: Client, settings: Settings) -> None:
    positions = [seen(START_MS - 1000), seen(), seen(track_id="radar-2")]
    send(client, *positions)
    before = recorded(settings), client.get("/v1/flights").json()
    assert slugs(send(client, *positions)) == {0: "position-out-of-order"}
    assert (recorded(settings), client.get("/v1/flights").json()) == before


# Velocity, and what no aircraft does


@on_sqlite
def test_two_positions_make_a_velocity(client: Client) -> None:
    send(client, seen(START_MS - 1000, OLD_TOWN.point(1, 3)))
    assert tracks(client)["radar-1"]["velocity_mps"] is None
    send(client, seen(START_MS, OLD_TOWN.point(1.5, 3, alt_m=17)))
    velocity = tracks(client)["radar-1"]["velocity_mps"]
    # The grid's east lies two degrees off true east.
    assert velocity == pytest.approx({"east": 10.0, "north": 0.0, "up": -3.0}, abs=0.5)


@on_sqlite
def test_positions_too_near_in_time_change_no_velocity_and_are_no_jump(client: Client) -> None:
    send(client, seen(START_MS - 1000, OLD_TOWN.point(1, 3)), seen(START_MS - 499, OLD_TOWN.point(1.25, 3)))
    before = tracks(client)["radar-1"]["velocity_mps"]
    answer = send(client, seen(START_MS, OLD_TOWN.point(3.25, 3)))
    assert (answer["flagged"], before) == ([], tracks(client)["radar-1"]["velocity_mps"])


@on_sqlite
def test_reads_are_answered_while_a_great_many_reports_wait(client: Client, settings: Settings) -> None:
    # More than there are threads for what blocks.
    with ThreadPoolExecutor(60) as reporters:
        with write_lock(settings.ledger):
            sent = [reporters.submit(send, client, seen(track_id=f"radar-{number}")) for number in range(60)]
            asyncio.run(until(lambda: client.service.writer.waiting >= 59))
            assert client.get("/v1/airspace/status").json()["blocks"] == []
        assert [answer.result()["accepted"] for answer in sent] == [1] * 60


@on_sqlite
@pytest.mark.parametrize(("apart_ms", "is_known"), [(10_000, True), (10_001, False)])
def test_positions_too_far_apart_in_time_make_no_velocity(client: Client, apart_ms: int, is_known: bool) -> None:
    send(client, seen(START_MS - apart_ms), seen(START_MS))
    assert (tracks(client)["radar-1"]["velocity_mps"] is not None) == is_known


def test_a_jump_that_no_aircraft_makes_is_taken_and_flagged(client: Client) -> None:
    answer = send(client, seen(START_MS - 2000), seen(START_MS - 1000), seen(START_MS, "B"))
    assert answer == {
        "accepted": 3,
        "problem_count": 0,
        "problems": [],
        "flagged": [
            {
                "index": 2,
                "flag": "implausible-jump",
                "detail": "further from the last position than aircraft fly",
            }
        ],
    }
    item = tracks(client)["radar-1"]
    assert (item["position"]["block"], item["position"]["flagged"], item["velocity_mps"]) == ([7, 4, 0], True, None)


@on_sqlite
def test_after_a_jump_an_aircraft_goes_on_from_there(client: Client) -> None:
    send(client, seen(START_MS - 2000), seen(START_MS - 1000, "B"))
    assert send(client, seen(START_MS, "B")) == TAKEN
    assert tracks(client)["radar-1"]["position"]["flagged"] is False


def test_a_repeated_jump_is_flagged_again(client: Client) -> None:
    send(client, seen(START_MS - 1000))
    jump = send(client, seen(place="B"))
    assert [flag["index"] for flag in jump["flagged"]] == [0]
    assert send(client, seen(place="B")) == jump


@on_sqlite
@pytest.mark.parametrize(("seconds", "flagged"), [(2, True), (3, False)])
def test_what_is_a_jump_depends_on_the_time_it_took(client: Client, seconds: int, flagged: bool) -> None:
    # From A to B: 140 m.
    answer = send(client, seen(START_MS - 1000 * seconds), seen(START_MS, "B"))
    assert bool(answer["flagged"]) == flagged


# Too much, and what is no report


def test_five_thousand_positions_are_one_report(client: Client) -> None:
    positions = [seen(track_id=f"radar-{n}") for n in range(MAX_POSITIONS)]
    assert MAX_POSITIONS == 5_000
    assert send(client, *positions) == {**TAKEN, "accepted": 5_000}
    assert len(tracks(client)) == 5_000


@on_sqlite
def test_more_than_that_are_refused_as_a_whole(client: Client, settings: Settings) -> None:
    positions = [seen(track_id=f"radar-{n}") for n in range(MAX_POSITIONS + 1)]
    answer = problem(client.post(TELEMETRY, json=report(*positions)), 413, "too-many-positions")
    assert answer["detail"] == "5001 positions; a report may have up to 5000"
    assert recorded(settings) == []


@on_sqlite
def test_of_positions_that_are_none_the_first_hundred_are_told_and_how_many_were_refused(client: Client) -> None:
    answer = send(client, *[0] * 4_000, *[{}] * 998, seen(), seen(place="B"))
    assert (answer["accepted"], answer["problem_count"]) == (1, 4_999)
    assert slugs(answer) == dict.fromkeys(range(100), "invalid-position") | {4_999: "position-out-of-order"}


@on_sqlite
def test_all_that_are_refused_are_counted_told_or_not(client: Client) -> None:
    send(client, *[0] * 150, seen(alt_m="high"), seen(START_MS + 60_000), seen())
    counted = re.findall(r'^airmatrix_positions_total{outcome="(.+)"} (.+)$', client.get("/metrics").text, re.M)
    assert {outcome: float(count) for outcome, count in counted if float(count)} == {
        "invalid-position": 151,
        "position-in-the-future": 1,
        "accepted": 1,
    }


@on_sqlite
def test_each_position_that_can_be_read_is_told_of_when_it_is_refused(client: Client) -> None:
    answer = send(client, *(seen(START_MS + 60_000, track_id=f"radar-{n}") for n in range(300)))
    assert (answer["accepted"], answer["problem_count"]) == (0, 300)
    assert slugs(answer) == dict.fromkeys(range(300), "position-in-the-future")


@on_sqlite
@pytest.mark.parametrize(("size", "status"), [(2 * 2**20, 202), (2 * 2**20 + 1, 413)])
def test_a_report_may_have_two_mebibytes(client: Client, size: int, status: int) -> None:
    content = '{"positions": []}'
    assert send_raw(client, content + " " * (size - len(content))).status_code == status


@on_sqlite
def test_how_large_a_report_may_be_is_a_setting(settings: Settings, clock: FakeClock) -> None:
    with served(create_app(settings_with(settings, max_telemetry_bytes=1024), clock)) as client:
        answer = problem(send_raw(client, b" " * 1025), 413, "body-too-large")
    assert answer["detail"] == "bodies may have up to 1024 bytes"


@on_sqlite
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b'{"positions": [',
        b'{"positions": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
        b'{"positions": [' + b'{"a":' * 100_000 + b"1" + b"}" * 100_000 + b"]}",
        b'{"positions": [{"track_id": "\\ud800"}]}',
        b'{"positions": "\xff"}',
    ],
    ids=["empty", "half", "half a list", "deep lists", "deep objects", "lone surrogate", "not UTF-8"],
)
def test_what_is_not_json_is_malformed(client: Client, content: bytes) -> None:
    problem(send_raw(client, content), 400, "malformed-request")


@on_sqlite
@pytest.mark.parametrize(
    ("content", "loc"),
    [
        ("null", ["body"]),
        ("[]", ["body"]),
        ("7", ["body"]),
        ("{}", ["body", "positions"]),
        ('{"positions": null}', ["body", "positions"]),
        ('{"positions": {}}', ["body", "positions"]),
        ('{"positions": "here"}', ["body", "positions"]),
        ('{"positions": [], "operator": "acme-air"}', ["body", "operator"]),
        ('{"positions": [], "one": 1, "two": 2}', ["body", "one"]),
    ],
)
def test_what_is_no_report_is_refused_by_name(client: Client, content: str, loc: list[str]) -> None:
    answer = problem(send_raw(client, content), 422, "validation-error")
    assert [error["loc"] for error in answer["errors"]] == [loc]


# When it cannot be recorded


@contextmanager
def failing(statement: str) -> Iterator[None]:
    """Fail every statement that begins like this."""

    def listener(_connection: object, _cursor: object, text: str, *_: object) -> None:
        if text.startswith(statement):
            raise OperationalError(text, {}, Exception("disk I/O error"))

    event.listen(Engine, "before_cursor_execute", listener)
    try:
        yield
    finally:
        event.remove(Engine, "before_cursor_execute", listener)


@pytest.mark.parametrize("statement", ["INSERT INTO newest_positions", "INSERT INTO position_history"])
def test_a_report_that_cannot_be_recorded_whole_is_not_recorded(
    client: Client, settings: Settings, statement: str
) -> None:
    send(client, seen(START_MS - 1000))
    before = recorded(settings)
    with failing(statement):
        response = client.post(TELEMETRY, json=report(seen(), seen(track_id="radar-2")))
    problem(response, 503, "ledger-unavailable")
    assert response.headers["retry-after"] == "1"
    assert recorded(settings) == before
    assert send(client, seen(), seen(track_id="radar-2")) == {**TAKEN, "accepted": 2}


@on_sqlite
def test_a_service_whose_writer_has_stopped_takes_no_positions(client: Client) -> None:
    client.service.writer.stop()
    problem(client.post(TELEMETRY, json=report(seen())), 503, "ledger-unavailable")


@on_sqlite
def test_a_server_that_only_reads_takes_no_positions(client: Client, settings: Settings, clock: FakeClock) -> None:
    del client
    with served(create_app(settings_with(settings, read_only=True), clock)) as reader:
        problem(reader.post(TELEMETRY, json=report(seen())), 421, "read-only")
    assert recorded(settings) == []
