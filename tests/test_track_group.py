"""Several tracked objects that hide each other."""

from __future__ import annotations

import numpy as np
import pytest

from objects import CAMERA, bracket, cuboid
from posekit.errors import CameraError
from posekit.geometry import Pose, view_rotation
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.tracking.group import TrackerGroup
from posekit.tracking.tracker import TRACKED, Tracker
from test_refine import Oracle
from test_track import Estimator, backdrop


@pytest.fixture(scope="module")
def models() -> tuple[ObjectModel, ObjectModel]:
    vertices, faces = cuboid((0.0, 0.0, 0.0), (0.05, 0.04, 0.03), cells=4)
    shade = 0.5 + 0.5 * ((np.round(vertices / 0.01).sum(1) % 2) == 0)
    colours = (np.array([240, 140, 20]) * shade[:, None]).astype(np.uint8)
    return bracket(), ObjectModel.from_arrays(
        vertices.astype(np.float32), faces.astype(np.int32), name="block", colors=colours
    )


def poses(models: tuple[ObjectModel, ObjectModel], side: float = 0.03) -> list[Pose]:
    """The second object is in front, beside the first one's middle by ``side`` metres."""
    first, second = models
    R = view_rotation([0.5, -1.0, 0.6])
    return [Pose(R, [0, 0, 0.7]) @ first.T_ctr_obj, Pose(R, [side, 0, 0.5]) @ second.T_ctr_obj]


def frame(renderer: Renderer, models: tuple[ObjectModel, ObjectModel], there: list[Pose]) -> np.ndarray:
    image = backdrop()
    for model, pose in zip(models, there, strict=True):
        [drawn] = renderer.render(model, [pose], CAMERA)
        assert drawn.mask is not None
        image = np.where(drawn.mask[..., None], drawn.image, image)
    return image


def group_of(renderer: Renderer, models: tuple[ObjectModel, ObjectModel], there: list[Pose]) -> TrackerGroup:
    return TrackerGroup(
        [
            Tracker(m, CAMERA, pose=pose, estimator=Estimator(m, renderer), predictor=Oracle(m, pose))  # type: ignore[arg-type]
            for m, pose in zip(models, there, strict=True)
        ]
    )


def test_the_part_behind_another_object_is_known(renderer: Renderer, models: tuple[ObjectModel, ObjectModel]) -> None:
    there = poses(models)
    group = group_of(renderer, models, there)
    assert group.hidden(CAMERA) == [None, None], "nothing was followed yet"
    found = group.step(frame(renderer, models, there))
    assert [each.state for each in found] == [TRACKED, TRACKED]
    behind, before = group.hidden(CAMERA)
    assert before is None, "nothing is in front of the second one"
    assert behind is not None
    masks = [renderer.render(m, [pose], CAMERA)[0].mask for m, pose in zip(models, there, strict=True)]
    assert masks[0] is not None and masks[1] is not None
    overlap = masks[0] & masks[1]
    assert overlap.sum() > 500
    assert behind[overlap].mean() > 0.99 and behind[~masks[1]].mean() < 0.01


def test_apart_they_hide_nothing(renderer: Renderer, models: tuple[ObjectModel, ObjectModel]) -> None:
    there = [Pose(poses(models)[0].R, [-0.15, 0, 0.6]), Pose(poses(models)[1].R, [0.12, 0, 0.6])]
    there = [pose @ model.T_ctr_obj for pose, model in zip(there, models, strict=True)]
    group = group_of(renderer, models, there)
    group.step(frame(renderer, models, there))
    behind, before = group.hidden(CAMERA)
    assert before is None or not before[renderer.render(models[1], [there[1]], CAMERA)[0].mask].any()
    assert behind is None or not behind[renderer.render(models[0], [there[0]], CAMERA)[0].mask].any()


def test_an_object_behind_another_that_moves_is_followed(
    renderer: Renderer, models: tuple[ObjectModel, ObjectModel]
) -> None:
    start = poses(models, -0.09)
    group = group_of(renderer, models, start)
    for k in range(8):
        there = poses(models, -0.09 + 0.012 * k)
        for tracker, pose in zip(group.trackers, there, strict=True):
            tracker.predictor.truth = pose  # type: ignore[attr-defined]
        found = group.step(frame(renderer, models, there))
        for each, pose, model in zip(found, there, models, strict=True):
            assert each.T_cam_obj is not None
            shift = each.T_cam_obj.apply(model.center) - pose.apply(model.center)
            assert np.linalg.norm(shift) < 4e-3


def test_one_tracker_is_a_group_of_one(renderer: Renderer, models: tuple[ObjectModel, ObjectModel]) -> None:
    there = poses(models)
    image = frame(renderer, models, there)
    [alone] = [tracker.step(image) for tracker in group_of(renderer, models, there).trackers[:1]]
    [grouped] = TrackerGroup(group_of(renderer, models, there).trackers[:1]).step(image)
    assert alone.T_cam_obj is not None and grouped.T_cam_obj is not None
    assert np.array_equal(alone.T_cam_obj.matrix, grouped.T_cam_obj.matrix)


def test_a_camera_is_needed(renderer: Renderer, models: tuple[ObjectModel, ObjectModel]) -> None:
    there = poses(models)
    group = group_of(renderer, models, there)
    for tracker in group.trackers:
        tracker.camera = None
    with pytest.raises(CameraError, match="camera"):
        group.step(backdrop())
