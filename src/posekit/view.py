"""View: a picture and its camera, never apart."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera, Zoom
from posekit.lens import Lens


@dataclass(frozen=True, eq=False)
class View:
    """What a camera sees.

    image: uint8 RGB (H, W, 3). camera: its Camera, of the same size.
    mask: bool (H, W), the object's pixels. depth: float32 (H, W), metres along z, 0 = nothing.
    coords: float32 (H, W, 3), object coordinates in metres, 0 = nothing.
    R_view_cam: (3, 3), from the photograph's camera frame into this view's (identity unless zoomed).
    valid: bool (H, W), which pixels show something rather than what lies outside the photograph; None = all of them.
    lens: where this is an undistorted photograph, the lens that it was taken through.
    """

    image: NDArray[np.uint8]
    camera: Camera
    mask: NDArray[np.bool_] | None = None
    depth: NDArray[np.float32] | None = None
    coords: NDArray[np.float32] | None = None
    R_view_cam: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    lens: Lens | None = None
    valid: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        for name in ("image", "mask", "depth", "coords", "valid"):
            array = getattr(self, name)
            if array is not None and array.shape[:2] != size:
                raise ValueError(f"View: {name} is {array.shape[:2]}, its camera {size} (height, width)")

    @property
    def shown(self) -> NDArray[np.bool_]:
        """Pixels (H, W) that show something: `valid`, all of them where it is None."""
        return np.ones(self.image.shape[:2], np.bool_) if self.valid is None else self.valid

    def with_mask(self, mask: NDArray[np.bool_] | None) -> View:
        """The same view with another mask, bool (H, W), or with none."""
        return replace(self, mask=mask)

    def zoomed(self, zoom: Zoom) -> View:
        """The picture and the mask resampled into ``zoom.camera``; depth and coords are dropped.

        Pixels from outside the photograph are black, not valid and not in the mask. Where the zoom shrinks the
        picture it is smoothed first, so that small details do not alias.
        """
        size, H = zoom.camera.size, zoom.homography
        image = self._image_in(zoom)
        mask = None
        if self.mask is not None:
            soft = cv2.warpPerspective(self.mask.astype(np.float32), H, size, flags=cv2.INTER_LINEAR)
            mask = soft > 0.5
        return View(image, zoom.camera, mask, R_view_cam=zoom.R_view_cam @ self.R_view_cam, valid=self._valid_in(zoom))

    def _image_in(self, zoom: Zoom) -> NDArray[np.uint8]:
        """The picture resampled into ``zoom.camera``; where it shrinks, what it shows is smoothed first."""
        image, H, size = self.image, zoom.homography, zoom.camera.size
        shrink = self.camera.fx / zoom.camera.fx
        if shrink > 1.5:
            sigma, places = 0.4 * shrink, self._corners(zoom)
            if places is not None:
                reach = int(np.ceil(3 * sigma)) + 2  # of the filter and of the interpolation
                x0, y0 = np.clip(np.floor(places.min(0)) - reach, 0, self.camera.size).astype(int)
                x1, y1 = np.clip(np.ceil(places.max(0)) + reach + 1, 0, self.camera.size).astype(int)
                if x0 >= x1 or y0 >= y1:
                    return np.zeros((size[1], size[0], 3), np.uint8)
                image, H = image[y0:y1, x0:x1], H @ np.array([[1.0, 0, x0], [0, 1, y0], [0, 0, 1]])
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)
        return np.asarray(cv2.warpPerspective(image, H, size, flags=cv2.INTER_LINEAR), np.uint8)

    def _corners(self, zoom: Zoom) -> NDArray[np.float64] | None:
        """Where (4, 2) a zoom's corners lie in the picture; None where one of them is behind the camera."""
        width, height = zoom.camera.size
        corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]], np.float64)
        there = corners @ np.linalg.inv(zoom.homography).T
        return there[:, :2] / there[:, 2:] if (there[:, 2] > 0).all() else None

    def _valid_in(self, zoom: Zoom) -> NDArray[np.bool_] | None:
        """Which pixels of a zoomed picture take their colour from valid ones alone; None where all do."""
        places = self._corners(zoom) if self.valid is None else None
        if places is not None and (places >= 0).all() and (places <= np.array(self.camera.size) - 1).all():
            return None
        valid = self.shown.astype(np.float32)
        return np.asarray(cv2.warpPerspective(valid, zoom.homography, zoom.camera.size, flags=cv2.INTER_LINEAR) > 0.99)
