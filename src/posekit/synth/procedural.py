"""Objects made by a procedure: unions of primitives with random materials.

Collected meshes are scarce and their licences mixed; shapes made by a procedure teach a refiner nearly as
well (LRM-Zero, 2024). Every primitive is a patch of quadrilaterals over (u, v), so that it has texture
coordinates and enough vertices to carry a pattern in its vertex colours.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.geometry import random_rotation
from posekit.mesh.model import ObjectModel

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Rng = np.random.Generator


# --- shapes -----------------------------------------------------------------------------------------------------


def _signed_power(x: Array, p: float) -> Array:
    return np.sign(x) * np.abs(x) ** p


def _superellipsoid(u: Array, v: Array, rng: Rng) -> Array:
    """u, v: (n, m) in [0, 1] -> (n, m, 3). Balls, pills, rounded boxes and cylinders in one family."""
    p, q = rng.choice([0.15, 0.3, 0.6, 1.0, 1.0, 1.8], size=2)
    phi, theta = 2 * np.pi * u, np.pi * (v - 0.5)
    r = _signed_power(np.cos(theta), p)
    return np.stack(
        [r * _signed_power(np.cos(phi), q), r * _signed_power(np.sin(phi), q), _signed_power(np.sin(theta), p)], -1
    )


def _lathe(u: Array, v: Array, rng: Rng) -> Array:
    """A surface of revolution with a random profile: cans, bottles, bowls, cones."""
    knots = int(rng.integers(2, 7))
    radius = rng.uniform(0.15, 1.0, size=knots)
    if rng.random() < 0.3:
        radius = np.repeat(radius, 2)  # steps
    profile = np.interp(v, np.linspace(0.06, 0.94, len(radius)), radius)
    profile *= np.clip(np.minimum(v, 1 - v) / 0.06, 0, 1)  # closed ends
    height = np.clip((v - 0.06) / 0.88, 0, 1) * 2 - 1
    height *= rng.uniform(0.3, 2.0)
    phi = 2 * np.pi * u
    corners = int(rng.integers(3, 9))
    if rng.random() < 0.4:  # a prism instead
        phi = np.round(phi / (2 * np.pi / corners)) * (2 * np.pi / corners)
    return np.stack([profile * np.cos(phi), profile * np.sin(phi), height], -1)


def _torus(u: Array, v: Array, rng: Rng) -> Array:
    """Rings and handles, whole or in part."""
    thin, part = rng.uniform(0.08, 0.45), rng.choice([1.0, 1.0, 0.5, 0.75])
    phi, theta = 2 * np.pi * u * part, 2 * np.pi * v
    r = 1 + thin * np.cos(theta)
    return np.stack([r * np.cos(phi), r * np.sin(phi), thin * np.sin(theta) * rng.uniform(0.8, 2.0)], -1)


def _tube(u: Array, v: Array, rng: Rng) -> Array:
    """A bent bar of changing thickness: legs, tails, spouts, grips."""
    spine = np.cumsum(rng.normal(size=(4, 3)) + [0, 0, 1.2], axis=0)
    at = u * 3
    k = np.clip(at.astype(int), 0, 2)
    f = (at - k)[..., None]
    f = f * f * (3 - 2 * f)
    centre = spine[k] * (1 - f) + spine[k + 1] * f
    thickness = np.interp(u, [0, 0.03, 0.97, 1], [0, 1, 1, 0]) * np.interp(u, [0, 0.5, 1], rng.uniform(0.2, 0.7, 3))
    side, up = random_rotation(rng)[:2]
    angle = 2 * np.pi * v
    ring = np.cos(angle)[..., None] * side + np.sin(angle)[..., None] * up
    return centre + ring * thickness[..., None]


def _box(rng: Rng, n: int) -> tuple[Array, Array, NDArray[np.int32]]:
    """Flat faces and sharp edges: points (V, 3), uv (V, 2), faces (F, 3)."""
    t = np.linspace(0, 1, n)
    u, v = (g.ravel() for g in np.meshgrid(t, t))
    flat = np.stack([2 * u - 1, 2 * v - 1, np.ones_like(u)], -1)
    points, uvs, faces = [], [], []
    quads = _grid_faces(n, n)
    taper = rng.uniform(0.4, 1.0, size=2) if rng.random() < 0.3 else np.ones(2)
    for k, (axes, sign) in enumerate([((0, 1, 2), 1), ((0, 1, 2), -1), ((1, 2, 0), 1), ((1, 2, 0), -1),
                                      ((2, 0, 1), 1), ((2, 0, 1), -1)]):  # fmt: skip
        side = np.empty_like(flat)
        side[:, list(axes)] = flat * [1, 1, sign]
        points.append(side)
        uvs.append(np.stack([(u + k % 3) / 3, (v + k // 3) / 2], -1))
        faces.append(quads + k * n * n)
    p = np.concatenate(points)
    p[:, :2] *= 1 + (taper - 1) * (p[:, 2:] + 1) / 2
    return p, np.concatenate(uvs), np.concatenate(faces)


def _grid_faces(n: int, m: int) -> NDArray[np.int32]:
    """Two triangles for each cell of an (n, m) grid of vertices, (F, 3)."""
    i = np.arange(n * m).reshape(n, m)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).astype(np.int32)


def _primitive(rng: Rng, n: int) -> tuple[Array, Array, NDArray[np.int32]]:
    """One random primitive: points (V, 3) within about a unit, uv (V, 2) in [0, 1], faces (F, 3)."""
    kind = rng.choice(["box", "superellipsoid", "lathe", "torus", "tube"], p=[0.25, 0.25, 0.25, 0.12, 0.13])
    if kind == "box":
        points, uvs, faces = _box(rng, max(3, n // 2))
    else:
        u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
        shape = {"superellipsoid": _superellipsoid, "lathe": _lathe, "torus": _torus, "tube": _tube}[str(kind)]
        points, uvs, faces = shape(u, v, rng).reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2), _grid_faces(n, n)
    return points / np.abs(points).max(), uvs, faces


def _deform(points: Array, rng: Rng) -> Array:
    """Twist, bend or gentle waves over the whole object, (V, 3) within about [-1, 1]."""
    kind = rng.integers(3)
    if kind == 0:
        a = rng.uniform(-1.2, 1.2) * points[:, 2]
        c, s = np.cos(a), np.sin(a)
        x, y = points[:, 0], points[:, 1]
        return np.stack([c * x - s * y, s * x + c * y, points[:, 2]], -1)
    if kind == 1:
        return points + rng.uniform(-0.4, 0.4, size=3) * points[:, [2, 0, 1]] ** 2
    waves = rng.normal(size=(3, 3)) * 2.5
    return points + 0.08 * np.sin(points @ waves + rng.uniform(0, 6, size=3))


# --- materials --------------------------------------------------------------------------------------------------


def random_colour(rng: Rng) -> Array:
    """(3,) in 0..255; vivid, pastel, dark or grey."""
    hsv = np.array([rng.uniform(0, 180), 255 * rng.random() ** 0.7, 255 * rng.random() ** 0.6])
    if rng.random() < 0.25:
        hsv[1] *= 0.15
    return cv2.cvtColor(np.uint8(hsv).reshape(1, 1, 3), cv2.COLOR_HSV2RGB)[0, 0].astype(np.float64)


def noise_image(rng: Rng, size: tuple[int, int], channels: int = 3) -> NDArray[np.float32]:
    """Smooth noise of a random grain, (height, width, channels) in 0..1; size: (width, height)."""
    out = np.zeros((size[1], size[0], channels), np.float32)
    total = 0.0
    first = int(rng.integers(0, 5))
    for octave in range(first, first + int(rng.integers(1, 4))):
        cells = min(2 ** (octave + 1), min(size))
        weight = rng.uniform(0.3, 1.0)
        coarse = rng.random((cells, cells, channels), dtype=np.float32)
        out += weight * cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC).reshape(out.shape)
        total += weight
    return np.clip(out / total, 0, 1)


def random_texture(rng: Rng, photos: Sequence[Image] = (), size: int = 256) -> Image:
    """A picture to wrap round an object, uint8 (size, size, 3)."""
    base, other = random_colour(rng), random_colour(rng)
    kind = rng.choice(["plain", "noise", "stripes", "checker", "gradient", "photo"], p=[0.2, 0.2, 0.15, 0.1, 0.15, 0.2])
    t = np.linspace(0, 1, size)
    if kind == "photo" and len(photos):
        image = photo_crop(rng, photos, (size, size)).astype(np.float64)
    else:
        if kind == "noise":
            blend = noise_image(rng, (size, size), 1)[..., 0] * 1.6 - 0.3
        elif kind == "stripes":
            a, b = rng.normal(size=2)
            blend = np.sin((a * t[:, None] + b * t[None]) / np.hypot(a, b) * rng.uniform(6, 80)) * 3 + 0.5
        elif kind == "checker":
            n = rng.uniform(2, 12)
            blend = ((t[:, None] * n).astype(int) + (t[None] * n).astype(int)) % 2
        elif kind == "gradient":
            blend = np.broadcast_to(t[:, None] if rng.random() < 0.5 else t[None], (size, size))
        else:
            blend = np.zeros((size, size))
        blend = np.clip(blend, 0, 1)[..., None]
        image = base * (1 - blend) + other * blend
    painted = np.ascontiguousarray(image.clip(0, 255).astype(np.uint8))
    for _ in range(int(rng.integers(0, 9)) if rng.random() < 0.6 else 0):
        _draw_mark(painted, rng)
    return painted


def _draw_mark(image: Image, rng: Rng) -> None:
    """A patch, a line, a polygon or some letters, as labels and wear have them; drawn in place."""
    size = image.shape[0]
    colour = tuple(int(c) for c in random_colour(rng))
    at = rng.integers(0, size, size=(4, 2))
    reach = int(rng.integers(4, size // 3))
    kind = rng.integers(5)
    if kind == 0:
        cv2.circle(image, at[0].tolist(), reach // 2, colour, -1)
    elif kind == 1:
        cv2.rectangle(image, at[0].tolist(), (at[0] + rng.integers(4, size // 3, size=2)).tolist(), colour, -1)
    elif kind == 2:
        cv2.line(image, at[0].tolist(), at[1].tolist(), colour, int(rng.integers(1, 12)))
    elif kind == 3:
        cv2.fillPoly(image, [at[0] + rng.integers(-reach, reach, size=(4, 2))], colour)
    else:
        text = "".join(chr(c) for c in rng.integers(33, 126, size=int(rng.integers(1, 9))))
        cv2.putText(image, text, at[0].tolist(), int(rng.integers(0, 8)), reach / 30, colour, int(rng.integers(1, 5)))


def photo_crop(rng: Rng, photos: Sequence[Image], size: tuple[int, int]) -> Image:
    """A random part of a random photo, perhaps mirrored, uint8 (height, width, 3); size: (width, height)."""
    photo = photos[int(rng.integers(len(photos)))]
    h, w = photo.shape[:2]
    scale = min(w / size[0], h / size[1]) * rng.uniform(0.2, 1.0)
    cw, ch = max(2, int(size[0] * scale)), max(2, int(size[1] * scale))
    x, y = int(rng.integers(0, w - cw + 1)), int(rng.integers(0, h - ch + 1))
    part = cv2.resize(photo[y : y + ch, x : x + cw], size, interpolation=cv2.INTER_AREA)
    return part[:, ::-1] if rng.random() < 0.5 else part


def _vertex_colours(points: Array, part: NDArray[np.int64], rng: Rng) -> Image:
    """Patterns in space: per-part colours, bands, gradients and blobs, uint8 (V, 3)."""
    palette = np.stack([random_colour(rng) for _ in range(part.max() + 1)])
    colours = palette[part]
    for _ in range(int(rng.integers(0, 5))):
        direction = rng.normal(size=3)
        along = points @ direction / np.linalg.norm(direction)
        kind = rng.integers(3)
        if kind == 0:
            amount = np.clip(np.sin(along * rng.uniform(3, 25) + rng.uniform(0, 6)) * 4, 0, 1)
        elif kind == 1:
            amount = np.clip((along - along.min()) / (np.ptp(along) + 1e-9), 0, 1)
        else:
            centre = points[rng.integers(len(points))]
            amount = (np.linalg.norm(points - centre, axis=1) < rng.uniform(0.08, 0.5)).astype(np.float64)
        if rng.random() < 0.4:
            amount = amount * (part == rng.integers(part.max() + 1))
        amount = amount[:, None] * rng.uniform(0.4, 1.0)
        colours = colours * (1 - amount) + random_colour(rng) * amount
    grain = rng.normal(size=(len(points), 1)) * rng.choice([0, 0, 4, 10])
    return np.clip(colours + grain, 0, 255).astype(np.uint8)


# --- the whole object -------------------------------------------------------------------------------------------


def random_object(rng: Rng, photos: Sequence[Image] = (), diameter: float | None = None) -> ObjectModel:
    """A random object of 1 to 6 intersecting primitives, textured, vertex-coloured or plain.

    photos: pictures to cut textures from. diameter: metres; 0.06 to 0.3 where not given.
    """
    count = int(rng.choice([1, 2, 3, 4, 5, 6], p=[0.12, 0.2, 0.22, 0.2, 0.16, 0.1]))
    detail = 40 if count <= 2 else 28
    points_list: list[Array] = []
    uv_list, face_list, part_list, offset = [], [], [], 0
    for k in range(count):
        points, uvs, faces = _primitive(rng, detail)
        scale = rng.uniform(0.25, 1.0, size=3) * (1.0 if k == 0 else rng.uniform(0.2, 0.9))
        if rng.random() < 0.15:
            scale[rng.integers(3)] *= 0.2  # plates and rods
        R = random_rotation(rng) if rng.random() < 0.6 else np.eye(3)
        anchor = points_list[-1][rng.integers(len(points_list[-1]))] if k else np.zeros(3)
        points_list.append((points * scale) @ R.T + anchor * rng.uniform(0.5, 1.0))
        # each primitive takes a random rectangle of the texture
        corner, reach = rng.random(2) * 0.6, rng.uniform(0.2, 0.4, size=2)
        uv_list.append(corner + uvs * reach if rng.random() < 0.7 else uvs)
        face_list.append(faces + offset)
        part_list.append(np.full(len(points), k))
        offset += len(points)
    points, part = np.concatenate(points_list), np.concatenate(part_list)
    points -= 0.5 * (points.max(0) + points.min(0))
    points /= np.abs(points).max()
    if rng.random() < 0.25:
        points = _deform(points, rng)
        points /= np.abs(points).max()
    material = rng.choice(["texture", "colours", "plain"], p=[0.5, 0.4, 0.1])
    colours = _vertex_colours(points, part, rng) if material == "colours" else None
    texture = random_texture(rng, photos) if material == "texture" else None
    if material == "plain":
        colours = np.broadcast_to(random_colour(rng).astype(np.uint8), (len(points), 3)).copy()
    if diameter is None:
        diameter = float(rng.uniform(0.06, 0.3))
    spread = np.linalg.norm(points.max(0) - points.min(0))
    return ObjectModel.from_arrays(
        (points * (diameter / spread)).astype(np.float32),
        np.concatenate(face_list).astype(np.int32),
        name="procedural",
        colors=colours,
        uvs=np.concatenate(uv_list).astype(np.float32) if texture is not None else None,
        texture=texture,
    )
