"""A plugin that can't be imported is one line with its file and line."""

import importlib.metadata
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.cli import main as cli
from msdgs_train.layers import plugins
from msdgs_train.layers.plugins import add_plugin, load_plugins

CASES = {
    "unknown_name": ("import math\n\nLayer\n", "line 3: NameError: name 'Layer' is not defined"),
    "wrong_grammar": ("import math\ndef layer(:\n    pass\n", "line 2: SyntaxError: "),
    "null": ("a = 1\0\n", "null bytes"),
    "missing_package": ("\nimport no_such_package\n", "line 2: ModuleNotFoundError: No module named 'no_such_package'"),
    "ended": ("import sys\nsys.exit('usage: plugin FILE')\n", "line 2: SystemExit: usage: plugin FILE"),
    "in_a_function": (
        "def register():\n    return 1 / 0\n\n\nregister()\n",
        "line 2: ZeroDivisionError: ",
    ),
    "of_a_library": ("import json\njson.loads('{')\n", "line 2: JSONDecodeError: "),
    "wrong_setting": (
        "from msdgs_train.systems.registry import preset\n\npreset('static').updated(steps=0)\n",
        "line 3: `config.steps` must be a whole number of 1 or more, got 0",
    ),
}


@pytest.fixture(params=CASES)
def broken(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, str]:
    """A plugin's file, and the end of its message."""
    contents, message = CASES[request.param]
    file = tmp_path / f"broken_{request.param}.py"
    file.write_text(contents)
    return file, message


def test_a_file_that_fails_is_named_with_its_line(broken: tuple[Path, str]) -> None:
    file, message = broken
    for _ in range(2):  # it isn't taken for imported
        with pytest.raises(InvalidInput) as failed:
            add_plugin(str(file))
        assert f"{file}" in str(failed.value)
        assert message in str(failed.value)
        assert str(failed.value).count("\n") == 0
        assert file.stem not in sys.modules


def test_so_is_a_module(broken: tuple[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    file, message = broken
    monkeypatch.syspath_prepend(file.parent)
    with pytest.raises(InvalidInput) as failed:
        add_plugin(file.stem)
    assert message in str(failed.value)


def test_so_is_one_of_an_installed_package(broken: tuple[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    file, message = broken
    monkeypatch.syspath_prepend(file.parent)
    entry = EntryPoint("mine", file.stem, plugins.GROUP)
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [entry])
    with pytest.raises(InvalidInput) as failed:
        load_plugins.__wrapped__()
    assert message in str(failed.value)


@pytest.mark.parametrize("name", ["no_such_module", "no.such.module", "/nowhere/plugin.py"])
def test_one_that_is_not_there_is_one_line(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fit", "data", "run", "--plugin", name]) == cli.EXIT_INVALID
    error = capsys.readouterr().err
    assert error.startswith(f"error: `plugin` must be a module that can be imported, or a Python file, got {name}: ")
    assert error.count("\n") == 1
    assert "line" not in error
