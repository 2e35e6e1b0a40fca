"""What became of the service under a fault: one line of the campaign's table."""

from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import median

from rich.table import Table

from tests.faults.audit import Damage
from tests.faults.operators import Told

# Called with the number of rounds that are done.
Report = Callable[[float], None]


@dataclass
class Verdict:
    """`back_s`: how long the service was gone each time. `broken`: promises that did not hold; `remarks`: figures."""

    fault: str
    rounds: int = 0
    told: Told = field(default_factory=Told)
    damage: Damage = field(default_factory=Damage)
    back_s: list[float] = field(default_factory=list)
    verifications: int = 0
    unverified: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def verify(self, found: list[str]) -> None:
        """Count a verification of the ledger, and what it found."""
        self.verifications += not found
        self.unverified += found

    @property
    def wrong(self) -> list[str]:
        """Everything that must not be, in sentences."""
        return [*self.damage.sentences, *self.unverified, *self.broken]

    @property
    def cells(self) -> list[str]:
        """The line."""
        back = f"{median(self.back_s):.2f}, {max(self.back_s):.2f}" if self.back_s else ""
        verify = f"{self.verifications} x ok" if self.verifications else ""
        return [
            self.fault,
            str(self.rounds),
            f"{len(self.told.accepted):,}",
            f"{len(self.told.unrecorded):,}",
            f"{len(self.told.unknown) + len(self.told.repeated):,}",
            str(len(self.damage.lost)),
            str(len(self.damage.doubled)),
            str(len(self.damage.half_written)),
            str(len(self.damage.wrongly_answered)),
            back,
            "failed" if self.unverified else verify,
            "WRONG" if self.wrong else "ok",
        ]


def table(verdicts: list[Verdict]) -> Table:
    """Return the lines as a table."""
    drawn = Table(
        "fault", "rounds", "answered 201", "nothing recorded", "no answer", "lost", "doubled", "half written",
        "wrongly answered", "back after s (median, max)", "verify", "verdict",
        title="faults", title_justify="left", title_style="bold",
    )  # fmt: skip
    for verdict in verdicts:
        drawn.add_row(*verdict.cells)
    return drawn
