"""The options of `msdgs-export` and `msdgs-convert`, without importing torch, so that `--help` is printed at once."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.settings import Flag, optional

Kept = Literal["heads", "modulation", "layers", "invisible", "static", "sh", "float32"]
"""The rules of pruning, and float32."""

WEB_MB, WEB_MIN_PSNR = 5.0, 40.0
"""Megabytes of a file that a page loads in seconds, and dB that its frames keep: browsers draw about as exactly."""


@dataclass(frozen=True)
class ExportOptions:
    """Turn a trained model into one self-contained ONNX scene file (docs/contract.md).

    Ways to compute the motion (plans) are tried together with pruning: removing what is invisible in rendered frames.
    Frames of each candidate are compared with those of the exact network in float64, and timed. The fastest whose worst
    frame has at least --min-psnr is written, the smallest of several that are about as fast, or with --max-mb the most
    exact that fits; and beside it a report: error against run time and bytes.

    Example, then view it at http://localhost:8000:

    msdgs-export runs/ball/model.pt -o scenes/ball.onnx

    msdgs-serve scenes/ball.onnx

    Scenes of other programs are detected by their contents: INRIA's and SuperSplat's .ply, .spz, SOG, .splat and
    .ksplat, numbered sequences of them, and runs of Deformable-3D-Gaussians, 4DGaussians, SC-GS and Grid4D
    (docs/formats.md):

    msdgs-export garden.ply -o scenes/garden.onnx --up z

    In seconds instead of minutes, all layers as trained, pruned:

    msdgs-export runs/ball/model.pt --quick
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """The `model.pt` of a training run, or a file or folder of another program."""
    output: Annotated[Path | None, optional("PATH", aliases=["-o"])] = None
    """The scene file to write; by default beside the model, ending in .onnx."""
    format: Annotated[str, tyro.conf.arg(metavar="FORMAT")] = "detect"
    """Format of the input, as docs/formats.md lists them: model, ply, ..., deformgs, 4dgs, scgs, grid4d. `detect` looks
    inside."""
    min_psnr: Annotated[float | None, optional("DB")] = None
    """PSNR of the worst frame against the exact network; less is faster. By default 50, from where no difference is
    visible; with --data what adds 0.05 dB to the error against held-out images; with --max-mb alone no limit."""
    max_mb: Annotated[float | None, optional("MB")] = None
    """Largest size of the file, in megabytes of 10⁶ bytes. Alone: the highest PSNR that fits, at any speed. With
    --min-psnr: the fastest that keeps both."""
    for_web: Flag = False
    """Write what a web page wants, few bytes and cheap poses: the same as --max-mb 5 --min-psnr 40, either of which may
    be given otherwise."""
    plan: Annotated[str | None, optional("PLAN")] = None
    """Write this plan, without a sweep: network, prefix:2, ...; an unknown one lists all."""
    quick: Flag = False
    """No sweep and no report: the plan `network`, pruned."""
    data: Annotated[Path | None, optional("DATA")] = None
    """The folder of the dataset. Errors are measured from its training cameras, and held-out images compared."""
    keep: Annotated[tuple[Kept, ...], tyro.conf.arg(help_behavior_hint="")] = ()
    """What to keep although it has no visible effect: `heads`, scale `modulation`, `layers`, `invisible` Gaussians, the
    motion of `static` ones, upper `sh` bands. With `float32` arrays aren't stored in fewer bits."""
    tolerance: float = 1e-4
    """Largest relative error of poses that the plan `network` may have against the model's layers."""
    duration: Annotated[float | None, optional("SECONDS")] = None
    """Seconds that the scene's time range lasts, which the file then says: the web page plays it at that speed."""
    times: int = 50
    """The number of times, over the time range, at which the written poses are compared with the model's."""
    up: Annotated[str | None, optional("AXIS")] = None
    """Which direction is up in a splat or a sequence: x, y, z, -x, -y, -z, or three numbers such as 0 -1 0.2. By
    default what the file says, as those of ns-export do, otherwise -y."""

    @property
    def spelled_out(self) -> "ExportOptions":
        """The same without `for_web`, but with what that stands for."""
        if not self.for_web:
            return self
        max_mb = WEB_MB if self.max_mb is None else self.max_mb
        min_psnr = WEB_MIN_PSNR if self.min_psnr is None else self.min_psnr
        return replace(self, for_web=False, max_mb=max_mb, min_psnr=min_psnr)

    @property
    def scene_file(self) -> Path:
        """The path of the scene file."""
        if self.output is not None:
            return self.output
        if not self.model.is_dir():
            return self.model.with_suffix(".onnx")
        folder = self.model.resolve()  # "." has no name, and a folder's has no suffix
        return folder.parent / f"{folder.name}.onnx"

    @property
    def chosen_plan(self) -> str | None:
        """The plan to write; None: a sweep chooses."""
        return "network" if self.quick and self.plan is None else self.plan

    @property
    def packs(self) -> bool:
        """Whether arrays are stored in fewer bits."""
        return "float32" not in self.keep


@dataclass(frozen=True)
class ConvertOptions:
    """Convert a scene file for other viewers. The written file is read back, rendered and compared with the scene.

    The suffix of OUT selects the format:

    msdgs-convert ball.onnx ball.ply          one time, as INRIA's trainer writes it

    msdgs-convert ball.onnx ball.spz          one time, ten times smaller

    msdgs-convert ball.onnx ball.glb          one time, as glTF with KHR_gaussian_splatting

    msdgs-convert ball.onnx ball.usdc         the whole time range, as OpenUSD with a time sample per frame

    msdgs-convert ball.onnx frames/           a folder of numbered PLY files over the scene's time

    msdgs-convert ball.onnx ball.visionary.onnx     the whole scene, for Visionary in a browser

    msdgs-convert ball.onnx small.onnx        the scene file itself, with arrays in fewer bits

    msdgs-convert ball.onnx site/ --site      a folder that any file server shows in a browser

    For videos use msdgs-render: msdgs-render ball.onnx turn.mp4. docs/formats.md lists what each format keeps.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """A scene file (.onnx)."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The output: name.ply, .spz, .glb, .usdc (or .usda, .usd), .visionary.onnx, .onnx, or a folder."""
    t: Annotated[float | None, optional("TIME")] = None
    """The time of a single file; by default the start of the scene's time range."""
    frames: Annotated[int | None, optional("INT")] = None
    """The number of files in a folder or frames of OpenUSD, evenly over the time range, including both ends; by default
    30."""
    min_psnr: Annotated[float | None, optional("DB")] = None
    """PSNR of the written file against the scene, below which it isn't kept; by default 45 for SPZ and Visionary,
    50 for scene files, and 60 for the others, which are lossless."""
    site: Flag = False
    """Write a folder of files with a page that draws the scene in browsers, and no server."""
    title: Annotated[str | None, optional("TEXT")] = None
    """The title of a site's page; by default the scene's name."""
    description: Annotated[str | None, optional("TEXT")] = None
    """What search engines and links say of a site."""
    url: Annotated[str | None, optional("URL")] = None
    """The address that a site's folder will have, so that links to it show its picture."""
    onnxruntime_web: Annotated[Path | None, optional("DIR")] = None
    """Folder of the npm package onnxruntime-web, whose files a site holds; by default npm fetches it the first time."""


def with_values_of_up(arguments: Sequence[str]) -> list[str]:
    """Arguments of a command in which `--up` and its value are one: -y looks like an option, and 0 -1 0 are three."""
    joined: list[str] = []
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        if argument == "--up" and rest:
            values = [rest.pop(0)]
            while len(values) < 3 and rest and all(_is_number(each) for each in (*values, rest[0])):
                values.append(rest.pop(0))
            argument = f"--up={' '.join(values)}"
        joined.append(argument)
    return joined


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def require_writable(field: str, file: Path, source: Path) -> None:
    """Raise `InvalidInput` naming `field` if a file can't be written there: its folder doesn't exist, it is a folder,
    or it is the `source` that is read."""
    if not file.parent.is_dir():
        raise InvalidInput(field, "in a folder that exists", str(file))
    if file.is_dir():
        raise InvalidInput(field, "a file, not a folder", str(file))
    if file.exists() and source.exists() and file.samefile(source):
        raise InvalidInput(field, "another file than the one that is read", str(file))
