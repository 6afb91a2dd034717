"""The viewer at `/`, which shows scenes in a browser: the static files of `msdgs_serve/viewer`."""

import hashlib
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import Response

from msdgs_serve.api.errors import RequestRejected
from msdgs_serve.api.frames import IfNoneMatch, is_unchanged

FOLDER = Path(__file__).parents[2] / "viewer"
PAGE = "index.html"
MEDIA_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


@dataclass(frozen=True)
class PageFile:
    """A file of the viewer, in memory."""

    content: bytes
    media_type: str
    etag: str


def _read(folder: Path) -> dict[str, PageFile]:
    """Read the viewer's files by name. Requests never open files, so that no path can escape the folder."""
    files: dict[str, PageFile] = {}
    for path in folder.iterdir():
        if path.suffix in MEDIA_TYPES:
            content = path.read_bytes()
            etag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
            files[path.name] = PageFile(content, MEDIA_TYPES[path.suffix], etag)
    return files


FILES = _read(FOLDER)

router = APIRouter(include_in_schema=False)


@router.get("/")
async def page(if_none_match: IfNoneMatch = None) -> Response:
    """Return the page."""
    return _answer(FILES[PAGE], if_none_match)


@router.get("/viewer/{name}")
async def page_file(name: str, if_none_match: IfNoneMatch = None) -> Response:
    """Return a file of the page."""
    if name not in FILES:
        raise RequestRejected(HTTPStatus.NOT_FOUND, "not_found", "The viewer has no such file.")
    return _answer(FILES[name], if_none_match)


def _answer(file: PageFile, if_none_match: str | None) -> Response:
    headers = {**HEADERS, "ETag": file.etag}
    if is_unchanged(if_none_match, file.etag):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    return Response(file.content, media_type=file.media_type, headers=headers)
