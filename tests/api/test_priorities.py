"""Priority over HTTP: who makes way, and how answers, events, the stream and what can be read agree on it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.main import create_app
from app.routes.answers import ChangedFlightIntentAnswer, FlightIntentAnswer, PreviewAnswer
from app.settings import Settings
from app.times import format_time, parse_time
from tests.api.bodies import PREVIEW, SUBMIT, intent, problem, recorded
from tests.api.serving import Client, served, settings_for
from tests.api.streaming import streaming
from tests.api.test_running import settings_with
from tests.ledger.district import DEPARTURE_MS, STREET
from tests.ledger.locations import on_sqlite
from tests.ledger.process import FakeClock

# How long a flight holds the first block and, with it, the street.
HOLD_S = 3.337


@pytest.fixture
def on_street(ledger: str, tmp_path: Path) -> Settings:
    return settings_for(STREET, ledger, tmp_path)


@pytest.fixture
def street(on_street: Settings, clock: FakeClock) -> Iterator[Client]:
    """Return a client of a service over one street."""
    with served(create_app(on_street, clock)) as client:
        yield client


def along(priority: int = 0, **members: Any) -> dict[str, Any]:
    return intent("W", "E", district=STREET, priority=priority, **members)


def submit(client: Client, priority: int = 0, **members: Any) -> dict[str, Any]:
    response = client.post(SUBMIT, json=along(priority, **members))
    assert response.status_code == 201, response.text
    answer: dict[str, Any] = response.json()
    ChangedFlightIntentAnswer.model_validate(answer)
    return answer


def read(client: Client, flight: str) -> dict[str, Any]:
    answer: dict[str, Any] = client.get(f"{SUBMIT}/{flight}").json()
    FlightIntentAnswer.model_validate(answer)
    return answer


def events(client: Client, after: int) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = client.get("/v1/events", params={"after": str(after)}).json()["items"]
    return items


def test_the_answer_tells_who_made_way_and_by_how_much(street: Client) -> None:
    first = submit(street, operator="other-air")
    urgent = submit(street, 1)
    assert urgent["displaced"] == [
        {
            "flight_intent_id": first["id"],
            "sequence": 1,
            "state": "accepted",
            "reason": None,
            "departure_moved_s": HOLD_S,
            "arrival_moved_s": HOLD_S,
        }
    ]
    assert (urgent["departure"], urgent["delay_s"]) == (format_time(DEPARTURE_MS), 0.0)
    moved = read(street, first["id"])
    assert moved["version"] == urgent["version"] == "2"
    assert parse_time(moved["departure"]) - parse_time(first["departure"]) == HOLD_S * 1000
    assert read(street, urgent["id"]) == recorded(urgent)


def test_who_finds_no_place_is_displaced_and_can_be_read_with_the_reason(street: Client) -> None:
    first = submit(street, window_ms=0)
    urgent = submit(street, 1)
    (told,) = urgent["displaced"]
    assert (told["state"], told["reason"]) == ("displaced", "no_departure_slot")
    assert (told["departure_moved_s"], told["arrival_moved_s"]) == (None, None)
    answer = read(street, first["id"])
    assert (answer["state"], answer["sequence"], answer["reservations"], answer["trajectory"]) == (
        "displaced", 1, [], [],
    )  # fmt: skip
    assert "departure" not in answer
    refusal = answer["refusal"]
    assert (refusal["reason"], refusal["conflicting_intents"]) == ("no_departure_slot", [urgent["id"]])
    assert refusal["detail"].startswith(f"displaced by flight intent {urgent['id']}, which has a higher priority")
    assert parse_time(refusal["earliest_feasible_departure"]) > DEPARTURE_MS
    (listed,) = street.get(SUBMIT, params={"state": "displaced"}).json()["items"]
    assert listed == answer


def test_events_of_one_revision_tell_of_who_came_and_who_made_way(street: Client) -> None:
    first, second = submit(street, window_ms=0), submit(street, earliest_ms=DEPARTURE_MS + 3_337)
    urgent = submit(street, 1, origin=along()["destination"], destination=along()["origin"])
    found = events(street, 2)
    assert [(each["revision"], each["kind"], each["flight_intent_id"]) for each in found] == [
        (3, "accepted", urgent["id"]),
        (3, "displaced", first["id"]),
        (3, "accepted", second["id"]),
    ]
    cause = {"flight_intent_id": urgent["id"]}
    told = {each["flight_intent_id"]: each for each in urgent["displaced"]}
    for each in found[1:]:
        own = told[each["flight_intent_id"]]
        assert each["details"] == {
            "cause": cause,
            "reason": own["reason"],
            "departure_moved_s": own["departure_moved_s"],
            "arrival_moved_s": own["arrival_moved_s"],
        }
    assert told[second["id"]]["departure_moved_s"] > 0


def test_a_page_of_events_does_not_part_a_revision(street: Client) -> None:
    for n in range(2):
        submit(street, earliest_ms=DEPARTURE_MS + n * 3_337)
    submit(street, 1, origin=along()["destination"], destination=along()["origin"])
    submit(street, earliest_ms=DEPARTURE_MS + 600_000)
    sizes, after = [], "0"
    while after is not None:
        page = street.get("/v1/events", params={"after": after, "limit": "1"}).json()
        sizes.append(len(page["items"]))
        after = page["next_cursor"]
    assert sizes == [1, 1, 3, 1]


def test_a_stream_gives_a_revision_its_id_where_all_of_it_was_told(street: Client) -> None:
    for n in range(2):
        submit(street, earliest_ms=DEPARTURE_MS + n * 3_337)
    submit(street, 1, origin=along()["destination"], destination=along()["origin"])
    street.service.monitor.look()
    with streaming(street, {"last-event-id": "1"}) as stream:
        found = [event for event in stream.news() if event.name == "intent"]
    assert [(event.data["revision"], event.id) for event in found] == [(2, 2), (3, None), (3, None), (3, 3)]
    # Who lost the stream within a revision has the whole of it again.
    with streaming(street, {"last-event-id": "2"}) as stream:
        again = [event for event in stream.news() if event.name == "intent"]
    assert [event.data for event in again] == [event.data for event in found[1:]]


def test_a_preview_names_who_would_have_to_make_way_and_moves_nobody(street: Client) -> None:
    first = submit(street)
    before = read(street, first["id"])
    preview = street.post(PREVIEW, json=along(1)).json()
    PreviewAnswer.model_validate(preview)
    assert preview["displaces"] == [first["id"]]
    assert street.post(PREVIEW, json=along(0)).json()["displaces"] == []
    assert read(street, first["id"]) == before
    assert len(events(street, 0)) == 1
    urgent = submit(street, 1)
    assert (urgent["departure"], urgent["arrival"]) == (preview["departure"], preview["arrival"])


def test_a_repetition_tells_again_who_made_way(street: Client) -> None:
    submit(street)
    headers = {"Idempotency-Key": "key"}
    urgent = street.post(SUBMIT, json=along(1), headers=headers)
    # It has moved on by then.
    submit(street, 2)
    again = street.post(SUBMIT, json=along(1), headers=headers)
    assert again.headers["idempotent-replayed"] == "true"
    assert again.json() == urgent.json()
    assert len(urgent.json()["displaced"]) == 1


@on_sqlite
def test_one_of_higher_priority_may_still_find_no_place(street: Client, clock: FakeClock) -> None:
    first = submit(street)
    clock.advance(ms=1)
    answer = problem(street.post(SUBMIT, json=along(9, window_ms=0)), 409, "no-conflict-free-plan")
    assert answer["conflicting_intents"] == [first["id"]]
    assert len(events(street, 0)) == 2


@on_sqlite
@pytest.mark.parametrize(("notice_s", "is_moved"), [(60, True), (60.001, False), (0, True)])
def test_the_notice_is_a_setting(on_street: Settings, clock: FakeClock, notice_s: float, is_moved: bool) -> None:
    with served(create_app(settings_with(on_street, notice_s=notice_s), clock)) as client:
        submit(client)
        assert bool(submit(client, 1)["displaced"]) == is_moved


@on_sqlite
def test_the_first_answer_is_repeated_to_whom_was_displaced_since(street: Client) -> None:
    one, all_ = {"Idempotency-Key": "one"}, {"Idempotency-Key": "all"}
    batch = {"flight_intents": [along(window_ms=0, earliest_ms=DEPARTURE_MS + 600_000)], "improve_for_s": 0}

    def first_or_again() -> list[httpx.Response]:
        alone = street.post(SUBMIT, json=along(window_ms=0), headers=one)
        return [alone, street.post(f"{SUBMIT}/batch", json=batch, headers=all_)]

    first, together = first_or_again()
    submit(street, 1, window_ms=0)
    submit(street, 1, window_ms=0, earliest_ms=DEPARTURE_MS + 600_000)
    again, together_again = first_or_again()
    assert read(street, first.json()["id"])["state"] == "displaced"
    assert (again.status_code, again.content) == (201, first.content)
    assert (again.headers["etag"], again.headers["location"]) == (first.headers["etag"], first.headers["location"])
    (item,), (item_again,) = (answer.json()["items"] for answer in (together, together_again))
    assert (item_again["id"], item_again["state"]) == (item["id"], "displaced")


def test_cancelling_who_was_displaced_ends_it(street: Client) -> None:
    first = submit(street, window_ms=0)
    submit(street, 1)
    response = street.delete(f"{SUBMIT}/{first['id']}")
    assert (response.status_code, response.json()["state"]) == (200, "cancelled")
    assert response.headers["etag"] == '"3"'
    # Why it could not fly is still to be read.
    assert read(street, first["id"])["refusal"]["reason"] == "no_departure_slot"
