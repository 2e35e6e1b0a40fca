"""Is it alive, is it ready, which version is it."""

import platform
from importlib.metadata import version
from typing import Literal

from fastapi import APIRouter
from pydantic import BaseModel

from app import problems
from app.errors import LedgerUnavailable, NotReady
from app.ledger import parse_location
from app.service import Service, ServiceDep
from app.writer import Writer

router = APIRouter(tags=["running it"])

Mode = Literal["read-write", "read-only"]

# Batches take a fraction of a second, and whoever waits for another writer's lock gives up after as long as this.
_LONGEST_WAIT_S = 10.0


class Liveness(BaseModel):
    """The process answers."""

    status: str = "live"


class Readiness(BaseModel):
    """Requests can be served, or only reads; `revision` is the ledger's newest."""

    status: str = "ready"
    mode: Mode
    revision: int
    waiting: int


class Version(BaseModel):
    """What runs here."""

    airmatrix: str
    python: str
    airspace: str
    ledger: Literal["sqlite", "postgresql"]
    mode: Mode
    authentication: Literal["jwt", "none"]
    allow_unauthenticated: bool


@router.get("/health/live", responses=problems.documented(), summary="Liveness")
async def live() -> Liveness:
    """Answer while the process runs."""
    return Liveness()


@router.get("/health/ready", responses=problems.documented(503), summary="Readiness")
async def ready(service: ServiceDep) -> Readiness:
    """Answer 200 when the ledger can be read and, unless this process only reads, written; 503 with `reason` if not.

    The answer comes within two seconds, whatever the ledger does.
    """
    writer = None if service.is_read_only else service.writer
    reasons = [] if writer is None else _troubles_of(writer)
    revision = None
    try:
        revision = await service.probe.revision()
    except LedgerUnavailable as error:
        reasons.append(str(error))
    waiting = 0 if writer is None else writer.waiting
    if revision is None or reasons:
        raise NotReady("; ".join(dict.fromkeys(reasons)), waiting, revision)
    return Readiness(mode=_mode(service), revision=revision, waiting=waiting)


@router.get("/version", responses=problems.documented(), summary="Version")
async def read_version(service: ServiceDep) -> Version:
    """Return versions, and whether anybody may do anything."""
    return Version(
        airmatrix=version("airmatrix"),
        python=platform.python_version(),
        airspace=service.airspace.id,
        ledger="sqlite" if parse_location(service.settings.ledger).is_sqlite else "postgresql",
        mode=_mode(service),
        authentication="none" if service.settings.jwks is None else "jwt",
        allow_unauthenticated=service.settings.allow_unauthenticated,
    )


def _mode(service: Service) -> Mode:
    return "read-only" if service.is_read_only else "read-write"


def _troubles_of(writer: Writer) -> list[str]:
    """Return why requests that write would not be answered well at present."""
    troubles = []
    if not writer.is_running:
        troubles.append("the ledger writer has stopped")
    if writer.trouble is not None:
        # Why, with what belongs to the ledger's place, is in the log.
        troubles.append("the last write failed")
    if writer.is_full:
        troubles.append(f"the queue is full: {writer.waiting} requests are waiting")
    if writer.waiting_s > _LONGEST_WAIT_S:
        troubles.append(f"the first request in the queue has waited for {writer.waiting_s:.0f} s")
    return troubles
