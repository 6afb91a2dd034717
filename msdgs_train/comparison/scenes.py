"""The scenes of a comparison: datasets, each at one size and with its own split."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.comparison.tables import read_tables, require_unique
from msdgs_train.datasets.config import DataConfig

SPLITS = ("val", "test")
SETTINGS = ("size", "llffhold", "time_from")


@dataclass(frozen=True)
class Scene:
    """A dataset and the settings with which it is read."""

    name: str
    folder: Path
    settings: Mapping[str, Any]  # of `SETTINGS`; they replace those of the system and the command
    splits: tuple[str, ...] = SPLITS  # whose metrics are reported


def read_scenes(sources: Sequence[Path], names: Sequence[str] = ()) -> list[Scene]:
    """Return the scenes of dataset folders and of TOML files, or those with the given names.

    Each table of a file is a scene: its `folder`, relative to the file, and optionally `size`, `llffhold`, `time_from`
    and `splits`. Raises `InvalidInput` naming what is unknown, invalid or missing.
    """
    scenes = all_scenes(sources)
    known = [scene.name for scene in scenes]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InvalidInput("scenes", f"of {', '.join(known)}", unknown[0])
    chosen = [scene for scene in scenes if scene.name in names or not names]
    require_folders(chosen)
    return chosen


def all_scenes(sources: Sequence[Path]) -> list[Scene]:
    """The same, of all names, whether or not there are their folders."""
    scenes = [scene for source in sources for scene in _scenes(source)]
    require_unique("scene", (scene.name for scene in scenes))
    return scenes


def require_folders(scenes: Sequence[Scene]) -> None:
    """Raise `InvalidInput` naming the folders of scenes that are missing."""
    missing = dict.fromkeys(str(scene.folder) for scene in scenes if not scene.folder.is_dir())
    if missing:
        raise InvalidInput("data", "folders of datasets", f"no folder {', '.join(missing)}")


def _scenes(source: Path) -> list[Scene]:
    if source.suffix != ".toml":
        folder = source.resolve()
        return [Scene(folder.name, folder, {})]
    return [_scene(source, name, table) for name, table in read_tables("data", source).items()]


def _scene(file: Path, name: str, table: Mapping[str, Any]) -> Scene:
    folder, splits = table.get("folder"), table.get("splits", list(SPLITS))
    unknown = table.keys() - {"folder", "splits", *SETTINGS}
    if unknown:
        raise InvalidInput("data", f"made of folder, splits, {', '.join(SETTINGS)}", f"scene `{name}`: {min(unknown)}")
    if not isinstance(folder, str):
        raise InvalidInput("data", "scenes with a folder", f"scene `{name}` of {file}")
    if not (isinstance(splits, list) and splits and all(split in SPLITS for split in splits)):
        raise InvalidInput("data", f"scenes with splits of {', '.join(SPLITS)}", f"scene `{name}`: {splits}")
    settings = {key: table[key] for key in SETTINGS if key in table}
    try:
        DataConfig(**settings)
    except InvalidInput as error:
        raise InvalidInput("data", "made of valid settings", f"scene `{name}`: {error}") from error
    return Scene(name, (file.parent / folder).resolve(), settings, tuple(splits))
