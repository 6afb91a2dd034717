"""Layers, supports and systems from outside this package.

A plugin is a module that registers them when it is imported. It is named by the entry point group `msdgs.plugins` of an
installed package, or by `--plugin`, which worker processes inherit through the environment.
"""

import importlib
import importlib.metadata
import importlib.util
import os
import pkgutil
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_serve.writing import in_words

SYSTEMS = "msdgs_train.systems"
"""The package whose modules register the systems of this project, as plugins do theirs."""
GROUP = "msdgs.plugins"
VARIABLE = "MSDGS_PLUGINS"
IMPORTERS = (__file__, importlib.__file__, importlib.metadata.__file__)
"""Files of code that imports plugins, besides Python's own, whose names begin with `<`."""


def add_plugin(name: str) -> None:
    """Import a plugin, here and in worker processes: the name of a module, or the path of a Python file.

    Raises `InvalidInput` if there is no such module, or its code fails.
    """
    name = str(Path(name).resolve()) if name.endswith(".py") else name
    known = os.environ.get(VARIABLE, "").split(os.pathsep)
    _import(name)
    if name not in known:
        os.environ[VARIABLE] = os.pathsep.join([*filter(None, known), name])


@cache
def load_plugins() -> None:
    """Import this project's systems and all plugins, once a process."""
    for module in pkgutil.iter_modules(importlib.import_module(SYSTEMS).__path__):
        importlib.import_module(f"{SYSTEMS}.{module.name}")
    for entry in importlib.metadata.entry_points(group=GROUP):
        with _named(entry.value):
            entry.load()
    for name in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
        _import(name)


def _import(name: str) -> None:
    if name.endswith(".py"):
        _import_file(Path(name))
    else:
        with _named(name):
            importlib.import_module(name)


def _import_file(file: Path) -> None:
    if file.stem in sys.modules:
        known = getattr(sys.modules[file.stem], "__file__", None)
        if known is None or Path(known).resolve() != file.resolve():
            raise InvalidInput("plugin", f"a file of another name: there is a module `{file.stem}`", file)
        return
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[file.stem] = module  # before it runs, as the import system does
    try:
        with _named(str(file)):
            spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[file.stem]
        raise


@contextmanager
def _named(name: str) -> Iterator[None]:
    """Raise `InvalidInput` for any error of a plugin's code, with its file and line."""
    try:
        yield
    except (Exception, SystemExit) as error:  # its code may raise anything
        known = isinstance(error, MsdgsError | OSError)
        what = in_words(error) if known else f"{type(error).__name__}: {error}"
        problem = f"{name}: {_place(error)}{what}"
        raise InvalidInput("plugin", "a module that can be imported, or a Python file", problem) from error


def _place(error: BaseException) -> str:
    """`FILE, line N: ` of the plugin's code; nothing if none of it has run."""
    if isinstance(error, SyntaxError):
        return f"{error.filename}, line {error.lineno}: "
    frames = [each for each in traceback.extract_tb(error.__traceback__) if each.filename not in IMPORTERS]
    frames = [frame for frame in frames if not frame.filename.startswith("<")]
    if not frames:
        return ""
    *_, last = (frame for frame in frames if frame.filename == frames[0].filename)
    return f"{last.filename}, line {last.lineno}: "
