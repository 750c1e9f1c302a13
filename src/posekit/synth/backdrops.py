"""What is behind the objects, and the camera that photographs them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.errors import InputError
from posekit.io.load import load_image
from posekit.synth.procedural import noise_image, random_colour, random_texture

PICTURES = (".jpg", ".jpeg", ".png", ".webp")
TEXTURES = 48  # procedural textures of a data set, made once

Image = NDArray[np.uint8]
Rng = np.random.Generator


class Backdrops:
    """Photographs from a folder, read when they are wanted, or procedural pictures.

    folder: its pictures in the order of their names; of Pascal VOC's layout those in JPEGImages.
    Raises InputError where there are none.
    """

    def __init__(self, folder: str, seed: int) -> None:
        self.seed, self.paths = seed, _pictures(Path(folder)) if folder else []
        self._textures: dict[int, Image] = {}

    def draw(self, rng: Rng, size: tuple[int, int]) -> Image:
        """A picture uint8 (height, width, 3); size: (width, height)."""
        if self.paths:
            return _part(load_image(self.paths[int(rng.integers(len(self.paths)))]), rng, size)
        low, high = random_colour(rng), random_colour(rng)
        small = max(8, size[0] // 2), max(8, size[1] // 2)
        noise = noise_image(rng, small, int(rng.choice([1, 3])))
        picture = cv2.resize((low + (high - low) * noise).clip(0, 255).astype(np.uint8), size)
        for _ in range(int(rng.integers(0, 6))):
            _paste(picture, self.texture(rng), rng)
        return picture

    def texture(self, rng: Rng) -> Image:
        """One of the data set's procedural textures."""
        k = int(rng.integers(TEXTURES))
        if k not in self._textures:
            self._textures[k] = random_texture(np.random.default_rng([self.seed, 1, k]))
        return self._textures[k]


def _pictures(folder: Path) -> list[Path]:
    folder = folder / "JPEGImages" if (folder / "JPEGImages").is_dir() else folder
    if not folder.is_dir():
        raise InputError(f"there is no folder of backgrounds {folder}: check the path.")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
    if not found:
        raise InputError(f"the folder {folder} holds no JPEG, PNG or WebP pictures for backgrounds.")
    return found


def _part(photo: Image, rng: Rng, size: tuple[int, int]) -> Image:
    """A random part of a photograph, perhaps mirrored."""
    h, w = photo.shape[:2]
    scale = min(w / size[0], h / size[1]) * rng.uniform(0.5, 1.0)
    cw, ch = max(2, int(size[0] * scale)), max(2, int(size[1] * scale))
    x, y = int(rng.integers(0, w - cw + 1)), int(rng.integers(0, h - ch + 1))
    shrinks = cw > size[0]
    part = cv2.resize(
        photo[y : y + ch, x : x + cw], size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )
    return np.ascontiguousarray(part[:, ::-1]) if rng.random() < 0.5 else part


def _paste(picture: Image, texture: Image, rng: Rng) -> None:
    """A texture as a turned rectangle somewhere in the picture, in place."""
    height, width = picture.shape[:2]
    scale = rng.uniform(0.15, 0.8) * height / texture.shape[0]
    M = cv2.getRotationMatrix2D((texture.shape[1] / 2, texture.shape[0] / 2), float(rng.uniform(0, 360)), float(scale))
    M[:, 2] += rng.uniform(0, 1, size=2) * (width, height) - np.array(texture.shape[1::-1]) / 2
    cv2.warpAffine(texture, M, (width, height), dst=picture, borderMode=cv2.BORDER_TRANSPARENT)


def photograph(image: Image, rng: Rng) -> Image:
    """Colour jitter, blur and sensor noise of a camera, uint8 (H, W, 3) to the same.

    The colours go through a table for each channel: gain, contrast, gamma and white balance in one lookup.
    """
    levels = np.linspace(0, 1, 256)
    gain = np.exp(rng.normal() * 0.18) * np.exp(rng.normal(size=(3, 1)) * 0.06)
    curve = (gain * levels ** np.exp(rng.normal() * 0.18) - 0.5) * rng.uniform(0.75, 1.2) + 0.5 + rng.normal() * 0.04
    table = (255 * curve.clip(0, 1)).astype(np.uint8).T.reshape(1, 256, 3)
    picture = cv2.LUT(image, table)
    if rng.random() < 0.5:
        picture = cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.4, 1.8)))
    if rng.random() < 0.12:
        picture = _motion_blur(picture, rng)
    if rng.random() < 0.8:
        picture = add_noise(picture, float(rng.uniform(0.5, 9.0)), rng)
    return picture


def add_noise(image: Image, sigma: float, rng: Rng) -> Image:
    """Gaussian noise of ``sigma`` grey levels on every channel."""
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    return np.asarray(cv2.add(image, noise * np.float32(sigma), dtype=cv2.CV_8U))


def _motion_blur(image: Image, rng: Rng) -> Image:
    length, angle = int(rng.integers(3, 12)), rng.uniform(0, np.pi)
    kernel = np.zeros((length, length), np.float32)
    half = (length - 1) / 2
    reach = half * np.array([np.cos(angle), np.sin(angle)])
    start, end = (half - reach).round().astype(int), (half + reach).round().astype(int)
    cv2.line(kernel, start.tolist(), end.tolist(), 1.0)
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()))
