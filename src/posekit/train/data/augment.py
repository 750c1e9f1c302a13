"""From rendered pairs to training samples: background, occluders, light, blur, noise, imperfect masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import box_mask
from posekit.synth.procedural import noise_image, photo_crop, random_colour
from posekit.train.data.pairs import ANCHOR, Pair

Image = NDArray[np.uint8]
Rng = np.random.Generator
LEVELS = np.arange(256, dtype=np.float64)[:, None].repeat(3, 1)  # (256, 3)


@dataclass(frozen=True)
class AugmentConfig:
    """Probabilities and ranges; lengths in pixels of a crop 160 wide."""

    photo: float = 0.75  # share of photo backgrounds, where photos are at hand
    clutter: int = 4  # most objects pasted behind
    camouflage: float = 0.2  # share of backgrounds that take on the object's own colours
    soft: float = 0.8  # share of objects whose edges mix with what is behind
    occluded: float = 0.45  # share with something in front
    shrink: float = 3.0  # the observed crop is shrunk by up to this and re-enlarged, since real objects are small
    dilate: int = 10  # largest dilation of the mask (the paper's 40 px at 640x480)
    # share of the masks of another size that are too large, not too small; the paper's are always too large, and a
    # network that learned from such masks alone takes an exact one for too large and the object for smaller and
    # further away than it is
    grown: float = 0.5
    # no_mask, box_mask, cut_mask: shares of masks left out, replaced by the filled box, and cut in part
    no_mask: float = 0.15
    box_mask: float = 0.12
    cut_mask: float = 0.08
    tone: float = 1.0  # strength of changes of exposure, contrast and white balance, 0 = none
    # share of pictures with one of MegaPose's stronger changes: little or much contrast, brightness or colour, grey,
    # sharpened
    harsh: float = 0.35


@dataclass(frozen=True, eq=False)
class Sample:
    """One training sample: observed uint8 (H, W, 3); rendered uint8 (H, W, 4), RGB and mask; the pair's truth; visible
    bool (h, w), of the rendered anchors; silhouettes uint8 (2, h, w), 255 where a whole 4x4 block of the observed crop
    shows the object, and would if nothing stood before it."""

    observed: Image
    rendered: Image
    pair: Pair
    visible: NDArray[np.bool_]
    silhouettes: Image


def augment(pair: Pair, others: Sequence[Pair], photos: Sequence[Image], config: AugmentConfig, rng: Rng) -> Sample:
    """Put the target before a background and behind occluders, and photograph it badly. others: pairs to take clutter
    and occluders from."""
    observed, hidden = composed(pair.target, [other.target for other in others], photos, config, rng)
    visible = pair.seen & ~_at_anchors(hidden, pair)
    whole = pair.target[..., 3] > 0
    H, W = whole.shape
    masks = np.stack([whole & ~hidden, whole]).astype(np.uint8) * 255
    shares = np.stack([cv2.resize(m, (W // ANCHOR, H // ANCHOR), interpolation=cv2.INTER_AREA) for m in masks])
    return Sample(observed, pair.source, pair, visible, shares)


def observe(
    target: Image, others: Sequence[Image], photos: Sequence[Image], config: AugmentConfig, rng: Rng
) -> tuple[Image, NDArray[np.bool_]]:
    """As `composed`, with a bad mask beside the picture: (H, W, 4) and (H, W)."""
    observed, hidden = composed(target, others, photos, config, rng)
    mask = disturb_mask((target[..., 3] > 0) & ~hidden, config, rng)
    return np.dstack([observed, mask.astype(np.uint8) * 255]), hidden


def composed(
    target: Image, others: Sequence[Image], photos: Sequence[Image], config: AugmentConfig, rng: Rng
) -> tuple[Image, NDArray[np.bool_]]:
    """A rendered object, uint8 (H, W, 4) with its mask in alpha, in a bad photograph (H, W, 3), and what hides it, bool
    (H, W). others: renderings of the same size to take clutter and occluders from."""
    H, W = target.shape[:2]
    alpha = target[..., 3] > 0
    paint = _recolour(target[..., :3], rng)
    scene = _background((W, H), others, photos, config, rng)
    if rng.random() < config.camouflage and alpha.any():
        scene = _coloured_like(scene, paint[alpha], rng)
    scene = _pasted(scene, paint, alpha, float(rng.uniform(0.4, 0.9)) if rng.random() < config.soft else 0.0)
    hidden = np.zeros((H, W), bool)
    if len(others) and rng.random() < config.occluded:
        for _ in range(int(rng.integers(1, 3))):
            _paste_occluder(scene, hidden, alpha, others[int(rng.integers(len(others)))], rng)
    return _photograph(scene, config, rng), hidden


def _pasted(scene: Image, paint: Image, alpha: NDArray[np.bool_], sigma: float) -> Image:
    """The object (H, W, 3) before the scene, its edges mixed over about ``sigma`` pixels as a lens does."""
    if sigma <= 0:
        scene[alpha] = paint[alpha]
        return scene
    share = alpha.astype(np.float32)
    soft = cv2.GaussianBlur(share, (0, 0), sigma)
    # the object's colours alone, smoothed into what lies beside it: the rendering is black there
    own = cv2.GaussianBlur(cv2.copyTo(paint, alpha.astype(np.uint8)), (0, 0), sigma)
    own = cv2.divide(own, cv2.merge([np.maximum(soft, np.float32(1e-2))] * 3), dtype=cv2.CV_8U)
    own[alpha] = paint[alpha]
    return np.asarray(cv2.blendLinear(own, scene, soft, 1 - soft), np.uint8)


def _coloured_like(scene: Image, colours: NDArray[np.uint8], rng: Rng) -> Image:
    """The scene with the mean and the spread of the object's colours (N, 3), in part."""
    mean, spread = (v[:, 0] for v in cv2.meanStdDev(scene))
    wanted, own = (v[:, 0] for v in cv2.meanStdDev(colours[:, None]))
    gain = (own + 4) / (spread + 4) * rng.uniform(0.7, 1.5)
    share = rng.uniform(0.5, 1.0)
    return _mapped(scene, LEVELS + ((LEVELS - mean) * gain + wanted - LEVELS) * share)


def _mapped(image: Image, levels: NDArray[np.float64]) -> Image:
    """Each channel through its table: levels (256, 3), in 0..255."""
    return np.asarray(cv2.LUT(image, np.rint(levels).clip(0, 255).astype(np.uint8)[None]), np.uint8)


def observe_photo(photo: Image, config: AugmentConfig, rng: Rng) -> Image:
    """A real photograph and its visible mask (H, W, 4), photographed once more and its mask disturbed."""
    mask = disturb_mask(photo[..., 3] > 0, config, rng)
    return np.dstack([_photograph(np.ascontiguousarray(photo[..., :3]), config, rng), mask.astype(np.uint8) * 255])


def _at_anchors(hidden: NDArray[np.bool_], pair: Pair) -> NDArray[np.bool_]:
    """``hidden`` (H, W) looked up where each anchor's surface point lies in the target, (h, w)."""
    h, w = pair.valid.shape
    H, W = hidden.shape
    place = np.rint(_anchor_pixels(h, w) + pair.flow).astype(int)
    return hidden[place[..., 1].clip(0, H - 1), place[..., 0].clip(0, W - 1)]


@cache
def _anchor_pixels(h: int, w: int) -> NDArray[np.int64]:
    """The anchors' pixels (h, w, 2)."""
    return np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1) * ANCHOR + 2


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
    x = _saturated(image, rng.uniform(0.5, 1.4))
    gains = np.exp(rng.normal(size=3) * 0.08) * np.exp(rng.normal() * 0.18)
    x = _mapped(x, 255 * (LEVELS / 255) ** np.exp(rng.normal() * 0.3) * gains)
    if rng.random() < 0.4:
        field = cv2.resize(
            rng.uniform(0.5, 1.3, size=(3, 4)).astype(np.float32), image.shape[1::-1], interpolation=cv2.INTER_CUBIC
        )
        x = cv2.multiply(x, cv2.merge([field] * 3), dtype=cv2.CV_8U)
    if rng.random() < 0.3:
        x = cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.5, 1.5)))
    return np.asarray(x, np.uint8)


def _saturated(image: Image, amount: float) -> Image:
    """The picture with so many times its colour; 0 = grey."""
    return np.asarray(cv2.transform(image, amount * np.eye(3) + (1 - amount) / 3), np.uint8)


def _photograph(scene: Image, config: AugmentConfig, rng: Rng) -> Image:
    """Exposure, white balance, defocus, motion, few pixels, sensor noise and JPEG, in a camera's order."""
    H, W = scene.shape[:2]
    x = scene
    if rng.random() < 0.8:
        x = _mapped(x, 255 * _tone(LEVELS / 255, config.tone, rng))
    if rng.random() < config.harsh:
        x = _strong_change(x, rng)
    if rng.random() < 0.4:
        x = cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.4, 1.8)))
    if rng.random() < 0.12:
        x = _motion_blur(x, rng)
    factor = float(np.exp(rng.uniform(0.0, np.log(config.shrink)))) if rng.random() < 0.8 else 1.0
    small = (max(8, round(W / factor)), max(8, round(H / factor)))
    if factor > 1.0:
        x = cv2.resize(x, small, interpolation=cv2.INTER_AREA)
    if rng.random() < 0.7:
        x = cv2.add(x, _noise(x.shape[:2], rng) * np.float32(rng.uniform(0.0, 0.045) * 255), dtype=cv2.CV_8U)
    if rng.random() < 0.3:
        ok, data = cv2.imencode(".jpg", x, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 96))])
        assert ok
        x = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return np.asarray(cv2.resize(x, (W, H), interpolation=cv2.INTER_LINEAR) if factor > 1.0 else x, np.uint8)


def _tone(levels: NDArray[np.float64], tone: float, rng: Rng) -> NDArray[np.float64]:
    """Gamma, white balance, exposure, contrast and offset of levels (256, 3) in 0..1; tone: how strong the changes
    are."""
    x = levels ** np.exp(rng.normal() * 0.2 * tone)
    x = x * np.exp((rng.normal(size=3) * 0.07 + rng.normal() * 0.18) * tone)
    return np.asarray((x - 0.5) * rng.uniform(0.75, 1.2) ** tone + 0.5 + rng.normal() * 0.04 * tone)


def _noise(size: tuple[int, int], rng: Rng) -> NDArray[np.float32]:
    """Normal noise (H, W, 3): a part of a picture of noise that is drawn once, since drawing takes most of the time."""
    H, W = size
    bank = _noise_bank(-(-H // 256) * 256 + 256, -(-W // 256) * 256 + 256)
    y, x = int(rng.integers(bank.shape[0] - H)), int(rng.integers(bank.shape[1] - W))
    return bank[y : y + H, x : x + W]


@cache
def _noise_bank(height: int, width: int) -> NDArray[np.float32]:
    return np.random.default_rng(0).standard_normal((height, width, 3), dtype=np.float32)


def _strong_change(x: Image, rng: Rng) -> Image:
    """One strong change of contrast, brightness or colour, or a sharpened picture."""
    kind = int(rng.integers(5))
    if kind == 0:
        mean = np.mean(cv2.mean(x)[:3])
        return _mapped(x, mean + (LEVELS - mean) * np.exp(rng.uniform(np.log(0.25), np.log(3.0))))
    if kind == 1:
        return _mapped(x, LEVELS * np.exp(rng.uniform(np.log(0.2), np.log(3.0))))
    if kind in (2, 3):
        return _saturated(x, 0.0 if kind == 2 and rng.random() < 0.5 else rng.uniform(0.0, 3.0))
    amount = rng.uniform(0.5, 4.0)
    return np.asarray(cv2.addWeighted(x, 1 + amount, cv2.GaussianBlur(x, (0, 0), 1.2), -amount, 0), np.uint8)


def _motion_blur(x: Image, rng: Rng) -> Image:
    length = int(rng.integers(3, 9))
    kernel = np.zeros((length, length), np.float32)
    angle = rng.uniform(0, np.pi)
    half = (length - 1) / 2
    reach = half * np.array([np.cos(angle), np.sin(angle)])
    start, end = (half - reach).round().astype(int), (half + reach).round().astype(int)
    cv2.line(kernel, start.tolist(), end.tolist(), 1.0)
    return np.asarray(cv2.filter2D(x, -1, kernel / kernel.sum()), np.uint8)


def disturb_mask(mask: NDArray[np.bool_], config: AugmentConfig, rng: Rng) -> NDArray[np.bool_]:
    """What a detector or a person might give instead of the true visible mask (H, W)."""
    kind = rng.random()
    if kind < config.no_mask or not mask.any():
        return np.zeros_like(mask)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if kind < config.no_mask + config.box_mask:
        box = float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)
        return box_mask(box, (mask.shape[1], mask.shape[0]))
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
    """A mask (H, W) dilated or eroded by a few pixels; one that would vanish stays."""
    radius = int(rng.integers(0, config.dilate // 2 + 1)) if rng.random() < 0.4 else int(rng.integers(0, 2))
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    if rng.random() < config.grown:
        return cv2.dilate(mask, kernel).astype(np.uint8)
    eroded = cv2.erode(mask, kernel).astype(np.uint8)
    return eroded if eroded.sum() > 0.4 * mask.sum() else mask
