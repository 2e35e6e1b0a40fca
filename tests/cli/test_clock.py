"""A service whose clock is set: it says so loudly, and all of its workers show one time."""

import os
import signal
import time
from pathlib import Path

import httpx
import pytest

from app.client import Client, ProblemAnswer
from app.times import now_ms, parse_time
from tests.cli.serving import Server, serving
from tests.cli.town import along_row

pytestmark = pytest.mark.compiled

START = "2026-12-01T08:00:00Z"
START_MS = parse_time(START)
DAY_MS = 86_400_000
PATIENCE_S = 60.0
_WARNING = "SIMULATED CLOCK: no time in answers, ledger or telemetry is real; for demonstrations and tests only"


def clock(server: Server) -> tuple[int, float, bool]:
    """Return what a new connection is told of the clock: the time, the rate, whether it is simulated."""
    answer = httpx.get(f"{server.url}/v1/airspace/alerts", headers={"Connection": "close"}).json()["clock"]
    return parse_time(answer["now"]), answer["rate"], answer["simulated"]


def test_by_default_the_clock_is_the_real_one_and_nobody_is_warned(town: Server) -> None:
    before = now_ms()
    now, rate, simulated = clock(town)
    assert before <= now <= now_ms()
    assert (rate, simulated) == (1.0, False)
    assert town.entries(_WARNING) == []


def test_a_service_starts_at_the_time_it_is_given_and_plans_by_it(tmp_path: Path, town_file: Path) -> None:
    options = ("--airspace", str(town_file), "--clock-start", START, "--clock-rate", "10")
    with serving(tmp_path, *options, AIRMATRIX_LOG_FORMAT="json") as server, Client(server.url) as client:
        now, rate, simulated = clock(server)
        assert START_MS < now < START_MS + DAY_MS
        assert (rate, simulated) == (10.0, True)
        (warning,) = server.entries(_WARNING)
        assert (warning["level"], warning["clock"], warning["rate"]) == ("warning", "2026-12-01T08:00:00.000Z", 10.0)
        assert client.submit(along_row(1, 0, START_MS + DAY_MS)).departure == START_MS + DAY_MS
        with pytest.raises(ProblemAnswer, match="it is 2026-12-01T08:"):
            client.submit(along_row(1, 0, START_MS - DAY_MS))


def test_the_clock_is_a_setting_too(tmp_path: Path, town_file: Path) -> None:
    with serving(tmp_path, "--airspace", str(town_file), AIRMATRIX_CLOCK_START=START) as server:
        now, rate, simulated = clock(server)
    assert START_MS < now < START_MS + DAY_MS
    assert (rate, simulated) == (1.0, True)


def test_all_workers_show_one_time_also_one_that_is_started_later(tmp_path: Path, town_file: Path) -> None:
    # A millisecond is a second: workers with clocks of their own would be hours apart.
    options = ("--airspace", str(town_file), "--clock-start", START, "--clock-rate", "1000", "--workers", "2")
    with serving(tmp_path, *options, AIRMATRIX_LOG_FORMAT="json") as server:
        first = [clock(server)[0] for _ in range(40)]
        killed = min(server.workers())
        os.kill(killed, signal.SIGKILL)
        until = time.monotonic() + PATIENCE_S
        while killed in server.workers() or len(server.workers()) < 2:
            assert time.monotonic() < until
            time.sleep(0.05)
        then = [clock(server)[0] for _ in range(40)]
    assert first + then == sorted(first + then)


def test_a_ledger_is_taken_up_again_by_a_clock_that_starts_anew(tmp_path: Path, town_file: Path) -> None:
    options = ("--airspace", str(town_file), "--clock-start", START, "--clock-rate", "1000")
    with serving(tmp_path, *options) as server, Client(server.url) as client:
        later = client.submit(along_row(1, 0, START_MS + DAY_MS))
    with serving(tmp_path, *options) as server, Client(server.url) as client:
        again = client.submit(along_row(1, 0, START_MS + DAY_MS, START_MS + DAY_MS + 60_000))
        assert [event.sequence for event in client.events().items if event.kind == "accepted"] == [1, 2]
    assert again.departure is not None
    assert again.departure > START_MS + DAY_MS
    assert later.departure == START_MS + DAY_MS


def test_what_is_kept_for_an_hour_goes_after_an_hour_of_that_clock(tmp_path: Path, town_file: Path) -> None:
    options = ("--airspace", str(town_file), "--clock-start", START, "--clock-rate", "1000")
    kept = {"AIRMATRIX_RETENTION_DAYS": "0.042", "AIRMATRIX_IDEMPOTENCY_HOURS": "1"}
    with serving(tmp_path, *options, **kept) as server, Client(server.url) as client:
        first = client.submit(along_row(1, 0, clock(server)[0] + 1_200_000))
        until = time.monotonic() + PATIENCE_S
        while first.sequence in [intent.sequence for intent in client.flight_intents()]:
            assert time.monotonic() < until
            time.sleep(1)
            # Between batches is when things are removed.
            client.submit(along_row(2, 0, clock(server)[0] + DAY_MS))
        removed_before = client.status().removed_before
    assert removed_before is not None
    assert removed_before > START_MS
