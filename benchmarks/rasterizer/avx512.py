"""A renderer written by hand for AVX-512, built by the machine's own g++ and called through ctypes."""

import ctypes
import hashlib
import os
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer import RasterizerOptions
from msdgs_serve.rasterizer.view import view_of
from msdgs_serve.scene import Camera, Gaussians
from msdgs_serve.threads import thread_count

SOURCE = Path(__file__).with_name("renderer.cpp")
BUILT = Path(__file__).resolve().parents[2] / "out" / "avx512"
FLAGS = ("-std=c++20", "-O3", "-march=native", "-ffp-contract=fast", "-shared", "-fPIC", "-pthread")
NEEDED = {"avx512f", "avx512bw", "avx512dq", "avx512vl"}
STAGES = ("project", "sort", "bin", "composite")


class _Scene(ctypes.Structure):
    _fields_ = (
        ("count", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("means", "quats", "scales", "opacities", "harmonics")),
    )


class _View(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_float * count) for name, count in (("rotation", 9), ("translation", 3), ("position", 3))),
        *((name, ctypes.c_float) for name in ("fx", "fy", "cx", "cy", "min_x", "max_x", "min_y", "max_y")),
        *((name, ctypes.c_float) for name in ("near_plane", "eps2d", "alpha_min", "alpha_max", "transmittance_min")),
        ("background", ctypes.c_float * 3),
        ("width", ctypes.c_int32),
        ("height", ctypes.c_int32),
    )


class Drawn(NamedTuple):
    """A frame."""

    rgb: np.ndarray  # [H, W, 3] float32
    seconds: dict[str, float]  # of each of `STAGES`


def why_not() -> str | None:
    """What keeps this machine from having the renderer; None if nothing does."""
    if shutil.which("g++") is None:
        return "there is no g++"
    try:
        flags = Path("/proc/cpuinfo").read_text().split()
    except OSError:
        return "there is no /proc/cpuinfo to ask for AVX-512"
    missing = sorted(NEEDED - set(flags))
    return f"the processor has no {', '.join(missing)}" if missing else None


class Avx512Renderer:
    """Draws pinhole frames of float32 Gaussians with harmonics of degree 3, on as many threads as ours."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(str(_built()))
        self._library.new_renderer.restype = ctypes.c_void_p
        self._renderer = ctypes.c_void_p(self._library.new_renderer(thread_count()))

    def __enter__(self) -> "Avx512Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give its memory back."""
        self._library.delete_renderer(self._renderer)

    def draw(self, gaussians: Gaussians, camera: Camera, options: RasterizerOptions) -> Drawn:
        """Over black."""
        g = gaussians
        arrays = (g.means, g.quats, g.scales, g.opacities, g.sh)
        if camera.model != "pinhole" or options.mip or g.sh_degree != 3:
            raise ValueError("a pinhole camera, no mip filter and harmonics of degree 3 are all that it can draw")
        if not all(array.dtype == np.float32 and array.flags.c_contiguous for array in arrays):
            raise ValueError("the Gaussians must be float32 in C order")
        view = view_of(camera, options)._asdict() | options._asdict() | {"background": np.zeros(3)}
        values = [view[name] for name, *_ in _View._fields_]
        rgb, seconds = np.empty((camera.height, camera.width, 3), np.float32), np.empty(len(STAGES))
        self._library.draw(
            self._renderer,
            ctypes.byref(_Scene(len(g), *(array.ctypes.data for array in arrays))),
            ctypes.byref(_View(*(tuple(v.ravel()) if isinstance(v, np.ndarray) else v for v in values))),
            ctypes.c_void_p(rgb.ctypes.data),
            ctypes.c_void_p(seconds.ctypes.data),
        )
        return Drawn(rgb, dict(zip(STAGES, seconds.tolist(), strict=True)))


def _built() -> Path:
    """The library of this source, made where it isn't there yet."""
    library = BUILT / f"renderer-{hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:16]}.so"
    if not library.exists():
        BUILT.mkdir(parents=True, exist_ok=True)
        part = library.with_suffix(f".{os.getpid()}")
        subprocess.run(["g++", *FLAGS, "-o", str(part), str(SOURCE)], check=True)
        os.replace(part, library)
    return library
