"""Writing a site: a folder with the page, the viewer, onnxruntime-web, the scene and their licenses."""

import gzip
import json
import shlex
from importlib.metadata import distribution
from pathlib import Path

from rich.console import Console

from msdgs_export.exporters.site.page import PREVIEW, PREVIEW_SIZE, PageText, folder_url, iframe, site_page
from msdgs_export.exporters.site.runtime import site_runtime
from msdgs_export.options import WEB_MB, ConvertOptions
from msdgs_serve.browser import PAGE, RUNTIME, viewer_files
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.description import described
from msdgs_serve.framing import framing
from msdgs_serve.imaging import encode
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene.camera import Camera, orbit
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import PREFIX, made_folder, move_all, temporary_folder

FORMAT = "msdgs-site/1"
DESCRIPTION = "scene.json"
SERVICE = "service/"
"""The part of the viewer that needs the service."""
AZIMUTH, ELEVATION = 30.0, 20.0
"""Of the view that the page opens with, degrees."""
MIN_SAVED = 0.1
"""Part of the scene's bytes that gzip has to save: browsers take time to unpack it."""
LICENSE = "LICENSE.txt"


def write_site(session: DeformationSession, options: ConvertOptions, console: Console) -> None:
    """Write the folder `options.out`, whole or not at all, and print how to look at it.

    Raises `InvalidInput` for an address that isn't one and for a folder that holds anything but a site,
    `RuntimeMissing` and `WriteFailed`.
    """
    out = options.out
    for name in ("t", "frames", "min_psnr"):
        if getattr(options, name) is not None:
            raise InvalidInput(name, "left out for a site, which holds the scene itself", getattr(options, name))
    text = _text(session, options)
    replaced = _replaceable(out)
    files = _files(session, options, text, site_runtime(options.onnxruntime_web, console))
    with made_folder(out):
        _replace(out, replaced, files)
    _tell(out, text, files, console)


def _replace(out: Path, replaced: set[str], files: dict[str, bytes]) -> None:
    """Write files into a folder in the place of the entries named `replaced`: all, or none.

    The folder itself stays, as others may hold on to it: a mount point, a container, a server.
    """
    with temporary_folder(out, out) as folder:
        new, old = folder / "new", folder / "old"
        old.mkdir()
        for path, contents in files.items():
            (new / path).parent.mkdir(parents=True, exist_ok=True)
            (new / path).write_bytes(contents)
        move_all([(out / name, old / name) for name in replaced] + [(path, out / path.name) for path in new.iterdir()])


def _text(session: DeformationSession, options: ConvertOptions) -> PageText:
    title = _printable(options.title or "") or _printable(options.scene.stem)
    moves = "A moving scene" if session.scene.changes else "A scene"
    description = f"{moves} of {len(session.scene):,} Gaussians, to look at from all sides."
    url = None if options.url is None else folder_url(options.url)
    return PageText(title, _printable(options.description or "") or description, url)


def _printable(text: str) -> str:
    """Text in one line, in which bytes of arguments and file names that are no text are replaced."""
    return " ".join(text.encode("utf-8", "replace").decode().split())


def _replaceable(out: Path) -> set[str]:
    """The names in `out` of what a site consists of. Raises `InvalidInput` if it is a file, or holds other files."""
    if out.exists() and not out.is_dir():
        raise InvalidInput("out", "a folder", str(out))
    try:
        written = set(json.loads((out / DESCRIPTION).read_text())["files"])
    except (OSError, ValueError, LookupError, TypeError):
        written = set()
    files = [path.relative_to(out) for path in out.rglob("*") if path.is_file()]
    files = [path for path in files if not path.parts[0].startswith(PREFIX)]
    others = sorted(path.as_posix() for path in files if path.as_posix() not in written)
    if others:
        found = f"{out}, which also holds {', '.join(others[:3])}"
        raise InvalidInput("out", "a new folder, or one that holds nothing but a site", found)
    return {path.parts[0] for path in files}


def _files(
    session: DeformationSession, options: ConvertOptions, text: PageText, runtime: dict[str, bytes]
) -> dict[str, bytes]:
    """The contents of all files by their paths."""
    viewer = viewer_files()
    page = site_page(viewer.pop(PAGE).decode(), text)
    scene = options.scene.read_bytes()
    packed = gzip.compress(scene, mtime=0)
    is_smaller = len(packed) <= (1 - MIN_SAVED) * len(scene)
    stored_name, stored = ("scene.onnx.gz", packed) if is_smaller else ("scene.onnx", scene)
    files = {
        PAGE: page.encode(),
        PREVIEW: _preview(session),
        stored_name: stored,
        LICENSE: _license(),
        **{f"viewer/{path}": contents for path, contents in viewer.items() if not path.startswith(SERVICE)},
        **{f"{RUNTIME}/{name}": contents for name, contents in runtime.items()},
    }
    metadata = session.scene.metadata
    description = {
        "format": FORMAT,
        "name": _printable(options.scene.stem),
        "file": {"path": stored_name, "size": len(scene), "stored": len(stored)},
        **described(session, metadata.in_world(), framing(metadata)),
        "files": [*files, DESCRIPTION],
    }
    return files | {DESCRIPTION: json.dumps(description).encode()}


def _preview(session: DeformationSession) -> bytes:
    """The view that the page opens with, as a JPEG."""
    metadata = session.scene.metadata
    view = framing(metadata)
    pose = orbit(view.target, view.distance, AZIMUTH, ELEVATION, view.up)
    camera = Camera.from_fov(pose, *PREVIEW_SIZE, view.fov_y)
    return encode(Renderer().render(session, camera, metadata.time_range[0]), "jpeg")


def _license() -> bytes:
    """The license of this package, which the viewer's files are under."""
    text = distribution("msdgs").read_text("licenses/LICENSE")
    assert text is not None
    return text.encode()


def _tell(out: Path, text: PageText, files: dict[str, bytes], console: Console) -> None:
    scene = next(len(contents) for path, contents in files.items() if path.startswith("scene.onnx"))
    size = sum(map(len, files.values()))
    lines = [
        f"{out}: {len(files)} files, {size / 1e6:.1f} MB, of which the scene has {scene / 1e6:.1f} MB",
        f"to look at it: python -m http.server -d {shlex.quote(str(out))}",
        "then open http://localhost:8000",
        f"to show it in another page: {iframe(text, out.absolute().name)}",
    ]
    if scene > 1e6 * WEB_MB:
        lines.append("msdgs-export --for-web writes a scene with fewer bytes")
    for line in lines:
        console.print(line, markup=False)
