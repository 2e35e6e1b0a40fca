"""How the search's work grows, counted in expansions and interval visits, never in seconds."""

from collections.abc import Iterable, Iterator

import numpy as np
import pytest

from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Planner, PlanRequest, Search
from planner.errors import NoConflictFreePath, NoDepartureSlot, SearchTooLong
from planner.path import Plan
from tests.planner.drawing import airspace_of
from tests.planner.traffic import flight, planner_in, reserve
from tests.reference.planning import Hold, link_times

HOUR_MS = 3_600_000
TIMES = link_times(horizontal=1000, diagonal=1414, vertical=4000, alpha=4200, beta=4400)
SIDE, LAYERS = 30, 2


def district(side: int = SIDE) -> Airspace:
    """A square of towers on every third block of the lower layer."""
    layers = np.zeros((LAYERS, side, side), dtype=np.bool_)
    layers[0, 1::3, 1::3] = True
    return airspace_of((side, side, LAYERS), layers.ravel(), rule=OccupancyRule.CONTAINMENT, terminal_dwell_ms=0)


def open_air(count_i: int, count_j: int, count_k: int) -> Airspace:
    """Blocks without any building."""
    nothing = np.zeros(count_i * count_j * count_k, dtype=np.bool_)
    return airspace_of((count_i, count_j, count_k), nothing, rule=OccupancyRule.CONTAINMENT, terminal_dwell_ms=0)


def random_flights(airspace: Airspace, hour: int, count: int) -> Iterator[PlanRequest]:
    """Yield the same flights, up to the hour in which they go, whichever hour it is."""
    random = np.random.default_rng(1)
    free = np.flatnonzero(~airspace.occupied)
    for _ in range(count):
        origin, destination = random.choice(free, 2, replace=False).tolist()
        start = hour * HOUR_MS + int(random.integers(HOUR_MS))
        yield flight(origin, destination, earliest=start, latest=start + 300_000, times=TIMES)


def commit(planner: Planner, requests: Iterable[PlanRequest]) -> None:
    for request in requests:
        plan = planner.plan(request)
        planner.index.reserve(plan.hold_block, plan.hold_enter_ms, plan.hold_exit_ms, 1)


def work(plans: Iterable[Plan]) -> tuple[int, int]:
    """Return expansions and interval visits in all."""
    counted = [(plan.expansions, plan.interval_visits) for plan in plans]
    return sum(expansions for expansions, _ in counted), sum(visits for _, visits in counted)


@pytest.mark.compiled
def test_reservations_at_other_hours_cost_a_plan_nothing() -> None:
    airspace = district()
    hour = 4
    alone, among_others = Planner(airspace), Planner(airspace)
    commit(alone, random_flights(airspace, hour, 150))
    for other in range(9):
        commit(among_others, random_flights(airspace, other, 150))
    assert len(among_others.index) == 9 * len(alone.index)
    further = list(random_flights(airspace, hour, 200))[150:]
    assert work(alone.plan(request) for request in further) == work(among_others.plan(request) for request in further)


def test_far_reservations_of_the_blocks_on_the_way_cost_a_plan_nothing() -> None:
    airspace = open_air(20, 1, 1)
    empty, booked = planner_in(airspace), planner_in(airspace)
    # Every other block is always free, so a flight could wait there for each later gap of its neighbours.
    for block in range(1, 19, 2):
        far = (Hold(block, day * 24 * HOUR_MS, day * 24 * HOUR_MS + 1) for day in range(1, 50))
        reserve(booked, far, owner=1)
    request = flight(0, 19, times=TIMES)
    assert booked.plan(request).expansions == empty.plan(request).expansions
    assert booked.plan(request).interval_visits == empty.plan(request).interval_visits


def test_with_room_a_flight_takes_expansions_in_proportion_to_its_length() -> None:
    def expansions(side: int) -> int:
        return Planner(open_air(side, side, 3)).plan(flight(0, side * (side - 4) - 1, times=TIMES)).expansions

    lengths = [20, 40, 80]
    assert [expansions(side) <= 3 * side for side in lengths] == [True] * 3


@pytest.mark.parametrize("yard_around", ["destination", "origin"])
def test_a_detour_that_shows_only_at_one_end_is_not_paid_for_all_the_way(yard_around: str) -> None:
    """A roofed yard around one end: the lattice distance is too short by the same everywhere outside."""

    def expansions(side: int) -> int:
        layers = np.zeros((LAYERS, side, side), dtype=np.bool_)
        yard = layers[0, -9:-2, -9:-2]
        yard[:] = True
        yard[1:-1, 1:-1] = False
        yard[-1, 3] = False
        layers[1, -9:-2, -9:-2] = True
        airspace = airspace_of(
            (side, side, LAYERS), layers.ravel(), rule=OccupancyRule.CONTAINMENT, terminal_dwell_ms=0
        )
        ends = [0, (side - 6) * side + side - 6]
        if yard_around == "origin":
            ends.reverse()
        return Planner(airspace).plan(flight(*ends, times=TIMES)).expansions

    # Four times the way, sixteen times the area.
    assert expansions(160) <= 6 * expansions(40)


def test_a_destination_reserved_for_an_hour_costs_a_few_expansions_not_the_whole_district() -> None:
    airspace = district()
    destination = airspace.grid.index((SIDE - 1, SIDE - 1, 0))
    request = flight(0, destination, times=TIMES)
    free = planner_in(airspace).plan(request)
    waiting = planner_in(airspace, [Hold(destination, 0, HOUR_MS)]).plan(request)
    assert waiting.arrival_ms >= HOUR_MS
    assert waiting.expansions <= 3 * free.expansions


def test_a_destination_in_a_closed_volume_costs_its_surroundings_not_the_whole_district() -> None:
    airspace = district()
    i, j, k = (axis.ravel() for axis in np.meshgrid(*map(np.arange, airspace.grid.dimensions), indexing="ij"))
    closed = [
        (i, j, k)
        for i, j, k in zip(i.tolist(), j.tolist(), k.tolist(), strict=True)
        if max(abs(i - 15), abs(j - SIDE // 2)) <= 8
    ]
    request = flight(SIDE * (SIDE // 2 + 1) - 1, airspace.grid.index((15, SIDE // 2, 0)), times=TIMES)
    waiting = planner_in(airspace, [Hold(airspace.grid.index(block), 0, HOUR_MS) for block in closed]).plan(request)
    assert waiting.arrival_ms >= HOUR_MS
    # Less than what is closed, 578 blocks, of 1,800.
    assert waiting.expansions <= 300


def test_a_dive_that_misses_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the busy blocks around the destination nobody can land for another minute: the dive cannot know that."""
    airspace = district()
    destination = airspace.grid.index((SIDE - 1, SIDE - 1, 1))
    planner = planner_in(airspace, shut_for_a_minute(airspace, destination))
    request = flight(0, destination, latest=HOUR_MS, times=TIMES)
    dive = planner.plan(request)
    monkeypatch.setattr("planner.cfa_star._DIVE", 100)
    other = planner.plan(request)
    assert other.arrival_ms == dive.arrival_ms
    assert other.expansions < dive.expansions / 2


def shut_for_a_minute(airspace: Airspace, destination: int) -> list[Hold]:
    """Reserve all around a corner of the upper layer from when that is free: what no bound of the arrival foresees."""
    i, j, k = airspace.grid.block(destination)
    around = [(-1, 0, 0), (0, -1, 0), (0, 0, -1), (-1, 0, -1), (0, -1, -1), (-1, -1, 0), (-1, -1, -1)]
    shut = [Hold(airspace.grid.index((i + x, j + y, k + z)), HOUR_MS, HOUR_MS + 60_000) for x, y, z in around]
    return [Hold(destination, 0, HOUR_MS), *shut]


def test_to_look_again_for_a_later_departure_costs_little_more() -> None:
    """All around the destination is reserved for a minute once that is free; somebody else comes to the origin."""
    airspace = district()
    origin, destination = airspace.grid.index((SIDE - 1, 0, 0)), airspace.grid.index((SIDE - 1, SIDE - 1, 1))
    shut = shut_for_a_minute(airspace, destination)
    planner = planner_in(airspace, [*shut, Hold(origin, 10_000, HOUR_MS - 20_000)])
    request = flight(origin, destination, latest=HOUR_MS, times=TIMES)
    first = planner.plan(request)
    planner.detour_limit_ms = 60_000
    later = planner.plan(request)
    assert later.departure_ms > first.departure_ms
    assert later.arrival_ms == first.arrival_ms > HOUR_MS + 60_000
    assert first.expansions < later.expansions <= first.expansions + 100


def test_proof_that_there_is_no_path_is_as_short_as_what_shuts_the_flight_in() -> None:
    """All around the origin is reserved until its own free interval is over."""
    airspace = district()
    grid = airspace.grid
    origin, destination = grid.index((0, 0, 0)), grid.index((SIDE - 1, SIDE - 1, 1))
    corner = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1), (1, 1, 1)]
    shut = [Hold(grid.index(block), 0, 10_000) for block in corner]
    planner = planner_in(airspace, [*shut, Hold(origin, 9_000, 20_000)])
    with pytest.raises(NoConflictFreePath) as refusal:
        planner.plan(flight(origin, destination, times=TIMES), outlook=False)
    with_path = planner.plan(flight(origin, destination, latest=30_000, times=TIMES))
    assert with_path.departure_ms == 20_000
    assert refusal.value.expansions <= with_path.expansions


@pytest.mark.parametrize("search", Search)
def test_a_request_takes_no_more_work_than_it_may(search: Search) -> None:
    airspace = district()
    ends = (0, SIDE * SIDE - 1)
    whole = planner_in(airspace, search=search).plan(flight(*ends, times=TIMES))
    needed = whole.expansions - whole.static_expansions
    planner = planner_in(airspace, search=search)
    planner.most_expansions = needed
    # Again and again: each request may take as much.
    assert [planner.plan(flight(*ends, times=TIMES)).arrival_ms for _ in range(3)] == [whole.arrival_ms] * 3
    planner.most_expansions = needed - 1
    with pytest.raises(SearchTooLong) as refusal:
        planner.plan(flight(*ends, times=TIMES))
    assert refusal.value.earliest_feasible_departure_ms is None
    assert refusal.value.expansions == whole.expansions - 1


def test_the_look_for_a_later_departure_takes_what_is_left_of_the_work() -> None:
    airspace = district()
    origin, destination = 0, SIDE * SIDE - 1
    request = flight(origin, destination, times=TIMES)
    planner = planner_in(airspace, [Hold(origin, 0, HOUR_MS)])
    with pytest.raises(NoDepartureSlot) as refusal:
        planner.plan(request)
    assert refusal.value.earliest_feasible_departure_ms == HOUR_MS
    planner.most_expansions = SIDE // 2
    with pytest.raises(NoDepartureSlot) as refusal:
        planner.plan(request)
    assert refusal.value.earliest_feasible_departure_ms is None


def test_a_workspace_that_grows_takes_none_of_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("planner.cfa_star._FEWEST_LABELS", 64)
    airspace = district()
    destination = airspace.grid.index((SIDE - 1, SIDE - 1, 1))
    planner = planner_in(airspace, shut_for_a_minute(airspace, destination))
    request = flight(0, destination, latest=HOUR_MS, times=TIMES)
    first = planner.plan(request)
    planner.most_expansions = first.expansions - first.static_expansions
    again = planner.another()
    labels = len(again._workspace.labels)
    assert again.plan(request, planner.index).arrival_ms == first.arrival_ms
    assert len(again._workspace.labels) > labels
