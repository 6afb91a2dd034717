"""`python export/stability.py model.pt`: `msdgs-stability` of this checkout, from any folder."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

    from msdgs_export.commands import stability

    sys.exit(stability())
