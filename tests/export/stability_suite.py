"""`python -m tests.export.stability_suite`: all constructed cases as a table; `--write`: docs/data/stability.csv."""

import csv
import sys
from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from tests.export import stability_extreme, stability_stiff
from tests.export.stability_rows import FAILS, Row
from tests.support.processes import ROOT

TABLE = ROOT / "docs" / "data" / "stability.csv"


def all_rows() -> Iterator[Row]:
    yield from stability_stiff.all_rows()
    for group in stability_extreme.GROUPS:
        yield from group()


def main(arguments: list[str]) -> int:
    """Print the table; the exit status is 1 if a row fails."""
    if set(arguments) - {"--write"}:
        print(__doc__)
        return 2
    console, rows = Console(soft_wrap=True, highlight=False), []
    table = Table(*(name for name in Row._fields), box=None)
    with console.status("running the cases") as status:
        for row in all_rows():
            rows.append(row)
            table.add_row(*row, style="red" if row.verdict.startswith(FAILS) else "")
            status.update(f"{len(rows)} rows, {row.case}")
    console.print(table)
    failed = [row for row in rows if row.verdict.startswith(FAILS)]
    console.print(f"{len(rows)} rows, {len(failed)} of them fail")
    if "--write" in arguments:
        with TABLE.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([Row._fields, *rows])
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
