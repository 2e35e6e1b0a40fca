"""Flights of equal standing planned together: who comes first is the service's to choose (beyond the paper, whose first
come, first served this starts from; it names the order of flights as an open problem).

First come, first served is the base line. Then other orders are tried in which those who were delayed come earlier
(squeaky wheel optimisation: Joslin and Clements 1999), and then a few flights at a time are taken out and planned again
in another order (large neighbourhood search: Shaw 1998; for many agents on a grid: Li et al. 2021). What is kept is
always a whole schedule without conflicts, so that it can be stopped at any time.

The cost of a delay d is d + d²/30 s. A cost that grows faster than the delay is how air traffic flow management keeps
delays from being heaped on a few (Lulli and Odoni 2007; Bertsimas and Gupta 2016): here a second more counts twice for
a flight that is 15 s late already.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from planner.airmatrix import IntArray
from planner.cfa_star import Planner, PlanRequest
from planner.errors import NoPlan
from planner.occupancy import OccupancyIndex
from planner.path import Plan

# The delay whose cost is twice the delay. A longer one than the second counts as that, so that sums stay in range.
_TWICE_AT_MS = 30_000
_LONGEST_MS = 1 << 31
# Orders tried before flights are planned again a few at a time; the delay that takes a flight from last to first.
_ORDERS = 4
_TO_FIRST_MS = 30_000
# How many flights are planned again at a time; how near in time two flights in one block are to be near each other.
_FEWEST, _MOST = 2, 8
_NEAR_MS = 3_000
# How often the neighbours of those in the way are taken out too, and how often who was delayed is not the first.
_WIDER, _ANY_ORDER = 0.5, 0.3
# Owners of the batch's reservations in the index: beyond all sequence numbers.
_FIRST_OWNER = 1 << 48


@dataclass(frozen=True)
class Figures:
    """What a schedule is worth: delays of the planned flights in ms, and how many have no plan.

    `spread_ms` is the standard deviation. `fairness` is Jain's index (Jain, Chiu and Hawe 1984) of what each flight
    gets of what it would have alone: its flight time without traffic, divided by the time from its earliest departure
    to its arrival; 0 if it has no plan. The index is 1 if all get the same share, as they do without any delay (and
    without any plan), and 1/n if one of n gets everything. Of the delays themselves it would say that one of 0.1 s
    among many flights without any is as unfair as can be, and of no delay at all nothing.
    """

    refused: int
    total_ms: int
    mean_ms: float
    worst_ms: int
    p95_ms: float
    spread_ms: float
    fairness: float

    @classmethod
    def of(cls, delay_ms: IntArray, unconstrained_ms: IntArray) -> "Figures":
        """Sum up delays, -1 for a flight without a plan, and the same flights' times without traffic: (flights,)."""
        planned = delay_ms >= 0
        refused = int((~planned).sum())
        if refused == len(delay_ms):
            return cls(refused, 0, 0.0, 0, 0.0, 0.0, 1.0)
        delays, alone = delay_ms[planned], unconstrained_ms[planned]
        shares = alone / (alone + delays)
        return cls(
            refused=refused,
            total_ms=int(delays.sum()),
            mean_ms=float(delays.mean()),
            worst_ms=int(delays.max()),
            p95_ms=float(np.percentile(delays, 95)),
            spread_ms=float(delays.std()),
            fairness=float(shares.sum() ** 2 / (len(delay_ms) * (shares**2).sum())),
        )


@dataclass(frozen=True, eq=False)
class Schedule:
    """A plan for each request, None where there is none: together free of conflicts."""

    plans: tuple[Plan | None, ...]

    @cached_property
    def delay_ms(self) -> IntArray:
        """Delays, -1 where there is no plan: (flights,)."""
        return _delays_ms(self.plans)

    @property
    def figures(self) -> Figures:
        """Sum the schedule up."""
        alone_ms = np.array([0 if plan is None else plan.unconstrained_ms for plan in self.plans], dtype=np.int64)
        return Figures.of(self.delay_ms, alone_ms)


class Interrupted(Exception):
    """Told to stop before there was a first schedule."""


class _InOrder(NamedTuple):
    """Plans of flights that were planned one after another, and the index with them."""

    plans: list[Plan | None]
    occupancy: OccupancyIndex


class Together:
    """Plans requests of equal standing around what is reserved: in the planner's index, or in another one.

    `first_come` is the base line, in the order of the requests; `should_stop` is asked before each of them. `improve`
    makes `best` better. In `best`

    - everybody has a plan whom first come, first served gives one;
    - unless more flights have one, delays are not longer in all, and none is longer than the longest was.

    A flight may well be delayed more than under first come, first served: that is what equal standing means. All of it
    follows from the requests, the reservations and `seed`. What is reserved stays as it is, and must meanwhile.

    Raises
    ------
    NotPlannable
        No traffic could make a request possible.
    Interrupted
        There is no base line yet, and it `should_stop`.
    """

    def __init__(
        self,
        planner: Planner,
        requests: Sequence[PlanRequest],
        reserved: OccupancyIndex | None = None,
        seed: int = 0,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        self._planner = planner
        self._requests = requests
        self._reserved = planner.index if reserved is None else reserved
        self._random = np.random.default_rng(seed)
        self._refused_ms = np.array(
            [request.latest_departure_ms - request.earliest_departure_ms + _TWICE_AT_MS for request in requests],
            dtype=np.int64,
        )
        self._order = np.arange(len(requests))
        found = self._in_order(self._order, should_stop)
        if found is None:
            raise Interrupted(f"told to stop before all of {len(requests)} flights were planned once")
        self._plans, self._index = found
        self.first_come = Schedule(tuple(self._plans))
        # Delays of the best schedule, of the order tried last, and without the others of the batch.
        self._delay_ms = self._tried_ms = self.first_come.delay_ms
        self._alone: Schedule | None = None
        self.iterations = 0

    @property
    def best(self) -> Schedule:
        """The best schedule so far."""
        return Schedule(tuple(self._plans))

    @property
    def is_best_possible(self) -> bool:
        """Whether no flight of the batch is known to be delayed by another one."""
        return self._alone is not None and not self._due_to_others_ms(self._delay_ms).any()

    def improve(self, should_stop: Callable[[], bool], most_iterations: int | None = None) -> None:
        """Look for better schedules until told to stop, for so many iterations in all, or until none can be better.

        An iteration tries one order of all flights, or plans a few again. `should_stop` is asked before each iteration
        and, where all are planned, before each flight; what it interrupts is dropped.
        """
        while not (self.is_best_possible or self.iterations == most_iterations or should_stop()):
            if self._alone is None:
                self._alone = self._each_alone(should_stop)
            elif self.iterations < _ORDERS:
                self.iterations += self._try_order(should_stop)
            else:
                self._plan_some_again()
                self.iterations += 1

    def _plan(self, request: PlanRequest, index: OccupancyIndex) -> Plan | None:
        try:
            return self._planner.plan(request, index, outlook=False)
        except NoPlan:
            return None

    def _each_alone(self, should_stop: Callable[[], bool]) -> Schedule | None:
        """Plan each flight as if there were no other of the batch; return None if told to stop."""
        plans: list[Plan | None] = []
        for request in self._requests:
            if should_stop():
                return None
            plans.append(self._plan(request, self._reserved))
        return Schedule(tuple(plans))

    def _in_order(self, order: IntArray, should_stop: Callable[[], bool]) -> "_InOrder | None":
        """Plan all flights one after another; return the plans, and the index with them, or None if told to stop."""
        index = self._reserved.copy()
        plans: list[Plan | None] = [None] * len(order)
        for number in order.tolist():
            if should_stop():
                return None
            plans[number] = self._plan(self._requests[number], index)
            _reserve(index, plans[number], number)
        return _InOrder(plans, index)

    def _try_order(self, should_stop: Callable[[], bool]) -> bool:
        """Let those who were delayed in the order tried last come earlier; tell whether that was done."""
        sooner = self._due_to_others_ms(self._tried_ms) * len(self._order) / _TO_FIRST_MS
        places = np.empty(len(self._order))
        places[self._order] = np.arange(len(self._order))
        order = np.argsort(places - sooner, kind="stable")
        found = self._in_order(order, should_stop)
        if found is None:
            return False
        self._order, self._tried_ms = order, _delays_ms(found.plans)
        if self._is_kept(self._tried_ms):
            self._plans, self._index, self._delay_ms = found.plans, found.occupancy, self._tried_ms
        return True

    def _plan_some_again(self) -> None:
        """Take out a few flights, plan them in another order, and keep that if it is no worse."""
        numbers = self._neighbourhood()
        before = [self._plans[number] for number in numbers]
        for number in numbers:
            self._put(number, None)
        delay_ms = self._delay_ms.copy()
        delay_ms[numbers] = 0
        for number in self._order_of(numbers):
            self._put(number, self._plan(self._requests[number], self._index))
            delay_ms[number] = _delays_ms([self._plans[number]])[0]
            # As if those that are still to come were not delayed at all.
            if not self._is_kept(delay_ms):
                for undone in numbers:
                    self._put(undone, None)
                for restored, plan in zip(numbers, before, strict=True):
                    self._put(restored, plan)
                return
        self._delay_ms = delay_ms

    def _put(self, number: int, plan: Plan | None) -> None:
        """Give a flight another plan, or none."""
        old = self._plans[number]
        if old is not None:
            self._index.release(old.hold_block, old.hold_enter_ms, old.hold_exit_ms)
        _reserve(self._index, plan, number)
        self._plans[number] = plan

    def _neighbourhood(self) -> list[int]:
        """Draw a flight that others delay, the longer the likelier, and flights that are in its way.

        Those are the ones that hold what it would hold without the batch, and half the time others that are near those.
        """
        assert self._alone is not None
        delayed_ms = self._due_to_others_ms(self._delay_ms)
        first = int(self._random.choice(len(delayed_ms), p=delayed_ms / delayed_ms.sum()))
        most = int(self._random.integers(_FEWEST, _MOST + 1))
        chosen = [first]
        self._add(chosen, self._alone.plans[first], 0, most)
        if self._random.random() < _WIDER:
            for number in chosen[1:]:
                self._add(chosen, self._plans[number], _NEAR_MS, most)
        return chosen

    def _add(self, chosen: list[int], plan: Plan | None, within_ms: int, most: int) -> None:
        """Choose flights that hold blocks of a plan within its times and some more, in a random order."""
        if plan is None or len(chosen) >= most:
            return
        owners = self._index.owners_within(
            plan.hold_block, plan.hold_enter_ms - within_ms, plan.hold_exit_ms + within_ms
        )
        near = [owner - _FIRST_OWNER for owner in owners if owner >= _FIRST_OWNER]
        fresh = [number for number in near if number not in chosen]
        self._random.shuffle(fresh)
        chosen += fresh[: most - len(chosen)]

    def _order_of(self, numbers: list[int]) -> list[int]:
        """Return numbers in a random order; the first stays it most of the time."""
        fixed = 0 if self._random.random() < _ANY_ORDER else 1
        rest = numbers[fixed:]
        self._random.shuffle(rest)
        return numbers[:fixed] + rest

    def _due_to_others_ms(self, delay_ms: IntArray) -> IntArray:
        """Return how much of the delays others of the batch cause; for a flight without a plan more than its window.

        Nobody is to blame for what a flight would suffer alone.
        """
        assert self._alone is not None
        alone_ms = self._alone.delay_ms
        full_ms = np.where(delay_ms < 0, self._refused_ms, delay_ms)
        return np.where(alone_ms < 0, 0, np.maximum(full_ms - alone_ms, 0))

    def _is_kept(self, delay_ms: IntArray) -> bool:
        """Tell whether delays are no worse than the best ones, and as it is promised of them."""
        before_ms = self.first_come.delay_ms
        if (delay_ms[before_ms >= 0] < 0).any():
            return False
        is_longer = delay_ms.sum() > before_ms.sum() or delay_ms.max(initial=0) > before_ms.max(initial=0)
        if is_longer and (delay_ms < 0).sum() == (before_ms < 0).sum():
            return False
        return _worth(delay_ms) <= _worth(self._delay_ms)


def _delays_ms(plans: Sequence[Plan | None]) -> IntArray:
    return np.array([-1 if plan is None else plan.delay_ms for plan in plans], dtype=np.int64)


def _worth(delay_ms: IntArray) -> tuple[int, int]:
    """Return how bad delays are: flights without a plan, then the cost of the others' delays in ms."""
    planned = np.clip(delay_ms, 0, _LONGEST_MS)
    return int((delay_ms < 0).sum()), int((planned + planned * planned // _TWICE_AT_MS).sum())


def _reserve(index: OccupancyIndex, plan: Plan | None, number: int) -> None:
    if plan is not None:
        index.reserve(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms, _FIRST_OWNER + number)
