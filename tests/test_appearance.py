"""What an object was seen to look like, in place of its mesh's colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from posekit.geometry import Pose, so3_exp
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.tracking.appearance import APART, MISSED, MOST, SETTLED, Appearance, colours_agree
from test_track import looked, parcel, path, photograph


def plain(model: ObjectModel) -> ObjectModel:
    return replace(model, colors=None, uvs=None, texture=None)


def learned(model: ObjectModel, renderer: Renderer, *poses: Pose) -> Appearance:
    """From photographs of the model, with a mesh without colours."""
    appearance = Appearance(model.center, model.diameter)
    for pose in poses:
        at = looked(photograph(renderer, model, pose), plain(model), renderer, pose)
        appearance.keep(at.seen, at.drawn, at.T_view_ctr, at.visible)
    return appearance


def turned(model: ObjectModel, degrees: float) -> Pose:
    there = path(model, 0) @ model.T_obj_ctr
    return Pose(so3_exp([0.0, np.deg2rad(degrees), 0.0]) @ there.R, there.t) @ model.T_ctr_obj


@pytest.mark.parametrize("degrees", [0.0, 12.0])
def test_a_mesh_without_colours_is_drawn_as_the_video_showed_it(renderer: Renderer, degrees: float) -> None:
    model = parcel()
    at = looked(photograph(renderer, model, turned(model, degrees)), plain(model), renderer, turned(model, degrees))
    image, known = learned(model, renderer, path(model, 0)).painted(at.drawn, at.T_view_ctr)
    assert at.drawn.mask is not None and known[at.drawn.mask].mean() > 0.6 and not known[~at.drawn.mask].any()
    assert (image[~known] == at.drawn.image[~known]).all()
    off, before = (np.abs(i[known].astype(int) - at.seen.image[known]).mean() for i in (image, at.drawn.image))
    assert off < 15 and off < 0.4 * before


def test_sides_that_were_not_seen_are_not_painted(renderer: Renderer) -> None:
    model = parcel()
    one, both = (learned(model, renderer, *[turned(model, d) for d in angles]) for angles in ([0], [0, 180]))
    at = looked(photograph(renderer, model, turned(model, 180)), plain(model), renderer, turned(model, 180))
    seen_once, seen_twice = (each.painted(at.drawn, at.T_view_ctr)[1][at.drawn.mask].mean() for each in (one, both))
    assert seen_once < 0.5 * seen_twice and seen_twice > 0.6


def test_what_hides_the_object_is_not_learned(renderer: Renderer) -> None:
    model = parcel()
    at = looked(photograph(renderer, model, path(model, 0)), plain(model), renderer, path(model, 0))
    appearance = Appearance(model.center, model.diameter)
    assert at.drawn.mask is not None
    columns = np.nonzero(at.drawn.mask)[1]
    left = np.broadcast_to(np.arange(160) < np.quantile(columns, 0.7), (120, 160))
    appearance.keep(at.seen, at.drawn, at.T_view_ctr, left)
    _, known = appearance.painted(at.drawn, at.T_view_ctr)
    assert known.any() and not known[~left].any()
    appearance.keep(at.seen, at.drawn, at.T_view_ctr, np.broadcast_to(np.arange(160) < columns.min() + 5, (120, 160)))
    assert len(appearance.looks) == 1, "hidden for the most part"


def test_what_hid_the_object_is_forgotten(renderer: Renderer) -> None:
    model = parcel()
    at = looked(photograph(renderer, model, path(model, 0)), plain(model), renderer, path(model, 0))
    appearance = learned(model, renderer, path(model, 0))
    left = np.broadcast_to(np.arange(160) < 80, (120, 160))
    for k in range(2 * MISSED):
        _, known = appearance.painted(at.drawn, at.T_view_ctr)
        assert known[left].any() == (k < MISSED) and known[~left].any()
        appearance.compare(left, ~left)
    appearance = learned(model, renderer, path(model, 0))
    for other in [left, left, left, ~left] * 2:  # not in a row
        _, known = appearance.painted(at.drawn, at.T_view_ctr)
        appearance.compare(other, ~left)
    assert known[left].any()


def test_kept_views_are_apart_and_few(renderer: Renderer) -> None:
    model = parcel()
    appearance = learned(model, renderer, path(model, 0))
    step = np.rad2deg(APART)
    there = [turned(model, degrees) @ model.T_obj_ctr for degrees in (0.5 * step, 1.5 * step)]
    nothing = np.zeros((120, 160), np.bool_)
    for _ in range(SETTLED):
        assert not any(appearance.wants(pose) for pose in there), "the first frames' poses may be wrong"
        appearance.compare(nothing, nothing)
    assert [appearance.wants(pose) for pose in there] == [False, True]
    at = looked(photograph(renderer, model, path(model, 0)), plain(model), renderer, path(model, 0))
    appearance.painted(at.drawn, at.T_view_ctr)
    assert at.drawn.mask is not None
    appearance.compare(np.zeros_like(at.drawn.mask), at.drawn.mask)
    assert not appearance.wants(there[0])
    appearance.looks[0].points[:, :80] = np.nan
    appearance.painted(at.drawn, at.T_view_ctr)
    appearance.compare(np.zeros_like(at.drawn.mask), at.drawn.mask)
    assert appearance.wants(there[0]), "half of what is seen was hidden then"
    first = appearance.looks[0]
    appearance.looks *= MOST
    assert not appearance.wants(there[0]) and appearance.wants(there[1])
    at = looked(photograph(renderer, model, turned(model, 40)), plain(model), renderer, turned(model, 40))
    appearance.keep(at.seen, at.drawn, at.T_view_ctr, at.visible)
    assert len(appearance.looks) == MOST and appearance.looks[0] is first
    assert appearance.looks[-1].image is at.seen.image


def test_wrong_colours_are_told(renderer: Renderer) -> None:
    model = parcel()
    view = photograph(renderer, model, path(model, 0))
    assert model.colors is not None
    magenta = np.full_like(model.colors, (170, 40, 150))
    brighter = np.clip(1.3 * model.colors + 15, 0, 255).astype(np.uint8)
    for colors, right in ((model.colors, True), (brighter, True), (magenta, False), (model.colors[::-1], False)):
        at = looked(view, replace(model, colors=colors), renderer, path(model, 0))
        assert colours_agree(at.seen, at.drawn, at.visible) == right
