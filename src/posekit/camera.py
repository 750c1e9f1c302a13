"""Camera: the only place with half-pixel offsets and OpenGL's clip space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.errors import CameraError
from posekit.geometry import rotation_between

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion, OpenCV axes.

    fx, fy, cx, cy in pixels, where (0, 0) is the centre of the top-left pixel; width, height in pixels.
    Raises CameraError where a focal length or a size is not a positive number.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        if not all(np.isfinite(values)) or self.fx <= 0 or self.fy <= 0:
            raise CameraError(
                f"camera intrinsics fx={self.fx}, fy={self.fy}, cx={self.cx}, cy={self.cy}: "
                "focal lengths must be positive numbers of pixels. Give fx,fy,cx,cy in pixels."
            )
        if self.width < 1 or self.height < 1:
            raise CameraError(f"camera size {self.width}x{self.height}: both must be at least 1 pixel.")

    @classmethod
    def from_K(cls, K: ArrayLike, width: int, height: int) -> Camera:
        """K: (3, 3) or 9 numbers, row by row."""
        try:
            k = np.asarray(K, dtype=np.float64).reshape(3, 3)
        except (ValueError, TypeError, OverflowError) as error:
            raise CameraError(f"a camera matrix has 3x3 numbers: {error}") from error
        return cls(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]), width, height)

    @classmethod
    def from_fov(cls, fov: float, width: int, height: int) -> Camera:
        """fov: field of view of the longer side, radians; the principal point is the picture's centre."""
        f = 0.5 * max(width, height) / np.tan(0.5 * fov)
        return cls(f, f, 0.5 * width - 0.5, 0.5 * height - 0.5, width, height)

    @property
    def K(self) -> Array:
        """The intrinsic matrix (3, 3), pixels; float64."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.width, self.height

    def project(self, points_cam: ArrayLike) -> Array:
        """Points (..., 3) in the camera's frame, z > 0 -> pixel-centre coordinates (..., 2)."""
        p = np.asarray(points_cam, dtype=np.float64)
        return p[..., :2] / p[..., 2:] * (self.fx, self.fy) + (self.cx, self.cy)

    def backproject(self, pixels: ArrayLike, depth: ArrayLike = 1.0) -> Array:
        """Pixel-centre coordinates (..., 2) and depth (...) along z -> points (..., 3)."""
        ray = (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        points = np.concatenate([ray, np.ones((*ray.shape[:-1], 1))], axis=-1)
        return points * np.asarray(depth, dtype=np.float64)[..., None]

    def pixel_grid(self) -> Array:
        """Pixel-centre coordinates (H, W, 2) of every pixel."""
        return np.stack(np.meshgrid(np.arange(self.width), np.arange(self.height)), axis=-1).astype(np.float64)

    def gl_projection(self, near: float, far: float) -> Array:
        """(4, 4), from this camera's own (OpenCV) frame to OpenGL clip space.

        The picture's first row lands on the framebuffer's first row, so that what glReadPixels
        returns needs no flip.
        """
        w, h = self.width, self.height
        return np.array(
            [
                [2 * self.fx / w, 0, (2 * self.cx + 1) / w - 1, 0],
                [0, 2 * self.fy / h, (2 * self.cy + 1) / h - 1, 0],
                [0, 0, (far + near) / (far - near), -2 * far * near / (far - near)],
                [0, 0, 1, 0],
            ]
        )

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with its picture scaled to another size."""
        sx, sy = width / self.width, height / self.height
        return Camera(self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5, width, height)

    def cropped(self, x0: int, y0: int, width: int, height: int) -> Camera:
        """The camera of the picture's part that starts at pixel (x0, y0)."""
        return Camera(self.fx, self.fy, self.cx - x0, self.cy - y0, width, height)

    def box_centre_ray(self, box: Box) -> Array:
        """The viewing ray (3,), z = 1, through the middle of a box given by its edges."""
        return self.backproject([0.5 * (box[0] + box[2]) - 0.5, 0.5 * (box[1] + box[3]) - 0.5])

    def box_corner_rays(self, box: Box) -> Array:
        """(4, 3) rays through a box's corners, z = 1."""
        x0, y0, x1, y1 = (v - 0.5 for v in box)
        return self.backproject([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])

    def points_box(self, points_cam: ArrayLike) -> Box:
        """The box (edges) round the projections of points (N, 3)."""
        uv = self.project(points_cam) + 0.5
        (x0, y0), (x1, y1) = uv.min(axis=0), uv.max(axis=0)
        return float(x0), float(y0), float(x1), float(y1)


def mask_box(mask: NDArray[np.bool_]) -> Box | None:
    """The box (edges) round a mask (H, W), None where it is empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if rows.size == 0:
        return None
    return float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)


def box_mask(box: Box, size: tuple[int, int]) -> NDArray[np.bool_]:
    """The filled box (edges), bool (H, W): all pixels whose greater part lies in it, at least one where the box meets
    the picture of ``size`` (width, height)."""
    width, height = size
    mask = np.zeros((height, width), dtype=np.bool_)
    if box[2] > 0 and box[3] > 0 and box[0] < width and box[1] < height:
        x0, y0 = (min(max(round(low), 0), most - 1) for low, most in zip(box[:2], size, strict=True))
        mask[y0 : max(round(box[3]), y0 + 1), x0 : max(round(box[2]), x0 + 1)] = True
    return mask


def box_iou(a: ArrayLike, b: ArrayLike) -> Array:
    """Intersection over union of boxes (..., 4) and (..., 4), edges, which broadcast: (...); 0 where both are empty."""
    first, second = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    low, high = np.maximum(first[..., :2], second[..., :2]), np.minimum(first[..., 2:], second[..., 2:])
    common = np.clip(high - low, 0, None).prod(axis=-1)
    area_a, area_b = ((x[..., 2:] - x[..., :2]).prod(axis=-1) for x in (first, second))
    union = np.asarray(area_a + area_b - common)
    return np.divide(common, union, out=np.zeros_like(union), where=union > 0)[()]


def mask_iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks (H, W) of one picture; 0 where both are empty."""
    return float((a & b).sum() / max(1, (a | b).sum()))


@dataclass(frozen=True, eq=False)
class Zoom:
    """From a photograph's camera to a virtual one that looks straight at the object.

    source, camera: the two cameras; R_view_cam: (3, 3), the viewing-ray rotation between their frames.
    """

    source: Camera
    camera: Camera
    R_view_cam: Array

    @classmethod
    def look_at(cls, source: Camera, ray: ArrayLike, half_width: float, size: tuple[int, int]) -> Zoom:
        """A square-pixelled camera whose axis is ``ray`` (3,) in the source camera's frame.

        half_width: tangent of the angle from the axis to the picture's left and right edge;
        size: (width, height) in pixels.
        """
        width, height = size
        f = 0.5 * width / half_width
        camera = Camera(f, f, 0.5 * width - 0.5, 0.5 * height - 0.5, width, height)
        return cls(source, camera, rotation_between(ray, [0.0, 0.0, 1.0]))

    @property
    def homography(self) -> Array:
        """(3, 3), from the source's pixel-centre coordinates to the zoomed ones."""
        return self.camera.K @ self.R_view_cam @ np.linalg.inv(self.source.K)
