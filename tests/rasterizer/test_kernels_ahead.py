"""What is compiled ahead of the first request is all that requests need."""

import json
from pathlib import Path

from msdgs_serve.api.cli import USAGE_ERROR, main
from tests.support.processes import ROOT, run_python

KERNELS_AFTER = """
import importlib, json, pkgutil, sys
from numba.core.dispatcher import Dispatcher
import msdgs_serve.rasterizer as rasterizer
from msdgs_serve.rasterizer.ahead import compile_kernels

def compiled():
    names = [f"{rasterizer.__name__}.{module.name}" for module in pkgutil.iter_modules(rasterizer.__path__)]
    return {
        f"{name}.{kernel}": sorted(map(str, value.signatures))
        for name in names
        for kernel, value in vars(importlib.import_module(name)).items()
        if isinstance(value, Dispatcher)
    }

compile_kernels()
ahead = compiled()
"""

FRAMES = (
    KERNELS_AFTER
    + """
import dataclasses
from pathlib import Path
from msdgs_serve.api.cameras import resolve_camera
from msdgs_serve.api.schemas import RenderRequest
from msdgs_serve.renderer import Renderer, RenderOptions, Shutter
from msdgs_serve.store import SceneStore

served = SceneStore([Path(sys.argv[1])]).get("toybench")
session = served.session
request = RenderRequest.model_validate(
    {"camera": {"type": "orbit", "azimuth": 0, "elevation": 0}, "t": 0.5, "width": 40, "height": 30}
)
camera = resolve_camera(request, served)
renderer = Renderer()
for model in ("pinhole", "orthographic", "fisheye"):
    view = dataclasses.replace(camera, model=model)
    for options in (
        RenderOptions(),
        RenderOptions(depth=True),
        RenderOptions(background="transparent"),
        RenderOptions(background=(1.0, 0.5, 0.0), motion_dt=0.1),
        RenderOptions(shutter=Shutter(0.0, 0.1, 3)),
    ):
        renderer.render(session, view, 0.5, options)
print(json.dumps([ahead, compiled()]))
"""
)


def test_frames_need_no_kernel_beyond_those_compiled_ahead() -> None:
    ahead, after = json.loads(run_python(FRAMES, ROOT / "examples" / "toybench.onnx"))
    assert ahead["msdgs_serve.rasterizer.projection._project_parts"]
    assert ahead["msdgs_serve.rasterizer.compositing._composite_tiles"]
    assert after == ahead


def test_compiling_says_where_the_kernels_are() -> None:
    printed = run_python("from msdgs_serve.api.cli import main; main(['--compile'])", NUMBA_CACHE_DIR="")
    folder = Path(printed.rsplit(" in ", 1)[1].strip())
    assert list(folder.glob("rasterizer/__pycache__/compositing._composite_tiles-*.nbc"))


def test_compiling_for_nothing_is_refused(tmp_path: Path, capsys, monkeypatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "kernels"))
    assert main(["--compile"]) == USAGE_ERROR
    assert "can't be written" in capsys.readouterr().err
