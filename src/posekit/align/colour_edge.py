"""Where a frame's colours put the object's outline.

The colours of the object and of what is round it are learned from the frames before. Along each normal of the rendered
outline, the place that parts them best is where the outline should lie (correspondence lines: Tjaden et al., 2017;
Stoiber et al., 2022). This takes no texture, no edges and no training, and does not drift.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.align.gauss_newton import Lines
from posekit.view import View

Array = NDArray[np.float64]
FArray = NDArray[np.float32]
Mask = NDArray[np.bool_]
Outline = tuple[FArray, FArray]

BINS = 32  # of each channel
COUNT = 240  # lines at most
REACH, TAIL = 6, 4  # pixels: how far an outline is looked for, and what is looked at beyond
CLEAR, SOFT = 0.42, 0.7  # the step between inside and outside: half its height, and its width in pixels
SIGMA = 0.5  # pixels, the least standard deviation of a line
LEAST = 20  # lines
MIXED, BOTH, EDGE = 2, 2, 30.0  # pixels to either side that mix colours, that show them, and a clear step's grey values
BAND = 3  # pixels on either side of an edge in which `contrast` looks
GAP, RING = 1, 14  # pixels beside the outline that no colours are learned from, and how far the surroundings reach
BLUR = 1.0  # pixels over which neighbouring probabilities are averaged
ASIDE, ENDS = 3.0, 0.25  # pixels beside an outline; by how much the object's chance falls across it where it ends
HUE = 0.12  # distance of chromaticities beyond which a pixel is not the mesh's
SUDDEN, SMOOTH = 0.12, 1.0  # the same beyond what it has been before; pixels over which that is averaged
# pixels: how deep a hidden part is that no pose's error explains, and how near to it outlines are not used
HIDDEN, BESIDE = 2, 5


@dataclass(frozen=True, eq=False)
class Colours:
    """inside, outside: (BINS**3,), the share of each colour on the object and round it."""

    inside: FArray
    outside: FArray

    def mixed(self, newer: Colours, share: float) -> Colours:
        """With a share of newer ones."""
        return Colours(
            (1 - share) * self.inside + share * newer.inside, (1 - share) * self.outside + share * newer.outside
        )

    @cached_property
    def chance(self) -> FArray:
        """(BINS**3,), that a pixel of this colour is the object's."""
        inside, outside = self.inside + np.float32(1e-6), self.outside + np.float32(1e-6)
        return np.asarray(inside / (inside + outside), np.float32)

    def posterior(self, image: NDArray[np.uint8]) -> FArray:
        """The probability (...) that a pixel of this colour is the object's; image: uint8 RGB (..., 3)."""
        return np.asarray(self.chance[_index(image)], np.float32)

    def seen(self, view: View) -> Mask:
        """Where (H, W) the colours are rather the object's."""
        return np.asarray(cv2.GaussianBlur(self.posterior(view.image), (0, 0), BLUR) > 0.35)


@dataclass(frozen=True, eq=False)
class Tint:
    """How far from the mesh's the colours of a frame's crop have been. apart: (H, W, 3), of chromaticities.

    Light, wear and the camera change the mesh's colours slowly. What is suddenly further from them is something else
    in front of the object, even where it has colours that the object has elsewhere.
    """

    apart: FArray

    @classmethod
    def of(cls, apart: FArray, seen: Mask) -> Tint:
        """Of one frame. seen: (H, W), where it shows the object; elsewhere the median is taken."""
        usual = np.median(apart[seen], axis=0) if seen.any() else np.zeros(3, np.float32)
        return cls(np.where(seen[..., None], cv2.GaussianBlur(apart, (0, 0), SMOOTH), usual).astype(np.float32))

    def hides(self, apart: FArray, silhouette: Mask) -> Mask:
        """Where (H, W) something else is before the silhouette."""
        further = apart - self.apart
        far = silhouette & (_sum(further * further) > SUDDEN**2)
        return np.asarray(cv2.morphologyEx(far.astype(np.uint8), cv2.MORPH_OPEN, _disc(1)) > 0)

    def mixed(self, newer: Tint, share: float) -> Tint:
        """With a share of a newer one."""
        return Tint((1 - share) * self.apart + share * newer.apart)


def learn(view: View, silhouette: Mask, seen: Mask) -> Colours:
    """From a frame's crop. silhouette, seen: (H, W), the rendered one and what of it the frame shows."""
    solid, shown = silhouette.astype(np.uint8), view.shown
    inner = (cv2.erode(solid, _disc(GAP)) > 0) & seen & shown
    outer = (cv2.dilate(solid, _disc(RING)) > cv2.dilate(solid, _disc(GAP))) & shown
    return Colours(_histogram(_index(view.image[inner])), _histogram(_index(view.image[outer])))


def like_mesh(view: View, drawn: View) -> Mask:
    """Where (H, W) a frame's crop has the hue of the mesh drawn there: a first guess of what is not hidden."""
    return np.asarray(np.linalg.norm(off_colour(view, drawn), axis=2) < HUE)


def unhidden(view: View, drawn: View) -> Mask:
    """A first guess of where (H, W) a frame's crop shows the object rather than something before it.

    Parts with another hue than the mesh may be hidden, or the mesh's colours may be wrong. What hides the object goes
    on beyond its outline, so the colours on both sides of the outline are alike there; the object itself ends there.
    """
    assert drawn.mask is not None
    solid = drawn.mask
    unlike = (solid & ~like_mesh(view, drawn)).astype(np.uint8)
    visible = ~cv2.morphologyEx(unlike, cv2.MORPH_OPEN, _disc(1)).astype(bool)
    pixels, normals = find_outline(solid)
    if not len(pixels):
        return visible
    chance = cv2.GaussianBlur(learn(view, solid, np.ones_like(solid)).posterior(view.image), (0, 0), BLUR)
    (inner, _), (outer, shown) = (_pixels(pixels + side * ASIDE * normals, view) for side in (-1, 1))
    step = chance[inner[:, 1], inner[:, 0]] - chance[outer[:, 1], outer[:, 0]]
    count, parts = cv2.connectedComponents((~visible).astype(np.uint8))
    there = parts[inner[:, 1], inner[:, 0]]
    for part in range(1, count):
        steps = step[(there == part) & shown]
        if not len(steps) or np.median(steps) > ENDS:
            visible[parts == part] = True
    return visible


def off_colour(view: View, drawn: View) -> FArray:
    """How far (H, W, 3) the chromaticities of a frame's crop are from those of the mesh drawn there."""
    return chromaticity(view.image) - chromaticity(drawn.image)


def outline_lines(
    view: View, drawn: View, colours: Colours, seen: Mask, center: Array, outline: Outline | None = None
) -> Lines | None:
    """Where the outline of ``drawn`` (mask and coords) should lie in a frame's crop of the same camera; None where too
    little of it can be found. seen: (H, W), what the crop shows of the object: outlines elsewhere are not used.
    center: (3,), the model's. outline: of ``drawn.mask``, where it is known already."""
    assert drawn.mask is not None and drawn.coords is not None
    pixels, normals = outline or find_outline(drawn.mask)
    if len(pixels) < LEAST:
        return None
    along = np.arange(-REACH - TAIL, REACH + TAIL + 1, dtype=np.float32)
    at, inside = _pixels(pixels[:, None] + normals[:, None] * along[None, :, None], view)
    image = view.image[at[..., 1], at[..., 0]]
    posterior = colours.posterior(image)
    posterior[~inside] = 0.5
    mean, sigma = _offsets(posterior, along)
    mean = _halfway(image, mean)
    places = pixels + normals * mean[:, None]
    there, _ = _pixels(places, view)
    near = cv2.dilate(seen.astype(np.uint8), np.ones((5, 5), np.uint8))[there[:, 1], there[:, 0]] > 0
    # the edge of what hides the object would be taken for its outline
    hidden = cv2.erode((drawn.mask & ~seen).astype(np.uint8), _disc(HIDDEN))
    near_occluder = cv2.dilate(hidden, _disc(HIDDEN + BESIDE))[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] > 0
    usable = near & ~near_occluder & (sigma < 0.5 * REACH) & (np.abs(mean) < REACH - 1.5)
    usable &= inside[:, TAIL:-TAIL].mean(axis=1) > 0.9
    if usable.sum() < LEAST:
        return None
    columns, rows = pixels[usable].astype(int).T
    points = drawn.coords[rows, columns].astype(np.float64) - center
    return Lines(*(array.astype(np.float64) for array in (points, places[usable], normals[usable], sigma[usable])))


def contrast(view: View, silhouette: Mask, colours: Colours) -> float:
    """How well a silhouette (H, W) separates the object's colours from its surroundings' in a frame's crop, -1 to 1.

    The mean probability that a pixel is the object's in a band inside its edge, less that in a band outside; 0 where
    there is no band.
    """
    solid = silhouette.astype(np.uint8)
    shown = view.shown
    deep = cv2.erode(solid, _disc(BAND + 1), borderValue=1) > 0
    inner = (cv2.erode(solid, _disc(1)) > 0) & ~deep & shown
    outer = (cv2.dilate(solid, _disc(BAND + 1)) > cv2.dilate(solid, _disc(1))) & shown
    if not inner.any() or not outer.any():
        return 0.0
    chance = colours.posterior(view.image)
    return float(chance[inner].mean() - chance[outer].mean())


def find_outline(mask: Mask) -> Outline:
    """Pixels (N, 2) of the mask's outline, but for those at the crop's edge, and its normals (N, 2), outwards."""
    edge = mask & (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    edge[[0, -1]] = edge[:, [0, -1]] = False
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 2.0)
    rows, columns = np.nonzero(edge)
    slope = np.stack(
        [cv2.Sobel(soft, cv2.CV_32F, 1, 0)[rows, columns], cv2.Sobel(soft, cv2.CV_32F, 0, 1)[rows, columns]]
    )
    length = np.linalg.norm(slope, axis=0)
    chosen = np.flatnonzero(length > 1e-3)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(COUNT, len(chosen))).astype(int)]
    return np.stack([columns, rows], axis=1)[chosen].astype(np.float32), -(slope / np.maximum(length, 1e-6)).T[chosen]


def _offsets(posterior: FArray, along: FArray) -> tuple[FArray, FArray]:
    """Mean and standard deviation (N,) of where each line (N, S) parts object and surroundings, pixels outwards."""
    shifts = np.arange(-REACH, REACH + 1, dtype=np.float32)
    # an outline's pixel lies half a pixel inside it
    step = 0.5 - CLEAR * np.tanh((along[:, None] - shifts - 0.5) / (2 * SOFT))
    likely = np.log(posterior[..., None] * step + (1 - posterior[..., None]) * (1 - step)).sum(axis=1)
    weight = np.exp(likely - likely.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    mean = weight @ shifts
    variance = (weight * (shifts - mean[:, None]) ** 2).sum(axis=1)
    return mean, np.sqrt(np.maximum(variance, SIGMA**2))


def _halfway(image: NDArray[np.uint8], mean: FArray) -> FArray:
    """Offsets (N,) again, where each line (N, S, 3) is halfway between the colours on either side.

    Pixels that mix the two are similar to neither, and by their chances the object's or its surroundings' depending on
    what colours these have: outlines found by chances alone lie up to a pixel too far out or in.
    """
    middle = np.rint(mean).astype(np.intp)
    window = middle[:, None] + np.arange(-MIXED - BOTH, MIXED + BOTH + 1) + image.shape[1] // 2
    colours = np.take_along_axis(image, window.clip(0, image.shape[1] - 1)[..., None], axis=1).astype(np.float32)
    inner, outer = colours[:, :BOTH].mean(axis=1), colours[:, -BOTH:].mean(axis=1)
    step = outer - inner
    size = np.einsum("ni,ni->n", step, step)
    share = 1 - np.einsum("nsi,ni->ns", colours[:, BOTH:-BOTH] - inner[:, None], step) / np.maximum(size, 1)[:, None]
    found = middle - MIXED - 1 + share.clip(0, 1).sum(axis=1)
    clear = (size > EDGE**2) & (np.abs(found - mean) < MIXED)
    return np.asarray(np.where(clear, found, mean), np.float32)


def _pixels(places: FArray, view: View) -> tuple[NDArray[np.intp], Mask]:
    """Nearest pixels (..., 2), and whether they lie in the photograph."""
    nearest = np.rint(places).astype(np.intp)
    clipped = np.clip(nearest, 0, np.array(view.camera.size) - 1)
    inside = (nearest == clipped).all(axis=-1) & view.shown[clipped[..., 1], clipped[..., 0]]
    return clipped, inside


def _index(image: NDArray[np.uint8]) -> NDArray[np.intp]:
    bins = (image // (256 // BINS)).astype(np.uint16)
    return np.asarray((bins[..., 0] * BINS + bins[..., 1]) * BINS + bins[..., 2], np.intp)


def _histogram(index: NDArray[np.intp]) -> FArray:
    counts = np.bincount(index, minlength=BINS**3).astype(np.float32).reshape(BINS, BINS, BINS)
    for axis in range(3):  # neighbouring colours are similar
        counts = 0.5 * counts + 0.25 * (np.roll(counts, 1, axis) + np.roll(counts, -1, axis))
    return np.asarray(counts.ravel() / max(1.0, float(counts.sum())), np.float32)


def chromaticity(image: NDArray[np.uint8]) -> FArray:
    """Each channel's share (H, W, 3) of a smoothed picture's brightness."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32) + 8
    return np.asarray(smooth / _sum(smooth)[..., None], np.float32)


def _sum(image: FArray) -> FArray:
    """Over three channels; numpy's own sum takes ten times as long."""
    return np.asarray(image[..., 0] + image[..., 1] + image[..., 2], np.float32)


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)
