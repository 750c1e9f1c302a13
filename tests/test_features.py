"""Local features: textured boxes at known poses, several instances, meshes without texture, and the cache."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from objects import CAMERA, bracket, cuboid
from posekit.detect.novel import make_detector
from posekit.first_pose import features
from posekit.first_pose.features import VERSION, FeatureModel, FeatureSearch
from posekit.geometry import Pose, random_rotation, rotation_angle
from posekit.io import array_cache
from posekit.mesh import cache as mesh_cache
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer
from posekit.view import View


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory):  # type: ignore[no-untyped-def]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def textured(seed: int = 0) -> ObjectModel:
    """A box of 0.16 x 0.12 x 0.08 m away from its origin, each side with a picture of its own."""
    vertices, faces = cuboid((0.02, 0.01, 0.0), (0.18, 0.13, 0.08))
    corners = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    uvs = np.concatenate([(corners * 0.9 + 0.05 + [k % 3, k // 3]) / [3, 2] for k in range(6)])
    return ObjectModel.from_arrays(vertices, faces, name="box", uvs=uvs, texture=print_(seed, (768, 512)))


def print_(seed: int, size: tuple[int, int]) -> np.ndarray:
    """Letters, discs and patches."""
    rng = np.random.default_rng(seed)
    image = np.full((size[1], size[0], 3), 200, np.uint8)
    for k in range(400):
        at = (int(rng.integers(size[0])), int(rng.integers(size[1])))
        colour = tuple(int(c) for c in rng.integers(0, 256, 3))
        if k % 2:
            cv2.circle(image, at, int(rng.integers(3, 25)), colour, -1)
        else:
            cv2.putText(image, chr(int(rng.integers(65, 91))), at, 0, float(rng.uniform(0.5, 2.0)), colour, 3)
    return image


def photograph(renderer: Renderer, model: ObjectModel, poses: list[Pose]) -> View:
    """The meshes under another light than the features', before a printed wall."""
    image = cv2.GaussianBlur(print_(7, CAMERA.size), (0, 0), 1.0)
    for drawn in renderer.render(model, poses, CAMERA, light=Light(direction=(0.7, -0.3, -0.5), ambient=0.5)):
        image = np.where(drawn.mask[..., None], drawn.image, image)
    return View(cv2.GaussianBlur(image, (0, 0), 0.7), CAMERA)


def at(model: ObjectModel, seed: int, x: float, y: float = 0.0, z: float = 0.7) -> Pose:
    return Pose(random_rotation(np.random.default_rng(seed)), np.array([x, y, z])) @ model.T_ctr_obj


def assert_near(model: ObjectModel, found: Pose, truth: Pose) -> None:
    a, b = found @ model.T_obj_ctr, truth @ model.T_obj_ctr
    assert np.rad2deg(rotation_angle(a.R.T @ b.R)) < 2
    assert np.linalg.norm(a.t - b.t) < 0.01


@pytest.mark.parametrize("boxed", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_textured_box_is_found(renderer: Renderer, seed: int, boxed: bool) -> None:
    model = textured()
    truth = at(model, seed, 0.05 * seed - 0.1, 0.03)
    view = photograph(renderer, model, [truth])
    box = CAMERA.points_box(truth.apply(model.hull_vertices))
    [found] = FeatureSearch(model, renderer).search(view, box if boxed else None)
    assert_near(model, found.T_cam_obj, truth)
    np.testing.assert_allclose(found.box, box, atol=4)
    assert found.inliers >= 15
    assert 0.5 < found.share <= 1
    assert len(found.points) == len(found.pixels) >= found.inliers
    assert np.median(np.linalg.norm(CAMERA.project(truth.apply(found.points)) - found.pixels, axis=1)) < 1.5


def test_two_instances_are_found(renderer: Renderer) -> None:
    model = textured()
    truths = [at(model, 4, -0.15), at(model, 5, 0.15, 0.05, 0.8)]
    found = FeatureSearch(model, renderer).search(photograph(renderer, model, truths))
    assert len(found) == 2
    assert found[0].inliers >= found[1].inliers
    for pose, truth in zip(sorted((f.T_cam_obj for f in found), key=lambda T: (T @ model.T_obj_ctr).t[0]), truths,
                           strict=True):  # fmt: skip
        assert_near(model, pose, truth)


def test_another_box_is_not_taken_for_it(renderer: Renderer) -> None:
    model, other = textured(0), textured(1)
    view = photograph(renderer, other, [at(other, 1, 0.0)])
    assert FeatureSearch(other, renderer).search(view)
    assert FeatureSearch(model, renderer).search(view) == []


def test_a_box_elsewhere_hides_it(renderer: Renderer) -> None:
    model = textured()
    view = photograph(renderer, model, [at(model, 1, -0.2)])
    assert FeatureSearch(model, renderer).search(view, (420.0, 100.0, 600.0, 300.0)) == []


@pytest.mark.parametrize("box", [(700.0, 10.0, 800.0, 50.0), (10.0, 10.0, 12.0, 11.0)])
def test_a_box_outside_or_tiny_shows_nothing(renderer: Renderer, box: tuple[float, float, float, float]) -> None:
    model = textured()
    view = photograph(renderer, model, [at(model, 1, 0.0)])
    assert FeatureSearch(model, renderer).search(view, box) == []


def test_meshes_without_texture_are_not_looked_for(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("the photograph was looked at")

    grey = np.full((512, 768, 3), 120, np.uint8)
    view = photograph(renderer, textured(), [at(textured(), 1, 0.0)])
    monkeypatch.setattr(features, "keypoints_of", refuse)
    for model in (replace(textured(), texture=grey), replace(textured(), texture=None, uvs=None)):
        assert FeatureModel.of(model, renderer).plain
        assert FeatureSearch(model, renderer).search(view) == []


def test_the_same_twice(renderer: Renderer) -> None:
    model = textured()
    image = photograph(renderer, model, [at(model, 2, 0.0)]).image
    [first], [second] = (FeatureSearch(model, renderer).search(View(image, CAMERA)) for _ in range(2))
    np.testing.assert_array_equal(first.T_cam_obj.matrix, second.T_cam_obj.matrix)
    np.testing.assert_array_equal(first.pixels, second.pixels)


def test_points_lie_on_the_mesh_and_the_cache_gives_them_again(
    renderer: Renderer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    model = textured()
    made = FeatureModel.of(model, renderer)
    assert not made.plain
    inside = np.abs(made.points) / (0.5 * model.extents)
    np.testing.assert_allclose(inside.max(axis=1), 1.0, atol=0.02)  # every point on one of the six sides
    monkeypatch.setattr(features, "_extracted", lambda *_: pytest.fail("made a second time"))
    again = FeatureModel.of(model, renderer)
    for name in ("descriptors", "points", "tips", "directions", "plain"):
        np.testing.assert_array_equal(getattr(made, name), getattr(again, name))


def test_another_texture_has_another_file_and_a_damaged_one_is_made_anew(
    renderer: Renderer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    model = textured()
    path = mesh_cache.cache_file("features", model, VERSION)
    assert path != mesh_cache.cache_file("features", textured(1), VERSION)
    assert mesh_cache.cache_file("features", model, VERSION) == mesh_cache.cache_file("features", textured(), VERSION)
    assert tmp_path in path.parents
    path.parent.mkdir(parents=True)
    path.write_bytes(b"no archive")
    assert len(FeatureModel.of(model, renderer).points) > 100
    assert path.stat().st_size > 1000


def test_the_oldest_files_make_room(renderer: Renderer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(array_cache, "KEPT", 2)
    for seed in range(3):
        FeatureModel.of(textured(seed), renderer)
    left = set(mesh_cache.cache_file("features", textured(), VERSION).parent.glob("*.npz"))
    assert left == {
        mesh_cache.cache_file("features", textured(1), VERSION),
        mesh_cache.cache_file("features", textured(2), VERSION),
    }


def test_coloured_vertices_alone_give_nothing_false(renderer: Renderer) -> None:
    view = photograph(renderer, textured(), [at(textured(), 1, 0.0)])
    assert FeatureSearch(bracket(), renderer).search(view) == []


def test_what_texture_shows_is_detected_without_any_proposal(
    renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = textured()
    truth = at(model, 1, 0.0)
    detector, _ = make_detector(None, [model])
    monkeypatch.setattr(detector, "propose", lambda _: [])
    [found] = detector.detect(photograph(renderer, model, [truth]), [model])
    assert (found.source, found.label, found.mask) == ("features", "box", None)
    assert 0.5 <= found.score < 1
    np.testing.assert_allclose(found.box, CAMERA.points_box(truth.apply(model.hull_vertices)), atol=4)
