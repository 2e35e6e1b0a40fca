"""The independent checker: judges flights as the ledger holds them, with none of the planner's code.

The theorem it judges, for an airspace under the containment rule. A flight on a link holds every block of
the box that the link spans, and one that hovers holds its block; nobody holds a block that another holds or
that a building occupies. An aircraft on its link is at least half a block inside the faces of that box, and
the boxes of two flights never overlap. Hence **any two aircraft are at every instant at least one block
side apart horizontally or one block height apart vertically, and each is at least half a block side away
horizontally from every building whose roof is not at least half a block height below it.**

Its scope: from departure to arrival, instants included, of flights that follow their trajectories; in
metres of the airspace's projection, between the block centres that trajectories are made of. It does not
speak of aircraft on a pad, nor of the way between a pad and its block's centre, nor of the wind. Under the
midpoint rule neither separation nor clearance is promised: what comes near is reported, and is no
violation.

The premises (disjoint reservations, complete holds, continuous trajectories) and the conclusions (closest
approach, clearance from buildings) are each computed from the data, so that a mistake in either shows. Of a
flight that was released in part, the part still held is judged; one released wholly is only counted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from planner.airmatrix import AirMatrix
from planner.airspace import Airspace, OccupancyRule
from planner.building_clearance import Clearance, building_clearances
from planner.closest_approach import Approach, Legs, closest_approaches
from planner.premises import CheckedFlight, Kind, Traffic, Violation, broken_rules, not_held

__all__ = ["Approach", "CheckedFlight", "Clearance", "Kind", "Report", "Violation", "verify"]

# Flights whose trajectories are compared with their reservations at once: bounds memory.
_CHUNK = 500

# More violations of the premises than this, and distances are not looked at.
_HOPELESS = 10_000

_LATEST = np.iinfo(np.int64).max


@dataclass(frozen=True)
class Report:
    """What was judged and what was found.

    `flights` were given: of these `released` have no trajectory left to judge, and `cut` a part of it.
    `closest` is the smallest horizontal distance of two flights less than a block height apart vertically,
    `closest_vertical` the smallest vertical one of two less than a block side apart horizontally,
    `clearance` the smallest distance from a building: None where there is none. `near_misses` are what the
    containment rule would forbid, under the midpoint rule. Distances are not judged (`motion_judged`) where the
    reservations are wrong by the ten thousands.
    """

    rule: OccupancyRule
    flights: int
    released: int
    cut: int
    reservations: int
    legs: int
    flight_pairs: int
    leg_pairs: int
    closest: Approach | None
    closest_vertical: Approach | None
    clearance: Clearance | None
    violations: tuple[Violation, ...]
    near_misses: tuple[Violation, ...]
    motion_judged: bool

    @property
    def ok(self) -> bool:
        """Tell whether nothing is violated."""
        return not self.violations


def verify(
    airspace: Airspace,
    flights: Sequence[CheckedFlight],
    on_progress: Callable[[str, float], None] | None = None,
) -> Report:
    """Judge flights against each other, the airspace and its rule.

    `on_progress` is called with the name of a stage and the fraction of it that is done; a stage that has
    to look farther afield starts again.
    """
    progress = on_progress or _silent
    traffic = Traffic.of(flights)
    progress("reservations", 0.0)
    violations = list(broken_rules(airspace, traffic))
    for begin in range(0, len(flights), _CHUNK):
        progress("reservations", begin / len(flights))
        violations += not_held(airspace, Traffic.of(flights[begin : begin + _CHUNK]))
    progress("reservations", 1.0)
    # Where the premises fail wholesale, so does the conclusion, for too many pairs of flights to list.
    hopeless = len(violations) > _HOPELESS
    legs = _legs(airspace.grid, Traffic.of([]) if hopeless else traffic)
    approaches = closest_approaches(airspace.grid, legs, lambda done: progress("closest approach", done))
    clearances = building_clearances(airspace, legs, lambda done: progress("buildings", done))
    near = [
        *(_too_near(approach) for approach in approaches.too_near),
        *(_too_near_a_building(clearance) for clearance in clearances.too_near),
    ]
    promised = airspace.rule is OccupancyRule.CONTAINMENT
    return Report(
        rule=airspace.rule,
        flights=len(flights),
        released=len(flights) - len(np.unique(legs.flight)),
        cut=len(np.unique(legs.flight[~legs.whole])),
        reservations=len(traffic.hold_block),
        legs=len(legs),
        flight_pairs=_concurrent_pairs(legs),
        leg_pairs=approaches.leg_pairs,
        closest=approaches.horizontal,
        closest_vertical=approaches.vertical,
        clearance=clearances.smallest,
        violations=tuple(violations + near if promised else violations),
        near_misses=() if promised else tuple(near),
        motion_judged=not hopeless,
    )


def _silent(_stage: str, _fraction: float) -> None:
    """Report no progress."""


def _legs(grid: AirMatrix, traffic: Traffic) -> Legs:
    """Return the legs, links and stands, clipped to what is held.

    Stops and links that are themselves violations, outside the grid or ending before they begin, have no
    place and are left out.
    """
    last = np.append(traffic.flight[1:] != traffic.flight[:-1], True)[: len(traffic.flight)]
    link, stand = traffic.links, np.flatnonzero((traffic.arrive_ms < traffic.depart_ms) | last)
    first = np.concatenate([link, stand])
    to = np.concatenate([link + 1, stand])
    start_ms = np.concatenate([traffic.depart_ms[link], traffic.arrive_ms[stand]])
    end_ms = np.concatenate([traffic.arrive_ms[link + 1], traffic.depart_ms[stand]])
    flight = traffic.flight[first]
    begin_ms = np.maximum(start_ms, traffic.held_from_ms[flight])
    cease_ms = np.minimum(end_ms, traffic.held_to_ms[flight])
    inside = (traffic.block >= 0) & (traffic.block < grid.block_count)
    held = np.flatnonzero((begin_ms <= cease_ms) & inside[first] & inside[to])
    centres = grid.centres(traffic.block) - (grid.origin_x_m, grid.origin_y_m, 0.0)
    way = centres[to] - centres[first]
    velocity = way / np.maximum(end_ms - start_ms, 1)[:, None]
    position = centres[first] + velocity * (begin_ms - start_ms)[:, None]
    return Legs(
        ids=traffic.ids,
        flight=flight[held],
        start_ms=begin_ms[held],
        end_ms=cease_ms[held],
        position_m=position[held],
        velocity=velocity[held],
        first_block=traffic.block[first[held]],
        last_block=traffic.block[to[held]],
        whole=((begin_ms == start_ms) & (cease_ms == end_ms))[held],
    )


def _concurrent_pairs(legs: Legs) -> int:
    """Count the pairs of flights that overlap in time."""
    flights, number = np.unique(legs.flight, return_inverse=True)
    start_ms, end_ms = np.full(len(flights), _LATEST), np.full(len(flights), -_LATEST)
    np.minimum.at(start_ms, number, legs.start_ms)
    np.maximum.at(end_ms, number, legs.end_ms)
    # Of two flights, one has started before the other ends if they are apart, and both have if they overlap.
    started_before_end = int(np.searchsorted(np.sort(start_ms), end_ms, side="right").sum()) - len(flights)
    return started_before_end - len(flights) * (len(flights) - 1) // 2


def _too_near(approach: Approach) -> Violation:
    return Violation(
        Kind.TOO_NEAR,
        approach.flights,
        approach.block,
        approach.time_ms,
        approach.time_ms,
        f"{approach.horizontal_m:.3f} m apart horizontally while {approach.vertical_m:.3f} m vertically",
    )


def _too_near_a_building(clearance: Clearance) -> Violation:
    return Violation(
        Kind.BUILDING,
        (clearance.flight,),
        clearance.block,
        clearance.time_ms,
        clearance.time_ms,
        f"{clearance.distance_m:.3f} m from building {clearance.building}",
    )
