"""The campaign's own eyes: each kind of damage to a ledger is seen, and called by its name."""

import random
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.faults.audit import Book, audit, book_of
from tests.faults.inside import AIRSPACE, Desk
from tests.faults.operators import Told
from tests.ledger.locations import SqliteLedgers
from tests.ledger.process import FakeClock, Process


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> tuple[Book, Told]:
    """Return a ledger with accepted, rejected and cancelled flights, and what their operators were told."""
    location = SqliteLedgers(tmp_path_factory.mktemp("audited")).migrated()
    desk, clock = Desk("audited", random.Random(3)), FakeClock()
    with Process(location, AIRSPACE, clock) as process:
        for _ in range(12):
            desk.submit(process, desk.flight(clock.now_ms))
        desk.cancel_one(process)
    return book_of(location), desk.told


@pytest.fixture
def book(sound: tuple[Book, Told]) -> Book:
    return sound[0]


@pytest.fixture
def told(sound: tuple[Book, Told]) -> Told:
    return deepcopy(sound[1])


@pytest.fixture
def kept(told: Told) -> str:
    """Return the reference of a flight that was accepted and not cancelled."""
    return min(told.accepted.keys() - told.cancelled)


def kinds(book: Book, told: Told) -> set[str]:
    """Return the kinds of damage that are found."""
    return {kind for kind, sentences in vars(audit(book, told)).items() if sentences}


def changed(book: Book, reference: str, /, **changes: Any) -> Book:
    """Return a ledger in which one intent is another."""
    intents = [intent._replace(**changes) if intent.reference == reference else intent for intent in book.intents]
    return replace(book, intents=intents)


def without(book: Book, reference: str) -> Book:
    """Return a ledger that lacks an intent and all that belongs to it."""
    (gone,) = (intent for intent in book.intents if intent.reference == reference)
    return Book(
        [intent for intent in book.intents if intent != gone],
        book.holds[book.holds[:, 0] != gone.sequence],
        [entry for entry in book.journal if entry[2] != gone.sequence],
        book.counters,
    )


def test_a_sound_ledger_shows_no_damage(book: Book, told: Told) -> None:
    assert all((told.accepted, told.rejected, told.cancelled))
    assert audit(book, told).sentences == []


def test_an_accepted_flight_that_is_not_there_is_lost(book: Book, told: Told, kept: str) -> None:
    assert "lost" in kinds(without(book, kept), told)


def test_a_recorded_refusal_that_is_not_there_is_lost(book: Book, told: Told) -> None:
    assert "lost" in kinds(without(book, min(told.rejected)), told)


def test_an_accepted_flight_under_another_number_is_lost(book: Book, told: Told, kept: str) -> None:
    told.accepted[kept] = replace(told.accepted[kept], sequence=99)
    assert kinds(book, told) == {"lost"}


def test_an_accepted_flight_that_nobody_cancelled_and_is_cancelled_is_lost(book: Book, told: Told) -> None:
    told.cancelled.clear()
    assert kinds(book, told) == {"lost"}


def test_a_cancellation_that_is_not_there_is_lost(book: Book, told: Told, kept: str) -> None:
    told.cancelled.add(kept)
    assert kinds(book, told) == {"lost"}


def test_a_cancellation_that_nobody_answered_may_have_happened_or_not(book: Book, told: Told, kept: str) -> None:
    told.perhaps_cancelled |= {kept, *told.cancelled}
    told.cancelled.clear()
    assert kinds(book, told) == set()


def test_a_flight_that_is_recorded_twice_is_doubled(book: Book, told: Told, kept: str) -> None:
    assert "doubled" in kinds(changed(book, min(told.rejected), reference=kept), told)


def test_a_block_that_is_reserved_twice_is_doubled(book: Book, told: Told) -> None:
    owner, block, enter, leave = book.holds[0].tolist()
    overlapping = np.array([[owner, block, enter + 1, leave + 1]])
    assert "doubled" in kinds(replace(book, holds=np.concatenate([book.holds, overlapping])), told)


def test_a_flight_without_one_of_its_reservations_is_half_written(book: Book, told: Told) -> None:
    assert kinds(replace(book, holds=book.holds[1:]), told) == {"half_written"}


def test_an_accepted_flight_without_reservations_is_half_written(book: Book, kept: str) -> None:
    (bare,) = (intent.sequence for intent in book.intents if intent.reference == kept)
    assert kinds(replace(book, holds=book.holds[book.holds[:, 0] != bare]), Told()) == {"half_written"}


def test_reservations_of_nobody_are_half_written(book: Book, told: Told) -> None:
    stray = np.array([[99, 0, 0, 1]])
    assert kinds(replace(book, holds=np.concatenate([book.holds, stray])), told) == {"half_written"}


def test_a_missing_revision_is_half_written(book: Book, told: Told) -> None:
    assert kinds(replace(book, journal=book.journal[1:]), told) == {"half_written"}


def test_counters_that_lag_behind_are_half_written(book: Book, told: Told) -> None:
    sequence, revision = book.counters
    assert kinds(replace(book, counters=(sequence, revision - 1)), told) == {"half_written"}


def test_a_state_that_the_journal_does_not_know_is_half_written(book: Book, told: Told) -> None:
    assert "half_written" in kinds(changed(book, min(told.rejected), state="ended"), Told())


def test_what_was_not_to_be_recorded_and_is_there_is_wrongly_answered(book: Book, told: Told, kept: str) -> None:
    told.unrecorded[kept] = "ledger-unavailable"
    assert kinds(book, told) == {"wrongly_answered"}


def test_what_was_not_recorded_is_answered_rightly(book: Book, told: Told) -> None:
    told.unrecorded["never seen"] = "queue-full"
    assert kinds(book, told) == set()


def test_an_answer_that_should_not_exist_is_wrong(book: Book, told: Told) -> None:
    told.unexpected.append("flight 1: 500 Internal error")
    assert kinds(book, told) == {"wrongly_answered"}
