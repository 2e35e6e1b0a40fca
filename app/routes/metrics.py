"""What Prometheus scrapes."""

import asyncio

from fastapi import APIRouter, Response

from app import metrics, problems
from app.service import ServiceDep

router = APIRouter(tags=["running it"])

_TEXT = {"description": "Metrics", "content": {"text/plain": {"schema": {"type": "string"}}}}


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: _TEXT, **problems.documented()},
    summary="Metrics",
)
async def read_metrics(service: ServiceDep) -> Response:
    """Return the metrics of this server, all its workers together, in Prometheus' text format."""
    # Neither on the event loop nor in the threads of plain routes, which a ledger that hangs may hold all.
    exposition = await asyncio.to_thread(service.metrics.exposition)
    return Response(exposition, media_type=metrics.MEDIA_TYPE)
