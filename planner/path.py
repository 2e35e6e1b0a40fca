"""A plan: the path of one flight in space and time, and the holds it asks for."""

from dataclasses import dataclass, field

from planner.airmatrix import IntArray


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A flight's path. Times are int64 ms, blocks flat indices.

    `block`, `arrive_ms`, `depart_ms` (n,): the chain of block centres; the first arrival is the departure, the last
    departure the arrival, terminal dwell included. `unconstrained_ms` is the flight time without traffic. One that
    `is_submitted` was made by the operator: its links may take longer than the aircraft is planned with.
    """

    block: IntArray
    arrive_ms: IntArray
    depart_ms: IntArray
    unconstrained_ms: int
    terminal_dwell_ms: int
    is_submitted: bool = field(default=False, kw_only=True)

    @property
    def departure_ms(self) -> int:
        """Start of the first hold."""
        return int(self.arrive_ms[0])

    @property
    def arrival_ms(self) -> int:
        """End of the last hold, landing dwell included."""
        return int(self.depart_ms[-1])

    @property
    def flight_time_ms(self) -> int:
        """Arrival minus departure."""
        return self.arrival_ms - self.departure_ms

    @property
    def hover_ms(self) -> int:
        """Wait at block centres in flight, terminal dwell excluded."""
        return int((self.depart_ms - self.arrive_ms).sum()) - 2 * self.terminal_dwell_ms


@dataclass(frozen=True, eq=False)
class Plan(Trajectory):
    """A conflict-free path and what the search knows of it.

    `hold_*` (m,): half-open holds [enter, exit), overlapping ones of a block merged, sorted by enter, then i, j, k.
    `slot_opens_ms` is the first moment, from the earliest departure on, of the free interval of the first block in
    which the flight departs. `expansions` counts both searches', `static_expansions` those of the one without
    traffic; `interval_visits` the reservations and free intervals that the one with traffic looked at.
    """

    hold_block: IntArray
    hold_enter_ms: IntArray
    hold_exit_ms: IntArray
    earliest_departure_ms: int
    slot_opens_ms: int
    expansions: int
    static_expansions: int
    interval_visits: int

    @property
    def ground_hold_ms(self) -> int:
        """Wait before departure, which holds no block."""
        return self.departure_ms - self.earliest_departure_ms

    @property
    def delay_ms(self) -> int:
        """Arrival minus what it would be without traffic."""
        return self.arrival_ms - self.earliest_departure_ms - self.unconstrained_ms
