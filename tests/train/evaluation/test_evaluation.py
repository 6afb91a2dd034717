"""`msdgs-train eval`: metrics against the service's renderings, masks against known ones, files."""

import json
import shutil
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene import Gaussians, InvalidInput
from msdgs_train.cli import main as cli
from msdgs_train.datasets import Frame, load_scene
from msdgs_train.engine import run as fit_module
from msdgs_train.engine.metrics_log import read_metrics, to_bytes
from msdgs_train.engine.run import Observer, fit
from msdgs_train.engine.run_record import stored_config
from msdgs_train.engine.trainer import Trainer
from msdgs_train.evaluation import report as evaluation_report
from msdgs_train.evaluation.evaluate import evaluate_run
from msdgs_train.evaluation.metrics import image_metrics
from msdgs_train.evaluation.perceptual import perceptual_metrics
from msdgs_train.evaluation.sheets import CAPTION, HEADER
from msdgs_train.gaussians.model_file import load_model
from tests.support.tolerances import assert_close
from tests.support.training_scene import SIZE, small_config, write_scene

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run whose best model is not its last one."""
    run = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "draw_curve", lambda run: None)
        fit(small_config(steps=40, eval_every=5, static_fraction=0.1), data, run)
    return run


@pytest.fixture
def _clean(run: Path) -> None:
    for path in (run / "eval").glob("*"):
        path.unlink()


def _read(path: Path) -> np.ndarray:
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT))[..., :3]


@torch.no_grad()
def _render(path: Path, frame: Frame) -> np.ndarray:
    """Render with the service's rasterizer."""
    gaussians = Gaussians(*(tensor.numpy() for tensor in load_model(path).model.pose(frame.t)))
    return np.clip(rasterize(gaussians, frame.camera, background=(1.0, 1.0, 1.0)).rgb, 0, 1)


@pytest.mark.usefixtures("_clean")
def test_numbers_are_those_of_the_services_renderings(data: Path, run: Path) -> None:
    assert cli.main(["eval", str(run)]) == 0
    report = json.loads((run / "eval" / "test.json").read_text())
    assert report["data"] == str(data)
    assert set(report["models"]) == {"last", "best"}
    frames = load_scene(data).splits["test"]
    for name, file in (("last", "model.pt"), ("best", "best.pt")):
        evaluated = report["models"][name]
        assert evaluated["file"] == file
        assert [image["name"] for image in evaluated["images"]] == [frame.name for frame in frames]
        for image, frame in zip(evaluated["images"], frames, strict=True):
            rgb, target = _render(run / file, frame), _read(frame.image_path)
            want = image_metrics(torch.from_numpy(rgb), torch.from_numpy(target))
            assert_close(image["psnr"], want.psnr, "psnr.relative")
            assert_close(image["ssim"], want.ssim, "ssim.float32")
        for score in ("psnr", "ssim"):
            mean = sum(image[score] for image in evaluated["images"]) / len(frames)
            assert_close(evaluated["mean"][score], mean, "psnr.relative")
    metrics = json.loads((run / "metrics.json").read_text())["splits"]["test"]
    last = report["models"]["last"]["mean"]
    assert (last["psnr"], last["ssim"]) == (metrics["psnr"], metrics["ssim"])


def test_the_best_model_is_that_of_the_highest_psnr_on_val(run: Path) -> None:
    lines = [line for line in read_metrics(run) if line["kind"] == "eval" and line["split"] == "val"]
    highest = max(lines, key=lambda line: line["psnr"])
    best = json.loads((run / "metrics.json").read_text())["best"]
    assert best == {"file": "best.pt", "split": "val", "step": highest["step"], "psnr": highest["psnr"]}
    assert load_model(run / "best.pt").step == highest["step"]
    evaluation = evaluate_run(run, split="val")
    by_name = {evaluated.name: evaluated for evaluated in evaluation.models}
    assert by_name["best"].mean.psnr == highest["psnr"]
    assert by_name["last"].loaded.step == 40
    assert by_name["last"].mean.psnr <= highest["psnr"]


@pytest.mark.usefixtures("no_curve")
def test_without_val_the_best_is_chosen_on_test(tmp_path: Path) -> None:
    data = write_scene(tmp_path / "scene")
    (data / "transforms_val.json").unlink()
    outcome = fit(small_config(steps=4, eval_every=2), data, tmp_path / "run")
    assert outcome.best is not None
    assert (outcome.best.split, outcome.best.psnr >= outcome.metrics["test"].psnr) == ("test", True)


class _SecondRun(Observer):
    """Starts another run in the same folder."""

    def __init__(self, data: Path, run: Path) -> None:
        self.data, self.run = data, run

    def on_train_start(self, trainer: Trainer) -> None:
        for resume, expected in ((False, "a new folder"), (True, "a folder in which no other process trains")):
            with pytest.raises(InvalidInput, match=f"`run` must be {expected}"):
                fit(small_config(steps=2), self.data, self.run, resume=resume)


@pytest.mark.usefixtures("no_curve")
def test_two_runs_do_not_share_a_folder(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert fit(small_config(steps=2), data, run, observer=_SecondRun(data, run)).status == "finished"
    assert fit(small_config(steps=3), data, run, resume=True).status == "finished"


@pytest.mark.usefixtures("no_curve")
def test_a_resumed_run_knows_its_best(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    first = fit(small_config(steps=3), data, run).best
    assert first is not None
    unbeatable = {"split": "val", "step": first.step, "psnr": 99.0}
    (run / "run.json").write_text(json.dumps({"data": str(data), "best": unbeatable}))
    before = (run / "best.pt").read_bytes()
    assert fit(small_config(steps=4), data, run, resume=True).best == type(first)(**unbeatable)
    assert (run / "best.pt").read_bytes() == before
    (run / "best.pt").unlink()
    again = fit(small_config(steps=5), data, run, resume=True).best
    assert again is not None
    assert again.step == 5


@pytest.mark.usefixtures("no_curve")
def test_a_finished_run_can_be_evaluated_again_but_not_get_more_minutes(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    fit(small_config(steps=2), data, run)
    before = read_metrics(run)
    fit(small_config(steps=2), data, run, resume=True)
    assert read_metrics(run) == before
    with pytest.raises(InvalidInput, match=r"`config\.minutes` must be unchanged, as the run is finished"):
        fit(small_config(steps=2, minutes=9.0), data, run, resume=True)
    assert stored_config(run) == small_config(steps=2)


def test_flip_is_nvidias(data: Path, run: Path) -> None:
    evaluator = pytest.importorskip("flip_evaluator")
    evaluation = evaluate_run(run)
    frame, scores = evaluation.frames[0], evaluation.models[0].images[0]
    rgb, target = _render(run / "model.pt", frame), _read(frame.image_path)
    assert scores.flip is not None
    assert 0.01 < scores.flip < 1
    assert_close(scores.flip, evaluator.evaluate(target, rgb, "LDR")[1], "flip.relative")
    assert perceptual_metrics().metrics["flip"](torch.from_numpy(target), torch.from_numpy(target)) == 0
    (last,) = evaluate_run(run, brief=True).models
    assert (last.mean.psnr, last.mean.flip) == (evaluation.models[0].mean.psnr, None)


@pytest.mark.usefixtures("_clean")
def test_unavailable_metrics_are_null_with_a_reason(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("flip_evaluator", "torchvision.models"):
        monkeypatch.setitem(sys.modules, module, None)
    assert cli.main(["eval", str(run)]) == 0
    report = json.loads((run / "eval" / "test.json").read_text())
    assert set(report["unavailable"]) == {"lpips", "lpips_01", "flip"}
    for evaluated in report["models"].values():
        for scores in (evaluated["mean"], *evaluated["images"]):
            assert [scores[name] for name in ("lpips", "lpips_01", "flip")] == [None] * 3
    table = (run / "eval" / "test.md").read_text()
    assert table.count("unavailable") >= 3 * 2 * 3
    assert "torchvision isn't installed" in table
    assert "flip-evaluator isn't installed" in table


def test_a_library_that_fails_on_import_costs_its_metric_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """As torchvision built for another version of torch does."""

    def fail(name: str) -> types.ModuleType:
        raise RuntimeError("operator torchvision::nms does not exist")

    monkeypatch.setattr("msdgs_train.evaluation.perceptual.importlib.import_module", fail)
    assert "torchvision can't be used: operator" in perceptual_metrics().unavailable["lpips"]


def test_lpips_needs_its_weights_on_disk_and_is_of_images_in_plus_minus_one_and_in_zero_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = types.SimpleNamespace(IMAGENET1K_V1=types.SimpleNamespace(url="https://example.org/vgg16-1.pth"))
    monkeypatch.setitem(sys.modules, "torchvision.models", types.SimpleNamespace(VGG16_Weights=weights))
    stand_in = types.SimpleNamespace(LearnedPerceptualImagePatchSimilarity=_StandInForLpips)
    monkeypatch.setitem(sys.modules, "torchmetrics.image.lpip", stand_in)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert "vgg16-1.pth" in perceptual_metrics().unavailable["lpips_01"]
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "vgg16-1.pth").touch()
    metrics = perceptual_metrics().metrics
    images = torch.zeros(6, 5, 3), torch.ones(6, 5, 3)
    assert (metrics["lpips"](*images), metrics["lpips_01"](*images)) == (2.0, 1.0)


class _StandInForLpips:
    def __init__(self, net_type: str) -> None:
        assert net_type == "vgg"

    def __call__(self, rgb: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        assert rgb.shape == (1, 3, 6, 5)
        return (target - rgb).mean()[None, None, None, None]


@pytest.mark.usefixtures("_clean")
def test_sheet_shows_image_rendering_and_error(run: Path) -> None:
    evaluation = evaluate_run(run)
    evaluation_report.write_evaluation(run, evaluation)
    assert {path.name for path in (run / "eval").iterdir()} == {"test.json", "test.md", "test.png"}
    sheet = _read(run / "eval" / "test.png")
    worst = min(range(2), key=lambda index: evaluation.models[0].images[index].psnr)
    for drawn in (_read(evaluation.frames[worst].image_path), _render(run / "model.pt", evaluation.frames[worst])):
        assert _contains(sheet, drawn)


def _contains(sheet: np.ndarray, drawn: np.ndarray) -> bool:
    """Whether the image lies somewhere in the sheet's first row, each pixel as a square of pixels."""
    times = -(-evaluation_report.MIN_PANEL // SIZE)
    pixels = to_bytes(drawn).repeat(times, axis=0).repeat(times, axis=1)
    height, width, _ = pixels.shape
    rows = to_bytes(sheet)[HEADER + CAPTION : HEADER + CAPTION + height]
    return any(np.array_equal(rows[:, x : x + width], pixels) for x in range(sheet.shape[1] - width + 1))


@pytest.mark.usefixtures("_clean")
@pytest.mark.parametrize("broken", ["draw_contact_sheet", "as_json", "savefig"])
def test_an_interrupted_evaluation_leaves_no_half_written_file(
    run: Path, broken: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*args: Any, **kwargs: Any) -> None:
        if broken == "savefig":
            Path(args[1]).write_bytes(b"\x89PNG, the beginning")
        raise KeyboardInterrupt

    target = "matplotlib.figure.Figure.savefig" if broken == "savefig" else f"msdgs_train.evaluation.report.{broken}"
    monkeypatch.setattr(target, interrupt)
    assert cli.main(["eval", str(run)]) == cli.EXIT_INTERRUPTED
    assert "interrupted" in capsys.readouterr().err
    for path in (run / "eval").iterdir():
        assert not path.name.startswith(".")
        assert path.suffix != ".json"
        if path.suffix == ".png":
            _read(path)


def test_missing_files_are_named(data: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, model = (run / "config.json").read_bytes(), (run / "model.pt").read_bytes()
    (tmp_path / "old").mkdir()
    (tmp_path / "empty").mkdir()
    (tmp_path / "old" / "config.json").write_bytes(config)

    def message(*arguments: object) -> str:
        assert cli.main(["eval", *map(str, arguments)]) == cli.EXIT_INVALID
        return capsys.readouterr().err

    assert "empty/config.json" in message(tmp_path / "empty")
    assert "model.pt: no such file" in message(tmp_path / "old")
    (tmp_path / "old" / "model.pt").write_bytes(model)
    assert "run.json: no such file, so the dataset has to be given" in message(tmp_path / "old")
    assert "nowhere: `folder` does not exist" in message(tmp_path / "old", "--data", tmp_path / "nowhere")
    (tmp_path / "old" / "run.json").write_text(json.dumps({"data": str(tmp_path / "gone"), "best": None}))
    assert "gone: `folder` does not exist; if it is elsewhere now: msdgs-train eval" in message(tmp_path / "old")
    (tmp_path / "old" / "run.json").write_text("[]")
    assert "run.json: is damaged" in message(tmp_path / "old")
    assert cli.main(["eval", str(tmp_path / "old"), "--data", str(data), "--split", "val"]) == cli.EXIT_INVALID


def test_a_run_from_before_there_was_a_best_model(data: Path, run: Path, tmp_path: Path) -> None:
    for name in ("config.json", "model.pt"):
        (tmp_path / name).write_bytes((run / name).read_bytes())
    assert cli.main(["eval", str(tmp_path), "--data", str(data), "--split", "val"]) == 0
    assert "this run has no best.pt" in (tmp_path / "eval" / "val.md").read_text()
    assert set(json.loads((tmp_path / "eval" / "val.json").read_text())["models"]) == {"last"}


def test_several_runs_are_drawn_side_by_side(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other, path = tmp_path / "other [2]", tmp_path / "new" / "sheet.png"
    shutil.copytree(run, other)
    shutil.copyfile(run / "best.pt", other / "model.pt")
    assert cli.main(["eval", str(run), str(other), "--sheet", str(path)]) == 0
    shown = capsys.readouterr().out
    assert f"wrote {path}" in shown
    assert str(other / "eval" / "test.md") in shown
    frame = evaluate_run(run).frames[0]
    for image in (_read(frame.image_path), *(_render(each / "model.pt", frame) for each in (run, other))):
        assert _contains(_read(path), image)
    assert cli.main(["eval"]) == cli.EXIT_INVALID
    assert cli.main(["eval", str(run), str(other), "--sheet", str(tmp_path / "sheet.gif")]) == cli.EXIT_INVALID
    assert "`sheet` must be a .png file" in capsys.readouterr().err
    assert cli.main(["eval", str(run), "--sheet", str(tmp_path / "one.png")]) == cli.EXIT_INVALID
    assert "`sheet` must be left out with one run" in capsys.readouterr().err
    assert cli.main(["eval", str(run), str(run / ".")]) == cli.EXIT_INVALID
    assert "`RUN` must be different folders" in capsys.readouterr().err


def test_split_without_images_is_named(run: Path, tmp_path: Path) -> None:
    data = write_scene(tmp_path / "scene")
    (data / "transforms_test.json").unlink()
    with pytest.raises(Exception, match="`test` has no images; there are `train` with 7, `val` with 1"):
        evaluate_run(run, data)
