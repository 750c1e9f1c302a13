"""Results to JSON and back, and files that are written whole or not at all."""

from __future__ import annotations

import json
import os
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from posekit import __version__
from posekit.errors import OutputError, PromptError
from posekit.geometry import Pose, random_rotation
from posekit.io.files import write_bytes_atomic, write_text_atomic
from posekit.io.load import load_pose
from posekit.results import (
    RELIABLE_ANGLE_DEG,
    RELIABLE_SCORE,
    Detection,
    Estimate,
    Source,
    Step,
    estimates_from_json,
    estimates_to_json,
)

POSE = Pose(random_rotation(np.random.default_rng(0)), [0.1, -0.2, 0.9])


def estimate(angle: float = 0.02) -> Estimate:
    return Estimate(
        T_cam_obj=POSE,
        angle=angle,
        iterations=3,
        converged=True,
        score=0.8,
        box=(1.0, 2.0, 30.5, 40.0),
        model="duck",
        detection=Detection((0.0, 0.0, 32.0, 42.0), np.ones((4, 4), bool), 0.9, "duck", Source.MASK),
        trace=(Step(Pose.identity(), 0.4), Step(POSE, angle)),
        timings={"refine": 0.25, "total": 0.5},
    )


@pytest.mark.parametrize(
    ("angle_deg", "score", "words"),
    [
        (2.2, 0.9, "reliable: expected rotation error about 2 degrees"),
        (RELIABLE_ANGLE_DEG - 0.1, RELIABLE_SCORE, "reliable: expected rotation error about 15 degrees"),
        (0.4, 0.9, "reliable: expected rotation error below 1 degree"),
        (1.2, 0.9, "reliable: expected rotation error about 1 degree"),
        (23.8, 0.9, "NOT RELIABLE: estimated rotation error about 24 degrees"),
        (2.2, 0.1, "NOT RELIABLE: the picture hardly shows this object in this pose; estimated rotation error about 2"),
        (float("nan"), 0.9, "NOT RELIABLE: estimated rotation error unknown"),
    ],
)
def test_a_verdict_needs_both_score_and_angle(angle_deg: float, score: float, words: str) -> None:
    found = replace(estimate(float(np.deg2rad(angle_deg))), score=score)
    assert found.reliable == words.startswith("reliable")
    assert found.verdict.startswith(words)
    assert found.angle_deg == pytest.approx(angle_deg, nan_ok=True)
    assert json.loads(estimates_to_json([found]))["estimates"][0]["reliable"] is found.reliable


def test_a_source_says_who_vouches_for_a_detection() -> None:
    by_hand = {Source.BOX, Source.GRABCUT, Source.FILLED, Source.MASK}
    assert {source for source in Source if source.by_hand} == by_hand
    assert {source for source in Source if source.given} == by_hand | {Source.FILE}
    assert Detection((0.0, 0.0, 1.0, 1.0)).score == 1.0, "what a person gives is certain"


def test_the_mask_edges_deviation_is_kept() -> None:
    [with_one, without] = estimates_from_json(
        estimates_to_json([replace(estimate(), mask_edge_std=0.01), replace(estimate(), mask_edge_std=None)])
    )
    assert with_one.mask_edge_std == pytest.approx(0.01) and without.mask_edge_std is None


def no_constant(name: str) -> float:
    raise AssertionError(f"{name} is not JSON")


def test_the_result_has_what_the_readme_promises() -> None:
    data = json.loads(
        estimates_to_json([estimate()], weights_hash="abc", versions={"torch": "2"}), parse_constant=no_constant
    )
    [entry] = data["estimates"]
    np.testing.assert_allclose(entry["T_cam_obj"], POSE.matrix)
    np.testing.assert_allclose(entry["quat_wxyz"], POSE.quat_wxyz)
    np.testing.assert_allclose(entry["t_m"], POSE.t)
    assert entry["angle_deg"] == pytest.approx(np.rad2deg(0.02))
    assert (entry["iterations"], entry["converged"], entry["score"]) == (3, True, 0.8)
    assert entry["box"] == [1.0, 2.0, 30.5, 40.0]
    assert entry["timings_s"] == {"refine": 0.25, "total": 0.5}
    assert entry["trace"][0]["angle_deg"] == pytest.approx(np.rad2deg(0.4))
    assert data["estimates"][0]["weights_hash"] == "abc"
    assert data["estimates"][0]["versions"] == {"posekit": __version__, "torch": "2"}


def test_round_trip() -> None:
    text = estimates_to_json([estimate(), estimate(0.5)], about={"image": Path("a.png"), "K": np.eye(3)})
    first, second = estimates_from_json(text)
    assert second.angle == pytest.approx(0.5)
    np.testing.assert_allclose(first.T_cam_obj.matrix, POSE.matrix, atol=1e-12)
    assert (first.box, first.model, dict(first.timings)) == (estimate().box, "duck", estimate().timings)
    assert first.detection is not None
    assert (first.detection.label, first.detection.source, first.detection.mask) == ("duck", "mask", None)
    assert [step.angle for step in first.trace] == pytest.approx([0.4, 0.02])
    assert json.loads(text)["image"] == "a.png"
    assert json.loads(text)["K"] == np.eye(3).tolist()
    assert estimates_from_json(estimates_to_json([])) == []


def test_alternatives_are_kept() -> None:
    found = replace(estimate(), alternatives=(estimate(0.3), replace(estimate(0.4), score=0.1)))
    [back] = estimates_from_json(estimates_to_json([found]))
    assert [(e.angle, e.score) for e in back.alternatives] == [pytest.approx((0.3, 0.8)), pytest.approx((0.4, 0.1))]
    entry = json.loads(estimates_to_json([found]))["estimates"][0]
    assert [e["reliable"] for e in entry["alternatives"]] == [False, False]
    del entry["alternatives"]
    [old] = estimates_from_json(json.dumps({"estimates": [entry]}))
    assert old.alternatives == (), "files from before"


def test_what_is_not_finite_is_null() -> None:
    text = estimates_to_json([estimate(float("nan"))], about={"loss": np.float32("inf")})
    data = json.loads(text, parse_constant=no_constant)
    assert data["estimates"][0]["angle_deg"] is None
    assert data["loss"] is None
    assert np.isnan(estimates_from_json(text)[0].angle)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"estimates": [{}]}', '{"estimates": [{"T_cam_obj": 3}]}', "null"])
def test_other_json_is_refused(text: str) -> None:
    with pytest.raises(PromptError, match="this is no posekit result"):
        estimates_from_json(text)


# --- poses from files ---


@pytest.mark.parametrize(
    "data",
    [
        {"T_cam_obj": POSE.matrix.tolist()},
        {"cam_R_m2c": POSE.R.ravel().tolist(), "cam_t_m2c": (POSE.t * 1000).tolist(), "obj_id": 9},
        json.loads(estimates_to_json([estimate()])),
    ],
    ids=["matrix", "bop", "result"],
)
def test_poses_from_files(tmp_path: Path, data: object) -> None:
    (tmp_path / "pose.json").write_text(json.dumps(data))
    np.testing.assert_allclose(load_pose(tmp_path / "pose.json").matrix, POSE.matrix, atol=1e-9)


def test_bop_rotations_that_are_a_little_too_large(tmp_path: Path) -> None:
    data = {"cam_R_m2c": (POSE.R * 1.0023).ravel().tolist(), "cam_t_m2c": [0, 0, 500]}
    (tmp_path / "pose.json").write_text(json.dumps(data))
    np.testing.assert_allclose(load_pose(tmp_path / "pose.json").R, POSE.R, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("{", "holds no pose"),
        ("[1, 2]", "it has 2 numbers"),
        ("[{}]", "outermost"),
        ("{}", "has no cam_R_m2c"),
        ('{"T_cam_obj": [[1, 2], [3, 4]]}', r"shape \(4, 4\)"),
        (json.dumps({"T_cam_obj": np.zeros((4, 4)).tolist()}), "not a rotation"),
        (json.dumps({"T_cam_obj": "x"}), "holds no pose"),
        (json.dumps({"cam_R_m2c": [2, 0, 0, 0, 2, 0, 0, 0, 2], "cam_t_m2c": [0, 0, 1]}), "not a rotation"),
        ('{"estimates": []}', "no estimates"),
    ],
)
def test_files_without_a_pose(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "pose.json").write_text(text)
    with pytest.raises(PromptError, match=why) as caught:
        load_pose(tmp_path / "pose.json")
    assert '"T_cam_obj": 4x4 in metres' in str(caught.value)


def test_a_pose_file_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(PromptError, match=r"pose.json cannot be read \(No such file"):
        load_pose(tmp_path / "pose.json")


# --- files ---


def test_files_are_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text_atomic(path, "ä")
    assert path.read_text(encoding="utf-8") == "ä"
    path.chmod(0o640)
    write_bytes_atomic(path, b"new")
    assert path.read_bytes() == b"new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_new_file_has_the_usual_permissions(tmp_path: Path) -> None:
    mask = os.umask(0o027)
    try:
        write_text_atomic(tmp_path / "a.txt", "x")
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == 0o640


def test_a_failure_leaves_the_old_file_and_no_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.txt"
    write_text_atomic(path, "old")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OutputError, match=r"a.txt cannot be written: No space left"):
        write_text_atomic(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_folder_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="Name a folder that exists and is writable"):
        write_text_atomic(tmp_path / "no" / "a.txt", "x")
