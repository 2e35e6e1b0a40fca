"""Far more operators than the queue has places: refusals are fast, memory does not grow, and it is over at once."""

import time
from itertools import islice
from pathlib import Path
from statistics import median

import numpy as np

from tests.faults.audit import audit, book_of
from tests.faults.health import undisturbed
from tests.faults.operators import Operators
from tests.faults.serving import serving, verified
from tests.faults.traffic import Traffic
from tests.faults.verdict import Report, Verdict

_QUEUE_LIMIT = 4
_CLIENTS = 48
_OVERLOAD_S = 4.0
_FLIGHTS = 20
# Beside what is accepted meanwhile.
_GROWTH_MB = 40
_MB = 1024 * 1024


def overload(
    folder: Path, rounds: int, report: Report, *, seed: int = 5, seconds: float = _OVERLOAD_S, timed: bool = True
) -> Verdict:
    """Let many operators at a service with a short queue, who do not wait when they are asked to.

    If it is `timed`, refusals must be answered sooner than what is decided.
    """
    verdict = Verdict("overload")
    told = verdict.told
    traffic = Traffic(seed)
    ledger = folder / "ledger.sqlite"
    with serving(folder, ledger, AIRMATRIX_QUEUE_LIMIT=str(_QUEUE_LIMIT)) as service:
        verdict.broken += undisturbed(service.url, islice(traffic.all_day(), _FLIGHTS), told)
        before_mb = service.resident_bytes / _MB
        for _ in range(rounds):
            with Operators(service.url, traffic.rush(), told, _CLIENTS):
                time.sleep(seconds)
            over = time.monotonic()
            verdict.broken += undisturbed(service.url, islice(traffic.all_day(), 1), told)
            verdict.back_s.append(time.monotonic() - over)
            verdict.broken += undisturbed(service.url, islice(traffic.all_day(), _FLIGHTS), told)
            verdict.rounds += 1
            report(verdict.rounds)
        grown_mb = service.resident_bytes / _MB - before_mb
    decided_s, refused_s = told.seconds[201] + told.seconds[409], told.seconds[503]
    if not refused_s:
        verdict.broken.append("nothing was refused")
    elif timed and median(refused_s) >= median(decided_s):
        verdict.broken.append("a refusal takes as long as a decision")
    if grown_mb > _GROWTH_MB + _size_mb(ledger):
        verdict.broken.append(f"the service has grown by {grown_mb:.0f} MB")
    verdict.damage.add(audit(book_of(ledger), told))
    verdict.verify(verified(folder, ledger))
    for what, answered_s in (("decided", decided_s), ("503", refused_s)):
        verdict.remarks.append(f"{what}: {_milliseconds(answered_s)}")
    verdict.remarks.append(f"memory: {before_mb:.0f} MB before, {grown_mb:+.0f} MB after")
    return verdict


def _size_mb(ledger: Path) -> float:
    """Return what a ledger takes on the disk, which may be in memory too."""
    return sum(path.stat().st_size for path in ledger.parent.glob(f"{ledger.name}*")) / _MB


def _milliseconds(seconds: list[float]) -> str:
    if not seconds:
        return "none"
    middle, most = np.percentile(seconds, [50, 99]) * 1000
    return f"{len(seconds):,}, median {middle:.1f} ms, p99 {most:.1f} ms"
