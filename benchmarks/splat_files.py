"""Files of trained splats as Gaussians: .splat, and PLY as INRIA's code writes it."""

from pathlib import Path

import numpy as np

from msdgs_serve.scene import Gaussians
from msdgs_serve.scene.spherical_harmonics import SH_C0

SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
"""A record of a .splat file; quaternions w x y z as 128 + 128 q."""


def read_records(path: Path) -> np.ndarray:
    """A .splat file's records; those that a PLY would have as a .splat file."""
    return np.fromfile(path, SPLAT) if path.suffix == ".splat" else records_of(read_gaussians(path))


def read_gaussians(path: Path) -> Gaussians:
    """Of a .splat file, or of a PLY that is binary with all properties float32; float32, all harmonics it has."""
    if not path.is_file():
        raise SystemExit(f"{path} is no file; name .splat or .ply files themselves")
    if path.suffix == ".splat":
        return gaussians_of(np.fromfile(path, SPLAT))
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in header.decode().splitlines()]
    count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
    names = [line[2] for line in lines if line[:2] == ["property", "float"]]
    if not {"x", "rot_3", "f_dc_2", "opacity"} <= set(names) or "format binary_little_endian" not in header.decode():
        raise SystemExit(f"{path} is no PLY as INRIA's code writes it: binary, all properties float, rot_0 to rot_3")
    table = np.frombuffer(body, [(name, "<f4") for name in names], count)

    def columns(*names: str) -> np.ndarray:
        return np.stack([table[name] for name in names], axis=1)

    quats = columns("rot_0", "rot_1", "rot_2", "rot_3")
    above_0 = columns(*(f"f_rest_{k}" for k in range(sum(name.startswith("f_rest_") for name in names))))
    sh = [columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], above_0.reshape(count, 3, -1).transpose(0, 2, 1)]
    return Gaussians(
        means=columns("x", "y", "z"),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(columns("scale_0", "scale_1", "scale_2")),
        opacities=1 / (1 + np.exp(-table["opacity"])),
        sh=np.ascontiguousarray(np.concatenate(sh, axis=1)),
    )


def gaussians_of(records: np.ndarray) -> Gaussians:
    """What the records of a .splat file say, in float32."""
    quats = (records["quats"].astype(np.float32) - 128) / 128
    rgba = records["rgba"].astype(np.float32) / 255
    return Gaussians(
        means=np.ascontiguousarray(records["means"]),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.ascontiguousarray(records["scales"]),
        opacities=np.ascontiguousarray(rgba[:, 3]),
        sh=(rgba[:, None, :3] - 0.5) / np.float32(SH_C0),
    )


def records_of(gaussians: Gaussians) -> np.ndarray:
    """Rounded to what a .splat file can say: 8 bits, no harmonics beyond the constant."""
    records = np.zeros(len(gaussians), SPLAT)
    records["means"], records["scales"] = gaussians.means, gaussians.scales
    colors = 0.5 + SH_C0 * gaussians.sh[:, 0]
    records["rgba"] = np.clip(np.round(255 * np.column_stack([colors, gaussians.opacities])), 0, 255)
    records["quats"] = to_bytes(gaussians.quats)
    return records


def to_bytes(quats: np.ndarray) -> np.ndarray:
    """Quaternions [N, 4], any length, as a .splat file has them."""
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return np.clip(np.round(quats * 128 + 128), 0, 255).astype(np.uint8)
