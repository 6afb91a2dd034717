"""Layers, supports and systems from outside this package.

A plugin is a module that registers them when it is imported. It is named by the entry point group `msdgs.plugins` of an
installed package, or by `--plugin`, which worker processes inherit through the environment.
"""

import importlib
import importlib.metadata
import importlib.util
import os
import sys
from functools import cache
from pathlib import Path

from msdgs_serve.scene.errors import InvalidInput

GROUP = "msdgs.plugins"
VARIABLE = "MSDGS_PLUGINS"


def add_plugin(name: str) -> None:
    """Import a plugin, here and in worker processes: the name of a module, or the path of a Python file.

    Raises `InvalidInput` if there is no such module.
    """
    name = str(Path(name).resolve()) if name.endswith(".py") else name
    known = os.environ.get(VARIABLE, "").split(os.pathsep)
    _import(name)
    if name not in known:
        os.environ[VARIABLE] = os.pathsep.join([*filter(None, known), name])


@cache
def load_plugins() -> None:
    """Import all plugins, once a process."""
    for entry in importlib.metadata.entry_points(group=GROUP):
        entry.load()
    for name in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
        _import(name)


def _import(name: str) -> None:
    try:
        if not name.endswith(".py"):
            importlib.import_module(name)
            return
        stem = Path(name).stem
        if stem in sys.modules:
            known = getattr(sys.modules[stem], "__file__", None)
            if known is None or Path(known).resolve() != Path(name).resolve():
                raise InvalidInput("plugin", f"a file of another name: there is a module `{stem}`", name)
            return
        spec = importlib.util.spec_from_file_location(stem, name)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[stem] = module  # before it runs, as the import system does
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[stem]
            raise
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise InvalidInput("plugin", "a module that can be imported, or a Python file", f"{name}: {error}") from error
