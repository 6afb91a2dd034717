"""A renderer written by hand for AVX-512, built by the machine's own g++ and called through ctypes.

python -m benchmarks.rasterizer.avx512                          compare its images with ours
python -m benchmarks.rasterizer.renderers --avx512 --repeats 20  compare times
"""

import ctypes
import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.measuring import psnr
from benchmarks.rasterizer.scenes import Case, object_camera, object_scene
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, rasterize
from msdgs_serve.rasterizer.view import view_of
from msdgs_serve.scene import Camera, Gaussians
from msdgs_serve.threads import thread_count

SOURCE = Path(__file__).with_suffix(".cpp")
BUILT = Path(__file__).resolve().parents[2] / "out" / "avx512"
FLAGS = ("-std=c++20", "-O3", "-march=native", "-ffp-contract=fast", "-shared", "-fPIC", "-pthread")
NEEDED = {"avx512f", "avx512bw", "avx512dq", "avx512vl"}
STAGES = ("project", "bin", "composite")
"""`bin` includes sorting, as in `benchmarks.rasterizer.stages`."""
CHECKED = ((1, 64, 48), (1001, 150, 101), (10_000, 400, 400))  # Gaussians, width, height
MIN_PSNR = 70  # dB: at thresholds some decisions differ by round-off


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
    """Why the renderer can't be built or run on this machine; None if it can."""
    if shutil.which("g++") is None:
        return "there is no g++"
    try:
        flags = Path("/proc/cpuinfo").read_text().split()
    except OSError:
        return "there is no /proc/cpuinfo to ask for AVX-512"
    missing = sorted(NEEDED - set(flags))
    return f"the processor has no {', '.join(missing)}" if missing else None


class Avx512Renderer:
    """Draws pinhole frames of float32 Gaussians with SH of degree 3, on as many threads as the service."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(str(_built()))
        self._library.new_renderer.restype = ctypes.c_void_p
        self._renderer = ctypes.c_void_p(self._library.new_renderer(thread_count()))

    def __enter__(self) -> "Avx512Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free its memory."""
        self._library.delete_renderer(self._renderer)

    def draw(self, gaussians: Gaussians, camera: Camera, options: RasterizerOptions) -> Drawn:
        """Draw a frame over black."""
        g = gaussians
        arrays = (g.means, g.quats, g.scales, g.opacities, g.sh)
        if camera.model != "pinhole" or options.mip or g.sh_degree != 3:
            raise ValueError("it draws only with a pinhole camera, without mip filter and with SH of degree 3")
        if not all(array.dtype == np.float32 and array.flags.c_contiguous for array in arrays):
            raise ValueError("the Gaussians must be float32 in C order")
        view = view_of(camera, options)._asdict() | options._asdict()
        view |= {"width": camera.width, "height": camera.height, "background": np.zeros(3)}
        values = [view[name] for name, *_ in _View._fields_]
        rgb, seconds = np.empty((camera.height, camera.width, 3), np.float32), np.empty(4)
        self._library.draw(
            self._renderer,
            ctypes.byref(_Scene(len(g), *(array.ctypes.data for array in arrays))),
            ctypes.byref(_View(*(tuple(np.ravel(v)) if isinstance(v, tuple | np.ndarray) else v for v in values))),
            ctypes.c_void_p(rgb.ctypes.data),
            ctypes.c_void_p(seconds.ctypes.data),
        )
        project, sort, binned, composite = seconds.tolist()
        return Drawn(rgb, dict(zip(STAGES, (project, sort + binned, composite), strict=True)))


def _built() -> Path:
    """The compiled library, compiled first if the source has changed."""
    library = BUILT / f"renderer-{hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:16]}.so"
    if not library.exists():
        BUILT.mkdir(parents=True, exist_ok=True)
        part = library.with_suffix(f".{os.getpid()}")
        subprocess.run(["g++", *FLAGS, "-o", str(part), str(SOURCE)], check=True)
        os.replace(part, library)
    return library


def check() -> int:
    """Draw small scenes with both renderers and compare; twice, since threads must not change the image."""
    if reason := why_not():
        print(f"not checked: {reason}")
        return 0
    with Avx512Renderer() as renderer:
        for count, width, height in CHECKED:
            case = Case("seeded", object_scene(count), object_camera(width, height))
            image, again = (renderer.draw(case.gaussians, case.camera, GSPLAT).rgb for _ in range(2))
            agreement = psnr(image, rasterize(case.gaussians, case.camera).rgb)
            print(f"{case.title()}, {case.size()}: {agreement:.1f} dB to ours")
            assert agreement >= MIN_PSNR
            np.testing.assert_array_equal(image, again)
    return 0


if __name__ == "__main__":
    sys.exit(check())
