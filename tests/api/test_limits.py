"""Limits of what one operator may ask for: requests a second, and flight intents that are not over."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from app.errors import TooManyRequests
from app.limits import RateLimit
from app.main import create_app
from app.times import parse_time
from tests.api.bodies import PREVIEW, SUBMIT, intent, problem
from tests.api.serving import Client, served, serving, settings_for
from tests.api.tokens import as_, issuer, write_keys
from tests.ledger.district import DEPARTURE_MS, OLD_TOWN
from tests.ledger.locations import write_lock
from tests.ledger.process import FakeClock, until

TEN_MINUTES_MS = 600_000


@contextmanager
def limited(ledger: str, folder: Path, clock: FakeClock, **options: object) -> Iterator[Client]:
    """Run a service with authentication and some limits."""
    keys = str(write_keys(folder, issuer()))
    with served(
        create_app(settings_for(OLD_TOWN, ledger, folder, jwks=keys, **options), clock, elapsed_ms=clock)
    ) as api:
        yield api


# Requests a second


def spends(rate: RateLimit, operator: str | None, times: int) -> int:
    """Return how many of some requests pass."""
    passed = 0
    for _ in range(times):
        try:
            rate.spend(operator)
        except TooManyRequests:
            continue
        passed += 1
    return passed


def test_so_many_pass_at_once_as_the_burst_says_and_the_rate_in_the_long_run() -> None:
    clock = FakeClock()
    rate = RateLimit(2.0, 5, clock)
    assert spends(rate, "acme-air", 9) == 5
    clock.advance(seconds=1)
    assert spends(rate, "acme-air", 9) == 2
    clock.advance(seconds=0.4)
    assert spends(rate, "acme-air", 9) == 0
    clock.advance(seconds=0.1)
    assert spends(rate, "acme-air", 9) == 1
    clock.advance(seconds=3600)
    assert spends(rate, "acme-air", 9) == 5


def test_each_operator_has_a_bucket_of_its_own() -> None:
    rate = RateLimit(1.0, 1, FakeClock())
    assert [spends(rate, operator, 2) for operator in ("acme-air", "blue-kite", None)] == [1, 1, 1]


def test_operators_are_not_remembered_for_ever_nor_forgotten_while_they_must_wait() -> None:
    clock = FakeClock()
    rate = RateLimit(1.0, 1, clock)
    for number in range(1_000):
        rate.spend(f"operator {number}")
        clock.advance(ms=10)
    rate.spend("one more")
    # Who asked more than a second ago may ask again, and is forgotten.
    assert len(rate._buckets) == 100
    assert spends(rate, "operator 999", 1) == 0


def test_what_a_request_is_worth_beyond_itself_is_waited_for_afterwards() -> None:
    clock = FakeClock()
    rate = RateLimit(1.0, 3, clock)
    rate.spend("acme-air")
    rate.overdraw("acme-air", 4)
    with pytest.raises(TooManyRequests):
        rate.overdraw("acme-air", 1)
    clock.advance(seconds=2)
    assert spends(rate, "acme-air", 1) == 0
    clock.advance(seconds=1)
    assert spends(rate, "acme-air", 9) == 1


def test_a_batch_counts_as_its_flight_intents(ledger: str, tmp_path: Path, clock: FakeClock) -> None:
    with limited(ledger, tmp_path, clock, rate_per_s=0.1, rate_burst=2) as api:
        batch = {"flight_intents": [intent()] * 5, "improve_for_s": 0}
        assert api.post(f"{SUBMIT}/batch", json=batch, **as_()).status_code == 201
        response = api.post(SUBMIT, json=intent(), **as_())
        problem(response, 429, "too-many-requests")
        assert response.headers["retry-after"] == "40"


@pytest.mark.parametrize(("positions", "requests"), [(0, 1), (1, 1), (500, 1), (501, 2), (1_001, 3)])
def test_a_report_counts_once_for_every_500_positions(
    ledger: str, tmp_path: Path, clock: FakeClock, positions: int, requests: int
) -> None:
    with limited(ledger, tmp_path, clock, rate_per_s=1, rate_burst=4) as api:
        # What cannot be read counts too.
        reports = [{"positions": [None] * positions}, *[{"positions": []}] * (4 - requests)]
        answers = [api.post("/v1/telemetry", json=report, **as_()) for report in (*reports, {"positions": []})]
        assert [answer.status_code for answer in answers] == [202] * (5 - requests) + [429]
        problem(api.post(SUBMIT, json=intent(), **as_()), 429, "too-many-requests")


def test_who_asks_too_often_is_told_when_to_come_back(ledger: str, tmp_path: Path, clock: FakeClock) -> None:
    with limited(ledger, tmp_path, clock, rate_per_s=0.1, rate_burst=2) as api:
        first = api.post(SUBMIT, json=intent(), **as_())
        assert api.post(PREVIEW, json=intent(earliest_ms=DEPARTURE_MS + TEN_MINUTES_MS), **as_()).status_code == 200
        for method, path in (("POST", SUBMIT), ("DELETE", first.headers["location"])):
            response = api.request(method, path, **as_())
            problem(response, 429, "too-many-requests")
            assert response.headers["retry-after"] == "10"
        # Who only reads, and who is somebody else, need not wait.
        assert api.get(SUBMIT, **as_()).status_code == 200
        other = intent(operator="blue-kite", earliest_ms=DEPARTURE_MS + TEN_MINUTES_MS)
        assert api.post(SUBMIT, json=other, **as_("blue-kite")).status_code == 201
        clock.advance(seconds=10)
        assert api.delete(first.headers["location"], **as_()).status_code == 200


def test_who_subscribes_over_and_over_must_wait_too(ledger: str, tmp_path: Path, clock: FakeClock) -> None:
    body = {"url": "https://receiver.example/", "kinds": ["intent"]}
    with limited(ledger, tmp_path, clock, rate_per_s=0.1, rate_burst=1) as api:
        webhook = api.post("/v1/webhooks", json=body, **as_()).headers["location"]
        problem(api.post("/v1/webhooks", json=body, **as_()), 429, "too-many-requests")
        problem(api.delete(webhook, **as_()), 429, "too-many-requests")
        assert len(api.get("/v1/webhooks", **as_()).json()["items"]) == 1


def test_strangers_do_not_use_up_an_operator_s_rate(ledger: str, tmp_path: Path, clock: FakeClock) -> None:
    with limited(ledger, tmp_path, clock, rate_per_s=1, rate_burst=1) as api:
        assert [api.post(SUBMIT, json=intent()).status_code for _ in range(5)] == [401] * 5
        assert api.post(SUBMIT, json=intent(), **as_()).status_code == 201


# Flight intents that are not over


def later(number: int, operator: str = "acme-air") -> dict[str, object]:
    """Return the body of a flight that is in no other's way."""
    return intent(operator=operator, earliest_ms=DEPARTURE_MS + number * TEN_MINUTES_MS)


def test_an_operator_has_so_many_open_flight_intents_at_most(ledger: str, tmp_path: Path, clock: FakeClock) -> None:
    with limited(ledger, tmp_path, clock, open_intents_limit=2) as api:
        first = api.post(SUBMIT, json=later(0), **as_())
        # A refused one is not open.
        assert api.post(SUBMIT, json=intent(window_ms=0), **as_()).status_code == 409
        assert api.post(SUBMIT, json=later(1), **as_()).status_code == 201
        before = len(api.get(SUBMIT, **as_()).json()["items"])
        detail = problem(api.post(SUBMIT, json=later(2), **as_()), 429, "too-many-open-intents")["detail"]
        assert "may have 2" in detail
        assert len(api.get(SUBMIT, **as_()).json()["items"]) == before
        assert api.post(SUBMIT, json=later(3, "blue-kite"), **as_("blue-kite")).status_code == 201
        assert api.delete(first.headers["location"], **as_()).status_code == 200
        assert api.post(SUBMIT, json=later(2), **as_()).status_code == 201


@pytest.mark.parametrize("way", ["cancelled", "ended"])
def test_a_flight_that_is_over_counts_while_it_holds_something(
    ledger: str, tmp_path: Path, clock: FakeClock, way: str
) -> None:
    with limited(ledger, tmp_path, clock, open_intents_limit=2) as api:
        # One that was cancelled before its departure holds nothing then.
        assert api.delete(api.post(SUBMIT, json=later(0), **as_()).headers["location"], **as_()).status_code == 200
        flights = [api.post(SUBMIT, json=later(number), **as_()) for number in (0, 1)]
        place = flights[0].headers["location"]
        clock.now_ms = DEPARTURE_MS + 1
        over = api.delete(place, **as_()) if way == "cancelled" else api.post(f"{place}/end", **as_())
        assert (over.json()["state"], bool(over.json()["reservations"])) == (way, True)
        problem(api.post(SUBMIT, json=later(2), **as_()), 429, "too-many-open-intents")
        clock.now_ms = parse_time(over.json()["trajectory"][-1]["depart"])
        assert api.post(SUBMIT, json=later(2), **as_()).status_code == 201
        problem(api.post(SUBMIT, json=later(3), **as_()), 429, "too-many-open-intents")


def test_an_answer_is_repeated_at_the_limit_too(ledger: str, tmp_path: Path, clock: FakeClock) -> None:
    with limited(ledger, tmp_path, clock, open_intents_limit=1) as api:
        headers = {**as_()["headers"], "Idempotency-Key": "once"}
        first, again = (api.post(SUBMIT, json=later(0), headers=headers) for _ in range(2))
        assert (again.status_code, again.json()) == (201, first.json())


def test_flight_intents_that_are_written_together_count_too(ledger: str, tmp_path: Path, clock: FakeClock) -> None:
    settings = settings_for(OLD_TOWN, ledger, tmp_path, open_intents_limit=3)

    async def race() -> list[int]:
        async with serving(create_app(settings, clock)) as (http, service):
            with write_lock(ledger):
                tasks = [asyncio.create_task(http.post(SUBMIT, json=later(number))) for number in range(8)]
                await until(lambda: service.writer.waiting == 7)
            return [answer.status_code for answer in await asyncio.gather(*tasks)]

    assert sorted(asyncio.run(race())) == [201] * 3 + [429] * 5
