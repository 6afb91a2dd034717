"""Gradients of the training rasterizer: finite differences, autograd through a plain renderer, laws, edge cases."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import torch

import msdgs_serve.rasterizer
from msdgs_serve.rasterizer import GSPLAT, INRIA, RasterizerOptions, compositing_backward
from msdgs_serve.scene import Camera, Gaussians
from msdgs_train.rendering.rasterize import rasterize
from tests.support import reference, reference_torch
from tests.support.scenes import ADVERSARIAL, OPTIONS, as_dtype, front_camera, gaussians_of, random_scene, select
from tests.support.tolerances import assert_close, tolerance

BACKGROUND = (0.2, 0.6, 0.9)
STEP = 1e-6
"""Step of central differences: their error is STEP² f''' / 6, about 1e-10, plus 1e-16 / STEP = 1e-10 from rounding."""


class Parameters(NamedTuple):
    """Inputs that have gradients; quaternions are normalized before they are rendered."""

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor
    background: torch.Tensor


KINDS = Parameters._fields
Loss = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def parameters_of(gaussians: Gaussians, dtype: torch.dtype = torch.float64) -> Parameters:
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    arrays = (gaussians.means, quats, gaussians.scales, gaussians.opacities, gaussians.sh, np.array(BACKGROUND))
    return Parameters(*(torch.tensor(array, dtype=dtype, requires_grad=True) for array in arrays))


def draw(p: Parameters, camera: Camera, options: RasterizerOptions = GSPLAT) -> tuple[torch.Tensor, torch.Tensor]:
    quats = torch.nn.functional.normalize(p.quats, dim=-1)
    rgb, alpha, _ = rasterize(p.means, quats, p.scales, p.opacities, p.sh, camera, p.background, options)
    return rgb, alpha


def draw_plainly(
    p: Parameters, camera: Camera, options: RasterizerOptions = GSPLAT
) -> tuple[torch.Tensor, torch.Tensor]:
    world_to_camera = torch.from_numpy(camera.world_to_camera)
    depths = p.means.detach() @ world_to_camera[2, :3] + world_to_camera[2, 3]
    front = depths > options.near_plane  # at depth 0 even the gradient of what is not used is NaN
    splats = reference_torch.project(p.means[front], p.quats[front], p.scales[front], p.sh[front], camera, options)
    return reference_torch.render(splats, p.opacities[front], camera, p.background, options)


def gradients(drawn: tuple[torch.Tensor, torch.Tensor], loss: Loss, p: Parameters) -> dict[str, np.ndarray]:
    grads = torch.autograd.grad(loss(*drawn), p, allow_unused=True, materialize_grads=True)
    return {kind: grad.detach().numpy() for kind, grad in zip(KINDS, grads, strict=True)}


def weighted(pixels: np.ndarray, seed: int = 0) -> Loss:
    """A random linear loss on rgb and alpha of some pixels, [H, W] bool."""
    rng = np.random.default_rng(seed)
    on_rgb = torch.from_numpy(rng.normal(size=(*pixels.shape, 3)) * pixels[..., None])
    on_alpha = torch.from_numpy(rng.normal(size=pixels.shape) * pixels)
    return lambda rgb, alpha: (rgb * on_rgb).sum() + (alpha * on_alpha).sum()


def assert_gradients_agree(got: dict[str, np.ndarray], want: dict[str, np.ndarray], row: str):
    """Compare gradients relative to the largest entry of their kind; if that is about 0, to the largest of all."""
    largest = max(np.abs(want[kind]).max(initial=0) for kind in KINDS)
    for kind in KINDS:
        size = np.abs(want[kind]).max(initial=1e-6 * largest)
        error = np.abs(got[kind] - want[kind]).max(initial=0) / size
        assert error <= tolerance(row), f"{kind}: {error:.1e} of {size:.1e}"


def central_differences(value: Callable[[], float], parameter: torch.Tensor) -> np.ndarray:
    """Return d value / d parameter, entry by entry."""
    flat = parameter.detach().view(-1)
    result = np.empty(flat.shape)
    for i in range(len(flat)):
        original = flat[i].item()
        flat[i] = original + STEP
        above = value()
        flat[i] = original - STEP
        result[i] = (above - value()) / (2 * STEP)
        flat[i] = original
    return result.reshape(parameter.shape)


def small_scene(seed: int, options: RasterizerOptions = GSPLAT) -> tuple[Parameters, Camera, np.ndarray]:
    """Return a few overlapping Gaussians, a camera, and the pixels that are not at a threshold."""
    gaussians, camera = random_scene(seed, 7, 21, 13)
    gaussians = as_dtype(gaussians, np.float64)
    clear = reference.render(gaussians, camera, BACKGROUND, options).slack == 0
    assert clear.mean() > 0.9
    return parameters_of(gaussians), camera, clear


def test_trainer_and_service_draw_the_same_bytes():
    gaussians, camera = random_scene(49, 200)
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    means, quats, scales, opacities, sh = map(torch.from_numpy, arrays)
    rgb, alpha, _ = rasterize(means, quats, scales, opacities, sh, camera, torch.tensor(BACKGROUND))
    served = msdgs_serve.rasterizer.rasterize(gaussians, camera, background=BACKGROUND)
    np.testing.assert_array_equal(rgb.numpy(), served.rgb)
    np.testing.assert_array_equal(alpha.numpy(), served.alpha)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("seed", "options"), [(50, GSPLAT), (51, GSPLAT), (52, INRIA)])
def test_finite_differences(kind: str, seed: int, options: RasterizerOptions):
    parameters, camera, clear = small_scene(seed, options)
    loss = weighted(clear)
    got = gradients(draw(parameters, camera, options), loss, parameters)[kind]

    def value() -> float:
        with torch.no_grad():
            return loss(*draw(parameters, camera, options)).item()

    want = central_differences(value, getattr(parameters, kind))
    size = np.abs(want).max()
    assert size > 0
    assert np.abs(got - want).max() / size <= tolerance("gradient.finite_differences")


def test_pixels_at_a_threshold_jump_by_no_more_than_stated():
    """At a threshold the image departs from its gradient by at most the oracle's bound."""
    splat = gaussians_of([[0, 0, 2], [0.1, 0, 3]], scales=0.2, opacities=[0.6, 0.9], dtype=np.float64)
    camera, step = front_camera(21, 13), 2e-4
    want = reference.render(splat, camera, BACKGROUND)
    parameters = parameters_of(splat)
    moved = parameters._replace(scales=parameters.scales * (1 + step))
    rgb, alpha = draw(parameters, camera)
    change = [after - before for after, before in zip(draw(moved, camera), (rgb, alpha), strict=True)]
    tangent = torch.autograd.functional.jvp(  # by reverse mode twice through the plain renderer, pixel by pixel
        lambda scales: draw_plainly(parameters._replace(scales=scales), camera),
        parameters.scales,
        step * parameters.scales.detach(),
    )[1]
    departure = np.abs((change[0] - tangent[0]).detach().numpy()).max(axis=-1)
    jumped = departure > tolerance("gradient.second_order")
    assert (want.slack[jumped] > 0).all()
    assert (departure <= want.slack * want.color_range + tolerance("gradient.second_order")).all()


def assert_as_autograd(
    parameters: Parameters, camera: Camera, loss: Loss | None = None, options: RasterizerOptions = GSPLAT
):
    """Compare all pixels unless the loss selects some: in float64 both renderers make the same decisions."""
    loss = loss or weighted(np.ones((camera.height, camera.width)))
    got = gradients(draw(parameters, camera, options), loss, parameters)
    want = gradients(draw_plainly(parameters, camera, options), loss, parameters)
    assert_gradients_agree(got, want, "gradient.autograd")


@pytest.mark.parametrize("name", ["random", *sorted(set(ADVERSARIAL) - {"crowd"})])
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_autograd_through_a_plain_renderer(name: str, options: RasterizerOptions):
    gaussians, camera = random_scene(53, 60) if name == "random" else ADVERSARIAL[name]()
    gaussians = as_dtype(select(gaussians, slice(60)), np.float64)
    assert_as_autograd(parameters_of(gaussians), camera, options=options)


@pytest.mark.parametrize("degree", range(4))
def test_every_degree_of_harmonics(degree: int):
    gaussians, camera = random_scene(54, 30, 21, 13, sh_degree=degree)
    assert_as_autograd(parameters_of(as_dtype(gaussians, np.float64)), camera)


@pytest.mark.parametrize(
    "loss", [lambda rgb, alpha: rgb.square().mean(), lambda rgb, alpha: alpha.sum(), lambda rgb, alpha: rgb[2, 3, 1]]
)
def test_losses_on_one_output_or_one_pixel(loss: Loss):
    parameters, camera, _ = small_scene(55)
    assert_as_autograd(parameters, camera, loss)


@pytest.mark.parametrize("opacity", [0.0, 0.9995, 1.0])
def test_no_gradient_is_infinite_at_the_ends_of_opacity(opacity: float):
    """Three Gaussians behind one another: a naive backward pass divides by 1 - alpha, which is 0."""
    gaussians = gaussians_of([[0, 0, 2], [0, 0, 2.5], [0, 0, 3]], scales=0.5, opacities=[opacity, 1.0, opacity])
    assert_as_autograd(parameters_of(gaussians), front_camera(9, 7))


def test_gradients_of_projected_means_and_radii():
    parameters, camera, _ = small_scene(56)
    loss = weighted(np.ones((13, 21)))
    args = (parameters.means, parameters.quats, parameters.scales, parameters.opacities, parameters.sh)
    rgb, alpha, info = rasterize(*args, camera, parameters.background)
    assert info.means2d_grads is None
    loss(rgb, alpha).backward()
    splats = reference_torch.project(*args[:3], parameters.sh, camera)
    means2d = splats.means2d.detach().requires_grad_()
    plain = reference_torch.render(
        splats._replace(means2d=means2d), parameters.opacities, camera, parameters.background
    )
    want = torch.autograd.grad(loss(*plain), means2d)[0].numpy()
    assert info.means2d_grads is not None
    assert_close(info.means2d_grads.numpy() / np.abs(want).max(), want / np.abs(want).max(), "gradient.autograd")
    np.testing.assert_array_equal(info.means2d_grads.numpy()[info.radii.numpy() == 0], 0)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_absolute_gradients_of_projected_means_behind_one_another(options: RasterizerOptions):
    """Against autograd in a mean of each pixel's own; other gradients keep their bits."""
    gaussians, camera = random_scene(56, 40, 37, 21)
    parameters, loss = parameters_of(as_dtype(gaussians, np.float64)), weighted(np.ones((21, 37)))
    args = (parameters.means, parameters.quats, parameters.scales, parameters.opacities, parameters.sh)
    drawn = [
        rasterize(*args, camera, parameters.background, options, absolute_gradients=absolute)
        for absolute in (True, False)
    ]
    grads = [gradients((rgb, alpha), loss, parameters) for rgb, alpha, _ in drawn]
    assert all(np.array_equal(grads[0][kind], grads[1][kind]) for kind in KINDS)
    splats = reference_torch.project(*args[:3], parameters.sh, camera, options)
    means2d = splats.means2d.detach()[..., None, None].repeat(1, 1, 21, 37).requires_grad_()
    plain = reference_torch.render(
        splats._replace(means2d=means2d), parameters.opacities, camera, parameters.background, options
    )
    of_pixels = torch.autograd.grad(loss(*plain), means2d)[0].numpy()
    for (_, _, info), want in zip(drawn, (np.abs(of_pixels), of_pixels), strict=True):
        assert info.means2d_grads is not None
        want = want.sum(axis=(2, 3))
        assert_close(info.means2d_grads.numpy() / np.abs(want).max(), want / np.abs(want).max(), "gradient.autograd")
        np.testing.assert_array_equal(info.means2d_grads.numpy()[info.radii.numpy() == 0], 0)


def test_radii_are_zero_where_nothing_is_drawn_and_bound_what_is():
    gaussians = gaussians_of(
        [[0, 0, 2], [0, 0, -2], [50, 0, 2], [0, 0, 2]], scales=0.1, opacities=[0.9, 0.9, 0.9, 0.001]
    )
    parameters, camera = parameters_of(gaussians), front_camera()
    _, alpha, info = rasterize(*parameters[:5], camera, parameters.background)
    radii = info.radii.numpy()
    np.testing.assert_array_equal(radii > 0, [True, False, False, False])
    rows, columns = np.nonzero(alpha.detach().numpy())
    reach = max(np.abs(columns + 0.5 - camera.cx).max(), np.abs(rows + 0.5 - camera.cy).max())
    assert reach <= radii[0] <= reach + 2


def test_float32_is_close_to_float64():
    gaussians, camera = random_scene(57, 100)
    clear = reference.render(gaussians, camera, BACKGROUND).slack == 0
    loss, narrow_loss = weighted(clear), weighted(clear)
    double, single = parameters_of(gaussians), parameters_of(gaussians, torch.float32)
    want = gradients(draw(double, camera), loss, double)
    got = gradients(draw(single, camera), narrow_loss, single)
    assert {grad.dtype for grad in got.values()} == {np.dtype(np.float32)}
    assert_gradients_agree(got, want, "gradient.float32")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("size", [(1, 1), (5, 3)])
def test_none_and_one(count: int, size: tuple[int, int], dtype: torch.dtype):
    parameters = parameters_of(select(gaussians_of([[0, 0, 2]]), slice(count)), dtype)
    rgb, alpha = draw(parameters, front_camera(*size))
    grads = gradients((rgb, alpha), lambda rgb, alpha: rgb.sum() + alpha.sum(), parameters)
    for kind, grad in grads.items():
        assert grad.shape == getattr(parameters, kind).shape
        assert np.isfinite(grad).all()
    left = (1 - alpha.detach()).sum().item()
    np.testing.assert_allclose(grads["background"], left, rtol=tolerance("float32.relative"))
    assert (count == 1) == bool(grads["opacities"].any())


def test_same_bytes_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch):
    gaussians, camera = random_scene(58, 200, 90, 70)
    loss = weighted(np.ones((70, 90)))
    results = []
    for threads in ("2", "1", "5", "2"):
        monkeypatch.setenv("MSDGS_THREADS", threads)
        parameters = parameters_of(gaussians, torch.float32)
        grads = gradients(draw(parameters, camera), loss, parameters)
        results.append([grads[kind].tobytes() for kind in KINDS])
    assert all(result == results[0] for result in results[1:])


@pytest.mark.parametrize("pairs", [1, 50])
def test_in_rounds_the_gradient_is_the_same(monkeypatch: pytest.MonkeyPatch, pairs: int):
    """As in large images, whose sums of all pairs would take too much memory."""
    gaussians, camera = random_scene(58, 200, 90, 70)
    loss, parameters = weighted(np.ones((70, 90))), parameters_of(gaussians, torch.float32)
    at_once = gradients(draw(parameters, camera), loss, parameters)
    counts, rounds_of = list[int](), compositing_backward._rounds

    def counted(offsets: np.ndarray) -> list[tuple[int, int]]:
        counts.append(len(rounds_of(offsets)))
        return rounds_of(offsets)

    monkeypatch.setattr(compositing_backward, "PAIRS_PER_ROUND", pairs)
    monkeypatch.setattr(compositing_backward, "_rounds", counted)
    in_rounds = gradients(draw(parameters, camera), loss, parameters)
    assert counts[0] > 5
    assert all(np.array_equal(in_rounds[kind], at_once[kind]) for kind in KINDS)


@pytest.mark.parametrize("changed", ["image", "means"])
def test_a_change_in_place_before_the_backward_pass_is_noticed(changed: str):
    """As for torch's own functions, since the gradient would be wrong for both values."""
    parameters, camera, _ = small_scene(59)
    rgb, _ = draw(parameters, camera)
    with torch.no_grad():
        {"image": rgb, "means": parameters.means}[changed].add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        rgb.sum().backward()


def test_backward_twice_gives_the_same():
    parameters, camera, _ = small_scene(59)
    rgb, _ = draw(parameters, camera)
    first, second = (torch.autograd.grad(rgb.sum(), parameters.means, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(first, second)
