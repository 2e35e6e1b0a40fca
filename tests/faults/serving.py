"""Services to be hurt: `airmatrix serve` on a ledger, timed, perhaps inside a wrapper; and `airmatrix verify` of it."""

import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from tests.cli import serving as cli
from tests.ledger.locations import database

_READY_WITHIN_S = 120.0
_VERIFIED_WITHIN_S = 1800.0
_POLL_S = 0.01
_starts = count(1)


@dataclass(frozen=True)
class Service:
    """A service that became ready, so many seconds after its process began."""

    url: str
    process: "subprocess.Popen[bytes]"
    log: Path
    ready_after_s: float

    def kill(self) -> None:
        """End it as a crash does."""
        self.process.kill()
        self.process.wait()

    @property
    def resident_bytes(self) -> int:
        """Its resident memory."""
        status = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        (line,) = (line for line in status if line.startswith("VmRSS:"))
        return int(line.split()[1]) * 1024


@dataclass(frozen=True)
class Start:
    """A service that was started at `since` of the monotonic clock, and logs to `log`."""

    process: "subprocess.Popen[bytes]"
    log: Path
    since: float

    def ready(self) -> Service:
        """Wait until it is ready."""
        while not (url := cli.ready_url(self.log)):
            if self.process.poll() is not None or time.monotonic() > self.since + _READY_WITHIN_S:
                raise AssertionError(f"the service did not become ready:\n{self.log.read_text()[-2000:]}")
            time.sleep(_POLL_S)
        return Service(url, self.process, self.log, time.monotonic() - self.since)


@contextmanager
def started(
    folder: Path, ledger: Path | str, *options: str, inside: Sequence[str] = (), **settings: str
) -> Iterator[Start]:
    """Start a service on any free port, inside a wrapper command if need be; it is ended if it still runs."""
    log = f"serve-{next(_starts)}.log"
    arguments = ("--port", "0", "--ledger", str(ledger), *options)
    since = time.monotonic()
    with cli.started(folder, *arguments, log=log, program=(*inside, cli.AIRMATRIX), **settings) as process:
        yield Start(process, folder / log, since)


@contextmanager
def serving(
    folder: Path, ledger: Path | str, *options: str, inside: Sequence[str] = (), **settings: str
) -> Iterator[Service]:
    """Start a service and wait until it is ready."""
    with started(folder, ledger, *options, inside=inside, **settings) as start:
        yield start.ready()


def refusal(start: Start, about: str) -> list[str]:
    """Wait for the end of a service that must not start; return what is wrong with how it does that."""
    while (status := start.process.poll()) is None:
        if cli.ready_url(start.log):
            return ["it serves"]
        if time.monotonic() > start.since + _READY_WITHIN_S:
            return ["it neither stops nor serves"]
        time.sleep(_POLL_S)
    said = [line for line in start.log.read_text().splitlines() if " [info " not in line]
    clear = len(said) == 1 and said[0].startswith("error: ") and about in said[0]
    return ([] if status == 2 else [f"exit status {status}"]) + ([] if clear else [f"it said {said}"])


def verified(folder: Path, ledger: Path | str) -> list[str]:
    """Return what `airmatrix verify` finds wrong, and SQLite itself in a file of its own."""
    done = subprocess.run(
        [cli.AIRMATRIX, "verify", "--ledger", str(ledger)],
        cwd=folder, env=cli.environment(), capture_output=True, text=True, timeout=_VERIFIED_WITHIN_S, check=False,
    )  # fmt: skip
    found = [] if done.returncode == 0 else [f"verify: exit status {done.returncode}: {done.stderr[-500:]}"]
    return found if "://" in str(ledger) else found + _damage(ledger)


def _damage(ledger: Path | str) -> list[str]:
    with database(ledger) as stranger:
        found = [sentence for (sentence,) in stranger.rows("PRAGMA integrity_check") if sentence != "ok"]
        return found + [f"foreign key: {row}" for row in stranger.rows("PRAGMA foreign_key_check")]
