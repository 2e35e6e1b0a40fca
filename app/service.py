"""What a running process holds: built at its start, handed to the routes, closed at the end.

A service may be several processes. `prepare` does what is done once for all of them, `started` what each does.
"""

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from hashlib import sha256
from typing import Annotated, cast

import structlog
from fastapi import Depends, Request

from app import auth
from app.airspace_closing import AirspaceClosing
from app.batches import Batches
from app.conformance import Thresholds
from app.deconfliction import Deconfliction, log_intents
from app.errors import ReadOnlyServer, StartupError
from app.keys import store_of
from app.ledger import Ledger, create_or_upgrade, open_ledger
from app.ledger_probe import LedgerProbe
from app.metrics import Metrics
from app.monitor import Monitor
from app.replica import OccupancyReplica
from app.scheduling import Limits, Scheduler
from app.settings import Settings
from app.telemetry import Telemetry
from app.times import monotonic_ms
from app.webhook_delivery import Deliverer, Post
from app.webhooks import Destinations, Webhooks
from app.writer import Policy, Writer
from planner.aircraft import AircraftType, merged, read_aircraft_types, shipped_aircraft_types
from planner.airspace import Airspace, read_airspace
from planner.buildings import shipped_airspace
from planner.cfa_star import Performance, Planner
from planner.warm_up import kernels_are_compiled, warm_up

log = structlog.get_logger()


@dataclass(frozen=True)
class Basis:
    """What the processes of a service have in common: the settings, and what the files hold that they name."""

    settings: Settings
    airspace: Airspace
    aircraft_types: Mapping[str, AircraftType]

    @property
    def fingerprint(self) -> str:
        """A digest by which a process can tell that it has read the same as another."""
        return sha256(f"{self.airspace.fingerprint} {self.aircraft_types}".encode()).hexdigest()

    def performances(self) -> dict[str, Performance]:
        """Return what each aircraft can do in this airspace; raises `AircraftProfileError`."""
        return {id_: Performance.of(aircraft, self.airspace.grid) for id_, aircraft in self.aircraft_types.items()}


@dataclass(frozen=True)
class Writing:
    """What a process that writes has beyond one that only reads."""

    writer: Writer
    deconfliction: Deconfliction
    airspace_closing: AirspaceClosing
    batches: Batches
    telemetry: Telemetry
    webhooks: Webhooks
    deliverer: Deliverer


@dataclass(frozen=True)
class Service:
    """The parts of a running process; `writing` are those that one which only reads has not."""

    settings: Settings
    airspace: Airspace
    aircraft_types: Mapping[str, AircraftType]
    ledger: Ledger
    writing: Writing | None
    clock: Callable[[], int]
    metrics: Metrics
    probe: LedgerProbe
    access: auth.Access
    monitor: Monitor
    # Set when the server goes down: streams must not hold it up.
    closing: threading.Event

    @property
    def is_read_only(self) -> bool:
        """Whether this process only reads."""
        return self.writing is None

    @property
    def writer(self) -> Writer:
        """The only writer; raises `ReadOnlyServer` where there is none."""
        return self._writing().writer

    @property
    def deconfliction(self) -> Deconfliction:
        """What plans and records flights; raises `ReadOnlyServer` where nothing does."""
        return self._writing().deconfliction

    @property
    def airspace_closing(self) -> AirspaceClosing:
        """What closes airspace and opens it again; raises `ReadOnlyServer` where nothing does."""
        return self._writing().airspace_closing

    @property
    def batches(self) -> Batches:
        """What plans and records batches; raises `ReadOnlyServer` where nothing does."""
        return self._writing().batches

    @property
    def telemetry(self) -> Telemetry:
        """What takes positions; raises `ReadOnlyServer` where nothing does."""
        return self._writing().telemetry

    @property
    def webhooks(self) -> Webhooks:
        """What adds and removes webhooks; raises `ReadOnlyServer` where nothing does."""
        return self._writing().webhooks

    def _writing(self) -> Writing:
        if self.writing is None:
            raise ReadOnlyServer("this server only answers reads; send the request to one that writes")
        return self.writing


def load_airspace(settings: Settings) -> Airspace:
    """Return the airspace that the settings name, the shipped one by default; raises `PlannerError`."""
    return shipped_airspace() if settings.airspace is None else read_airspace(settings.airspace)


def load_aircraft_types(settings: Settings) -> dict[str, AircraftType]:
    """Return the shipped aircraft and the user's, whose profiles win; raises `AircraftProfileError`."""
    own = () if settings.aircraft_types is None else read_aircraft_types(settings.aircraft_types)
    return merged(shipped_aircraft_types(), own)


@contextmanager
def running(
    settings: Settings, clock: Callable[[], int], elapsed_ms: Callable[[], int] = monotonic_ms
) -> Iterator[Service]:
    """Prepare and start a service of one process; raises as `prepare`."""
    with started(prepare(settings), clock, elapsed_ms) as service:
        yield service


def read_basis(settings: Settings) -> Basis:
    """Read the files that the settings name; raises `PlannerError`."""
    return Basis(settings, load_airspace(settings), load_aircraft_types(settings))


def reread_basis(settings: Settings, fingerprint: str) -> Basis:
    """Read them in another process; raises `StartupError` if they are no longer what the first process has read."""
    basis = read_basis(settings)
    if basis.fingerprint != fingerprint:
        raise StartupError("airspace or aircraft types have changed since the service was started; start it anew")
    return basis


def prepare(settings: Settings) -> Basis:
    """Check all that is given; unless it is only read, create, upgrade and claim the ledger, and compile the kernels.

    Raises
    ------
    StartupError, PlannerError
        A file is missing, foreign or does not fit.
    """
    auth.check_listening(settings)
    store_of(settings)
    basis = read_basis(settings)
    airspace = basis.airspace
    log.info(
        "airspace",
        airspace=airspace.id,
        rule=airspace.rule.value,
        buildings=len(airspace.buildings),
        occupied=airspace.occupied_per_layer,
        bounds=[round(degrees, 6) for degrees in airspace.grid.bounds],
    )
    basis.performances()
    if not settings.read_only:
        create_or_upgrade(settings.ledger)
    open_ledger(settings.ledger, airspace, claim=not settings.read_only).close()
    if not settings.read_only and not kernels_are_compiled():
        log.info("compiling the planner's kernels, once per version; this takes some ten seconds")
        warm_up()
    return basis


@contextmanager
def started(
    basis: Basis,
    clock: Callable[[], int],
    elapsed_ms: Callable[[], int] = monotonic_ms,
    on_death: Callable[[], None] = lambda: None,
) -> Iterator[Service]:
    """Start a process's parts in order, and stop them in reverse.

    `on_death` is called, in another thread, when the writer has ended by itself, after which nothing is written.

    Raises
    ------
    StartupError, LedgerUnavailable
        The ledger has changed since it was prepared, or fails; nothing is left running.
    """
    settings, airspace = basis.settings, basis.airspace
    with auth.access(settings, elapsed_ms) as access, closing(open_ledger(settings.ledger, airspace)) as ledger:
        # Opening the projection takes as long as a hundred plans: not in the first request.
        airspace.grid.project(*airspace.grid.bounds[:2])
        metrics = Metrics()
        writing = None
        if not settings.read_only:
            writing = _writing(basis, ledger, clock, elapsed_ms, metrics, on_death)
        monitor = Monitor(
            ledger,
            airspace,
            clock,
            _thresholds(settings),
            None if writing is None else (writing.writer, writing.deconfliction),
            metrics.looked,
        )
        monitor.start(settings.monitor_every_s)
        try:
            yield Service(
                settings=settings,
                airspace=airspace,
                aircraft_types=basis.aircraft_types,
                ledger=ledger,
                writing=writing,
                clock=clock,
                metrics=metrics,
                probe=LedgerProbe(ledger),
                access=access,
                monitor=monitor,
                closing=threading.Event(),
            )
        finally:
            monitor.stop()
            if writing is not None:
                writing.deliverer.stop()
                writing.writer.stop()


def _thresholds(settings: Settings) -> Thresholds:
    return Thresholds(
        freshness_ms=int(settings.freshness_s * 1000),
        tolerance_ms=int(settings.tolerance_s * 1000),
        contingent_after_ms=int(settings.contingent_after_s * 1000),
        projection_ms=int(settings.projection_s * 1000),
    )


def _writing(
    basis: Basis,
    ledger: Ledger,
    clock: Callable[[], int],
    elapsed_ms: Callable[[], int],
    metrics: Metrics,
    on_death: Callable[[], None],
) -> Writing:
    settings = basis.settings
    warm_up()
    planner = Planner(
        basis.airspace,
        settings.search,
        int(settings.hover_limit_s * 1000),
        int(settings.detour_limit_s * 1000),
        settings.most_expansions,
    )
    policy = Policy(
        idempotency_ms=int(settings.idempotency_hours * 3_600_000),
        queue_limit=settings.queue_limit,
        retention_ms=None if settings.retention_days is None else int(settings.retention_days * 86_400_000),
        positions_ms=int(settings.telemetry_hours * 3_600_000),
    )
    writer = Writer(
        ledger,
        OccupancyReplica(planner.index),
        clock,
        policy,
        elapsed_ms=elapsed_ms,
        observers=(log_intents, metrics.batch),
        on_death=on_death,
    )
    limits = Limits(
        horizon_ms=int(settings.horizon_days * 86_400_000),
        notice_ms=int(settings.notice_s * 1000),
        lead_ms=int(settings.replan_lead_s * 1000),
    )
    scheduler = Scheduler(planner, basis.performances(), limits)
    deconfliction = Deconfliction(
        writer,
        ledger,
        scheduler,
        _thresholds(settings).freshness_ms,
        settings.open_intents_limit,
        None if settings.activation_lead_s is None else int(settings.activation_lead_s * 1000),
    )
    telemetry = Telemetry(
        ledger,
        writer,
        basis.airspace.grid,
        clock,
        ahead_ms=int(settings.tolerance_s * 1000),
        kept_ms=policy.positions_ms,
    )
    destinations = Destinations.of(settings)
    deliverer = Deliverer(ledger, writer, clock, Post(destinations), metrics.webhook, elapsed_ms=elapsed_ms)
    writer.start()
    deliverer.start()
    metrics.index_loaded(len(planner.index))
    return Writing(
        writer,
        deconfliction,
        AirspaceClosing(writer, ledger, scheduler),
        Batches(writer, ledger, scheduler, deconfliction),
        telemetry,
        Webhooks(ledger, writer, destinations),
        deliverer,
    )


async def of_request(request: Request) -> Service:
    """Return the service that answers a request. A coroutine, so that it needs none of the threads of plain routes."""
    return cast(Service, request.state.service)


ServiceDep = Annotated[Service, Depends(of_request)]
