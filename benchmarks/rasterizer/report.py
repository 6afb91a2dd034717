"""Tables of what `python -m benchmarks.rasterizer` has measured."""

from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.measuring import minimum_and_median
from benchmarks.rasterizer.stages import STAGES

Row = dict[str, Any]


def print_tables(result: Row, console: Console) -> None:
    """Each section that has been measured."""
    machine = result["machine"]
    console.print(machine["name"])
    if "gflops" in machine:
        rates = f"{machine['gflops']:.0f} GFLOP/s of float32 fma, {machine['gigabytes']:.1f} GB/s copied"
        console.print(f"at most seen in this run: {rates}")
    for section, title in (("frames", "Seeded scenes"), ("real", "Real splats")):
        if section in result:
            console.print(_stages(result[section], title), _work(result[section]))
    if "scenes" in result:
        console.print(_scenes(result["scenes"]))
    console.print(*growth(result.get("frames", [])), sep="\n")


def growth(rows: list[Row]) -> list[str]:
    """From 100,000 to 1,000,000 Gaussians."""
    totals = {(row["count"], _size(row["size"])): _total(row) for row in rows}
    return [
        f"100k to 1M Gaussians at {size}: {total / totals[100_000, size]:.2f} times the time"
        for (count, size), total in totals.items()
        if count == 1_000_000 and (100_000, size) in totals
    ]


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
        *("scene", "size", "visible", "tile entries", "evaluated", "blended", "floor: blended", "evaluated", "memory"),
        *("total / (evaluated + memory)", "MB", "bytes/splat"),
    )
    for row in rows:
        floor = row["floor_milliseconds"]
        made.add_row(
            row["title"],
            _size(row["size"]),
            *(f"{row[name]:,}" for name in ("visible", "tile_entries", "evaluated", "blended")),
            *(f"{floor[name]:.1f}" for name in ("arithmetic", "evaluated", "memory")),
            f"{_total(row) / (floor['evaluated'] + floor['memory']):.1f}",
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
