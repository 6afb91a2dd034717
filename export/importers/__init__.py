"""Importers of scenes from other programs, one module per format.

All readers treat their input as hostile: sizes are checked before memory is allocated, no code in a file is run, and
errors name the file.
"""

from export.importers.detect import FORMATS, detect_format
from export.importers.errors import ImportFailed
from export.importers.splats.base import Splats
from export.importers.splats.formats import READERS, read_splats

__all__ = ["FORMATS", "READERS", "ImportFailed", "Splats", "detect_format", "read_splats"]
