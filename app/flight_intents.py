"""Flight intents as the service thinks of them: between the HTTP bodies and the ledger's rows."""

from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from planner.airmatrix import IntArray
from planner.path import Trajectory
from planner.submitted import SubmittedPath


class State(StrEnum):
    """States of a flight intent (ASTM F3548 names where it has them)."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"
    CANCELLED = "cancelled"
    ACTIVATED = "activated"
    NONCONFORMING = "nonconforming"
    CONTINGENT = "contingent"
    ENDED = "ended"
    DISPLACED = "displaced"


# In these a flight may be in the air, or go there.
OPEN_STATES = (State.ACCEPTED, State.ACTIVATED, State.NONCONFORMING, State.CONTINGENT)


@dataclass(frozen=True)
class Position:
    """WGS84 degrees, metres above the airspace's ground datum."""

    lon: float
    lat: float
    alt_m: float


@dataclass(frozen=True)
class Submission:
    """What an operator asks for, located: blocks are flat indices, times ms. With a `path` of its own it departs when
    that does; planned again, as late as `latest_departure_ms`. The ledger does not keep the path.
    """

    operator: str
    reference: str | None
    aircraft_type: str
    priority: int
    origin: Position
    destination: Position
    origin_block: int
    destination_block: int
    earliest_departure_ms: int
    latest_departure_ms: int
    path: SubmittedPath | None = field(default=None, compare=False)


@dataclass(frozen=True, eq=False)
class Reservations:
    """Half-open reservations [enter, exit) of one flight intent, sorted by enter, then i, j, k."""

    block: IntArray
    enter_ms: IntArray
    exit_ms: IntArray

    @classmethod
    def none(cls) -> "Reservations":
        """Return an empty set."""
        empty = np.empty(0, dtype=np.int64)
        return cls(empty, empty, empty)

    def __len__(self) -> int:
        return len(self.block)

    def until(self, end_ms: int) -> "Reservations":
        """Return what lies before a time; what covers it ends there."""
        keep = self.enter_ms < end_ms
        return Reservations(self.block[keep], self.enter_ms[keep], np.minimum(self.exit_ms[keep], end_ms))

    def beyond(self, end_ms: int) -> "Reservations":
        """Return, whole, those that last longer than until a time."""
        lasts = self.exit_ms > end_ms
        return Reservations(self.block[lasts], self.enter_ms[lasts], self.exit_ms[lasts])


@dataclass(frozen=True, eq=False)
class HeldReservations:
    """Reservations as columns, with the sequence number of the intent that holds each."""

    block: IntArray
    enter_ms: IntArray
    exit_ms: IntArray
    sequence: IntArray


@dataclass(frozen=True)
class Refusal:
    """Why a recorded intent has no plan; the conflicting intents and constraints are ids."""

    reason: str
    detail: str
    conflicting_intents: tuple[str, ...] = ()
    earliest_feasible_departure_ms: int | None = None
    conflicting_constraints: tuple[str, ...] = ()


@dataclass(frozen=True)
class Displacement:
    """What became of a flight that had to make way: how much later it departs and arrives (ms), or why it cannot."""

    sequence: int
    id: str
    operator: str
    state: State
    departure_moved_ms: int | None = None
    arrival_moved_ms: int | None = None
    reason: str | None = None


@dataclass(frozen=True, eq=False)
class FlightIntent:
    """A recorded intent, with a trajectory or, rejected or displaced, a refusal. Each change has a new `version`."""

    id: str
    sequence: int
    version: int
    state: State
    submission: Submission
    received_ms: int
    trajectory: Trajectory | None = None
    reservations: Reservations = Reservations.none()  # noqa: RUF009 -- frozen and empty
    refusal: Refusal | None = None
    activated_ms: int | None = None

    def changed(
        self, version: int, state: State, reservations: Reservations, activated_ms: int | None
    ) -> "FlightIntent":
        """Return the intent after a change."""
        return replace(self, version=version, state=state, reservations=reservations, activated_ms=activated_ms)
