"""Green, yellow or red: what a block's reservations say of it at one time (paper 2.1). Pure.

Without telemetry nothing is known of deviations, so every reserved block is green and the others are idle.
"""

from dataclasses import dataclass
from enum import StrEnum

from app.ledger.rows import HeldReservations


class Status(StrEnum):
    """A block's status; red beats yellow beats green."""

    GREEN = "green"
    YELLOW = "yellow"
    RED = "red"


@dataclass(frozen=True)
class BlockStatus:
    """One block in use: its status, all reasons for it, and the sequence numbers of the intents concerned."""

    block: int
    status: Status
    reasons: tuple[str, ...]
    sequences: tuple[int, ...]


def statuses(held: HeldReservations) -> list[BlockStatus]:
    """Return the blocks in use, given the reservations that cover one time; at most one a block."""
    return [
        BlockStatus(block, Status.GREEN, (), (sequence,))
        for block, sequence in zip(held.block.tolist(), held.sequence.tolist(), strict=True)
    ]
