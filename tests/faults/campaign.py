"""`make faults`: break the service in every way that can be made here, and compare what it said with what it holds.

Each line of the table is a fault. Columns:
  lost              answered 201 (or a recorded 409, or 200 to a cancellation), but not so in the ledger
  doubled           recorded twice, or a block reserved twice
  half written      intents, reservations, journal and counters that do not fit together
  wrongly answered  "nothing was recorded", but it was; or an answer that should not exist
  no answer         the connection broke, or the answer was that nobody knows; asked again with the same key
"""

import argparse
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import mkdtemp
from typing import Never

import structlog
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from planner.warm_up import warm_up
from tests.faults import clocks, databases, disks, kills, overload, raising, strangers
from tests.faults.isolation import Unavailable
from tests.faults.verdict import Report, Verdict, table
from tests.ledger.locations import SqliteLedgers
from tests.postgres import Cluster, NoPostgres, cluster

_WIDTH = 190
_SHOWN = 10
_INTERRUPTED = 130

Fault = Callable[[Path, int, Report], Verdict]


def _on_postgresql(fault: Callable[[Path, int, Report, Cluster], Verdict]) -> Fault:
    """Return a fault that gets a server of its own, whose commits are durable."""

    def run(folder: Path, rounds: int, report: Report) -> Verdict:
        with cluster(durable=True) as server:
            return fault(folder, rounds, report, server)

    return run


# What may be chosen, and how many rounds each fault has by default.
PARTS: dict[str, list[tuple[Fault, int]]] = {
    "kill": [(kills.kill, 200)],
    "worker": [(kills.kill_workers, 20)],
    "disk": [(disks.full_disk, 5), (disks.unwritable_ledger, 7)],
    "stranger": [
        (strangers.another_airspace, 5),
        (strangers.two_airspaces_at_once, 10),
        (strangers.lock_held, 2),
        (strangers.file_taken_away, 6),
    ],
    "overload": [(overload.overload, 3)],
    "clock": [(lambda folder, *rest: clocks.clock_steps(SqliteLedgers(folder), *rest), 200)],
    "raising": [(lambda folder, *rest: raising.raising(SqliteLedgers(folder), *rest), 400)],
    "postgres": [
        (_on_postgresql(databases.service_killed), 20),
        (_on_postgresql(databases.crashes), 20),
        (_on_postgresql(databases.restarts), 20),
        (_on_postgresql(databases.connections_cut), 10),
        (_on_postgresql(databases.commits_cut), 16),
    ],
}


@dataclass
class Campaign:
    """What has come of the faults so far."""

    verdicts: list[Verdict] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def run(self, part: str, fault: Fault, rounds: int) -> None:
        """Make a fault; what it leaves on the disk is kept if anything was wrong."""
        folder = Path(mkdtemp(prefix=f"airmatrix-{part}-"))
        with _progress(part, rounds) as report:
            try:
                verdict = fault(folder, rounds, report)
            except (Unavailable, NoPostgres) as error:
                self.skipped.append(f"{part}: {error}")
                shutil.rmtree(folder)
                return
            except Exception as error:
                verdict = Verdict(part, broken=[f"the campaign could not go on: {error}"])
        self.verdicts.append(verdict)
        if verdict.wrong:
            verdict.remarks.append(f"what is left of it is in {folder}")
        else:
            shutil.rmtree(folder)

    def show(self) -> None:
        """Print the table, what is worth knowing beside it, and what is wrong."""
        console = Console(width=_WIDTH, highlight=False, markup=False, emoji=False)
        console.print(table(self.verdicts))
        for verdict in self.verdicts:
            for remark in verdict.remarks:
                console.print(f"{verdict.fault}: {remark}")
            for sentence in verdict.wrong[:_SHOWN]:
                console.print(f"WRONG: {verdict.fault}: {sentence}")
        for reason in self.skipped:
            console.print(f"skipped: {reason}")


def main() -> None:
    """Run the chosen parts, by default all; exit with 1 if anything is wrong."""
    parser = argparse.ArgumentParser(
        prog="faults", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="part", help=f"{', '.join(PARTS)}; default: all")
    parser.add_argument("--rounds", type=int, help="how often each fault is made; default: see PARTS")
    options = parser.parse_args()
    if unknown := sorted(set(options.parts) - set(PARTS)):
        parser.error(f"unknown part {unknown[0]!r}; there are {', '.join(PARTS)}")
    if options.rounds is not None and options.rounds < 1:
        parser.error("--rounds must be at least 1")
    structlog.configure(processors=[_drop])
    warm_up()
    campaign = Campaign()
    try:
        for part in options.parts or PARTS:
            for fault, rounds in PARTS[part]:
                campaign.run(part, fault, options.rounds or rounds)
    except KeyboardInterrupt:
        campaign.show()
        sys.exit(_INTERRUPTED)
    campaign.show()
    sys.exit(any(verdict.wrong for verdict in campaign.verdicts))


@contextmanager
def _progress(what: str, total: int) -> Iterator[Report]:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)


def _drop(*_: object) -> Never:
    """Log nothing of the processes that run in this one."""
    raise structlog.DropEvent


if __name__ == "__main__":
    main()
