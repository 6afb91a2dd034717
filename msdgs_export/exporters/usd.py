"""A scene as OpenUSD: one ParticleField3DGaussianSplat with a time sample of its poses per frame."""

import errno
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from msdgs_export.exporters.upright import upright, upright_offset
from msdgs_export.importers.scene import UP
from msdgs_export.importers.splats.axes import from_right_up_back
from msdgs_export.importers.splats.base import as_float32
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.writing import WriteFailed

FRAMES_PER_SECOND = 24
EXTENT = 3.0
"""Standard deviations of a Gaussian within the extent."""

PRIM = "/Splats"
"""Also the default prim."""

HARMONICS = "radiance:sphericalHarmonics"
_NAMES = {"opacities": "opacities", "sh": f"{HARMONICS}Coefficients"}


def write_usd(
    file: Path,
    gaussians: Callable[[float], Gaussians],
    times: Sequence[float],
    changing: Sequence[str] = (),
    on_frame: Callable[[], object] = lambda: None,
    up: np.ndarray = UP,
    offset: Sequence[float] = (0.0, 0.0, 0.0),
) -> None:
    """Write the Gaussians at some times as frames 0, 1, …, or one time without samples. float32, activated; the prim is
    rotated so that the scene's `up`, [3], is y, and moved by `offset`, [3], in the scene's axes.

    Opacities and SH are those of the first time unless they are `changing`. Raises `InvalidInput` if OpenUSD or its
    schema is missing.
    """
    usd, vol, geom, vt, gf = _modules(file)
    stage = usd.Stage.CreateInMemory()
    geom.SetStageUpAxis(stage, geom.Tokens.y)
    geom.SetStageMetersPerUnit(stage, geom.LinearUnits.meters)
    field = vol.ParticleField3DGaussianSplat.Define(stage, PRIM)
    prim = field.GetPrim()
    stage.SetDefaultPrim(prim)
    x, y, z, w = upright(up)
    if any(offset):
        geom.Xformable(prim).AddTranslateOp(geom.XformOp.PrecisionDouble).Set(gf.Vec3d(*upright_offset(offset, up)))
    geom.Xformable(prim).AddOrientOp(geom.XformOp.PrecisionDouble).Set(gf.Quatd(w, x, y, z))
    for number, t in enumerate(times):
        g = gaussians(t)
        means, quats, sh = from_right_up_back(g.means, g.quats, g.sh)
        samples = {
            "positions": vt.Vec3fArray.FromNumpy(as_float32(means)),
            "orientations": vt.QuatfArray.FromNumpy(as_float32(quats[:, [1, 2, 3, 0]])),
            "scales": vt.Vec3fArray.FromNumpy(as_float32(g.scales)),
            "extent": vt.Vec3fArray.FromNumpy(_extent(means, g.scales)),
        }
        appearance = {
            "opacities": vt.FloatArray.FromNumpy(as_float32(g.opacities)),
            "sh": vt.Vec3fArray.FromNumpy(as_float32(sh).reshape(-1, 3)),
        }
        samples |= {_NAMES[name]: values for name, values in appearance.items() if name in changing}
        for name, values in samples.items():
            prim.GetAttribute(name).Set(values, *([number] if len(times) > 1 else []))
        if not number:
            prim.GetAttribute(f"{HARMONICS}Degree").Set(g.sh_degree)
            for name, values in appearance.items():
                if name not in changing:
                    prim.GetAttribute(_NAMES[name]).Set(values)
        on_frame()
    if len(times) > 1:
        stage.SetTimeCodesPerSecond(FRAMES_PER_SECOND)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(times) - 1)
    try:
        stage.Export(str(file))
    except RuntimeError:  # OpenUSD doesn't tell why
        problem = OSError(errno.EIO, "OpenUSD couldn't write it; is there space on the disk?")
        raise WriteFailed(file, problem) from None


def _extent(means: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """[2, 3] corners of a box around all Gaussians."""
    radii = EXTENT * scales.max(axis=1, keepdims=True)
    return as_float32(np.stack([(means - radii).min(axis=0), (means + radii).max(axis=0)]))


def read_usd(file: Path) -> Callable[[int], Gaussians]:
    """Read a file of `write_usd`; returns a function from frame numbers to Gaussians, in the axes of the scene."""
    usd, *_ = _modules(file)
    stage = usd.Stage.Open(str(file))  # prims are valid as long as it exists

    def read(name: str, frame: int) -> np.ndarray:
        return np.array(stage.GetDefaultPrim().GetAttribute(name).Get(frame))

    def shown(frame: int) -> Gaussians:
        degree = stage.GetDefaultPrim().GetAttribute(f"{HARMONICS}Degree").Get()
        means, opacities = read("positions", frame), read(_NAMES["opacities"], frame)
        sh = read(_NAMES["sh"], frame).reshape(len(means), (degree + 1) ** 2, 3)
        quats = read("orientations", frame)[:, [3, 0, 1, 2]]
        means, quats, sh = (as_float32(array) for array in from_right_up_back(means, quats, sh))
        return Gaussians(means, quats, as_float32(read("scales", frame)), as_float32(opacities), sh).validate()

    return shown


def _modules(file: Path) -> tuple[Any, ...]:
    """Modules of OpenUSD, which has no type stubs."""
    try:
        from pxr import Gf, Usd, UsdGeom, UsdVol, Vt
    except ModuleNotFoundError:
        raise InvalidInput(
            "out", "another format, or pip install 'msdgs[usd]'", f"{file.name} without OpenUSD"
        ) from None
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise InvalidInput("out", "another format, or OpenUSD 26.3 or later", f"{file.name} with an older version")
    return Usd, UsdVol, UsdGeom, Vt, Gf
