"""`msdgs-train compare`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.cli.console import EXIT_INTERRUPTED, EXIT_INVALID, console, rich_table


@dataclass(frozen=True)
class Compare:
    """Train every system on every scene with every seed under one budget, and compare them: a table (comparison.md),
    all numbers (comparison.json), error against training time (time.png) and against the number of layers (layers.png).

    A system is a preset, or a table of a TOML file: a `preset` and settings of `fit` that replace its own. The same
    command continues after Ctrl-C; finished runs aren't trained again.

    Example:  msdgs-train compare deformgs 4dgs mine.toml --data data/a data/b --out runs/all --steps 3000 --size 200
    --init-num-pts 5000 --max-gaussians 10000

    mine.toml:  [k2]  preset = "msdgs-small"  [k4]  layers = ["mlp", "mlp:width=64", "mlp", "mlp"]
    """

    systems: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG...")]
    """Presets and TOML files."""
    data: tuple[Path, ...]
    """Dataset folders, one or more."""
    out: Path
    """The folder of all runs and results: new, or one of the same comparison."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One run per seed; the table shows mean and standard deviation."""
    steps: int = 3000
    """Optimizer steps of each run, instead of the preset's. All schedules are fractions of a run and scale with it."""
    minutes: float | None = None
    """Time limit of each run. Learning rates decay over --steps, which the limit should just allow."""
    size: int | None = None
    """Width of all images in pixels."""
    init_num_pts: int | None = None
    """Initial Gaussians of all systems; their own settings if not given."""
    max_gaussians: int | None = None
    """Maximum Gaussians of all systems; their own settings if not given."""
    threads: int = 1
    """CPU threads of each run."""
    jobs: int | None = None
    """Parallel runs; as many as the cores allow if not given. Parallel runs slow each other down somewhat; frame times
    are measured at the end, one after the other."""
    ray: str | None = None
    """Train on a Ray cluster: its address, or `auto` for that of this machine, started if there is none. DATA and OUT
    must be at the same paths on all its machines."""

    def execute(self) -> int:
        from msdgs_serve.threads import thread_count
        from msdgs_train.cli.compare_progress import ComparisonProgress
        from msdgs_train.comparison.matrix import Budget, make_runs, read_systems
        from msdgs_train.comparison.pools import processes, ray_tasks
        from msdgs_train.comparison.report import HEADINGS, table, write_comparison
        from msdgs_train.comparison.results import collect
        from msdgs_train.comparison.runner import train_all

        budget = Budget(self.steps, self.minutes, self.size, self.threads, self.init_num_pts, self.max_gaussians)
        runs = make_runs(read_systems(self.systems, budget), self.data, self.seeds, self.out)
        if self.jobs is not None and self.jobs < 1:
            raise InvalidInput("jobs", "1 or more", self.jobs)
        if self.ray is None:
            pool = processes(self.jobs or max(1, thread_count() // self.threads))
        else:
            pool = ray_tasks(self.ray, self.threads, self.jobs)
        with ComparisonProgress(console, len(runs)) as progress:
            complete = train_all(runs, pool, progress.ended)
        results = collect(runs)
        if results:
            paths = write_comparison(self.out, results, len(runs) - len(results))
            if console.is_terminal:
                console.print(rich_table(HEADINGS, table(results), names=2))
            else:  # the table is wider than 80 columns
                console.print(paths[0].read_text(encoding="utf-8"), soft_wrap=True, markup=False, highlight=False)
            console.print("wrote " + ", ".join(map(str, paths)), soft_wrap=True)
        if not complete:
            console.print("interrupted; the same command continues", soft_wrap=True)
            return EXIT_INTERRUPTED
        return 0 if len(results) == len(runs) else EXIT_INVALID
