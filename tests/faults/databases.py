"""PostgreSQL that crashes, restarts and loses connections under load, in the middle of commits too."""

import random
import time
from collections import Counter
from collections.abc import Callable
from itertools import chain, islice
from pathlib import Path
from urllib.parse import urlsplit

from tests.faults.audit import audit, book_of
from tests.faults.health import seconds_until_ready, undisturbed
from tests.faults.kills import kill
from tests.faults.operators import Operators, again
from tests.faults.serving import serving, verified
from tests.faults.traffic import Traffic
from tests.faults.verdict import Report, Verdict
from tests.faults.wire import wire
from tests.postgres import Cluster

_SEED = 8
_CLIENTS = 8
_FLIGHTS = 20
_RESERVATIONS = 20_000
_LOAD_S = 0.4
_CUTTING_S = 1.2
_CUT_OF_COMMITS = 0.3
_CUT_EVERY_S = 0.05
# Longer than the service looks for what became of a commit.
_DOWN_S = 12.0
_DOWN_EVERY = 4
_OUR_CONNECTIONS = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = 'airmatrix'"


def service_killed(folder: Path, rounds: int, report: Report, server: Cluster) -> Verdict:
    """Kill the service, not the database."""
    return kill(folder, rounds, report, ledger=server.database(), reservations=_RESERVATIONS)


def crashes(folder: Path, rounds: int, report: Report, server: Cluster) -> Verdict:
    """Let the database crash, and come back."""
    verdict = Verdict("PostgreSQL crashes")
    _play(folder, server.database(), rounds, report, verdict, lambda _: server.restart("immediate"))
    return verdict


def restarts(folder: Path, rounds: int, report: Report, server: Cluster) -> Verdict:
    """Restart the database as an administrator does."""
    verdict = Verdict("PostgreSQL restarts")
    _play(folder, server.database(), rounds, report, verdict, lambda _: server.restart())
    return verdict


def connections_cut(folder: Path, rounds: int, report: Report, server: Cluster) -> Verdict:
    """Let the database end the service's connections over and over."""
    verdict = Verdict("PostgreSQL ends connections")

    def cut(_: int) -> None:
        until = time.monotonic() + _CUTTING_S
        with server.connect() as connection:
            while time.monotonic() < until:
                connection.execute(_OUR_CONNECTIONS)
                time.sleep(_CUT_EVERY_S)

    _play(folder, server.database(), rounds, report, verdict, cut)
    return verdict


def commits_cut(folder: Path, rounds: int, report: Report, server: Cluster) -> Verdict:
    """Break connections just before commits, at them and just after; every fourth time, let nobody through for long."""
    verdict = Verdict("connections break at commits")
    url = urlsplit(server.database())
    assert url.hostname is not None
    assert url.port is not None
    with wire((url.hostname, url.port), random.Random(_SEED)) as between:

        def cut(number: int) -> None:
            between.breaks_down = number % _DOWN_EVERY == _DOWN_EVERY - 1
            between.cut_of = _CUT_OF_COMMITS
            time.sleep(_CUTTING_S + _DOWN_S * between.breaks_down)
            between.mend()

        through = url._replace(netloc=url.netloc.replace(f":{url.port}", f":{between.port}")).geturl()
        _play(folder, through, rounds, report, verdict, cut)
    verdict.remarks.append(", ".join(f"{count} cut {cut.value}" for cut, count in Counter(between.cuts).items()))
    return verdict


def _play(
    folder: Path, ledger: str, rounds: int, report: Report, verdict: Verdict, fault: Callable[[int], None]
) -> None:
    """Let a fault happen under load, wait until the service is well again, and compare; round after round."""
    told = verdict.told
    traffic = Traffic(_SEED)
    with serving(folder, ledger) as service:
        for number in range(rounds):
            with Operators(service.url, traffic.rush(), told, _CLIENTS):
                time.sleep(_LOAD_S)
                fault(number)
                verdict.back_s.append(seconds_until_ready(service.url))
                time.sleep(_LOAD_S)
            verdict.damage.add(audit(book_of(ledger), told))
            verdict.broken += undisturbed(service.url, chain(again(told), islice(traffic.all_day(), _FLIGHTS)), told)
            verdict.damage.add(audit(book_of(ledger), told))
            verdict.rounds += 1
            report(verdict.rounds)
    verdict.verify(verified(folder, ledger))
    unknown = told.problems("outcome-unknown")
    verdict.remarks.append(f"{unknown} answered outcome-unknown, {told.problems('ledger-unavailable')} unavailable")
