"""Splat files of each format, small ones, written by hand for the tests of importers."""

import gzip
import io
import json
import struct
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import zstandard

from msdgs_export.exporters.spz import write_spz
from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene.camera import Camera, orbit
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.quaternion import to_matrix
from tests.support.tolerances import tolerance

COUNT = 300
"""Gaussians of a file: more than one chunk of a compressed PLY."""


def some_gaussians(count: int = COUNT, sh_degree: int = 1, seed: int = 0) -> Gaussians:
    """Return Gaussians in the cube [-1, 1]³ whose values all differ."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return Gaussians(
        rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        np.exp(rng.uniform(-4, -2, (count, 3))).astype(np.float32),
        rng.uniform(0.05, 0.95, count).astype(np.float32),
        (0.3 * rng.normal(size=(count, (sh_degree + 1) ** 2, 3))).astype(np.float32),
    )


def inria_columns(g: Gaussians) -> dict[str, np.ndarray]:
    """The properties of INRIA's PLY by name, one loop at a time; no normals."""
    columns: dict[str, np.ndarray] = {axis: g.means[:, i] for i, axis in enumerate("xyz")}
    for channel in range(3):
        columns[f"f_dc_{channel}"] = g.sh[:, 0, channel]
        for k in range(1, g.sh.shape[1]):
            columns[f"f_rest_{channel * (g.sh.shape[1] - 1) + k - 1}"] = g.sh[:, k, channel]
    columns["opacity"] = np.log(g.opacities / (1 - g.opacities))
    columns |= {f"scale_{i}": np.log(g.scales[:, i]) for i in range(3)}
    return columns | {f"rot_{i}": g.quats[:, i] for i in range(4)}


def ply_bytes(columns: dict[str, np.ndarray], form: str = "binary_little_endian", count: int | None = None) -> bytes:
    """A PLY of float columns, in the order given; `count` is what its header says."""
    rows = len(next(iter(columns.values())))
    lines = ["ply", f"format {form} 1.0", f"element vertex {rows if count is None else count}"]
    lines += [f"property float {name}" for name in columns] + ["end_header", ""]
    table = np.stack(list(columns.values()), axis=1).astype("<f4")
    if form == "ascii":
        body = "\n".join(" ".join(repr(float(v)) for v in row) for row in table).encode() + b"\n"
    else:
        body = (table.astype(">f4") if form == "binary_big_endian" else table).tobytes()
    return "\n".join(lines).encode() + body


def compressed_ply_bytes(g: Gaussians) -> bytes:
    """SuperSplat's: a chunk per 256 Gaussians, bytes of -4 to 4 for SH above degree 0."""
    chunks, packed = [], []
    for start in range(0, len(g), 256):
        part = slice(start, start + 256)
        ends, words = [], []
        for values, bits in ((g.means, (11, 10, 11)), (np.log(g.scales), (11, 10, 11)), (_colors(g), (8, 8, 8))):
            low, high = values[part].min(axis=0), values[part].max(axis=0)
            ends += [low, high]
            words.append(_fields((values[part] - low) / np.maximum(high - low, 1e-30), bits))
        largest, small = _three_smallest(g.quats[part])
        rotations = largest << 30 | _fields(small / np.sqrt(2) + 0.5, (10, 10, 10))
        opacities = np.round(255 * g.opacities[part]).astype(np.int64)
        chunks.append(np.concatenate(ends))
        packed.append(np.column_stack([words[0], rotations, words[1], words[2] << 8 | opacities]))
    kinds = ("xyz", ("scale_x", "scale_y", "scale_z"), "rgb")
    names = [f"{end}_{axis}" for axes in kinds for end in ("min", "max") for axis in axes]
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(chunks)}"]
    lines += [f"property float {name}" for name in names] + [f"element vertex {len(g)}"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    rest = g.sh[:, 1:].transpose(0, 2, 1).reshape(len(g), -1)  # sorted by channel
    if rest.size:
        lines += [f"element sh {len(g)}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
    header = "\n".join([*lines, "end_header", ""]).encode()
    body = np.array(chunks, "<f4").tobytes() + np.concatenate(packed).astype("<u4").tobytes()
    return header + body + ((rest / 8 + 0.5) * 256).clip(0, 255).astype(np.uint8).tobytes()


def _colors(g: Gaussians) -> np.ndarray:
    return g.sh[:, 0] * 0.28209479177387814 + 0.5


def _three_smallest(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The index [N] of the largest component, and the others [N, 3], with signs for which it is positive."""
    largest = np.abs(quats).argmax(axis=1)
    return largest, np.array([np.delete(q * np.sign(q[k]), k) for q, k in zip(quats, largest, strict=True)])


def _fields(parts: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """[N] integers of the bits of numbers from 0 to 1, [N, 3]."""
    packed = np.zeros(len(parts), np.int64)
    for column, size in zip(parts.T.astype(np.float64), bits, strict=True):
        packed = packed << size | np.round(column * (2**size - 1)).astype(np.int64)
    return packed


def _rgba(g: Gaussians) -> np.ndarray:
    return np.column_stack([255 * _colors(g), 255 * g.opacities]).round().clip(0, 255).astype(np.uint8)


def splat_bytes(g: Gaussians) -> bytes:
    """`.splat`, degree 0."""
    rows = np.empty(len(g), [("numbers", "<f4", 6), ("color", "u1", 4), ("rotation", "u1", 4)])
    rows["numbers"], rows["color"] = np.column_stack([g.means, g.scales]), _rgba(g)
    rows["rotation"] = (g.quats * 128 + 128).round().clip(0, 255)
    return rows.tobytes()


def ksplat_bytes(g: Gaussians, level: int = 0, sections: int = 1) -> bytes:
    """`.ksplat` 0.1 of SH up to degree 2. Level 0 rounds nothing but colors."""
    least, most = g.sh[:, 1:].min(initial=-1), g.sh[:, 1:].max(initial=1)
    parts = [
        _ksplat_section(Gaussians(*(array[part] for array in vars(g).values())), level, least, most)
        for part in np.array_split(np.arange(len(g)), sections)
    ]
    header = bytearray(4096)
    header[1] = 1
    struct.pack_into("<4IH", header, 4, sections, sections, len(g), len(g), level)
    struct.pack_into("<2f", header, 36, least, most)
    return b"".join([bytes(header), *(head for head, _ in parts), *(body for _, body in parts)])


def _ksplat_section(g: Gaussians, level: int, least: float, most: float) -> tuple[bytes, bytes]:
    """The header and the body of a section. From level 1 on its Gaussians, sorted by x, are in two full buckets and two
    partly filled ones."""
    number, harmonic = ("<f4", "<f4") if level == 0 else ("<f2", "<f2" if level == 1 else "u1")
    degree = {1: 0, 4: 1, 9: 2}[g.sh.shape[1]]
    bands = [g.sh[:, k * k : (k + 1) ** 2].transpose(0, 2, 1).reshape(len(g), 6 * k + 3) for k in range(1, degree + 1)]
    rest = np.concatenate([np.empty((len(g), 0)), *bands], axis=1)
    if level == 2:
        rest = np.round((rest - least) / (most - least) * 255)
    fields = [("place", "<f4" if level == 0 else "<u2", 3), ("size", number, 3), ("turn", number, 4)]
    rows = np.empty(len(g), [*fields, ("color", "u1", 4), ("sh", harmonic, (rest.shape[1],))])
    rows["place"], rows["size"], rows["turn"], rows["color"], rows["sh"] = g.means, g.scales, g.quats, _rgba(g), rest
    header = bytearray(1024)
    struct.pack_into("<2I", header, 0, len(g), len(g))
    struct.pack_into("<H", header, 40, degree)
    buckets = b""
    if level:
        rows = rows[order := np.argsort(g.means[:, 0])]
        full, block, steps = len(g) // 3, 4.0, 30_000
        lengths = [full, full, 1, len(g) - 2 * full - 1]
        starts = np.cumsum([0, *lengths[:-1]])
        centers = np.array(
            [g.means[order[start : start + n]].mean(axis=0) for start, n in zip(starts, lengths, strict=True)]
        )
        around = g.means[order] - np.repeat(centers, lengths, axis=0)
        rows["place"] = np.round(around / (block / 2) * steps) + steps
        buckets = np.array(lengths[2:], "<u4").tobytes() + centers.astype("<f4").tobytes()
        struct.pack_into("<2IfH", header, 8, full, len(lengths), block, 12)
        struct.pack_into("<I", header, 24, steps)
        struct.pack_into("<2I", header, 32, 2, 2)
    struct.pack_into("<I", header, 28, len(buckets) + rows.nbytes)
    return bytes(header), buckets + rows.tobytes()


def spz3_bytes(g: Gaussians) -> bytes:
    """Return a `.spz`, version 3, written by our exporter."""
    with tempfile.TemporaryDirectory() as folder:
        write_spz(Path(folder) / "a.spz", g, "dilate")
        return (Path(folder) / "a.spz").read_bytes()


def spz2_bytes(version3: bytes, quats: np.ndarray) -> bytes:
    """Version 2 of an unpacked version 3 stream: bytes of x, y and z of rotations, whose axes are right, up, back."""
    _, _, count, *rest = struct.unpack_from("<4sIIBBBB", version3)
    xyz = quats[:, 1:] * np.where(quats[:, :1] < 0, -1, 1) * np.array([1, -1, -1])
    rotations = np.round((xyz + 1) * 127.5).astype(np.uint8).tobytes()
    header = struct.pack("<4sIIBBBB", b"NGSP", 2, count, *rest)
    return header + version3[16 : 16 + 16 * count] + rotations + version3[16 + 20 * count :]


def spz_extensions(extensions: dict[int, bytes]) -> bytes:
    """The records of extensions, by number."""
    return b"".join(struct.pack("<II", number, len(payload)) + payload for number, payload in extensions.items())


def spz4_bytes(version3: bytes, extensions: dict[int, bytes] | None = None) -> bytes:
    """Version 4 of an unpacked version 3 stream: the same parts, each in a zstd stream."""
    _, _, count, degree, bits, flags, _ = struct.unpack_from("<4sIIBBBB", version3)
    sizes = [9 * count, count, 3 * count, 3 * count, 4 * count, 3 * ((degree + 1) ** 2 - 1) * count]
    parts, at = [], 16
    for size in sizes[: 6 if degree else 5]:
        parts.append(version3[at : at + size])
        at += size
    packed = [zstandard.compress(part) for part in parts]
    records = spz_extensions(extensions or {})
    flags |= 2 if extensions else 0
    header = struct.pack("<4sIIBBBB", b"NGSP", 4, count, degree, bits, flags, len(parts))
    header += struct.pack("<I12x", 32 + len(records)) + records
    table = b"".join(struct.pack("<QQ", len(small), len(part)) for small, part in zip(packed, parts, strict=True))
    return header + table + b"".join(packed)


def spz_levels_bytes(g: Gaussians, flags: int = 0x80) -> bytes:
    """Version 3, unpacked, with levels of detail as Spark writes them: a root of two nodes, the Gaussians below one of
    them each, and halved opacities."""
    half = len(g) // 2
    nodes = np.array([0, 0, half, *range(len(g))])  # the inner nodes look like some of the leaves, and larger
    larger = np.where(np.arange(len(nodes)) < 3, np.float32(4), np.float32(1))[:, None]
    tree = Gaussians(g.means[nodes], g.quats[nodes], g.scales[nodes] * larger, g.opacities[nodes] / 2, g.sh[nodes])
    packed = bytearray(gzip.decompress(spz3_bytes(tree)))
    packed[14] |= flags
    children = np.zeros(len(nodes), "<u2")
    starts = np.zeros(len(nodes), "<u4")
    children[:3], starts[:3] = (2, half, len(g) - half), (1, 3, 3 + half)
    return bytes(packed) + children.tobytes() + starts.tobytes()


def write_sog(folder: Path, g: Gaussians, palette: int | None = None) -> Path:
    """A SOG folder: codebooks of evenly spread numbers. Harmonics beyond degree 0 are those of the first `palette`
    Gaussians in turns, or each its own."""
    folder.mkdir()
    logs = np.sign(g.means) * np.log1p(np.abs(g.means))
    mins, maxs = logs.min(0), logs.max(0)
    fixed = np.round((logs - mins) / (maxs - mins) * 65535).astype(np.int64)
    scales = np.linspace(-5, -1, 256)
    colors = np.linspace(-2, 2, 256)
    largest, small = _three_smallest(g.quats)
    textures = {
        "means_l.webp": fixed & 255,
        "means_u.webp": fixed >> 8,
        "scales.webp": np.round((np.log(g.scales) + 5) / 4 * 255),
        "quats.webp": np.column_stack([np.round((small * np.sqrt(2) + 1) / 2 * 255), 252 + largest]),
        "sh0.webp": np.column_stack([np.round((g.sh[:, 0] + 2) / 4 * 255), np.round(255 * g.opacities)]),
    }
    for name, values in textures.items():
        _write_webp(folder / name, values)
    meta = {
        "version": 2,
        "count": len(g),
        "means": {"mins": mins.tolist(), "maxs": maxs.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.tolist(), "files": ["sh0.webp"]},
    }
    if g.sh.shape[1] > 1:
        entries, files = palette or len(g), ["shN_centroids.webp", "shN_labels.webp"]
        labels, wide = np.arange(len(g)) % entries, 64 * (g.sh.shape[1] - 1)  # 64 entries side by side
        _write_webp(folder / files[0], np.round((g.sh[:entries, 1:].reshape(-1, 3) + 2) / 4 * 255), wide)
        _write_webp(folder / files[1], np.column_stack([labels & 255, labels >> 8]))
        bands = int(np.sqrt(g.sh.shape[1])) - 1
        meta["shN"] = {"bands": bands, "count": entries, "codebook": colors.tolist(), "files": files}
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


def sog_bytes(g: Gaussians, palette: int | None = None) -> bytes:
    """Return a SOG in a zip."""
    with tempfile.TemporaryDirectory() as folder:
        return zipped(write_sog(Path(folder) / "sog", g, palette))


def zipped(folder: Path, compression: int = zipfile.ZIP_STORED) -> bytes:
    """Return a zip of the files of a folder."""
    contents = io.BytesIO()
    with zipfile.ZipFile(contents, "w", compression) as archive:
        for file in sorted(folder.iterdir()):
            archive.write(file, file.name)
    return contents.getvalue()


def _write_webp(file: Path, values: np.ndarray, width: int | None = None) -> None:
    """Lossless, a row of values a pixel; square where no width is given."""
    width = width or int(np.ceil(np.sqrt(len(values))))
    height = -(-len(values) // width)
    pixels = np.full((height * width, 4), 255, np.uint8)
    pixels[: len(values), : values.shape[1]] = values.clip(0, 255)
    spec = oiio.ImageSpec(width, height, 4, oiio.UINT8)
    spec.attribute("compression", "lossless:100")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    writer = oiio.ImageOutput.create(str(file))
    assert writer is not None
    assert writer.open(str(file), spec), writer.geterror()
    assert writer.write_image(pixels.reshape(height, width, 4))
    writer.close()


FORMATS: dict[str, tuple[str, Callable[[Gaussians], bytes]]] = {
    "ply": ("a.ply", lambda g: ply_bytes(inria_columns(g))),
    "text ply": ("a.ply", lambda g: ply_bytes(inria_columns(g), "ascii")),
    "compressed ply": ("a.compressed.ply", compressed_ply_bytes),
    "splat": ("a.splat", splat_bytes),
    "ksplat": ("a.ksplat", ksplat_bytes),
    "ksplat, level 1": ("a.ksplat", lambda g: ksplat_bytes(g, 1)),
    "ksplat, level 2": ("a.ksplat", lambda g: ksplat_bytes(g, 2, 3)),
    "sog": ("a.sog", sog_bytes),
    "spz 2": ("a.spz", lambda g: gzip.compress(spz2_bytes(gzip.decompress(spz3_bytes(g)), g.quats))),
    "spz 3": ("a.spz", spz3_bytes),
    "spz 3, bare": ("a.spz", lambda g: gzip.decompress(spz3_bytes(g))),
    "spz 4": ("a.spz", lambda g: spz4_bytes(gzip.decompress(spz3_bytes(g)))),
    "spz, levels": ("a.spz", lambda g: gzip.compress(spz_levels_bytes(g))),
}
"""File name and contents for Gaussians, by format."""


def write_splats(folder: Path, file_format: str, g: Gaussians) -> Path:
    """Write a file of one of `FORMATS`."""
    name, contents = FORMATS[file_format]
    (folder / name).write_bytes(contents(g))
    return folder / name


def drawn(g: Gaussians) -> np.ndarray:
    """[48, 64, 3] image of Gaussians from `some_gaussians`."""
    camera = Camera.from_fov(orbit(np.zeros(3), 3.0, 30, 20, np.array([0.0, -1.0, 0.0])), 64, 48, 50)
    return rasterize(g, camera).rgb


def assert_same(got: Gaussians, expected: Gaussians) -> None:
    for name in ("means", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(got, name), getattr(expected, name), atol=tolerance("splat_values"))
    assert angles(got, expected) < tolerance("splat_values")


def angles(got: Gaussians, expected: Gaussians) -> float:
    """The largest difference of axes, which may point either way."""
    cosines = to_matrix(got.quats).transpose(0, 2, 1) @ to_matrix(expected.quats)
    return np.abs(np.abs(cosines) - np.eye(3)).max()
