"""A disk that fills up under a serving service; disks and files that cannot be written when one starts."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import chain, cycle, islice
from pathlib import Path
from shutil import copyfile, copytree

from tests.faults.audit import audit, book_of
from tests.faults.health import await_refusals, complaints_while_unwritable, seconds_until_ready, undisturbed
from tests.faults.isolation import seen_by, with_read_only_disk, with_small_disk, without_rights
from tests.faults.operators import Operators, again
from tests.faults.serving import refusal, serving, started, verified
from tests.faults.traffic import Traffic
from tests.faults.verdict import Report, Verdict

_CLIENTS = 6
_FLIGHTS = 30
_DISK_MB = 16
_FULL_FOR_S = 1.0


def full_disk(folder: Path, rounds: int, report: Report, *, seed: int = 2) -> Verdict:
    """Fill the disk under a service, see that it says so and goes on reading, and free it again."""
    verdict = Verdict("full disk")
    told = verdict.told
    traffic = Traffic(seed)
    small = folder / "small"
    small.mkdir()
    with serving(folder, small / "ledger.sqlite", inside=with_small_disk(small, _DISK_MB)) as service:
        disk = seen_by(service.process, small)
        verdict.broken += undisturbed(service.url, islice(traffic.all_day(), _FLIGHTS), told)
        for _ in range(rounds):
            _fill(disk / "filler")
            with Operators(service.url, traffic.rush(), told, _CLIENTS):
                await_refusals(told)
                time.sleep(_FULL_FOR_S)
                verdict.broken += complaints_while_unwritable(service.url, next(iter(told.accepted.values())).id)
            verdict.damage.add(audit(book_of(_as_after_a_crash(disk, folder)), told))
            (disk / "filler").unlink()
            verdict.back_s.append(seconds_until_ready(service.url))
            verdict.broken += undisturbed(service.url, chain(again(told), islice(traffic.all_day(), _FLIGHTS)), told)
            verdict.damage.add(audit(book_of(_as_after_a_crash(disk, folder)), told))
            verdict.rounds += 1
            report(verdict.rounds)
        copy = _as_after_a_crash(disk, folder)
    verdict.verify(verified(folder, copy))
    return verdict


def _fill(filler: Path) -> None:
    """Write until the disk has no page left."""
    with suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))


def _as_after_a_crash(disk: Path, folder: Path) -> Path:
    """Copy a ledger's files while nobody writes, and return the copy: what a service would find that started now."""
    for name in ("ledger.sqlite", "ledger.sqlite-wal"):
        copyfile(disk / name, folder / name)
    (folder / "ledger.sqlite-shm").unlink(missing_ok=True)
    return folder / "ledger.sqlite"


def unwritable_ledger(folder: Path, rounds: int, report: Report, *, seed: int = 3) -> Verdict:
    """Start services on ledgers that they cannot write, left by a clean end or by a crash: each must refuse to."""
    verdict = Verdict("unwritable ledger")
    clean = folder / _CLEAN
    clean.mkdir()
    with serving(folder, clean / "ledger.sqlite") as service:
        verdict.broken += undisturbed(service.url, islice(Traffic(seed).all_day(), _FLIGHTS), verdict.told)
        copytree(clean, folder / _CRASHED)
    for name, left, lock in islice(cycle(_LOCKED), rounds):
        home = folder / str(verdict.rounds)
        copytree(folder / left, home)
        before = _contents(home)
        with started(folder, home / "ledger.sqlite", inside=lock(home)) as start:
            complaints = refusal(start, str(home / "ledger.sqlite"))
        home.chmod(0o755)
        after = _contents(home)
        complaints += [] if after == before else [f"files changed, from {sorted(before)} to {sorted(after)}"]
        verdict.broken += [f"{name}, {left}: {complaint}" for complaint in complaints]
        verdict.rounds += 1
        report(verdict.rounds)
    return verdict


def _contents(home: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in home.iterdir()}


def _read_only_files(home: Path) -> Sequence[str]:
    for path in home.iterdir():
        path.chmod(0o444)
    return without_rights()


def _read_only_folder(home: Path) -> Sequence[str]:
    home.chmod(0o555)
    return without_rights()


def _read_only_files_and_folder(home: Path) -> Sequence[str]:
    _read_only_files(home)
    return _read_only_folder(home)


_CLEAN, _CRASHED = "after a clean end", "after a crash"
# After a crash SQLite can write in a folder that is read-only, because all files that it needs are there.
_LOCKED: list[tuple[str, str, Callable[[Path], Sequence[str]]]] = [
    ("files of mode 444", _CLEAN, _read_only_files),
    ("a folder of mode 555", _CLEAN, _read_only_folder),
    ("a disk mounted read-only", _CRASHED, with_read_only_disk),
    ("a disk mounted read-only", _CLEAN, with_read_only_disk),
    ("files of mode 444", _CRASHED, _read_only_files),
    ("files of mode 444 in a folder of mode 555", _CLEAN, _read_only_files_and_folder),
    ("files of mode 444 in a folder of mode 555", _CRASHED, _read_only_files_and_folder),
]
