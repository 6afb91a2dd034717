"""A page as sections of a heading, a table and notes: in Markdown, and in HTML without links to other files."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from string import Template

from msdgs_train.evaluation.report import markdown_table

PAGE = Path(__file__).with_name("page.html")


@dataclass(frozen=True)
class Section:
    """A part of a page; pictures are in HTML only."""

    heading: str
    columns: Sequence[str] = ()
    lines: Sequence[Sequence[str]] = ()
    notes: Sequence[str] = ()
    pictures: Mapping[str, bytes] = field(default_factory=dict)  # PNGs by caption


def as_markdown(title: str, sections: Sequence[Section]) -> str:
    """The page as Markdown."""
    parts = [f"# {title}"]
    for section in sections:
        if section.lines or section.notes:
            parts += [f"## {section.heading}"] if section.heading else []
            parts += [markdown_table(section.columns, section.lines)] if section.lines else []
            parts += section.notes
    return "\n\n".join(parts) + "\n"


def as_html(title: str, sections: Sequence[Section]) -> str:
    """The page as one HTML file."""
    body = "".join(f"<section>{_section(section)}</section>" for section in sections)
    return Template(PAGE.read_text(encoding="utf-8")).substitute(title=escape(title), body=body)


def _section(section: Section) -> str:
    parts = [f"<h2>{escape(section.heading)}</h2>" if section.heading else ""]
    if section.lines:
        rows = [_row("th", section.columns), *(_row("td", line) for line in section.lines)]
        parts.append(f"<div class=scroll><table>{''.join(rows)}</table></div>")
    parts += [f"<p>{escape(note)}</p>" for note in section.notes]
    parts += ["<div class=pictures>", *(_picture(*picture) for picture in section.pictures.items()), "</div>"]
    return "".join(parts)


def _row(tag: str, cells: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<{tag}>{escape(cell)}</{tag}>' for cell in cells)}</tr>"


def _picture(caption: str, png: bytes) -> str:
    coded = base64.b64encode(png).decode()
    return (
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{coded}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )
