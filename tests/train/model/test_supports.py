"""What a support may ask of a model: heads of its layers, scale spaces, parameters of its own."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import pytest
import torch
from torch import Tensor, nn

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.scale_space import ScaleSpace
from msdgs_train.layers.base import Heads, LayerStep
from msdgs_train.layers.chain import Deltas, MultiStepDeformation
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.layers.parameters import ParamGroup, constant
from msdgs_train.layers.plane import PlaneConfig
from msdgs_train.layers.spline import SplineConfig
from msdgs_train.supports.base import CanonicalPoints, Support, SupportConfig
from tests.support.training_scene import MLP, PLANE

EXTRA = (("turns", 2), ("gains", 1))


@dataclass(frozen=True)
class ScaledConfig(SupportConfig):
    """Moves Gaussians by the deltas of its chain times a parameter and the head `gains`."""

    kind: ClassVar[str] = "scaled"
    moves_nodes: ClassVar[bool] = True
    scale_spaces: ClassVar[tuple[ScaleSpace, ...]] = ("linear",)
    extra_heads: ClassVar[Mapping[str, int]] = MappingProxyType(dict(EXTRA))

    def build(self) -> "ScaledSupport":
        return ScaledSupport()


class ScaledSupport(Support):
    kind = "scaled"

    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(2.0))

    def motions(self, chain: MultiStepDeformation, means: Tensor, t: Tensor, num_layers: int | None = None) -> Deltas:
        return chain(means, t, num_layers)

    def follow(self, gaussians: CanonicalPoints, motions: Deltas) -> Deltas:
        return motions._replace(means=self.factor * motions.extra["gains"] * motions.means)

    def parameter_groups(self) -> list[ParamGroup]:
        return [ParamGroup("factor", [self.factor], constant(1e-3))]


def model_on(support: SupportConfig, *layers: MLPConfig | PlaneConfig) -> DynamicGaussians:
    config = ModelConfig(sh_degree=0, support=support, layers=layers, embedding_dim=0, scale_space="linear")
    gaussians = CanonicalGaussians.random_in_cube(7, 1.0, 0, 0)
    model = DynamicGaussians(config, gaussians)
    with torch.no_grad():
        for parameter in model.deformation.parameters():
            parameter.add_(
                0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(parameter.numel()))
            )
    return model


def test_heads_name_their_columns_in_order():
    columns = Heads(opacity=True, sh=4, extra=EXTRA).columns
    assert [(name, c.stop - c.start) for name, c in columns.items()][3:] == [("opacities", 1), ("sh", 12), *EXTRA]
    assert list(columns.values())[-1].stop == sum(Heads(False, True, 4, EXTRA).sizes)


@pytest.mark.parametrize("kinds", [(MLP,), (MLP, PLANE)], ids=str)
def test_extra_heads_are_summed_over_layers_with_their_weights(kinds: tuple[MLPConfig | PlaneConfig, ...]):
    model = model_on(ScaledConfig(), *kinds)
    means, t = model.gaussians.means.detach(), torch.tensor(0.3)
    moved, totals = means, {name: torch.zeros(len(means), columns) for name, columns in EXTRA}
    for layer in model.deformation:
        step: LayerStep = layer(moved, t)
        moved = moved + step.weight * step.delta_means
        totals = {name: total + step.weight * step.extra[name] for name, total in totals.items()}
    deltas = model.deformation(means, t)
    for name, total in totals.items():
        torch.testing.assert_close(deltas.extra[name], total)
    expected = means + 2 * totals["gains"] * (moved - means)
    torch.testing.assert_close(model.pose(0.3).means, expected)


def test_joined_deltas_are_those_of_all_rows():
    model = model_on(ScaledConfig(), MLP)
    means, t = model.gaussians.means.detach(), torch.tensor(0.7)
    whole, joined = model.deformation(means, t), Deltas.joined([model.deformation(part, t) for part in means.split(3)])
    torch.testing.assert_close(joined.means, whole.means)
    torch.testing.assert_close(joined.extra["turns"], whole.extra["turns"])
    assert joined.opacities is None


def test_parameters_of_a_support_are_trained():
    groups = {group.name: group for group in model_on(ScaledConfig(), MLP).motion_groups()}
    assert [p.numel() for p in groups["support.factor"].params] == [1]


def test_layers_and_scale_spaces_that_a_support_cannot_use_are_refused():
    with pytest.raises(InvalidInput, match=r"model\.layers\.1.*turns, gains for --support scaled.*spline"):
        ModelConfig(support=ScaledConfig(), layers=(MLP, SplineConfig()), scale_space="linear")
    with pytest.raises(InvalidInput, match=r"model\.scale_space.*linear with --support scaled.*log"):
        ModelConfig(support=ScaledConfig(), layers=(MLP,))
