"""What a page in a browser loads: the viewer's files, and those of onnxruntime-web, with which it draws by itself."""

import gzip
from importlib.util import find_spec
from pathlib import Path

from msdgs_serve.scene.errors import InvalidInput

VIEWER = Path(__file__).parent / "viewer"
PAGE = "index.html"
MEDIA_TYPES = {
    ".css": "text/css",
    ".html": "text/html",
    ".js": "text/javascript",
    ".mjs": "text/javascript",
    ".svg": "image/svg+xml",
    ".txt": "text/plain",
    ".wasm": "application/octet-stream",  # gzipped
}

RUNTIME = "onnxruntime-web"
"""The npm package, and the folder that the viewer finds its files in."""
RUNTIME_MODULES = ("ort.wasm.min.mjs", "ort-wasm-simd-threaded.mjs")
RUNTIME_WASM = "ort-wasm-simd-threaded.wasm"
GZIP = b"\x1f\x8b"
LICENSES = {"LICENSE": "LICENSE.txt", "ThirdPartyNotices.txt": "ThirdPartyNotices.txt"}
"""Of ONNX Runtime, which its Python package has and onnxruntime-web doesn't; and their names beside its files."""


def viewer_files() -> dict[str, bytes]:
    """The contents of the viewer's files by their paths, such as `local/engine.js`."""
    files = (path for path in sorted(VIEWER.rglob("*")) if path.suffix in MEDIA_TYPES)
    return {path.relative_to(VIEWER).as_posix(): path.read_bytes() for path in files}


def runtime_files(folder: Path) -> dict[str, bytes]:
    """The contents of what pages load of onnxruntime-web, by name: two modules, the wasm in gzip's format, licenses.

    `folder` is the npm package, its folder `dist`, or one that was written from these contents. Raises `InvalidInput`.
    """
    dist = folder / "dist" if (folder / "dist").is_dir() else folder
    try:
        files = {name: (dist / name).read_bytes() for name in (*RUNTIME_MODULES, RUNTIME_WASM)}
    except OSError as error:
        wanted = f"a folder with {', '.join((*RUNTIME_MODULES, RUNTIME_WASM))}, as node_modules/{RUNTIME}/dist"
        raise InvalidInput(
            "onnxruntime_web", wanted, f"{folder}, where {Path(error.filename).name} can't be read"
        ) from None
    if not files[RUNTIME_WASM].startswith(GZIP):
        files[RUNTIME_WASM] = gzip.compress(files[RUNTIME_WASM], mtime=0)
    return files | _licenses()


def _licenses() -> dict[str, bytes]:
    found = find_spec("onnxruntime")
    assert found is not None
    assert found.origin is not None
    package = Path(found.origin).parent
    return {name: (package / file).read_bytes() for file, name in LICENSES.items()}
