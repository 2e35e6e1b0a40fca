"""Is it alive, is it ready, which version is it."""

import platform
from importlib.metadata import version

from fastapi import APIRouter, Response
from pydantic import BaseModel

from app import problems
from app.errors import LedgerUnavailable
from app.service import ServiceDep

router = APIRouter(tags=["running it"])


class Liveness(BaseModel):
    """The process answers."""

    status: str = "live"


class Readiness(BaseModel):
    """Whether requests can be served; `reason` says why not."""

    status: str
    revision: int | None = None
    waiting: int
    reason: str | None = None


class Version(BaseModel):
    """What runs here."""

    airmatrix: str
    python: str
    airspace: str
    authentication: str
    allow_unauthenticated: bool


@router.get("/health/live", responses=problems.documented(), summary="Liveness")
async def live() -> Liveness:
    """Answer while the process runs."""
    return Liveness()


@router.get("/health/ready", responses={503: {"model": Readiness}, **problems.documented()}, summary="Readiness")
def ready(service: ServiceDep, response: Response) -> Readiness:
    """Answer 200 when the ledger can be read and the writer runs, otherwise 503 with the reason."""
    waiting = service.deconfliction.waiting
    try:
        revision = service.ledger.revision()
    except LedgerUnavailable as error:
        response.status_code = 503
        return Readiness(status="not ready", waiting=waiting, reason=str(error))
    if not service.deconfliction.is_running:
        response.status_code = 503
        return Readiness(status="not ready", waiting=waiting, reason="the ledger writer has stopped")
    return Readiness(status="ready", revision=revision, waiting=waiting)


@router.get("/version", responses=problems.documented(), summary="Version")
def read_version(service: ServiceDep) -> Version:
    """Return versions, and whether anybody may do anything."""
    return Version(
        airmatrix=version("airmatrix"),
        python=platform.python_version(),
        airspace=service.airspace.id,
        authentication="off",
        allow_unauthenticated=service.settings.allow_unauthenticated,
    )
