"""`msdgs-train bench`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from msdgs_train.cli.compare import comparison_progress
from msdgs_train.cli.console import EXIT_INTERRUPTED, EXIT_INVALID, console
from msdgs_train.comparison.matrix import Budget, Run, read_systems

if TYPE_CHECKING:
    from msdgs_train.comparison.pools import RunEnd


@dataclass(frozen=True)
class Bench:
    """Train systems on many scenes for equal time, and compare them: a table (bench.md), a figure (bench.png), and a
    row of --csv for each finished run, from which the same command continues.

    A system is a preset, or a table of a TOML file: a `preset` and settings of `fit` that replace its own. Settings are
    chosen by the mean over scenes on val images; test images are reported.

    Example, 40 minutes per system:  msdgs-train bench msdgs-nodes motion-bases --data data --out runs/bench
    """

    systems: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG...")]
    """Presets and TOML files; gains are over the first system."""
    data: Path
    """The folder that holds the datasets, named as the benchmark names them."""
    out: Path
    """The folder of all runs and results."""
    csv: Path | None = None
    """The file with a row per finished run; OUT/bench.csv if not given."""
    whole: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """All scenes, for 30 minutes each if --minutes isn't given."""
    minutes: float | None = None
    """Minutes per run; 5 if not given."""
    scenes: tuple[str, ...] = ()
    """Scenes by name, in place of those of the short or the whole form."""
    seeds: tuple[int, ...] = (0,)
    """One run per seed; the table shows mean and standard deviation."""
    threads: int = 2
    """CPU threads of each run."""
    jobs: int = 1
    """Runs in parallel; together with --threads, no more than the machine has cores."""
    time: Literal["wall", "cpu"] = "wall"
    """What --minutes count: time that passes, or CPU time of all threads, on a machine that does other work too."""

    def execute(self) -> int:
        from msdgs_train.comparison.bench import (
            append_row,
            key_of,
            key_of_row,
            make_bench_runs,
            measure,
            read_rows,
            read_scenes,
        )
        from msdgs_train.comparison.bench_report import write_bench
        from msdgs_train.comparison.pools import processes
        from msdgs_train.comparison.runner import train_all

        minutes, csv = self.minutes or (30.0 if self.whole else 5.0), self.csv or self.out / "bench.csv"
        budget = Budget(steps=None, minutes=minutes, threads=self.threads, time=self.time)
        scenes = {scene.name: scene for scene in read_scenes(self.data, short=not self.whole, names=self.scenes)}
        systems = read_systems(self.systems, budget)
        runs = make_bench_runs(systems, list(scenes.values()), self.seeds, self.out)
        done = set(map(key_of_row, read_rows(csv)))
        left = [run for run in runs if key_of(run) not in done]
        with comparison_progress(len(left)) as on_end:

            def finish(run: Run, end: "RunEnd") -> None:
                on_end(run, end)
                if end.status in ("finished", "was finished"):
                    append_row(csv, measure(run, scenes[run.scene]))

            complete = train_all(left, processes(self.jobs), finish)
        wanted = {key_of(run) for run in runs}
        rows = [row for row in read_rows(csv) if key_of_row(row) in wanted]
        if rows:
            paths = write_bench(self.out, rows)
            console.print(paths[0].read_text(encoding="utf-8"), soft_wrap=True, markup=False, highlight=False)
            console.print("wrote " + ", ".join(map(str, [csv, *paths])), soft_wrap=True)
        if not complete:
            console.print("interrupted; the same command continues", soft_wrap=True)
            return EXIT_INTERRUPTED
        return 0 if len(rows) == len(runs) else EXIT_INVALID
