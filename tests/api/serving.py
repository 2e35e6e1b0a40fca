"""A running application without sockets: its settings, its lifespan, and httpx in front of it."""

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import httpx
from anyio.from_thread import BlockingPortal, start_blocking_portal
from fastapi import FastAPI
from starlette.types import Receive, Scope, Send

from app.service import Service
from app.settings import Settings
from tests.ledger.district import District


def settings_for(district: District, ledger: str, folder: Path, **options: object) -> Settings:
    """Return settings for a district, whose airspace file is written into a folder."""
    airspace = folder / "airspace.json"
    district.airspace.write(airspace)
    return Settings.model_validate({"ledger": ledger, "airspace": airspace, "monitor_every_s": 3600, **options})


@dataclass(frozen=True)
class Client:
    """httpx, called from plain functions; from several threads if need be."""

    portal: BlockingPortal
    http: httpx.AsyncClient
    service: Service

    def request(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        """Return the answer to a request."""
        return self.portal.call(partial(self.http.request, method, path, **arguments))

    def get(self, path: str, **arguments: Any) -> httpx.Response:
        """Return the answer to a GET."""
        return self.request("GET", path, **arguments)

    def post(self, path: str, **arguments: Any) -> httpx.Response:
        """Return the answer to a POST."""
        return self.request("POST", path, **arguments)

    def delete(self, path: str, **arguments: Any) -> httpx.Response:
        """Return the answer to a DELETE."""
        return self.request("DELETE", path, **arguments)


@asynccontextmanager
async def serving(app: FastAPI) -> AsyncIterator[tuple[httpx.AsyncClient, Service]]:
    """Run an application, yield a client of it and its parts."""
    async with app.router.lifespan_context(app) as state:

        async def with_state(scope: Scope, receive: Receive, send: Send) -> None:
            await app({**scope, "state": dict(state or {})}, receive, send)

        transport = httpx.ASGITransport(app=with_state, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as http:
            yield http, (state or {})["service"]


@contextmanager
def served(app: FastAPI) -> Iterator[Client]:
    """Run an application in a thread of its own, yield a client of it."""
    with start_blocking_portal() as portal, portal.wrap_async_context_manager(serving(app)) as (http, service):
        yield Client(portal, http, service)
