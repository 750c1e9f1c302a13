"""Textured meshes found by local features: SIFT of rendered views, matched with a photograph's.

RootSIFT descriptors (Lowe, 2004; Arandjelovic and Zisserman, 2012) of views from all sides, each with its place on the
mesh; a robust PnP (OpenCV's USAC with MAGSAC's score) of the matches gives poses without any training. What a match
says beside its place, the keypoint's size and turn, decides whether it is consistent with a pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.align.pnp import PnpConfig, solve_pnp
from posekit.camera import Box, Camera
from posekit.geometry import Pose, cube_views
from posekit.io.array_cache import keep_arrays, read_arrays
from posekit.mesh.cache import cache_file
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer, centred_poses, view_rotations
from posekit.view import View

Array = NDArray[np.float64]
FArray = NDArray[np.float32]


VERSION = 1  # of what is kept on disk; a change of the views or of the extraction raises it
SIDE = 256  # pixels of a rendered view
FIELD = float(np.deg2rad(30.0))  # of a rendered view
OF_VIEW, OF_PICTURE = 400, 8000  # keypoints at most, the strongest
PLAIN_BELOW = 8  # keypoints of a view, in the median, below which a mesh has too little texture
PICTURE_SIDES = 1280, 1920  # pixels of a whole picture's longer side: small ones are enlarged to the first
BOX_SIDES = 384, 768  # likewise of a box
MOST_ENLARGED = 2.0, 4.0  # of a picture, of a box
BOX_MARGIN = 1.3
MIN_SIMILARITY = 0.8  # cosine of two descriptors of one place of the mesh


@dataclass(frozen=True)
class FeatureOptions:
    """How local features are matched, and what a pose from them needs."""

    ratio: float = 0.85  # of the descriptors' distances to the best and to the second best place of the mesh, at most
    apart: float = 0.1  # of two such places, in diameters
    # of a match, a share of the picture's longer side (or of the box's, where there is one), and error_px, pixels at
    # least
    error: float = 0.004
    error_px: float = 2.0
    size: float = 1.6  # factor between a keypoint's size and the one that the pose gives it
    turn: float = float(np.deg2rad(35.0))  # radians, likewise
    min_matches: int = 8  # least consistent matches at different places
    share: float = 0.3  # of all matches with the mesh's picture area
    spread: float = 0.05  # of the projected mesh's area, within these matches
    instances: int = 5  # at most
    seed: int = 0  # of the robust fit


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Of a picture. descriptors: (P, 128), RootSIFT. pixels: (P, 2), pixel centres. tips: (P, 2), pixels: along the
    keypoint's turn, as long as its size."""

    descriptors: FArray
    pixels: Array
    tips: Array


@dataclass(frozen=True, eq=False)
class FeatureModel:
    """A mesh's features. descriptors: (N, 128), RootSIFT. points: (N, 3), metres in ``ctr``. tips: (N, 3), metres in
    ``ctr``: the keypoint's size and turn. directions: (N, 3), unit, from the mesh's centre to the view that showed it.
    plain: whether the mesh has too little texture to be found by."""

    descriptors: FArray
    points: Array
    tips: Array
    directions: Array
    plain: bool

    @classmethod
    def of(cls, model: ObjectModel, renderer: Renderer) -> FeatureModel:
        """From the user's cache, else from rendered views, which take some seconds and are then kept there."""
        if model.texture is None and model.colors is None:
            none = np.zeros((0, 3))
            return cls(np.zeros((0, 128), np.float32), none, none, none, True)
        file = cache_file("features", model, VERSION)
        kept = _read(file)
        if kept is not None:
            return kept
        raw, points, tips, directions, plain = _extracted(model, renderer)
        arrays: dict[str, NDArray[Any]] = {"raw": raw, "points": points, "tips": tips, "directions": directions}
        keep_arrays(file, arrays | {"plain": np.asarray(plain)})
        return _decoded(raw, points, tips, directions, plain)

    @classmethod
    def of_views(cls, views: Sequence[tuple[View, Pose]]) -> FeatureModel:
        """From at least one picture of the object in a known pose. views: each a View, whose mask is where it shows the
        object and whose depth is the mesh's there, with its ``T_view_ctr``."""
        return _decoded(*_of_views(views))


@dataclass(frozen=True, eq=False)
class FeaturePose:
    """An instance found. inliers: consistent matches at different places. share: of the matches in its part of
    the picture. points: (N, 3), metres in ``obj``; pixels: (N, 2), pixel centres: these matches. box: edges, of the
    projected mesh."""

    T_cam_obj: Pose
    inliers: int
    share: float
    points: Array
    pixels: Array
    box: Box


class FeatureSearch:
    """Finds a mesh in photographs by its texture. features: what is looked for; by default the mesh's, which are made
    at the first search."""

    def __init__(
        self,
        model: ObjectModel,
        renderer: Renderer,
        options: FeatureOptions = FeatureOptions(),
        features: FeatureModel | None = None,
    ) -> None:
        self.model, self.renderer, self.options = model, renderer, options
        self._features = features

    @property
    def features(self) -> FeatureModel:
        """The model's local features, computed at the first call and kept."""
        if self._features is None:
            self._features = FeatureModel.of(self.model, self.renderer)
        return self._features

    def search(self, view: View, box: Box | None = None) -> list[FeaturePose]:
        """The instances, most matches first; at once none where the mesh has too little texture. box: edges, where
        an instance is looked for."""
        known = self.features
        if known.plain:
            return []
        seen = keypoints_of(view, box)
        if len(seen.pixels) < self.options.min_matches:
            return []
        similarity = seen.descriptors @ known.descriptors.T
        found: list[FeaturePose] = []
        while len(found) < self.options.instances:
            rows, columns = self._matches(similarity)
            one = self._instance(view.camera, seen, rows, columns, self._error(view.camera, box))
            if one is None:
                break
            found.append(self._refined(view.camera, seen, similarity, one, self._error(view.camera, box)))
            similarity[self._inside(view.camera, one.T_cam_obj, seen.pixels)] = -1.0
        return sorted(found, key=lambda f: -f.inliers)

    def _error(self, camera: Camera, box: Box | None) -> float:
        """Of a match, pixels at most."""
        options, longer = self.options, float(max(camera.size))
        if box is not None:
            longer = 2.0 * max(box[2] - box[0], box[3] - box[1])
        return max(options.error_px, options.error * longer)

    def _matches(self, similarity: FArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Of the picture's and the mesh's features: each other's best, and clearly better than other places of the
        mesh. similarity: (P, N), cosines."""
        best, back = similarity.argmax(1), similarity.argmax(0)
        rows = np.flatnonzero((back[best] == np.arange(len(best))) & (similarity.max(1) > 0))
        points = self.features.points.astype(np.float32)
        elsewhere = np.empty(len(rows), np.float32)
        for k, row in enumerate(rows):
            other = similarity[row].copy()
            other[((points - points[best[row]]) ** 2).sum(1) < (self.options.apart * self.model.diameter) ** 2] = -1.0
            elsewhere[k] = other.max()
        near = np.maximum(0, 1 - similarity[rows, best[rows]])
        rows = rows[near < self.options.ratio**2 * (1 - elsewhere)]
        return rows, best[rows]

    def _instance(
        self, camera: Camera, seen: Keypoints, rows: NDArray[np.intp], columns: NDArray[np.intp], error: float
    ) -> FeaturePose | None:
        """The instance that most matches agree on; None where too few do."""
        options, known = self.options, self.features
        if len(rows) < options.min_matches:
            return None
        points, pixels = known.points[columns], seen.pixels[rows]
        pose = _robust_pose(points, pixels, camera, error, options.seed)
        for _ in range(2):
            if pose is None:
                return None
            consistent = self._consistent(camera, seen, rows, columns, pose, error)
            if consistent.sum() < options.min_matches:
                return None
            ones = np.ones(int(consistent.sum()))
            pose = solve_pnp(
                points[consistent],
                pixels[consistent],
                ones,
                ones,
                camera,
                pose,
                PnpConfig(min_points=options.min_matches),
            )
        if pose is None or pose.t[2] < 0.5 * self.model.diameter:
            return None
        consistent = self._consistent(camera, seen, rows, columns, pose, error)
        return self._accepted(camera, pose, points, pixels, consistent, error)

    def _consistent(
        self,
        camera: Camera,
        seen: Keypoints,
        rows: NDArray[np.intp],
        columns: NDArray[np.intp],
        T_cam_ctr: Pose,
        error: float,
    ) -> NDArray[np.bool_]:
        """Which matches the pose explains: place, size, turn, and a side of the mesh that it shows."""
        known = self.features
        points = T_cam_ctr.apply(known.points[columns])
        ends = T_cam_ctr.apply(known.points[columns] + known.tips[columns])
        before = (points[:, 2] > 1e-3) & (ends[:, 2] > 1e-3)
        points[~before, 2] = ends[~before, 2] = 1.0
        at, tips = camera.project(points), camera.project(ends) - camera.project(points)
        near = np.linalg.norm(at - seen.pixels[rows], axis=1) < error
        length, wanted = np.linalg.norm(tips, axis=1), np.linalg.norm(seen.tips[rows], axis=1)
        sized = np.abs(np.log((length + 1e-9) / wanted)) < np.log(self.options.size)
        turned = (tips * seen.tips[rows]).sum(1) > np.cos(self.options.turn) * length * wanted
        viewpoint = -T_cam_ctr.R.T @ T_cam_ctr.t
        shown = known.directions[columns] @ (viewpoint / np.linalg.norm(viewpoint)) > 0.3
        return np.asarray(before & near & sized & turned & shown)

    def _refined(
        self, camera: Camera, seen: Keypoints, similarity: FArray, one: FeaturePose, error: float
    ) -> FeaturePose:
        """With all keypoints that the pose explains and whose descriptors are similar, whether or not others are
        too."""
        T_cam_ctr = one.T_cam_obj @ self.model.T_obj_ctr
        inside = np.flatnonzero(self._inside(camera, one.T_cam_obj, seen.pixels))
        pairs = np.argwhere(similarity[inside] > MIN_SIMILARITY)
        if not len(pairs):
            return one
        rows, columns = inside[pairs[:, 0]], pairs[:, 1]
        consistent = self._consistent(camera, seen, rows, columns, T_cam_ctr, error)
        rows, columns = rows[consistent], columns[consistent]
        order = np.argsort(-similarity[rows, columns], kind="stable")  # each keypoint's best only
        first = order[np.unique(rows[order], return_index=True)[1]]
        rows, columns = rows[first], columns[first]
        if len(rows) < one.inliers:
            return one
        points, pixels = self.features.points[columns], seen.pixels[rows]
        size = np.linalg.norm(seen.tips[rows], axis=1)  # a keypoint is placed as exactly as it is small
        better = solve_pnp(points, pixels, np.ones(len(rows)), size / size.min(), camera, T_cam_ctr)
        if better is None:
            return one
        T_cam_obj = better @ self.model.T_ctr_obj
        box = camera.points_box(T_cam_obj.apply(self.model.hull_vertices))
        return replace(one, T_cam_obj=T_cam_obj, points=points + self.model.center, pixels=pixels, box=box)

    def _accepted(
        self, camera: Camera, T_cam_ctr: Pose, points: Array, pixels: Array, consistent: NDArray[np.bool_], error: float
    ) -> FeaturePose | None:
        """As the result where enough matches, spread over the mesh, are consistent with it."""
        T_cam_obj = T_cam_ctr @ self.model.T_ctr_obj
        hull = self._hull(camera, T_cam_obj)
        if hull is None or not consistent.any():
            return None
        chosen = np.flatnonzero(consistent)[_different(pixels[consistent], error)]
        inside = _within(hull, pixels)
        share = float(consistent.sum() / max(1, (inside | consistent).sum()))
        area = float(cv2.contourArea(cv2.convexHull(pixels[chosen].astype(np.float32)))) if len(chosen) > 2 else 0.0
        spread = area / max(1.0, float(cv2.contourArea(hull)))
        options = self.options
        if len(chosen) < options.min_matches or share < options.share or spread < options.spread:
            return None
        outline = T_cam_obj.apply(self.model.hull_vertices)
        places = points[consistent] + self.model.center
        return FeaturePose(T_cam_obj, len(chosen), share, places, pixels[consistent], camera.points_box(outline))

    def _hull(self, camera: Camera, T_cam_obj: Pose) -> FArray | None:
        """The projected mesh's convex hull (N, 1, 2); None where it reaches behind the camera."""
        corners = T_cam_obj.apply(self.model.hull_vertices)
        if corners[:, 2].min() < 1e-3:
            return None
        return np.asarray(cv2.convexHull(camera.project(corners).astype(np.float32)), np.float32)

    def _inside(self, camera: Camera, T_cam_obj: Pose, pixels: Array) -> NDArray[np.bool_]:
        hull = self._hull(camera, T_cam_obj)
        return np.zeros(len(pixels), bool) if hull is None else _within(hull, pixels)


# --- geometry ---------------------------------------------------------------------------------------------------


def _robust_pose(points: Array, pixels: Array, camera: Camera, error: float, seed: int) -> Pose | None:
    """``T_cam_ctr`` by OpenCV's USAC; the same for the same seed."""
    params = cv2.UsacParams()
    params.threshold, params.confidence, params.maxIterations = error, 0.9999, 10000
    params.score, params.sampler = cv2.SCORE_METHOD_MAGSAC, cv2.SAMPLING_UNIFORM
    params.loMethod, params.randomGeneratorState, params.isParallel = cv2.LOCAL_OPTIM_INNER_LO, seed, False
    try:
        fitted, _, turn, t, _ = cv2.solvePnPRansac(points, pixels, camera.K, None, params=params)
    except cv2.error:  # raised for degenerate matches
        return None
    if not fitted or not np.isfinite(turn).all() or not np.isfinite(t).all():
        return None
    return Pose(cv2.Rodrigues(turn)[0], t.ravel())


def _within(hull: FArray, pixels: Array) -> NDArray[np.bool_]:
    return np.array([cv2.pointPolygonTest(hull, (float(u), float(v)), False) >= 0 for u, v in pixels], bool)


def _different(pixels: Array, apart: float) -> NDArray[np.intp]:
    """Indices of one of the pixels in each cell of a grid: keypoints of one corner count once."""
    return np.unique(np.floor(pixels / apart).astype(np.int64), axis=0, return_index=True)[1]


# --- a picture's keypoints --------------------------------------------------------------------------------------


_PICTURES: WeakKeyDictionary[View, Keypoints] = WeakKeyDictionary()


def keypoints_of(view: View, box: Box | None = None) -> Keypoints:
    """Of a photograph, or of a box (edges) in it. Those of the whole photograph are kept as long as the View is."""
    if box is not None:
        return _keypoints(view, box)
    if view not in _PICTURES:
        _PICTURES[view] = _keypoints(view, (0.0, 0.0, float(view.camera.width), float(view.camera.height)))
    return _PICTURES[view]


def _keypoints(view: View, box: Box) -> Keypoints:
    whole = (box[2] - box[0], box[3] - box[1]) == view.camera.size
    longer = max(box[2] - box[0], box[3] - box[1], 1.0)
    (small, large), most = (PICTURE_SIDES, MOST_ENLARGED[0]) if whole else (BOX_SIDES, MOST_ENLARGED[1])
    scale = min(max(small / longer, min(1.0, large / longer)), most)
    x0, y0, x1, y1 = _region(view.camera, box, 1.0 if whole else BOX_MARGIN)
    if x1 - x0 < 8 or y1 - y0 < 8:
        return Keypoints(np.zeros((0, 128), np.float32), np.zeros((0, 2)), np.zeros((0, 2)))
    size = round(scale * (x1 - x0)), round(scale * (y1 - y0))
    part = view.image[y0:y1, x0:x1]
    image = cv2.resize(part, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    camera = view.camera.cropped(x0, y0, x1 - x0, y1 - y0).resized(*size)
    at, tips, raw = _sift(image, OF_PICTURE)
    pixels = view.camera.project(camera.backproject(at))
    ends = view.camera.project(camera.backproject(at + tips))
    return Keypoints(_root(raw), pixels, ends - pixels)


def _region(camera: Camera, box: Box, enlarge: float) -> tuple[int, int, int, int]:
    """A box enlarged, in whole pixels within the picture."""
    middle, half = 0.5 * np.add(box[:2], box[2:]), 0.5 * enlarge * np.subtract(box[2:], box[:2])
    low = np.clip(np.floor(middle - half), 0, camera.size).astype(int)
    high = np.clip(np.ceil(middle + half), 0, camera.size).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _sift(image: NDArray[np.uint8], most: int) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Keypoints of an RGB picture: pixels (P, 2), tips (P, 2), descriptors (P, 128) as OpenCV has them."""
    detector = cv2.SIFT_create(nfeatures=most, contrastThreshold=0.02, enable_precise_upscale=True)
    found, raw = detector.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    if raw is None or not found:
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 128), np.uint8)
    at = np.array([k.pt for k in found], np.float64)
    turn = np.deg2rad([k.angle for k in found])
    tips = np.array([k.size for k in found])[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
    return at, tips, np.clip(np.rint(raw), 0, 255).astype(np.uint8)


def _root(raw: NDArray[np.uint8]) -> FArray:
    """RootSIFT: unit vectors whose cosine is the histograms' Bhattacharyya coefficient."""
    floats = raw.astype(np.float32)
    return np.sqrt(floats / np.maximum(floats.sum(1, keepdims=True), 1.0))


# --- a mesh's features ------------------------------------------------------------------------------------------

_Made = tuple[NDArray[np.uint8], Array, Array, Array, bool]


def _extracted(model: ObjectModel, renderer: Renderer) -> _Made:
    """From 26 views spread evenly and the six sides."""
    camera = Camera.from_fov(FIELD, SIDE, SIDE)
    poses = centred_poses(model, [*view_rotations(26), *cube_views()], camera)
    drawn = renderer.render(model, poses, camera, light=Light.flat())
    return _of_views([(view, T @ model.T_obj_ctr) for T, view in zip(poses, drawn, strict=True)])


def _of_views(views: Sequence[tuple[View, Pose]]) -> _Made:
    made = [_of_view(view, T_view_ctr) for view, T_view_ctr in views]
    raw, points, tips, directions = (np.concatenate(each) for each in zip(*made, strict=True))
    return raw, points, tips, directions, bool(np.median([len(each[0]) for each in made]) < PLAIN_BELOW)


def _of_view(view: View, T_view_ctr: Pose) -> tuple[NDArray[np.uint8], Array, Array, Array]:
    assert view.mask is not None and view.depth is not None
    if not view.mask.any():
        return np.zeros((0, 128), np.uint8), *np.zeros((3, 0, 3))
    image = view.image.copy()
    image[~view.mask] = np.median(image[view.mask], axis=0)  # so that the outline is no strong edge of the texture
    at, tips, raw = _sift(image, OF_VIEW)
    whole = np.rint(at).astype(int).clip(0, np.array(view.camera.size) - 1)
    inside = cv2.distanceTransform(view.mask.astype(np.uint8), cv2.DIST_L2, 5)[whole[:, 1], whole[:, 0]]
    kept = inside > np.maximum(1.5, 0.5 * np.linalg.norm(tips, axis=1))
    at, tips, whole, raw = at[kept], tips[kept], whole[kept], raw[kept]
    depth = view.depth[whole[:, 1], whole[:, 0]]
    T_ctr_view = T_view_ctr.inverse()
    points, ends = (T_ctr_view.apply(view.camera.backproject(p, depth)) for p in (at, at + tips))
    viewpoint = T_ctr_view.t / np.linalg.norm(T_ctr_view.t)
    return raw, points, ends - points, np.broadcast_to(viewpoint, points.shape)


def _decoded(raw: NDArray[np.uint8], points: Array, tips: Array, directions: Array, plain: bool) -> FeatureModel:
    return FeatureModel(_root(raw), points, tips, directions, plain)


def _read(path: Path) -> FeatureModel | None:
    """None where there is none that can be used."""
    kept = read_arrays(path)
    if kept is None or set(kept) != {"raw", "points", "tips", "directions", "plain"}:
        return None
    made = _decoded(kept["raw"], kept["points"], kept["tips"], kept["directions"], bool(kept["plain"]))
    n = len(made.points)
    fits = made.descriptors.shape == (n, 128) and {made.points.shape, made.tips.shape, made.directions.shape} == {
        (n, 3)
    }
    return made if fits else None
