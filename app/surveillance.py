"""What is known of the air at one time: flights, where aircraft were seen, what is reserved. Plain data."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from app.constraints import Constraint
from app.flight_intents import HeldReservations, State


class Aircraft(NamedTuple):
    """Whose position is known: a flight's, by its intent's sequence number, or a surveillance track's (sequence 0)."""

    sequence: int
    track_id: str = ""


class Velocity(NamedTuple):
    """Metres a second."""

    east: float
    north: float
    up: float


@dataclass(frozen=True, slots=True)
class Sighting:
    """A reported position: WGS84 degrees, metres above the ground datum. `block` is None outside the grid, `airborne`
    where nobody said; `is_implausible` marks a jump that no aircraft makes.
    """

    time_ms: int
    lon: float
    lat: float
    alt_m: float
    airborne: bool | None = None
    velocity: Velocity | None = None
    is_implausible: bool = False
    block: int | None = None


@dataclass(frozen=True, slots=True)
class Path:
    """The chain of a trajectory's blocks, each from arrival to departure in ms, as tuples: they are looked up one by
    one.
    """

    blocks: tuple[int, ...]
    arrive_ms: tuple[int, ...]
    depart_ms: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Flight:
    """What monitoring needs of a flight intent; one that was refused has no path."""

    sequence: int
    id: str
    version: int
    state: State
    operator: str
    reference: str | None
    aircraft_type: str
    activated_ms: int | None
    path: Path | None

    @property
    def departure_ms(self) -> int | None:
        """Start of the first hold."""
        return None if self.path is None else self.path.arrive_ms[0]

    @property
    def arrival_ms(self) -> int | None:
        """End of the last hold, dwell included."""
        return None if self.path is None else self.path.depart_ms[-1]


@dataclass(frozen=True, slots=True)
class Remark:
    """What was last recorded of an aircraft that did not simply conform: since when, and since when it has not
    conformed at all.
    """

    conformance: str
    reasons: tuple[str, ...]
    since_ms: int
    raised_ms: int


@dataclass(frozen=True)
class Reach:
    """How much of the time around it belongs to a picture, in ms.

    `before_ms` and `after_ms` bound its reservations, `before_ms` also how old a new position can be; flights that
    depart within `due_ms` and tracks that were seen within `track_ms` are in it.
    """

    before_ms: int
    after_ms: int
    due_ms: int
    track_ms: int


@dataclass(frozen=True, eq=False)
class AirPicture:
    """The air at one time. `held` are the reservations from shortly before it until shortly after it, `constraints`
    those in force at it.

    Where `is_forecast`, no positions are known, for the time lies ahead or they are no longer kept: nobody is missed.
    """

    at_ms: int
    held: HeldReservations
    flights: Mapping[int, Flight]
    sightings: Mapping[Aircraft, Sighting] = field(default_factory=dict)
    remarks: Mapping[Aircraft, Remark] = field(default_factory=dict)
    is_forecast: bool = False
    constraints: Sequence[Constraint] = ()
