"""`msdgs-train compare`."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, TimeElapsedColumn, TimeRemainingColumn

from msdgs_serve.process import EXIT_INTERRUPTED
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.cli.console import EXIT_INVALID, console, progress_bar, rich_table
from msdgs_train.comparison.matrix import Budget, Run, make_runs, read_systems
from msdgs_train.settings import optional

if TYPE_CHECKING:
    from msdgs_train.comparison.pools import RunEnd

ONE_OR_MORE_SYSTEMS = tyro.conf.arg(metavar="SYSTEM...", help_behavior_hint="(one or more)")


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

    systems: Annotated[tuple[str, ...], tyro.conf.Positional, ONE_OR_MORE_SYSTEMS]
    """Names of presets, and TOML files."""
    data: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="DATA...")]
    """Dataset folders, one or more."""
    out: Path
    """The folder of all runs and results: new, or one of the same comparison."""
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
        from msdgs_train.comparison.report import HEADINGS, table, write_comparison
        from msdgs_train.comparison.results import collect
        from msdgs_train.comparison.runner import train_all

        check_jobs(self.jobs)
        runs = make_runs(read_systems(self.systems, self.budget), self.data, self.seeds, self.out)
        if self.ray is None:
            pool = processes(self.jobs or max(1, thread_count() // self.budget.threads))
        else:
            pool = ray_tasks(self.ray, self.budget.threads, self.jobs)
        with comparison_progress(len(runs)) as on_end:
            complete = train_all(runs, pool, on_end)
        results = collect(runs)
        if results:
            paths = write_comparison(self.out, results, len(runs) - len(results))
            if console.is_terminal:
                console.print(rich_table(HEADINGS, table(results), names=2))
            else:  # the table is wider than 80 columns
                console.print(paths[0].read_text(encoding="utf-8"), soft_wrap=True, highlight=False)
            console.print("wrote " + ", ".join(map(str, paths)), soft_wrap=True)
        if not complete:
            console.print("interrupted; the same command continues", soft_wrap=True)
            return EXIT_INTERRUPTED
        return 0 if len(results) == len(runs) else EXIT_INVALID


def check_jobs(jobs: int | None) -> None:
    """Raise `InvalidInput` if `jobs` is below 1."""
    if jobs is not None and jobs < 1:
        raise InvalidInput("jobs", "1 or more", jobs)


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
