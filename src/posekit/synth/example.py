"""The demo's example: a toy locomotive from a script, and a picture of it on a table among other things.

Everything is made here, so that a first run needs neither a download nor a licence. The picture is built like a
photograph rather than like a render: two planes with grain and defocus behind, clutter, a soft shadow, vignetting,
sensor noise and JPEG.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Box, Camera, mask_box
from posekit.geometry import Pose, euler_xyz, view_rotation
from posekit.mesh.model import ObjectModel
from posekit.mesh.symmetries import Symmetries
from posekit.render import Light, Renderer
from posekit.view import View

Array = NDArray[np.float64]
Colour = tuple[int, int, int]
Profile = Sequence[tuple[float, float]]

RED, GREEN, BLUE, GOLD = (196, 38, 30), (34, 122, 62), (38, 84, 180), (226, 178, 52)
BLACK, CREAM, ORANGE, GREY = (34, 34, 38), (238, 226, 196), (232, 116, 30), (128, 130, 136)

_SHADE = Light(ambient=0.5, direction=(-0.45, -0.75, -0.5), diffuse=0.6, specular=0.15)
_TO_LIGHT_TABLE = np.array([-0.35, -0.25, 0.9])  # roughly where _SHADE comes from, for the shadow

_CAMERA = Camera(610.0, 610.0, 322.0, 236.0, 640, 480)
_T_CAM_TABLE = Pose(view_rotation([0.25, -0.8, 0.5]), np.array([0.035, 0.025, 0.62]))


@dataclass(frozen=True, eq=False)
class Example:
    """view: the picture with its camera, without a mask. T_cam_obj: the true pose. box: edges round the object."""

    model: ObjectModel
    view: View
    T_cam_obj: Pose
    box: Box


def make_example(renderer: Renderer, seed: int = 0, model: ObjectModel | None = None, light: Light = _SHADE) -> Example:
    """The locomotive on the table, 640x480; the seed turns it about the table's normal and draws the noise.

    model: another mesh, metres, standing on its z = 0. light: how the object is lit; the rest of the picture keeps its
    light.
    """
    rng = np.random.default_rng(seed)
    T_table_obj = Pose(euler_xyz([0, 0, np.deg2rad(rng.uniform(20, 50))]), np.zeros(3))
    room = _room(_fine(_CAMERA), _T_CAM_TABLE, rng)
    return _example(renderer, locomotive() if model is None else model, T_table_obj, room, rng, light)


def make_film(renderer: Renderer, frames: int, seed: int = 0) -> Iterator[Example]:
    """The locomotive turns in an arc on the same table, 640x480, two degrees from frame to frame: one Example each."""
    rng = np.random.default_rng(seed)
    room, model = _room(_fine(_CAMERA), _T_CAM_TABLE, rng), locomotive()
    for k in range(frames):
        turn = np.deg2rad(10 + 2.0 * k)
        way = Pose(euler_xyz([0, 0, turn]), 0.12 * np.array([np.sin(turn), -np.cos(turn), 0]) + (-0.06, 0.1, 0))
        yield _example(renderer, model, way, room, rng)


def _example(
    renderer: Renderer,
    model: ObjectModel,
    T_table_obj: Pose,
    room: NDArray[np.float32],
    rng: np.random.Generator,
    light: Light = _SHADE,
) -> Example:
    T_cam_obj = _T_CAM_TABLE @ T_table_obj
    [seen] = renderer.render(model, [T_cam_obj], _CAMERA, rgb=False, coords=False)
    box = mask_box(seen.mask) if seen.mask is not None else None
    assert box is not None, "the example's object lies in front of its camera"
    image = _photograph(renderer, model, T_cam_obj, room, rng, light)
    return Example(model, View(image, _CAMERA), T_cam_obj, box)


def ply(model: ObjectModel) -> str:
    """The mesh with its vertex colours as an ASCII PLY file, metres."""
    colours = model.colors if model.colors is not None else np.full((len(model.vertices), 3), 128, np.uint8)
    names = [f"property float {n}" for n in "xyz"] + [f"property uchar {n}" for n in ("red", "green", "blue")]
    head = ["ply", "format ascii 1.0", f"element vertex {len(model.vertices)}", *names]
    head += [f"element face {len(model.faces)}", "property list uchar int vertex_indices", "end_header"]
    vertices = ["{:.6f} {:.6f} {:.6f} {} {} {}".format(*p, *c) for p, c in zip(model.vertices, colours, strict=True)]
    return "\n".join([*head, *vertices, *(f"3 {a} {b} {c}" for a, b, c in model.faces)]) + "\n"


# --- meshes -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Part:
    vertices: Array  # (V, 3)
    faces: NDArray[np.int64]  # (F, 3), counter-clockwise from outside
    colour: Colour


def locomotive() -> ObjectModel:
    """A toy, 0.19 m long, its wheels standing on z = 0, its front towards +x; no two sides look alike."""
    return _model("locomotive", [*_body(), *_gear()])


def bottle() -> ObjectModel:
    """A bottle of one colour, 0.16 m high, standing on z = 0: it looks the same after any turn about its z axis."""
    profile = [(0, 0), (0.030, 0), (0.032, 0.004), (0.032, 0.095), (0.013, 0.125), (0.013, 0.150), (0.015, 0.150)]
    mesh = _model("bottle", [_turned([*profile, (0.015, 0.160), (0, 0.160)], "z", (0, 0, 0), GREEN)])
    return replace(mesh, symmetries=Symmetries.parse("z:inf", mesh.center))


def _body() -> Iterator[_Part]:
    yield _block((-0.092, -0.030, 0.026), (0.086, 0.030, 0.036), RED)  # frame
    yield _turned([(0, 0), (0.026, 0), (0.026, 0.094), (0, 0.094)], "x", (-0.020, 0, 0.062), GREEN)  # boiler
    for x in (0.008, 0.042):
        yield _turned([(0.0268, 0), (0.0268, 0.006)], "x", (x, 0, 0.062), GOLD)  # its bands
    yield _turned([(0, 0), (0.028, 0), (0.028, 0.016), (0.022, 0.020), (0, 0.020)], "x", (0.066, 0, 0.062), BLACK)
    yield _turned(
        [(0.008, 0), (0.008, 0.022), (0.015, 0.034), (0.011, 0.034), (0, 0.020)], "z", (0.056, 0, 0.084), BLACK
    )
    yield _turned(
        [(0.012, 0), (0.012, 0.008), (0.010, 0.014), (0.006, 0.018), (0, 0.019)], "z", (0.018, 0, 0.084), GOLD
    )
    yield _block((-0.086, -0.032, 0.036), (-0.020, 0.032, 0.106), BLUE)  # cab
    yield _block((-0.094, -0.037, 0.106), (-0.012, 0.037, 0.112), RED)  # roof
    for y in (-0.0325, 0.0315):
        yield _block((-0.072, y, 0.074), (-0.034, y + 0.001, 0.098), CREAM)  # side windows
    yield _block((-0.0868, -0.020, 0.074), (-0.0858, 0.020, 0.098), CREAM)  # rear window
    yield _block((-0.018, -0.034, 0.036), (0.040, -0.024, 0.060), ORANGE)  # a water tank on the right side only
    yield _turned([(0, 0), (0.007, 0), (0.007, 0.008), (0, 0.010)], "x", (0.084, 0.012, 0.094), CREAM)  # lamp, left


def _gear() -> Iterator[_Part]:
    for side in (-1, 1):
        for x, radius in ((-0.062, 0.024), (-0.010, 0.018), (0.030, 0.018), (0.068, 0.018)):
            wheel = [(0, -0.004), (radius, -0.004), (radius, 0.004), (0, 0.004)]
            yield _turned(wheel, "y", (x, side * 0.030, radius), BLACK)
            hub = [(0, -0.0055), (0.6 * radius, -0.0055), (0.6 * radius, 0.0055), (0, 0.0055)]
            yield _turned(hub, "y", (x, side * 0.030, radius), RED if side < 0 else GOLD)
        yield _turned([(0, 0), (0.007, 0), (0.007, 0.010), (0, 0.010)], "x", (0.086, side * 0.020, 0.031), GREY)
    yield _block((-0.064, -0.0385, 0.014), (0.032, -0.0355, 0.020), GREY)  # coupling rod, right side only


def _clutter() -> ObjectModel:
    """What stands behind the locomotive, in the table's frame."""
    mug: Profile = [(0, 0), (0.038, 0), (0.040, 0.085), (0.036, 0.085), (0.034, 0.01), (0, 0.01)]
    ball: Profile = [(0.045 * np.sin(a), -0.045 * np.cos(a)) for a in np.linspace(0, np.pi, 25)]
    parts = [
        _turned(mug, "z", (-0.19, 0.18, 0), (206, 202, 190)),
        _turned([(0.0403, 0.03), (0.0403, 0.05)], "z", (-0.19, 0.18, 0), (70, 120, 150)),
        _block((0.10, 0.14, 0), (0.32, 0.30, 0.028), (122, 54, 58)),
        _block((0.13, 0.15, 0.028), (0.30, 0.31, 0.046), (60, 92, 84)),
        _turned(ball, "z", (0.02, 0.36, 0.045), (214, 140, 44)),
        _turned([(0, 0), (0.005, 0), (0.005, 0.16), (0, 0.17)], "x", (-0.30, -0.02, 0.005), (208, 176, 40)),
    ]
    return _model("clutter", parts)


def _block(low: Sequence[float], high: Sequence[float], colour: Colour) -> _Part:
    """A box between two corners; each face has its own vertices, so that its edges stay sharp."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    corners: list[Array] = []
    faces: list[NDArray[np.int64]] = []
    for axis in range(3):
        for end in (0, 1):
            face = np.insert(square, axis, end, axis=1)
            corners.append(np.asarray(low) + face * (np.asarray(high) - np.asarray(low)))
            outward = (end == 1) != (axis == 1)  # dropping y from (x, y, z) mirrors the rest
            faces.append(_QUAD[:, :: 1 if outward else -1] + 4 * len(faces))
    return _Part(np.concatenate(corners), np.concatenate(faces), colour)


_QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def _turned(profile: Profile, axis: str, at: Sequence[float], colour: Colour, n: int = 40) -> _Part:
    """A profile of (radius, height) turned about an axis through ``at``; its edges stay sharp.

    The heights rise along the axis on the outside, so that the faces look outwards.
    """
    angle = np.linspace(0, 2 * np.pi, n + 1)
    rings = [np.stack([r * np.cos(angle), r * np.sin(angle), np.full(n + 1, h)], 1) for r, h in profile]
    k = np.arange(n)
    strip = np.concatenate([np.stack([k, k + 1, k + n + 2], 1), np.stack([k, k + n + 2, k + n + 1], 1)])
    bands = [np.concatenate(pair) for pair in pairwise(rings)]
    faces = np.concatenate([strip + 2 * (n + 1) * band for band in range(len(bands))])
    order = {"x": [2, 0, 1], "y": [1, 2, 0], "z": [0, 1, 2]}[axis]  # cyclic: keeps the faces' sense
    vertices = np.concatenate(bands)[:, order]
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return _Part(vertices + np.asarray(at), faces[area > 1e-12], colour)


def _model(name: str, parts: Sequence[_Part]) -> ObjectModel:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return ObjectModel.from_arrays(
        np.concatenate([part.vertices for part in parts]).astype(np.float32),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]).astype(np.int32),
        name=name,
        colors=np.concatenate([np.full((len(part.vertices), 3), part.colour, np.uint8) for part in parts]),
    )


# --- the picture ------------------------------------------------------------------------------------------------


def _fine(camera: Camera) -> Camera:
    """Twice the pixels: pictures are drawn so and averaged, as a sensor's pixels average."""
    return camera.resized(2 * camera.width, 2 * camera.height)


def _photograph(
    renderer: Renderer,
    model: ObjectModel,
    T_cam_obj: Pose,
    room: NDArray[np.float32],
    rng: np.random.Generator,
    light: Light,
) -> NDArray[np.uint8]:
    """The room, as `_room` draws it for the fine camera, with clutter and the model in it."""
    fine, clutter = _fine(_CAMERA), _clutter()
    dark = _shadow(clutter, _T_CAM_TABLE, _T_CAM_TABLE, fine) * _shadow(model, T_cam_obj, _T_CAM_TABLE, fine)
    scene = _paste(room * dark, renderer.render(clutter, [_T_CAM_TABLE], fine, light=_SHADE, coords=False)[0])
    scene = cv2.GaussianBlur(scene, (0, 0), 2.2)  # the lens is focused on the object
    scene = _paste(scene, renderer.render(model, [T_cam_obj], fine, light=light, coords=False)[0])
    return _develop(cv2.resize(scene, _CAMERA.size, interpolation=cv2.INTER_AREA), rng)


def _room(camera: Camera, T_cam_table: Pose, rng: np.random.Generator) -> NDArray[np.float32]:
    """A wooden table and a wall behind it, (H, W, 3) in 0..255."""
    to_table = T_cam_table.inverse()
    rays = camera.backproject(camera.pixel_grid()) @ to_table.R.T
    with np.errstate(divide="ignore", invalid="ignore"):
        down = np.where(rays[..., 2] < 0, -to_table.t[2] / rays[..., 2], np.inf)
        back = np.where(rays[..., 1] > 0, (0.75 - to_table.t[1]) / rays[..., 1], np.inf)
    reach = np.minimum(np.minimum(down, back), 10.0)[..., None]
    points = to_table.t + rays * reach
    on_table = (down < back)[..., None]
    room: NDArray[np.float32] = np.where(on_table, _wood(points, rng), _wall(points, rng)).astype(np.float32)
    return room


def _wood(points: Array, rng: np.random.Generator) -> Array:
    """Boards along x with grain; points (H, W, 3) on the table."""
    x, y = points[..., 0], points[..., 1]
    board = np.floor(y / 0.11)
    shade = 0.10 * np.sin(board * 12.9 + 1.0)
    bend = 0.006 * np.sin(5 * x + 3 * board) + 0.003 * np.sin(17 * x + board)
    rings = np.sin((y + bend) * 420 + 2.5 * np.sin(6 * x + 4 * board))
    fibre = np.sin((y + 0.3 * bend) * 2600 + 31 * np.sin(2 * x))
    seam = np.clip(np.abs(y / 0.11 - np.round(y / 0.11)) * 60, 0.35, 1)
    value = (0.78 + shade + 0.07 * rings + 0.03 * fibre + rng.normal(scale=0.01, size=x.shape)) * seam
    return value[..., None] * np.array([186.0, 138.0, 92.0])


def _wall(points: Array, rng: np.random.Generator) -> Array:
    """Plaster with a dado and the light of a window; points (H, W, 3) at the wall."""
    x, z = points[..., 0], points[..., 2]
    glow = np.exp(-(((x + 0.35) / 0.5) ** 2) - ((z - 0.35) / 0.35) ** 2)
    stain = 0.04 * np.sin(9 * x + 2) * np.sin(7 * z + 1)
    value = 0.62 + 0.4 * glow + stain + rng.normal(scale=0.015, size=x.shape)
    dado = (z < 0.1)[..., None]
    return value[..., None] * np.where(dado, [120.0, 140.0, 138.0], [204.0, 198.0, 184.0])


def _shadow(model: ObjectModel, T_cam_obj: Pose, T_cam_table: Pose, camera: Camera) -> NDArray[np.float32]:
    """What is left of the light, (H, W, 1) in 0..1: the mesh thrown onto the table along the light, made soft."""
    points = (T_cam_table.inverse() @ T_cam_obj).apply(model.vertices)
    thrown = points - points[:, 2:] / _TO_LIGHT_TABLE[2] * _TO_LIGHT_TABLE
    pixels = np.rint(camera.project(T_cam_table.apply(thrown))).astype(np.int32)
    dark = np.zeros((camera.height, camera.width), np.float32)
    for triangle in pixels[model.faces]:
        cv2.fillConvexPoly(dark, triangle, 1.0)
    soft = 0.6 * cv2.GaussianBlur(dark, (0, 0), 7) + 0.4 * cv2.GaussianBlur(dark, (0, 0), 25)
    return (1 - 0.6 * soft)[..., None].astype(np.float32)


def _paste(scene: NDArray[np.float32], drawn: View) -> NDArray[np.float32]:
    assert drawn.mask is not None
    return np.where(drawn.mask[..., None], drawn.image, scene).astype(np.float32)


def _develop(scene: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Lens, sensor and JPEG: (H, W, 3) float in 0..255 to uint8."""
    height, width = scene.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    vignette = (1 - 0.22 * (x * x + y * y) / 2)[..., None]
    picture = cv2.GaussianBlur(scene, (0, 0), 0.6) * vignette * (1.04, 1.0, 0.94)
    picture += rng.normal(size=scene.shape) * (1.5 + 0.012 * picture)
    _, jpeg = cv2.imencode(".jpg", np.clip(picture, 0, 255).astype(np.uint8)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
    return np.ascontiguousarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR)[..., ::-1])
