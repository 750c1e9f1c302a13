"""What a view shows, and what lies outside its photograph."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from objects import CAMERA, bracket
from posekit.align.colour_edge import learn, outline_lines
from posekit.camera import Zoom
from posekit.estimate.refine import crops
from posekit.geometry import Pose, view_rotation
from posekit.io.load import load_view
from posekit.io.video import open_frames
from posekit.render import Renderer
from posekit.tracking.points import Keyframe, follow_points
from posekit.view import View


def black_backdrop() -> tuple[View, Pose]:
    model = bracket()
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), np.array([0.0, 0.0, 0.6])) @ model.T_ctr_obj
    [drawn] = Renderer().render(model, [truth], CAMERA)
    assert drawn.mask is not None
    return View(np.where(drawn.mask[..., None], drawn.image, 0).astype(np.uint8), CAMERA, drawn.mask), truth


def test_black_is_a_colour() -> None:
    view = View(np.zeros((480, 640, 3), np.uint8), CAMERA)
    assert view.shown.all()
    inside = Zoom.look_at(CAMERA, [0.0, 0.0, 1.0], 0.1, (160, 120))
    assert view.zoomed(inside).valid is None and view.zoomed(inside).shown.all()


@pytest.mark.parametrize("value", [0, 200])
def test_what_lies_outside_the_photograph_is_not_shown(value: int) -> None:
    view = View(np.full((480, 640, 3), value, np.uint8), CAMERA)
    zoom = Zoom.look_at(CAMERA, [-0.5, 0.0, 1.0], 0.2, (160, 120))
    found = view.zoomed(zoom)
    places = (
        np.concatenate([zoom.camera.pixel_grid(), np.ones((120, 160, 1))], axis=2) @ np.linalg.inv(zoom.homography).T
    )
    places = places[..., :2] / places[..., 2:]
    inside = (places >= 0).all(axis=2) & (places <= [639, 479]).all(axis=2)
    assert 0.2 < inside.mean() < 0.8
    assert (found.shown != inside).mean() < 0.01 and not (found.shown & ~inside).sum() > 20
    again = found.zoomed(Zoom.look_at(found.camera, [0.0, 0.0, 1.0], 0.2, (160, 120)))
    assert abs(again.shown.mean() - found.shown.mean()) < 0.02, "carried on"


def test_an_object_before_black_keeps_its_outline() -> None:
    """From a pose beside the truth, the outline's lines end where the true outline is."""
    view, truth = black_backdrop()
    model, renderer = bracket(), Renderer()
    outline, size = model.hull_ctr, (160, 120)
    start = Pose(truth.R, truth.t + [0.002, 0.0, 0.0])
    [seen], [drawn] = crops(View(view.image, CAMERA), model, outline, [start], size, renderer)
    assert drawn.mask is not None
    colours = learn(seen, drawn.mask, np.ones_like(drawn.mask))
    lines = outline_lines(seen, drawn, colours, np.ones_like(drawn.mask), model.center)
    assert lines is not None, "the outline is told by black beside colours"
    T_view_cam = Pose.rotation(seen.R_view_cam)
    off = []
    for pose in (start, truth):
        there = drawn.camera.project((T_view_cam @ pose @ model.T_obj_ctr).apply(lines.points))
        off.append(np.median(np.abs(np.einsum("ni,ni->n", lines.places - there, lines.normals))))
    assert off[1] < 0.5 and off[1] < 0.5 * off[0]


def test_black_surroundings_teach_their_colour_and_black_parts_are_followed() -> None:
    view, truth = black_backdrop()
    model, renderer = bracket(), Renderer()
    [seen], [drawn] = crops(View(view.image, CAMERA), model, model.hull_ctr, [truth], (160, 120), renderer)
    assert drawn.mask is not None
    colours = learn(seen, drawn.mask, np.ones_like(drawn.mask))
    assert colours.outside[0] > 0.1, "black is the ground's"
    # stripes of pure black on the object are part of it
    striped = np.where((np.arange(160) // 6 % 2 == 0)[None, :, None], seen.image, 0).astype(np.uint8)
    shown = View(striped, seen.camera, R_view_cam=seen.R_view_cam)
    T_view_ctr = Pose.rotation(seen.R_view_cam) @ truth @ model.T_obj_ctr
    keyframe = Keyframe(shown, drawn, T_view_ctr, np.ones_like(drawn.mask))
    points = follow_points(keyframe, T_view_ctr, shown, model)
    assert points is not None and len(points.points) >= 10


def test_an_undistorted_photograph_says_where_it_shows_nothing(tmp_path: Path) -> None:
    """Black in the photograph is shown; what undistortion adds is not."""
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((480, 640, 3), np.uint8))
    (tmp_path / "c.json").write_text(
        json.dumps({"fx": 500, "fy": 500, "cx": 320, "cy": 240, "width": 640, "height": 480, "dist": [-0.3, 0.1, 0, 0]})
    )
    view = load_view(tmp_path / "black.png", tmp_path / "c.json")
    assert view.lens is not None and view.valid is not None
    assert 0.5 < view.valid.mean() < 1 and view.valid[view.camera.height // 2, view.camera.width // 2]
    [frame] = open_frames(str(tmp_path), tmp_path / "c.json")
    assert frame.valid is not None
    np.testing.assert_array_equal(frame.valid, view.valid)
