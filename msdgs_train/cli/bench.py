"""`msdgs-train bench`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from msdgs_serve.process import EXIT_INTERRUPTED
from msdgs_train.cli.compare import check_jobs, comparison_progress
from msdgs_train.cli.console import EXIT_INVALID, console
from msdgs_train.comparison.matrix import Budget, read_systems


@dataclass(frozen=True)
class Bench:
    """Train systems on many scenes for equal time, and compare them: a table (bench.md), a figure (bench.png), and a
    row of --csv for each finished run, from which the same command continues.

    A system is a preset, or a table of a TOML file: a `preset` and settings of `fit` that replace its own. Settings are
    chosen by the mean over scenes on val images; test images are reported.

    Example, 40 minutes per system:  msdgs-train bench msdgs-nodes msdgs-small --data data --out runs/bench
    """

    systems: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG...")]
    """Presets and TOML files; gains are over the first system."""
    data: Path
    """The folder that holds the datasets; an error names those that are missing."""
    out: Path
    """The folder of all runs and results."""
    csv: Path | None = None
    """The file with a row per finished run; OUT/bench.csv if not given."""
    whole: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """All scenes, for 30 minutes each if --minutes isn't given."""
    minutes: float | None = None
    """Minutes per run; 5 if not given."""
    scenes: tuple[str, ...] = ()
    """Scenes by name; if not given, eight of the benchmark's, or with --whole all."""
    seeds: tuple[int, ...] = (0,)
    """One run per seed; the table shows mean and standard deviation."""
    threads: int = 2
    """CPU threads of each run."""
    jobs: int = 1
    """Runs in parallel; together with --threads, no more than the machine has cores."""
    time: Literal["wall", "cpu"] = "wall"
    """What --minutes count: time that passes, or CPU time of all threads, on a machine that does other work too."""

    def execute(self) -> int:
        from msdgs_train.comparison.bench import make_bench_runs, read_scenes, rows_of, runs_left, train_and_measure
        from msdgs_train.comparison.bench_report import write_bench

        check_jobs(self.jobs)
        minutes, csv = self.minutes, self.csv or self.out / "bench.csv"
        if minutes is None:
            minutes = 30.0 if self.whole else 5.0
        budget = Budget(steps=None, minutes=minutes, threads=self.threads, time=self.time)
        scenes = read_scenes(self.data, short=not self.whole, names=self.scenes)
        systems = read_systems(self.systems, budget)
        runs = make_bench_runs(systems, scenes, self.seeds, self.out)
        with comparison_progress(len(runs_left(runs, csv))) as on_end:
            complete = train_and_measure(runs, scenes, csv, self.jobs, on_end)
        rows = rows_of(runs, csv)
        if rows:
            paths = write_bench(self.out, rows, list(systems))
            console.print(paths[0].read_text(encoding="utf-8"), soft_wrap=True, highlight=False)
            console.print("wrote " + ", ".join(map(str, [csv, *paths])), soft_wrap=True)
        if not complete:
            console.print("interrupted; the same command continues", soft_wrap=True)
            return EXIT_INTERRUPTED
        return 0 if len(rows) == len(runs) else EXIT_INVALID
