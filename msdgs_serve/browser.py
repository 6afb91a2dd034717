"""What a page in a browser loads: the viewer's files, and those of onnxruntime-web, with which it draws by itself."""

import gzip
from importlib.util import find_spec
from pathlib import Path

from msdgs_serve.scene.errors import InvalidInput

VIEWER = Path(__file__).parent / "viewer"
PAGE = "index.html"
MEDIA_TYPES = {
    ".css": "text/css",
    ".gz": "application/gzip",
    ".html": "text/html",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
    ".txt": "text/plain",
}

RUNTIME = "onnxruntime-web"
"""The npm package, and the folder that the viewer finds its files in."""
RUNTIME_FILES = {
    "ort.wasm.min.mjs": "ort.js",
    "ort-wasm-simd-threaded.mjs": "ort-wasm.js",
    "ort-wasm-simd-threaded.wasm": "ort-wasm.wasm.gz",
}
"""The package's files in its folder `dist`, and their names for pages: many servers send `.mjs` as a type that browsers
refuse in a script, and few compress wasm."""
GZIP = b"\x1f\x8b"
LICENSES = {"LICENSE": "LICENSE.txt", "ThirdPartyNotices.txt": "ThirdPartyNotices.txt"}
"""Of ONNX Runtime, which its Python package has and onnxruntime-web doesn't; and their names beside its files."""


def viewer_files() -> dict[str, bytes]:
    """The contents of the viewer's files by their paths, such as `local/engine.js`."""
    files = (path for path in sorted(VIEWER.rglob("*")) if path.suffix in MEDIA_TYPES)
    return {path.relative_to(VIEWER).as_posix(): path.read_bytes() for path in files}


def runtime_files(folder: Path) -> dict[str, bytes]:
    """The contents of what pages load of onnxruntime-web, and of its licenses, by the names for pages.

    `folder` is the npm package, or one with its three files, the wasm as it is or gzipped. Raises `InvalidInput`.
    """
    dist = folder / "dist" if (folder / "dist").is_dir() else folder
    try:
        files = {name: (dist / file).read_bytes() for file, name in RUNTIME_FILES.items()}
    except OSError as error:
        wanted = f"a folder with {', '.join(RUNTIME_FILES)}, as node_modules/{RUNTIME}/dist"
        missing = Path(error.filename).name
        raise InvalidInput("onnxruntime_web", wanted, f"{folder}, where {missing} can't be read") from None
    for name, contents in files.items():
        if name.endswith(".gz") and not contents.startswith(GZIP):
            files[name] = gzip.compress(contents, mtime=0)
    return files | _licenses()


def _licenses() -> dict[str, bytes]:
    found = find_spec("onnxruntime")
    assert found is not None
    assert found.origin is not None
    package = Path(found.origin).parent
    return {name: (package / file).read_bytes() for file, name in LICENSES.items()}
