"""HexPlane-Slim (Cao and Johnson 2023) and TiNeuVox (Fang et al. 2022): volumes, as published for D-NeRF."""

from msdgs_train.systems.registry import register_system
from msdgs_train.volumes.hexplane import HexPlaneConfig
from msdgs_train.volumes.system import BASE, VolumeSystem
from msdgs_train.volumes.tineuvox import TiNeuVoxConfig

register_system(
    "hexplane-slim",
    "HexPlane-Slim: planes over two axes each, marched along rays",
    BASE.updated(own=HexPlaneConfig(), steps=25_000),
    VolumeSystem,
)
register_system(
    "tineuvox-s",
    "TiNeuVox, small: a grid behind a deformation MLP, marched along rays",
    BASE.updated(own=TiNeuVoxConfig(), steps=20_000),
    VolumeSystem,
)
register_system(
    "tineuvox-b",
    "TiNeuVox, base",
    BASE.updated(own=TiNeuVoxConfig(voxels=160**3, channels=6, width=256, first_alpha=1e-3), steps=20_000),
    VolumeSystem,
)
