"""Any sequence of submissions, cancellations, restarts and passing time keeps ledger, index and journal in step."""

from contextlib import ExitStack
from typing import ClassVar

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    MultipleResults,
    RuleBasedStateMachine,
    initialize,
    invariant,
    multiple,
    rule,
    run_state_machine_as_test,
)

from app.errors import DepartureInThePast, IllegalTransition
from app.flight_intents import FlightIntent, State
from planner.errors import Block
from tests.ledger.district import district
from tests.ledger.locations import Ledgers, database
from tests.ledger.process import (
    FakeClock,
    Process,
    assert_gapless,
    assert_journal_tells_states,
    assert_no_overlaps,
    reserved,
)

YARD = district("....\n.#..\n....", "....\n....\n....")
BLOCKS: list[Block] = [YARD.airspace.grid.block(block) for block in range(24) if not YARD.airspace.occupied[block]]


class LedgerMachine(RuleBasedStateMachine):
    """The model is small: what each intent held when it was accepted, and when it was cancelled."""

    ledgers: ClassVar[Ledgers]
    intents: Bundle[FlightIntent] = Bundle("intents")

    def __init__(self) -> None:
        super().__init__()
        self.open_until_the_end = ExitStack()

    @initialize()
    def start(self) -> None:
        self.location = self.ledgers.migrated()
        self.stranger = self.open_until_the_end.enter_context(database(self.location))
        self.clock = FakeClock()
        self.states: dict[int, State] = {}
        self.kept: set[tuple[int, int, int, int]] = set()
        self.open()

    def open(self) -> None:
        self.process = Process(self.location, YARD.airspace, self.clock)

    def teardown(self) -> None:
        if hasattr(self, "process"):
            self.process.__exit__(None, None, None)
        self.open_until_the_end.close()

    @rule(
        target=intents,
        ends=st.lists(st.sampled_from(BLOCKS), min_size=2, max_size=2, unique=True),
        after_ms=st.sampled_from([-20_000, 0, 1, 5_000, 20_000]),
        window_ms=st.sampled_from([0, 20_000, 300_000]),
    )
    def submit(self, ends: list[Block], after_ms: int, window_ms: int) -> FlightIntent | MultipleResults[FlightIntent]:
        request = YARD.submission(*ends, earliest_ms=self.clock.now_ms + after_ms, window_ms=window_ms)
        if after_ms + window_ms < 0:
            with pytest.raises(DepartureInThePast):
                self.process.submit(request)
            return multiple()
        intent = self.process.submit(request)
        assert intent.sequence == len(self.states) + 1
        self.states[intent.sequence] = intent.state
        self.kept |= holds(intent)
        return intent

    @rule(intent=intents)
    def cancel(self, intent: FlightIntent) -> None:
        now_ms = self.clock.now_ms
        state = self.states[intent.sequence]
        arrived = intent.trajectory is not None and intent.trajectory.arrival_ms < now_ms
        if state is State.REJECTED or (state is State.ACCEPTED and arrived):
            with pytest.raises(IllegalTransition):
                self.process.cancel(intent)
            return
        assert intent.trajectory is not None
        assert self.process.cancel(intent).state is State.CANCELLED
        if state is State.ACCEPTED and now_ms < intent.trajectory.departure_ms:
            self.kept -= holds(intent)
        self.states[intent.sequence] = State.CANCELLED

    @rule(ms=st.sampled_from([1, 1_000, 9_999, 10_000, 60_000]))
    def let_time_pass(self, ms: int) -> None:
        self.clock.advance(ms=ms)

    @rule()
    def restart(self) -> None:
        self.process.__exit__(None, None, None)
        self.open()

    @invariant()
    def the_ledger_holds_what_was_answered(self) -> None:
        table = reserved(self.stranger)
        assert {(*hold, intent) for hold, intent in table.items()} == self.kept
        assert {intent.sequence: intent.state for intent in self.process.ledger.everything()[0]} == self.states

    @invariant()
    def nothing_overlaps_and_nothing_is_missing(self) -> None:
        assert_no_overlaps(self.stranger)
        assert_gapless(self.stranger)
        assert_journal_tells_states(self.stranger)

    @invariant()
    def the_index_is_the_table_but_for_the_past(self) -> None:
        now_ms = self.clock.now_ms
        assert self.process.indexed(now_ms) == reserved(self.stranger, now_ms)


def holds(intent: FlightIntent) -> set[tuple[int, int, int, int]]:
    """Return block, enter, exit and sequence of what an intent holds."""
    held = intent.reservations
    columns = zip(held.block.tolist(), held.enter_ms.tolist(), held.exit_ms.tolist(), strict=True)
    return {(block, enter, leave, intent.sequence) for block, enter, leave in columns}


@pytest.mark.compiled
def test_ledger_index_and_journal_stay_in_step(ledgers: Ledgers) -> None:
    machine = type("Machine", (LedgerMachine,), {"ledgers": ledgers})
    run_state_machine_as_test(machine, settings=settings(deadline=None, max_examples=12, stateful_step_count=20))
