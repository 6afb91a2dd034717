"""The viewer at `/`, which shows scenes in a browser: static files."""

import hashlib
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path, PurePosixPath
from typing import Annotated

from fastapi import APIRouter, Depends, Request
from fastapi.responses import Response

from msdgs_serve.api.errors import RequestRejected
from msdgs_serve.api.frames import IfNoneMatch, is_unchanged
from msdgs_serve.browser import MEDIA_TYPES, PAGE, RUNTIME, runtime_files, viewer_files

SCRIPTS, SCRIPTS_AND_WASM = "script-src 'self'", "script-src 'self' 'wasm-unsafe-eval'; worker-src 'self'"
POLICY = (
    "default-src 'none'; {scripts}; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
DRAWS = (b"<html ", f'<html data-runtime="viewer/{RUNTIME}/" '.encode())
"""What tells the page that it can draw by itself: a replacement in `PAGE`."""


@dataclass(frozen=True)
class PageFile:
    """A file of the viewer, in memory."""

    content: bytes
    media_type: str
    etag: str


class PageFiles:
    """The viewer's files by their paths. Requests never open files, so that no path can escape a folder."""

    def __init__(self, runtime: Path | None) -> None:
        """`runtime`: the folder of onnxruntime-web, if the page may draw by itself. Raises `InvalidInput`."""
        contents = viewer_files()
        if runtime is not None:
            contents[PAGE] = contents[PAGE].replace(*DRAWS)
            contents |= {f"{RUNTIME}/{name}": content for name, content in runtime_files(runtime).items()}
        self.headers = HEADERS | {
            "Content-Security-Policy": POLICY.format(scripts=SCRIPTS if runtime is None else SCRIPTS_AND_WASM)
        }
        self._files = {path: _page_file(path, content) for path, content in contents.items()}

    def get(self, path: str) -> PageFile:
        """The file of a path. Raises `RequestRejected` if there is none."""
        if path not in self._files:
            raise RequestRejected(HTTPStatus.NOT_FOUND, "not_found", "The viewer has no such file.")
        return self._files[path]


def _page_file(path: str, content: bytes) -> PageFile:
    media_type = MEDIA_TYPES[PurePosixPath(path).suffix]
    return PageFile(content, media_type, f'"{hashlib.sha256(content).hexdigest()[:32]}"')


def _page_files(request: Request) -> PageFiles:
    return request.app.state.page_files


Files = Annotated[PageFiles, Depends(_page_files)]
router = APIRouter(include_in_schema=False)


@router.get("/")
async def page(files: Files, if_none_match: IfNoneMatch = None) -> Response:
    """Return the page."""
    return _answer(files, PAGE, if_none_match)


@router.get("/viewer/{name}")
async def page_file(name: str, files: Files, if_none_match: IfNoneMatch = None) -> Response:
    """Return a file of the page."""
    return _answer(files, name, if_none_match)


@router.get("/viewer/{folder}/{name}")
async def page_part(folder: str, name: str, files: Files, if_none_match: IfNoneMatch = None) -> Response:
    """Return a file of a part of the page."""
    return _answer(files, f"{folder}/{name}", if_none_match)


def _answer(files: PageFiles, path: str, if_none_match: str | None) -> Response:
    file = files.get(path)
    headers = {**files.headers, "ETag": file.etag}
    if is_unchanged(if_none_match, file.etag):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    return Response(file.content, media_type=file.media_type, headers=headers)
