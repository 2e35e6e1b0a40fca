"""Conformance monitoring: looks at the air every second, records what changed, moves states that move by themselves."""

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import structlog

from app.alerts import Alert, alerts
from app.block_status import Alarm, BlockStatus, statuses
from app.conformance import Assessment, Conformance, Thresholds, assess, move
from app.deconfliction import Deconfliction, Moved
from app.errors import IllegalTransition, LedgerUnavailable, QueueFull
from app.flight_intents import State
from app.ledger import Ledger, Transaction
from app.surveillance import Aircraft, AirPicture, Flight, Reach, Remark
from app.writer import Writer
from planner.airspace import Airspace

log = structlog.get_logger()

# In these a flight becomes contingent after a while.
_SEVERE = frozenset({Conformance.LOST.value, Conformance.VIOLATING.value})
# So many changes are recorded at once, and so many flights ended that were never seen: nobody waits long for that. So
# often in one look.
_PART, _END_AT_ONCE, _ENDS = 64, 256, 8
# After its start a process that finds aircraft gives them so long to report again.
_SETTLE_S = 5.0
# The writer takes a few milliseconds for all that, unless it waits for others or for the ledger.
_PATIENCE_S = 0.5
# A flight is shown from so long before its departure, a track until so long after it was last seen.
_DUE_MS, _TRACK_MS = 60_000, 60_000


@dataclass(frozen=True, eq=False)
class View:
    """The air at one time as it was judged `now_ms`: every aircraft, and every block in use, by block."""

    now_ms: int
    picture: AirPicture
    assessed: Mapping[Aircraft, Assessment]
    blocks: Sequence[BlockStatus]

    @property
    def at_ms(self) -> int:
        """The time."""
        return self.picture.at_ms


@dataclass(frozen=True)
class Change:
    """What is to be recorded of one aircraft: what was remarked of it and what is now, and where its state goes.

    Where it `is_over`, the flight has ended or the track is gone: nothing is remarked, rather than that it conforms.
    """

    aircraft: Aircraft
    flight: Flight | None
    before: Remark | None
    after: Remark | None
    state: State | None
    is_over: bool = False


class Monitor:
    """Judges the air at any time; between `start` and `stop` it does so by itself and records what changed. `observe`
    is told how many seconds that took.

    Several processes may do this on one ledger: who comes second finds nothing left to record.
    """

    def __init__(
        self,
        ledger: Ledger,
        airspace: Airspace,
        clock: Callable[[], int],
        thresholds: Thresholds,
        writing: tuple[Writer, Deconfliction] | None,
        observe: Callable[[float], None] = lambda _: None,
    ) -> None:
        self._ledger = ledger
        self._airspace = airspace
        self._clock = clock
        self._thresholds = thresholds
        self._writing = writing
        self._observe = observe
        self._reach = Reach(
            before_ms=thresholds.freshness_ms + thresholds.tolerance_ms,
            # A position may be ahead of the clock by the tolerance, and ahead of its reservation by another.
            after_ms=2 * thresholds.tolerance_ms,
            due_ms=_DUE_MS,
            track_ms=_TRACK_MS,
        )
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._latest: View | None = None
        self._pending: list[Future[Moved]] = []

    def start(self, every_s: float) -> None:
        """Begin to look, at intervals by the system's clock."""
        self._thread = threading.Thread(target=self._run, args=(every_s,), name="conformance-monitor", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End it."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()

    def view(self, at_ms: int | None = None) -> View:
        """Return the air as it is, or at a time: the past from recorded positions, the future from reservations.

        Raises
        ------
        LedgerUnavailable
        """
        now = self._clock()
        at_ms = now if at_ms is None else at_ms
        picture = self._ledger.air_picture(at_ms, self._reach, is_past=at_ms < now, is_forecast=at_ms > now)
        assessed = assess(picture, self._airspace.grid, self._thresholds)
        blocks, assessed = statuses(picture, assessed, self._airspace.occupied)
        return View(now, picture, assessed, blocks)

    def alerts(self, view: View) -> list[Alert]:
        """Return who deviates in a view of the present, whom they threaten, and who is in closed airspace; raises
        `LedgerUnavailable`.
        """
        deviating = [
            (assessment, view.at_ms if remark is None else remark.raised_ms)
            for aircraft, assessment in view.assessed.items()
            # Who is in closed airspace as it was planned is to be seen too; other red blocks have somebody to blame.
            if assessment.reasons or Alarm.IN_CONSTRAINT in assessment.alarms
            for remark in [view.picture.remarks.get(aircraft)]
        ]
        return alerts(deviating, self._airspace.grid, view.at_ms, self._thresholds, self._ledger.held_in)

    def status_of(self, block: int) -> BlockStatus | None:
        """Return a block's status now, None where it is idle; raises `LedgerUnavailable`."""
        return next((entry for entry in self.view().blocks if entry.block == block), None)

    @property
    def latest(self) -> View | None:
        """What was seen last, None before the first look."""
        return self._latest

    def look(self, patience_s: float | None = None) -> View:
        """Judge the present, have recorded what has changed, and return it as it was judged.

        Whoever watches sees it when it is recorded, or after `patience_s` (None: as long as it takes) if the writer has
        not got round to it by then; until it has, nothing further is recorded.

        Raises
        ------
        LedgerUnavailable, QueueFull
        """
        began = time.perf_counter()
        view = self.view()
        try:
            if self._writing is not None and not wait(self._pending, patience_s).not_done:
                self._pending = []
                self._record(view, *self._writing)
                for future in wait(self._pending, patience_s).done:
                    future.result()
        finally:
            self._latest = view
            self._observe(time.perf_counter() - began)
        return view

    def _run(self, every_s: float) -> None:
        settled_s: float | None = None
        while not self._stopping.wait(every_s):
            try:
                if settled_s is None:
                    # Nobody could report while nobody listened: that somebody is lost cannot be said at once.
                    self._latest = self.view()
                    settled_s = time.monotonic() + (_SETTLE_S if self._latest.picture.sightings else 0.0)
                elif time.monotonic() < settled_s:
                    self._latest = self.view()
                else:
                    self.look(_PATIENCE_S)
            except (LedgerUnavailable, QueueFull) as error:
                with suppress(OSError, ValueError):
                    log.warning("conformance is not monitored", error=str(error))
            except Exception as error:
                with suppress(OSError, ValueError):
                    log.error("conformance monitoring failed", exc_info=error)

    def _record(self, view: View, writer: Writer, deconfliction: Deconfliction) -> None:
        """Hand what has changed to the writer, in parts, so that planning goes on in between."""
        changes = self._changes(view)
        slices = [changes[start : start + _PART] for start in range(0, len(changes), _PART)]
        parts = [partial(_record, deconfliction, part) for part in slices]
        before_ms = view.at_ms - self._thresholds.tolerance_ms
        unseen = self._ledger.unseen(before_ms, _END_AT_ONCE * _ENDS)
        parts += [partial(_end, before_ms)] * math.ceil(unseen / _END_AT_ONCE)
        for part in parts:
            self._pending.append(writer.enqueue(part, lambda: Moved(())).future)

    def _changes(self, view: View) -> list[Change]:
        remarks, now = view.picture.remarks, view.at_ms
        changes = [
            # Ended, or gone.
            Change(aircraft, None, before, None, None, is_over=True)
            for aircraft, before in remarks.items()
            if aircraft not in view.assessed
        ]
        for aircraft, assessment in view.assessed.items():
            before = remarks.get(aircraft)
            after = _remark(assessment, before, now)
            is_severe = after is not None and after.conformance in _SEVERE
            since_ms = after.since_ms if after is not None and is_severe else None
            state = move(assessment, since_ms, now, self._thresholds)
            is_over = state is State.ENDED
            if is_over:
                after = None
            if state is not None or after != before:
                changes.append(Change(aircraft, assessment.flight, before, after, state, is_over))
        return changes


def _end(before_ms: int, transaction: Transaction, now: int) -> Moved:
    ended = transaction.end_unseen(before_ms, _END_AT_ONCE, now)
    return Moved([(sequence, intent_id, State.ENDED) for sequence, intent_id in ended])


def _remark(assessment: Assessment, before: Remark | None, now: int) -> Remark | None:
    """Return what is to be remarked of an aircraft, None where it simply conforms."""
    reasons = assessment.all_reasons
    if not reasons:
        return None
    conformance = assessment.conformance.value
    if before is None:
        return Remark(conformance, reasons, now, now)
    # How long somebody is lost or violating counts together.
    is_same = before.conformance == conformance or {before.conformance, conformance} <= _SEVERE
    # What was recorded while the clock was ahead began now.
    since_ms = min(before.since_ms, now) if is_same else now
    return Remark(conformance, reasons, since_ms, min(before.raised_ms, now))


def _record(deconfliction: Deconfliction, changes: Sequence[Change], transaction: Transaction, now: int) -> Moved:
    """Write down changes that nobody else has written down already; return the flights that moved."""
    present = transaction.remarks(change.aircraft for change in changes)
    current = [change for change in changes if present.get(change.aircraft) == change.before]
    moved = []
    for change in current:
        intent = None if change.flight is None or change.state is None else transaction.find(change.flight.id)
        if intent is None or change.flight is None or change.state is None or intent.version != change.flight.version:
            continue
        with suppress(IllegalTransition):
            deconfliction.move(transaction, now, intent, change.state)
            moved.append((intent.sequence, intent.id, change.state))
    changed = [change for change in current if change.after != change.before]
    transaction.forget_remarks(change.aircraft for change in changed if change.is_over)
    transaction.remark({change.aircraft: change.after for change in changed if not change.is_over}, now)
    return Moved(moved)
