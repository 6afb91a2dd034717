"""Tables of `python -m benchmarks.rasterizer`."""

from typing import Any

from rich.table import Table

from benchmarks.measuring import minimum_and_median, table
from benchmarks.rasterizer.stages import STAGES

Rows = list[dict[str, Any]]


def stage_table(rows: Rows) -> Table:
    """Times by stage, pairs of splat and pixel, and the gradient if it was measured."""
    gradient = "backward" in rows[0]["milliseconds"]
    columns = ["scene", "size", "project", "sort, bin", "composite", "total", "pairs", "ns/pair", "Mpairs/s"]
    columns += ["forward", "backward", "ratio"] if gradient else []
    made = table(f"Milliseconds, minimum (median) of {rows[0]['repeats']}", *columns)
    for row in rows:
        times = row["milliseconds"]
        cells = [minimum_and_median(times[name]) for name in STAGES]
        cells += [f"{row['blended'] / 1e6:.1f} M", f"{row['ns_per_pair']:.2f}", f"{row['pairs_per_second'] / 1e6:.0f}"]
        if gradient:
            cells += [minimum_and_median(times["forward"]), minimum_and_median(times["backward"])]
            cells.append(f"{times['backward']['min'] / times['forward']['min']:.2f}")
        made.add_row(row["title"], "{}×{}".format(*row["size"]), *cells)
    return made


def work_table(rows: Rows) -> Table:
    """Counts, the least times that they allow on this machine, and memory."""
    made = table(
        "Work and memory; lower bounds in milliseconds at the rates above",
        *("scene", "size", "visible", "tile entries", "evaluated", "blended", "bound: blended", "evaluated", "memory"),
        *("total / (evaluated + memory)", "MB", "bytes/splat"),
    )
    for row in rows:
        bound, total = row["floor_milliseconds"], row["milliseconds"]["total"]["min"]
        made.add_row(
            row["title"],
            "{}×{}".format(*row["size"]),
            *(f"{row[name]:,}" for name in ("visible", "tile_entries", "evaluated", "blended")),
            *(f"{bound[name]:.1f}" for name in ("arithmetic", "evaluated", "memory")),
            f"{total / (bound['evaluated'] + bound['memory']):.1f}",
            f"{row['memory_bytes'] / 1e6:.1f}",
            f"{row['bytes_per_splat']:.0f}",
        )
    return made
