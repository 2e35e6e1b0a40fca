"""Everything the planner can refuse, as one tree.

PlannerError
├── BuildingDataError         footprints or heights that cannot be used
├── AirspaceFileError         not an airspace file, or a damaged one
├── AircraftProfileError      an aircraft profile the speed model or the heuristic cannot accept
├── NotPlannable              static: a property of the request; no traffic can change it
│   ├── OutsideAirspace       outside_airspace
│   ├── OriginBlocked         origin_blocked
│   ├── DestinationBlocked    destination_blocked
│   ├── SameBlock             same_block
│   └── Disconnected          disconnected
└── NoPlan                    dynamic: a property of the traffic at that moment
    ├── NoDepartureSlot       no_departure_slot
    ├── NoConflictFreePath    no_conflict_free_path
    └── EnduranceExceeded     endurance_exceeded
"""

from typing import ClassVar

Block = tuple[int, int, int]


class PlannerError(Exception):
    """Base of every error the planner raises on purpose."""


class BuildingDataError(PlannerError):
    """Building data cannot be turned into statically occupied blocks."""


class AirspaceFileError(PlannerError):
    """A file is not an airspace file of a known version, or does not hold together."""


class AircraftProfileError(PlannerError):
    """An aircraft profile is malformed or outside what the speed model covers."""


class NotPlannable(PlannerError):
    """No plan can exist whatever the traffic; `nearest_free_block` helps where the cause is a building."""

    reason: ClassVar[str]

    def __init__(self, message: str, nearest_free_block: Block | None = None) -> None:
        super().__init__(message)
        self.nearest_free_block = nearest_free_block


class OutsideAirspace(NotPlannable):
    """A position lies outside the AirMatrix."""

    reason = "outside_airspace"


class OriginBlocked(NotPlannable):
    """The origin lies in a statically occupied block."""

    reason = "origin_blocked"
    end = "the origin lies"


class DestinationBlocked(NotPlannable):
    """The destination lies in a statically occupied block."""

    reason = "destination_blocked"
    end = "the destination lies"


class SameBlock(NotPlannable):
    """Origin and destination lie in one block."""

    reason = "same_block"


class Disconnected(NotPlannable):
    """Buildings leave no chain of links from origin to destination."""

    reason = "disconnected"


class NoPlan(PlannerError):
    """The traffic leaves no plan for this request.

    `conflicting_owners` are the owners of the reservations in the way and `earliest_feasible_departure_ms` a
    departure that would work, where known. `expansions` is what it took to find out.
    """

    reason: ClassVar[str]

    def __init__(
        self,
        message: str,
        conflicting_owners: tuple[int, ...] = (),
        earliest_feasible_departure_ms: int | None = None,
        expansions: int = 0,
    ) -> None:
        super().__init__(message)
        self.conflicting_owners = conflicting_owners
        self.expansions = expansions
        self.earliest_feasible_departure_ms = earliest_feasible_departure_ms


class NoDepartureSlot(NoPlan):
    """The first block is reserved throughout the departure window."""

    reason = "no_departure_slot"


class NoConflictFreePath(NoPlan):
    """Departure is possible, arrival is not."""

    reason = "no_conflict_free_path"


class EnduranceExceeded(NoPlan):
    """Every conflict-free plan is longer than the aircraft's endurance."""

    reason = "endurance_exceeded"
