"""Model files: complete or refused; saving is atomic."""

import pickle
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from msdgs_train.gaussians.model_file import load_model, save_model
from msdgs_train.gaussians.safe_load import CheckpointInvalid, load, save_atomic
from msdgs_train.supports.nodes import NodesConfig
from tests.support.models import MLP, NODES, SCENE, SHADING, random_model


@pytest.fixture
def model_file(tmp_path: Path) -> Path:
    save_model(tmp_path / "model.pt", random_model(), SCENE, 42)
    return tmp_path / "model.pt"


def rewritten(path: Path, part: str | None = None, **changes: object) -> None:
    """The file with other contents, of all or a part; None removes an entry."""
    contents = torch.load(path, weights_only=True)
    changed = contents if part is None else contents[part]
    changed.update(changes)
    for name in [name for name, value in changes.items() if value is None]:
        del changed[name]
    torch.save(contents, path)


@pytest.mark.parametrize(
    "changes",
    [
        *({}, {"count": 0}, {"count": 1}, {"layers": ()}, {"embedding_dim": 0}, {"sh_degree": 0}),
        {"layers": ("plane", "mlp")},
        {"layers": ("spline", "plane", "mlp"), "support": NODES},
        {"layers": ("bodies", "spline"), "support": NODES},
        {"layers": (SHADING,), "support": NODES},
        {"layers": ("mlp",), "support": NodesConfig(num_nodes=1, k_nearest=3)},
    ],
)
def test_a_saved_model_is_loaded_unchanged(tmp_path: Path, changes: dict[str, Any]):
    model = random_model(**changes)
    save_model(tmp_path / "model.pt", model, SCENE, 42)
    loaded = load_model(tmp_path / "model.pt")
    assert loaded.step == 42
    assert loaded.scene == SCENE
    assert loaded.model.config == model.config
    for got, want in zip(loaded.model.pose(0.4), model.pose(0.4), strict=True):
        assert torch.equal(got, want)


@pytest.mark.parametrize("wrong", [NODES.num_nodes, -1, 10**9, 0.5])
def test_a_gaussian_that_follows_no_node_is_refused(tmp_path: Path, wrong: float):
    save_model(tmp_path / "model.pt", random_model(support=NODES, layers=("mlp",)), SCENE, 42)
    ids = torch.load(tmp_path / "model.pt", weights_only=True)["state"]["gaussians.node_ids"]
    ids = ids + (wrong - ids) * (torch.arange(len(ids)) == 7)[:, None]
    rewritten(tmp_path / "model.pt", "state", **{"gaussians.node_ids": ids})
    with pytest.raises(CheckpointInvalid, match=r"`node_ids` must be integers in \[0, "):
        load_model(tmp_path / "model.pt")


@pytest.mark.parametrize("part", [None, 0.0, 0.001, 0.3, 0.9, 0.9999])
def test_cut_off_files_and_those_of_other_kinds_are_refused(model_file: Path, part: float | None):
    contents = model_file.read_bytes()
    model_file.write_bytes(b"not a model" if part is None else contents[: int(part * len(contents))])
    with pytest.raises(CheckpointInvalid, match=r"model\.pt: (is empty|isn't a torch checkpoint, or is cut off)"):
        load_model(model_file)


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ({"weights": torch.zeros(3)}, r"isn't a model of msdgs-train \(found None\); of other trainers give the PLY"),
        ({"step": 3, "splats": {"means": torch.zeros(3)}}, r"of gsplat: give the PLY .* --save_ply"),
        ({"step": 3, "pipeline": {}, "optimizers": {}}, r"of nerfstudio: give the PLY that ns-export gaussian-splat"),
        ({"format": "msdgs-model/1"}, r"found 'msdgs-model/1'\): train or import it again"),
        ([1, 2], "found 'list'"),
    ],
)
def test_files_of_others_are_refused(tmp_path: Path, contents: object, message: str):
    torch.save(contents, tmp_path / "model.pt")
    with pytest.raises(CheckpointInvalid, match=message):
        load_model(tmp_path / "model.pt")


@pytest.mark.parametrize("name", ["missing.pt", "."])
def test_what_is_no_file_is_refused(tmp_path: Path, name: str):
    with pytest.raises(CheckpointInvalid):
        load_model(tmp_path / name)


@pytest.mark.parametrize("opcodes", [b"\x80\x02u.", b"\x80\x02(u.", b"\x80\x02e.", b"\x80\x02r", b"\x80\x02\x85."])
def test_a_stream_that_makes_no_sense_is_refused(tmp_path: Path, opcodes: bytes):
    torch.save({}, tmp_path / "sound.pt")
    with zipfile.ZipFile(tmp_path / "sound.pt") as sound, zipfile.ZipFile(tmp_path / "model.pt", "w") as changed:
        for name in sound.namelist():
            changed.writestr(name, opcodes if name.endswith("data.pkl") else sound.read(name))
    with pytest.raises(CheckpointInvalid, match="isn't a whole torch checkpoint"):
        load(tmp_path / "model.pt")


class Trap:
    """Creates a file when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("save", [torch.save, lambda trap, path: path.write_bytes(pickle.dumps(trap))])
def test_no_code_of_a_file_is_run(tmp_path: Path, save):
    save(Trap(tmp_path / "sprung"), tmp_path / "model.pt")
    with pytest.raises(CheckpointInvalid):
        load(tmp_path / "model.pt")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("poison", [float("nan"), float("inf"), float("-inf")])
def test_values_that_are_not_finite_are_named_and_counted(model_file: Path, poison: float):
    state = torch.load(model_file, weights_only=True)["state"]
    state["gaussians.means"][3:5, 1] = poison
    state["deformation.layers.1.heads.bias"][0] = poison
    rewritten(model_file, state=state)
    named = "gaussians.means (2 of 900), deformation.layers.1.heads.bias (1 of 11)"
    with pytest.raises(CheckpointInvalid, match=re.escape(named)):
        load_model(model_file)


@pytest.mark.parametrize("key", ["config", "scene", "step", "state"])
def test_incomplete_files_are_refused(model_file: Path, key: str):
    rewritten(model_file, **{key: None})
    with pytest.raises(CheckpointInvalid, match=key):
        load_model(model_file)


@pytest.mark.parametrize("step", ["first", float("inf"), []])
def test_a_step_that_is_no_number_is_refused(model_file: Path, step: object):
    rewritten(model_file, step=step)
    with pytest.raises(CheckpointInvalid, match="isn't a complete model"):
        load_model(model_file)


@pytest.mark.parametrize("name", ["cameras", "training_cameras"])
@pytest.mark.parametrize("cameras", [None, 5, [1], [{}], [{**SCENE.cameras[0], "fx": float("nan")}]])
def test_damaged_cameras_are_named(model_file: Path, name: str, cameras: Any):
    scene = torch.load(model_file, weights_only=True)["scene"]
    rewritten(model_file, scene=scene | {name: cameras})
    with pytest.raises(CheckpointInvalid, match=rf"scene\.{name}"):
        load_model(model_file)


@pytest.mark.parametrize("time_from", ["name", "(", 3])
def test_a_source_of_times_that_cannot_be_used_is_named(model_file: Path, time_from: object):
    scene = torch.load(model_file, weights_only=True)["scene"]
    rewritten(model_file, scene=scene | {"time_from": time_from})
    with pytest.raises(CheckpointInvalid, match=r"scene\.time_from must be names, index, none or a regular expression"):
        load_model(model_file)


@pytest.mark.parametrize("name", ["gaussians.raw_quats", "gaussians.embeddings", "deformation.layers.0.first.weight"])
@pytest.mark.parametrize("tensor", [None, torch.zeros(2, 2)])
def test_tensors_missing_or_of_another_shape_are_named(model_file: Path, name: str, tensor: torch.Tensor | None):
    rewritten(model_file, "state", **{name: tensor})
    with pytest.raises(CheckpointInvalid, match=name.removeprefix("gaussians.")):
        load_model(model_file)


@pytest.mark.parametrize(
    "config", [{"unheard_of": 1}, {"layers": -1}, {"layers": ["hash"]}, {"support": {"kind": "cage"}}]
)
def test_configurations_of_others_are_refused(model_file: Path, config: dict[str, Any]):
    rewritten(model_file, config=config)
    with pytest.raises(CheckpointInvalid, match=next(iter(config))):
        load_model(model_file)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"layers": (replace(MLP, width=10_000_000),)}, r"must be a tensor of shape"),
        ({"layers": (replace(MLP, depth=10_000_000),)}, r"`depth` must be at most \d+"),
        ({"support": NodesConfig(num_nodes=10**12)}, r"must be a tensor of shape|must be of shape"),
    ],
)
def test_sizes_that_are_not_stored_take_no_memory(tmp_path: Path, part: dict[str, Any], message: str):
    model = random_model(layers=("mlp",), support=NODES)
    save_model(tmp_path / "model.pt", model, SCENE, 42, replace(model.config, **part))
    with pytest.raises(CheckpointInvalid, match=message):
        load_model(tmp_path / "model.pt")


def test_tensors_that_are_not_stored_in_full_are_named(model_file: Path):
    rewritten(model_file, "state", **{"gaussians.means": torch.zeros(1).expand(1_000_000_000_000, 3)})
    with pytest.raises(CheckpointInvalid, match=r"`gaussians.means` of shape .* isn't stored in full"):
        load_model(model_file)


class Unsavable:
    def __reduce__(self) -> tuple:
        raise KeyboardInterrupt


def test_an_interrupted_save_leaves_the_old_file_alone(model_file: Path):
    before = model_file.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        save_atomic(model_file, {"tensor": torch.zeros(1000), "then": Unsavable()})
    assert model_file.read_bytes() == before
    assert list(model_file.parent.iterdir()) == [model_file]


@pytest.mark.parametrize("content", [b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n"])
def test_a_pointer_of_git_lfs_is_called_one(tmp_path: Path, content: bytes):
    (tmp_path / "model.pt").write_bytes(content)
    with pytest.raises(CheckpointInvalid, match=r"model\.pt: is a Git LFS pointer, .*`git lfs pull`"):
        load_model(tmp_path / "model.pt")
