"""`python -m benchmarks.paper TABLE`: a table of the paper, trained here."""

import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from benchmarks.paper.tables import PaperBudget, find_scenes, read_systems, read_table, runs_of
from msdgs_serve.process import EXIT_INTERRUPTED, EXIT_INVALID, begin
from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_serve.writing import in_words, write_text
from msdgs_train.cli.compare import comparison_progress
from msdgs_train.cli.console import console
from msdgs_train.comparison.scenes import Scene, require_folders
from msdgs_train.engine.schedule import Schedule
from msdgs_train.layers.parts import to_text
from msdgs_train.settings import Flag, optional

if TYPE_CHECKING:
    from benchmarks.paper.page import Results
    from msdgs_train.comparison.matrix import Run
    from msdgs_train.comparison.pools import RunEnd

Name = Literal["table1", "table2", "table3", "table4", "table5", "figure7"]


@dataclass(frozen=True)
class Paper:
    """Train the systems of a table of the paper, and write a page with our numbers beside the published ones: PSNR,
    SSIM, LPIPS in both conventions, gains with their intervals, parameters, steps, minutes, pictures side by side.

    table1: eight systems on D-NeRF; table2: five on Neu3D; table3: four on HyperNeRF; table4: fewer parameters; table5:
    without weights, and modulation of other deltas; figure7: numbers of layers. The last three are on D-NeRF, too.

    The data are the folder of D-NeRF, Neu3D or HyperNeRF with a folder for each scene, single datasets, or TOML files
    of scenes as for `msdgs-train compare`. Scenes that aren't there are dashes, others are added. Without --small each
    system is trained as its authors publish it for the dataset and, where they do, for a scene (published.toml); the
    page names what differs. That needs a GPU; --steps and --minutes shorten its schedule.

    Each finished run adds a row to a CSV file and renews the page, OUT/TABLE.html and .md. Runs that have a row aren't
    trained again, so that the same command continues after Ctrl-C, also for more seeds, scenes or systems. Tables share
    the runs of OUT.

    All on a GPU:  python -m benchmarks.paper table1 --data data/D-NeRF --device cuda

    Shorter:  python -m benchmarks.paper table1 --data data/D-NeRF --device cuda --size 400 --minutes 30

    On a CPU:  python -m benchmarks.paper table1 --data data/D-NeRF --small --size 200 --minutes 10 --time cpu

    Two rows:  python -m benchmarks.paper table1 --data data/D-NeRF --device cuda --methods "Ours(MLP)" DeformGS
    """

    table: Annotated[Name, tyro.conf.Positional] = "table1"
    """The table, or figure."""
    data: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="DATA...", help_behavior_hint="")] = ()
    """Folders of scenes, datasets and TOML files of scenes, one or more."""
    out: Path = Path("out/paper")
    """The folder of runs and pages."""
    csv: Annotated[Path | None, optional("PATH")] = None
    """The file with a row per finished run; OUT/paper.csv if not given."""
    docs: Annotated[Path | None, optional("PATH")] = None
    """A copy of the page as Markdown."""
    methods: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...", help_behavior_hint="")] = ()
    """Rows of the table to train, as the paper writes them; all if not given. The page has all."""
    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...", help_behavior_hint="")] = ()
    """Scenes to train on; all if not given. The page has all."""
    seeds: Annotated[tuple[int, ...], tyro.conf.arg(metavar="INT...")] = (0,)
    """One run per seed; the page has mean and standard deviation."""
    small: Flag = False
    """Systems in sizes for a CPU (systems.toml)."""
    budget: Annotated[PaperBudget, tyro.conf.arg(name="")] = field(default_factory=PaperBudget)
    jobs: Annotated[int, tyro.conf.arg(metavar="INT")] = 1
    """Parallel runs."""
    check: Flag = False
    """Test this benchmark: two systems on a scene of a few pixels."""

    def execute(self) -> int:
        """Train what is missing, and write the page; returns the exit code."""
        from benchmarks.paper.page import Results
        from msdgs_train.comparison.pools import processes
        from msdgs_train.comparison.rows import rows_of, runs_left, train_and_measure

        if self.jobs < 1:
            raise InvalidInput("jobs", "1 or more", self.jobs)
        table = read_table(self.table)
        scenes = find_scenes(table, self.data)
        require_known("methods", self.methods, [method.name for method in table.methods])
        require_known("scenes", self.scenes, [scene.name for scene in scenes])
        require_folders([scene for scene in scenes if scene.name in self.scenes or not self.scenes])
        trained = read_systems(table, scenes, self.budget, small=self.small)
        csv = self.csv or self.out / "paper.csv"
        runs = runs_of(trained, scenes, self.seeds, self.out)
        wanted = {row.system for method, row in trained.items() if method in self.methods or not self.methods}
        chosen = [run for run in runs if run.system in wanted and (run.scene in self.scenes or not self.scenes)]
        results = Results(table, trained, scenes, runs, (), self.budget, self.small)

        def write() -> None:
            self._write(replace(results, rows=rows_of(runs, csv)))

        with comparison_progress(len(runs_left(chosen, csv))) as advance:

            def on_end(run: "Run", end: "RunEnd") -> None:
                advance(run, end)
                write()

            complete = train_and_measure(chosen, csv, processes(self.jobs), on_end)
        write()
        console.print(f"wrote {self.out / self.table}.html and .md; rows in {csv}", soft_wrap=True)
        if not complete:
            console.print("interrupted; the same command continues", soft_wrap=True)
            return EXIT_INTERRUPTED
        return EXIT_INVALID if runs_left(chosen, csv) else 0

    def _write(self, results: "Results") -> None:
        from benchmarks.paper.page import sections
        from benchmarks.paper.sections import as_html, as_markdown

        self.out.mkdir(parents=True, exist_ok=True)
        parts = list(sections(results))
        text = as_markdown(results.title, parts)
        write_text(self.out / f"{self.table}.html", as_html(results.title, parts))
        for file in (self.out / f"{self.table}.md", *([self.docs] if self.docs else [])):
            write_text(file, text)


def require_known(option: str, names: Sequence[str], known: Sequence[str]) -> None:
    """Raise `InvalidInput` naming the first that isn't known."""
    for name in names:
        if name not in known:
            raise InvalidInput(option, f"of {', '.join(known)}", name)


def self_test() -> int:
    """Two systems on one of D-NeRF's scenes, small; then nothing is left to train."""
    from tests.support.training_scene import write_scene

    with tempfile.TemporaryDirectory() as folder:
        out, budget = Path(folder) / "out", PaperBudget(steps=6, init_num_pts=60, max_gaussians=90)
        write_scene(Path(folder) / "data" / "hook", train=3, test=1)
        paper = Paper(
            "table1", (Path(folder) / "data",), out, methods=("DeformGS", "Ours(MLP)"), small=True, budget=budget
        )
        assert paper.execute() == 0
        rows = (out / "paper.csv").read_text(encoding="utf-8")
        assert paper.execute() == 0
        assert (out / "paper.csv").read_text(encoding="utf-8") == rows
        text, page = ((out / f"table1.{kind}").read_text(encoding="utf-8") for kind in ("md", "html"))
        first = next(line for line in text.splitlines() if line.startswith("| DeformGS |")).split("|")
        assert first[2].strip() == "– / 41.01"
        assert float(first[4].split("/")[0]) > 5
        assert first[4].split("/")[1].strip() == "37.42"
        assert "Ours(MLP) over DeformGS" in text
        assert page.count("data:image/png") == 3
        for name in ("table2", "table3", "table4", "table5", "figure7"):
            assert refused(replace(paper, table=name, methods=("none",))) == "methods"
        assert refused(replace(paper, methods=(), scenes=("none",))) == "scenes"
        assert_as_published(Path(folder))
        assert refused(replace(paper, data=())) == "data"
    console.print("ok")
    return 0


def assert_as_published(folder: Path) -> None:
    """Each scene is trained as published for it, and the page says so; tests have the numbers."""
    from benchmarks.paper.page import Results, sections

    table = read_table("table3")
    scenes = [Scene("Broom", folder, {}), Scene("Chicken", folder, {}), Scene("other", folder / "peel-banana", {})]
    trained = read_systems(table, scenes, PaperBudget(), small=False)
    runs = runs_of(trained, scenes, (0, 1), folder)
    assert [(run.scene, run.seed) for run in runs[:: len(trained)]] == [
        (s.name, seed) for seed in (0, 1) for s in scenes
    ]
    layers = [to_text(config.model.layers[0]) for config in trained["4DGS"].configs.values()]
    assert [f"time_resolution={times}," in layer for times, layer in zip((100, 80, 250), layers, strict=True)] == [
        True
    ] * 3
    assert [config.run.steps for config in trained["Grid4D"].configs.values()] == [30_000, 40_000, 30_000]
    sizes = {scene: {row.configs[scene].data.size for row in trained.values()} for scene in ("Broom", "other")}
    assert sizes == {"Broom": {536}, "other": {None}}
    short = read_systems(table, scenes, PaperBudget(steps=170, size=90), small=False)
    config = short["4DGS"].configs["Broom"]
    assert (config.data.size, Schedule.from_config(config).restart_step) == (90, 30)
    page = sections(Results(table, trained, scenes, runs, (), PaperBudget(), False))
    (lines,) = (section.lines for section in page if section.heading == "Settings")
    assert [line[1] for line in lines if line[0] == "Grid4D"] == ["all", "Broom", "Chicken", "other"]


def refused(paper: Paper) -> str | None:
    """The field that a command refuses."""
    try:
        paper.execute()
    except InvalidInput as error:
        return error.field
    return None


@contextmanager
def errors_in_words() -> Iterator[None]:
    """Invalid input as a line, and exit codes as those of `msdgs-train`."""
    try:
        yield
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted")
        sys.exit(EXIT_INTERRUPTED)
    except (MsdgsError, OSError) as error:
        Console(stderr=True).print(
            f"error: {in_words(error)}", style="red", markup=False, highlight=False, soft_wrap=True
        )
        sys.exit(EXIT_INVALID)


if __name__ == "__main__":
    begin()
    with errors_in_words():
        options = tyro.cli(Paper, prog="python -m benchmarks.paper")
        sys.exit(self_test() if options.check else options.execute())
