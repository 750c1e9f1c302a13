"""Scenes of several objects: what is in front, who is who, and that things rest on the table."""

from __future__ import annotations

import numpy as np
import pytest

from objects import bracket
from posekit.errors import ConfigError
from posekit.render import Renderer
from posekit.synth.tabletop import DISTRACTOR, TabletopConfig, compose, procedural_objects, resting_rotation

CONFIG = TabletopConfig(size=(160, 120), objects=(3, 5), distractors=(2, 3))


def test_labels_depth_and_counts_agree_with_a_rendering_of_each_object_alone(renderer: Renderer) -> None:
    rng = np.random.default_rng(3)
    others = procedural_objects(3, rng)
    seen = hidden = 0
    for _ in range(4):
        scene = compose(renderer, [bracket()], CONFIG, rng, distractors=others)
        assert scene.view.depth is not None
        alone = [renderer.render(p.model, [p.T_cam_obj], scene.view.camera)[0] for p in scene.placed]
        for k, (placed, view) in enumerate(zip(scene.placed, alone, strict=True)):
            assert view.mask is not None and view.depth is not None
            mine = scene.mask(k)
            assert not (mine & ~view.mask).any(), "a label lies where the object is not"
            np.testing.assert_allclose(scene.view.depth[mine], view.depth[mine], rtol=1e-4)
            elsewhere = view.mask & ~mine
            assert (scene.view.depth[elsewhere] <= view.depth[elsewhere] * 1.0001).all(), "something farther hides it"
            assert placed.visible_px == mine.sum() and placed.whole_px >= view.mask.sum()
            seen, hidden = seen + int(mine.sum()), hidden + int(elsewhere.sum())
    assert seen > 1000 and hidden > 100


def test_who_is_who(renderer: Renderer) -> None:
    rng = np.random.default_rng(0)
    meshes, others = [bracket(), bracket((0.1, 0.0, 0.0))], procedural_objects(2, rng)
    scenes = [compose(renderer, meshes, CONFIG, rng, distractors=others) for _ in range(5)]
    placed = [p for scene in scenes for p in scene.placed]
    assert {p.number for p in placed} == {0, 1, DISTRACTOR}
    for p in placed:
        assert p.model is meshes[p.number] if p.number >= 0 else p.model in others
        assert 0 <= p.visib_fract <= 1


def test_objects_rest_on_a_facet() -> None:
    rng = np.random.default_rng(1)
    model = bracket()
    for _ in range(20):
        points = (model.hull_ctr) @ resting_rotation(model, rng).T
        lowest = points[:, 2] < points[:, 2].min() + 1e-6
        assert lowest.sum() >= 3, "it balances on a corner"
        low, high = points[lowest, :2].min(0), points[lowest, :2].max(0)
        assert (low <= 1e-6).all() and (high >= -1e-6).all(), "its middle is beside what it stands on"


def test_the_same_seed_gives_the_same_scene(renderer: Renderer) -> None:
    def scene() -> tuple[np.ndarray, np.ndarray]:
        found = compose(renderer, [bracket()], CONFIG, np.random.default_rng(7))
        return found.view.image, found.labels

    (image, labels), (again, labels_again) = scene(), scene()
    np.testing.assert_array_equal(image, again)
    np.testing.assert_array_equal(labels, labels_again)


def test_a_box_lies_round_the_visible_pixels(renderer: Renderer) -> None:
    scene = compose(renderer, [bracket()], CONFIG, np.random.default_rng(2))
    k = int(np.argmax([p.visible_px for p in scene.placed]))
    box = scene.box(k)
    assert box is not None
    rows, columns = np.nonzero(scene.mask(k))
    assert box == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)


def test_nothing_to_show_is_an_error(renderer: Renderer) -> None:
    with pytest.raises(ConfigError, match="needs meshes"):
        compose(renderer, [], CONFIG, np.random.default_rng(0))
    with pytest.raises(ConfigError, match="least first"):
        TabletopConfig(objects=(3, 1))
