"""Scenes of several objects on a table or in a pile, with instance masks: to train detectors on.

Each object is drawn alone, in a tile round it, and the tiles are joined by depth: what is hidden is known exactly.
The table's own frame ``world`` has z up and the table at z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from posekit.camera import Box, Camera, mask_box
from posekit.errors import ConfigError
from posekit.geometry import Pose, random_rotation, rotation_between, so3_exp
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer
from posekit.synth.canvas import Canvas, tile
from posekit.synth.light import random_light
from posekit.synth.procedural import noise_image, photo_crop, random_colour, random_object, random_texture
from posekit.view import View

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Labels = NDArray[np.int16]
Rng = np.random.Generator

TILES = (48, 96, 192, 384, 768)  # sides of the pictures that objects are drawn in, pixels
DISTRACTOR = -1  # the number of what is not one of the objects
TRIES = 20  # places tried for an object on the table


@dataclass(frozen=True)
class TabletopConfig:
    """Lengths in units of the objects' median diameter."""

    size: tuple[int, int] = (640, 480)  # (width, height)
    fov_deg: tuple[float, float] = (35.0, 70.0)  # of the longer side
    # objects, distractors: least and most in a scene
    objects: tuple[int, int] = (1, 8)
    distractors: tuple[int, int] = (0, 6)
    pile: float = 0.3  # share of scenes with objects at random in a heap instead of at rest
    table: float = 0.7  # share with a table; the others float before the backdrop
    photo: float = 0.7  # share of backdrops that are photographs, where there are any
    distance: tuple[float, float] = (3.0, 9.0)  # from the camera to the scene's middle
    elevation_deg: tuple[float, float] = (10.0, 85.0)  # of the camera over the table
    spread: tuple[float, float] = (1.0, 3.0)  # radius in which objects lie
    shadow: float = 0.7  # share of tables with shadows
    paint: float = 1.0  # how far the objects' paint strays from the meshes', 0 = not at all
    scraps: tuple[int, int] = (0, 0)  # least and most parts cut out of photographs behind the objects

    def __post_init__(self) -> None:
        if not 0 <= self.objects[0] <= self.objects[1] or not 0 <= self.distractors[0] <= self.distractors[1]:
            raise ConfigError("a scene's objects and distractors are (least, most), not negative, least first.")
        if not 0 <= self.scraps[0] <= self.scraps[1] or self.paint < 0:
            raise ConfigError("a scene's scraps are (least, most), not negative, least first; its paint not negative.")
        if not 0 < self.distance[0] <= self.distance[1] or not 0 < self.spread[0] <= self.spread[1]:
            raise ConfigError("a scene's distance and spread are (least, most), above 0, least first.")


@dataclass(frozen=True, eq=False)
class Placed:
    """An object in a scene. number: in the given objects, `DISTRACTOR` for others. whole_px: pixels of its whole
    silhouette, hidden parts and those outside the picture too. visible_px: those that are seen."""

    number: int
    model: ObjectModel
    T_cam_obj: Pose
    whole_px: int
    visible_px: int

    @property
    def visib_fract(self) -> float:
        """The visible share, in [0, 1]."""
        return self.visible_px / self.whole_px if self.whole_px else 0.0


@dataclass(frozen=True, eq=False)
class Tabletop:
    """A scene. view: image, camera and depth (0 where nothing but the backdrop is). labels: int16 (H, W), k + 1 where
    placed[k] is seen, 0 elsewhere. light: the scene's, in the camera's frame."""

    view: View
    labels: Labels
    placed: tuple[Placed, ...]
    light: Light

    def mask(self, k: int) -> NDArray[np.bool_]:
        """The visible pixels of placed[k], bool (H, W)."""
        return self.labels == k + 1

    def box(self, k: int) -> Box | None:
        """Round the visible pixels of placed[k], edges; None where nothing of it is seen."""
        return mask_box(self.mask(k))


def compose(
    renderer: Renderer,
    objects: Sequence[ObjectModel],
    config: TabletopConfig,
    rng: Rng,
    *,
    distractors: Sequence[ObjectModel] = (),
    photos: Sequence[Image] = (),
) -> Tabletop:
    """A random scene. objects: to draw from, with repetition. distractors: other meshes to draw from, of about the
    objects' sizes (see `procedural_objects` and `resized`). Raises ConfigError where there are
    neither objects nor distractors."""
    if not len(objects) and not len(distractors):
        raise ConfigError("a scene needs meshes: pass objects or distractors.")
    unit = float(np.median([m.diameter for m in (objects or distractors)]))
    chosen = _chosen(objects, distractors, config, rng)
    table = rng.random() < config.table
    T_world_objs = _arranged([model for _, model in chosen], unit, rng.random() < config.pile, config, rng)
    T_cam_world = _camera_pose(unit, config, rng)
    camera = Camera.from_fov(float(np.deg2rad(rng.uniform(*config.fov_deg))), *config.size)
    light = random_light(rng)
    canvas = Canvas(_backdrop(config, photos, rng))
    if table:
        _draw_table(canvas, camera, renderer, T_cam_world, unit, light, photos, rng)
        if rng.random() < config.shadow:
            _draw_shadows(canvas, camera, [m for _, m in chosen], T_world_objs, T_cam_world, light, rng)
    if len(photos):
        for _ in range(int(rng.integers(config.scraps[0], config.scraps[1] + 1))):
            _lay_scrap(canvas.image, photos, rng)
    found: list[tuple[int, ObjectModel, Pose, int]] = []
    for (number, model), T_world_obj in zip(chosen, T_world_objs, strict=True):
        T_cam_obj = T_cam_world @ T_world_obj
        whole = _add(canvas, len(found) + 1, renderer, model, T_cam_obj, camera, light, config.paint, rng)
        if whole:
            found.append((number, model, T_cam_obj, whole))
    canvas.smooth_edges()
    counts = np.bincount(canvas.labels.ravel(), minlength=len(found) + 1)
    placed = tuple(Placed(*each, visible_px=int(counts[k + 1])) for k, each in enumerate(found))
    return Tabletop(View(canvas.image, camera, depth=canvas.depth), canvas.labels, placed, light)


def procedural_objects(count: int, rng: Rng, photos: Sequence[Image] = (), unit: float = 0.15) -> list[ObjectModel]:
    """Random objects whose diameters scatter about ``unit`` metres as the things on a table do."""
    sizes = unit * np.exp(rng.normal(size=count) * 0.4).clip(0.4, 2.5)
    return [random_object(rng, photos, float(size)) for size in sizes]


def resized(model: ObjectModel, diameter: float) -> ObjectModel:
    """The same mesh with another diameter, metres."""
    scale = np.float32(diameter / model.diameter)
    return ObjectModel.from_arrays(
        model.vertices * scale, model.faces, name=model.name, colors=model.colors, uvs=model.uvs, texture=model.texture
    )


def _chosen(
    objects: Sequence[ObjectModel], distractors: Sequence[ObjectModel], config: TabletopConfig, rng: Rng
) -> list[tuple[int, ObjectModel]]:
    count = int(rng.integers(config.objects[0], config.objects[1] + 1)) if len(objects) else 0
    others = int(rng.integers(config.distractors[0], config.distractors[1] + 1)) if len(distractors) else 0
    if not count + others:
        return []
    chosen = [(int(k), objects[int(k)]) for k in rng.integers(len(objects), size=count)] if count else []
    chosen += [(DISTRACTOR, distractors[int(k)]) for k in rng.integers(len(distractors), size=others)] if others else []
    return chosen


# --- where things are -------------------------------------------------------------------------------------------


def _arranged(models: Sequence[ObjectModel], unit: float, pile: bool, config: TabletopConfig, rng: Rng) -> list[Pose]:
    """``T_world_obj`` of each: at rest side by side, or anyhow in a heap."""
    radius = unit * rng.uniform(*config.spread)
    poses: list[Pose] = []
    taken: list[tuple[Array, float]] = []
    for model in models:
        R = random_rotation(rng) if pile else resting_rotation(model, rng)
        points = (model.hull_ctr) @ R.T
        reach = 0.8 * float(np.linalg.norm(points[:, :2], axis=1).max())
        place = _free_place(taken, reach, radius * (0.6 if pile else 1.0), 0 if pile else TRIES, rng)
        taken.append((place, reach))
        height = -float(points[:, 2].min()) + (unit * rng.uniform(0, 1.2) if pile else 0.0)
        poses.append(Pose(R, np.array([*place, height]) - R @ model.center))
    return poses


def _free_place(taken: Sequence[tuple[Array, float]], reach: float, radius: float, tries: int, rng: Rng) -> Array:
    """A place (2,) on the table that is free, or the last one tried, where it is crowded."""
    place = _on_disc(radius, rng)
    for _ in range(tries):
        if all(np.linalg.norm(place - other) > reach + theirs for other, theirs in taken):
            break
        radius *= 1.05
        place = _on_disc(radius, rng)
    return place


def _on_disc(radius: float, rng: Rng) -> Array:
    angle, r = rng.uniform(0, 2 * np.pi), radius * np.sqrt(rng.random())
    return np.array([r * np.cos(angle), r * np.sin(angle)])


def resting_rotation(model: ObjectModel, rng: Rng) -> Array:
    """``R_world_obj`` (3, 3) of an object that stands on a facet of its convex hull over which its middle lies.

    Facets are chosen by their area; the turn about the vertical is random.
    """
    points = model.hull_ctr
    normals, areas = _stable_facets(points)
    down = normals[int(rng.choice(len(areas), p=areas / areas.sum()))] if len(areas) else rng.normal(size=3)
    spin = so3_exp([0.0, 0.0, float(rng.uniform(0, 2 * np.pi))])
    # over by half a turn first where it points up: there is no one shortest rotation to the opposite
    over = np.diag([1.0, -1.0, -1.0]) if down[2] > 0 else np.eye(3)
    return spin @ rotation_between(over @ down, [0.0, 0.0, -1.0]) @ over


def _stable_facets(points: Array) -> tuple[Array, Array]:
    """Outward normals (N, 3) and areas (N,) of the hull's triangles that hold the origin's projection onto them."""
    try:
        hull = ConvexHull(points)
    except QhullError:  # flat
        return np.zeros((0, 3)), np.zeros(0)
    normals = hull.equations[:, :3]
    corners = points[hull.simplices]  # (N, 3, 3)
    foot = -hull.equations[:, 3:] * normals
    inside = np.ones(len(normals), bool)
    areas = np.zeros(len(normals))
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        towards = np.cross(b - a, normals)
        flip = np.sign(np.einsum("ij,ij->i", towards, corners[:, (k + 2) % 3] - a))
        inside &= flip * np.einsum("ij,ij->i", towards, foot - a) >= -1e-9
        areas = 0.5 * np.linalg.norm(np.cross(b - a, corners[:, (k + 2) % 3] - a), axis=1)
    kept = inside & (areas > 0)
    return normals[kept], areas[kept]


def _camera_pose(unit: float, config: TabletopConfig, rng: Rng) -> Pose:
    """``T_cam_world``: the camera looks down at somewhere near the middle of the table, a little tilted."""
    distance = unit * np.exp(rng.uniform(*np.log(config.distance)))
    elevation, azimuth = np.deg2rad(rng.uniform(*config.elevation_deg)), rng.uniform(0, 2 * np.pi)
    away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    R = np.stack([right, np.cross(-away, right), -away])  # rows: x right, y down, z forward
    R = so3_exp([0.0, 0.0, float(rng.normal() * 0.12)]) @ R
    middle = unit * np.array([*rng.uniform(-0.8, 0.8, size=2), rng.uniform(0, 0.5)])
    return Pose(R, np.array([0.0, 0.0, distance]) - R @ middle)


# --- drawing ----------------------------------------------------------------------------------------------------


def _add(
    canvas: Canvas, label: int, renderer: Renderer, model: ObjectModel, T_cam_obj: Pose, camera: Camera, light: Light,
    paint: float, rng: Rng,
) -> int:  # fmt: skip
    """Draw an object; returns the pixels of its whole silhouette, 0 where it is not in the picture at all, too near or
    too large to draw."""
    points = T_cam_obj.apply(model.hull_vertices)
    if points[:, 2].min() < 0.2 * model.diameter:
        return 0
    x0, y0, x1, y1 = camera.points_box(points)
    found = tile(camera, points, TILES)
    if found is None or x1 <= 0 or y1 <= 0 or x0 >= camera.width or y0 >= camera.height:
        return 0
    part, left, top = found
    drawn = renderer.render(model, [T_cam_obj], part, light=light)[0]
    assert drawn.mask is not None and drawn.depth is not None
    if not drawn.mask.any():
        return 0
    canvas.paste(repainted(drawn.image, paint, rng), drawn.mask, drawn.depth, label, left, top)
    return int(drawn.mask.sum())


def repainted(image: Image, strength: float, rng: Rng) -> Image:
    """Another paint than the mesh's: gains, gamma and saturation. strength: 1 = usual, 0 = the same paint."""
    x = image.astype(np.float32) / 255
    grey = x.mean(-1, keepdims=True)
    saturation, gamma = rng.uniform(0.6, 1.3) ** strength, np.exp(rng.normal() * 0.2 * strength)
    x = np.clip(grey + (x - grey) * np.float32(saturation), 0, 1) ** np.float32(gamma)
    x *= np.exp((rng.normal(size=3) * 0.06 + rng.normal() * 0.15) * strength).astype(np.float32)
    return (np.clip(x, 0, 1) * 255).astype(np.uint8)


def _backdrop(config: TabletopConfig, photos: Sequence[Image], rng: Rng) -> Image:
    """What is behind everything, uint8 (H, W, 3): a photograph's part, a texture, or one colour."""
    width, height = config.size
    if len(photos) and rng.random() < config.photo:
        return photo_crop(rng, photos, config.size).copy()
    if rng.random() < 0.4:
        return np.array(np.broadcast_to(random_colour(rng).astype(np.uint8), (height, width, 3)))
    low, high = random_colour(rng), random_colour(rng)
    noise = noise_image(rng, config.size, int(rng.choice([1, 3])))
    return np.asarray((low + (high - low) * noise).clip(0, 255).astype(np.uint8))


def _lay_scrap(image: Image, photos: Sequence[Image], rng: Rng) -> None:
    """Paint over a part of a picture with one of a photograph, a blob with straight edges or round; in place."""
    height, width = image.shape[:2]
    side = int(width * np.exp(rng.uniform(np.log(0.05), np.log(0.35))))
    shape = np.zeros((side, side), np.uint8)
    if rng.random() < 0.6:
        corners = (rng.uniform(0, 1, size=(int(rng.integers(4, 9)), 1, 2)) * side).astype(np.int32)
        cv2.fillConvexPoly(shape, cv2.convexHull(corners), 1)
    else:
        axes = tuple(int(a) for a in (rng.uniform(0.15, 0.5, size=2) * side))
        cv2.ellipse(shape, (side // 2, side // 2), axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
    part = photo_crop(rng, photos, (side, side))
    left, top = int(rng.integers(-side // 2, width - side // 2)), int(rng.integers(-side // 2, height - side // 2))
    here = image[max(0, top) : top + side, max(0, left) : left + side]
    there = (slice(max(0, -top), max(0, -top) + here.shape[0]), slice(max(0, -left), max(0, -left) + here.shape[1]))
    on = shape[there] > 0
    here[on] = part[there][on]


def _draw_table(
    canvas: Canvas, camera: Camera, renderer: Renderer, T_cam_world: Pose, unit: float, light: Light,
    photos: Sequence[Image], rng: Rng,
) -> None:  # fmt: skip
    """A textured rectangle at z = 0."""
    half = 0.5 * unit * rng.uniform(5, 16, size=2)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32) * [*half, 0]
    turn = so3_exp([0.0, 0.0, float(rng.uniform(0, 2 * np.pi))])
    table = ObjectModel.from_arrays(
        (corners @ turn.T).astype(np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        name="table",
        uvs=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32),
        texture=_table_texture(photos, rng),
    )
    view = renderer.render(table, [T_cam_world], camera, light=light)[0]
    assert view.mask is not None and view.depth is not None
    canvas.paste(view.image, view.mask, view.depth, 0)


def _table_texture(photos: Sequence[Image], rng: Rng) -> Image:
    """Plain with grain as most tables are, or anything."""
    if rng.random() < 0.4:
        return random_texture(rng, photos)
    noise = noise_image(rng, (256, 256), 1) - 0.5
    return np.asarray((random_colour(rng) + noise * rng.uniform(5, 60)).clip(0, 255).astype(np.uint8))


def _draw_shadows(
    canvas: Canvas, camera: Camera, models: Sequence[ObjectModel], T_world_objs: Sequence[Pose], T_cam_world: Pose,
    light: Light, rng: Rng,
) -> None:  # fmt: skip
    """Darken the table where objects stand between it and the light; soft outlines of their hulls."""
    towards = np.asarray(light.direction) @ T_cam_world.R
    if towards[2] < 0.15:
        return
    shadow = np.zeros(canvas.labels.shape, np.uint8)
    for model, T_world_obj in zip(models, T_world_objs, strict=True):
        points = T_world_obj.apply(model.hull_vertices)
        fallen = T_cam_world.apply(points - points[:, 2:] / towards[2] * towards)
        if fallen[:, 2].min() > 0.2 * model.diameter:
            pixels = camera.project(fallen).clip(-4000, 4000).astype(np.int32)
            cv2.fillConvexPoly(shadow, cv2.convexHull(pixels.reshape(-1, 1, 2)), 255)
    softness = float(rng.uniform(0.005, 0.03)) * camera.width
    soft = cv2.GaussianBlur(shadow.astype(np.float32) / 255, (0, 0), softness)
    strength = light.diffuse / (light.ambient + light.diffuse) * rng.uniform(0.5, 1.0)
    factor = np.where(canvas.depth > 0, 1 - np.float32(strength) * soft, 1.0)
    canvas.image[:] = (canvas.image * factor[..., None]).astype(np.uint8)
