"""Other people's scenes in: files and folders of other formats to what a scene file stores.

One file a format. Each reader takes what it is given as hostile: sizes are checked before memory is taken, no code in
a file is run, and what is wrong is said with the file's name.
"""

from export.importers.detect import KINDS, READERS, read_splats, recognise
from export.importers.errors import ImportFailed
from export.importers.splats.base import Splats

__all__ = ["KINDS", "READERS", "ImportFailed", "Splats", "read_splats", "recognise"]
