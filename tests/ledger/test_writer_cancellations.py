"""Cancellation through the one writer (domain 4)."""

import asyncio

import pytest

from app.errors import IllegalTransition, UnknownFlightIntent
from app.flight_intents import State
from tests.ledger.district import DEPARTURE_MS, SQUARE, START_MS, STREET
from tests.ledger.process import FakeClock, Process, arrival, assert_gapless, assert_sound, departure, held


def test_cancelling_before_departure_frees_the_space_at_once(street: Process) -> None:
    first = street.submit(STREET.submission("W", "E"))
    assert street.submit(STREET.submission("W", "E", window_ms=0)).state is State.REJECTED
    cancelled = street.cancel(first)
    again = street.submit(STREET.submission("W", "E", window_ms=0))
    assert (cancelled.state, held(cancelled)) == (State.CANCELLED, set())
    assert held(again) == held(first)
    assert_sound(street)


def test_cancelling_at_the_moment_of_departure_keeps_the_reservations_until_arrival(
    street: Process, clock: FakeClock
) -> None:
    first = street.submit(STREET.submission("W", "E"))
    clock.now_ms = departure(first)
    cancelled = street.cancel(first)
    assert (cancelled.state, held(cancelled)) == (State.CANCELLED, held(first))
    behind = street.submit(STREET.submission("W", "E", earliest_ms=clock.now_ms))
    assert departure(behind) > departure(first)
    assert_sound(street, clock.now_ms)


def test_a_millisecond_before_departure_the_reservations_still_go(street: Process, clock: FakeClock) -> None:
    first = street.submit(STREET.submission("W", "E"))
    clock.now_ms = DEPARTURE_MS - 1
    assert held(street.cancel(first)) == set()


def test_cancelling_at_the_moment_of_arrival_is_allowed(street: Process, clock: FakeClock) -> None:
    first = street.submit(STREET.submission("W", "E"))
    clock.now_ms = arrival(first)
    assert street.cancel(first).state is State.CANCELLED


def test_cancelling_after_arrival_is_an_illegal_transition(street: Process, clock: FakeClock) -> None:
    first = street.submit(STREET.submission("W", "E"))
    clock.now_ms = arrival(first) + 1
    with pytest.raises(IllegalTransition, match=r"arrived at 2026-11-22T08:01:11\.676Z"):
        street.cancel(first)
    found = street.ledger.find(first.id)
    assert found is not None
    assert (found.state, found.version) == (State.ACCEPTED, 1)


def test_cancelling_twice_changes_nothing_the_second_time(square: Process) -> None:
    intent = square.submit(SQUARE.submission("N", "S"))
    first = square.cancel(intent)
    second = square.cancel(intent)
    assert (second.state, second.version) == (State.CANCELLED, first.version)
    assert_gapless(square.location)


def test_a_refused_intent_cannot_be_cancelled(street: Process) -> None:
    street.submit(STREET.submission("W", "E"))
    refused = street.submit(STREET.submission("W", "E", window_ms=0))
    with pytest.raises(IllegalTransition, match="is rejected and cannot be cancelled"):
        street.cancel(refused)


def test_an_intent_that_does_not_exist_cannot_be_cancelled(square: Process) -> None:
    with pytest.raises(UnknownFlightIntent):
        asyncio.run(square.deconfliction.cancel("no such id"))


def test_what_a_flight_in_the_air_held_before_its_cancellation_is_in_the_journal_as_kept(
    street: Process, clock: FakeClock
) -> None:
    first = street.submit(STREET.submission("W", "E"))
    second = street.submit(STREET.submission("W", "E", earliest_ms=START_MS + 600_000))
    clock.now_ms = departure(first)
    street.cancel(first)
    street.cancel(second)
    entries = street.ledger.journal_after(2, 10)
    assert [entry.kind for entry in entries] == ["cancelled", "cancelled"]
    assert entries[0].released.tolist() == []
    assert {tuple(hold) for hold in entries[1].released.tolist()} == held(second)
