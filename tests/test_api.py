"""A pose in one call."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from posekit import Camera, EstimateOptions, PoseEstimator, Result, api, estimate
from posekit.errors import ImageError, PromptError
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.synth.example import Example

CAMERA = "610,610,322,236"


@pytest.fixture(scope="module")
def estimator(example: Example, example_folder: Path) -> PoseEstimator:
    options = EstimateOptions(hypotheses=1, iterations=1)
    model = ObjectModel.load(example_folder / "toy.ply", units="m")
    return PoseEstimator(model, weights=example_folder / "untrained", options=options)


@pytest.fixture(scope="module")
def result(example: Example, example_folder: Path) -> Result:
    options = EstimateOptions(hypotheses=1, iterations=1)
    return estimate(
        example_folder / "photo.png", example_folder / "toy.ply", example.box, camera=CAMERA, units="m",
        weights=example_folder / "untrained", options=options,
    )  # fmt: skip


def test_a_result_says_what_its_best_estimate_does(result: Result) -> None:
    assert len(result) == 1 and list(result) == [result.best] == [result[0]]
    assert result.T_cam_obj is result.best.T_cam_obj
    assert (result.angle_deg, result.score, result.reliable) == (
        result.best.angle_deg,
        result.best.score,
        result.best.reliable,
    )


def test_a_result_draws_and_saves_itself(result: Result, tmp_path: Path) -> None:
    picture = result.draw()
    assert picture.dtype == np.uint8 and picture.shape[0] > 480
    assert (result.draw(blend=1.0) != picture).any()
    saved = result.save(tmp_path / "new" / "folder")
    assert (cv2.imread(str(saved / "overlay.png"))[..., ::-1] == picture).all()
    [entry] = json.loads((saved / "result.json").read_text())["estimates"]
    np.testing.assert_allclose(entry["T_cam_obj"], result.T_cam_obj.matrix)


def test_arrays_models_and_estimators_give_the_same(example: Example, result: Result, estimator: PoseEstimator) -> None:
    size = (example.view.camera.width, example.view.camera.height)
    image, camera = example.view.image, Camera(610, 610, 322, 236, *size)
    for given in (camera, CAMERA):
        again = estimate(image, estimator, box=list(example.box), camera=given)
        np.testing.assert_allclose(again.T_cam_obj.matrix, result.T_cam_obj.matrix, atol=1e-4)


def test_masks_as_files_and_arrays(example: Example, estimator: PoseEstimator, tmp_path: Path) -> None:
    [drawn] = Renderer().render(example.model, [example.T_cam_obj], example.view.camera)
    assert drawn.mask is not None
    cv2.imwrite(str(tmp_path / "mask.png"), drawn.mask.astype(np.uint8) * 255)
    found = [estimate(example.view, estimator, mask=mask) for mask in (drawn.mask, tmp_path / "mask.png")]
    assert [each.best.detection.source for each in found if each.best.detection] == ["mask", "mask"]
    np.testing.assert_array_equal(found[0].T_cam_obj.matrix, found[1].T_cam_obj.matrix)


def test_what_cannot_be_used_is_said(example: Example, estimator: PoseEstimator) -> None:
    with pytest.raises(PromptError, match="both given"):
        estimate(example.view, estimator, example.box, mask=np.ones((480, 640), np.bool_))
    with pytest.raises(PromptError, match="four numbers"):
        estimate(example.view, estimator, (1, 2, 3))
    with pytest.raises(ImageError, match=r"uint8 RGB \(H, W, 3\), not float64"):
        estimate(np.zeros((480, 640, 3)), estimator, example.box)  # type: ignore[arg-type]
    with pytest.raises(ImageError, match="64x48"):
        estimate(example.view.image, estimator, example.box, camera=Camera.from_fov(1.0, 64, 48))
    nothing = Result(example.view, estimator, ())
    assert not nothing.reliable
    with pytest.raises(PromptError, match="not found: give a box"):
        _ = nothing.best


@pytest.mark.parametrize(
    "first", ["import posekit.estimate", "from posekit.estimate import PoseEstimator", "import posekit.api", "pass"]
)
def test_estimate_can_be_called_whatever_was_imported_before(first: str) -> None:
    code = (
        f"{first}\nfrom posekit import estimate\ntry: estimate(None, None, (1,), 'm')\nexcept Exception as e: print(e)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "both given" in done.stdout, done.stdout + done.stderr
    assert api.estimate.__doc__
