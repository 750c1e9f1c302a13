"""First poses: the template search, and MV-Net.

The search renders the mesh from a few hundred directions once, and compares each template, turned in the picture
plane, with the observed crop: how well the silhouettes agree, and how well the colours do once brightness and contrast
are taken out. Nothing in it is learned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Box, Camera, box_mask
from posekit.errors import PromptError
from posekit.first_pose.evidence import Palette, Picture, Silhouettes, Weights
from posekit.geometry import (
    Pose,
    fibonacci_sphere,
    rotation_between,
    so3_exp,
    view_rotation,
)
from posekit.io.array_cache import keep_arrays, read_arrays
from posekit.mesh.cache import cache_file
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer
from posekit.results import Detection
from posekit.view import View
from posekit.zoom import box_window, zoom_to_box

Array = NDArray[np.float64]
FArray = NDArray[np.float32]

TEMPLATE_VERSION = 1  # of what is kept on disk; a change of the views raises it
PLACED_VERSION = 1  # of the silhouettes that are kept; a change of what is done with templates raises it
KEPT_SILHOUETTES = 50  # meshes whose silhouettes are kept, about 4 MB each
KEPT_NAMES = {"masks", "colours", "edges", "normals", "starts", "placed", "made_for"}
TEMPLATE = 64  # side of the box search's templates, pixels
JUDGED = 96  # side of the window in which poses are judged, pixels
FINER = 2  # times as fine as it is compared, a crop is kept
FLAT = 20.0  # a gradient below which brightness says little, in Sobel's units of 8 bits


@dataclass(frozen=True)
class TemplateOptions:
    """How `TemplateSearch` works."""

    views: int = 200  # directions over the sphere
    turns: int = 24  # in-plane rotations
    size: int = 32  # side of the compared patches in pixels
    colour: float = 0.5  # weight of the colour agreement against the silhouettes'
    apart: float = float(np.deg2rad(20.0))  # least angle between two hypotheses


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """T_cam_obj: a first pose. score: higher is better, comparable within one search only."""

    T_cam_obj: Pose
    score: float


@dataclass(frozen=True, eq=False)
class _Patch:
    """A silhouette fitted into a square: mask float32 (s, s); colour float32 (s, s, 3), zero mean and unit
    variance inside the mask, zero outside. centre: (2,) the box's centre and half: half its longer side, in the
    source picture's pixels."""

    mask: FArray
    colour: FArray
    centre: Array
    half: float


def _patch(image: NDArray[np.uint8], mask: NDArray[np.uint8], size: int, turn: float = 0.0) -> _Patch | None:
    """The masked object, turned by ``turn`` radians (clockwise in the picture), fitted into a square of ``size``."""
    points = cv2.findNonZero(mask)
    if points is None:
        return None
    uv = points.reshape(-1, 2).astype(np.float64)
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s], [s, c]])
    turned = uv @ R.T
    low, high = turned.min(0), turned.max(0)
    half = 0.5 * float((high - low).max() + 1)
    middle = 0.5 * (low + high)
    scale = 0.5 * size / half
    # from source pixels to patch pixels: turn, move the box's middle to the patch's, scale
    M = np.zeros((2, 3))
    M[:, :2] = scale * R
    M[:, 2] = 0.5 * (size - 1) - scale * middle
    flags = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    soft = cv2.warpAffine(mask.astype(np.float32), M, (size, size), flags=flags) > 0.5
    colour = cv2.warpAffine(image, M, (size, size), flags=flags).astype(np.float32)
    if soft.sum() < 8:
        return None
    inside = colour[soft]
    colour = (colour - inside.mean(0)) / (inside.std() + 4.0)
    colour[~soft] = 0
    return _Patch(soft.astype(np.float32), colour, middle @ R, half)


def template_views(model: ObjectModel, renderer: Renderer, count: int) -> list[View]:
    """The mesh from ``count`` directions spread over the sphere, each with its mask: from the user's cache, else
    rendered and kept there."""
    _, camera = _template_camera(model)
    file = cache_file(f"templates-{count}", model, TEMPLATE_VERSION)
    kept = read_arrays(file)
    shape = (count, TEMPLATE, TEMPLATE)
    if kept is not None and set(kept) == {"images", "masks"} and kept["masks"].shape == shape:
        return [View(image, camera, mask) for image, mask in zip(kept["images"], kept["masks"], strict=True)]
    views = _rendered(model, renderer, count, camera)
    masks = np.stack([np.asarray(view.mask, np.bool_) for view in views])
    keep_arrays(file, {"images": np.stack([view.image for view in views]), "masks": masks})
    return views


def _template_camera(model: ObjectModel) -> tuple[float, Camera]:
    """The distance of the templates' camera, metres, and the camera."""
    distance = 4.0 * model.diameter
    focal, middle = 0.9 * TEMPLATE * distance / model.diameter, 0.5 * TEMPLATE - 0.5
    return distance, Camera(focal, focal, middle, middle, TEMPLATE, TEMPLATE)


def _rendered(model: ObjectModel, renderer: Renderer, count: int, camera: Camera) -> list[View]:
    distance, _ = _template_camera(model)
    rotations = [view_rotation(d) for d in fibonacci_sphere(count)]
    poses = [Pose(R, np.array([0, 0, distance])) @ model.T_ctr_obj for R in rotations]
    return renderer.render(model, poses, camera, light=Light(), coords=False)


class FirstPoseSearch(Protocol):
    """Whatever gives first poses for a detection."""

    def search(self, view: View, detection: Detection, count: int) -> list[Hypothesis]:
        """At most ``count`` ``T_cam_obj``, best first."""


class TemplateSearch:
    """First poses by comparison with rendered templates; the templates are made once per mesh."""

    def __init__(self, model: ObjectModel, renderer: Renderer, options: TemplateOptions = TemplateOptions()) -> None:
        self.model, self.options = model, options
        self.rotations = [view_rotation(d) for d in fibonacci_sphere(options.views)]
        self.distance, self.camera = _template_camera(model)
        views = template_views(model, renderer, options.views)
        found = [_patch(v.image, _u8(v.mask), options.size) for v in views]
        self.kept = [k for k, patch in enumerate(found) if patch is not None]
        self.patches = [patch for patch in found if patch is not None]
        if not self.patches:
            raise PromptError(f"{model.name} leaves no silhouette from any side: its surface is too thin to search.")
        self.masks = np.stack([p.mask.ravel() for p in self.patches])
        self.colours = np.stack([p.colour.ravel() for p in self.patches])

    def search(self, view: View, detection: Detection, count: int) -> list[Hypothesis]:
        """The best ``count`` first poses for a detection, best first, none nearer to another than ``apart``.

        view: the photograph. detection: its box and, better, its mask; without a mask the filled box is compared.
        """
        zoom = zoom_to_box(view.camera, detection.box, (128, 128), enlarge=1.15)
        mask = detection.mask if detection.mask is not None else box_mask(detection.box, view.camera.size)
        crop = view.with_mask(mask).zoomed(zoom)
        if crop.mask is None or not crop.mask.any():
            return []
        turns = np.arange(self.options.turns) * (2 * np.pi / self.options.turns)
        patches = [_patch(crop.image, _u8(crop.mask), self.options.size, turn) for turn in turns]
        usable = [(turn, patch) for turn, patch in zip(turns, patches, strict=True) if patch is not None]
        if not usable:
            return []
        scores = self._scores([patch for _, patch in usable])  # (turns, templates)
        found: list[Hypothesis] = []
        for flat in np.argsort(-scores, axis=None):
            row, column = np.unravel_index(flat, scores.shape)
            turn, patch = usable[int(row)]
            pose = self._pose(crop, turn, patch, int(column))
            if _is_apart(pose, found, self.model, self.options.apart):
                found.append(Hypothesis(pose, float(scores[row, column])))
            if len(found) == count:
                break
        return found

    def _scores(self, observed: Sequence[_Patch]) -> Array:
        masks = np.stack([p.mask.ravel() for p in observed])
        colours = np.stack([p.colour.ravel() for p in observed])
        both = masks @ self.masks.T
        union = masks.sum(1)[:, None] + self.masks.sum(1)[None] - both
        agreement = colours @ self.colours.T / (3 * np.maximum(both, 1.0))
        return (both / union + self.options.colour * np.clip(agreement, -1, 1)).astype(np.float64)

    def _pose(self, crop: View, turn: float, patch: _Patch, column: int) -> Pose:
        """The template's pose turned back, at the depth and place that the two boxes give (in the photograph)."""
        template = self.patches[column]
        # the observed crop was turned by ``turn`` to look like the template: the object is turned by -turn
        R_turn = so3_exp([0.0, 0.0, -turn])
        R = R_turn @ self.rotations[self.kept[column]]
        size_here = patch.half / crop.camera.fx
        size_there = template.half / self.camera.fx
        depth = self.distance * size_there / size_here
        # the object's centre lies beside its box's centre by this much of the box
        offset = (np.array([self.camera.cx, self.camera.cy]) - template.centre) / template.half * patch.half
        pixel = patch.centre + R_turn[:2, :2] @ offset
        T_view_ctr = Pose(R, crop.camera.backproject(pixel, depth))
        ray_turn = rotation_between([0.0, 0.0, 1.0], T_view_ctr.t)
        T_view_ctr = Pose(ray_turn @ T_view_ctr.R, T_view_ctr.t)  # seen along this ray it looks as the template does
        return Pose.rotation(crop.R_view_cam.T) @ T_view_ctr @ self.model.T_ctr_obj


@dataclass(frozen=True)
class BoxOptions:
    """How `BoxSearch` works."""

    views: int = 200  # directions over the sphere
    turns: int = 24  # in-plane rotations, a multiple of 4
    side: int = 48  # of the compared pictures, pixels;
    root: float = 26.0  # square root of the box's area in them
    aspect: float = 1.42  # factor by which a silhouette's aspect may differ from the box's
    tried: int = 64  # silhouettes that are moved
    apart: float = float(np.deg2rad(20.0))  # least angle between two hypotheses
    weights: Weights = Weights()  # of the evidence


@dataclass(frozen=True)
class _Move:
    """Of a silhouette in its picture: pixels to the side, a factor of its size, a turn (radians)."""

    x: float = 0.0
    y: float = 0.0
    scale: float = 1.0
    turn: float = 0.0

    def matrix(self, side: int) -> Array:
        """(2, 3), of the picture's pixels, about its middle."""
        c, s = self.scale * np.cos(self.turn), self.scale * np.sin(self.turn)
        R, middle = np.array([[c, -s], [s, c]]), np.full(2, 0.5 * side - 0.5)
        return np.column_stack([R, middle + (self.x, self.y) - R @ middle])


@dataclass(frozen=True, eq=False)
class _Placed:
    """How a template lies in the compared picture. view: its number. turn: in the picture's plane, radians. aspect: its
    box's width over height. scale: from the template's pixels. offset: (2,), from its box's middle to the object's
    centre, pixels."""

    view: int
    turn: float
    aspect: float
    scale: float
    offset: Array

    def turned(self) -> _Placed:
        """By a quarter turn clockwise."""
        offset = np.array([-self.offset[1], self.offset[0]])
        return _Placed(self.view, self.turn + 0.5 * np.pi, 1 / self.aspect, self.scale, offset)


def _packed(placed: Sequence[_Placed]) -> Array:
    """(N, 6): view, turn, aspect, scale, offset."""
    return np.array([[each.view, each.turn, each.aspect, each.scale, *each.offset] for each in placed])


def _unpacked(rows: Array) -> list[_Placed]:
    return [
        _Placed(int(view), turn, aspect, scale, np.array([x, y])) for view, turn, aspect, scale, x, y in rows.tolist()
    ]


MOVES = tuple(
    _Move(x, y, scale, turn)
    for x in (-1.5, 0.0, 1.5)
    for y in (-1.5, 0.0, 1.5)
    for scale in (0.94, 1.0, 1.06)
    for turn in (-np.pi / 36, 0.0, np.pi / 36)
)


class BoxSearch:
    """First poses from a box alone: every template's silhouette, laid into the box, is tried as the object's mask.

    The templates are made once per mesh, all with the same area of their boxes; a photograph is zoomed so that the box
    has that area. Evidence of colours and edges says which silhouette the picture shows
    (`posekit.first_pose.evidence`); the best ones are then moved, scaled and turned a little.
    """

    def __init__(self, model: ObjectModel, renderer: Renderer, options: BoxOptions = BoxOptions()) -> None:
        """Raises PromptError where the mesh leaves no silhouette."""
        self.model, self.options, self.weights = model, options, weights_for(model, options.weights)
        self.rotations = [view_rotation(d) for d in fibonacci_sphere(options.views)]
        self.distance, self.camera = _template_camera(model)
        self.placed, first = self._first_quarter(renderer)
        quarters, count = [first], len(first)
        for _ in range(3):
            quarters.append(quarters[-1].turned())
            self.placed += [placed.turned() for placed in self.placed[-count:]]
        self.silhouettes = Silhouettes.joined(quarters)
        self.aspects = np.array([placed.aspect for placed in self.placed])

    def _first_quarter(self, renderer: Renderer) -> tuple[list[_Placed], Silhouettes]:
        """The templates, turned by less than a quarter: from the user's cache, else made and kept there. Raises
        PromptError where the mesh leaves no silhouette."""
        options = self.options
        file = cache_file("silhouettes", self.model, 1000 * TEMPLATE_VERSION + PLACED_VERSION)
        made_for = np.array([options.views, options.turns, options.side, options.root])
        kept = read_arrays(file)
        if kept is not None and set(kept) == KEPT_NAMES and np.array_equal(kept["made_for"], made_for):
            return _unpacked(kept["placed"]), Silhouettes.unpacked(kept, options.side**2)
        views = template_views(self.model, renderer, options.views)
        turns = np.arange(options.turns // 4) * (2 * np.pi / options.turns)
        found = [self._place(k, view, turn) for k, view in enumerate(views) for turn in turns]
        usable = [each for each in found if each is not None]
        if not usable:
            raise PromptError(
                f"{self.model.name} leaves no silhouette from any side: its surface is too thin to search."
            )
        placed = [each for each, _, _ in usable]
        silhouettes = Silhouettes.of([mask for _, mask, _ in usable], [image for _, _, image in usable])
        arrays = silhouettes.packed() | {"placed": _packed(placed), "made_for": made_for}
        keep_arrays(file, arrays, most=KEPT_SILHOUETTES, compressed=False)
        return placed, silhouettes

    def search(self, view: View, detection: Detection, count: int, *, moved: bool = True) -> list[Hypothesis]:
        """The best ``count`` first poses for a detection, best first, none nearer to another than ``apart``.

        view: the photograph. detection: its box; where it has a mask, its overlap with the silhouette counts too.
        moved: whether the best silhouettes are moved, scaled and turned a little, which takes three times as long.
        """
        zoom = box_window(view.camera, detection.box, FINER * self.options.side, self.options.root / self.options.side)
        masked = view.with_mask(detection.mask)
        crop = masked.zoomed(zoom)
        shown = crop.shown
        if not shown.any() or (detection.mask is not None and (crop.mask is None or not crop.mask.any())):
            return []
        palette = Palette(crop.image, shown)
        box = view.camera.box_corner_rays(detection.box) @ zoom.R_view_cam.T
        size = np.ptp(box[:, :2] / box[:, 2:], axis=0)
        different = np.abs(np.log(self.aspects * size[1] / size[0]))
        rows = np.flatnonzero(different < max(np.log(self.options.aspect), different.min() + 1e-6))
        found = self.silhouettes.chosen(rows)
        scores = found.scores(self._picture(crop, shown, palette, _Move()), self.weights)
        best = rows[np.argsort(-scores, kind="stable")[: self.options.tried]]
        if moved:
            moves, scores = self._moved(crop, shown, palette, best)
        else:
            moves, scores = [_Move()] * len(best), np.sort(scores)[::-1][: len(best)]
        return self._apart(crop, best, moves, scores, count)

    def _apart(
        self, crop: View, rows: NDArray[np.intp], moves: Sequence[_Move], scores: FArray, count: int
    ) -> list[Hypothesis]:
        found: list[Hypothesis] = []
        for k in np.argsort(-scores, kind="stable"):
            pose = self._pose(crop, self.placed[rows[k]], moves[k])
            if _is_apart(pose, found, self.model, self.options.apart):
                found.append(Hypothesis(pose, float(scores[k])))
            if len(found) == count:
                break
        return found

    def _moved(
        self, crop: View, shown: NDArray[np.bool_], palette: Palette, rows: NDArray[np.intp]
    ) -> tuple[list[_Move], FArray]:
        """The best of MOVES for each of some silhouettes, and its score."""
        some = self.silhouettes.chosen(rows)
        tried = [some.scores(self._picture(crop, shown, palette, move), self.weights) for move in MOVES]
        table = np.stack(tried)
        best = table.argmax(0)
        return [MOVES[k] for k in best], np.asarray(table.max(0), np.float32)

    def _picture(self, crop: View, shown: NDArray[np.bool_], palette: Palette, move: _Move) -> Picture:
        """The crop as a silhouette that is moved so sees it. crop: FINER times as fine."""
        side = self.options.side
        M = np.zeros((2, 3))
        there = move.matrix(side)
        M[:, :2], M[:, 2] = FINER * there[:, :2], FINER * (there[:, 2] + 0.5) - 0.5
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        image = cv2.warpAffine(crop.image, M, (side, side), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        on, mask = (
            None if each is None else cv2.warpAffine(each.astype(np.float32), M, (side, side), flags=flags) > 0.5
            for each in (shown, crop.mask)
        )
        assert on is not None
        return Picture.of(image, on, palette, mask)

    def _place(
        self, number: int, view: View, turn: float
    ) -> tuple[_Placed, NDArray[np.bool_], NDArray[np.uint8]] | None:
        """A template turned and scaled to the compared picture: how it lies, its mask (H, W) and RGB (H, W, 3)."""
        side = self.options.side
        points = cv2.findNonZero(_u8(view.mask))
        if points is None:
            return None
        c, s = np.cos(turn), np.sin(turn)
        R = np.array([[c, -s], [s, c]])
        turned = points.reshape(-1, 2) @ R.T
        low, high = turned.min(0), turned.max(0)
        width, height = high - low + 1
        scale = float(self.options.root / np.sqrt(width * height))
        M = np.column_stack([scale * R, 0.5 * side - 0.5 - scale * 0.5 * (low + high)])
        mask = cv2.warpAffine(_u8(view.mask).astype(np.float32), M, (side, side), flags=cv2.INTER_LINEAR) > 0.5
        if mask.sum() < 8:
            return None
        image = cv2.warpAffine(view.image, M, (side, side), flags=cv2.INTER_LINEAR)
        offset = scale * (R @ (self.camera.cx, self.camera.cy) - 0.5 * (low + high))
        return _Placed(number, turn, float(width / height), scale, offset), mask, np.asarray(image, np.uint8)

    def _pose(self, crop: View, placed: _Placed, move: _Move) -> Pose:
        """The template's pose at the place and depth where its silhouette was laid (in the photograph)."""
        side = self.options.side
        camera = crop.camera.resized(side, side)
        M = move.matrix(side)
        pixel = M[:, :2] @ (placed.offset + (0.5 * side - 0.5)) + M[:, 2]
        depth = self.distance * camera.fx / (placed.scale * move.scale * self.camera.fx)
        R = so3_exp([0.0, 0.0, placed.turn + move.turn]) @ self.rotations[placed.view]
        t = camera.backproject(pixel, depth)
        T_view_ctr = Pose(rotation_between([0.0, 0.0, 1.0], t) @ R, t)  # along this ray it looks as the template does
        return Pose.rotation(crop.R_view_cam.T) @ T_view_ctr @ self.model.T_ctr_obj


class EvidenceScorer:
    """Evidence for rendered poses in one window of a photograph, so that poses can be compared with each other."""

    def __init__(self, view: View, box: Box, model: ObjectModel, renderer: Renderer, weights: Weights = Weights()):
        """view: the photograph; its mask, where there is one, counts too. box: edges, round what the poses show."""
        self.model, self.renderer, self.weights = model, renderer, weights_for(model, weights)
        self.zoom = box_window(view.camera, box, JUDGED, BoxOptions.root / BoxOptions.side)
        crop = view.zoomed(self.zoom)
        shown = crop.shown
        self.picture = Picture.of(crop.image, shown, Palette(crop.image, shown), crop.mask) if shown.any() else None

    def scores(self, poses: Sequence[Pose]) -> list[float]:
        """Of each ``T_cam_obj``, as `Silhouettes.scores`; 0 for one that shows nothing in the window."""
        if self.picture is None or not poses:
            return [0.0] * len(poses)
        turned = [Pose.rotation(self.zoom.R_view_cam) @ pose for pose in poses]
        drawn = self.renderer.render(self.model, turned, self.zoom.camera, coords=False)
        masks = [np.asarray(each.mask, np.bool_) for each in drawn]
        scores = Silhouettes.of(masks, [each.image for each in drawn]).scores(self.picture, self.weights)
        return [float(score) if mask.any() else 0.0 for score, mask in zip(scores, masks, strict=True)]


def _is_apart(pose: Pose, found: Sequence[Hypothesis], model: ObjectModel, angle: float) -> bool:
    """Whether a ``T_cam_obj`` is further than ``angle`` from all that were found, and from all that look the same."""
    if not found:
        return True
    return bool((model.symmetries.angles(pose.R, np.stack([h.T_cam_obj.R for h in found])) > angle).all())


def perturbed_poses(T_cam_obj: Pose, model: ObjectModel, angle: float) -> list[Pose]:
    """The pose turned by ``angle`` (radians) about the object's centre, towards each corner of a tetrahedron."""
    T_cam_ctr = T_cam_obj @ model.T_obj_ctr
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    turned = [Pose(so3_exp(angle * corner) @ T_cam_ctr.R, T_cam_ctr.t) for corner in corners]
    return [T @ model.T_ctr_obj for T in turned]


def weights_for(model: ObjectModel, weights: Weights) -> Weights:
    """Without the colour agreement for a mesh without colours: its shading depends on a light that nobody knows."""
    return weights if model.coloured else replace(weights, agreement=0.0)


def _u8(mask: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
    assert mask is not None
    return mask.astype(np.uint8)
