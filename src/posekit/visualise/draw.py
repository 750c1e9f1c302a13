"""Pictures for people: contours, axes, boxes, captions, strips and contact sheets.

Every function takes and returns uint8 RGB (H, W, 3) and leaves its input as it was.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.camera import Box, Camera
from posekit.geometry import Pose

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Colour = tuple[int, int, int]

WHITE: Colour = (255, 255, 255)
BLACK: Colour = (0, 0, 0)
PAPER: Colour = (24, 26, 30)  # behind tiles
GREEN: Colour = (64, 255, 96)  # what was found
YELLOW: Colour = (255, 235, 60)  # what is predicted, and not borne out by the picture
RED: Colour = (255, 60, 60)  # what was found, but is not reliable
ORANGE: Colour = (255, 170, 30)  # what was given
AXES: tuple[Colour, Colour, Colour] = ((255, 70, 70), (80, 230, 80), (80, 140, 255))  # x, y, z
GAP = 4  # pixels between tiles
LINE = 19  # pixels from one line of text to the next
RIM = 0.6  # how dark the rim of a contour is, 0 to 1
FONT = cv2.FONT_HERSHEY_SIMPLEX


def contour(
    image: Image, mask: Mask, colour: Colour = GREEN, *, fine: int = 1, corner: tuple[int, int] = (0, 0)
) -> Image:
    """The outline of a mask, holes included: its outermost pixels, and a dark rim one pixel wide round them.

    mask: (fine * h, fine * w), for the picture's part of h x w pixels whose first one is ``corner`` (x, y); a finer
    mask smooths the line, which stays one pixel wide. Where the mask ends at the picture's edge there is no line.
    """
    inside = mask.astype(np.uint8)
    reach = fine + 0.25  # so that the line is as wide in every direction; at ``fine`` 1 diagonal neighbours are no edge
    line, rim = (
        (part > 0) & (cv2.distanceTransform(part, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) < reach)
        for part in (inside, 1 - inside)
    )
    if not inside.any() or inside.all():
        return image.copy()
    width, height = mask.shape[1] // fine, mask.shape[0] // fine
    covered = [
        cv2.resize(part.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) for part in (line, rim)
    ]
    line_share, rim_share = covered[0][..., None], RIM * covered[1][..., None]
    out, (x, y) = image.copy(), corner
    part = out[y : y + height, x : x + width]
    mixed = part * (1 - line_share - rim_share) + np.asarray(colour, np.float32) * line_share
    part[...] = np.rint(mixed).astype(np.uint8)
    return out


def blend(image: Image, rendered: Image, mask: Mask, share: float) -> Image:
    """A rendered picture laid over a photograph where the mask (H, W) is; share: 0 shows none of it, 1 it alone."""
    out = image.copy()
    out[mask] = np.rint((1 - share) * image[mask] + share * rendered[mask]).astype(np.uint8)
    return out


def axes(image: Image, camera: Camera, T_cam_obj: Pose, length: float, origin: ArrayLike = (0, 0, 0)) -> Image:
    """The object's axes with their letters, x red, y green and z blue, the farthest drawn first.

    length: metres. origin: (3,) metres in the object's frame, where the axes start. An axis that begins or ends
    behind the camera is left out.
    """
    start = np.asarray(origin, dtype=np.float64)
    points = T_cam_obj.apply(np.stack([start, *(start + length * np.eye(3))]))
    out = image.copy()
    if points[0, 2] <= 0:
        return out
    width = _line_width(image) + 1
    for axis in sorted(range(3), key=lambda k: -points[k + 1, 2]):
        if points[axis + 1, 2] <= 0:
            continue
        tail, head = (_pixel(p) for p in camera.project(points[[0, axis + 1]]))
        cv2.arrowedLine(out, tail, head, BLACK, width + 2, cv2.LINE_AA, tipLength=0.1)
        cv2.arrowedLine(out, tail, head, AXES[axis], width, cv2.LINE_AA, tipLength=0.1)
        _letter(out, "xyz"[axis], tail, head, AXES[axis])
    return out


def _letter(out: Image, letter: str, tail: tuple[int, int], head: tuple[int, int], colour: Colour) -> None:
    """An axis' name just beyond its end, drawn into ``out``."""
    way = np.subtract(head, tail).astype(np.float64)
    size = 0.42 * _line_width(out)
    (width, height), _ = cv2.getTextSize(letter, FONT, size, 1)
    x, y = head + way / max(float(np.linalg.norm(way)), 1.0) * 22 * size
    corner = _pixel(np.array([x - width / 2, y + height / 2]))
    cv2.putText(out, letter, corner, FONT, size, BLACK, 3, cv2.LINE_AA)
    cv2.putText(out, letter, corner, FONT, size, colour, 1, cv2.LINE_AA)


def box(image: Image, edges: Box, colour: Colour = ORANGE) -> Image:
    """A box given by its edges; its line runs along the outermost pixels inside it."""
    x0, y0, x1, y1 = (round(v) for v in edges)
    return cv2.rectangle(image.copy(), (x0, y0), (x1 - 1, y1 - 1), colour, _line_width(image))


def caption(image: Image, text: str, colour: Colour = WHITE) -> Image:
    """One line of text on a darkened bar along the top; text that does not fit is made smaller."""
    height, width = image.shape[:2]
    size = float(np.clip(width / 500, 0.32, 0.9))
    (text_width, _), _ = cv2.getTextSize(text, FONT, size, 1)
    size *= min(1.0, (width - 6) / max(text_width, 1))
    (_, text_height), below = cv2.getTextSize(text, FONT, size, 1)
    bar = min(height, text_height + below + 4)
    out = image.copy()
    out[:bar] = (out[:bar] * 0.35).astype(np.uint8)
    return cv2.putText(out, text, (3, text_height + 2), FONT, size, colour, 1, cv2.LINE_AA)


def lines(texts: Sequence[str], width: int, colour: Colour = WHITE) -> Image:
    """Lines of text on a plain ground; each that does not fit into ``width`` is made smaller."""
    out = _paper(LINE * len(texts) + 4, width)
    for k, text in enumerate(texts):
        size = 0.48 * min(1.0, (width - 8) / max(cv2.getTextSize(text, FONT, 0.48, 1)[0][0], 1))
        cv2.putText(out, text, (4, LINE * (k + 1) - 3), FONT, size, colour, 1, cv2.LINE_AA)
    return out


def label(image: Image, text: str, corner: tuple[float, float], colour: Colour = WHITE) -> Image:
    """One line of text on a dark ground, whose bottom left corner (x, y) is moved as far as it takes to fit."""
    size = 0.4 * _line_width(image)
    (width, height), below = cv2.getTextSize(text, FONT, size, 1)
    x = int(np.clip(corner[0], 0, max(0, image.shape[1] - width - 4)))
    bottom = int(np.clip(corner[1], height + below + 3, image.shape[0]))
    out = image.copy()
    ground = out[bottom - height - below - 3 : bottom, x : x + width + 4]
    ground[...] = (ground * 0.35).astype(np.uint8)
    return cv2.putText(out, text, (x + 2, bottom - below), FONT, size, colour, 1, cv2.LINE_AA)


def grid(images: Sequence[Image], columns: int | None = None, captions: Sequence[str] = (), gap: int = GAP) -> Image:
    """A contact sheet of pictures of one size, row by row; about square where ``columns`` is not given.

    captions: one for each picture, or none. Raises ValueError where there is no picture or sizes differ.
    """
    if not images or len({image.shape for image in images}) != 1:
        raise ValueError(f"a grid needs pictures of one size, not {[image.shape for image in images]}")
    tiles = [caption(image, text) for image, text in zip(images, captions, strict=True)] if captions else images
    height, width = images[0].shape[:2]
    columns = min(len(tiles), columns or round(np.sqrt(len(tiles) * 1.34)))
    rows = -(-len(tiles) // columns)
    sheet = _paper(rows * (height + gap) - gap, columns * (width + gap) - gap)
    for k, tile in enumerate(tiles):
        y, x = k // columns * (height + gap), k % columns * (width + gap)
        sheet[y : y + height, x : x + width] = tile
    return sheet


def strip_tile(count: int, width: int, gap: int = GAP) -> tuple[int, int]:
    """(width, height) of the 4:3 pictures of which ``count`` fill a strip."""
    tile = max(4, (width - (count - 1) * gap) // count)
    return tile, round(0.75 * tile)


def strip(images: Sequence[Image], captions: Sequence[str], width: int, gap: int = GAP) -> Image:
    """Pictures in one row of ``width`` pixels, each with its caption; see ``strip_tile`` for their size."""
    count = len(images)
    size = strip_tile(count, width, gap)
    row = grid([fit(image, size) for image in images], count, captions, gap)
    sheet = _paper(size[1], max(width, row.shape[1]))
    left = (sheet.shape[1] - row.shape[1]) // 2
    sheet[:, left : left + row.shape[1]] = row
    return sheet


def stack(images: Sequence[Image], gap: int = GAP) -> Image:
    """Pictures below each other, each at the left, over a common ground."""
    width = max(image.shape[1] for image in images)
    sheet = _paper(sum(image.shape[0] + gap for image in images) - gap, width)
    top = 0
    for image in images:
        sheet[top : top + image.shape[0], : image.shape[1]] = image
        top += image.shape[0] + gap
    return sheet


def beside(image: Image, tiles: Sequence[Image], gap: int = GAP) -> Image:
    """Tiles of one size in columns to the right of a picture, as many below each other as its height holds."""
    height, width = tiles[0].shape[:2]
    rows = max(1, (image.shape[0] + gap) // (height + gap))
    columns = -(-len(tiles) // rows)
    sheet = _paper(max(image.shape[0], height), image.shape[1] + columns * (gap + width))
    sheet[: image.shape[0], : image.shape[1]] = image
    for k, tile in enumerate(tiles):
        x, y = image.shape[1] + gap + k // rows * (width + gap), k % rows * (height + gap)
        sheet[y : y + height, x : x + width] = tile
    return sheet


def fit(image: Image, size: tuple[int, int]) -> Image:
    """A picture resized to (width, height), averaged where it shrinks."""
    if size == (image.shape[1], image.shape[0]):
        return image
    shrinks = size[0] < image.shape[1]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


def png(image: Image | Mask) -> bytes:
    """A picture (H, W, 3) or a mask (H, W), 0 and 255, encoded as PNG."""
    if image.dtype == np.bool_:
        image = image.astype(np.uint8) * np.uint8(255)
    pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    done, data = cv2.imencode(".png", pixels)
    if not done:
        raise ValueError(f"an array of shape {image.shape} and type {image.dtype} cannot become a PNG")
    return data.tobytes()


def _line_width(image: Image) -> int:
    return max(1, round(max(image.shape[:2]) / 640))


def _pixel(point: NDArray[np.float64]) -> tuple[int, int]:
    """The nearest pixel; far outside points stay where OpenCV's integers can hold them."""
    x, y = np.clip(np.rint(point), -10_000, 30_000).astype(int)
    return int(x), int(y)


def _paper(height: int, width: int) -> Image:
    return np.full((height, width, 3), PAPER, dtype=np.uint8)
