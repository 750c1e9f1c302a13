"""The demo's example and the figures made of an estimate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from posekit.camera import Camera, mask_box
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer
from posekit.results import Detection, Estimate, Source, Step
from posekit.synth.example import Example, bottle, locomotive, make_example, ply
from posekit.view import View
from posekit.visualise import draw, figures


def test_the_locomotive_is_a_toy_of_sensible_size() -> None:
    model = locomotive()
    assert 0.15 < model.diameter < 0.25
    assert model.vertices[:, 2].min() == pytest.approx(0, abs=1e-6)
    assert model.colors is not None
    assert len(np.unique(model.colors, axis=0)) >= 8


def test_the_locomotive_looks_outwards() -> None:
    corners = locomotive().vertices.astype(np.float64)[locomotive().faces]
    volume = np.einsum("ij,ij->", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2]) / 6
    assert volume > 1e-4


def test_the_picture_shows_the_object_at_its_pose(example: Example, renderer: Renderer) -> None:
    assert example.view.camera.size == (640, 480)
    [drawn] = renderer.render(example.model, [example.T_cam_obj], example.view.camera)
    assert drawn.mask is not None
    assert mask_box(drawn.mask) == example.box
    inside = drawn.mask
    difference = np.abs(example.view.image.astype(float) - drawn.image)[inside].mean()
    shifted = np.abs(np.roll(example.view.image, 12, axis=1).astype(float) - drawn.image)[inside].mean()
    assert difference < 0.5 * shifted


def test_the_example_is_the_same_every_time(example: Example, renderer: Renderer) -> None:
    again = make_example(renderer)
    np.testing.assert_array_equal(again.view.image, example.view.image)
    other = make_example(renderer, seed=1)
    assert not np.allclose(other.T_cam_obj.R, example.T_cam_obj.R)


def test_the_bottle_looks_the_same_after_its_symmetry(renderer: Renderer) -> None:
    shown = make_example(renderer, model=bottle())
    turn = shown.model.symmetries.continuous[0].turn(np.deg2rad(36))  # four of the forty segments
    poses = [shown.T_cam_obj, shown.T_cam_obj @ turn]
    drawn, turned = (view.mask for view in renderer.render(shown.model, poses, shown.view.camera))
    assert drawn is not None and turned is not None
    assert mask_box(drawn) == shown.box
    assert (drawn != turned).mean() < 1e-4


def test_a_light_changes_the_object_alone(example: Example, renderer: Renderer) -> None:
    bright = make_example(renderer, light=Light(ambient=0.9, specular=1.6))
    [drawn] = renderer.render(example.model, [example.T_cam_obj], example.view.camera)
    assert drawn.mask is not None
    around = cv2.dilate(drawn.mask.astype(np.uint8), np.ones((41, 41))) > 0  # JPEG's blocks reach beyond the outline
    change = np.abs(bright.view.image.astype(float) - example.view.image).mean(axis=2)
    assert change[drawn.mask].mean() > 20
    assert change[~around].mean() < 1


def test_the_mesh_comes_back_from_its_file(tmp_path: Path) -> None:
    model = locomotive()
    (tmp_path / "toy.ply").write_text(ply(model))
    read = ObjectModel.load(tmp_path / "toy.ply", units="m")
    np.testing.assert_allclose(read.extents, model.extents, atol=1e-6)
    assert len(read.faces) == len(model.faces)
    assert read.colors is not None


def estimate(example: Example, steps: int) -> Estimate:
    trace = tuple(
        Step(Pose(example.T_cam_obj.R, example.T_cam_obj.t + [0.002 * k, 0, 0]), 0.01 * k) for k in range(steps, 0, -1)
    )
    detection = Detection(box=example.box, source=Source.FILLED)
    return Estimate(example.T_cam_obj, 0.01, steps, True, 0.9, example.box, "locomotive", detection, trace)


@pytest.mark.parametrize("steps", [0, 1, 3, 50])
def test_overlay_shows_photograph_enlarged_crop_and_strip(example: Example, renderer: Renderer, steps: int) -> None:
    picture = figures.overlay(renderer, example.view, [(example.model, estimate(example, steps))])
    assert picture.dtype == np.uint8
    assert picture.shape[1] == 640 + 4 + 480
    assert picture.shape[0] > 480 + 60
    changed = (picture[:480, :640] != example.view.image).any(axis=2)
    assert 0.005 < changed.mean() < 0.1
    x0, y0, x1, y1 = (int(v) for v in example.box)
    changed[y0 - 80 : y1 + 80, x0 - 80 : x1 + 80] = False
    assert not changed.any()


def test_the_outline_lies_on_the_silhouettes_edge_to_the_pixel(example: Example, renderer: Renderer) -> None:
    camera, fine = example.view.camera, 8
    [drawn] = renderer.render(example.model, [example.T_cam_obj], camera.resized(fine * 640, fine * 480))
    assert drawn.mask is not None
    covered = drawn.mask.reshape(480, fine, 640, fine).mean(axis=(1, 3))
    grey = np.full_like(example.view.image, 100)
    drawn_line = figures.outlined(renderer, grey, camera, example.model, example.T_cam_obj, (255, 255, 255))
    line = drawn_line[..., 0].astype(float)
    around, cross = np.ones((5, 5)), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    inside = cv2.erode((covered == 1).astype(np.uint8), around) > 0
    outside = cv2.dilate((covered > 0).astype(np.uint8), around) == 0
    assert (line[inside] == 100).all() and (line[outside] == 100).all(), "nothing beyond two pixels of the edge"
    assert (line[covered == 0] <= 100).all(), "the line lies on the object's own outermost pixels"
    edge = (covered > 0.7) & (cv2.erode((covered > 0.7).astype(np.uint8), cross) == 0)
    assert (line[edge] > 130).mean() > 0.95, "without gaps"


def test_the_outline_of_what_lies_partly_or_wholly_outside(example: Example, renderer: Renderer) -> None:
    for shift, seen in (([-0.17, 0, 0], True), ([5.0, 0, 0], False), ([0, 0, -5.0], False)):
        pose = Pose(example.T_cam_obj.R, example.T_cam_obj.t + shift)
        drawn = figures.outlined(renderer, example.view.image, example.view.camera, example.model, pose)
        assert (drawn != example.view.image).any() == seen


def test_what_is_not_reliable_is_red(example: Example, renderer: Renderer) -> None:
    good = estimate(example, 1)
    pictures = [
        figures.overlay(renderer, example.view, [(example.model, each)])[:480, :640]
        for each in (good, replace(good, score=0.1))
    ]
    counts = [[int((p == c).all(axis=-1).sum()) for c in (draw.GREEN, draw.RED)] for p in pictures]
    assert counts[0][0] > 50 > 5 > counts[0][1]
    assert counts[1][1] > 50 > 5 > counts[1][0]


def test_several_objects_are_in_one_picture_and_blended_in_at_choice(example: Example, renderer: Renderer) -> None:
    good = estimate(example, 0)
    other = replace(good, T_cam_obj=Pose(good.T_cam_obj.R, good.T_cam_obj.t + [-0.17, 0, 0]))
    results = [(example.model, good), (example.model, other)]
    one, two, blended = (
        figures.overlay(renderer, example.view, chosen, share)[:480, :640]
        for chosen, share in ((results[:1], 0.0), (results, 0.0), (results, 1.0))
    )
    assert (one != two).any(axis=-1).sum() > 300
    assert np.abs(two[:, :200].astype(int) - blended[:, :200]).max() > 50, "the second one's render shows"


def test_overlay_of_nothing_is_the_photograph(example: Example, renderer: Renderer) -> None:
    np.testing.assert_array_equal(figures.overlay(renderer, example.view, []), example.view.image)


@pytest.mark.parametrize(
    ("size", "shown"), [((64, 48), (640, 480)), ((3200, 2400), (1600, 1200)), ((40, 800), (40, 800))]
)
def test_overlays_suit_a_screen(
    size: tuple[int, int], shown: tuple[int, int], example: Example, renderer: Renderer
) -> None:
    camera = Camera.from_fov(0.9, *size)
    view = View(np.full((size[1], size[0], 3), 90, np.uint8), camera)
    found = Estimate(Pose.translation([0, 0, 0.8]), 0.01, 1, True, 0.9, (0, 0, *size), "locomotive")
    picture = figures.overlay(renderer, view, [(example.model, found)])
    assert picture.shape[0] > shown[1]
    assert shown[0] + 236 < picture.shape[1] <= shown[0] + 484
