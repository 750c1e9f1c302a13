"""How an object looks in the video, learned while it is followed.

A mesh may have no colours, or other ones than the object in the video. Frames whose poses the evidence bears out show
what it looks like: they are projected onto the mesh, which is then drawn as the video showed it. So what is in front of
the object is told by its colours. (The network compares the mesh as it is: with what earlier frames showed, it repeats
the errors of their poses.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.align.colour_edge import off_colour
from posekit.camera import Camera
from posekit.geometry import Pose
from posekit.view import View

Mask = NDArray[np.bool_]

SETTLED = 4  # frames before the first is kept: by then outlines have corrected a first pose that is some degrees wrong
MOST = 16  # frames that are kept
USED = 2  # of them, those whose directions are nearest, for one drawing
APART = math.radians(12.0)  # between the directions of two kept frames
EDGE = 2  # pixels beside an outline or what hides the object, whose colours are mixed
OFF_SURFACE = (
    0.02  # diameters between a point and the one that a kept frame shows in its place, from which it is hidden
)
STEEP = 3.0  # pixels of a kept frame that such a distance may be, too: on steep surfaces neighbours are far apart
LEAST_SHOWN = 0.5  # share of a silhouette that a kept frame shows
LEAST_KNOWN = 0.7  # share of what a frame shows of the object, below which the frame is kept, too
MISSED = 4  # frames in a row that show something else, after which a kept frame's pixel is taken for no part of it
# the mesh's colours are taken for wrong where its chromaticities are further than this from the first frame's, in the
# median, or where its brightness is correlated with the frame's less than this
HUE_OFF, LEAST_CORRELATED = 0.06, 0.2


@dataclass(frozen=True, eq=False)
class Look:
    """One frame's crop. image: uint8 RGB (H, W, 3). camera: of the crop. T_view_ctr: the pose in it. points: float32
    (H, W, 3), of the surface, metres in ``ctr``, NaN where the object's colour is not seen. direction: (3,), unit, from
    the object's centre to the camera, in ``ctr``. missed: uint8 (H, W), for how many frames another colour was seen."""

    image: NDArray[np.uint8]
    camera: Camera
    T_view_ctr: Pose
    points: NDArray[np.float32]
    direction: NDArray[np.float64]
    missed: NDArray[np.uint8]


class Appearance:
    """Frames that show an object, at most `MOST`, and its drawing with what they show.

    center: (3,), the mesh's; diameter: metres.
    """

    def __init__(self, center: NDArray[np.float64], diameter: float) -> None:
        self.center, self.diameter = center, diameter
        self.looks: list[Look] = []
        self._frames = 0  # that were compared
        self._known = 1.0  # share of what the last compared frame shows of the object that was painted
        # of the last drawing: kept frames, their pixels (N, 2), and the pixels (N,), (N,) painted with them
        self._painted: list[tuple[Look, NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]] = []

    def wants(self, T_view_ctr: Pose) -> bool:
        """Whether no kept frame shows this side, or too little of what the last compared frame showed of it; not in the
        first frames."""
        if self._frames < SETTLED:
            return False
        direction = towards_camera(T_view_ctr)
        apart = all(float(direction @ look.direction) < math.cos(APART) for look in self.looks)
        return apart or (self._known < LEAST_KNOWN and len(self.looks) < MOST)

    def keep(self, seen: View, drawn: View, T_view_ctr: Pose, visible: Mask) -> None:
        """A frame's crop; drawn: the mesh at this pose, with mask and coords. visible: (H, W), where the crop shows the
        object. Nothing is kept of an object that is hidden for the most part."""
        assert drawn.mask is not None and drawn.coords is not None
        shown = drawn.mask & visible & seen.shown
        if shown.sum() < LEAST_SHOWN * drawn.mask.sum():
            return
        inner = _inside(shown)
        points = np.where(inner[..., None], drawn.coords - self.center.astype(np.float32), np.float32(np.nan))
        direction = towards_camera(T_view_ctr)
        missed = np.zeros(shown.shape, np.uint8)
        self.looks.append(Look(seen.image, seen.camera, T_view_ctr, points, direction, missed))
        if len(self.looks) > MOST:  # one of the two that are most alike; the first one has drifted least
            directions = np.stack([look.direction for look in self.looks])
            alike = directions @ directions.T - 2 * np.eye(len(directions))
            del self.looks[1 + int(np.argmax(alike[1:].max(axis=1)))]

    def painted(self, drawn: View, T_view_ctr: Pose) -> tuple[NDArray[np.uint8], Mask]:
        """The drawing (uint8 RGB, H, W, 3) of a mesh with the colours of the kept frames, where one shows them, and
        where (H, W) that is; elsewhere the drawing is as it was. drawn: with mask and coords, at this pose."""
        assert drawn.mask is not None and drawn.coords is not None
        image, known = drawn.image.copy(), np.zeros_like(drawn.mask)
        rows, columns = np.nonzero(drawn.mask)
        points = drawn.coords[rows, columns] - self.center.astype(np.float32)
        direction = towards_camera(T_view_ctr)
        self._painted = []
        for look in sorted(self.looks, key=lambda each: -float(direction @ each.direction))[:USED]:
            if not len(points):
                break
            there, found = self._shown(look, points)
            colours = cv2.remap(look.image, there[None, :, 0], there[None, :, 1], cv2.INTER_LINEAR)[0]
            image[rows[found], columns[found]] = colours[found]
            known[rows[found], columns[found]] = True
            self._painted.append((look, np.rint(there[found]).astype(np.intp), rows[found], columns[found]))
            rows, columns, points = rows[~found], columns[~found], points[~found]
        return image, known

    def compare(self, other: Mask, shown: Mask) -> None:
        """What a frame told of the last drawing. other: (H, W), where it has another colour than was painted; shown:
        (H, W), where it shows the object.

        What hid the object in a kept frame is forgotten when the object is seen there for `MISSED` frames."""
        self._frames += 1
        inner, known = _inside(shown), 0
        for look, pixels, rows, columns in self._painted:
            known += int(inner[rows, columns].sum())
            at = pixels[:, 1], pixels[:, 0]
            look.missed[at] = np.where(other[rows, columns], np.minimum(look.missed[at] + 1, MISSED), 0)
            gone = look.missed[at] >= MISSED
            look.points[pixels[gone, 1], pixels[gone, 0]] = np.nan
        if inner.any():
            self._known = known / int(inner.sum())

    def _shown(self, look: Look, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], Mask]:
        """Pixels (N, 2) of a kept frame at which points (N, 3) of ``ctr`` lie, and which of them it shows."""
        R, t = look.T_view_ctr.R.astype(np.float32), look.T_view_ctr.t.astype(np.float32)
        placed = points @ R.T + t
        depth = np.maximum(placed[:, 2], np.float32(1e-3))
        camera = look.camera
        u = camera.fx / depth * placed[:, 0] + camera.cx
        v = camera.fy / depth * placed[:, 1] + camera.cy
        there = np.stack([u, v], axis=1).astype(np.float32)
        size = np.array(camera.size) - 1
        nearest = np.clip(np.rint(there), 0, size).astype(np.intp)
        off = look.points[nearest[:, 1], nearest[:, 0]] - points
        limit = OFF_SURFACE * self.diameter + STEEP * float(look.T_view_ctr.t[2]) / camera.fx
        found = np.einsum("ni,ni->n", off, off) < limit**2  # never where it is NaN
        return there, np.asarray(found & (there >= 0).all(axis=1) & (there <= size).all(axis=1))


def _inside(mask: Mask) -> Mask:
    """Without `EDGE` pixels at its edge."""
    return np.asarray(cv2.erode(mask.astype(np.uint8), np.ones((2 * EDGE + 1, 2 * EDGE + 1), np.uint8)) > 0)


def colours_agree(seen: View, drawn: View, visible: Mask) -> bool:
    """Whether a frame's crop has the colours of the mesh drawn there. visible: (H, W), where it shows the object."""
    chroma, correlation = colour_agreement(seen, drawn, visible)
    return chroma < HUE_OFF and correlation > LEAST_CORRELATED


def colour_agreement(seen: View, drawn: View, visible: Mask) -> tuple[float, float]:
    """The median distance of the chromaticities of a frame's crop from those of the mesh drawn there, and the
    correlation of their brightness, -1 to 1 (0 where either has one brightness)."""
    assert drawn.mask is not None
    inner = cv2.erode((drawn.mask & visible & seen.shown).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    if not inner.any():
        return 0.0, 0.0
    apart = float(np.median(np.linalg.norm(off_colour(seen, drawn)[inner], axis=1)))
    first, second = (cv2.cvtColor(v.image, cv2.COLOR_RGB2GRAY)[inner].astype(np.float64) for v in (seen, drawn))
    first, second = first - first.mean(), second - second.mean()
    size = float(np.linalg.norm(first) * np.linalg.norm(second))
    return apart, float(first @ second) / size if size > 0 else 0.0


def towards_camera(T_view_ctr: Pose) -> NDArray[np.float64]:
    """From the object's centre to the camera, in ``ctr``, unit."""
    towards = -T_view_ctr.R.T @ T_view_ctr.t
    return np.asarray(towards / max(float(np.linalg.norm(towards)), 1e-9))
