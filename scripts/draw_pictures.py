"""The pictures of README and docs, from seeds: `python scripts/draw_pictures.py FOLDER [NAME ...]`."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from posekit import PoseEstimator, Renderer, estimate
from posekit.geometry import Pose, so3_exp
from posekit.render import render_views, view_rotations
from posekit.synth.example import locomotive, make_example, make_film
from posekit.tracking.tracker import Tracker
from posekit.viewer import Photograph, PoseViewer, ViewerOptions, candidates_of
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


def page() -> Image:
    """The page of `posekit view`: the demo's example, with the mesh moved a little off the object. Needs Chromium."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        sys.exit('the picture page is taken in a browser: pip install "posekit[dev]", and Chromium (docs/view.md).')
    example = make_example(Renderer())
    found = estimate(example.view, example.model, box=example.box)
    shown = Photograph(example.view, "photo.png", candidates_of(found))
    options = ViewerOptions(port=0)
    with (
        PoseViewer(
            example.model, shown, save=lambda name, _: Path(name), refiner=found.estimator.refine, options=options
        ) as viewer,
        sync_playwright() as driver,
    ):
        best = found.T_cam_obj
        viewer.move(Pose(so3_exp([0.0, 0.25, 0.1]) @ best.R, best.t + (0.03, -0.01, 0.02)))
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        window = browser.new_page(viewport={"width": 1000, "height": 560})
        window.goto(viewer.url)
        window.get_by_role("button", name="Refine from here").wait_for()
        window.wait_for_timeout(4000)  # until the scene has faded in
        window.locator(".mantine-Notification-closeButton").first.click()  # that no GPU draws
        window.wait_for_timeout(2000)
        taken = cv2.imdecode(np.frombuffer(window.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    return np.ascontiguousarray(taken[..., ::-1]).astype(np.uint8)


PICTURES: dict[str, Callable[[], Image]] = {"pose": pose, "track": track, "views": views, "page": page}


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
