"""/livez, /readyz and /metrics."""

from __future__ import annotations

from fastapi import APIRouter, Response

from specshield.errors import Starting
from specshield.service import metrics
from specshield.service.schemas.base import Health
from specshield.service.state import ServerState, problems

router = APIRouter(tags=["system"])


@router.head("/livez", include_in_schema=False)  # monitors ask so
@router.get("/livez", summary="Is it alive?")
async def livez() -> Health:
    """Answers as long as the process runs. It looks neither at the store nor at the kernels."""
    return Health(status="ok")


@router.head("/readyz", include_in_schema=False)
@router.get(
    "/readyz",
    summary="Is it ready?",
    responses=problems(
        _503="`starting`, with the progress; `stopping`: the server was told to stop; or the store is away."
    ),
)
async def readyz(server: ServerState) -> Health:
    """Whether the server can decide: the store answers, and the kernels are compiled.

    The first start of an installation compiles the kernels, in about a minute; `kernels` says how many are
    compiled. Until then every path under /v1 answers 503 `starting`, with Retry-After. A server that was told
    to stop answers 503 here at once, and answers everything else until it stops. With several processes it is
    ready once all that take requests are.
    """
    await server.store.ping()
    problem = server.startup.problem()
    if problem is not None:
        raise problem
    if server.startup.processes.any("starting"):
        expected = "/readyz again, until it answers 200"
        raise Starting("another process of the server is not ready", expected=expected)
    return Health(status="ok")


@router.get(
    "/metrics",
    response_class=Response,
    summary="Metrics",
    responses={200: {"content": {"text/plain": {}}, "description": "Prometheus text format."}},
)
async def show(server: ServerState) -> Response:
    """Counters and times, for Prometheus."""
    return Response(metrics.exposition(await server.gauges.read()), media_type=metrics.MEDIA_TYPE)
