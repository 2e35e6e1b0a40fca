"""The application: routes, problems, OpenAPI. Nothing is opened until its lifespan begins."""

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import Any, TypedDict

from anyio import to_thread
from fastapi import Depends, FastAPI
from fastapi_offline import FastAPIOffline

from app import auth, openapi, problems, service
from app.gate import Gate
from app.routes import (
    aircraft_types,
    airspace,
    batches,
    console,
    constraints,
    docs,
    events,
    flight_intents,
    flights,
    health,
    metrics,
    status,
    stream,
    telemetry,
    webhooks,
)
from app.security_headers import SecurityHeaders
from app.service import Service
from app.settings import Settings
from app.times import monotonic_ms, now_ms
from app.tracing import Tracing

DESCRIPTION = """
Strategic deconfliction for urban air mobility. Operators submit flight intents; each is planned in order of arrival
against everything reserved before, and its blocks are reserved durably. Ops staff read the status of the airspace.

Times are RFC 3339 with an offset, answered in UTC with milliseconds. Errors are problem documents (RFC 9457). Every
answer names its request in `X-Request-ID`, and so do the logs; send one (up to 100 of `A-Za-z0-9._:-`) to choose it.
"""


class State(TypedDict):
    """What the lifespan hands to every request."""

    service: Service
    board: stream.Board


def create_app(
    settings: Settings,
    clock: Callable[[], int] = now_ms,
    *,
    elapsed_ms: Callable[[], int] = monotonic_ms,
    running: Service | None = None,
) -> FastAPI:
    """Return the application for these settings. Its lifespan starts a service, unless one is `running` already."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[State]:
        if running is not None:
            yield {"service": running, "board": stream.Board()}
            return
        starting = service.running(settings, clock, elapsed_ms)
        started = await to_thread.run_sync(starting.__enter__)
        try:
            yield {"service": started, "board": stream.Board()}
        finally:
            await to_thread.run_sync(starting.__exit__, None, None, None)

    # Its documentation page, which is ours, needs no other server than this one.
    app = FastAPIOffline(
        title="AirMatrix",
        version=version("airmatrix"),
        description=DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        # Redirects would be built from the Host header, which says what its sender likes.
        redirect_slashes=False,
        dependencies=[Depends(auth.admitted)],
    )
    for resource in (
        flight_intents,
        batches,
        telemetry,
        aircraft_types,
        airspace,
        status,
        constraints,
        flights,
        stream,
        events,
        webhooks,
        health,
        metrics,
        console,
        docs,
    ):
        app.include_router(resource.router)
    app.include_router(problems.router)
    problems.install(app)
    app.add_middleware(Gate, settings=settings)
    inner = app.build_middleware_stack
    # Outside of the middleware that answers unexpected errors, where `add_middleware` cannot put it.
    app.build_middleware_stack = lambda: Tracing(SecurityHeaders(inner()))  # type: ignore[method-assign]
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


def _openapi(app: FastAPI) -> dict[str, Any]:
    if app.openapi_schema is None:
        app.openapi_schema = openapi.document(app)
    return app.openapi_schema
