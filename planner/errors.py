"""Everything the planner can refuse, as one tree.

PlannerError
├── BuildingDataError         footprints or heights that cannot be used
├── AirspaceFileError         not an airspace file, or a damaged one
├── AircraftProfileError      an aircraft profile the speed model or the heuristic cannot accept
├── VolumeError               a polygon with altitudes that takes no blocks
├── NotPlannable              static: a property of the request; no traffic can change it
│   ├── OutsideAirspace       outside_airspace
│   ├── OriginBlocked         origin_blocked
│   ├── DestinationBlocked    destination_blocked
│   ├── SameBlock             same_block
│   └── Disconnected          disconnected
├── PathRefused               static too: an operator's own path that cannot be flown
│   ├── EntryOutside          outside_airspace
│   ├── OutOfOrder            out_of_order
│   ├── NotAChain             not_a_chain
│   ├── TooFast               too_fast
│   ├── InBuilding            in_building
│   ├── DwellTooShort         dwell_too_short
│   ├── TooLong               too_long
│   ├── BeyondEndurance       endurance_exceeded
│   ├── OutOfReach            out_of_reach
│   └── NotFlyable            not_flyable
└── NoPlan                    dynamic: a property of the traffic at that moment
    ├── NoDepartureSlot       no_departure_slot
    ├── NoConflictFreePath    no_conflict_free_path
    ├── EnduranceExceeded     endurance_exceeded
    ├── SearchTooLong         search_too_long
    └── PathConflicts         path_conflicts (in `planner.submitted`)
"""

from typing import ClassVar

Block = tuple[int, int, int]

# Who waits behind hundreds on a busy pad need not be told of all.
_MOST_FLIGHTS = 100


class PlannerError(Exception):
    """Base of every error the planner raises on purpose."""


class BuildingDataError(PlannerError):
    """Building data cannot be turned into statically occupied blocks."""


class AirspaceFileError(PlannerError):
    """A file is not an airspace file of a known version, or does not hold together."""


class AircraftProfileError(PlannerError):
    """An aircraft profile is malformed or outside what the speed model covers."""


class VolumeError(PlannerError):
    """A polygon is malformed or invalid, or lies outside the AirMatrix with its altitudes."""


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


class PathRefused(PlannerError):
    """An operator's own path cannot be flown whatever the traffic.

    `entry` is the index of the first entry that shows it, None where no single one does.
    """

    reason: ClassVar[str]

    def __init__(self, message: str, entry: int | None = None) -> None:
        super().__init__(message if entry is None else f"entry {entry}: {message}")
        self.entry = entry


class EntryOutside(PathRefused):
    """A block lies outside the AirMatrix."""

    reason = "outside_airspace"


class OutOfOrder(PathRefused):
    """An entry ends before it begins, or begins before the one ahead of it has ended."""

    reason = "out_of_order"


class NotAChain(PathRefused):
    """A block is no neighbour of the one before."""

    reason = "not_a_chain"


class TooFast(PathRefused):
    """A link takes less time than the aircraft is planned with."""

    reason = "too_fast"


class InBuilding(PathRefused):
    """A block that the flight must hold is statically occupied."""

    reason = "in_building"


class DwellTooShort(PathRefused):
    """The stay in the first or the last block is shorter than the airspace's terminal dwell."""

    reason = "dwell_too_short"


class TooLong(PathRefused):
    """From the first hold to the last lies more time than a submitted path may take."""

    reason = "too_long"


class BeyondEndurance(PathRefused):
    """The path takes longer than the aircraft can stay in the air."""

    reason = "endurance_exceeded"


class OutOfReach(PathRefused):
    """A volume that no chain of volumes leads to from where the flight departs: of no use to the aircraft."""

    reason = "out_of_reach"


class NotFlyable(PathRefused):
    """The aircraft has no way through the volumes."""

    reason = "not_flyable"


class NoPlan(PlannerError):
    """The traffic leaves no plan for this request.

    `conflicting_owners` are the owners of the reservations in the way, of flights the first hundred, and
    `earliest_feasible_departure_ms` a departure that would work, where known. `expansions` is what it took to find out.
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
        flights = [owner for owner in conflicting_owners if owner > 0]
        untold = set(flights[_MOST_FLIGHTS:])
        self.conflicting_owners = tuple(owner for owner in conflicting_owners if owner not in untold)
        self.expansions = expansions
        self.earliest_feasible_departure_ms = earliest_feasible_departure_ms


class NoDepartureSlot(NoPlan):
    """The first block is reserved or closed throughout the departure window."""

    reason = "no_departure_slot"


class NoConflictFreePath(NoPlan):
    """Departure is possible, arrival is not."""

    reason = "no_conflict_free_path"


class SearchTooLong(NoPlan):
    """No plan was found within the work that one request may take; there may be one."""

    reason = "search_too_long"


class EnduranceExceeded(NoPlan):
    """Every conflict-free plan is longer than the aircraft's endurance."""

    reason = "endurance_exceeded"
