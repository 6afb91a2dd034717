"""Other spellings of the numbers in the names of images, which all names share."""

import re
from collections.abc import Sequence

from msdgs_train.datasets.common.hexadecimal import as_decimal

MONTHS = (
    "january", "february", "march", "april", "may", "june", "july", "august", "september", "october", "november",
    "december",
)  # fmt: skip
YEAR, DAY = r"(?P<{}y>(?:19|20)\d\d)", r"(?P<{}d>0?[1-9]|[12]\d|3[01])(?:st|nd|rd|th)?"
MONTH = rf"(?P<{{}}m>{'|'.join(f'{name[:3]}(?:{name[3:]})?' for name in MONTHS)}|sept)"
BETWEEN, END = r"[-_.,\s]*", r"(?!\d(?!\d{5}(?!\d)))"  # a clock of six digits may follow
NAMED_DATE = re.compile(
    "|".join(
        start + BETWEEN.join(part.format(order) for part in parts) + END
        for order, start, parts in (
            ("a", r"(?<!\d)", (DAY, MONTH, YEAR)),
            ("b", r"(?<![A-Za-z])", (MONTH, DAY, YEAR)),
            ("c", r"(?<!\d)", (YEAR, MONTH, DAY)),
        )
    ),
    re.IGNORECASE,
)
COPY = re.compile(r"(\s*)\(\d+\)(?=\.[A-Za-z]\w*$)")


def plain(names: Sequence[str]) -> list[str]:
    """The names with hexadecimal counters as decimal numbers, names of months as numbers (`10Jan2024`), and `(0)` on
    files of which there are numbered copies (`a.png`, `a(1).png`), if there are of all."""
    names = [NAMED_DATE.sub(_date, name) for name in as_decimal(names)]
    copied = {COPY.sub("", name): match[1] for name in names if (match := COPY.search(name))}
    if copied.keys() != {COPY.sub("", name) for name in names}:
        return names
    return [re.sub(r"(?=\.\w+$)", f"{copied[name]}(0)", name) if name in copied else name for name in names]


def _date(match: re.Match[str]) -> str:
    year, month, day = (next(match[order + part] for order in "abc" if match[order + part]) for part in "ymd")
    number = 1 + [name[:3] for name in MONTHS].index(month[:3].lower())
    return f"{year}{number:02}{int(day):02}"
