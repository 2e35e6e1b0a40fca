"""The service's clock: the system's, or one that is set and runs from there."""

import pickle
import time

import pytest
from pydantic import ValidationError

from app.settings import Settings
from app.times import ServerClock, now_ms, parse_time

START_MS = parse_time("2026-11-22T08:00:00Z")


@pytest.fixture
def monotonic(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The machine's monotonic clock, in ns: one element, to be set."""
    reading = [5_000_000_000]
    monkeypatch.setattr(time, "monotonic_ns", lambda: reading[0])
    return reading


def test_a_clock_that_is_not_set_is_the_systems() -> None:
    clock = ServerClock()
    before = now_ms()
    assert before <= clock() <= now_ms()
    assert (clock.rate, clock.simulated) == (1.0, False)


def test_a_clock_runs_at_its_rate_from_its_start(monotonic: list[int]) -> None:
    clock = ServerClock(START_MS, 10)
    assert clock() == START_MS
    monotonic[0] += 1_500_000_000
    assert clock() == clock.now() == START_MS + 15_000
    assert clock.elapsed_ms() == 15_000
    assert (clock.rate, clock.simulated) == (10, True)


@pytest.mark.parametrize("rate", [0.001, 0.3, 1, 7, 1000])
def test_a_clock_never_goes_back_and_loses_nothing(monotonic: list[int], rate: float) -> None:
    clock, zero = ServerClock(START_MS, rate), monotonic[0]
    readings = []
    for elapsed in range(0, 30_000_000, 333_333):
        monotonic[0] = zero + elapsed
        readings.append(clock())
    assert readings == sorted(readings)
    assert readings[-1] - START_MS == pytest.approx(29.999_97 * rate, abs=1)


def test_a_clock_with_a_rate_alone_starts_now(monotonic: list[int]) -> None:
    before = now_ms()
    clock = ServerClock(rate=60)
    assert before <= clock() <= now_ms()
    assert clock.simulated
    monotonic[0] += 1_000_000_000
    assert clock() >= before + 60_000


def test_a_clock_that_only_starts_elsewhere_is_simulated_too(monotonic: list[int]) -> None:
    clock = ServerClock(START_MS)
    monotonic[0] += 1_000_000_000
    assert clock.simulated
    assert clock() == START_MS + 1000


def test_the_time_that_passes_does_not_depend_on_the_systems_clock(
    monotonic: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = ServerClock()
    monotonic[0] += 2_000_000_000
    monkeypatch.setattr(time, "time_ns", lambda: 0)
    assert clock() == 0
    assert clock.elapsed_ms() == 2000


def test_another_process_that_is_handed_the_clock_shows_the_same_time_however_late(monotonic: list[int]) -> None:
    clock = ServerClock(START_MS, 10)
    monotonic[0] += 1_000_000_000
    handed = pickle.loads(pickle.dumps(clock))  # noqa: S301 -- as spawning a worker does
    monotonic[0] += 1_000_000_000
    assert handed() == clock() == START_MS + 20_000


def test_by_default_no_clock_is_set() -> None:
    settings = Settings()
    assert (settings.clock_start, settings.clock_rate) == (None, 1.0)


def test_the_clock_is_a_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AIRMATRIX_CLOCK_START", "2026-11-22T13:00:00+05:00")
    monkeypatch.setenv("AIRMATRIX_CLOCK_RATE", "5")
    settings = Settings()
    assert (settings.clock_start, settings.clock_rate) == (START_MS, 5.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [("clock_start", "yesterday"), ("clock_start", "2026-11-22T08:00:00"), ("clock_start", "3000-01-01T00:00:00Z"),
     ("clock_rate", "0"), ("clock_rate", "-1"), ("clock_rate", "1001"), ("clock_rate", "nan"),
     ("freshness_s", "0"), ("freshness_s", "nan"), ("tolerance_s", "-1"), ("contingent_after_s", "0"),
     ("projection_s", "inf"), ("telemetry_hours", "0")],
)  # fmt: skip
def test_a_setting_of_the_clock_or_of_monitoring_outside_its_bounds_is_refused(name: str, value: str) -> None:
    with pytest.raises(ValidationError) as refusal:
        Settings.given(**{name: value})
    assert [error["loc"] for error in refusal.value.errors()] == [(name,)]
