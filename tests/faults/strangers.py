"""Strangers at a ledger in use: a service of another airspace, somebody who locks it, or takes it away."""

import time
from itertools import islice
from pathlib import Path

import httpx

from tests.cli.serving import ready_url
from tests.cli.town import town_airspace
from tests.faults.audit import audit, book_of
from tests.faults.health import await_refusals, complaints_while_unwritable, seconds_until_ready, undisturbed
from tests.faults.operators import Operators
from tests.faults.serving import Start, refusal, serving, started, verified
from tests.faults.traffic import Traffic
from tests.faults.verdict import Report, Verdict
from tests.ledger.locations import migrated_file, write_lock

_CLIENTS = 4
_FLIGHTS = 20


def another_airspace(folder: Path, rounds: int, report: Report, *, seed: int = 4) -> Verdict:
    """Let services of a town try to use a city's ledger under load: each is refused, and no operator notices."""
    verdict = Verdict("another airspace")
    ledger = folder / "ledger.sqlite"
    town = str(town_airspace(folder))
    with (
        serving(folder, ledger) as service,
        Operators(service.url, Traffic(seed).all_day(), verdict.told, _CLIENTS),
    ):
        for _ in range(rounds):
            with started(folder, ledger, "--airspace", town) as stranger:
                verdict.broken += refusal(stranger, "belongs to airspace 'astana-2km'")
            verdict.rounds += 1
            report(verdict.rounds)
    verdict.broken += [f"an operator was told: {said}" for said in verdict.told.unrecorded.values()]
    verdict.damage.add(audit(book_of(ledger), verdict.told))
    verdict.verify(verified(folder, ledger))
    return verdict


def two_airspaces_at_once(folder: Path, rounds: int, report: Report) -> Verdict:
    """Start a city's and a town's service on one new ledger at the same moment: one serves, the other is refused."""
    verdict = Verdict("two airspaces at once")
    town = str(town_airspace(folder))
    for _ in range(rounds):
        ledger = folder / f"ledger-{verdict.rounds}.sqlite"
        with started(folder, ledger) as of_city, started(folder, ledger, "--airspace", town) as of_town:
            verdict.broken += _one_serves(of_city, of_town)
        verdict.rounds += 1
        report(verdict.rounds)
    return verdict


def _one_serves(*both: Start) -> list[str]:
    while all(start.process.poll() is None for start in both):
        if all(ready_url(start.log) for start in both):
            return ["both serve"]
        time.sleep(0.01)
    loser, winner = sorted(both, key=lambda start: start.process.poll() is None)
    complaints = refusal(loser, "belongs to airspace")
    winner.ready()
    return complaints


def lock_held(folder: Path, rounds: int, report: Report, *, seed: int = 11) -> Verdict:
    """Hold a ledger's write lock for longer than the service waits for it."""
    verdict = Verdict("the write lock held")
    told, traffic = verdict.told, Traffic(seed)
    ledger = folder / "ledger.sqlite"
    with serving(folder, ledger) as service:
        verdict.broken += undisturbed(service.url, islice(traffic.all_day(), _FLIGHTS), told)
        for _ in range(rounds):
            with Operators(service.url, traffic.rush(), told, _CLIENTS):
                with write_lock(ledger):
                    await_refusals(told)
                    verdict.broken += complaints_while_unwritable(service.url, next(iter(told.accepted.values())).id)
                verdict.back_s.append(seconds_until_ready(service.url))
            verdict.broken += undisturbed(service.url, islice(traffic.all_day(), _FLIGHTS), told)
            verdict.damage.add(audit(book_of(ledger), told))
            verdict.rounds += 1
            report(verdict.rounds)
    verdict.verify(verified(folder, ledger))
    return verdict


def file_taken_away(folder: Path, rounds: int, report: Report, *, seed: int = 12) -> Verdict:
    """Move the file of a ledger in use, or put another in its place, and bring it back.

    SQLite would go on writing what has no name any more.
    """
    verdict = Verdict("the file taken away")
    told, traffic = verdict.told, Traffic(seed)
    ledger, elsewhere = folder / "ledger.sqlite", folder / "elsewhere.sqlite"
    with serving(folder, ledger) as service:
        verdict.broken += undisturbed(service.url, islice(traffic.all_day(), _FLIGHTS), told)
        for _ in range(rounds):
            with Operators(service.url, traffic.rush(), told, _CLIENTS):
                ledger.rename(elsewhere)
                if verdict.rounds % 2:
                    ledger.write_bytes(migrated_file())
                await_refusals(told)
                readiness = httpx.get(f"{service.url}/health/ready")
                verdict.broken += [] if readiness.status_code == 503 else [f"readiness says {readiness.text}"]
                elsewhere.replace(ledger)
                verdict.back_s.append(seconds_until_ready(service.url))
            verdict.broken += undisturbed(service.url, islice(traffic.all_day(), _FLIGHTS), told)
            verdict.damage.add(audit(book_of(ledger), told))
            verdict.rounds += 1
            report(verdict.rounds)
    verdict.verify(verified(folder, ledger))
    return verdict
