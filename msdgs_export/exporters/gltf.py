"""The Gaussians at one time as binary glTF with KHR_gaussian_splatting: points with Gaussians as attributes."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from msdgs_export.exporters.upright import upright, upright_offset
from msdgs_export.importers.scene import UP
from msdgs_export.importers.splats.axes import from_right_up_back
from msdgs_serve.imaging.image import srgb_to_linear
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.spherical_harmonics import SH_C0

EXTENSION = "KHR_gaussian_splatting"
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
MAX_BYTES = 2**32 - 1
FLOAT, SHORT, POINTS, VERTICES = 5126, 5123, 0, 34962
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
COLUMNS = {name: columns for columns, name in TYPES.items()}
PRIMITIVE = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}


def write_gltf(
    file: Path, gaussians: Gaussians, up: np.ndarray = UP, offset: Sequence[float] = (0.0, 0.0, 0.0)
) -> None:
    """Write all Gaussians, activated, float32; axes right, up, back, and a node whose rotation turns the scene's `up`,
    [3], to y and that is moved by `offset`, [3], in the scene's axes. Viewers without the extension show points.

    Raises `InvalidInput` for none, which glTF can't hold, and for more than 4 GiB.
    """
    if not len(gaussians):
        raise InvalidInput("scene", "of one or more Gaussians for glTF", 0)
    means, quats, sh = from_right_up_back(gaussians.means, gaussians.quats, gaussians.sh)
    linear = srgb_to_linear((SH_C0 * sh[:, 0] + 0.5).clip(0, 1))
    colors = np.concatenate([linear, gaussians.opacities[:, None]], axis=1)
    attributes = {
        "POSITION": means,
        "COLOR_0": np.round(65535 * colors).astype("<u2"),
        f"{EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": gaussians.scales,
        f"{EXTENSION}:OPACITY": gaussians.opacities,
        **{name: sh[:, i] for i, name in enumerate(_sh_names(gaussians.sh_degree))},
    }
    accessors, views, parts, at = [], [], [], 0
    for name, values in attributes.items():
        part = np.ascontiguousarray(values, values.dtype if values.dtype == np.uint16 else "<f4")
        views.append({"buffer": 0, "byteOffset": at, "byteLength": part.nbytes, "target": VERTICES})
        accessors.append(_accessor(name, part, len(views) - 1))
        parts.append(part.tobytes())
        at += part.nbytes
    document = {
        "asset": {"version": "2.0", "generator": "msdgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": upright(up), **_translation(offset, up)}],
        "meshes": [{"primitives": [_primitive(list(attributes))]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    size = HEADER.size + 2 * CHUNK.size + len(text) + at
    if size > MAX_BYTES:
        raise InvalidInput("scene", f"at most {MAX_BYTES:,} bytes as glTF; a PLY may be larger", f"{size:,}")
    with file.open("wb") as stream:
        stream.write(HEADER.pack(b"glTF", 2, size))
        stream.write(CHUNK.pack(len(text), b"JSON") + text + CHUNK.pack(at, b"BIN\0"))
        for part in parts:
            stream.write(part)


def read_gltf(file: Path) -> Gaussians:
    """Read a file of `write_gltf`, in the axes of the scene: without the rotation and translation of its node."""
    contents = file.read_bytes()
    size, _ = CHUNK.unpack_from(contents, HEADER.size)
    start = HEADER.size + CHUNK.size
    document, body = json.loads(contents[start : start + size]), contents[start + size + CHUNK.size :]
    (primitive,) = document["meshes"][0]["primitives"]

    def read(name: str) -> np.ndarray:
        accessor = document["accessors"][primitive["attributes"][name]]
        view, columns = document["bufferViews"][accessor["bufferView"]], COLUMNS[accessor["type"]]
        values = np.frombuffer(body, "<f4", accessor["count"] * columns, view["byteOffset"])
        return values.reshape(-1, columns)

    degree = max(int(name.split("_")[-3]) for name in primitive["attributes"] if "SH_DEGREE" in name)
    sh = np.stack([read(name) for name in _sh_names(degree)], axis=1)
    quats = read(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]]
    means, quats, sh = (array.astype(np.float32) for array in from_right_up_back(read("POSITION"), quats, sh))
    return Gaussians(means, quats, read(f"{EXTENSION}:SCALE"), read(f"{EXTENSION}:OPACITY")[:, 0], sh).validate()


def _translation(offset: Sequence[float], up: np.ndarray) -> dict[str, list[float]]:
    return {"translation": upright_offset(offset, up)} if any(offset) else {}


def _sh_names(degree: int) -> list[str]:
    return [f"{EXTENSION}:SH_DEGREE_{band}_COEF_{i}" for band in range(degree + 1) for i in range(2 * band + 1)]


def _primitive(names: list[str]) -> dict[str, Any]:
    attributes = {name: i for i, name in enumerate(names)}
    return {"mode": POINTS, "attributes": attributes, "extensions": {EXTENSION: PRIMITIVE}}


def _accessor(name: str, part: np.ndarray, view: int) -> dict[str, Any]:
    columns = part.shape[1] if part.ndim == 2 else 1
    accessor = {"bufferView": view, "count": len(part), "type": TYPES[columns]}
    accessor |= {"componentType": FLOAT} if part.dtype != np.uint16 else {"componentType": SHORT, "normalized": True}
    if name == "POSITION":
        accessor |= {"min": part.min(axis=0).tolist(), "max": part.max(axis=0).tolist()}
    return accessor
