"""Liveness, readiness and metrics. Never rejected because of load."""

from http import HTTPStatus

from fastapi import APIRouter
from fastapi.responses import Response

from msdgs_serve import __version__
from msdgs_serve.api.errors import RequestRejected
from msdgs_serve.api.metrics import MEDIA_TYPE
from msdgs_serve.api.openapi import problems
from msdgs_serve.api.schemas import Live, Ready
from msdgs_serve.api.service import Phase, SharedService

router = APIRouter(tags=["operation"])


@router.get("/live", summary="Whether the process answers")
async def live() -> Live:
    """Always answers; needs no key."""
    return Live(version=__version__)


@router.get("/ready", summary="Whether the service is ready", responses=problems(503))
async def ready(service: SharedService) -> Ready:
    """503 until scenes are loaded and kernels compiled, and while the service is stopping; needs no key."""
    if service.phase is not Phase.READY:
        detail = f"The service is {service.phase.value}."
        raise RequestRejected(HTTPStatus.SERVICE_UNAVAILABLE, service.phase.value, detail, retry_after=1)
    return Ready()


@router.get(
    "/metrics",
    summary="Metrics for Prometheus",
    response_class=Response,
    responses={
        200: {"description": "Prometheus' text format", "content": {"text/plain": {"schema": {"type": "string"}}}}
    },
)
def metrics(service: SharedService) -> Response:
    """Requests, latencies by stage, queue, cache, errors by kind, process."""
    return Response(service.metrics.page(), headers={"Content-Type": MEDIA_TYPE})
