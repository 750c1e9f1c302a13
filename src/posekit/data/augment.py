"""From rendered pairs to training samples: background, occluders, light, blur, noise, imperfect masks. Layer 3."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.data.pairs import ANCHOR, Pair
from posekit.data.procedural import noise_image, photo_crop, random_colour

Image = NDArray[np.uint8]
Rng = np.random.Generator


@dataclass(frozen=True)
class AugmentConfig:
    """Probabilities and ranges; lengths in pixels of a crop 160 wide.

    photo: share of photo backgrounds, where photos are at hand. clutter: most objects pasted behind.
    occluded: share with something in front. shrink: the observed crop is shrunk by up to this factor and
    re-enlarged, since real objects are small in their photographs. dilate: largest dilation of the mask (the
    paper's 40 px at 640x480). grown: share of the masks of another size that are too large, not too small; the
    paper's are always too large, and a network that learned from such masks alone takes an exact one for too large
    and the object for smaller and further away than it is. no_mask, box_mask, cut_mask: shares of masks left out,
    replaced by the filled box, and cut in part. source_mask: share of pairs whose mask is the source's, as in a
    video, where the last frame's pose is all that is known of the next one's mask. tone: how far exposure, contrast
    and white balance stray, 0 = not at all.
    """

    photo: float = 0.6
    clutter: int = 4
    occluded: float = 0.45
    shrink: float = 4.0
    dilate: int = 10
    grown: float = 0.5
    no_mask: float = 0.15
    box_mask: float = 0.12
    cut_mask: float = 0.08
    source_mask: float = 0.0
    tone: float = 1.0


@dataclass(frozen=True, eq=False)
class Sample:
    """One training sample: observed, rendered uint8 (H, W, 4), RGB and mask; the pair's truth; visible (h, w)."""

    observed: Image
    rendered: Image
    pair: Pair
    visible: NDArray[np.bool_]


def augment(pair: Pair, others: Sequence[Pair], photos: Sequence[Image], config: AugmentConfig, rng: Rng) -> Sample:
    """Put the target before a background and behind occluders, photograph it badly, and blur what is known of
    its mask. others: pairs to take clutter and occluders from."""
    observed, hidden = observe(pair.target, [other.target for other in others], photos, config, rng)
    if config.source_mask and rng.random() < config.source_mask:
        known = disturb_mask(pair.source[..., 3] > 0, replace(config, no_mask=0.0), rng)
        observed[..., 3] = known.astype(np.uint8) * 255
    visible = pair.seen & ~_at_anchors(hidden, pair)
    return Sample(observed, pair.source, pair, visible)


def observe(
    target: Image, others: Sequence[Image], photos: Sequence[Image], config: AugmentConfig, rng: Rng
) -> tuple[Image, NDArray[np.bool_]]:
    """A rendered object, uint8 (H, W, 4) with its mask in alpha, as a bad photograph with a bad mask (H, W, 4), and
    what hides it, bool (H, W). others: renderings of the same size to take clutter and occluders from."""
    H, W = target.shape[:2]
    scene = _background((W, H), others, photos, config, rng)
    alpha = target[..., 3] > 0
    scene[alpha] = _recolour(target[..., :3], rng)[alpha]
    hidden = np.zeros((H, W), bool)
    if len(others) and rng.random() < config.occluded:
        for _ in range(int(rng.integers(1, 3))):
            _paste_occluder(scene, hidden, alpha, others[int(rng.integers(len(others)))], rng)
    observed = _photograph(scene, config, rng)
    mask = disturb_mask(alpha & ~hidden, config, rng)
    return np.dstack([observed, mask.astype(np.uint8) * 255]), hidden


def observe_photo(photo: Image, config: AugmentConfig, rng: Rng) -> Image:
    """A real photograph and its visible mask (H, W, 4), photographed once more and its mask disturbed."""
    mask = disturb_mask(photo[..., 3] > 0, config, rng)
    return np.dstack([_photograph(photo[..., :3], config, rng), mask.astype(np.uint8) * 255])


def _at_anchors(hidden: NDArray[np.bool_], pair: Pair) -> NDArray[np.bool_]:
    """``hidden`` (H, W) looked up where each anchor's surface point lies in the target, (h, w)."""
    h, w = pair.valid.shape
    H, W = hidden.shape
    home = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1) * ANCHOR + 2
    place = np.rint(home + pair.flow).astype(int)
    return hidden[place[..., 1].clip(0, H - 1), place[..., 0].clip(0, W - 1)]


def _background(size: tuple[int, int], others: Sequence[Image], photos: Sequence[Image], config: AugmentConfig,
                rng: Rng) -> Image:  # fmt: skip
    W, H = size
    if len(photos) and rng.random() < config.photo:
        scene = photo_crop(rng, photos, size).copy()
    elif rng.random() < 0.6:
        low, high = random_colour(rng), random_colour(rng)
        noise = noise_image(rng, size, int(rng.choice([1, 3])))
        scene = (low + (high - low) * noise).clip(0, 255).astype(np.uint8)
    else:
        scene = np.broadcast_to(random_colour(rng).astype(np.uint8), (H, W, 3)).copy()
    if len(others):
        for _ in range(int(rng.integers(0, config.clutter + 1))):
            other = others[int(rng.integers(len(others)))]
            M = _placement(rng, W, H, rng.uniform(0.3, 1.3))
            pasted = cv2.warpAffine(other, M, size, flags=cv2.INTER_LINEAR)
            on = pasted[..., 3] > 127
            scene[on] = pasted[..., :3][on]
    return scene


def _placement(rng: Rng, W: int, H: int, scale: float) -> NDArray[np.float64]:
    """An affine map (2, 3) that scales, turns and moves a crop anywhere over the scene."""
    M = cv2.getRotationMatrix2D((W / 2, H / 2), float(rng.uniform(0, 360)), float(scale))
    M[:, 2] += rng.uniform(-0.6, 0.6, size=2) * (W, H)
    return M


def _paste_occluder(scene: Image, hidden: NDArray[np.bool_], alpha: NDArray[np.bool_], other: Image, rng: Rng) -> None:
    """Something before the object, hiding at most 60 % of it; drawn in place."""
    H, W = hidden.shape
    M = _placement(rng, W, H, rng.uniform(0.3, 1.0))
    pasted = cv2.warpAffine(other, M, (W, H), flags=cv2.INTER_LINEAR)
    on = pasted[..., 3] > 127
    if (alpha & (on | hidden)).sum() > 0.6 * alpha.sum():
        return
    scene[on] = pasted[..., :3][on]
    hidden |= on


def _recolour(image: Image, rng: Rng) -> Image:
    """The real object's paint is never the mesh's: other gains, gamma, saturation, and light that falls off."""
    x = image.astype(np.float32) / 255
    grey = x.mean(-1, keepdims=True)
    x = grey + (x - grey) * np.float32(rng.uniform(0.5, 1.4))
    x = np.clip(x, 0, 1) ** np.float32(np.exp(rng.normal() * 0.3))
    x *= np.exp(rng.normal(size=3) * 0.08).astype(np.float32) * np.float32(np.exp(rng.normal() * 0.18))
    if rng.random() < 0.4:
        field = cv2.resize(
            rng.uniform(0.5, 1.3, size=(3, 4)).astype(np.float32), image.shape[1::-1], interpolation=cv2.INTER_CUBIC
        )
        x *= field[..., None]
    if rng.random() < 0.3:
        x = cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.5, 1.5)))
    return (np.clip(x, 0, 1) * 255).astype(np.uint8)


def _photograph(scene: Image, config: AugmentConfig, rng: Rng) -> Image:
    """Exposure, white balance, defocus, motion, few pixels, sensor noise and JPEG, in a camera's order."""
    H, W = scene.shape[:2]
    x: NDArray[np.float32] = scene.astype(np.float32) / np.float32(255)
    if rng.random() < 0.8:
        tone = config.tone
        x = np.clip(x, 0, 1) ** np.float32(np.exp(rng.normal() * 0.2 * tone))
        x *= np.exp((rng.normal(size=3) * 0.07 + rng.normal() * 0.18) * tone).astype(np.float32)
        contrast = np.float32(rng.uniform(0.75, 1.2) ** tone)
        x = (x - np.float32(0.5)) * contrast + np.float32(0.5 + rng.normal() * 0.04 * tone)
    if rng.random() < 0.4:
        x = cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.4, 1.8)))
    if rng.random() < 0.12:
        x = _motion_blur(x, rng)
    factor = float(np.exp(rng.uniform(0.0, np.log(config.shrink)))) if rng.random() < 0.8 else 1.0
    small = (max(8, round(W / factor)), max(8, round(H / factor)))
    if factor > 1.0:
        x = cv2.resize(x, small, interpolation=cv2.INTER_AREA)
    if rng.random() < 0.7:
        sigma = rng.uniform(0.0, 0.045)
        x = x + rng.standard_normal(x.shape, dtype=np.float32) * np.float32(sigma)
    image = (np.clip(x, 0, 1) * 255).astype(np.uint8)
    if rng.random() < 0.3:
        ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 96))])
        assert ok
        image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return cv2.resize(image, (W, H), interpolation=cv2.INTER_LINEAR) if factor > 1.0 else image


def _motion_blur(x: NDArray[np.float32], rng: Rng) -> NDArray[np.float32]:
    length = int(rng.integers(3, 9))
    kernel = np.zeros((length, length), np.float32)
    angle = rng.uniform(0, np.pi)
    half = (length - 1) / 2
    reach = half * np.array([np.cos(angle), np.sin(angle)])
    start, end = (half - reach).round().astype(int), (half + reach).round().astype(int)
    cv2.line(kernel, start.tolist(), end.tolist(), 1.0)
    return cv2.filter2D(x, -1, kernel / kernel.sum())


def disturb_mask(mask: NDArray[np.bool_], config: AugmentConfig, rng: Rng) -> NDArray[np.bool_]:
    """What a detector or a person might give instead of the true visible mask (H, W)."""
    kind = rng.random()
    if kind < config.no_mask or not mask.any():
        return np.zeros_like(mask)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if kind < config.no_mask + config.box_mask:
        box = np.zeros_like(mask)
        box[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = True
        return box
    out: Image = mask.astype(np.uint8)
    if kind < config.no_mask + config.box_mask + config.cut_mask:
        centre = [int(rng.choice(columns)), int(rng.choice(rows))]
        axes = [int(a) for a in rng.integers(5, 30, size=2)]
        cv2.ellipse(out, centre, axes, float(rng.uniform(0, 180)), 0, 360, int(rng.integers(2)), -1)
    if rng.random() < 0.45:
        out = _resize_mask(out, config, rng)
    if rng.random() < 0.2:
        noise = noise_image(rng, mask.shape[::-1], 1)[..., 0] - 0.5
        soft = cv2.GaussianBlur(out.astype(np.float32), (0, 0), float(rng.uniform(1, 3)))
        out = (soft + 0.8 * noise > 0.5).astype(np.uint8)
    return out.astype(bool)


def _resize_mask(mask: Image, config: AugmentConfig, rng: Rng) -> Image:
    """A mask (H, W) grown or worn off by a few pixels; one that would vanish stays."""
    radius = int(rng.integers(0, config.dilate // 2 + 1)) if rng.random() < 0.4 else int(rng.integers(0, 2))
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    if rng.random() < config.grown:
        return cv2.dilate(mask, kernel).astype(np.uint8)
    worn = cv2.erode(mask, kernel).astype(np.uint8)
    return worn if worn.sum() > 0.4 * mask.sum() else mask
