"""The page of a table: ours beside the published numbers, how they were made, and pictures."""

import itertools
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from benchmarks.paper.crops import crops
from benchmarks.paper.sections import Section
from benchmarks.paper.tables import MEAN, Method, Table, Trained
from msdgs_train.comparison.best import COLUMNS, HEADING, NOTE, best_evaluation
from msdgs_train.comparison.gains import gain, machines_of, mean_and_deviation, values_of
from msdgs_train.comparison.matrix import Budget, Run
from msdgs_train.comparison.rows import Row
from msdgs_train.comparison.scenes import Scene
from msdgs_train.engine.config import TrainConfig
from msdgs_train.layers.parts import to_text

NONE = "–"
OVERTIME = 1.05
MAX_GAP = 1.0  # dB; larger ones need a cause
EMBEDDING_SIZE, NETWORK_SIZE = 32, 1_155  # of the paper's modulation, numbers a Gaussian and of the network
VARIANTS = {
    "psnr": [("PSNR, dB", "psnr", 2)],
    "ssim": [("SSIM", "ssim", 3)],
    "lpips": [
        ("LPIPS of images in [0, 1], as the field's scripts measure it", "lpips_01", 3),
        ("LPIPS as defined, of images in [−1, 1]", "lpips", 3),
    ],
}
"""By metric: heading, column of the rows, and digits; published numbers are beside the first."""


@dataclass(frozen=True)
class Results:
    """What a page shows."""

    table: Table
    trained: Mapping[str, Trained]  # by method
    scenes: Sequence[Scene]
    runs: Sequence[Run]
    rows: Sequence[Row]
    budget: Budget
    small: bool

    @property
    def title(self) -> str:
        """The table and how long ours were trained."""
        b = self.budget
        length = "as many steps as published"
        if b.minutes is not None:
            length = f"{b.minutes:g} {'CPU minutes' if b.time == 'cpu' else 'minutes'} a run"
        elif b.steps is not None:
            length = f"{b.steps:,} steps a run"
        shown = {row["scene"] for row in self.rows}
        widths = {width for run in self.runs if run.scene in shown and (width := run.config.data.size)}
        size = f", images {' or '.join(map(str, sorted(widths)))} pixels wide" if widths else ""
        notes = (", small systems" if self.small else "") + (", not the paper's setting" if self.is_short else "")
        return f"{self.table.title}, {length}{size}{notes}"

    @property
    def is_short(self) -> bool:
        """Whether less is trained than published."""
        b = self.budget
        return self.small or any(limit is not None for limit in (b.minutes, b.steps, b.size))

    def columns(self) -> Iterator[tuple[str, str]]:
        """Scene and split: the paper's scenes, and others that have runs."""
        yield from ((scene, "test") for scene in self.table.scenes)
        shown = {row["scene"] for row in self.rows} - self.table.scenes.keys()
        for scene in self.scenes:
            if scene.name in shown:
                yield from ((scene.name, split) for split in reversed(scene.splits))

    def values(self, method: Method, scene: str, column: str) -> list[float]:
        """A column of the rows of a method's runs on a scene, one per seed."""
        return [float(value) for value in values_of(self.rows, scene, self.system(method.name), column)]

    def system(self, method: str) -> str:
        """The name of what is trained for a row; empty: nothing."""
        return self.trained[method].system if method in self.trained else ""


def sections(results: Results) -> Iterator[Section]:
    """The page, part by part."""
    yield Section("", notes=list(_conditions(results)))
    for metric in results.table.metrics:
        for place, (heading, column, digits) in enumerate(VARIANTS[metric]):
            published = results.table.metrics.index(metric) if place == 0 else None
            section = _numbers(results, heading, column, digits, published)
            if published is not None or any(set(line[1:]) != {NONE} for line in section.lines):
                yield section
    yield _best(results)
    yield _gains(results)
    yield _gaps(results)
    yield _parameters(results)
    yield _runs(results)
    yield _settings(results)
    yield from _pictures(results)


def _conditions(results: Results) -> Iterator[str]:
    rows = results.rows
    cells = f"Each cell has ours / the paper's; {NONE}: not measured, or not in the paper."
    if results.is_short:
        cells += (
            " The paper trains whole schedules at full size on an RTX 3090. Ours, made as the title says, show the "
            "order of the systems under one budget, not whether its numbers can be reached."
        )
    yield cells
    if rows:
        days = sorted({row["date"] for row in rows})
        seeds = ", ".join(sorted({row["seed"] for row in rows}, key=int))
        yield (
            f"{len(rows)} finished run(s): of the last model, mean ± standard deviation over seeds; seeds {seeds}; "
            f"{results.budget.threads} thread(s) of {machines_of(rows)}; {days[0]} to {days[-1]}."
        )
        if results.budget.minutes and len({row["machine"] for row in rows}) > 1:
            yield "A minute has more steps on one machine than on another: compare systems on the same (Runs, below)."
    else:
        yield "No run is finished."
    if absent := [scene for scene in results.table.scenes if scene not in {found.name for found in results.scenes}]:
        yield f"Scenes that weren't there: {', '.join(absent)}."
    for scene in results.scenes:
        if (every := scene.settings.get("llffhold")) and any(row["scene"] == scene.name for row in rows):
            yield (
                f"{scene.name}: every {every}th training image is held out as test, and those halfway between as val."
            )
    if without := [row for row in rows if not (row["test_lpips"] or row["val_lpips"])]:
        which = "" if len(without) == len(rows) else f" in {len(without)} run(s)"
        yield f"LPIPS wasn't measured{which}: its package or the weights of its network weren't there."
    if over := [
        row for row in rows if row["minutes"] and float(row["seconds"]) > OVERTIME * 60 * float(row["minutes"])
    ]:
        systems = " and ".join(dict.fromkeys(row["system"] for row in over))
        yield (
            f"{len(over)} run(s) of {systems} took longer than their minutes: a quarter of the time is "
            "kept for the last evaluation, and held-out images of a volume may take more (Runs, below)."
        )


def _numbers(results: Results, heading: str, column: str, digits: int, published: int | None) -> Section:
    columns = list(results.columns())
    inside = list(results.table.scenes)
    lines = []
    for method in results.table.methods:
        cells = {at: results.values(method, at[0], f"{at[1]}_{column}") for at in columns}
        line = [method.name]
        for scene, split in columns:
            ours = mean_and_deviation(found, digits) if (found := cells[scene, split]) else NONE
            line.append(_cell(ours, method, scene, digits, published) if scene in inside else ours)
        complete = [statistics.fmean(cells[scene, "test"]) for scene in inside if cells[scene, "test"]]
        mean = f"{statistics.fmean(complete):.{digits}f}" if len(complete) == len(inside) else NONE
        line.insert(1 + len(inside), _cell(mean, method, MEAN, digits, published))
        lines.append(line)
    others = [f"{scene} {split}" for scene, split in columns if scene not in inside]
    return Section(heading, ["", *inside, MEAN, *others], lines)


def _cell(ours: str, method: Method, scene: str, digits: int, published: int | None) -> str:
    if published is None or not method.numbers:
        return ours
    numbers = method.numbers.get(scene)
    return f"{ours} / {f'{numbers[published]:.{digits}f}' if numbers else NONE}"


def _best(results: Results) -> Section:
    """Of each method and scene that has runs."""
    lines = []
    for method, scene in itertools.product(results.table.methods, dict.fromkeys(s for s, _ in results.columns())):
        if cells := best_evaluation(results.rows, scene, results.system(method.name)):
            lines.append([method.name, scene, *cells])
    return Section(HEADING, ["", "scene", *COLUMNS], lines, [NOTE] if lines else [])


def _gains(results: Results) -> Section:
    """Of each method over its baseline, on test images."""
    table = results.table
    by_name = {method.name: method for method in table.methods}
    scenes = list(dict.fromkeys(scene for scene, split in results.columns() if split == "test"))
    lines = []
    for method in table.methods:
        if not method.baseline:
            continue
        systems = [results.system(name) for name in (method.name, method.baseline)]
        line = [f"{method.name} over {method.baseline}"]
        for scene in [*scenes, MEAN]:
            if scene == MEAN and NONE in (gain(results.rows, [each], *systems) for each in table.scenes):
                line.append(NONE)  # the published mean is over all
            else:
                of = list(table.scenes) if scene == MEAN else [scene]
                line.append(gain(results.rows, of, *systems))
            pair = [other.numbers.get(scene) for other in (method, by_name[method.baseline])]
            if scene == MEAN or scene in table.scenes:
                line[-1] += f" / {pair[0][0] - pair[1][0]:+.2f}" if pair[0] and pair[1] else f" / {NONE}"
        lines.append(line)
    notes = ["The 95 % interval in parentheses is over images, by bootstrap; of seeds that both have."]
    return Section("Gain on test images, dB", ["", *scenes, MEAN], lines, notes if lines else [])


def _gaps(results: Results) -> Section:
    """Every difference to the paper of more than `MAX_GAP`, with its cause."""
    lines = []
    for method, scene in itertools.product(results.table.methods, results.table.scenes):
        ours, published = results.values(method, scene, "test_psnr"), method.numbers.get(scene)
        if ours and published and abs(gap := statistics.fmean(ours) - published[0]) > MAX_GAP:
            lines.append([method.name, scene, f"{gap:+.2f}", method.cause])
    return Section(f"Differences of more than {MAX_GAP:g} dB", ["", "scene", "PSNR, dB", "cause"], lines)


def _parameters(results: Results) -> Section:
    """Millions of parameters, where the paper states them."""
    lines = []
    for method in results.table.methods:
        if not method.parameters:
            continue
        published = " + ".join(f"{count:.2f}" for count in method.parameters)
        implied = (
            f"{(1e6 * method.parameters[1] - NETWORK_SIZE) / EMBEDDING_SIZE:,.0f}" if method.parameters[1:] else NONE
        )
        lines.append([method.name, published, implied])
        for column in ("parameters", "modulation_parameters", "gaussians"):
            counts = [value for scene in results.table.scenes for value in results.values(method, scene, column)]
            lines[-1].append(f"{statistics.fmean(counts):,.0f}" if counts else NONE)
    columns = ["", "published, M", "Gaussians this implies", "ours", "ours, modulation", "ours, Gaussians"]
    return Section("Parameters", columns, lines)


def _runs(results: Results) -> Section:
    """What was trained, by method and scene."""
    lines = []
    names = [scene.name for scene in results.scenes]
    for method, scene in itertools.product(results.table.methods, names):
        if seconds := results.values(method, scene, "seconds"):
            row = results.trained[method.name]
            columns = ("parameters", "modulation_parameters", "gaussians", "optimizer_steps")
            counts = [f"{statistics.fmean(results.values(method, scene, c)):,.0f}" for c in columns]
            fit = mean_and_deviation(results.values(method, scene, "train_psnr"), 2)
            minutes = f"{statistics.fmean(seconds) / 60:.1f}"
            layers, of = _layers(row.configs[scene]), [r for r in results.rows if r["scene"] == scene]
            machines = machines_of([r for r in of if r["system"] == row.system])
            lines.append([method.name, row.system, layers, scene, str(len(seconds)), *counts, minutes, machines, fit])
    columns = ["", "system", "layers", "scene", "seeds", "parameters", "of modulation", "Gaussians or vertices"]
    return Section("Runs", [*columns, "steps", "minutes", "machine", "PSNR in training, dB"], lines)


def _settings(results: Results) -> Section:
    """What is trained for the dataset and its scenes instead of the presets' settings, and what isn't as published."""
    if results.small:
        return Section("Settings", notes=["Small systems have the same settings for all datasets and scenes."])
    lines = [
        [method, scene or "all", str(recipe), recipe.source, "; ".join(recipe.differs)]
        for method, row in results.trained.items()
        for scene, recipe in row.recipes.items()
    ]
    columns = ["", "scene", "instead of the preset's", "from", "published, but not here"]
    notes = [
        *results.table.notes,
        "Phases and intervals keep the preset's steps. What presets leave out is in docs/training.md, Presets.",
    ]
    return Section("Settings", columns, lines, notes)


def _layers(config: TrainConfig) -> str:
    groups = itertools.groupby(map(to_text, config.model.layers))
    return " + ".join(f"{count} × {layer}" for layer, of in groups if (count := len(list(of))))


def _pictures(results: Results) -> Iterator[Section]:
    """Of each scene, of the first seed that was trained."""
    names = {row.system: method for method, row in results.trained.items()}
    done = {(row["scene"], row["system"], row["seed"]) for row in results.rows}
    for scene in results.scenes:
        finished = [run for run in results.runs if (run.scene, run.system, str(run.seed)) in done]
        runs = {names[run.system]: run for run in reversed(finished) if run.scene == scene.name}
        if pictures := crops(dict(reversed(runs.items())), "test" if "test" in scene.splits else "val"):
            yield Section(f"{scene.name}, where the renderings differ most", pictures=pictures)
