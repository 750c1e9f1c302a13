"""LINEMOD's layouts and splits, on data made here; and what is known of the data sets by name."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bop_scene import bop_pose, brick, put
from objects import bracket
from posekit.datasets.linemod import DeepimDataset, LinemodDataset, spread_rotations
from posekit.datasets.registry import DATASETS, data_folder, dataset_info, find_root, open_dataset
from posekit.errors import ConfigError, InputError
from posekit.evaluate.table import PUBLISHED, paper_table
from posekit.geometry import Pose, rotation_angle, so3_exp
from posekit.synth.example import ply

ANGLES = (0, 4, 16, 20, 33, 50)  # degrees about z; 0, 16, 33 and 50 are 15 degrees apart


def rotations() -> np.ndarray:
    return np.stack([so3_exp([0, 0, np.deg2rad(a)]) for a in ANGLES])


@pytest.fixture
def bop(tmp_path: Path) -> Path:
    """Sequences of the cat (6) and of the bowl (3), which is not among the 13 objects."""
    for scene in (3, 6):
        folder = tmp_path / "lm/test" / f"{scene:06d}"
        (folder / "rgb").mkdir(parents=True)
        poses = [Pose(R, [0, 0, 0.5]) for R in rotations()]
        put(folder / "scene_gt.json", {str(k): [bop_pose(9, p), bop_pose(scene, p)] for k, p in enumerate(poses)})
        put(folder / "scene_camera.json", {str(k): {"cam_K": [500, 0, 32, 0, 500, 24, 0, 0, 1]} for k in range(6)})
        for k in range(6):
            Image.new("RGB", (64, 48)).save(folder / f"rgb/{k:06d}.png")
    (tmp_path / "lm/models").mkdir()
    (tmp_path / "lm/models/obj_000006.ply").write_text(ply(brick()))
    return tmp_path / "lm"


def test_greedy_selection_keeps_15_degrees() -> None:
    R = rotations()
    taken = spread_rotations(R)
    assert taken == [0, 2, 4, 5]
    apart = [rotation_angle(R[a].T @ R[b]) for a in taken for b in taken if a < b]
    assert np.rad2deg(min(apart)) >= 15
    left = [k for k in range(len(R)) if k not in taken]
    assert all(min(np.rad2deg(rotation_angle(R[k].T @ R[t])) for t in taken) < 15 for k in left)


def test_without_lists_the_split_is_made_anew_and_says_so(bop: Path) -> None:
    data = LinemodDataset(bop)
    assert data.images() == [(6, 1), (6, 3)]
    assert data.split_label == "regenerated (greedy, 15 degrees apart)"
    assert [i.obj_id for i in data.instances(6, 1)] == [6]  # the duck in the same picture is not asked for
    assert LinemodDataset(bop).split_hash == data.split_hash
    opened, info = open_dataset("linemod", bop)
    assert isinstance(opened, LinemodDataset) and info.flipped == (10,)


@pytest.mark.parametrize("folder", [".", "image_set", "image_set/observed", "splits"])
def test_lists_are_read_where_they_are(bop: Path, folder: str) -> None:
    before = LinemodDataset(bop).split_hash
    (bop / folder).mkdir(parents=True, exist_ok=True)
    (bop / folder / "cat_train.txt").write_text("06/000000\n06/000005\n")
    data = LinemodDataset(bop)
    assert data.images() == [(6, 1), (6, 2), (6, 3), (6, 4)]
    assert data.split_label == "lists of the data set"
    assert data.split_hash != before
    (bop / folder / "cat_test.txt").write_text("3\n\n4\n")
    assert LinemodDataset(bop).images() == [(6, 3), (6, 4)]


def test_lists_that_cannot_be_meant_are_refused(bop: Path) -> None:
    (bop / "cat_test.txt").write_text("06/000001\nnone\n")
    with pytest.raises(InputError, match=r"cat_test.txt, line 2: 'none' names no frame"):
        LinemodDataset(bop).images()
    (bop / "cat_test.txt").write_text("06/000700\n")
    with pytest.raises(InputError, match="lists frames such as 700, none of which is in this copy"):
        LinemodDataset(bop).images()


def test_deepim_s_layout(tmp_path: Path) -> None:
    observed, truth = tmp_path / "data/observed/01", tmp_path / "data/gt_observed/ape"
    observed.mkdir(parents=True)
    truth.mkdir(parents=True)
    (tmp_path / "models/ape").mkdir(parents=True)
    (tmp_path / "models/ape/ape.ply").write_text(ply(bracket()))
    labels = np.zeros((48, 64), np.uint8)
    labels[3:9, 5:9] = 1
    for k, R in enumerate(rotations()):
        Image.new("RGB", (64, 48), (k, 0, 0)).save(observed / f"{k:06d}-color.png")
        Image.fromarray(labels).save(observed / f"{k:06d}-label.png")
        Image.fromarray(np.full((48, 64), 700, np.uint16)).save(observed / f"{k:06d}-depth.png")
        rows = "\n".join(" ".join(map(str, row)) for row in np.column_stack([R, [0.1, 0, 0.7]]))
        (truth / f"{k:06d}-pose.txt").write_text(f"1\n{rows}\n")
    data, _ = open_dataset("linemod", tmp_path)
    assert isinstance(data, DeepimDataset)
    assert data.images() == [(1, 1), (1, 3)]
    [instance] = data.instances(1, 3)
    np.testing.assert_allclose(instance.T_cam_obj.t, [0.1, 0, 0.7])
    np.testing.assert_allclose(instance.T_cam_obj.R, rotations()[3])
    assert instance.mask().sum() == 24
    depth = data.depth(1, 3)
    assert depth is not None and depth[0, 0] == pytest.approx(0.7)
    assert data.view(1, 3).camera.fx == pytest.approx(572.4114)
    assert data.measured_model(1).diameter == pytest.approx(bracket().diameter, rel=1e-4)
    (truth / "000003-pose.txt").write_text("1\n1 0 0\n")
    with pytest.raises(InputError, match=r"000003-pose.txt is no pose"):
        data.instances(1, 3)


def test_the_paper_s_table() -> None:
    results = {"per_object": {"6": {"name": "cat", "2deg_2cm": 1.0}}, "mean": {"2deg_2cm": 2.0}}
    rows = paper_table(results)
    assert [name for name, _ in rows] == [*PUBLISHED, "posekit, cat", "posekit, mean"]
    assert rows[3][1]["5deg_5cm"] == 73.1
    assert rows[-2][1]["2deg_2cm"] == 1.0 and rows[-1][1]["2deg_2cm"] == 2.0


# --- data sets by name -----------------------------------------------------------------------------------------------


def test_every_known_data_set_is_whole() -> None:
    for name, info in DATASETS.items():
        assert info.name == name and info.title and info.objects
        assert any(a.endswith("_models.zip") for a in info.archives)
        assert all(a.startswith(info.below + "_") for a in info.archives)
    assert dataset_info("lmo").label(9) == "duck"
    assert dataset_info("tless").split == "test_primesense"
    with pytest.raises(ConfigError, match=r"there is no data set 'ycb'; .* Did you mean ycbv\?"):
        dataset_info("ycb")


def test_where_data_is_looked_for(bop: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = dataset_info("lm")
    assert find_root(info, bop) == bop
    assert find_root(info, bop.parent) == bop
    monkeypatch.setenv("POSEKIT_DATA", str(bop.parent))
    assert find_root(info, None) == bop
    monkeypatch.delenv("POSEKIT_DATA")
    monkeypatch.setenv("XDG_CACHE_HOME", str(bop / "cache"))
    assert data_folder() == bop / "cache/posekit/data"
    with pytest.raises(InputError, match="Fetch it with: posekit download lm --root"):
        find_root(info, None)


def test_a_known_name_with_another_split_is_read_from_that_split(bop: Path, tmp_path: Path) -> None:
    root = tmp_path / "elsewhere" / bop.name
    shutil.copytree(bop, root)
    (root / "test").rename(root / "train")
    data, info = open_dataset(None, root, "train")
    assert info.name == "lm" and list(data.images())
    with pytest.raises(InputError, match="no folder test/ in it"):
        open_dataset("lm", root)


def test_any_folder_in_bop_layout_will_do(bop: Path) -> None:
    other = bop.rename(bop.parent / "mine")
    data, info = open_dataset(None, other)
    assert (data.name, info.name, info.objects) == ("mine", "mine", (6,))
    with pytest.raises(ConfigError, match="which data set"):
        open_dataset(None, None)
