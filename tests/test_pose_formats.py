"""Poses for other programs, and theirs read back."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from posekit.camera import Camera
from posekit.errors import ConfigError, PromptError
from posekit.geometry import Pose, quat_to_rotation, random_rotation
from posekit.io.load import load_pose
from posekit.io.pose_formats import (
    FORMATS,
    UNITY_MESH,
    NamedPose,
    opengl_projection,
    pose_files,
    pose_from_text,
    to_blender,
    to_opengl,
    to_unity,
)

RNG = np.random.default_rng(4)
POSE = Pose(random_rotation(RNG), [0.1, -0.2, 0.9])
OTHER = Pose(random_rotation(RNG), [-0.3, 0.1, 1.4])
POSES = [
    NamedPose("duck", POSE, 0.9, 2.5, True, 0, 0.04),
    NamedPose("cat: one", OTHER, 0.1, float("nan"), False, 0, 0.04),
    NamedPose("duck", OTHER, 0.8, 3.5, True, 7, 12.5),
]


def written(format_: str) -> dict[str, str]:
    return pose_files(format_, POSES)


def test_every_format_is_known_and_no_other() -> None:
    assert [bool(written(f)) for f in FORMATS] == [f != "json" for f in FORMATS]
    with pytest.raises(ConfigError, match="choose from json, csv"):
        pose_files("yaml", POSES)


def test_csv_has_units_in_its_heads() -> None:
    first, second, third = csv.DictReader(written("csv")["objects.csv"].splitlines())
    assert [float(first[k]) for k in ("x_m", "y_m", "z_m")] == POSE.t.tolist()
    assert [float(first[k]) for k in ("qw", "qx", "qy", "qz")] == POSE.quat_wxyz.tolist()
    assert (second["object"], second["angle_deg"], second["reliable"]) == ("cat: one", "", "false")
    assert (third["frame"], third["seconds"], third["score"], third["reliable"]) == ("7", "12.5", "0.8", "true")


def test_ros_is_transform_stamped_in_the_optical_frame() -> None:
    documents = list(yaml.safe_load_all(written("ros")["ros.yaml"]))
    assert [d["child_frame_id"] for d in documents] == ["duck", "cat: one", "duck"]
    assert documents[2]["header"] == {"stamp": {"sec": 12, "nanosec": 500_000_000}, "frame_id": "camera_optical_frame"}
    moved, turned = documents[0]["transform"]["translation"], documents[0]["transform"]["rotation"]
    assert [moved[k] for k in "xyz"] == POSE.t.tolist()
    np.testing.assert_allclose(quat_to_rotation([turned[k] for k in "wxyz"]), POSE.R, atol=1e-12)


def test_blenders_camera_looks_backwards_with_y_up() -> None:
    points = RNG.normal(size=(5, 3))
    seen = POSE.apply(points)
    np.testing.assert_allclose(to_blender(POSE).apply(points), seen * (1, -1, -1), atol=1e-12)
    entry = json.loads(written("blender")["blender.json"])["objects"][0]
    np.testing.assert_allclose(entry["matrix"], to_blender(POSE).matrix)
    np.testing.assert_allclose(quat_to_rotation(entry["rotation_quaternion"]), to_blender(POSE).R, atol=1e-12)
    assert entry["location"] == [0.1, 0.2, -0.9]


def test_unity_is_left_handed_with_y_up_and_meshes_negated_in_x() -> None:
    points = RNG.normal(size=(5, 3))
    there = to_unity(POSE)
    np.testing.assert_allclose(there.apply(points @ UNITY_MESH), POSE.apply(points) * (1, -1, 1), atol=1e-12)
    assert np.linalg.det(there.R) == pytest.approx(1), "a quaternion can hold it"
    entry = json.loads(written("unity")["unity.json"])["objects"][0]
    assert entry["localPosition"] == {"x": 0.1, "y": 0.2, "z": 0.9}
    turned = quat_to_rotation([entry["localRotation"][k] for k in "wxyz"])
    np.testing.assert_allclose(turned, there.R, atol=1e-12)


def test_opengl_shows_points_where_the_camera_does() -> None:
    camera = Camera(610.0, 604.0, 322.0, 236.0, 640, 480)
    points = 0.05 * RNG.normal(size=(20, 3))
    matrix = opengl_projection(camera, 0.2, 5.0) @ to_opengl(POSE).matrix
    clip = np.concatenate([points, np.ones((20, 1))], axis=1) @ matrix.T
    ndc = clip[:, :3] / clip[:, 3:]
    window = (ndc[:, :2] * (1, -1) + 1) / 2 * (640, 480)  # edges; the first row at the top, as y is up
    np.testing.assert_allclose(window - 0.5, camera.project(POSE.apply(points)), atol=1e-9)
    depths = clip[:, 3]
    np.testing.assert_allclose(depths, POSE.apply(points)[:, 2], atol=1e-12)
    assert (np.abs(ndc[:, 2]) < 1).all() and np.corrcoef(ndc[:, 2], depths)[0, 1] > 0, "nearer is smaller"


def test_opengl_wants_planes_in_front_of_the_camera() -> None:
    with pytest.raises(ConfigError, match="0 < near < far"):
        opengl_projection(Camera(610, 610, 322, 236, 640, 480), 5.0, 0.2)


def test_tum_is_one_trajectory_for_each_object_and_can_be_read_again(tmp_path: Path) -> None:
    files = written("tum")
    assert sorted(files) == ["cat: one.tum", "duck.tum"]
    head, first, last = files["duck.tum"].splitlines()
    assert head.startswith("#") and (first.split()[0], last.split()[0]) == ("0.04", "12.5")
    np.testing.assert_allclose(pose_from_text(f"{head}\n{last}").matrix, OTHER.matrix, atol=1e-12)
    twice = pose_files("tum", [*POSES, NamedPose("duck", POSE, 0.2, 9, False, 7, 12.5)])
    assert twice == files, "the first instance of a frame is the best"
    (tmp_path / "pose.tum").write_text(first)
    np.testing.assert_allclose(load_pose(tmp_path / "pose.tum").matrix, POSE.matrix, atol=1e-12)


QUAT = POSE.quat_wxyz
XYZW = [*QUAT[1:], QUAT[0]]


def spaced(values: object) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))  # type: ignore[call-overload]


@pytest.mark.parametrize(
    "text",
    [
        "\n".join(spaced(row) for row in POSE.matrix),
        "# from numpy.savetxt\n" + "\n".join(spaced(row).replace(" ", ", ") for row in POSE.matrix[:3]),
        str(POSE.matrix.tolist()),
        spaced([*POSE.t, *XYZW]),
        spaced([1700000000.25, *POSE.t, *XYZW]) + "  # with a timestamp",
        spaced([*POSE.t, *(-np.array(XYZW))]),
        json.dumps({"t_m": POSE.t.tolist(), "quat_wxyz": QUAT.tolist()}),
        json.dumps({"pose": {"position": dict(zip("xyz", POSE.t, strict=True)),
                             "orientation": dict(zip("wxyz", QUAT, strict=True))}}),
        json.dumps({"transform": {"translation": dict(zip("xyz", POSE.t, strict=True)),
                                  "rotation": dict(zip("wxyz", QUAT, strict=True))}}),
    ],
    ids=["4x4", "3x4 commas", "nested list", "TUM", "timestamp", "minus", "json", "ros pose", "ros transform"],
)  # fmt: skip
def test_poses_as_people_have_them(text: str, tmp_path: Path) -> None:
    (tmp_path / "pose.txt").write_text(text)
    np.testing.assert_allclose(load_pose(tmp_path / "pose.txt").matrix, POSE.matrix, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("1 2 3", "it has 3 numbers, not 16"),
        ("hello", "could not convert"),
        ("", "it has 0 numbers"),
        ("\n".join(spaced(row) for row in POSE.matrix.T), "last row is not 0 0 0 1"),
        (spaced([*POSE.t, 1, 1, 1, 1]), "length is 2, not 1"),
        (spaced([*POSE.t, 0, 0, 0, float("nan")]), "finite"),
        (json.dumps({"quat_wxyz": [1, 0, 0, 0]}), "has no t_m"),
        (json.dumps({"position": {"x": 1, "y": 2, "z": 3}}), "has no orientation"),
    ],
)
def test_other_texts_are_refused(text: str, why: str, tmp_path: Path) -> None:
    (tmp_path / "pose.txt").write_text(text)
    with pytest.raises(PromptError, match=why):
        load_pose(tmp_path / "pose.txt")


def test_millimetres_are_wondered_at(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "pose.txt").write_text("10 20 900 0 0 0 1")
    load_pose(tmp_path / "pose.txt")
    assert "900 m away: positions are in metres" in caplog.text
