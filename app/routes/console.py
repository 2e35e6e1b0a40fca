"""The ops console at `/`: its own files, and MapLibre GL's from the wheel that brings them."""

from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import Response
from starlette.staticfiles import StaticFiles

router = APIRouter(include_in_schema=False)

_OWN = Path(__file__).parents[1] / "console"

# Nothing from elsewhere and nothing inline. MapLibre makes its worker from a blob and draws its icons from data URLs.
_POLICY = (
    "default-src 'none'; script-src 'self'; worker-src blob:; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# Asked for again each time, which the ETag makes cheap: after an upgrade no page mixes old files with new.
_REVALIDATED = "no-cache"
_KEPT_FOR_A_DAY = "public, max-age=86400"


@router.api_route("/", methods=["GET", "HEAD"])
async def read_console(request: Request) -> Response:
    """Return the console's page."""
    return await _answer(_own_files(), "index.html", request, _REVALIDATED)


@router.api_route("/console/{name}", methods=["GET", "HEAD"])
async def read_file(request: Request, name: str) -> Response:
    """Return one of the console's own files; they all lie in one folder."""
    return await _answer(_own_files(), name, request, _REVALIDATED)


@router.api_route("/console/vendor/{name}", methods=["GET", "HEAD"])
async def read_vendor_file(request: Request, name: str) -> Response:
    """Return a file of MapLibre GL."""
    return await _answer(_maplibre_files(), name, request, _KEPT_FOR_A_DAY)


async def _answer(files: StaticFiles, name: str, request: Request, caching: str) -> Response:
    response = await files.get_response(name, request.scope)
    response.headers.update({"Content-Security-Policy": _POLICY, "Cache-Control": caching})
    return response


@cache
def _own_files() -> StaticFiles:
    return StaticFiles(directory=_OWN)


@cache
def _maplibre_files() -> StaticFiles:
    """Return the files as the wheel keeps them. Importing the package would load much more than its folder's name."""
    found: Any = find_spec("maplibre")
    return StaticFiles(directory=Path(found.origin).parent / "srcjs")
