"""Simulated traffic: flights planned in filing order under a rule and a search, and judged.

Everything but computing times follows from the airspace and the flights. Each is planned against all before it, from
time 0 on, and may be held on the ground for as long as the service allows by default; the paper says nothing of flights
whose first block is taken.
"""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from planner.aircraft import shipped_aircraft_types
from planner.airmatrix import FloatArray
from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Performance, Planner, PlanRequest, Search
from planner.errors import NoPlan, NotPlannable, PlannerError
from planner.experiments import altitude
from planner.experiments.traffic import PAPER_AIRCRAFT, Demand, Flight, Od, random_flights, terminals
from planner.path import Plan
from planner.separation import Approach, CheckedFlight, Kind, verify

GROUND_HOLD_MS = 300_000
HOVER_LIMIT_MS = 60_000


class NothingToStudy(PlannerError):
    """The airspace leaves no flights to study."""


@dataclass(frozen=True, eq=False)
class Run:
    """Flights planned one after another.

    `plans` and `refusals` have one entry a flight, one of both None. `seconds` (flights,) is how long each took from
    request to plan and into the index.
    """

    rule: OccupancyRule
    flights: tuple[Flight, ...]
    plans: tuple[Plan | None, ...]
    refusals: tuple[str | None, ...]
    seconds: FloatArray

    @property
    def accepted(self) -> list[Plan]:
        """The plans that were found."""
        return [plan for plan in self.plans if plan is not None]

    @property
    def refused(self) -> Counter[str]:
        """How many flights were refused for which reason."""
        return Counter(refusal for refusal in self.refusals if refusal is not None)

    @property
    def delay_s(self) -> FloatArray:
        """Delays of the flights, NaN where there is no plan: (flights,)."""
        return np.array([np.nan if plan is None else plan.delay_ms / 1000 for plan in self.plans])

    @property
    def unconstrained_s(self) -> FloatArray:
        """Flight times without traffic under the run's rule, NaN where there is no plan: (flights,)."""
        return np.array([np.nan if plan is None else plan.unconstrained_ms / 1000 for plan in self.plans])

    @property
    def expansions(self) -> int:
        """Blocks expanded in all."""
        return sum(plan.expansions for plan in self.accepted)

    @property
    def static_expansions(self) -> int:
        """Blocks expanded by the searches without traffic, with which plans begin."""
        return sum(plan.static_expansions for plan in self.accepted)


@dataclass(frozen=True)
class Verdict:
    """What the independent checker says of a run.

    `too_near` are the pairs of flight numbers that come nearer than a block side horizontally and a block height
    vertically at one instant, of `pairs` in the air at the same time; `near_buildings` counts pairs of a flight and a
    building nearer than half a block side, `violations` all that the airspace's rule forbids but pairs of flights.
    `closest` is the nearest horizontally while within a block height.
    """

    pairs: int
    too_near: tuple[tuple[int, int], ...]
    near_buildings: int
    violations: int
    closest: Approach | None
    clearance_m: float | None


class Simulator:
    """Plans traffic in one airspace under any rule, and counts the flights."""

    def __init__(self, airspace: Airspace, on_progress: Callable[[int], None] | None = None) -> None:
        self.airspaces = {rule: replace(airspace, rule=rule, terminal_dwell_ms=0) for rule in OccupancyRule}
        self.types = {aircraft.id: aircraft for aircraft in shipped_aircraft_types()}
        self.performances = {id_: Performance.of(aircraft, airspace.grid) for id_, aircraft in self.types.items()}
        self._terminals = {od: terminals(airspace.grid, airspace.occupied, od) for od in Od}
        self._planners: dict[tuple[OccupancyRule, Search], Planner] = {}
        self._planned = 0
        self._on_progress = on_progress
        if len(self._terminals[Od.LOWEST]) < 2:
            raise NothingToStudy("the airspace has fewer than two columns of blocks to fly between")

    def flights(self, demand: Demand) -> tuple[Flight, ...]:
        """Draw flights of the paper's four types of aircraft."""
        places = self._terminals[demand.od]
        return tuple(random_flights(places, PAPER_AIRCRAFT, demand.flights, 60.0 * demand.window_min, demand.seed))

    def fly(self, flights: Sequence[Flight], rule: OccupancyRule, search: Search) -> Run:
        """Plan flights by CFA*, each against all before it."""
        return self._fly(flights, rule, search, reserves=True)

    def fly_alone(self, flights: Sequence[Flight], rule: OccupancyRule, search: Search) -> Run:
        """Plan flights by A*, each as if it were alone: by a search of CFA* with nothing reserved."""
        return self._fly(flights, rule, search, reserves=False)

    def fly_balanced(self, flights: Sequence[Flight], rule: OccupancyRule, weight_ms: int) -> Run:
        """Plan flights by safe-interval CFA*, each with surcharges on the layers that those before it crowd."""
        return self._fly(flights, rule, Search.SAFE_INTERVAL, reserves=True, weight_ms=weight_ms)

    def time_without_traffic(self, flights: Sequence[Flight], rule: OccupancyRule) -> FloatArray:
        """Return how many seconds the search without traffic takes, with which every plan begins: (flights,)."""
        planner = self._planner(rule, Search.SAFE_INTERVAL)
        seconds = []
        for flight in flights:
            request = self._request(flight)
            began = time.perf_counter()
            with suppress(NotPlannable):
                planner.unconstrained(request)
            seconds.append(time.perf_counter() - began)
        return np.array(seconds)

    def _planner(self, rule: OccupancyRule, search: Search) -> Planner:
        if (rule, search) not in self._planners:
            self._planners[rule, search] = Planner(self.airspaces[rule], search, HOVER_LIMIT_MS)
        return self._planners[rule, search]

    def _request(self, flight: Flight, layer_surcharge_ms: tuple[int, ...] = ()) -> PlanRequest:
        return PlanRequest(
            flight.origin,
            flight.destination,
            self.performances[flight.aircraft],
            flight.departure_ms,
            flight.departure_ms + GROUND_HOLD_MS,
            layer_surcharge_ms,
        )

    def _fly(
        self, flights: Sequence[Flight], rule: OccupancyRule, search: Search, reserves: bool, weight_ms: int = 0
    ) -> Run:
        planner = self._planner(rule, search)
        planner.index.clear()
        crowding = altitude.Crowding(self.airspaces[rule])
        plans: list[Plan | None] = []
        refusals: list[str | None] = []
        seconds = []
        for number, flight in enumerate(flights):
            plan, refusal = None, None
            request = self._request(flight, crowding.surcharges_ms(weight_ms) if weight_ms else ())
            began = time.perf_counter()
            try:
                plan = planner.plan(request)
                if reserves:
                    planner.index.reserve(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms, number)
            except (NoPlan, NotPlannable) as error:
                refusal = error.reason
            seconds.append(time.perf_counter() - began)
            if plan is not None:
                crowding.add(plan)
            plans.append(plan)
            refusals.append(refusal)
            self._planned += 1
            if self._on_progress is not None:
                self._on_progress(self._planned)
        return Run(rule, tuple(flights), tuple(plans), tuple(refusals), np.array(seconds))

    def judge(self, run: Run) -> Verdict:
        """Have the independent checker judge a run."""
        report = verify(
            self.airspaces[run.rule],
            [
                CheckedFlight(
                    str(number),
                    plan.block,
                    plan.arrive_ms,
                    plan.depart_ms,
                    plan.hold_block,
                    plan.hold_enter_ms,
                    plan.hold_exit_ms,
                )
                for number, plan in enumerate(run.plans)
                if plan is not None
            ],
        )
        findings = (*report.near_misses, *report.violations)
        near = [finding for finding in findings if finding.kind is Kind.TOO_NEAR]
        return Verdict(
            pairs=report.flight_pairs,
            too_near=tuple((int(first), int(second)) for first, second in (finding.flights for finding in near)),
            near_buildings=sum(finding.kind is Kind.BUILDING for finding in findings),
            violations=sum(violation.kind is not Kind.TOO_NEAR for violation in report.violations),
            closest=report.closest,
            clearance_m=None if report.clearance is None else report.clearance.distance_m,
        )
