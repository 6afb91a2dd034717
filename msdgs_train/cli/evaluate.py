"""`msdgs-train eval`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.cli.console import console, frame_progress, rich_table
from msdgs_train.settings import optional

ONE_OR_MORE_RUNS = tyro.conf.arg(metavar="RUN...", help_behavior_hint="(one or more)")


@dataclass(frozen=True)
class Eval:
    """Evaluate the last and the best model of runs on held-out images: PSNR, SSIM, LPIPS, ꟻLIP, and PSNR of the
    moving region, since a static background hides errors of the motion.

    RUN/eval gets numbers for every image (<split>.json), a table (<split>.md) and a contact sheet of images, renderings
    and errors (<split>.png). LPIPS and ꟻLIP are omitted if their packages or weights are missing; nothing is
    downloaded. Several runs are also drawn side by side.

    Example:  msdgs-train eval runs/first

    Two runs beside the same images:  msdgs-train eval runs/first runs/second --sheet first_and_second.png
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, ONE_OR_MORE_RUNS]
    """Folders of runs that `msdgs-train fit` has filled."""
    data: Annotated[Path | None, optional("DATA")] = None
    """The folder of the dataset, if it has moved since training."""
    split: Literal["test", "val", "train"] = "test"
    """The images to evaluate on."""
    sheet: Annotated[Path | None, optional("PNG")] = None
    """With several runs, the PNG to write, side_by_side.png by default: one row per image, with the rendering of each
    run."""

    def execute(self) -> int:
        from msdgs_train.evaluation.evaluate import evaluate_run
        from msdgs_train.evaluation.report import HEADINGS, cells, draw_runs, notes, write_evaluation
        from msdgs_train.evaluation.sheets import check_sheet

        if not self.runs:
            raise InvalidInput("RUN", "the folder of one run or more", "none")
        folders = [run.resolve() for run in self.runs]
        if again := [run for number, run in enumerate(self.runs) if folders[number] in folders[:number]]:
            raise InvalidInput("RUN", "different folders", f"{again[0]} twice")
        sheet = self.sheet or Path("side_by_side.png")
        if len(self.runs) > 1:
            check_sheet("sheet", sheet)
        elif self.sheet is not None:
            raise InvalidInput("sheet", "left out with one run, whose own sheets are in RUN/eval", self.sheet)
        evaluations = {}
        for run in self.runs:
            with frame_progress(0) as progress:
                evaluation = evaluations[str(run)] = evaluate_run(run, self.data, self.split, progress)
            paths = write_evaluation(run, evaluation)
            title = f"{run}: {evaluation.split}, mean of {len(evaluation.frames)} images"
            rows = [[m.name, f"{m.loaded.step:,}", *cells(evaluation, m.mean)] for m in evaluation.models]
            console.print(rich_table(["model", "step", *HEADINGS.values()], rows, names=1, title=title))
            for note in notes(evaluation):
                console.print(note, soft_wrap=True, highlight=False)
            console.print("wrote " + ", ".join(map(str, paths)), soft_wrap=True)
        if len(evaluations) > 1:
            draw_runs(sheet, evaluations)
            console.print(f"wrote {sheet}", soft_wrap=True)
        return 0
