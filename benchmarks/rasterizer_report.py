"""Tables and a plot of what rasterizer.py has measured."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter
from rich.console import Console
from rich.table import Table

Row = dict[str, Any]


def print_tables(result: Row, console: Console) -> None:
    """Each section that has been measured."""
    machine = result["machine"]
    console.print(f"{machine['cpu']}, {machine['threads']} threads")
    if "gflops" in machine:
        console.print(
            f"at most seen in this run: {machine['gflops']:.0f} GFLOP/s of float32 fma, "
            f"{machine['gigabytes']:.1f} GB/s copied"
        )
    for section, title in (("frames", "Seeded scenes"), ("real", "Real splats")):
        if section in result:
            console.print(_stages(result[section], title), _floors(result[section]))
    for section, table in (("avx512", _avx512), ("knobs", _knobs), ("others", _others), ("checkouts", _checkouts)):
        if result.get(section):
            console.print(table(result[section]))
    if "no_avx512" in result:
        console.print(f"no renderer written by hand for AVX-512: {result['no_avx512']}")
    if "oracle_agreement" in result:
        console.print(
            f"float64 against tests/support/reference.py, a small scene: {result['oracle_agreement']:.1e} at most"
        )
    for line in summary(result):
        console.print(line)


def summary(result: Row) -> list[str]:
    """What the tables say about growth and about the gradient."""
    rows = {(row["count"], tuple(row["size"])): row for row in result.get("frames", [])}
    lines = []
    for size in dict.fromkeys(size for _, size in rows):
        if (100_000, size) in rows and (1_000_000, size) in rows:
            growth = _total(rows[1_000_000, size]) / _total(rows[100_000, size])
            lines.append(f"100k to 1M Gaussians at {_size(size)}: {growth:.2f} times the time")
    for row in result.get("real", []):
        if "predicted_milliseconds" in row:
            share = _total(row) / row["predicted_milliseconds"]
            lines.append(f"{row['scene']}: {share:.2f} times what the seeded scenes foretell for its work")
    return lines


def _total(row: Row) -> float:
    return row["milliseconds"]["total"]["min"]


def _size(size: Any) -> str:
    return f"{size[0]}×{size[1]}"


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left")
    for k, column in enumerate(columns):
        table.add_column(column, justify="right" if k else "left")
    return table


def _minimum_and_median(times: Row) -> str:
    return f"{times['min']:.1f} ({times['median']:.1f})"


def _stages(rows: list[Row], title: str) -> Table:
    gradient = "backward" in rows[0]["milliseconds"]
    columns = ["scene", "size", "project", "sort, bin", "composite", "total", "pairs", "ns/pair", "Mpairs/s"]
    table = _table(
        f"{title}: milliseconds, minimum (median) of {rows[0]['repeats']}",
        *columns,
        *(["forward", "backward", "ratio"] if gradient else []),
    )
    for row in rows:
        times = row["milliseconds"]
        cells = [_minimum_and_median(times[name]) for name in ("project", "bin", "composite", "total")]
        cells += [f"{row['blended'] / 1e6:.1f} M", f"{row['ns_per_pair']:.2f}", f"{row['pairs_per_second'] / 1e6:.0f}"]
        if gradient:
            cells += [_minimum_and_median(times["forward"]), _minimum_and_median(times["backward"])]
            cells.append(f"{times['backward']['min'] / times['forward']['min']:.2f}")
        table.add_row(f"{row['scene']} {row['count']:,}", _size(row["size"]), *cells)
    return table


def _floors(rows: list[Row]) -> Table:
    table = _table(
        "Work and memory; floors in milliseconds at the rates above",
        *("scene", "size", "visible", "tile entries", "lanes", "blended", "floor: blended", "lanes", "memory"),
        *("total / (lanes + memory)", "MB", "bytes/splat"),
    )
    for row in rows:
        floor = row["floor_milliseconds"]
        table.add_row(
            f"{row['scene']} {row['count']:,}",
            _size(row["size"]),
            *(f"{row[name]:,}" for name in ("visible", "tile_entries", "lanes", "blended")),
            *(f"{floor[name]:.1f}" for name in ("arithmetic", "lanes", "memory")),
            f"{_total(row) / (floor['lanes'] + floor['memory']):.1f}",
            f"{row['memory_bytes'] / 1e6:.1f}",
            f"{row['bytes_per_splat']:.0f}",
        )
    return table


def _avx512(rows: list[Row]) -> Table:
    table = _table(
        "Beside a renderer written by hand for AVX-512, in turns: milliseconds, ours / by hand",
        *("Gaussians", "size", "project", "sort, bin", "composite", "total", "ours / by hand", "PSNR"),
    )
    for row in rows:
        ours, other = row["ours"], row["by_hand"]
        cells = [
            f"{ours[name]['min']:.1f} / {other[name]['min']:.1f}" for name in ("project", "bin", "composite", "total")
        ]
        table.add_row(f"{row['count']:,}", _size(row["size"]), *cells, f"{row['ratio']:.2f}", f"{row['psnr']:.1f} dB")
    return table


def _knobs(rows: list[Row]) -> Table:
    table = _table(
        "One constant changed at a time",
        *(
            "knob",
            "value",
            "processor ms",
            "of usual",
            "dB to float64",
            "worst pixel",
            "dB to float64 without thresholds",
        ),
    )
    for row in rows:
        cells = (_minimum_and_median(row["milliseconds"]), f"{row['of_usual']:.2f}", f"{row['psnr']:.1f}")
        table.add_row(row["knob"], row["value"], *cells, f"{row['worst']:.1e}", f"{row['psnr_without_thresholds']:.1f}")
    return table


def _others(rows: list[Row]) -> Table:
    table = _table("Other renderers, 800×800, in turns", "renderer", "Gaussians", "ms", "times ours", "PSNR to ours")
    for row in rows:
        agreement = f"{row['psnr']:.1f} dB" if "psnr" in row else ""
        times = _minimum_and_median(row["milliseconds"])
        table.add_row(row["name"], f"{row['count']:,}", times, f"{row['times_ours']:.1f}", agreement)
    return table


def _checkouts(rows: list[Row]) -> Table:
    table = _table("Checkouts, 800×800, in turns", "Gaussians", "this one", "the other", "other / this", "PSNR")
    for row in rows:
        times = (_minimum_and_median(row["milliseconds"][name]) for name in ("this one", "the other"))
        table.add_row(
            f"{row['count']:,}", *times, f"{row['ratio']:.2f}", f"{row['psnr']:.1f} dB" if row["psnr"] else "same"
        )
    return table


ABOVE: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 1), "ncols": 3, "fontsize": 8}
"""Where a legend hides nothing."""


def draw_plot(result: Row, path: Path) -> None:
    """Times over the number of Gaussians, and, where knobs were turned, error over time."""
    knobs = result.get("knobs")
    figure = Figure(figsize=(13 if knobs else 7, 5.2), layout="constrained")
    axes = figure.subplots(1, 2 if knobs else 1, squeeze=False)[0]
    _draw_growth(axes[0], result)
    if knobs:
        _draw_knobs(axes[1], knobs)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, format="png")


def _draw_growth(axes: Any, result: Row) -> None:
    rows = result["frames"]
    for size in dict.fromkeys(tuple(row["size"]) for row in rows):
        some = [row for row in rows if tuple(row["size"]) == size]
        line = axes.plot([r["count"] for r in some], [_total(r) for r in some], marker="o", label=_size(size))[0]
        floors = [r["floor_milliseconds"]["lanes"] + r["floor_milliseconds"]["memory"] for r in some]
        axes.plot([r["count"] for r in some], floors, linestyle=":", color=line.get_color())
    axes.plot([], [], linestyle=":", color="grey", label="the machine's floor for the same")
    for row in result.get("real", []):
        axes.scatter(row["count"], _total(row), marker="x", color="black", zorder=3)
        axes.annotate(
            row["scene"], (row["count"], _total(row)), xytext=(5, -10), textcoords="offset points", fontsize=7
        )
    others = result.get("others", [])
    for name in dict.fromkeys(row["name"] for row in others if row["name"] != "msdgs"):
        some = [row for row in others if row["name"] == name]
        axes.plot(
            [r["count"] for r in some], [r["milliseconds"]["min"] for r in some], marker="s", label=f"{name}, 800×800"
        )
    axes.set(xscale="log", yscale="log", xlabel="Gaussians", ylabel="milliseconds a frame, least of all turns")
    axes.grid(which="both", alpha=0.2)
    axes.legend(**ABOVE)


def _draw_knobs(axes: Any, rows: list[Row]) -> None:
    for name in dict.fromkeys(row["knob"] for row in rows):
        some = [row for row in rows if row["knob"] == name]
        errors = [10 ** (-row["psnr_without_thresholds"] / 20) for row in some]
        axes.plot([row["milliseconds"]["min"] for row in some], errors, marker="o", linestyle="", label=name)
        for row, error in zip(some, errors, strict=True):
            place = (row["milliseconds"]["min"], error)
            # many values change time alone, so their labels would lie on each other
            axes.annotate(row["value"], place, xytext=(3, 3), textcoords="offset points", fontsize=7, rotation=50)
    axes.set(xscale="log", yscale="log", xlabel="processor milliseconds a frame, least of all turns")
    axes.xaxis.set_minor_formatter(ScalarFormatter())
    axes.set_ylabel("RMS error to float64 without thresholds")
    axes.grid(which="both", alpha=0.2)
    axes.margins(x=0.08)
    axes.legend(**ABOVE)
