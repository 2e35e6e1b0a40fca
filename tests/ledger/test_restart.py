"""Restarting changes nothing: a new process on the same ledger plans exactly what the old one would have planned."""

import random

import pytest

from app.flight_intents import FlightIntent, State, Submission
from planner.cfa_star import Search
from planner.errors import Block
from tests.ledger.district import OLD_TOWN, SQUARE, START_MS, District
from tests.ledger.locations import Ledgers
from tests.ledger.process import FakeClock, Process, assert_gapless, assert_no_overlaps, reserved


def free_blocks(district: District) -> list[Block]:
    """Return the free blocks that flights can reach."""
    airspace = district.airspace
    blocks = [airspace.grid.block(index) for index in range(airspace.grid.block_count) if not airspace.occupied[index]]
    return [block for block in blocks if block != (7, 0, 0)]


def random_submission(district: District, chance: random.Random, now_ms: int) -> Submission:
    """Return a request between two blocks near each other in time, often with too small a window."""
    origin, destination = chance.sample(free_blocks(district), 2)
    return district.submission(
        origin,
        destination,
        earliest_ms=now_ms + chance.randrange(0, 40_000),
        window_ms=chance.choice([0, 10_000, 300_000]),
    )


def busy(process: Process, district: District, clock: FakeClock, chance: random.Random, steps: int) -> None:
    """Submit, cancel and let time pass, long enough that the index forgets."""
    accepted: list[FlightIntent] = []
    for _ in range(steps):
        intent = process.submit(random_submission(district, chance, clock.now_ms))
        accepted += [intent] if intent.state is State.ACCEPTED else []
        if accepted and chance.random() < 0.2:
            candidate = accepted.pop(chance.randrange(len(accepted)))
            assert candidate.trajectory is not None
            if candidate.trajectory.arrival_ms >= clock.now_ms:
                process.cancel(candidate)
        clock.advance(ms=chance.choice([0, 0, 1, 500, 15_000]))


def described(intent: FlightIntent) -> object:
    """Return all of an intent but its random id."""
    trajectory, refusal, held = intent.trajectory, intent.refusal, intent.reservations
    return (
        intent.sequence,
        intent.state,
        None if trajectory is None else (trajectory.block.tolist(), trajectory.arrive_ms.tolist()),
        None if trajectory is None else (trajectory.depart_ms.tolist(), trajectory.unconstrained_ms),
        (held.block.tolist(), held.enter_ms.tolist(), held.exit_ms.tolist()),
        None if refusal is None else (refusal.reason, refusal.detail, refusal.earliest_feasible_departure_ms),
        None if refusal is None else len(refusal.conflicting_intents),
    )


@pytest.mark.compiled
@pytest.mark.parametrize("search", Search)
@pytest.mark.parametrize(
    ("ledgers", "seed"),
    [*(("sqlite", seed) for seed in range(6)), pytest.param("postgresql", 0, marks=pytest.mark.postgres)],
    indirect=["ledgers"],
)
def test_a_restarted_process_plans_what_one_that_kept_running_plans(
    seed: int, search: Search, ledgers: Ledgers, clock: FakeClock
) -> None:
    chance = random.Random(seed)
    district = chance.choice([OLD_TOWN, SQUARE])
    with Process(ledgers.migrated(), district.airspace, clock, search=search) as old:
        busy(old, district, clock, chance, steps=60)
        # PostgreSQL copies only what nobody is connected to; the old process connects again by itself.
        old.ledger.close()
        copy = ledgers.copy(old.location)
        with Process(copy, district.airspace, clock, search=search) as new:
            assert new.indexed(clock.now_ms) == old.indexed(clock.now_ms) == reserved(old.location, clock.now_ms)
            for _ in range(30):
                request = random_submission(district, chance, clock.now_ms)
                assert described(new.submit(request)) == described(old.submit(request))
                clock.advance(ms=chance.choice([0, 1, 15_000]))
        assert_no_overlaps(old.location)
        assert_gapless(old.location)


def test_a_restarted_process_keeps_to_what_was_reserved_before(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock) as process:
        first = process.submit(SQUARE.submission("N", "S"))
    with Process(ledger, SQUARE.airspace, clock) as process:
        assert process.indexed(0) == dict.fromkeys(reserved(ledger), first.sequence)
        second = process.submit(SQUARE.submission("N", "S"))
    assert (first.sequence, second.sequence) == (1, 2)
    assert_no_overlaps(ledger)


def test_a_restarted_process_loads_nothing_that_has_passed(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock) as process:
        process.submit(SQUARE.submission("N", "S"))
    clock.advance(seconds=3600)
    with Process(ledger, SQUARE.airspace, clock) as process:
        assert process.indexed(0) == {}


def test_a_process_that_keeps_running_forgets_what_has_passed(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock) as process:
        process.submit(SQUARE.submission("N", "S"))
        clock.advance(seconds=3600)
        later = process.submit(SQUARE.submission("N", "S", earliest_ms=START_MS + 7_200_000))
        assert set(process.indexed(0).values()) == {later.sequence}


def test_the_ledger_keeps_what_the_index_forgets(ledger: str, clock: FakeClock) -> None:
    with Process(ledger, SQUARE.airspace, clock) as process:
        first = process.submit(SQUARE.submission("N", "S"))
        clock.advance(seconds=3600)
        process.submit(SQUARE.submission("N", "S", earliest_ms=START_MS + 7_200_000))
        found = process.ledger.find(first.id)
    assert found is not None
    assert described(found) == described(first)
