"""Rays through pixels, batches of them over all images, boxes, cells and weights, against loops."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets import load_scene
from msdgs_train.datasets import rays as rays_module
from msdgs_train.datasets.common.images import write_png
from msdgs_train.datasets.rays import RayBatches, Rays, rays_of
from msdgs_train.systems.targets import Target
from msdgs_train.volumes.march import weigh
from msdgs_train.volumes.samples import Samples
from msdgs_train.volumes.space import Box, in_occupied, occupied_cells
from tests.support.tolerances import assert_close
from tests.support.training_scene import SIZE, training_image

BATCH = 100


def test_rays_pass_through_the_centers_of_pixels(data: Path) -> None:
    frame = load_scene(data).splits["train"][2]
    rays = rays_of(frame.camera, frame.t)
    pixels, depths = frame.camera.project((rays.origins + 3 * rays.directions).double().numpy())
    rows, columns = np.divmod(np.arange(SIZE * SIZE), SIZE)
    assert_close(pixels, np.stack([columns, rows], 1) + 0.5, "volume.pixel")
    assert_close(depths, np.full(SIZE * SIZE, 3.0), "volume.pixel")
    assert set(rays.times.tolist()) == {torch.tensor(frame.t).item()}


def test_a_pass_has_each_pixel_once_with_its_ray(data: Path) -> None:
    frames = load_scene(data).splits["train"]
    by_time = {torch.tensor(frame.t).item(): frame for frame in frames}
    assert len(by_time) == len(frames)
    batches, each_pass = RayBatches(frames, BATCH, "cpu"), len(frames) * SIZE * SIZE // BATCH
    drawn = [batches.batch(number, seed=3) for number in range(each_pass)]
    rays = Rays(*map(torch.cat, zip(*(batch.rays for batch in drawn), strict=True)))
    rgba, seen = torch.cat([batch.rgba for batch in drawn]), 0
    for t, frame in by_time.items():
        of_frame = rays.times == t
        points = rays.origins[of_frame] + 3 * rays.directions[of_frame]
        columns, rows = np.floor(frame.camera.project(points.double().numpy())[0]).astype(int).T
        assert len(set(zip(rows, columns, strict=True))) == len(rows)
        assert np.array_equal(frame.load_rgba()[rows, columns], rgba[of_frame])
        seen += len(rows)
    assert seen == each_pass * BATCH


def test_a_batch_follows_from_its_number_and_the_seed(data: Path) -> None:
    frames = load_scene(data).splits["train"]
    one, other = RayBatches(frames, BATCH, "cpu"), RayBatches(frames, BATCH, "cpu")
    later = 5 * len(frames) * SIZE * SIZE // BATCH
    for number in (later, 0):
        assert torch.equal(one.batch(number, 1).rays.directions, other.batch(number, 1).rays.directions)
    assert not torch.equal(one.batch(0, 1).rays.directions, one.batch(0, 2).rays.directions)
    assert not torch.equal(one.batch(0, 1).rays.directions, one.batch(later, 1).rays.directions)


def test_masked_pixels_and_rays_that_miss_take_no_part(data: Path, tmp_path: Path) -> None:
    frame, mask = load_scene(data).splits["train"][0], np.full((SIZE, SIZE, 3), 255, np.uint8)
    mask[:, : SIZE // 2] = 0
    write_png(tmp_path / "mask.png", mask)
    masked = dataclasses.replace(frame, mask_path=tmp_path / "mask.png")
    half = RayBatches([masked], SIZE * SIZE // 2, "cpu").batch(0, 0).rays
    whole = rays_of(frame.camera, frame.t).directions.view(SIZE, SIZE, 3)[:, SIZE // 2 :].reshape(-1, 3)
    assert set(map(tuple, half.directions.tolist())) == set(map(tuple, whole.tolist()))
    upper = rays_of(frame.camera, frame.t).directions[:, 2] > whole[:, 2].median()
    hit = RayBatches([frame], int(upper.sum()), "cpu", lambda rays: rays.directions[:, 2] > whole[:, 2].median())
    assert bool((hit.batch(0, 0).rays.directions[:, 2] > whole[:, 2].median()).all())


def test_images_that_are_too_many_or_too_small_are_refused(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = load_scene(data).splits["train"]
    with pytest.raises(InvalidInput, match=r"`config\.rays` must be 4,032 or fewer"):
        RayBatches(frames, 5000, "cpu")
    monkeypatch.setattr(rays_module, "MAX_BYTES", 400)
    with pytest.raises(InvalidInput, match="`size` must be a width of images at which all of them have 100 pixels"):
        RayBatches(frames, 10, "cpu")


def test_pixels_over_a_background_are_those_of_images(data: Path) -> None:
    rgba = np.random.default_rng(0).integers(0, 256, (5, 7, 4), np.uint8)
    background = torch.tensor([0.2, 0.5, 0.9])
    image = Target.over(training_image(rgba), background)
    pixels = Target.of_pixels(torch.from_numpy(rgba.reshape(-1, 4)), background)
    assert_close(pixels.rgb, image.rgb.reshape(-1, 3), "volume.forward")
    assert torch.equal(pixels.alpha, image.alpha.reshape(-1))


def test_where_rays_enter_and_leave_a_box() -> None:
    box = Box(torch.tensor([-1.0, -2.0, -0.5]), torch.tensor([2.0, 1.0, 0.5]))
    origins = torch.tensor([[-4.0, 0, 0], [0, 0, 0], [-4, 3, 0]])
    directions = torch.tensor([[1.5, 0, 0], [0, 0, 2.0], [1, 0, 0]])
    enters, leaves = box.spans(origins, directions)
    assert_close(enters[:2], [2.0, -0.25], "float32.relative")
    assert_close(leaves[:2], [4.0, 0.25], "float32.relative")
    assert enters[2] > leaves[2]


def test_cells_next_to_occupied_vertices_are_occupied() -> None:
    alphas = torch.zeros(9, 8, 7)
    alphas[4, 2, 6] = 0.5
    cells = occupied_cells(alphas, 0.1)
    assert cells.shape == (8, 7, 6)
    numbers = torch.Generator().manual_seed(0)
    points = 2 * torch.rand(2000, 3, generator=numbers) - 1
    places = (points + 1) / 2 * torch.tensor([8.0, 7.0, 6.0])
    near = (places - torch.tensor([4.0, 2.0, 6.0])).abs().amax(dim=1) < 2
    assert torch.equal(in_occupied(cells, points), near)
    assert bool(in_occupied(cells, torch.tensor([[0.0, -3 / 7, 1.0]])).all()), "on the border"


@pytest.mark.parametrize("stop", [0.0, 0.05])
def test_weights_as_in_a_loop(stop: float) -> None:
    numbers = torch.Generator().manual_seed(1)
    inside = torch.rand(6, 9, generator=numbers) < 0.7
    inside[3] = False
    samples = Samples.of(torch.zeros(6, 9, 3), torch.zeros(9), inside)
    depths = 2 * torch.rand(len(samples.rays), generator=numbers)
    depths[5] = 0.0
    weights, left = weigh(depths, samples, 6, stop)
    for ray in range(6):
        seen = 1.0
        for index in torch.nonzero(samples.rays == ray)[:, 0].tolist():
            alpha = 1 - math.exp(-float(depths[index])) if seen >= stop else 0.0
            assert_close(float(weights[index]), seen * alpha, "volume.forward")
            seen *= 1 - alpha
        assert_close(float(left[ray]), seen, "volume.forward")
    empty = samples.at(torch.zeros(0, dtype=torch.int64))
    assert weigh(depths[:0], empty, 6, stop)[1].tolist() == [1.0] * 6


def test_rays_in_parts_are_the_same() -> None:
    rays = Rays(torch.rand(10, 3), torch.rand(10, 3), torch.rand(10))
    parts = rays.split(4)
    assert [len(part.times) for part in parts] == [4, 4, 2]
    assert torch.equal(torch.cat([part.directions for part in parts]), rays.directions)
