"""Create the application from routes, error handlers, middleware and the service."""

from fastapi import FastAPI
from fastapi.routing import APIRoute
from fastapi_offline import FastAPIOffline
from starlette.middleware.cors import CORSMiddleware

from msdgs_serve import __version__
from msdgs_serve.api.admission import Admission
from msdgs_serve.api.body_limit import BodyLimit
from msdgs_serve.api.errors import install_error_handlers
from msdgs_serve.api.keys import KeyCheck, read_keys
from msdgs_serve.api.methods import Head
from msdgs_serve.api.observe import REQUEST_ID, Observe
from msdgs_serve.api.openapi import install_openapi
from msdgs_serve.api.prefix import BehindProxy
from msdgs_serve.api.routes import batch, health, render, scenes, video, viewer
from msdgs_serve.api.service import Service
from msdgs_serve.api.settings import Settings
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene import InvalidInput
from msdgs_serve.store import SceneStore

DESCRIPTION = """Frames of dynamic Gaussian scenes, for any camera and any time.

Cameras have OpenCV axes: x right, y down, z forward. Angles are degrees. Every error, but of browsers' preflights, is
`application/problem+json` (RFC 9457) and names the invalid fields. Every response has an `X-Request-ID`, which is the
client's own if it sends a valid one."""

STREAMED = (("POST", "/scenes"),)
FRAME_HEADERS = ("Msdgs-Scene", "Msdgs-Plan", "Msdgs-Error", "Msdgs-Channels", "Msdgs-Warning")
EXPOSED_HEADERS = (REQUEST_ID, "ETag", "Server-Timing", *FRAME_HEADERS, "Retry-After")


def create_app(store: SceneStore, renderer: Renderer, settings: Settings) -> FastAPI:
    """Return the application that serves the scenes of `store`.

    Raises `InvalidInput` if the file of API keys is invalid, or if there is no folder for uploads.
    """
    if settings.uploads and store.folder is None:
        raise InvalidInput("uploads", "given with a folder, to which scenes are added", "only files")
    keys = None if settings.api_keys_file is None else read_keys(settings.api_keys_file)
    service = Service(store, renderer, settings)
    app = FastAPIOffline(
        title="msdgs",
        version=__version__,
        description=DESCRIPTION,
        lifespan=service.lifespan,
        redirect_slashes=False,  # see msdgs_serve.api.errors
    )
    app.state.service = service
    app.state.page_files = viewer.PageFiles(settings.onnxruntime_web)
    for calls in (render, batch, video, scenes, health, viewer):
        app.include_router(calls.router)
    install_error_handlers(app)
    install_openapi(app, store, keys=keys is not None)
    queued = {
        (method, route.path): route
        for calls in (render, batch, video)
        for route in calls.router.routes
        if isinstance(route, APIRoute)
        for method in route.methods or ()
    }
    # the middleware added last is the outermost
    streamed = {("POST", "/render/batch"), ("POST", "/render/video")}
    app.add_middleware(Admission, service.queue, queued, streamed)
    app.add_middleware(BodyLimit, settings.max_body_bytes, settings.body_seconds, STREAMED)
    if keys is not None:
        app.add_middleware(KeyCheck, keys)
    if settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=["*"],
            allow_headers=["*"],
            expose_headers=EXPOSED_HEADERS,
        )
    app.add_middleware(Head)
    app.add_middleware(Observe, service.metrics)
    app.add_middleware(BehindProxy, settings.proxies, settings.root_path)
    return app
