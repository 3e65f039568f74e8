"""Whether the server lives, whether it is ready, and its metrics."""

from __future__ import annotations

from fastapi import APIRouter, Response

from specshield.errors import StoreError
from specshield.service import metrics
from specshield.service.schemas.base import Health
from specshield.service.state import ServerState, problems

router = APIRouter(tags=["system"])


@router.get("/livez", summary="Is it alive?")
async def livez() -> Health:
    """Whether the process answers at all; asks nothing else."""
    return Health(status="ok")


@router.get(
    "/readyz", summary="Is it ready?", responses=problems(_503="The store is away, or it is still starting.")
)
async def readyz(server: ServerState) -> Health:
    """Whether it can decide: the store answers, the kernels are compiled (seconds, at the first start)."""
    await server.store.ping()
    if server.failure is not None:
        raise StoreError(server.failure)
    if not server.ready:
        raise StoreError("still starting: compiling the kernels")
    return Health(status="ok")


@router.get(
    "/metrics",
    response_class=Response,
    summary="Metrics",
    responses={200: {"content": {"text/plain": {}}, "description": "Prometheus text format."}},
)
async def show() -> Response:
    """For Prometheus."""
    return Response(metrics.exposition(), media_type=metrics.MEDIA_TYPE)
