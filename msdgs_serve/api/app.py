"""The application: routes, error handlers and what they share, put together."""

import anyio
from fastapi import FastAPI

from msdgs_serve import __version__
from msdgs_serve.api.body_limit import BodyLimit
from msdgs_serve.api.errors import install_error_handlers
from msdgs_serve.api.openapi import install_openapi, render_examples
from msdgs_serve.api.routes import Service, router
from msdgs_serve.api.settings import Settings
from msdgs_serve.renderer import Renderer
from msdgs_serve.store import SceneStore

DESCRIPTION = """Frames of moving scenes, for any camera and any time.

World and cameras have OpenCV axes: x right, y down, z forward. Angles are degrees. Every error is
`application/problem+json` (RFC 9457) and names the fields that are wrong."""


def create_app(store: SceneStore, renderer: Renderer, settings: Settings) -> FastAPI:
    """The service over the scenes of `store`. Loads the first of them, for the examples at /docs."""
    app = FastAPI(title="msdgs", version=__version__, description=DESCRIPTION)
    slots = anyio.CapacityLimiter(settings.concurrent_renders)
    app.state.service = Service(store, renderer, settings.max_pixels, slots)
    app.include_router(router)
    install_error_handlers(app)
    install_openapi(app, render_examples(store))
    app.add_middleware(BodyLimit, max_bytes=settings.max_body_bytes)
    return app
