"""Whether K deformation layers pay: chains on control nodes beside one layer of as many parameters."""

import dataclasses
import io
import itertools
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure
from rich.console import Console

from benchmarks.measuring import report_console, table
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.cli.compare import comparison_progress
from msdgs_train.comparison.gains import gain, machines_of, mean_and_deviation, values_of
from msdgs_train.comparison.matrix import Budget, make_runs
from msdgs_train.comparison.pools import processes
from msdgs_train.comparison.report import save_figure
from msdgs_train.comparison.rows import Row, rows_of, runs_left, train_and_measure
from msdgs_train.comparison.scenes import read_scenes
from msdgs_train.engine.config import TrainConfig
from msdgs_train.layers.base import PAPER_HEADS
from msdgs_train.layers.bodies import BodiesConfig
from msdgs_train.layers.mlp import MLPConfig, MLPLayer
from msdgs_train.systems.registry import DEFAULT, preset
from msdgs_train.systems.small import SMALL_LAYER

STEPS = 2500
NUM_LAYERS = (1, 2, 4, 10)
SCENES_FILE = Path(__file__).with_name("k_steps.toml")
SCENES = ("toybench_100", "toybench_slow_100", "lego_100")
CHAIN, WIDE = "K layers", "1 layer of as many parameters"
UNWEIGHTED, MODULATED = "K layers, w = 1", "K layers, modulated"
COARSE, COARSE_WIDE = "bodies and K - 1 layers", "bodies and 1 layer of as many parameters"
FAMILIES = (CHAIN, WIDE, UNWEIGHTED, MODULATED)
WITH_BODIES = (COARSE, COARSE_WIDE)
"""With --bodies. Of these as of `FAMILIES`, runs of equal time are only of the first."""
GAINS = {
    f"of {CHAIN} over {WIDE}": (CHAIN, WIDE),
    "of w": (CHAIN, UNWEIGHTED),
    "of modulation": (MODULATED, CHAIN),
    f"of {COARSE} over {COARSE_WIDE}": (COARSE, COARSE_WIDE),
}


def main(
    out: Path = Path("out/k_steps"),
    csv: Path | None = None,
    scenes: tuple[str, ...] = SCENES,
    seeds: tuple[int, ...] = (0, 1, 2),
    steps: int | None = None,
    minutes: float | None = None,
    jobs: int = 1,
    bodies: bool = False,
    check: bool = False,
) -> int:
    """Train K = 1, 2, 4 and 10 layers, and one layer of as many parameters as each, with and without step weights and
    modulation; print a table and draw PSNR on test images against K.

    python -m benchmarks.training.k_steps --csv docs/data/k_steps.csv

    Each run has one thread. The bits of a run of a number of steps don't depend on what else the machine does. With
    `--minutes` the runs are of equal time, and only the K layers themselves are trained: whether more of them pay
    although each step takes longer. Runs that have a row in the file are not trained again.

    Args:
        out: The folder of runs, table and figure.
        csv: The file with a row per finished run; OUT/k_steps.csv if not given.
        scenes: Scenes of k_steps.toml, which are 100 pixels wide, of datasets in `data/`.
        seeds: One run per seed.
        steps: Optimizer steps of each run; 2,500 without minutes.
        minutes: CPU time of each run, instead of steps.
        jobs: Runs in parallel, no more than the machine has cores.
        bodies: The first of the K layers is a layer of rigid bodies, as in msdgs-bodies, in all runs.
        check: Test this benchmark: widths give equal parameters, and figure and table show what a file holds.
    """
    if check:
        return self_test()
    csv = csv or out / "k_steps.csv"
    try:
        found = read_scenes([SCENES_FILE], scenes)
        if steps is None and minutes is None:
            steps = STEPS
        budget = Budget(steps, minutes, time="cpu")
        families = WITH_BODIES if bodies else FAMILIES
        trained = families if minutes is None else families[:1]
        configs = {name: budget.of(config).updated(eval_every=0) for name, config in systems(trained).items()}
        runs = make_runs(configs, found, seeds, out)
        with comparison_progress(len(runs_left(runs, csv))) as on_end:
            complete = train_and_measure(runs, csv, processes(jobs), on_end)
    except InvalidInput as error:
        report_console().print(f"error: {error}", style="red", markup=False)
        return 1
    rows = rows_of(runs, csv)
    name = f"k_steps{'_bodies' * bodies}{'_time' * (minutes is not None)}.png"
    report(rows, scenes, families, out / name, report_console())
    return 0 if complete and len(rows) == len(runs) else 1


def systems(families: Sequence[str]) -> dict[str, TrainConfig]:
    """The default system with other layers, by the names that `name_of` gives."""
    base = preset(DEFAULT).updated(max_gaussians=18_000, grow_grad2d=8e-4, opacity_reg=None)
    chains = {k: base.updated(layers=(SMALL_LAYER,) * k) for k in NUM_LAYERS}
    made = {
        CHAIN: chains,
        WIDE: {k: base.updated(layers=(wide_layer(k),)) for k in NUM_LAYERS[1:]},
        UNWEIGHTED: {k: config.updated(weights=False) for k, config in chains.items()},
        MODULATED: {k: config.updated(embedding_dim=32) for k, config in chains.items()},
        COARSE: {k: base.updated(layers=(BodiesConfig(), *(SMALL_LAYER,) * (k - 1))) for k in NUM_LAYERS},
        COARSE_WIDE: {k: base.updated(layers=(BodiesConfig(), wide_layer(k - 1))) for k in NUM_LAYERS if k > 2},
    }
    return {name_of(family, k): config for family in families for k, config in made[family].items()}


def name_of(family: str, num_layers: int) -> str:
    """The name of a system."""
    return f"{family}, K = {num_layers}"


def wide_layer(num_layers: int) -> MLPConfig:
    """A layer as `SMALL_LAYER`, of the width that comes closest to the parameters of so many of them."""
    wanted = num_layers * parameters(SMALL_LAYER)
    candidates = [dataclasses.replace(SMALL_LAYER, width=width) for width in range(8, 1024, 4)]
    return min(candidates, key=lambda layer: abs(parameters(layer) - wanted))


def parameters(layer: MLPConfig) -> int:
    """Trainable numbers of a layer."""
    return sum(parameter.numel() for parameter in MLPLayer(layer, PAPER_HEADS).parameters())


def report(
    rows: Sequence[Row], scenes: Sequence[str], families: Sequence[str], figure_file: Path, console: Console
) -> None:
    """Print a table of PSNR, also of the moving region where it is known from the images, and one of gains; draw the
    figure."""
    first, pairs_of = families[0], {name: pair for name, pair in GAINS.items() if set(pair) <= set(families)}
    absolute = table("PSNR on test images, dB", "scene", "K", *families, f"moving region, {first}")
    gains = table("Gains, dB (95 % over images)", "scene", "K", *pairs_of, f"of {first} over K = 1")
    for scene, k in itertools.product(scenes, NUM_LAYERS):
        values = [psnrs(rows, scene, name_of(family, k)) for family in families]
        values.append(psnrs(rows, scene, name_of(first, k), "test_moving_psnr"))
        absolute.add_row(scene, str(k), *(mean_and_deviation(found, 2) if found else "–" for found in values))
        pairs = [(name_of(one, k), name_of(other, k)) for one, other in pairs_of.values()]
        pairs.append((name_of(first, k), name_of(first, NUM_LAYERS[0])))
        gains.add_row(scene, str(k), *(gain(rows, [scene], *pair) for pair in pairs))
    console.print(absolute, gains)
    console.print(f"machine: {machines_of(rows)}")
    figure_file.parent.mkdir(parents=True, exist_ok=True)
    save_figure(draw(rows, scenes, families), figure_file)
    console.print(f"wrote {figure_file}")


def draw(rows: Sequence[Row], scenes: Sequence[str], families: Sequence[str]) -> Figure:
    """A panel per scene, a line per family: mean PSNR against K, with bars from the worst seed to the best."""
    figure = Figure(figsize=(1.5 + 3.6 * len(scenes), 4.2), layout="constrained")
    panels = figure.subplots(1, len(scenes), squeeze=False)[0]
    for axes, scene in zip(panels, scenes, strict=True):
        for family in families:
            found = {k: psnrs(rows, scene, name_of(family, k)) for k in NUM_LAYERS}
            known = {k: np.array(values) for k, values in found.items() if values}
            if not known:
                continue
            mean, low, high = np.array([(v.mean(), v.min(), v.max()) for v in known.values()]).reshape(-1, 3).T
            bars = [mean - low, high - mean]
            axes.errorbar(list(known), mean, bars, marker="o", ms=4, capsize=3, label=family)
        axes.set(title=scene, xscale="log", xticks=NUM_LAYERS, xticklabels=NUM_LAYERS, xlabel="K")
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("PSNR on test images, dB")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize="small")
    return figure


def psnrs(rows: Sequence[Row], scene: str, system: str, column: str = "test_psnr") -> list[float]:
    """Values of a column, one per seed; none where the runs have none."""
    return [float(value) for value in values_of(rows, scene, system, column)]


def self_test() -> int:
    """Equal parameters within 2 %, and a figure and a table of two scenes that lack some runs."""
    for k in (*NUM_LAYERS[1:], *(k - 1 for k in NUM_LAYERS if k > 2)):
        ratio = parameters(wide_layer(k)) / (k * parameters(SMALL_LAYER))
        assert abs(ratio - 1) < 0.02, (k, ratio)
    console = Console(file=io.StringIO(), record=True, width=200)
    with tempfile.TemporaryDirectory() as folder:
        for families in (FAMILIES, WITH_BODIES):
            figure = Path(folder) / f"{len(families)}.png"
            report(rows_to_show(families), SCENES[:2], families, figure, console)
            assert figure.stat().st_size > 1000
    text = console.export_text()
    assert "+3.00 (+3.00 to +3.00)" in text
    assert text.count("20.00") == 2  # one in each report
    with_bodies = [(COARSE, 1), (COARSE, 2), (COARSE, 4), (COARSE, 10), (COARSE_WIDE, 4), (COARSE_WIDE, 10)]
    assert list(systems(WITH_BODIES)) == [name_of(family, k) for family, k in with_bodies]
    print("ok: equal parameters, a table and a figure")
    return 0


def rows_to_show(families: Sequence[str]) -> list[Row]:
    """Made-up rows of six systems on two scenes; each is 1 dB behind the one before."""
    return [
        {
            "scene": scene,
            "system": name,
            "seed": "0",
            "machine": "a CPU",
            "test_psnr": f"{30 - index}",
            "test_moving_psnr": f"{20 - index}" if scene == SCENES[0] else "",
            "test_images": f"{29 - index} {31 - index}",
        }
        for scene in SCENES[:2]
        for index, name in enumerate(list(systems(families))[:6])
    ]


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
