"""The pictures of README and docs, from seeds: `python scripts/draw_pictures.py FOLDER [NAME ...]`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from posekit import PoseEstimator, Renderer, estimate
from posekit.render import render_views, view_rotations
from posekit.synth.example import locomotive, make_example, make_film
from posekit.tracking.tracker import Tracker
from posekit.visualise import draw, figures
from posekit.visualise.draw import Image

MOST_BYTES = 200_000
TILE = (320, 240)


def pose() -> Image:
    """What the demo finds in its example, with the way from the first pose to the last."""
    example = make_example(Renderer())
    return estimate(example.view, example.model, box=example.box).draw()


def track() -> Image:
    """Six frames of 60, in which the locomotive turns on the table, with the outlines that the tracker finds."""
    tiles, captions, tracker = [], [], None
    for number, example in enumerate(make_film(Renderer(), 60)):
        view = example.view
        if tracker is None:
            first = estimate(view, PoseEstimator(example.model), box=example.box)
            tracker = Tracker(example.model, view.camera, pose=first.T_cam_obj, estimator=first.estimator)
        found = tracker.step(view.image)
        if number % 11 != 4:
            continue
        picture, told = view.image, found.T_cam_obj
        if told is not None:
            picture = figures.outlined(tracker.renderer, picture, view.camera, example.model, told)
        tiles.append(draw.fit(picture, TILE))
        captions.append(f"frame {number}: {found.state}")
    return draw.grid(tiles, columns=3, captions=captions)


def views() -> Image:
    """The example's mesh from twelve sides."""
    drawn = render_views(Renderer(samples=4), locomotive(), view_rotations(12), (240, 180), coords=False)
    return draw.grid([view.image for view in drawn], columns=6)


PICTURES: dict[str, Callable[[], Image]] = {"pose": pose, "track": track, "views": views}


def main(folder: Path, names: list[str]) -> None:
    if unknown := set(names) - set(PICTURES):
        sys.exit(f"there is no picture {', '.join(sorted(unknown))}: the names are {', '.join(PICTURES)}.")
    folder.mkdir(parents=True, exist_ok=True)
    for name in names or PICTURES:
        _, jpeg = cv2.imencode(
            ".jpg", np.ascontiguousarray(PICTURES[name]()[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85]
        )
        if len(jpeg) > MOST_BYTES:
            sys.exit(f"{name}.jpg has {len(jpeg)} bytes, more than {MOST_BYTES}: draw it smaller.")
        (folder / f"{name}.jpg").write_bytes(jpeg.tobytes())
        print(f"{folder / name}.jpg: {len(jpeg) // 1000} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
