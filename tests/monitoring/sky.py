"""A small sky drawn in ASCII, and how a moment in it is judged. Times are seconds since most flights depart."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from app.block_status import statuses
from app.conformance import Assessment, Thresholds, assess
from app.constraints import Constraint
from app.flight_intents import HeldReservations, State
from app.surveillance import Aircraft, AirPicture, Flight, Path, Sighting, Velocity
from planner.airmatrix import AirMatrix
from planner.airspace import OccupancyRule
from tests.planner.drawing import drawn
from tests.reference.planning import Visit, holds_of

START_MS = 1_795_334_400_000  # 2026-11-22T08:00:00Z

# Two layers, a street from A to E below one from a to e; a house south of C.
CITY = drawn(
    """
    ..N..
    ABCDE
    ..#..
    """,
    """
    .....
    abcde
    .....
    """,
)

Who = int | str


def ms(seconds: float) -> int:
    """Return a time of day in ms."""
    return START_MS + round(seconds * 1000)


def aircraft(who: Who) -> Aircraft:
    """Return the aircraft of the flight with this sequence number, or of a track."""
    return Aircraft(who) if isinstance(who, int) else Aircraft(0, who)


def path(signs: str, *, departure: float = 0, link: float = 10, hover: Mapping[str, float] | None = None) -> Path:
    """Return a path along blocks given by their signs, `link` seconds apart, with some seconds of hovering in a few."""
    arrive_ms, depart_ms, time = [], [], departure
    for sign in signs:
        arrive_ms.append(ms(time))
        time += (hover or {}).get(sign, 0)
        depart_ms.append(ms(time))
        time += link
    return Path(tuple(CITY[sign] for sign in signs), tuple(arrive_ms), tuple(depart_ms))


def flight(
    way: Path | str | None, *, sequence: int = 1, state: State = State.ACTIVATED, activated: bool | None = None
) -> Flight:
    """Return a flight along a path; activated unless its state tells otherwise; None: it was refused."""
    if activated is None:
        activated = state is not State.ACCEPTED
    return Flight(
        sequence=sequence,
        id=f"flight-{sequence}",
        version=1,
        state=state,
        operator="acme-air",
        reference=None,
        aircraft_type="dji-phantom-4",
        activated_ms=ms(-60) if activated else None,
        path=path(way) if isinstance(way, str) else way,
    )


def at(sign: str | None, time: float, *, airborne: bool | None = None, velocity: Velocity | None = None) -> Sighting:
    """Return a position in the middle of a block, or outside the grid."""
    return Sighting(
        time_ms=ms(time), lon=103.8, lat=1.3, alt_m=20.0, airborne=airborne, velocity=velocity,
        block=None if sign is None else CITY[sign],
    )  # fmt: skip


def reserved(
    flights: Iterable[Flight], grid: AirMatrix, rule: OccupancyRule = OccupancyRule.CONTAINMENT
) -> HeldReservations:
    """Return what flights hold under an occupancy rule."""
    rows = [(*hold, flight.sequence) for flight in flights if flight.path is not None for hold in holds_of(
        [Visit(*visit) for visit in zip(flight.path.blocks, flight.path.arrive_ms, flight.path.depart_ms, strict=True)],
        rule, grid,
    )]  # fmt: skip
    block, enter_ms, exit_ms, sequence = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    return HeldReservations(block, enter_ms, exit_ms, sequence)


def constraint(number: int, blocks: Iterable[int]) -> Constraint:
    """Return a constraint that closes some blocks for good."""
    square: dict[str, Any] = {"type": "Polygon", "coordinates": []}
    closed = np.array(sorted(blocks), dtype=np.int64)
    return Constraint(number, f"constraint-{number}", "closed", square, 0.0, None, 0, None, closed, 0)


class Moment:
    """One moment over the city: what flies, where it was seen, and how blocks and aircraft are judged.

    `seen` says who was seen where: the flight with a sequence number, or a track.
    All flights hold their blocks, except those whose sequence numbers are in `released`; `closed` are the signs of the
    blocks that constraints close, a word for each.
    """

    def __init__(
        self,
        time: float,
        flights: Sequence[Flight] = (),
        seen: Mapping[Any, Sighting] | None = None,
        *,
        rule: OccupancyRule = OccupancyRule.CONTAINMENT,
        released: Sequence[int] = (),
        thresholds: Thresholds | None = None,
        is_forecast: bool = False,
        closed: Sequence[str] = (),
    ) -> None:
        airspace = CITY.airspace
        picture = AirPicture(
            at_ms=ms(time),
            held=reserved([each for each in flights if each.sequence not in released], airspace.grid, rule),
            flights={each.sequence: each for each in flights},
            sightings={aircraft(who): sighting for who, sighting in (seen or {}).items()},
            is_forecast=is_forecast,
            constraints=[
                constraint(number, [CITY[sign] for sign in signs]) for number, signs in enumerate(closed, start=1)
            ],
        )
        assessed = assess(picture, airspace.grid, thresholds or Thresholds())
        self.blocks, self._assessed = statuses(picture, assessed, airspace.occupied)

    def __getitem__(self, sign: str) -> tuple[str, ...] | None:
        """Return a block's status and then its reasons, None where it is idle."""
        return next((
            (entry.status.value, *entry.reasons) for entry in self.blocks if entry.block == CITY[sign]
        ), None)  # fmt: skip

    def concerned(self, sign: str) -> list[Aircraft]:
        """Return the aircraft that a block's status names."""
        (entry,) = (entry for entry in self.blocks if entry.block == CITY[sign])
        return list(entry.aircraft)

    def closes(self, sign: str) -> tuple[str, ...]:
        """Return the ids of the constraints that a block's status names."""
        (entry,) = (entry for entry in self.blocks if entry.block == CITY[sign])
        return entry.constraints

    def of(self, who: Who) -> Assessment:
        """Return the assessment of an aircraft."""
        return self._assessed[aircraft(who)]

    def says(self, who: Who) -> tuple[str, ...]:
        """Return an aircraft's conformance and then its reasons."""
        return self.of(who).conformance.value, *self.of(who).all_reasons
