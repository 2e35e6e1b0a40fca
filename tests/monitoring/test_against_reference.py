"""Conformance and block status against their slow twin, on tiny airspaces full of random flights and positions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from hypothesis import assume, event, given, settings
from hypothesis import strategies as st

from app.block_status import Status, statuses
from app.conformance import Conformance, Thresholds, assess
from app.flight_intents import OPEN_STATES, HeldReservations, State
from app.surveillance import Aircraft, AirPicture, Flight, Path, Sighting
from planner.airmatrix import AirMatrix
from planner.airspace import Airspace, OccupancyRule
from tests.monitoring.sky import constraint
from tests.planner.traffic import EITHER_RULE, airspaces
from tests.reference.block_status import Keeping, Use, keeping, uses
from tests.reference.lattice import STEPS
from tests.reference.planning import Hold, Visit, holds_of, is_conflict_free

NOW = 0
unhurried = settings(deadline=None, max_examples=250)


@dataclass(frozen=True)
class Air:
    """An airspace, the air in it at one time, and the thresholds that it is judged by. A second takes a millisecond."""

    airspace: Airspace
    picture: AirPicture
    thresholds: Thresholds


@st.composite
def paths(draw: st.DrawFn, airspace: Airspace, departures: st.SearchStrategy[int]) -> Path:
    """Draw a walk of up to five links over free blocks to another block, with a hover here and there."""
    grid = airspace.grid
    free = np.flatnonzero(~airspace.occupied).tolist()
    blocks = [draw(st.sampled_from(free))]
    for _ in range(draw(st.integers(1, 5))):
        i, j, k = grid.block(blocks[-1])
        around = [(i + di, j + dj, k + dk) for di, dj, dk in STEPS]
        ways = [grid.index(block) for block in around if grid.contains(block) and grid.index(block) in free]
        if not ways:
            break
        blocks.append(draw(st.sampled_from(ways)))
    while len(blocks) > 1 and blocks[-1] == blocks[0]:
        blocks.pop()
    assume(len(blocks) > 1)
    time = draw(departures)
    arrive_ms, depart_ms = [], []
    for _ in blocks:
        arrive_ms.append(time)
        time += draw(st.sampled_from([0, 0, 0, 1, 5]))
        depart_ms.append(time)
        time += 2 * draw(st.integers(1, 5))
    return Path(tuple(blocks), tuple(arrive_ms), tuple(depart_ms))


@st.composite
def airs(draw: st.DrawFn) -> Air:
    """Draw the air now: flights that hold their blocks, others that were over before, positions of most, and tracks."""
    airspace = draw(airspaces(EITHER_RULE))
    thresholds = Thresholds(draw(st.integers(0, 6)), draw(st.integers(0, 3)))
    flights: dict[int, Flight] = {}
    held: list[tuple[Hold, int]] = []
    for sequence in range(1, draw(st.integers(1, 4)) + 1):
        path = draw(paths(airspace, st.integers(-20, 4)))
        holds = holds_of(visits(path), airspace.rule, airspace.grid)
        is_clear = not any(airspace.occupied[hold.block] for hold in holds)
        fits = is_clear and is_conflict_free(holds, [hold for hold, _ in held])
        flights[sequence], kept = draw(flights_on(sequence, path, holds if fits else None))
        held.extend((hold, sequence) for hold in kept)
    is_forecast = draw(st.sampled_from([False, False, False, True]))
    sightings: dict[Aircraft, Sighting] = {}
    if not is_forecast:
        for sequence in flights:
            if draw(st.sampled_from([True, True, True, False])):
                is_astray = draw(st.sampled_from([True, False, False]))
                own = [hold for hold, holder in held if is_astray or holder == sequence]
                sightings[Aircraft(sequence)] = draw(sightings_of(airspace, flights[sequence].path, own))
        for track in range(draw(st.sampled_from([0, 1, 2]))):
            sightings[Aircraft(0, f"track-{track}")] = draw(sightings_of(airspace, None, [hold for hold, _ in held]))
    columns = np.array([(*hold, sequence) for hold, sequence in held], dtype=np.int64).reshape(-1, 4).T
    closed = draw(st.lists(st.sets(st.integers(0, airspace.grid.block_count - 1), min_size=1), max_size=2))
    picture = AirPicture(
        NOW, HeldReservations(*columns), flights, sightings, is_forecast=is_forecast,
        constraints=[constraint(number, blocks) for number, blocks in enumerate(closed, start=1)],
    )  # fmt: skip
    return Air(airspace, picture, thresholds)


@st.composite
def flights_on(
    draw: st.DrawFn, sequence: int, path: Path, holds: Sequence[Hold] | None
) -> tuple[Flight, Sequence[Hold]]:
    """Draw a flight with its reservations; one that could have none is over, or was refused."""
    over = [State.CANCELLED, State.ENDED]
    state = draw(st.sampled_from([*OPEN_STATES, *OPEN_STATES, *over] if holds else [*over, State.REJECTED]))
    flight = intent(sequence, state, path, is_activated=state is not State.ACCEPTED and draw(st.booleans()))
    if state in OPEN_STATES or holds is None:
        return flight, holds or ()
    cut = draw(st.integers(-20, 20))
    return flight, [hold._replace(exit_ms=min(hold.exit_ms, cut)) for hold in holds if hold.enter_ms < cut]


@st.composite
def sightings_of(draw: st.DrawFn, airspace: Airspace, path: Path | None, holds: Sequence[Hold]) -> Sighting:
    """Draw a position: often in a block that is held about then, or at an end of the path, or anywhere."""
    time = NOW - draw(st.one_of(st.integers(0, 6), st.integers(0, 30)))
    somewhere = st.integers(0, airspace.grid.block_count - 1)
    held = [hold.block for hold in holds if hold.enter_ms - 3 <= time <= hold.exit_ms + 3]
    layer = airspace.grid.index((0, 0, 1))
    above = [(block + layer) % airspace.grid.block_count for block in held]
    likely = [*held, *held, *above, *([] if path is None else [path.blocks[0], path.blocks[-1], *path.blocks])]
    block = draw(st.one_of(st.sampled_from(likely), st.sampled_from(likely), somewhere) if likely else somewhere)
    return Sighting(
        time_ms=time, lon=103.8, lat=1.3, alt_m=20.0,
        airborne=draw(st.sampled_from([None, None, True, False])),
        block=None if draw(st.integers(0, 15)) == 0 else block,
    )  # fmt: skip


def intent(sequence: int, state: State, path: Path, *, is_activated: bool) -> Flight:
    """Return a flight; a refused one has no path."""
    return Flight(
        sequence=sequence,
        id=f"flight-{sequence}",
        version=1,
        state=state,
        operator="acme-air",
        reference=None,
        aircraft_type="dji-phantom-4",
        activated_ms=NOW - 60 if is_activated else None,
        path=None if state is State.REJECTED else path,
    )


def visits(path: Path) -> list[Visit]:
    """Return a path's stays."""
    return [Visit(*visit) for visit in zip(path.blocks, path.arrive_ms, path.depart_ms, strict=True)]


@given(airs())
@unhurried
def test_every_aircraft_and_every_block_is_judged_as_its_definition_says(air: Air) -> None:
    grid, picture, occupied = air.airspace.grid, air.picture, air.airspace.occupied
    kept = keeping(picture, grid, air.thresholds)
    # Early by as much as it is late: both are right.
    assume(all(len(how.reasons) <= 1 for how in kept.values()))
    used = uses(picture, kept, occupied)
    blocks, judged = statuses(picture, assess(picture, grid, air.thresholds), occupied)
    assert {
        aircraft: Keeping(each.own.value, frozenset(each.reasons), each.place) for aircraft, each in judged.items()
    } == kept
    assert {
        entry.block: Use(
            entry.status.value, frozenset(entry.reasons), frozenset(entry.aircraft), frozenset(entry.constraints)
        )
        for entry in blocks
    } == used
    in_red = {aircraft for aircraft, how in kept.items() if how.block in used and used[how.block].status == "red"}
    assert {aircraft for aircraft, each in judged.items() if each.conformance is Conformance.VIOLATING} == in_red
    for how in kept.values():
        event(f"{how.conformance}, {''.join(how.reasons) or 'no reason'}")
    for use in used.values():
        event(use.status)


@given(airs())
@unhurried
def test_reservations_that_are_over_or_begin_later_do_not_change_the_judgement(air: Air) -> None:
    """So a picture needs those only that lie within the freshness limit and the tolerance of its time."""
    grid, picture, occupied, thresholds = air.airspace.grid, air.picture, air.airspace.occupied, air.thresholds
    held = picture.held
    near = (held.exit_ms > NOW - thresholds.freshness_ms - thresholds.tolerance_ms) & (
        held.enter_ms <= NOW + thresholds.tolerance_ms
    )
    nearby = HeldReservations(held.block[near], held.enter_ms[near], held.exit_ms[near], held.sequence[near])
    whole = statuses(picture, assess(picture, grid, thresholds), occupied)
    part = replace(picture, held=nearby)
    assert statuses(part, assess(part, grid, thresholds), occupied) == whole


@given(st.data())
@unhurried
def test_a_flight_that_follows_its_trajectory_conforms_and_its_blocks_are_green(data: st.DataObject) -> None:
    """However old its position is, within the freshness limit, and a little early or late, within the tolerance."""
    airspace = data.draw(airspaces(EITHER_RULE))
    path = data.draw(paths(airspace, st.just(0)))
    holds = holds_of(visits(path), airspace.rule, airspace.grid)
    assume(not any(airspace.occupied[hold.block] for hold in holds))
    thresholds = Thresholds(data.draw(st.integers(0, 6)), data.draw(st.integers(0, 3)))
    flown_ms = data.draw(st.integers(path.arrive_ms[0], path.depart_ms[-1]))
    seen_ms = flown_ms + data.draw(st.integers(-thresholds.tolerance_ms, thresholds.tolerance_ms))
    now_ms = seen_ms + data.draw(st.integers(0, thresholds.freshness_ms))
    block = followed(path, airspace.grid, flown_ms, airspace.rule)
    assume(block is not None)
    sighting = Sighting(seen_ms, 103.8, 1.3, 20.0, airborne=data.draw(st.sampled_from([None, True])), block=block)
    flight = intent(1, State.ACTIVATED, path, is_activated=True)
    columns = np.array([(*hold, 1) for hold in holds], dtype=np.int64).T
    picture = AirPicture(now_ms, HeldReservations(*columns), {1: flight}, {Aircraft(1): sighting})
    blocks, judged = statuses(picture, assess(picture, airspace.grid, thresholds), airspace.occupied)
    assert judged[Aircraft(1)].conformance is Conformance.CONFORMING
    assert {entry.status for entry in blocks} <= {Status.GREEN}


def followed(path: Path, grid: AirMatrix, time_ms: int, rule: OccupancyRule) -> int | None:
    """Return the block that contains a trajectory's point at a time; None on the ground, and by the midpoint rule where
    a diagonal touches side blocks.
    """
    stays = visits(path)
    for stay in stays:
        if stay.arrive_ms <= time_ms <= stay.depart_ms:
            return stay.block
    for before, after in pairwise(stays):
        if before.depart_ms < time_ms < after.arrive_ms:
            share = (time_ms - before.depart_ms) / (after.arrive_ms - before.depart_ms)
            if share == 0.5 and rule is OccupancyRule.MIDPOINT:
                return None
            centres = grid.centres(np.array([before.block, after.block]))
            x, y, alt_m = centres[0] + share * (centres[1] - centres[0])
            side, height = grid.block_side_m, grid.block_height_m
            return grid.index((int(x // side), int(y // side), int(alt_m // height)))
    return None
