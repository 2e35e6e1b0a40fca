"""Plan one flight: request -> arrays -> kernel -> `Plan` or a typed error (paper 3)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from planner.aircraft import AircraftType
from planner.airmatrix import AirMatrix, IntArray
from planner.airspace import Airspace
from planner.errors import (
    AircraftProfileError,
    DestinationBlocked,
    Disconnected,
    EnduranceExceeded,
    NoConflictFreePath,
    NoDepartureSlot,
    NoPlan,
    OriginBlocked,
    SameBlock,
    SearchTooLong,
)
from planner.holds import holds_of
from planner.kernels import labels as label_columns
from planner.kernels import path as path_kernels
from planner.kernels import search as search_kernels
from planner.kernels.balancing import least_cost
from planner.kernels.connectivity import label_components
from planner.kernels.endurance import within_endurance
from planner.kernels.intervals import FAR_FUTURE
from planner.kernels.labels import LAST_STAMP, Task, larger_workspace, new_workspace
from planner.kernels.motion import VISITS, Motion
from planner.kernels.static_search import UNREACHED, Bounds, static_search
from planner.links import LinkTimes, build_link_times, build_offsets
from planner.occupancy import OccupancyIndex, build_motion, open_links
from planner.path import Plan, Trajectory

# How far beyond the requested window a refusal looks for a departure that would work; within what keys can order.
_OUTLOOK_MS = 1 << 31
_FEWEST_LABELS = 1 << 14
# A minute for each link is more than any balance asks for, and the sum stays within what keys can order.
MAX_SURCHARGE_MS = 60_000
# A refusal names the flights around as many labels at most: a flight that is shut in has few.
_SHUT_IN_LABELS = 100
_TOO_LONG = (
    "no plan was found within the work that one request may take: the way is too busy or closed for too much of the "
    "window; ask for a shorter window, or a later one"
)
# So many expansions may go into a dive to the destination before the search looks at everything in the order of F: a
# dive that misses comes back to the same blocks again and again.
_DIVE = 20_000
# How often a flight that would be in the air for too long is looked for again with a later departure.
_LATER_DEPARTURES = 16


class Search(StrEnum):
    """The two kinds of CFA*: the paper's, and the one that misses no path."""

    GREEDY = "greedy"
    SAFE_INTERVAL = "safe-interval"


@dataclass(frozen=True, eq=False)
class Performance:
    """What the search needs of an aircraft. `endurance_ms` bounds arrival minus departure, None for no bound."""

    times: LinkTimes
    endurance_ms: int | None = None

    @classmethod
    def of(cls, aircraft: AircraftType, grid: AirMatrix) -> "Performance":
        """Return an aircraft's performance in a grid; raises `AircraftProfileError`."""
        endurance = None if aircraft.endurance_s is None else int(aircraft.endurance_s * 1000)
        return cls(build_link_times(aircraft, grid), endurance)


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """From block to block (flat indices) with a departure in [earliest, latest], in ms.

    `layer_surcharge_ms` (layers,): what each link that ends in a layer counts beyond the time it takes, so that flights
    prefer other layers; empty, the default, for nothing. Only the safe-interval search knows it. A flight that
    `is_airborne` is in its first block already: it needs no climb-out there.
    """

    origin: int
    destination: int
    performance: Performance
    earliest_departure_ms: int
    latest_departure_ms: int
    layer_surcharge_ms: tuple[int, ...] = ()
    is_airborne: bool = False

    def __post_init__(self) -> None:
        if self.latest_departure_ms < self.earliest_departure_ms:
            raise ValueError("latest_departure_ms lies before earliest_departure_ms")
        if any(not 0 <= surcharge <= MAX_SURCHARGE_MS for surcharge in self.layer_surcharge_ms):
            raise ValueError(f"a surcharge must lie between 0 and {MAX_SURCHARGE_MS} ms")


class Planner:
    """CFA* over one airspace and the reservations in `index`, or in another one. One thread at a time.

    `hover_limit_ms` bounds the greedy search's hovering in one place; `detour_limit_ms` how much longer than without
    traffic a flight may be in the air, `most_expansions` how much work a request may take; None for no bound.
    """

    def __init__(
        self,
        airspace: Airspace,
        search: Search = Search.SAFE_INTERVAL,
        hover_limit_ms: int = 60_000,
        detour_limit_ms: int | None = None,
        most_expansions: int | None = None,
    ) -> None:
        self.airspace = airspace
        self.search = search
        self.hover_limit_ms = hover_limit_ms
        self.detour_limit_ms = detour_limit_ms
        self.most_expansions = most_expansions
        self.index = OccupancyIndex(airspace.grid.block_count)
        self._open_links = open_links(airspace)
        self._offsets = build_offsets(airspace.grid)
        self._components = label_components(self._open_links, self._offsets)
        # Memory that no search touches costs nothing.
        self._workspace = new_workspace(airspace.grid.block_count, max(_FEWEST_LABELS, airspace.grid.block_count // 8))
        self._stamp = self._static_stamp = 0
        self._motions: dict[tuple[int, ...], Motion] = {}
        # How many more expansions the present request may take.
        self._left = UNREACHED

    def another(self) -> "Planner":
        """Return a planner with the same limits, and an index of its own."""
        return Planner(self.airspace, self.search, self.hover_limit_ms, self.detour_limit_ms, self.most_expansions)

    def plan(
        self,
        request: PlanRequest,
        index: OccupancyIndex | None = None,
        *,
        outlook: bool = True,
        continues: bool = False,
    ) -> Plan:
        """Return a conflict-free plan; with the safe-interval search the one of earliest arrival.

        It is free of conflicts with what `index` holds: the planner's own by default. Where there is none, an `outlook`
        looks for a later departure that would work. One that `continues` has what the last one has left of the work.

        Raises
        ------
        ValueError
            The request has surcharges, and the search is greedy or the layers are of another number.
        NotPlannable
            No traffic could make it possible (paper 2.1: a block outside, blocked, or cut off).
        NoPlan
            The present reservations leave no plan.
        """
        layers = self.airspace.grid.dimensions[2]
        if request.layer_surcharge_ms and (self.search is Search.GREEDY or len(request.layer_surcharge_ms) != layers):
            raise ValueError(f"surcharges need the safe-interval search and one value for each of {layers} layers")
        self.check(request.origin, request.destination)
        motion = self._motion(request.performance)
        bounds = self._bounds(motion, request.origin, request.destination)
        index = self.index if index is None else index
        if not continues:
            self._left = UNREACHED if self.most_expansions is None else self.most_expansions
        found = self._search(request, motion, bounds, index)
        if isinstance(found, Plan):
            return found
        if outlook and not request.is_airborne:
            left = self._left
            found.earliest_feasible_departure_ms = self._earliest_feasible_departure(request, motion, bounds, index)
            found.expansions += left - self._left
        raise found

    def unconstrained(self, request: PlanRequest) -> int:
        """Return the flight time without traffic in ms, dwell included: A* under the airspace's rule."""
        self.check(request.origin, request.destination)
        bounds = self._bounds(self._motion(request.performance), request.origin, request.destination)
        return int(bounds.optimum) + 2 * self.airspace.terminal_dwell_ms

    def ends_by(self, request: PlanRequest) -> int:
        """Return when every plan for a request is over, however much is reserved; FAR_FUTURE without a detour limit."""
        if self.detour_limit_ms is None:
            return FAR_FUTURE
        return request.latest_departure_ms + self.unconstrained(request) + self.detour_limit_ms + 1

    def continued(self, flown: Trajectory, request: PlanRequest, index: OccupancyIndex | None = None) -> Plan:
        """Return the plan of a flight in the air: as it has `flown` until it reaches the origin of `request`, and from
        there as `plan` finds it.

        The request begins where `flown` ends and has one departure, that flight's last arrival or later. The holds are
        those of the whole; endurance counts from the first departure.

        Raises
        ------
        NotPlannable, NoPlan
            As `plan`.
        """
        performance = request.performance
        if performance.endurance_ms is not None:
            so_far = request.earliest_departure_ms - flown.departure_ms
            performance = replace(performance, endurance_ms=performance.endurance_ms - so_far)
        rest = self.plan(replace(request, performance=performance, is_airborne=True), index)
        block = np.concatenate([flown.block, rest.block[1:]])
        arrive = np.concatenate([flown.arrive_ms, rest.arrive_ms[1:]])
        depart = np.concatenate([flown.depart_ms[:-1], rest.depart_ms])
        links = arrive[1 : len(flown.block)] - depart[: len(flown.block) - 1]
        hold_block, hold_enter, hold_exit = holds_of(self.airspace, block, arrive, depart)
        return replace(
            rest,
            block=block,
            arrive_ms=arrive,
            depart_ms=depart,
            hold_block=hold_block,
            hold_enter_ms=hold_enter,
            hold_exit_ms=hold_exit,
            earliest_departure_ms=flown.departure_ms,
            slot_opens_ms=flown.departure_ms,
            # What was flown would have taken as long without traffic, but for hovering.
            unconstrained_ms=int(links.sum()) + self.airspace.terminal_dwell_ms + rest.unconstrained_ms,
        )

    def check(self, origin: int, destination: int) -> None:
        """Raise the `NotPlannable` that applies to these blocks, if any."""
        grid = self.airspace.grid
        for block, error in ((origin, OriginBlocked), (destination, DestinationBlocked)):
            if self.airspace.occupied[block]:
                raise error(f"{error.end} in block {list(grid.block(block))}, which a building occupies")
        if origin == destination:
            raise SameBlock(f"origin and destination lie in one block, {list(grid.block(origin))}")
        if self._components[origin] != self._components[destination]:
            raise Disconnected("buildings leave no way from the origin's block to the destination's")

    def _bounds(self, motion: Motion, origin: int, destination: int) -> Bounds:
        """Search without traffic; return what the search with it needs."""
        while True:
            sufficed, bounds = static_search(
                self._open_links, motion, self._workspace, origin, destination, self._next_static_stamp()
            )
            if sufficed and bounds.optimum >= UNREACHED:
                raise AircraftProfileError("too slow: the way there takes longer than the search can order")
            if sufficed:
                return bounds
            self._workspace = larger_workspace(self._workspace)

    def _search(self, request: PlanRequest, motion: Motion, bounds: Bounds, index: OccupancyIndex) -> Plan | NoPlan:
        """Search and return the plan, or the error that says why there is none."""
        in_air, spent = self._longest_in_air(bounds), 0
        asked, soonest = request, 0
        for _ in range(_LATER_DEPARTURES):
            found = self._attempt(asked, motion, bounds, index, soonest)
            if isinstance(found, NoPlan):
                found.expansions += spent
                return found
            if found.flight_time_ms <= in_air:
                if asked is request:
                    return found
                return replace(
                    found, earliest_departure_ms=request.earliest_departure_ms, expansions=found.expansions + spent
                )
            spent += found.expansions
            # Nobody arrives earlier than that; so who is in the air for no longer departs no earlier than this.
            soonest = int(found.arrive_ms[-1])
            earliest = found.arrival_ms - in_air
            if earliest > request.latest_departure_ms or self.search is Search.GREEDY:
                break
            asked = replace(request, earliest_departure_ms=earliest)
        return NoConflictFreePath(
            f"every conflict-free plan is in the air for more than {in_air / 1000:g} s: "
            f"the time without traffic and {(self.detour_limit_ms or 0) / 1000:g} s",
            expansions=spent,
        )

    def _attempt(
        self, request: PlanRequest, motion: Motion, bounds: Bounds, index: OccupancyIndex, soonest: int
    ) -> Plan | NoPlan:
        """Search once, for the earliest arrival within the aircraft's endurance; return as `_search` does.

        Nobody gets to the last block's centre before `soonest`.
        """
        in_air = self._longest_in_air(bounds)
        task = Task(
            request.origin,
            request.destination,
            request.earliest_departure_ms,
            request.latest_departure_ms,
            0 if request.is_airborne else self.airspace.terminal_dwell_ms,
            self.airspace.terminal_dwell_ms,
            self.hover_limit_ms,
            min(request.latest_departure_ms + in_air - self.airspace.terminal_dwell_ms, FAR_FUTURE),
            soonest,
            dive=_DIVE,
            most=0,
            stamp=0,
        )
        if self.search is Search.GREEDY:
            status, label, further = self._run(search_kernels.greedy, motion, index, task)
        elif request.layer_surcharge_ms:
            surcharge = np.array(request.layer_surcharge_ms, dtype=np.int64)
            status, label, further = self._run(least_cost, motion, index, task, bounds, surcharge)
        else:
            status, label, further = self._run(search_kernels.safe_interval, motion, index, task, bounds)
            if status == search_kernels.TOO_LONG and self._left > 0:
                dived = further
                task = task._replace(dive=0)
                status, label, further = self._run(search_kernels.safe_interval, motion, index, task, bounds)
                further += dived
        expansions = bounds.expansions + further
        visits = int(self._workspace.around[VISITS])
        if status == search_kernels.TOO_LONG:
            return SearchTooLong(_TOO_LONG, expansions=expansions)
        if status == search_kernels.NO_DEPARTURE_SLOT:
            owners = index.owners(task.origin, task.earliest, task.latest + task.climb_out + 1)
            return NoDepartureSlot(
                "the first block is reserved or closed throughout the departure window", owners, expansions=expansions
            )
        if status == search_kernels.NO_PATH:
            return NoConflictFreePath(
                "no conflict-free path leads from the first block within the departure window",
                # Who cannot land in time is not looked for on the way.
                self._owners_around(index, label) if label else self._owners_at_the_end(index, task),
                expansions=expansions,
            )
        plan = self._plan(motion, index, task, bounds, label, expansions, visits)
        endurance = request.performance.endurance_ms
        if endurance is None or plan.flight_time_ms <= endurance:
            return plan
        if self.search is Search.SAFE_INTERVAL:
            status, label, further = self._run(within_endurance, motion, index, task, bounds, endurance)
            expansions += further
            visits += int(self._workspace.around[VISITS])
            if status == search_kernels.FOUND:
                return self._plan(motion, index, task, bounds, label, expansions, visits)
            if status == search_kernels.TOO_LONG:
                return SearchTooLong(_TOO_LONG, expansions=expansions)
        return EnduranceExceeded(
            f"every conflict-free plan takes longer than the aircraft's endurance of {endurance / 1000:g} s",
            expansions=expansions,
        )

    def _earliest_feasible_departure(
        self, request: PlanRequest, motion: Motion, bounds: Bounds, index: OccupancyIndex
    ) -> int | None:
        """Return the earliest departure after the request's window from which there is a plan, None if none is near.

        Where the work that is left does not suffice, it is the earliest one found, or none.
        """
        earliest = None
        latest = request.latest_departure_ms + _OUTLOOK_MS
        while latest > request.latest_departure_ms:
            later = self._search(replace(request, latest_departure_ms=latest), motion, bounds, index)
            if isinstance(later, NoPlan):
                break
            # Who departs as soon as the first block is free may have to hover, which an endurance may not allow.
            is_long = later.arrival_ms - later.slot_opens_ms > self._longest_in_air(bounds)
            endurance_matters = request.performance.endurance_ms is not None or is_long
            earliest = later.departure_ms if endurance_matters else later.slot_opens_ms
            latest = later.slot_opens_ms - 1
        return earliest

    def _longest_in_air(self, bounds: Bounds) -> int:
        """Return how long a flight may take, both dwells included, whatever its aircraft's endurance."""
        if self.detour_limit_ms is None:
            return FAR_FUTURE
        return int(bounds.optimum) + 2 * self.airspace.terminal_dwell_ms + self.detour_limit_ms

    def _owners_around(self, index: OccupancyIndex, labels: int) -> tuple[int, ...]:
        """Return the owners of the reservations that shut in a search without a path, in the order it met them."""
        owners: dict[int, None] = {}
        for label in self._workspace.labels[: min(labels, _SHUT_IN_LABELS)]:
            block, open_links = label[label_columns.BLOCK], self._open_links[label[label_columns.BLOCK]]
            near = [block, *(block + offset for link, offset in enumerate(self._offsets) if open_links >> link & 1)]
            for place in near:
                owners.update(
                    dict.fromkeys(index.owners(place, label[label_columns.G], label[label_columns.GAP_END] + 1))
                )
        return tuple(owners)

    def _owners_at_the_end(self, index: OccupancyIndex, task: Task) -> tuple[int, ...]:
        """Return the owners of what lets nobody land in time, at the last block or around it."""
        waited = np.flatnonzero(self._workspace.marks[:, label_columns.STAMP] == self._stamp - 1)
        waited = np.concatenate([[task.destination], waited[waited != task.destination]])[:_SHUT_IN_LABELS]
        return index.owners_within(waited, np.full_like(waited, task.earliest), np.full_like(waited, task.until))

    def _run(
        self,
        kernel: Callable[..., tuple[int, int, int]],
        motion: Motion,
        index: OccupancyIndex,
        task: Task,
        *rest: Bounds | IntArray | int,
    ) -> tuple[int, int, int]:
        """Run a search kernel, with a larger workspace as often as it asks for one."""
        while True:
            stamped = task._replace(stamp=self._next_stamp(), most=self._left)
            outcome = kernel(self._open_links, motion, index.slabs, self._workspace, stamped, *rest)
            if outcome[0] != search_kernels.WORKSPACE_FULL:
                self._left -= outcome[2]
                return outcome
            self._workspace = larger_workspace(self._workspace)

    def _next_stamp(self) -> int:
        """Return a stamp for a search, which has the one before it too."""
        if self._stamp + 2 > LAST_STAMP:
            self._workspace.marks[:] = 0
            self._stamp = 0
        self._stamp += 2
        return self._stamp

    def _next_static_stamp(self) -> int:
        """Count by itself: what a static search leaves must outlive the stamps of the searches that use it."""
        if self._static_stamp == LAST_STAMP:
            self._workspace.field[:] = 0
            self._static_stamp = 0
        self._static_stamp += 1
        return self._static_stamp

    def _plan(
        self,
        motion: Motion,
        index: OccupancyIndex,
        task: Task,
        bounds: Bounds,
        goal: int,
        expansions: int,
        visits: int,
    ) -> Plan:
        """Turn the labels of a finished search into a plan."""
        ws = self._workspace
        block, arrive, depart, gap_end = path_kernels.trace(ws.labels, goal, task)
        slot_opens_ms = int(arrive[0])
        if self.search is Search.SAFE_INTERVAL:
            path_kernels.wait_early(motion, index.slabs, block, arrive, depart, gap_end)
        path_kernels.hold_on_ground(arrive, depart, task)
        hold_block, hold_enter, hold_exit = path_kernels.holds(
            motion, ws.marks, self._next_stamp(), block, arrive, depart
        )
        return Plan(
            block=block,
            arrive_ms=arrive,
            depart_ms=depart,
            hold_block=hold_block,
            hold_enter_ms=hold_enter,
            hold_exit_ms=hold_exit,
            earliest_departure_ms=task.earliest,
            slot_opens_ms=slot_opens_ms,
            # Without the JIT kernels return numpy's integers.
            unconstrained_ms=int(bounds.optimum) + task.climb_out + task.dwell,
            terminal_dwell_ms=task.dwell,
            expansions=expansions,
            static_expansions=bounds.expansions,
            interval_visits=visits,
        )

    def _motion(self, performance: Performance) -> Motion:
        key = performance.times[1:]
        if key not in self._motions:
            self._motions[key] = build_motion(performance.times, self.airspace)
        return self._motions[key]
