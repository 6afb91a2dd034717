"""The kinds of supports by name. A kind from outside this package joins with `register_support`."""

from msdgs_train.supports.base import SupportConfig
from msdgs_train.supports.gaussians import GaussiansConfig
from msdgs_train.supports.nodes import NodesConfig
from msdgs_train.supports.scgs import SCGSConfig

SUPPORTS: dict[str, type[SupportConfig]] = {
    config.kind: config for config in (GaussiansConfig, NodesConfig, SCGSConfig)
}


def register_support(config: type[SupportConfig]) -> None:
    """Make a kind known under its `kind`."""
    SUPPORTS[config.kind] = config
