"""docs/formats.md shows for each format what its reader does with each field."""

import re
from pathlib import Path

import pytest

from msdgs_export.importers.splats import ksplat, ply_fields, sog, splat, spz_container
from msdgs_serve import camera_path
from msdgs_serve.scene.fields import FieldTable
from msdgs_train.datasets.colmap.model import COLMAP_FIELDS
from msdgs_train.datasets.common.transforms_fields import TRANSFORMS_FIELDS
from msdgs_train.datasets.hypernerf import HYPERNERF_FIELDS
from msdgs_train.datasets.neu3d import NEU3D_FIELDS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "formats.md"
TABLES: tuple[FieldTable, ...] = (
    ply_fields.PLY,
    spz_container.FIELDS,
    sog.FIELDS,
    ksplat.FIELDS,
    splat.FIELDS,
    TRANSFORMS_FIELDS,
    COLMAP_FIELDS,
    HYPERNERF_FIELDS,
    NEU3D_FIELDS,
    camera_path.FIELDS,
)


def documented(section: str) -> dict[str, str]:
    """Use of each field by name, as the page's table under this heading has it."""
    text = PAGE.read_text(encoding="utf-8").partition(f"### {section}\n")[2].partition("\n#")[0]
    rows = re.findall(r"^\| (`.*`) \| (applied|refused|harmless)\b", text, flags=re.MULTILINE)
    return {name: use for names, use in rows for name in re.findall("`([^`]+)`", names)}


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.format)
def test_the_page_shows_the_table(table: FieldTable):
    assert documented(table.format) == dict(table.uses)
