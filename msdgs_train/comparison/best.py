"""The best evaluation during training beside the last model, from the rows of runs."""

from collections.abc import Sequence

from msdgs_train.comparison.gains import mean_and_deviation
from msdgs_train.comparison.rows import Row
from msdgs_train.evaluation.report import markdown_table

HEADING = "Best evaluation during training"
COLUMNS = ("chosen on", "last, dB", "best, dB", "step of the best")
NOTE = (
    "PSNR of the last model and of the best of those evaluated during training, mean ± standard deviation over seeds, "
    "on the images by which the best is chosen: val, or test where there are none. "
    "A dash: not recorded."
)


def best_evaluation(rows: Sequence[Row], scene: str, system: str) -> list[str] | None:
    """The cells of `COLUMNS`; dashes if the rows don't have them, None if there are no rows."""
    found = [row for row in rows if (row["scene"], row["system"]) == (scene, system)]
    known = [row for row in found if row["best_split"]]
    if not known:
        return ["–"] * len(COLUMNS) if found else None
    split = known[0]["best_split"]
    last = [float(row[f"{split}_psnr"]) for row in known if row[f"{split}_psnr"]]
    best, steps = ([float(row[name]) for row in known] for name in ("best_psnr", "best_step"))
    return [
        split,
        mean_and_deviation(last, 2) if last else "–",
        mean_and_deviation(best, 2),
        mean_and_deviation(steps, 0),
    ]


def best_as_markdown(rows: Sequence[Row], systems: Sequence[str]) -> str:
    """A line per system and scene."""
    scenes = dict.fromkeys(row["scene"] for row in rows)
    cells = {(system, scene): best_evaluation(rows, scene, system) for system in systems for scene in scenes}
    lines = [[*names, *found] for names, found in cells.items() if found]
    return "\n".join([f"{HEADING}:", "", markdown_table(["system", "scene", *COLUMNS], lines), "", NOTE]) + "\n"
