"""Training data of the matching MV-Net: rendered views of a mesh, and crops of rough boxes.

A query is the crop of a disturbed box, rendered as it is and photographed badly when it is drawn; it is compared with
templates of a `view_bank.ViewBank`. Lengths are in diameters of the object, points in its centred frame. Every random
number comes from the generator given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from posekit.camera import Box, Camera
from posekit.first_pose.view_bank import ViewBank
from posekit.geometry import Pose, fibonacci_sphere, random_rotation, rotation_between
from posekit.mesh.model import ObjectModel
from posekit.nets.mvnet import CELL, GRID, NONE
from posekit.render import Renderer
from posekit.synth.appearance import WASHED_OUT, washed_out
from posekit.synth.light import random_light
from posekit.train.data.augment import AugmentConfig, composed
from posekit.zoom import zoom_to_box

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Rng = np.random.Generator


@dataclass(frozen=True)
class QueryConfig:
    """How MV-Net's samples are drawn."""

    crop: tuple[int, int] = (128, 96)  # (width, height)
    enlarge: float = 1.35  # the crop's size in boxes
    views: int = 42  # directions;
    drawn: int = 20  # those of them that a training bank renders
    templates: int = 32  # in a group, of one mesh
    kept: int = 8  # of these, compared closely with a query;
    nearest: int = 3  # those among them nearest to the truth
    queries: int = 8  # in a group
    absent: float = 0.25  # share of the queries that do not show the mesh;
    empty: float = 0.2  # share of these that show no other object either
    distance: tuple[float, float] = (3.0, 14.0)  # range in diameters
    box: float = 0.25  # how far a box is shifted and scaled at most, in its size
    cut: float = 0.15  # share of the boxes that lack up to 40 % at one side, as where something hides it
    plain: float = 0.33  # share of meshes whose views, and plain_scene: of objects that, have other colours or none
    plain_scene: float = 0.1
    tolerance: float = 0.06  # how near a point of the surface must be to count as the same, in diameters
    # swing_deg, twist_deg: standard deviations of what counts as near, of directions and of turns
    swing_deg: float = 18.0
    twist_deg: float = 35.0

    @property
    def cells(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.crop[1] // CELL, self.crop[0] // CELL


@dataclass(frozen=True, eq=False)
class QueryScene:
    """An object in the crop of a rough box, before augmentation. rgba: uint8 (H, W, 4). coords: float32 (h, w, 3), the
    point at each cell's centre, and on: bool (h, w), whether there is one. amodal: bool (H/4, W/4). T_crop_ctr: the
    true pose, metres. R: (3, 3), its rotation as seen along the ray to the object. camera: the crop's."""

    rgba: Image
    coords: NDArray[np.float32]
    on: NDArray[np.bool_]
    amodal: NDArray[np.bool_]
    T_crop_ctr: Pose
    R: Array
    camera: Camera


@dataclass(frozen=True, eq=False)
class QuerySample:
    """A query and its targets for k templates of a group of K. observed: uint8 (H, W, 3). chosen: int64 (k,), in the
    group. cell: int64 (k, h * w), 64 = none. offset: float32 (k, 2, h * w), from the cell's middle in cells. turn:
    float32 (k, 2), cosine and sine of the turn in the picture from template to query. facing: (k,), cosine between
    directions of view. near: (k,) and near_all: (K,), 1 = the template is the truth. silhouettes: bool (2, H/4, W/4),
    visible and amodal. presence: 1 or 0; without, only the silhouettes mean anything."""

    observed: Image
    chosen: NDArray[np.int64]
    cell: NDArray[np.int64]
    offset: NDArray[np.float32]
    turn: NDArray[np.float32]
    facing: NDArray[np.float32]
    near: NDArray[np.float32]
    near_all: NDArray[np.float32]
    silhouettes: NDArray[np.bool_]
    presence: float


@dataclass(frozen=True, eq=False)
class QueryGroup:
    """Queries compared with one mesh. views: uint8 (K, 64, 64, 4)."""

    views: Image
    samples: list[QuerySample]


def training_bank(
    model: ObjectModel, renderer: Renderer, config: QueryConfig, rng: Rng, around: Sequence[QueryScene] = ()
) -> ViewBank:
    """A bank for `draw_queries`; a share of them has wrong colours or none.

    around: where given, only config.drawn of the directions are drawn, those nearest to the scenes' first.
    """
    coloured = washed_out(model, str(rng.choice(WASHED_OUT)), rng) if rng.random() < config.plain else model
    directions = fibonacci_sphere(config.views)
    if len(around):
        directions = directions[_near_directions(directions, around, config, rng)]
    return ViewBank.of(model, renderer, directions, coloured)


def _near_directions(
    directions: Array, scenes: Sequence[QueryScene], config: QueryConfig, rng: Rng
) -> NDArray[np.int64]:
    """config.drawn of the directions: the nearest of each scene, then their second nearest, and random ones."""
    facing = -np.stack([s.R[2] for s in scenes]) @ directions.T
    wanted = np.argsort(-facing, axis=1)[:, :2].T.ravel()
    order = list(dict.fromkeys([int(i) for i in wanted] + [int(i) for i in rng.permutation(len(directions))]))
    return np.array(order[: config.drawn], dtype=np.int64)


def rough_box(box: Box, config: QueryConfig, rng: Rng) -> Box:
    """A box (edges) as a person or a detector might draw it."""
    low, high = np.array(box[:2]), np.array(box[2:])
    if rng.random() < config.cut:
        axis, lost = int(rng.integers(2)), float(rng.uniform(0.0, 0.4)) * (high - low)
        if rng.random() < 0.5:
            low[axis] += lost[axis]
        else:
            high[axis] -= lost[axis]
    size = high - low
    strength = config.box * rng.random()
    centre = 0.5 * (low + high) + strength * rng.uniform(-1, 1, size=2) * size
    half = 0.5 * size * (1 + strength * rng.uniform(-1, 1, size=2))
    return (
        float(centre[0] - half[0]),
        float(centre[1] - half[1]),
        float(centre[0] + half[0]),
        float(centre[1] + half[1]),
    )


def render_queries(
    renderer: Renderer, model: ObjectModel, count: int, config: QueryConfig, rng: Rng
) -> list[QueryScene]:
    """At most ``count`` crops of an object from all sides; those in which hardly anything is seen are left out."""
    coloured = washed_out(model, str(rng.choice(WASHED_OUT)), rng) if rng.random() < config.plain_scene else model
    whole = Camera.from_fov(0.8, 640, 480)
    outline = model.hull_ctr
    poses, cameras = [], []
    for _ in range(count):
        distance = model.diameter * float(np.exp(rng.uniform(*np.log(config.distance))))
        pose = Pose(random_rotation(rng), np.array([0.0, 0.0, distance]))
        zoom = zoom_to_box(whole, rough_box(whole.points_box(pose.apply(outline)), config, rng), config.crop,
                           enlarge=config.enlarge)  # fmt: skip
        poses.append(Pose.rotation(zoom.R_view_cam) @ pose)
        cameras.append(zoom.camera)
    T_ctr_obj = model.T_ctr_obj
    placed = [pose @ T_ctr_obj for pose in poses]
    drawn = renderer.render(coloured, placed, cameras, light=[random_light(rng) for _ in range(count)], coords=False)
    h, w = config.cells
    cells = renderer.render(model, placed, [c.resized(w, h) for c in cameras], rgb=False)
    scenes = []
    for pose, camera, crop, cell in zip(poses, cameras, drawn, cells, strict=True):
        on = np.asarray(cell.mask)
        if on.sum() < 6:
            continue
        rgba = np.dstack([crop.image, np.asarray(crop.mask).astype(np.uint8) * 255])
        coords = ((np.asarray(cell.coords) - model.center) / model.diameter * on[..., None]).astype(np.float32)
        R = rotation_between(pose.t, [0.0, 0.0, 1.0]) @ pose.R
        amodal = _shrunk(np.asarray(crop.mask), (config.crop[1] // 4, config.crop[0] // 4))
        scenes.append(QueryScene(rgba, coords, on, amodal, pose, R, camera))
    return scenes


@dataclass(frozen=True, eq=False)
class Relation:
    """From K templates to a query. facing: (K,), cosine between the directions of view. turn: (K, 2), cosine and sine
    of the turn in the picture. near: (K,), 1 = the same."""

    facing: Array
    turn: Array
    near: Array

    @classmethod
    def of(cls, R_query: Array, R_templates: Array, config: QueryConfig) -> Relation:
        """From rotations ``R_cam_obj`` of a query (3, 3) and of K templates (K, 3, 3)."""
        between = R_query @ R_templates.transpose(0, 2, 1)
        turn = np.stack([between[:, 0, 0] + between[:, 1, 1], between[:, 1, 0] - between[:, 0, 1]], axis=1)
        turn /= np.linalg.norm(turn, axis=1, keepdims=True).clip(1e-9)
        facing = between[:, 2, 2].clip(-1, 1)
        swing, twist = np.rad2deg(np.arccos(facing)), np.rad2deg(np.arctan2(turn[:, 1], turn[:, 0]))
        near = np.exp(-0.5 * ((swing / config.swing_deg) ** 2 + (twist / config.twist_deg) ** 2))
        return cls(facing, turn, near)


def draw_queries(
    bank: ViewBank,
    scenes: Sequence[QueryScene],
    others: Sequence[Image],
    photos: Sequence[Image],
    config: QueryConfig,
    rng: Rng,
    negatives_from: Sequence[QueryScene],
    augment: AugmentConfig = AugmentConfig(),
) -> QueryGroup:
    """A group of config.queries queries for one mesh.

    scenes: of the bank's object; where there are none, no query shows it. others: RGBA crops of other objects, for
    clutter and occluders. negatives_from: scenes of other objects, which the mesh is not; where there are none, queries
    without the mesh show clutter at most.
    """
    R_templates = bank.template_rotations
    shown = [None if not len(scenes) or rng.random() < config.absent else scenes[int(rng.integers(len(scenes)))]
             for _ in range(config.queries)]  # fmt: skip
    relations = [None if s is None else Relation.of(s.R, R_templates, config) for s in shown]
    group = _group([r.near for r in relations if r is not None], len(R_templates), config, rng)
    samples = []
    for scene, relation in zip(shown, relations, strict=True):
        if scene is None or relation is None:
            samples.append(_absent(negatives_from, others, photos, config, augment, rng))
        else:
            samples.append(_present(bank, group, scene, relation, (others, photos), config, augment, rng))
    return QueryGroup(bank.templates(group), samples)


def _group(nears: Sequence[Array], count: int, config: QueryConfig, rng: Rng) -> NDArray[np.int64]:
    """Templates for a group: those nearest to its queries, and random ones."""
    wanted = [int(i) for near in nears for i in np.argsort(-near)[: config.nearest]]
    found = list(dict.fromkeys(wanted))[: config.templates]
    taken = set(found)
    found += [int(i) for i in rng.permutation(count) if int(i) not in taken][: config.templates - len(found)]
    return np.array(found, dtype=np.int64)[rng.permutation(len(found))]


def _present(
    bank: ViewBank,
    group: NDArray[np.int64],
    scene: QueryScene,
    relation: Relation,
    surroundings: tuple[Sequence[Image], Sequence[Image]],
    config: QueryConfig,
    augment: AugmentConfig,
    rng: Rng,
) -> QuerySample:
    picture, hidden = composed(scene.rgba, *surroundings, augment, rng)
    near = relation.near[group]
    first = np.argsort(-near)
    rest = rng.permutation(first[config.nearest :])[: config.kept - config.nearest]
    chosen = np.concatenate([first[: config.nearest], rest]).astype(np.int64)
    visible = scene.on & ~_shrunk(hidden, scene.on.shape)
    cell, offset = match_targets(bank, group[chosen], scene.coords, visible, config.tolerance)
    amodal = scene.amodal
    silhouettes = np.stack([amodal & ~_shrunk(hidden, amodal.shape), amodal])
    which = group[chosen]
    return QuerySample(picture, chosen, cell, offset, relation.turn[which].astype(np.float32),
                       relation.facing[which].astype(np.float32), near[chosen].astype(np.float32),
                       near.astype(np.float32), silhouettes, 1.0)  # fmt: skip


def _absent(scenes: Sequence[QueryScene], others: Sequence[Image], photos: Sequence[Image], config: QueryConfig,
            augment: AugmentConfig, rng: Rng) -> QuerySample:  # fmt: skip
    W, H = config.crop
    rgba = np.zeros((H, W, 4), np.uint8)
    if len(scenes) and rng.random() >= config.empty:
        rgba = scenes[int(rng.integers(len(scenes)))].rgba
    picture, _ = composed(rgba, others, photos, augment, rng)
    k, n = config.kept, config.cells[0] * config.cells[1]
    zero = np.zeros(k, np.float32)
    return QuerySample(picture, rng.permutation(config.templates)[:k].astype(np.int64),
                       np.full((k, n), NONE, np.int64), np.zeros((k, 2, n), np.float32), np.zeros((k, 2), np.float32),
                       zero, zero, np.zeros(config.templates, np.float32), np.zeros((2, H // 4, W // 4), bool),
                       0.0)  # fmt: skip


def match_targets(
    bank: ViewBank, templates: NDArray[np.int64], coords: NDArray[np.float32], visible: NDArray[np.bool_],
    tolerance: float,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:  # fmt: skip
    """For the cells of a crop, coords (h, w, 3), of which ``visible`` (h, w) show the object: the cell of each of k
    templates, int64 (k, h * w), 64 = none, and the place within, float32 (k, 2, h * w)."""
    which = np.flatnonzero(visible)
    points = coords.reshape(-1, 3)[which].astype(np.float64)
    cell = np.full((len(templates), visible.size), NONE, np.int64)
    offset = np.zeros((len(templates), 2, visible.size), np.float32)
    pixels, seen = bank.locate(points, templates, tolerance)
    place = ((pixels + 0.5) / CELL).clip(0, GRID - 1e-6)
    at = np.floor(place).astype(np.int64)
    cell[:, which] = np.where(seen, at[..., 1] * GRID + at[..., 0], NONE)
    offset[:, :, which] = np.where(seen[..., None], place - at - 0.5, 0.0).transpose(0, 2, 1)
    return cell, offset


def _shrunk(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Where most of a mask's pixels are set, at a smaller size (rows, columns)."""
    return cv2.resize(mask.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_AREA) > 0.5


def collate_queries(groups: Sequence[QueryGroup]) -> dict[str, Tensor]:
    """n groups, B queries: mv_observed uint8 (B, H, W, 3); mv_views uint8 (n, K, 64, 64, 4); mv_object int64 (B,), the
    query's group; mv_chosen int64 (B, k); mv_cell int64 (B, k, h * w); mv_offset (B, k, 2, h * w); mv_turn (B, k, 2);
    mv_facing, mv_near (B, k); mv_near_all (B, K); mv_silhouettes bool (B, 2, H/4, W/4); mv_presence (B,)."""
    samples = [s for group in groups for s in group.samples]
    names = ("observed", "chosen", "cell", "offset", "turn", "facing", "near", "near_all", "silhouettes")
    batch = {f"mv_{name}": torch.from_numpy(np.stack([getattr(s, name) for s in samples])) for name in names}
    batch["mv_views"] = torch.from_numpy(np.stack([group.views for group in groups]))
    batch["mv_object"] = torch.tensor([n for n, group in enumerate(groups) for _ in group.samples])
    batch["mv_presence"] = torch.tensor([s.presence for s in samples], dtype=torch.float32)
    return batch
