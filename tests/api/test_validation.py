"""What cannot be a flight intent is refused with a problem that says why, and leaves no trace."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from app.main import create_app
from tests.api.bodies import PREVIEW, PROBLEM, SUBMIT, intent, problem
from tests.api.serving import Client, served, settings_for
from tests.ledger.district import OLD_TOWN, START_MS
from tests.ledger.process import FakeClock

JSON = {"Content-Type": "application/json"}
NOBODY = "01a2025d-cf8d-7793-bfd6-fd7be76cdfea"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """Return a client of a service that nothing is ever recorded in."""
    folder: Path = tmp_path_factory.mktemp("validation")
    settings = settings_for(OLD_TOWN, str(folder / "ledger.sqlite"), folder)
    with served(create_app(settings, FakeClock())) as client:
        yield client


@pytest.fixture
def client(service: Client) -> Iterator[Client]:
    """Return a client; what it does must leave the ledger as it is."""
    before = service.get("/health/ready").json()
    yield service
    assert service.get("/health/ready").json() == before


def raw(client: Client, content: bytes | str, headers: dict[str, str] = JSON) -> Any:
    return client.post(SUBMIT, content=content, headers=headers)


def with_number(text: str) -> str:
    """Return a body whose origin's altitude is written exactly so."""
    body = intent()
    body["origin"]["alt_m"] = 4711
    return json.dumps(body).replace("4711", text)


def intent_with(member: str, value: object) -> dict[str, Any]:
    """Return a body with one member replaced or added."""
    return {**intent(), member: value}


def one_error(response: Any, *loc: str) -> str:
    """Return the message of the one thing that is wrong, after checking where."""
    document = problem(response, 422, "validation-error")
    assert set(document) == PROBLEM | {"errors", "error_count"}
    assert document["error_count"] == 1
    (error,) = document["errors"]
    assert set(error) == {"loc", "msg", "type"}
    assert error["loc"] == ["body", *loc]
    assert document["detail"] == f"{'.'.join(('body', *loc))}: {error['msg']}"
    return str(error["msg"])


# Static reasons


def in_the_house(alt_m: float) -> dict[str, float]:
    """Return a place in the house in the middle, 4 m south of its centre."""
    house, south = OLD_TOWN.centre((3, 2, 0)), OLD_TOWN.centre((3, 1, 0))
    return {"lon": house.lon, "lat": 0.8 * house.lat + 0.2 * south.lat, "alt_m": alt_m}


@pytest.mark.parametrize("where", ["origin", "destination"])
def test_a_place_in_a_building_is_refused_with_the_nearest_free_block(client: Client, where: str) -> None:
    answer = problem(client.post(SUBMIT, json=intent_with(where, in_the_house(20))), 422, "not-plannable")
    assert set(answer) == PROBLEM | {"reason", "nearest_free_block"}
    assert (answer["reason"], answer["nearest_free_block"]) == (f"{where}_blocked", [3, 1, 0])


def test_the_nearest_free_block_may_be_the_one_above(client: Client) -> None:
    answer = problem(client.post(SUBMIT, json=intent(origin=in_the_house(39.9))), 422, "not-plannable")
    assert answer["nearest_free_block"] == [3, 2, 1]


@pytest.mark.parametrize("where", ["origin", "destination"])
@pytest.mark.parametrize(
    "elsewhere",
    [
        {"lon": 71.0, "lat": 51.1},
        {"lon": -180, "lat": -90},
        {"alt_m": -0.001},
        {"alt_m": 80.001},
        {"alt_m": 1e308},
    ],
)
def test_a_place_outside_the_airspace_is_refused(client: Client, where: str, elsewhere: dict[str, float]) -> None:
    outside = {**asdict(OLD_TOWN.centre("A")), **elsewhere}
    answer = problem(client.post(SUBMIT, json=intent_with(where, outside)), 422, "not-plannable")
    assert set(answer) == PROBLEM | {"reason"}
    assert answer["reason"] == "outside_airspace"


def test_the_ceiling_belongs_to_the_airspace(client: Client) -> None:
    top = {**asdict(OLD_TOWN.centre("A")), "alt_m": 80}
    answer = client.post(PREVIEW, json=intent(origin=top)).json()
    assert answer["origin"]["block"] == [0, 4, 1]


def test_a_flight_within_one_block_is_refused(client: Client) -> None:
    answer = problem(client.post(SUBMIT, json=intent("A", "A")), 422, "not-plannable")
    assert set(answer) == PROBLEM | {"reason"}
    assert answer["reason"] == "same_block"


@pytest.mark.parametrize(("origin", "destination"), [("A", "Y"), ("Y", "A")])
def test_a_yard_without_way_in_or_out_is_refused(client: Client, origin: str, destination: str) -> None:
    answer = problem(client.post(SUBMIT, json=intent(origin, destination)), 422, "not-plannable")
    assert set(answer) == PROBLEM | {"reason"}
    assert answer["reason"] == "disconnected"


def test_an_unknown_aircraft_type_is_refused_with_the_known_ones(client: Client) -> None:
    answer = problem(client.post(SUBMIT, json=intent(aircraft_type="balloon")), 422, "unknown-aircraft-type")
    assert "dji-mavic-air, dji-phantom-4, self-built-drone" in answer["detail"]


# Members


@pytest.mark.parametrize("member", ["operator", "aircraft_type", "origin", "destination", "earliest_departure"])
def test_a_missing_member_is_named(client: Client, member: str) -> None:
    body = intent()
    del body[member]
    assert one_error(client.post(SUBMIT, json=body), member) == "Field required"


@pytest.mark.parametrize("member", ["lon", "lat", "alt_m"])
def test_a_missing_coordinate_is_named(client: Client, member: str) -> None:
    body = intent()
    del body["destination"][member]
    assert one_error(client.post(SUBMIT, json=body), "destination", member) == "Field required"


def test_several_errors_are_all_listed(client: Client) -> None:
    body = intent(operator="", priority="high")
    answer = problem(client.post(SUBMIT, json=body), 422, "validation-error")
    assert [error["loc"] for error in answer["errors"]] == [["body", "operator"], ["body", "priority"]]
    assert answer["detail"].endswith("(and 1 more)")


def test_an_unknown_member_is_refused(client: Client) -> None:
    assert one_error(client.post(SUBMIT, json=intent(colour="red")), "colour") == "Extra inputs are not permitted"


def test_an_unknown_coordinate_is_refused(client: Client) -> None:
    body = intent(origin={**asdict(OLD_TOWN.centre("A")), "altitude": 20})
    assert one_error(client.post(SUBMIT, json=body), "origin", "altitude") == "Extra inputs are not permitted"


@pytest.mark.parametrize("member", ["operator", "reference", "aircraft_type"])
@pytest.mark.parametrize(
    "text", ["", "x" * 201, "a\nb", "a\x00b", "a\tb", "\x7f", "a\n", 5, True, ["a"]], ids=lambda text: repr(text)[:10]
)
def test_a_label_is_a_short_text_without_control_characters(client: Client, member: str, text: object) -> None:
    one_error(client.post(SUBMIT, json=intent_with(member, text)), member)


@pytest.mark.parametrize("text", ["x" * 200, "Ärö-Flug 空 🛩", "'; DROP TABLE reservations; --"])
def test_a_label_may_have_any_other_letters(client: Client, text: str) -> None:
    answer = client.post(PREVIEW, json=intent(operator=text, reference=text)).json()
    assert (answer["operator"], answer["reference"]) == (text, text)


@pytest.mark.parametrize("place", ["value", "name"])
def test_half_a_surrogate_pair_is_refused(client: Client, place: str) -> None:
    body = json.dumps(intent_with("operator", "half") if place == "value" else intent_with("half", 1))
    problem(raw(client, body.replace("half", "\\ud800")), 422, "validation-error")


# Numbers


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "-1e999"])
def test_a_number_that_is_not_finite_is_refused(client: Client, number: str) -> None:
    assert one_error(raw(client, with_number(number)), "origin", "alt_m") == "Input should be a finite number"


@pytest.mark.parametrize("number", ["1" + "0" * 400, "-1" + "0" * 400])
def test_an_integer_too_large_for_any_coordinate_is_refused(client: Client, number: str) -> None:
    one_error(raw(client, with_number(number)), "origin", "alt_m")


def test_an_integer_of_ten_thousand_digits_is_refused(client: Client) -> None:
    problem(raw(client, with_number("1" * 10_000)), 400, "malformed-request")


@pytest.mark.parametrize("value", ["20", True, None, [20], {"m": 20}])
def test_a_coordinate_is_a_number_and_nothing_else(client: Client, value: object) -> None:
    body = intent(origin={**asdict(OLD_TOWN.centre("A")), "alt_m": value})
    one_error(client.post(SUBMIT, json=body), "origin", "alt_m")


@pytest.mark.parametrize(
    ("member", "value"), [("lon", 180.0001), ("lon", -180.0001), ("lat", 90.0001), ("lat", -90.0001)]
)
def test_degrees_have_their_bounds(client: Client, member: str, value: float) -> None:
    body = intent(origin={**asdict(OLD_TOWN.centre("A")), member: value})
    one_error(client.post(SUBMIT, json=body), "origin", member)


def test_whole_numbers_are_coordinates_too(client: Client) -> None:
    body = intent(origin={**asdict(OLD_TOWN.centre("A")), "alt_m": 20})
    assert client.post(PREVIEW, json=body).status_code == 200


@pytest.mark.parametrize("value", [0.0, "0", True, None, 1001, -1001])
def test_a_priority_is_a_small_whole_number(client: Client, value: object) -> None:
    one_error(client.post(SUBMIT, json=intent(priority=value)), "priority")


# Times


@pytest.mark.parametrize(
    ("time", "message"),
    [
        ("2026-11-22T08:01:00", "the time has no offset; end it with Z or an offset such as +05:00"),
        ("2026-11-22", "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z"),
        ("2026-11-22T08:01Z", "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z"),
        ("2026-11-22T08:01:00.Z", "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z"),
        ("2026-11-22T08:01:00Z\n", "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z"),
        ("2026-11-22T08:01:00+0500", "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z"),
        ("٢٠٢٦-11-22T08:01:00Z", "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z"),
        ("soon", "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z"),
        ("", "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z"),
        (None, "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z"),
        (1795334460000, "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z, not a number"),
        (1795334460.0, "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z"),
        (True, "expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z"),
        ("2026-11-22T08:01:00+24:00", "the time's offset must lie within 23:59"),
        ("2026-11-22T08:01:00+00:60", "the time's offset must lie within 23:59"),
    ],
)
def test_a_time_that_is_none_is_refused_with_an_example(client: Client, time: object, message: str) -> None:
    assert one_error(client.post(SUBMIT, json=intent(earliest_departure=time)), "earliest_departure") == message


@pytest.mark.parametrize(
    "time",
    [
        "2026-11-22T08:01:60Z",
        "2026-11-22T24:00:00Z",
        "2026-11-31T08:01:00Z",
        "2026-02-29T08:01:00Z",
        "2026-13-01T08:01:00Z",
        "0000-01-01T00:00:00Z",
    ],
)
def test_a_moment_that_the_calendar_lacks_is_refused(client: Client, time: str) -> None:
    message = one_error(client.post(SUBMIT, json=intent(earliest_departure=time)), "earliest_departure")
    assert message.startswith("not a date and time: ")


@pytest.mark.parametrize(
    ("written", "answered"),
    [
        ("2026-11-22T08:01:00Z", "2026-11-22T08:01:00.000Z"),
        ("2026-11-22t08:01:00z", "2026-11-22T08:01:00.000Z"),
        ("2026-11-22T13:01:00+05:00", "2026-11-22T08:01:00.000Z"),
        ("2026-11-22T02:31:00-05:30", "2026-11-22T08:01:00.000Z"),
        ("2026-11-22T08:01:00-00:00", "2026-11-22T08:01:00.000Z"),
        ("2026-11-22T08:01:00.5Z", "2026-11-22T08:01:00.500Z"),
        ("2026-11-22T08:01:00.123Z", "2026-11-22T08:01:00.123Z"),
        ("2026-11-22T08:01:00.123000000Z", "2026-11-22T08:01:00.123Z"),
        ("2026-11-22T08:01:00.1230001Z", "2026-11-22T08:01:00.124Z"),
        ("2026-11-22T08:01:00.000000000000000000000000000001Z", "2026-11-22T08:01:00.001Z"),
        ("2026-11-22T08:01:59.9999Z", "2026-11-22T08:02:00.000Z"),
    ],
)
def test_a_time_is_answered_in_utc_rounded_up_to_the_millisecond(client: Client, written: str, answered: str) -> None:
    answer = client.post(PREVIEW, json=intent(earliest_departure=written)).json()
    assert answer["earliest_departure"] == answered
    assert answer["departure"] == answered


def test_a_latest_departure_before_the_earliest_is_refused(client: Client) -> None:
    body = intent(latest_departure="2026-11-22T08:00:59.999Z")
    assert one_error(client.post(SUBMIT, json=body)) == "latest_departure lies before earliest_departure"


def test_a_latest_departure_at_the_earliest_is_accepted(client: Client) -> None:
    assert client.post(PREVIEW, json=intent(window_ms=0)).status_code == 200


@pytest.mark.parametrize(("before_ms", "status"), [(86_400_000, 200), (86_400_001, 422)])
def test_a_window_may_have_opened_a_day_ago_at_most(client: Client, before_ms: int, status: int) -> None:
    body = intent(earliest_ms=START_MS - before_ms, window_ms=before_ms + 60_000)
    assert client.post(PREVIEW, json=body).status_code == status


def test_an_earliest_departure_ages_ago_is_refused_as_absurd(client: Client) -> None:
    body = intent(earliest_departure="0001-01-01T00:00:00Z", latest_departure="2026-11-22T08:05:00Z")
    assert client.post(PREVIEW, json=body).status_code == 422


# Bodies


@pytest.mark.parametrize(
    "content", ["", "{", "nonsense", '{"operator": "a",}', "{'operator': 'a'}", '{"a": 1} {"b": 2}', "\x00"]
)
def test_a_body_that_is_not_json_is_malformed(client: Client, content: str) -> None:
    if content == "":
        problem(raw(client, content), 422, "validation-error")
    else:
        answer = problem(raw(client, content), 400, "malformed-request")
        assert answer["detail"] == "the body is not valid JSON"


@pytest.mark.parametrize("content", ["null", "[]", '"text"', "5", "[[]]"])
def test_json_that_is_no_object_is_refused(client: Client, content: str) -> None:
    problem(raw(client, content), 422, "validation-error")


@pytest.mark.parametrize("content", [b"\xff\xfe\xfd", b'{"operator": "\xe4"}', json.dumps(intent()).encode("utf-16")])
def test_a_body_that_is_not_utf_8_is_malformed(client: Client, content: bytes) -> None:
    problem(raw(client, content), 400, "malformed-request")


@pytest.mark.parametrize("content", ["[" * 30_000, '{"a":' * 10_000, "[" * 20_000 + "]" * 20_000])
def test_deep_nesting_is_malformed(client: Client, content: str) -> None:
    problem(raw(client, content), 400, "malformed-request")


@pytest.mark.parametrize("media_type", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data"])
def test_a_body_of_another_media_type_is_refused(client: Client, media_type: str) -> None:
    problem(raw(client, json.dumps(intent()), {"Content-Type": media_type}), 415, "unsupported-media-type")


def test_a_body_without_media_type_is_refused(client: Client) -> None:
    problem(raw(client, json.dumps(intent()), {}), 415, "unsupported-media-type")


@pytest.mark.parametrize("media_type", ["application/json; charset=utf-8", "application/problem+json"])
def test_json_by_any_name_is_read(client: Client, media_type: str) -> None:
    response = client.post(PREVIEW, content=json.dumps(intent()), headers={"Content-Type": media_type})
    assert response.status_code == 200


def padded(length: int) -> bytes:
    """Return a body of exactly this many bytes."""
    return json.dumps(intent()).encode().ljust(length)


def in_pieces(content: bytes) -> Any:
    """Return content for a request without Content-Length."""

    async def pieces() -> Any:
        for start in range(0, len(content), 10_000):
            yield content[start : start + 10_000]

    return pieces()


LIMIT = 64 * 1024
LIMIT_OF_INTENTS = 1024 * 1024


def test_a_body_of_just_the_largest_size_is_read(client: Client) -> None:
    assert client.post(PREVIEW, content=padded(LIMIT_OF_INTENTS), headers=JSON).status_code == 200


def test_a_body_of_just_the_largest_size_is_read_in_pieces(client: Client) -> None:
    response = client.post(PREVIEW, content=in_pieces(padded(LIMIT_OF_INTENTS)), headers=JSON)
    assert response.status_code == 200


@pytest.mark.parametrize(
    ("method", "path", "most"),
    [
        ("POST", SUBMIT, LIMIT_OF_INTENTS),
        ("POST", PREVIEW, LIMIT_OF_INTENTS),
        ("PUT", f"{SUBMIT}/{NOBODY}", LIMIT_OF_INTENTS),
        ("DELETE", f"{SUBMIT}/{NOBODY}", LIMIT),
        ("POST", f"{SUBMIT}/{NOBODY}/activate", LIMIT),
        ("GET", SUBMIT, LIMIT),
        ("POST", "/v1/constraints", LIMIT),
        ("GET", "/v1/telemetry", LIMIT),
        ("PATCH", "/nowhere", LIMIT),
    ],
)
def test_a_body_one_byte_too_large_is_refused(client: Client, method: str, path: str, most: int) -> None:
    assert client.request(method, path, content=b"{}".ljust(most), headers=JSON).status_code != 413
    answer = problem(client.request(method, path, content=b"{}".ljust(most + 1), headers=JSON), 413, "body-too-large")
    assert answer["detail"] == f"bodies may have up to {most} bytes"


def test_a_body_one_byte_too_large_is_refused_without_content_length(client: Client) -> None:
    response = client.post(SUBMIT, content=in_pieces(padded(LIMIT_OF_INTENTS + 1)), headers=JSON)
    problem(response, 413, "body-too-large")


def test_how_large_a_flight_intent_may_be_is_a_setting(tmp_path: Path) -> None:
    settings = settings_for(OLD_TOWN, str(tmp_path / "ledger.sqlite"), tmp_path, max_intent_bytes=1024)
    with served(create_app(settings, FakeClock())) as client:
        assert client.post(PREVIEW, content=padded(1024), headers=JSON).status_code == 200
        answer = problem(client.post(PREVIEW, content=padded(1025), headers=JSON), 413, "body-too-large")
    assert answer["detail"] == "bodies may have up to 1024 bytes"


def test_a_body_that_announces_too_much_is_refused_before_it_is_read(client: Client) -> None:
    headers = {**JSON, "Content-Length": "2000000"}
    problem(client.post(SUBMIT, content=in_pieces(b"{"), headers=headers), 413, "body-too-large")


def test_a_body_that_announces_an_absurd_length_is_refused(client: Client) -> None:
    headers = {**JSON, "Content-Length": "9" * 5000}
    problem(client.post(SUBMIT, content=in_pieces(b"{"), headers=headers), 413, "body-too-large")


def test_the_first_hundred_errors_are_told_and_how_many_there_are(client: Client) -> None:
    answer = problem(client.post(f"{SUBMIT}/batch", json={"flight_intents": [0] * 300}), 422, "validation-error")
    assert len(answer["errors"]) == 100
    assert answer["error_count"] == 300
    assert answer["detail"].endswith(f"(and {answer['error_count'] - 1} more)")


STRANGE = {f"strange-{n}": n for n in range(1_000)}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (STRANGE, [["strange-0"]]),
        ({"origin": {**asdict(OLD_TOWN.centre("A")), **STRANGE}}, [["origin", "strange-0"]]),
        ({"trajectory": [], **STRANGE}, [["origin"]]),
        ({"volumes": [STRANGE] * 2, **STRANGE}, [["volumes", 0, "strange-0"], ["earliest_departure"]]),
    ],
    ids=["body", "origin", "trajectory", "volumes"],
)
def test_of_members_that_nobody_asked_for_one_is_told_of_each_part_of_a_body(
    client: Client, changes: dict[str, Any], told: list[Any]
) -> None:
    answer = problem(client.post(SUBMIT, json=intent() | changes), 422, "validation-error")
    assert [error["loc"][1:] for error in answer["errors"] if error["type"] == "extra_forbidden"] == told
