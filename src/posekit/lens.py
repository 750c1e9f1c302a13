"""Lens: distortion as OpenCV models it, and pictures without it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.camera import Array, Box, Camera, mask_box
from posekit.errors import CameraError

COUNTS = {"pinhole": (4, 5, 8, 12, 14), "fisheye": (4,)}
_MOST_GROWTH = 2.0  # of a side, to hold what a wide lens bends inwards
_STEP = 16  # pixels between the border's points that are tried
_LEAST_SHARE = 0.25  # of them that the coefficients must be able to place


@dataclass(frozen=True)
class Lens:
    """A camera whose lens bends rays.

    camera: K and size of the distorted photograph. coefficients: OpenCV's k1, k2, p1, p2 (, k3 (, k4, k5, k6 (, s1 to
    s4 (, two tilts)))), of a fisheye k1 to k4. model: "pinhole" or "fisheye".
    Raises CameraError where there are as many coefficients as no model of OpenCV has, where they are no numbers, or
    where they cannot be undone over the photograph.
    """

    camera: Camera
    coefficients: tuple[float, ...]
    model: str = "pinhole"

    def __post_init__(self) -> None:
        counts = COUNTS[self.model]
        if len(self.coefficients) not in counts or not np.isfinite(self.coefficients).all():
            raise CameraError(
                f"{len(self.coefficients)} distortion coefficients {list(self.coefficients)} for a {self.model} "
                f"camera: OpenCV has {', '.join(map(str, counts))} finite numbers. Calibrate with OpenCV's models, or "
                "undistort the picture yourself and leave them out."
            )
        _ = self.ideal  # refused here, not at the first picture

    @cached_property
    def ideal(self) -> Camera:
        """The camera of the undistorted picture: the same focal lengths; its size holds the whole photograph, up to
        twice each side."""
        points, trusted = self._undone(_border(self.camera))
        if trusted.mean() < _LEAST_SHARE:
            raise CameraError(
                f"the distortion coefficients {list(self.coefficients)} cannot be undone over a picture of "
                f"{self.camera.width}x{self.camera.height} pixels: they belong to another camera, picture size or "
                "model (pinhole or fisheye)."
            )
        sides = np.array(self.camera.size, dtype=np.float64)
        room = 0.5 * (_MOST_GROWTH - 1) * sides
        low = np.floor(np.clip(points[trusted].min(axis=0), -room, 0.0)).astype(int)
        high = np.ceil(np.clip(points[trusted].max(axis=0), sides - 1, sides - 1 + room)).astype(int)
        width, height = (int(n) for n in high - low + 1)
        return self.camera.cropped(int(low[0]), int(low[1]), width, height)

    def undistorted(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A photograph (H, W, 3) as `ideal` sees it; black where it shows nothing."""
        return np.asarray(cv2.remap(image, *_maps(self), cv2.INTER_LINEAR), dtype=np.uint8)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which pixels (H, W) of `ideal` the photograph shows."""
        return _valid(self)

    def undistorted_mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """A mask (H, W) of the photograph as one of `ideal`. Raises CameraError where its size is another."""
        if mask.shape != (self.camera.height, self.camera.width):
            raise CameraError(
                f"the mask is {mask.shape[1]}x{mask.shape[0]} pixels, the photograph "
                f"{self.camera.width}x{self.camera.height}: a mask has the size of the photograph as it was taken."
            )
        return np.asarray(cv2.remap(mask.astype(np.float32), *_maps(self), cv2.INTER_LINEAR) > 0.5)

    def undistorted_box(self, box: Box) -> Box:
        """The box (edges) in `ideal` round what a box in the photograph shows."""
        x0, y0, x1, y1 = box
        u, v = np.linspace(x0, x1, 33) - 0.5, np.linspace(y0, y1, 33) - 0.5
        edges = [(a, b) for a in u for b in (v[0], v[-1])] + [(a, b) for b in v for a in (u[0], u[-1])]
        points, trusted = self._undone(np.array(edges))
        if not trusted.any():
            filled = np.zeros((self.camera.height, self.camera.width), dtype=np.bool_)
            filled[max(0, round(y0)) : max(0, round(y1)), max(0, round(x0)) : max(0, round(x1))] = True
            return mask_box(self.undistorted_mask(filled)) or box
        (a0, b0), (a1, b1) = points[trusted].min(axis=0), points[trusted].max(axis=0)
        dx, dy = self.camera.cx - self.ideal.cx, self.camera.cy - self.ideal.cy
        return float(a0 - dx + 0.5), float(b0 - dy + 0.5), float(a1 - dx + 0.5), float(b1 - dy + 0.5)

    def project(self, points_cam: ArrayLike) -> Array:
        """Points (N, 3) in the camera's frame, z > 0 -> pixel-centre coordinates (N, 2) in the photograph."""
        points = np.asarray(points_cam, dtype=np.float64).reshape(-1, 1, 3)
        project = cv2.fisheye.projectPoints if self.model == "fisheye" else cv2.projectPoints
        found, _ = project(points, np.zeros(3), np.zeros(3), self.camera.K, np.array(self.coefficients))
        return np.asarray(found, dtype=np.float64).reshape(-1, 2)

    def _undone(self, pixels: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (N, 2) of the photograph without distortion, same K; and where that is true: distorted again they are
        the same."""
        K, D = self.camera.K, np.array(self.coefficients)
        if self.model == "fisheye":
            rays = cv2.fisheye.undistortPoints(pixels.reshape(-1, 1, 2), K, D)
        else:
            ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
            undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # OpenCV 4 and 5
            rays = undistort(pixels.reshape(-1, 1, 2), K, D, R=np.eye(3), P=np.eye(3), criteria=ends)
        rays = np.asarray(rays, dtype=np.float64).reshape(-1, 2)
        with np.errstate(all="ignore"):
            again = self.project(np.column_stack([rays, np.ones(len(rays))]))
            trusted = np.linalg.norm(again - pixels, axis=1) < 0.5
        return rays * (self.camera.fx, self.camera.fy) + (self.camera.cx, self.camera.cy), trusted


def _border(camera: Camera) -> Array:
    """Pixels (N, 2) along a picture's border."""
    x = np.append(np.arange(0, camera.width - 1, _STEP), camera.width - 1)
    y = np.append(np.arange(0, camera.height - 1, _STEP), camera.height - 1)
    sides = [(u, v) for u in x for v in (0, camera.height - 1)] + [(u, v) for v in y for u in (0, camera.width - 1)]
    return np.array(sides, dtype=np.float64)


@lru_cache(maxsize=4)
def _valid(lens: Lens) -> NDArray[np.bool_]:
    whole = np.ones((lens.camera.height, lens.camera.width), np.float32)
    return np.asarray(cv2.remap(whole, *_maps(lens), cv2.INTER_LINEAR) > 0.99)


@lru_cache(maxsize=4)
def _maps(lens: Lens) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where each pixel of `ideal` lies in the photograph, x and y; outside it where it shows nothing."""
    ideal, K, D = lens.ideal, lens.camera.K, np.array(lens.coefficients)
    make = cv2.fisheye.initUndistortRectifyMap if lens.model == "fisheye" else cv2.initUndistortRectifyMap
    x, y = make(K, D, np.eye(3), ideal.K, ideal.size, cv2.CV_32FC1)
    # past the radius at which a polynomial turns back it would show the picture a second time, mirrored
    rays = ideal.backproject(ideal.pixel_grid())[..., :2]
    jacobian = np.gradient(x)[1] * np.gradient(y)[0] - np.gradient(x)[0] * np.gradient(y)[1]
    radius = np.hypot(rays[..., 0], rays[..., 1])
    if (jacobian <= 0).any():
        beyond = radius >= radius[jacobian <= 0].min()
        x, y = np.where(beyond, np.float32(-1e4), x), np.where(beyond, np.float32(-1e4), y)
    return x, y
