"""Tables and a plot of what `python -m benchmarks.rasterizer` has measured."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from benchmarks.measuring import minimum_and_median
from benchmarks.rasterizer.stages import STAGES

Row = dict[str, Any]


def print_tables(result: Row, console: Console) -> None:
    """Each section that has been measured."""
    at_most = result["machine"]
    console.print(at_most["name"])
    if "gflops" in at_most:
        rates = f"{at_most['gflops']:.0f} GFLOP/s of float32 fma, {at_most['gigabytes']:.1f} GB/s copied"
        console.print(f"at most seen in this run: {rates}")
    for section, title in (("frames", "Seeded scenes"), ("real", "Real splats")):
        if section in result:
            console.print(_stages(result[section], title), _work(result[section]))
    if "scenes" in result:
        console.print(_scenes(result["scenes"]))
    for line in summary(result):
        console.print(line)


def summary(result: Row) -> list[str]:
    """What the tables say about growth, and about the seeded scenes as a model of real ones."""
    rows = {(row["count"], tuple(row["size"])): row for row in result.get("frames", [])}
    lines = []
    for size in dict.fromkeys(size for _, size in rows):
        if (100_000, size) in rows and (1_000_000, size) in rows:
            growth = _total(rows[1_000_000, size]) / _total(rows[100_000, size])
            lines.append(f"100k to 1M Gaussians at {_size(size)}: {growth:.2f} times the time")
    for row in result.get("real", []):
        if "predicted_milliseconds" in row:
            ratio = _total(row) / row["predicted_milliseconds"]
            lines.append(f"{row['scene']}: {ratio:.2f} times what seeded scenes with as much work take")
    return lines


def _total(row: Row) -> float:
    return row["milliseconds"]["total"]["min"]


def _size(size: Any) -> str:
    return f"{size[0]}×{size[1]}"


def table(title: str, *columns: str) -> Table:
    """Names on the left, figures on the right."""
    made = Table(title=title, title_justify="left")
    for k, column in enumerate(columns):
        made.add_column(column, justify="right" if k else "left")
    return made


def _stages(rows: list[Row], title: str) -> Table:
    gradient = "backward" in rows[0]["milliseconds"]
    columns = ["scene", "size", "project", "sort, bin", "composite", "total", "pairs", "ns/pair", "Mpairs/s"]
    columns += ["forward", "backward", "ratio"] if gradient else []
    made = table(f"{title}: milliseconds, minimum (median) of {rows[0]['repeats']}", *columns)
    for row in rows:
        times = row["milliseconds"]
        cells = [minimum_and_median(times[name]) for name in STAGES]
        cells += [f"{row['blended'] / 1e6:.1f} M", f"{row['ns_per_pair']:.2f}", f"{row['pairs_per_second'] / 1e6:.0f}"]
        if gradient:
            cells += [minimum_and_median(times["forward"]), minimum_and_median(times["backward"])]
            cells.append(f"{times['backward']['min'] / times['forward']['min']:.2f}")
        made.add_row(row["title"], _size(row["size"]), *cells)
    return made


def _work(rows: list[Row]) -> Table:
    made = table(
        "Work and memory; floors in milliseconds at the rates above",
        *("scene", "size", "visible", "tile entries", "lanes", "blended", "floor: blended", "lanes", "memory"),
        *("total / (lanes + memory)", "MB", "bytes/splat"),
    )
    for row in rows:
        floor = row["floor_milliseconds"]
        made.add_row(
            row["title"],
            _size(row["size"]),
            *(f"{row[name]:,}" for name in ("visible", "tile_entries", "lanes", "blended")),
            *(f"{floor[name]:.1f}" for name in ("arithmetic", "lanes", "memory")),
            f"{_total(row) / (floor['lanes'] + floor['memory']):.1f}",
            f"{row['memory_bytes'] / 1e6:.1f}",
            f"{row['bytes_per_splat']:.0f}",
        )
    return made


def _scenes(rows: list[Row]) -> Table:
    made = table(
        "Scene files: milliseconds, minimum (median)", "scene", "plan", "moving", "width", "pose", "draw", "pose share"
    )
    for row in rows:
        pose, draw = row["milliseconds"]["pose"], row["milliseconds"]["draw"]
        cells = minimum_and_median(pose), minimum_and_median(draw), f"{pose['min'] / (pose['min'] + draw['min']):.0%}"
        made.add_row(row["scene"], row["plan"], f"{row['moving']:,}", f"{row['width']}", *cells)
    return made


def draw_plot(result: Row, path: Path) -> None:
    """Times over the number of Gaussians, and the machine's floor for the same work."""
    figure = Figure(figsize=(7, 5.2), layout="constrained")
    axes = figure.subplots()
    for size in dict.fromkeys(tuple(row["size"]) for row in result["frames"]):
        some = [row for row in result["frames"] if tuple(row["size"]) == size]
        counts, floors = [row["count"] for row in some], [row["floor_milliseconds"] for row in some]
        (line,) = axes.plot(counts, [_total(row) for row in some], marker="o", label=_size(size))
        axes.plot(counts, [each["lanes"] + each["memory"] for each in floors], linestyle=":", color=line.get_color())
    axes.plot([], [], linestyle=":", color="grey", label="the machine's floor for the same")
    for row in result.get("real", []):
        axes.scatter(row["count"], _total(row), marker="x", color="black", zorder=3)
        place = row["count"], _total(row)
        axes.annotate(row["scene"], place, xytext=(5, -10), textcoords="offset points", fontsize=7)
    axes.set(xscale="log", yscale="log", xlabel="Gaussians", ylabel="milliseconds per frame, minimum of all turns")
    axes.grid(which="both", alpha=0.2)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, format="png")
