"""A scene of the paper's size from a small trained one: 106,500 Gaussians and ten layers, with its motion and images.

Each Gaussian is split into smaller ones, which the small model's layers move. Ten layers of the size of `msdgs-mlp`
start with the small model's function, made wider and deeper without changing it (Net2Net, Chen et al. 2016), and are
trained by regression on these trajectories, smoothed in time."""

import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Annotated

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import Progress
from scipy.interpolate import BSpline
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.measuring import machine
from msdgs_export.measure.frames import compare, render
from msdgs_export.measure.poses import posed
from msdgs_export.measure.views import cameras_of, selection_views
from msdgs_export.trajectories.sampling import give_one_sign
from msdgs_export.trajectories.splines import along_time, fitting
from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_train.evaluation.layer_strip import camera_of
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo, load_model, save_model
from msdgs_train.layers.mlp import MLPLayer
from msdgs_train.layers.quaternions import rotate, unit_or_identity
from msdgs_train.systems.registry import preset
from tests.support.models import SCENE, random_model

SHRINK = 0.6
"""Axes of a part relative to those of its Gaussian. Centers are spread by √(1 − 0.6²) of them, so that all parts
together are as wide as the whole."""

MAX_OPACITY = 0.999

SAMPLES = 257
"""Times at which the small model is posed."""

TIMES_PER_STEP, GAUSSIANS_PER_TIME = 4, 384
MOVING_FRACTION = 0.75
"""Fraction of a batch drawn from Gaussians that move by more than a pixel."""

LR_INIT, LR_FINAL = 1e-4, 1e-6
OCTAVE_DAMPING = 0.5
"""Initial weights of each octave of the encoding relative to the one below: new layers are smooth in space and time."""

CHUNK = 8192
"""Gaussians whose trajectories are held at a time."""

MEANS, LOG_SCALES, QUATS = slice(0, 3), slice(3, 6), slice(6, 10)


class SmoothMotion:
    """Trajectories of a model, smoothed by least-squares cubic splines of few control points."""

    def __init__(self, model: DynamicGaussians, info: SceneInfo, control: int) -> None:
        self._time_range, matrix = info.time_range, fitting(control, SAMPLES).astype(np.float32)
        controls, travels = [], []
        for ids in np.array_split(np.arange(len(model.gaussians)), -(-len(model.gaussians) // CHUNK)):
            poses = [posed(model, t, ids) for t in np.linspace(*info.time_range, SAMPLES)]
            samples = np.stack([np.concatenate([p.means, np.log(p.scales), p.quats], axis=1) for p in poses], axis=1)
            give_one_sign(samples)
            controls.append(along_time(matrix, samples))
            travels.append(np.linalg.norm(np.ptp(samples[..., MEANS], axis=1), axis=1))
        self._control, self.travel = (torch.from_numpy(np.concatenate(each)) for each in (controls, travels))
        self._knots = np.concatenate([np.zeros(3), np.linspace(0, 1, control - 2), np.ones(3)])

    def at(self, t: float, ids: Tensor) -> Tensor:
        """[M, 10] means, log-scales and unit quaternions at a time."""
        t0, t1 = self._time_range
        weights = BSpline.design_matrix(np.array([(t - t0) / (t1 - t0)]), self._knots, 3).toarray()[0]
        pose = torch.einsum("c,mck->mk", torch.from_numpy(weights).float(), self._control[ids])
        return torch.cat([pose[:, :6], unit_or_identity(pose[:, QUATS])], dim=1)


class Training:
    """Training of the large model."""

    def __init__(self, model: DynamicGaussians, motion: SmoothMotion, info: SceneInfo) -> None:
        self.model, self.motion, self.info, self.steps = model, motion, info, 0
        self.pixel = _pixel(model, info)
        self._moving = torch.nonzero(motion.travel > self.pixel)[:, 0]
        self._parameters = [p.requires_grad_(True) for p in model.deformation.parameters()]
        self._optimizer = torch.optim.Adam(self._parameters, lr=LR_INIT, eps=1e-15)
        self._generator = torch.Generator().manual_seed(1)

    def run(self, seconds: float, console: Console) -> None:
        """Train for so much processor time."""
        with Progress(console=console) as progress:
            task, start, spent = progress.add_task("training", total=seconds), process_time(), 0.0
            while spent < seconds:
                error = self.step(spent / seconds)
                spent = process_time() - start
                described = f"step {self.steps:,}, median error of the batch {error:.2f} pixels"
                progress.update(task, completed=spent, description=described)

    def step(self, part: float) -> float:
        """Train on one batch after a `part` of the training time; returns the median error of means in pixels."""
        rate = LR_FINAL + (LR_INIT - LR_FINAL) * (1 + math.cos(math.pi * part)) / 2
        self._optimizer.param_groups[0]["lr"] = rate * min(1.0, (self.steps + 1) / 50)
        self._optimizer.zero_grad()
        t0, t1 = self.info.time_range
        times = t0 + (t1 - t0) * torch.rand(TIMES_PER_STEP, generator=self._generator)
        error = torch.cat([self.errors(t, self._batch()) for t in times.tolist()])
        functional.smooth_l1_loss(error, torch.zeros_like(error)).backward()
        torch.nn.utils.clip_grad_norm_(self._parameters, 1.0)
        self._optimizer.step()
        self.steps += 1
        return float(error.detach()[:, MEANS].norm(dim=1).median())

    def errors(self, t: float, ids: Tensor) -> Tensor:
        """[M, 10] errors of means, scales and ends of rotated axes in pixels."""
        target = self.motion.at(t, ids)
        pose = self.model.pose(t, ids=ids)
        scales = target[:, LOG_SCALES].exp()
        spread = (scales.amax(1, keepdim=True) - scales.amin(1, keepdim=True)) * 2
        sign = torch.where((pose.quats.detach() * target[:, QUATS]).sum(1, keepdim=True) < 0, -1.0, 1.0)
        quats = (sign * pose.quats - target[:, QUATS]) * spread
        return torch.cat([pose.means - target[:, MEANS], pose.scales - scales, quats], dim=1) / self.pixel

    def _batch(self) -> Tensor:
        moving = round(MOVING_FRACTION * GAUSSIANS_PER_TIME) if len(self._moving) else 0
        any_ = torch.randint(len(self.model.gaussians), (GAUSSIANS_PER_TIME - moving,), generator=self._generator)
        if not moving:
            return any_
        return torch.cat([any_, self._moving[torch.randint(len(self._moving), (moving,), generator=self._generator)]])


def main(
    model: Annotated[Path, tyro.conf.Positional] = Path("runs/toybench/model.pt"),
    output: Annotated[Path, tyro.conf.Positional] = Path("runs/paper_sized/model.pt"),
    count: int = 106_500,
    minutes: float = 4.0,
    size: int = 400,
    control: int = 27,
    threads: int = 1,
    check: bool = False,
) -> int:
    """Make a scene of the paper's size from a small trained one, to measure exports on (docs/work_precision.md).

    Its Gaussians are split until there are 106,500, as in the paper. The ten MLP layers of the preset msdgs-mlp are
    trained on their motion, smoothed in time, and the remaining error is printed.

    python -m benchmarks.export.paper_sized runs/toybench/model.pt runs/paper_sized/model.pt

    msdgs-export runs/paper_sized/model.pt

    Args:
        model: A trained `model.pt` of MLP layers.
        output: The `model.pt` to write.
        count: Gaussians of the new scene, at least those of the model.
        minutes: Processor time of the training.
        size: Width in pixels of the new scene's cameras.
        control: Control points of a smoothed trajectory.
        threads: Threads of torch.
        check: Test this script on a random model of 40 Gaussians.
    """
    if check:
        return self_test()
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    console.print(machine(), markup=False)
    torch.set_num_threads(threads)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        small, info, _ = load_model(model)
        if count < len(small.gaussians):
            raise InvalidInput("count", f"{len(small.gaussians):,} or more, the model's Gaussians", count)
        kept = {n: [resized(c, size) for c in getattr(info, n)] for n in ("cameras", "training_cameras")}
        info = replace(info, **kept)
        parts = split(small, count, torch.Generator().manual_seed(0))
        training = Training(grown(parts), SmoothMotion(parts, info, control), info)
        training.run(60 * minutes, console)
        save_model(output, training.model, info, training.steps)
        _describe(training, small, console)
    except (MsdgsError, OSError) as error:
        console.print(f"error: {error}", style="red", markup=False)
        return 1
    return 0


@torch.no_grad()
def split(small: DynamicGaussians, count: int, generator: torch.Generator) -> DynamicGaussians:
    """The model with `count` Gaussians, each split into the same number of parts or one more; the layers are the same.

    All parts of a Gaussian together absorb as much light of a ray as the whole.
    """
    g, parents = small.gaussians, torch.arange(count) * len(small.gaussians) // count
    places = (1 - SHRINK**2) ** 0.5 * torch.randn(count, 3, generator=generator).clamp(-2.5, 2.5)
    offsets = rotate(unit_or_identity(g.raw_quats[parents]), places * g.log_scales[parents].exp())
    parts = torch.bincount(parents, minlength=len(g))[parents]
    clear = (1 - g.raw_opacities[parents].sigmoid().clamp_max(MAX_OPACITY)).log() / (parts * SHRINK**2)
    tensors = {name: parameter[parents] for name, parameter in g.named_parameters()} | {
        "means": g.means[parents] + offsets,
        "log_scales": g.log_scales[parents] + np.log(SHRINK),
        "raw_opacities": torch.logit((1 - clear.exp()).clamp(1e-6, MAX_OPACITY)),
    }
    model = DynamicGaussians(small.config, CanonicalGaussians(**tensors)).requires_grad_(requires_grad=False)
    model.deformation, model.modulation = small.deformation, small.modulation
    return model


@torch.no_grad()
def grown(small: DynamicGaussians) -> DynamicGaussians:
    """A model of the preset msdgs-mlp that computes what the small one does; its last layers move nothing yet."""
    paper = preset("msdgs-mlp").model
    config = replace(
        paper,
        sh_degree=small.config.sh_degree,
        embedding_dim=small.config.embedding_dim,
        modulation_targets=small.config.modulation_targets,
        scale_space=small.config.scale_space,
    )
    torch.manual_seed(0)
    large = DynamicGaussians(config, small.gaussians).requires_grad_(requires_grad=False)
    large.modulation = small.modulation
    for layer in _mlp_layers(large):
        damping = OCTAVE_DAMPING ** torch.arange(layer.config.xyz_frequencies).repeat_interleave(3)
        layer.first.weight[:, 3 : 3 + 2 * len(damping)] *= damping.repeat(2)
    for layer, trained in zip(_mlp_layers(large), _mlp_layers(small), strict=False):
        _grown(layer, trained)
    return large


def _mlp_layers(model: DynamicGaussians) -> list[MLPLayer]:
    layers = [layer for layer in model.deformation.layers if isinstance(layer, MLPLayer)]
    if len(layers) < len(model.deformation) or any(layer.skip for layer in layers):
        raise InvalidInput(
            "model", "of MLP layers that read their input once", ", ".join(layer.kind for layer in model.config.layers)
        )
    return layers


def _grown(layer: MLPLayer, trained: MLPLayer) -> None:
    """Make a larger layer compute what a smaller one does. No output reads its other hidden units."""
    if layer.outputs != trained.outputs or len(layer.trunk) < len(trained.trunk):
        raise InvalidInput("model", "of layers with the heads of msdgs-mlp and at most four hidden layers", "others")
    width, places = trained.first.out_features, _columns(layer.xyz_frequency_matrix, trained.xyz_frequency_matrix)
    times = layer.xyz_features + torch.arange(trained.time_output.out_features)
    _copy(layer.time_hidden, trained.time_hidden, _columns(layer.time_frequency_matrix, trained.time_frequency_matrix))
    _copy(layer.time_output, trained.time_output, torch.arange(trained.time_output.in_features))
    _copy(layer.first, trained.first, torch.cat([places, times]))
    for i, linear in enumerate(_linears(layer)):
        if i < len(trained.trunk):
            _copy(linear, _linears(trained)[i], torch.arange(width))
        else:  # hidden units aren't negative, so an identity and a ReLU change nothing
            same = nn.Linear(width, width)
            nn.init.eye_(same.weight)
            nn.init.zeros_(same.bias)
            _copy(linear, same, torch.arange(width))
    _copy(layer.heads, trained.heads, torch.arange(width))


def _linears(layer: MLPLayer) -> list[nn.Linear]:
    return [linear for linear in layer.trunk if isinstance(linear, nn.Linear)]


def _columns(frequency_matrix: Tensor, fewer: Tensor) -> Tensor:
    """Columns of a longer encoding (value, sines, cosines) that a shorter one also has."""
    size, many, few = frequency_matrix.shape[0], frequency_matrix.shape[1], fewer.shape[1]
    if few > many:
        raise InvalidInput("model", f"with at most {many // size} frequencies", few // size)
    first = torch.arange(size + few)
    return torch.cat([first, size + many + torch.arange(few)])


def _copy(linear: nn.Linear, source: nn.Linear, columns: Tensor) -> None:
    """Let the first outputs of a Linear read these columns with the weights of another one, and no other columns."""
    outputs = source.out_features
    if outputs > linear.out_features or len(columns) > linear.in_features:
        raise InvalidInput("model", "as wide as the preset msdgs-mlp at most", outputs)
    linear.weight[:outputs] = 0
    linear.weight[:outputs, columns] = source.weight
    linear.bias[:outputs] = source.bias


@torch.no_grad()
def _describe(training: Training, small: DynamicGaussians, console: Console) -> None:
    """Print the errors against the smoothed motion and the small model's images."""
    ids, info = torch.arange(0, len(training.model.gaussians), 37), training.info
    errors = torch.cat([training.errors(t, ids)[:, MEANS].norm(dim=1) for t in np.linspace(*info.time_range, 17)])
    quantiles = ", ".join(f"{float(errors.quantile(q)):.2f}" for q in (0.5, 0.9, 0.99))
    console.print(f"error against the smoothed motion: {quantiles} pixels (50, 90, 99 % of Gaussians)", markup=False)
    psnrs = []
    for view in selection_views(cameras_of(info), info.time_range, 9):
        models = (small, training.model)
        psnrs.append(
            compare(*(render(posed(m, view.t), view.camera, info.background, m.rasterizer) for m in models)).psnr
        )
    console.print(f"images against the small model's: {np.mean(psnrs):.1f} dB, worst {min(psnrs):.1f}", markup=False)


def _pixel(model: DynamicGaussians, info: SceneInfo) -> float:
    middle = model.gaussians.means.median(dim=0).values.numpy()
    cameras = [camera for _, camera in cameras_of(info)]
    return float(min(np.linalg.norm(c.position - middle) / max(c.fx, c.fy) for c in cameras))


def resized(entry: dict, width: int) -> dict:
    camera = camera_of(entry, width)
    return entry | {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}


def self_test() -> int:
    """Larger layers compute what the smaller ones do, except for rounding; a short run writes a model."""
    small = random_model(40, layers=("mlp", "mlp"))
    parts = split(small, 100, torch.Generator().manual_seed(0))
    large = grown(parts).double()
    parts.double()
    assert len(large.deformation) == 10
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        for t in (0.0, 0.37, 1.0):
            expected, found = parts.pose(t), large.pose(t)
            for part in ("means", "quats", "scales"):
                torch.testing.assert_close(getattr(found, part), getattr(expected, part), rtol=1e-12, atol=1e-12)
        source, made = Path(folder) / "small.pt", Path(folder) / "large.pt"
        save_model(source, random_model(40, layers=("mlp",)), SCENE, 1)
        with torch.enable_grad():
            assert main(source, made, count=90, size=64, minutes=0.005) == 0
        assert len(load_model(made).model.gaussians) == 90
        assert main(source, made, count=3) == 1
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
