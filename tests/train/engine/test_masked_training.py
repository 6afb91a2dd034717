"""Masked pixels count neither in the loss, nor in density control, nor in scores."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_train.cli import main as cli
from msdgs_train.datasets import Frame, SceneData, load_scene
from msdgs_train.datasets.common.images import read_rgba, write_png
from msdgs_train.engine import schedule
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.trainer import Trainer
from msdgs_train.evaluation.evaluate import scores
from msdgs_train.evaluation.metrics import MAX_PSNR, image_metrics, masked_psnr, psnr
from msdgs_train.evaluation.perceptual import PerceptualMetrics
from msdgs_train.losses.photometric import photometric_loss, ssim
from msdgs_train.systems.base import Moment, ViewLoss
from msdgs_train.systems.targets import ImageFacts, Target
from tests.support.tolerances import assert_close
from tests.support.training_scene import FEW, SIZE, small_config, splatting, trained, write_scene

STEPS = 12
HIDDEN = np.zeros((SIZE, SIZE), bool)
HIDDEN[8:15, 6:16] = True


def masked_scene(folder: Path, hidden: np.ndarray, color: tuple[int, ...] = (255, 0, 0)) -> Path:
    """A scene whose training images show `color` in the hidden pixels, which their masks hide."""
    write_scene(folder, train=4, test=1)
    mask = np.repeat(np.where(hidden, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    write_png(folder / "mask.png", mask)
    for split in ("train", "test"):
        file = folder / f"transforms_{split}.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), "mask_path": "mask.png"}))
        for path in (folder / split).iterdir():
            rgb = read_rgba(path)[..., :3].copy()
            rgb[hidden] = color
            path.unlink()
            write_png(path, rgb)
    return folder


def parameters(config: TrainConfig, scene: SceneData) -> dict[str, Any]:
    trainer = trained(config, scene, STEPS)
    return {name: value.clone() for name, value in splatting(trainer).model.state_dict().items()}


def is_same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(value, other[name]) for name, value in one.items())


@pytest.mark.slow
@pytest.mark.parametrize("refined", [False, True])
def test_what_masked_pixels_show_has_no_effect(tmp_path: Path, refined: bool):
    """Bit by bit: without SSIM, whose windows reach into the mask."""
    config = small_config(ssim_lambda=0.0, mse_fraction=0.3, pose_opt=refined)
    results = [
        parameters(config, load_scene(masked_scene(tmp_path / name, HIDDEN, color)))
        for name, color in (("red", (255, 0, 0)), ("blue", (0, 0, 255)))
    ]
    assert is_same(*results)
    assert not is_same(results[0], parameters(config, load_scene(tmp_path / "red", masks=False)))


@pytest.mark.slow
def test_a_white_mask_changes_nothing(tmp_path: Path):
    folder, config = masked_scene(tmp_path, np.zeros_like(HIDDEN)), small_config()
    assert is_same(parameters(config, load_scene(folder)), parameters(config, load_scene(folder, masks=False)))


def random_pair(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    one, other = torch.rand(2, 20, 31, 3, generator=generator, dtype=torch.float64)
    return one, other


MASK = torch.ones(20, 31, dtype=torch.bool)
MASK[4:11, 13:29] = False


@pytest.mark.parametrize(("l1", "mse"), [(1.0, 0.0), (0.8, 0.0), (0.8, 0.4), (0.0, 0.0)])
def test_the_gradient_of_masked_pixels_is_zero(l1: float, mse: float):
    rgb, target = random_pair()
    rgb.requires_grad_()
    photometric_loss(rgb, target, l1, mse, MASK).backward()
    assert rgb.grad is not None
    assert (rgb.grad[~MASK] == 0).all()
    assert (rgb.grad[MASK] != 0).any(dim=-1).all()


def test_the_loss_is_the_mean_over_the_pixels_that_count():
    rgb, target = random_pair()
    wanted = (rgb - target).abs()[MASK].mean()
    assert_close(float(photometric_loss(rgb, target, 1.0, 0.0, MASK)), float(wanted), "ssim.float64")
    poisoned = torch.where(MASK[..., None], rgb, 1e3)
    assert photometric_loss(poisoned, target, 0.8, 0.2, MASK) == photometric_loss(rgb, target, 0.8, 0.2, MASK)


def test_ssim_is_that_of_the_part_that_counts():
    """Equal images have 1, whatever the rest shows, and a single pixel isn't outweighed by the masked ones."""
    rgb, target = random_pair()
    assert ssim(torch.where(MASK[..., None], target, rgb), target, MASK) == pytest.approx(1.0)
    few = torch.zeros_like(MASK)
    few[0, 0] = True
    assert float(ssim(rgb, target, few)) < 0.99
    assert float(ssim(rgb, target, MASK)) < 0.9


def test_scores_are_over_the_pixels_that_count():
    rgb, target = random_pair()
    known = torch.where(MASK[..., None], target, rgb)
    assert image_metrics(known, target, MASK.numpy()).psnr == MAX_PSNR
    got = image_metrics(rgb, target, MASK.numpy())
    assert got.psnr == pytest.approx(psnr(rgb[MASK], target[MASK]))
    assert image_metrics(torch.where(MASK[..., None], rgb, 0.5), target, MASK.numpy()) == got


def test_a_mask_of_nothing_gives_no_loss_and_no_gradient():
    """As the mask of a halved image may be."""
    rgb, target = random_pair()
    rgb.requires_grad_()
    nothing = torch.zeros_like(MASK)
    photometric_loss(rgb, target, 0.8, 0.2, nothing).backward()
    assert rgb.grad is not None
    assert (rgb.grad == 0).all()
    assert Target(target, torch.zeros(20, 31), nothing).squared_error(rgb) == 0.0


def test_alpha_and_training_error_are_over_the_pixels_that_count():
    rgb, rgb_target = random_pair()
    alpha = torch.where(MASK, 0, 200).to(torch.uint8)
    target = Target(rgb_target, alpha, MASK)
    assert float(target.alpha_error(torch.where(MASK, 0.25, 1.0))) == pytest.approx(0.25)
    assert float(target.squared_error(rgb)) == pytest.approx(float((rgb - rgb_target).square()[MASK].mean()))


def test_a_masked_border_may_show_anything():
    rgba = np.zeros((20, 31, 4), np.uint8)
    rgba[8:12, 8:12, 3] = 255
    border = np.ones((20, 31), np.bool_)
    border[0] = False
    assert ImageFacts.of(rgba).shows_all
    assert ImageFacts.of(rgba, MASK.numpy()).shows_all
    assert not ImageFacts.of(rgba, border).shows_all


def test_the_trainer_gives_masks_to_the_loss_and_to_the_metrics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    trainer, targets = Trainer(small_config(), load_scene(masked_scene(tmp_path, HIDDEN))), []
    (evaluated,) = trainer.evaluate("test")
    shown = ~HIDDEN
    assert evaluated.metrics.psnr == pytest.approx(psnr(evaluated.rgb[shown], evaluated.target[shown]))
    of_frame = splatting(trainer).loss

    def noted(frame: Frame, target: Target, background: torch.Tensor, moment: Moment) -> ViewLoss:
        targets.append(target)
        return of_frame(frame, target, background, moment)

    monkeypatch.setattr(trainer.system, "loss", noted)
    trainer.step()
    monkeypatch.setattr(schedule, "HALVED_WIDTH", SIZE)
    trainer.schedule = trainer.schedule._replace(full_resolution_step=5)
    trainer.step()
    whole, half = (target.mask for target in targets)
    assert (whole.numpy() == shown).all()
    assert (half.numpy() == shown.reshape(SIZE // 2, 2, SIZE // 2, 2).all(axis=(1, 3))).all()


def test_an_evaluation_leaves_masked_pixels_out(tmp_path: Path):
    nothing = PerceptualMetrics({"lpips": lambda rgb, target: float((rgb - target).abs().max())}, {})
    rgb, target = random_pair()
    moving = np.zeros(MASK.shape, bool)
    moving[:7] = True
    got = scores(rgb, target, moving, nothing, MASK.numpy())
    known = torch.where(MASK[..., None], rgb, target)
    assert got == scores(torch.where(MASK[..., None], rgb, 0.3), target, moving, nothing, MASK.numpy())
    assert (got.psnr, got.ssim) == image_metrics(rgb, target, MASK.numpy())
    assert got.lpips == float((known - target).abs().max())
    assert got.moving_psnr == masked_psnr(rgb, target, moving & MASK.numpy())


@pytest.mark.slow
@pytest.mark.usefixtures("no_curve")
def test_a_run_and_its_evaluation_say_that_there_are_masks(tmp_path: Path):
    data = str(masked_scene(tmp_path / "data", HIDDEN))
    psnrs = []
    for name, options in (("masked", []), ("whole", ["--no-masks"])):
        run = tmp_path / name
        assert cli.main(["fit", data, str(run), "--steps=8", *FEW, *options]) == 0
        assert cli.main(["eval", str(run)]) == 0
        table = (run / "eval" / "test.md").read_text()
        assert ("masks: 1 of 1 images have pixels that don't count; scores are over the others" in table) == (
            name == "masked"
        )
        scored, logged = (json.loads((run / file).read_text()) for file in ("eval/test.json", "metrics.json"))
        assert scored["models"]["last"]["mean"]["psnr"] == logged["splits"]["test"]["psnr"]
        psnrs.append(logged["splits"]["test"]["psnr"])
    assert psnrs[0] > psnrs[1]
