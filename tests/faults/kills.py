"""`kill -9` at random moments, under load and during start-up, on one ledger that grows; of all, or of one worker."""

import os
import random
import signal
import time
from itertools import islice
from pathlib import Path
from statistics import median

from tests.cli import serving as cli
from tests.faults.audit import audit, book_of
from tests.faults.health import undisturbed
from tests.faults.operators import Operators, again
from tests.faults.serving import serving, started, verified
from tests.faults.traffic import Traffic
from tests.faults.verdict import Report, Verdict

_CLIENTS = 12
_LOAD_S = 0.6
_VERIFY_EVERY = 20
_FLIGHTS_AT_ONCE = 100
_WORKERS = 3
_REPLACED_WITHIN_S = 60.0


def kill(
    folder: Path,
    rounds: int,
    report: Report,
    *,
    ledger: str | None = None,
    reservations: int = 100_000,
    seed: int = 1,
) -> Verdict:
    """Kill a service again and again on one ledger, which holds so many reservations from the beginning.

    In one of three rounds it dies before it is ready. After every other start the whole ledger is compared with all
    that operators were ever told, and requests that nobody answered are asked again with the same keys.
    """
    verdict = Verdict("kill -9" if ledger is None else "kill -9, on PostgreSQL")
    told = verdict.told
    traffic, chance = Traffic(seed), random.Random(seed)
    ledger = ledger or str(folder / "ledger.sqlite")
    with serving(folder, ledger) as service:
        flights = traffic.all_day()
        before = 0
        while before < reservations:
            with Operators(service.url, islice(flights, _FLIGHTS_AT_ONCE), told, _CLIENTS) as operators:
                operators.wait()
            before = len(book_of(ledger).holds)
        service.kill()
    for number in range(rounds):
        with started(folder, ledger) as start:
            if number % 3 == 1:
                time.sleep(chance.uniform(0, median(verdict.back_s)))
                start.process.kill()
            else:
                service = start.ready()
                verdict.back_s.append(service.ready_after_s)
                verdict.damage.add(audit(book_of(ledger), told))
                with (
                    Operators(service.url, again(told), told, _CLIENTS),
                    Operators(service.url, traffic.rush(), told, _CLIENTS),
                ):
                    time.sleep(chance.uniform(0, _LOAD_S))
                    service.kill()
        verdict.rounds += 1
        if verdict.rounds % _VERIFY_EVERY == 0:
            verdict.verify(verified(folder, ledger))
        report(verdict.rounds)
    with serving(folder, ledger) as service, Operators(service.url, again(told), told, clients=1) as operators:
        verdict.back_s.append(service.ready_after_s)
        operators.wait()
    verdict.damage.add(audit(book_of(ledger), told))
    verdict.verify(verified(folder, ledger))
    after = len(book_of(ledger).holds)
    verdict.remarks.append(
        f"{before:,} reservations at the first start, ready after {verdict.back_s[0]:.2f} s; "
        f"{after:,} at the last, {verdict.back_s[-1]:.2f} s"
    )
    return verdict


def kill_workers(folder: Path, rounds: int, report: Report, *, seed: int = 10) -> Verdict:
    """Kill one of several worker processes again and again, while the others go on."""
    verdict = Verdict("kill -9 of a worker")
    told = verdict.told
    traffic, chance = Traffic(seed), random.Random(seed)
    ledger = folder / "ledger.sqlite"
    with serving(folder, ledger, "--workers", str(_WORKERS), AIRMATRIX_LOG_FORMAT="json") as service:
        parent = cli.Server(service.url, folder, service.log, service.process)
        for _ in range(rounds):
            with Operators(service.url, traffic.rush(), told, _CLIENTS):
                time.sleep(chance.uniform(0, _LOAD_S))
                victim = chance.choice(sorted(parent.workers()))
                os.kill(victim, signal.SIGKILL)
                verdict.back_s.append(_seconds_until_replaced(parent, victim))
            verdict.damage.add(audit(book_of(ledger), told))
            verdict.broken += undisturbed(service.url, again(told), told)
            verdict.rounds += 1
            report(verdict.rounds)
        verdict.damage.add(audit(book_of(ledger), told))
    verdict.verify(verified(folder, ledger))
    return verdict


def _seconds_until_replaced(parent: cli.Server, victim: int) -> float:
    since = time.monotonic()
    while len(parent.workers() - {victim}) < _WORKERS:
        if time.monotonic() > since + _REPLACED_WITHIN_S:
            raise AssertionError("no other worker became ready")
        time.sleep(0.01)
    return time.monotonic() - since
