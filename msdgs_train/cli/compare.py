"""`msdgs-train compare`."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, TimeElapsedColumn, TimeRemainingColumn

from msdgs_serve.process import EXIT_INTERRUPTED, EXIT_INVALID
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.cli.console import console, progress_bar
from msdgs_train.comparison.matrix import Budget, Run, make_runs, read_systems
from msdgs_train.comparison.scenes import read_scenes
from msdgs_train.settings import optional

if TYPE_CHECKING:
    from msdgs_train.comparison.pools import RunEnd

ONE_OR_MORE_SYSTEMS = tyro.conf.arg(metavar="SYSTEM...", help_behavior_hint="(one or more)")


@dataclass(frozen=True)
class Compare:
    """Train every system on every scene with every seed under one budget, and compare them: tables with gains over the
    first system (comparison.md), all numbers (comparison.json), error against training time (time.png) and against the
    number of layers (layers.png).

    A system is a preset, or a table of a TOML file: a `preset` and settings of `fit` that replace its own, but none
    that this command sets for all systems. A scene is a dataset folder, or a table of a TOML file: a `folder` relative
    to the file, and if needed `size`, `llffhold`, `time_from` and the `splits` that are reported. Each finished run
    adds a row to a CSV file, and runs that have a row aren't trained again, so that the same command continues after
    Ctrl-C.

    Example:  msdgs-train compare deformgs 4dgs mine.toml --data data/a data/b --out runs/all --steps 3000 --size 200
    --init-num-pts 5000 --max-gaussians 10000

    mine.toml:  [k2]  preset = "msdgs-small"  [k4]  layers = ["mlp", "mlp:width=64", "mlp", "mlp"]
    """

    systems: Annotated[tuple[str, ...], tyro.conf.Positional, ONE_OR_MORE_SYSTEMS]
    """Names of presets, and TOML files."""
    data: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="DATA...")]
    """Dataset folders and TOML files of scenes, one or more."""
    out: Path
    """The folder of all runs and results: new, or one of the same comparison."""
    csv: Annotated[Path | None, optional("PATH")] = None
    """The file with a row per finished run; OUT/comparison.csv if not given."""
    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...", help_behavior_hint="")] = ()
    """Names of the scenes to train on; all if not given."""
    seeds: Annotated[tuple[int, ...], tyro.conf.arg(metavar="INT...")] = (0, 1, 2)
    """One run per seed; the table shows mean and standard deviation."""
    budget: Annotated[Budget, tyro.conf.arg(name="")] = field(default_factory=Budget)
    jobs: Annotated[int | None, optional("INT")] = None
    """Parallel runs; as many as the cores allow if not given. Parallel runs slow each other down somewhat; frame times
    are measured at the end, one after the other."""
    ray: Annotated[str | None, optional("ADDRESS")] = None
    """Train on a Ray cluster: its address, or `auto` for that of this machine, started if there is none. DATA and OUT
    must be at the same paths on all its machines."""

    def execute(self) -> int:
        from msdgs_serve.threads import thread_count
        from msdgs_train.comparison.pools import processes, ray_tasks
        from msdgs_train.comparison.report import write_comparison
        from msdgs_train.comparison.results import collect
        from msdgs_train.comparison.rows import rows_of, runs_left, train_and_measure

        if self.jobs is not None and self.jobs < 1:
            raise InvalidInput("jobs", "1 or more", self.jobs)
        csv, systems = self.csv or self.out / "comparison.csv", read_systems(self.systems, self.budget)
        runs = make_runs(systems, read_scenes(self.data, self.scenes), self.seeds, self.out)
        if self.ray is None:
            pool = processes(self.jobs or max(1, thread_count() // self.budget.threads))
        else:
            pool = ray_tasks(self.ray, self.budget.threads, self.jobs)
        with comparison_progress(len(runs_left(runs, csv))) as on_end:
            complete = train_and_measure(runs, csv, pool, on_end)
        rows = rows_of(runs, csv)
        if rows:
            paths = write_comparison(self.out, collect(runs), rows, list(systems), len(runs) - len(rows))
            console.print(paths[0].read_text(encoding="utf-8"), soft_wrap=True, highlight=False)
            console.print("wrote " + ", ".join(map(str, [csv, *paths])), soft_wrap=True)
        if not complete:
            console.print("interrupted; the same command continues", soft_wrap=True)
            return EXIT_INTERRUPTED
        return 0 if len(rows) == len(runs) else EXIT_INVALID


@contextmanager
def comparison_progress(total: int) -> "Iterator[Callable[[Run, RunEnd], None]]":
    """A bar over the runs; yields a function that advances it and prints a line about an ended run."""
    columns = BarColumn(None), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    with progress_bar(*columns) as bar:
        task = bar.add_task("runs", total=total)

        def on_end(run: Run, end: "RunEnd") -> None:
            bar.advance(task)
            line = f"{run.name}: {end.status}" + (f", {end.message}" if end.message else "")
            console.print(line, soft_wrap=True, style="red" if end.status == "failed" else None)

        yield on_end
