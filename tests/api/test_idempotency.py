"""Idempotency-Key: the same request again brings the first answer again, byte for byte."""

import asyncio

import httpx
import pytest

from app.main import create_app
from app.settings import Settings
from tests.api.bodies import SUBMIT, intent, problem
from tests.api.serving import Client, serving
from tests.ledger.district import DEPARTURE_MS, START_MS
from tests.ledger.locations import write_lock
from tests.ledger.process import DAY_MS, FakeClock, until

KEY = {"Idempotency-Key": "7c1b"}


def submit(client: Client, headers: dict[str, str] = KEY, **members: object) -> httpx.Response:
    return client.post(SUBMIT, json=intent(**members), headers=headers)  # type: ignore[arg-type]


def count(client: Client) -> int:
    return len(client.get(SUBMIT, params={"limit": "500"}).json()["items"])


def test_the_first_answer_is_not_marked_as_replayed(client: Client) -> None:
    assert "idempotent-replayed" not in submit(client).headers


def test_an_accepted_intent_is_answered_again_byte_for_byte(client: Client) -> None:
    first, again = submit(client), submit(client)
    assert (first.status_code, again.status_code) == (201, 201)
    assert again.content == first.content
    assert again.headers["idempotent-replayed"] == "true"
    assert {name: again.headers[name] for name in ("location", "etag", "content-type")} == {
        name: first.headers[name] for name in ("location", "etag", "content-type")
    }
    assert count(client) == 1


def test_a_refusal_is_answered_again_byte_for_byte(client: Client) -> None:
    submit(client, headers={})
    first, again = submit(client, window_ms=0), submit(client, window_ms=0)
    problem(again, 409, "no-conflict-free-plan")
    assert again.content == first.content
    assert again.headers["idempotent-replayed"] == "true"
    assert count(client) == 2


def test_a_refusal_is_answered_again_even_when_there_would_be_a_plan_by_now(client: Client) -> None:
    blocking = submit(client, headers={}).headers["location"]
    first = submit(client, window_ms=0)
    client.delete(blocking)
    assert submit(client, window_ms=0).content == first.content


def test_the_first_answer_comes_again_after_the_intent_was_cancelled(client: Client) -> None:
    first = submit(client)
    client.delete(first.headers["location"])
    again = submit(client)
    assert (again.status_code, again.content, again.headers["etag"]) == (201, first.content, '"1"')


def test_another_body_under_the_same_key_is_refused(client: Client) -> None:
    submit(client)
    answer = problem(submit(client, reference="another"), 422, "idempotency-key-reused")
    assert "'7c1b'" in answer["detail"]
    assert count(client) == 1


def test_bodies_are_compared_as_parsed_not_as_written(client: Client) -> None:
    first = submit(client, earliest_departure="2026-11-22T08:01:00Z", priority=0)
    again = submit(client, earliest_departure="2026-11-22T13:01:00.0000+05:00", reference=None)
    assert again.content == first.content


def test_another_key_is_another_request(client: Client) -> None:
    submit(client)
    assert submit(client, headers={"Idempotency-Key": "7c1c"}).json()["sequence"] == 2


def test_each_operator_has_keys_of_its_own(client: Client) -> None:
    submit(client)
    other = submit(client, operator="other-air")
    assert (other.json()["sequence"], other.headers.get("idempotent-replayed")) == (2, None)


def test_a_key_is_forgotten_after_a_day(client: Client, clock: FakeClock) -> None:
    submit(client, window_ms=2 * DAY_MS)
    clock.now_ms = START_MS + DAY_MS
    assert submit(client, window_ms=2 * DAY_MS).headers["idempotent-replayed"] == "true"
    clock.advance(ms=1)
    # A day has passed when something was recorded a day later, not when a clock says so.
    assert submit(client, operator="other-air", window_ms=2 * DAY_MS).status_code == 201
    fresh = submit(client, window_ms=2 * DAY_MS)
    assert (fresh.json()["sequence"], fresh.headers.get("idempotent-replayed")) == (3, None)


def test_a_request_that_recorded_nothing_leaves_its_key_unused(client: Client) -> None:
    problem(submit(client, earliest_ms=START_MS - 2, window_ms=1), 422, "departure-in-the-past")
    assert submit(client).status_code == 201


def test_a_preview_takes_no_notice_of_keys(client: Client) -> None:
    client.post(f"{SUBMIT}/preview", json=intent(), headers=KEY)
    assert "idempotent-replayed" not in submit(client).headers


@pytest.mark.parametrize("key", ["", "x" * 256])
def test_a_key_without_or_with_too_many_signs_is_refused(client: Client, key: str) -> None:
    answer = problem(submit(client, headers={"Idempotency-Key": key}), 422, "validation-error")
    assert [error["loc"] for error in answer["errors"]] == [["header", "idempotency-key"]]


def test_duplicates_in_flight_make_one_intent(settings: Settings, clock: FakeClock) -> None:
    async def race() -> list[httpx.Response]:
        async with serving(create_app(settings, clock)) as (http, service):
            with write_lock(settings.ledger):
                tasks = [asyncio.create_task(http.post(SUBMIT, json=intent(), headers=KEY)) for _ in range(6)]
                await until(lambda: service.writer.waiting == 5)
            answers = await asyncio.gather(*tasks)
            listed = await http.get(SUBMIT)
            assert len(listed.json()["items"]) == 1
        return answers

    answers = asyncio.run(race())
    assert {answer.status_code for answer in answers} == {201}
    assert len({answer.content for answer in answers}) == 1
    assert sorted(answer.headers.get("idempotent-replayed", "first") for answer in answers) == ["first"] + ["true"] * 5


def test_a_key_survives_a_restart(settings: Settings, clock: FakeClock) -> None:
    async def once() -> httpx.Response:
        async with serving(create_app(settings, clock)) as (http, _):
            return await http.post(SUBMIT, json=intent(earliest_ms=DEPARTURE_MS), headers=KEY)

    first, again = asyncio.run(once()), asyncio.run(once())
    assert again.content == first.content
    assert again.headers["idempotent-replayed"] == "true"
