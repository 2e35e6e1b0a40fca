"""What a running process holds: built once at start, handed to the routes, closed at the end."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Annotated, cast

import structlog
from fastapi import Depends, Request

from app import auth
from app.deconfliction import Deconfliction, Policy
from app.ledger import Ledger, create_or_upgrade, open_ledger
from app.settings import Settings
from planner.aircraft import AircraftType, merged, read_aircraft_types, shipped_aircraft_types
from planner.airspace import Airspace, read_airspace
from planner.buildings import shipped_airspace
from planner.cfa_star import Performance, Planner
from planner.warm_up import kernels_are_compiled, warm_up

log = structlog.get_logger()


@dataclass(frozen=True)
class Service:
    """The parts of a running service."""

    settings: Settings
    airspace: Airspace
    aircraft_types: Mapping[str, AircraftType]
    ledger: Ledger
    deconfliction: Deconfliction
    clock: Callable[[], int]


def load_airspace(settings: Settings) -> Airspace:
    """Return the airspace that the settings name, the shipped one by default; raises `PlannerError`."""
    return shipped_airspace() if settings.airspace is None else read_airspace(settings.airspace)


def load_aircraft_types(settings: Settings) -> dict[str, AircraftType]:
    """Return the shipped aircraft and the user's, whose profiles win; raises `AircraftProfileError`."""
    own = () if settings.aircraft_types is None else read_aircraft_types(settings.aircraft_types)
    return merged(shipped_aircraft_types(), own)


@contextmanager
def running(settings: Settings, clock: Callable[[], int]) -> Iterator[Service]:
    """Start the service's parts in order, and stop them in reverse.

    Raises
    ------
    StartupError, PlannerError
        A file is missing, foreign or does not fit; nothing is left running.
    """
    auth.check_listening(settings)
    airspace = load_airspace(settings)
    log.info(
        "airspace",
        airspace=airspace.id,
        rule=airspace.rule.value,
        buildings=len(airspace.buildings),
        occupied=airspace.occupied_per_layer,
        bounds=[round(degrees, 6) for degrees in airspace.grid.bounds],
    )
    aircraft_types = load_aircraft_types(settings)
    performances = {id_: Performance.of(aircraft, airspace.grid) for id_, aircraft in aircraft_types.items()}
    create_or_upgrade(settings.ledger)
    with closing(open_ledger(settings.ledger, airspace, claim=True)) as ledger:
        if not kernels_are_compiled():
            log.info("compiling the planner's kernels, once per version; this takes some ten seconds")
        warm_up()
        # Opening the projection takes as long as a hundred plans: not in the first request.
        airspace.grid.project(*airspace.grid.bounds[:2])
        planner = Planner(airspace, settings.search, int(settings.hover_limit_s * 1000))
        policy = Policy(
            horizon_ms=int(settings.horizon_days * 86_400_000),
            idempotency_ms=int(settings.idempotency_hours * 3_600_000),
            queue_limit=settings.queue_limit,
        )
        deconfliction = Deconfliction(ledger, planner, performances, clock, policy)
        deconfliction.start()
        log.info("ready", ledger=settings.ledger)
        try:
            yield Service(settings, airspace, aircraft_types, ledger, deconfliction, clock)
        finally:
            deconfliction.stop()


def of_request(request: Request) -> Service:
    """Return the service that answers a request."""
    return cast(Service, request.state.service)


ServiceDep = Annotated[Service, Depends(of_request)]
