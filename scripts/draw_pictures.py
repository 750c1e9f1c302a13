"""The pictures of README and docs, from seeds: `python scripts/draw_pictures.py FOLDER [NAME ...]`."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from posekit import PoseEstimator, Renderer, estimate
from posekit.geometry import Pose, so3_exp
from posekit.metrics import rotation_error
from posekit.render import Light, render_views, view_rotations
from posekit.synth.example import Example, bottle, locomotive, make_example, make_film
from posekit.tracking.tracker import Tracker
from posekit.view import View
from posekit.viewer import Photograph, PoseViewer, ViewerOptions, candidates_of
from posekit.visualise import draw, figures
from posekit.visualise.draw import Image

MOST_BYTES = 200_000
TILE = (320, 240)
HALF = (300, 225)


def pose() -> Image:
    """What the demo finds in its example, with the way from the first pose to the last."""
    example = make_example(Renderer())
    return estimate(example.view, example.model, box=example.box).draw()


def track() -> Image:
    """Six frames of 60, in which the locomotive turns on the table, with the outlines that the tracker finds.

    Of each frame the part is shown in which the locomotive moves.
    """
    tiles, captions, tracker = [], [], None
    x0, y0 = 200, 70
    for number, example in enumerate(make_film(Renderer(), 60)):
        view = example.view
        if tracker is None:
            first = estimate(view, PoseEstimator(example.model), box=example.box)
            tracker = Tracker(example.model, view.camera, pose=first.T_cam_obj, estimator=first.estimator)
        found = tracker.step(view.image)
        if number % 11 != 4:
            continue
        picture, pose_found = view.image, found.T_cam_obj
        if pose_found is not None:
            picture = figures.outlined(tracker.renderer, picture, view.camera, example.model, pose_found)
        tiles.append(picture[y0 : y0 + TILE[1], x0 : x0 + TILE[0]])
        captions.append(f"frame {number}: {found.state}")
    return draw.grid(tiles, columns=3, captions=captions)


def views() -> Image:
    """The example's mesh from twelve sides."""
    drawn = render_views(Renderer(samples=4), locomotive(), view_rotations(12), (240, 180), coords=False)
    return draw.grid([view.image for view in drawn], columns=6)


def texture() -> Image:
    """An object with parts of different colours, and a mesh with the same colours."""
    return _case(make_example(Renderer()))


def grey() -> Image:
    """The same photograph, with a mesh that has no colours."""
    example = make_example(Renderer())
    return _case(replace(example, model=replace(example.model, colors=None)))


def symmetric() -> Image:
    """A bottle of one colour."""
    return _case(make_example(Renderer(), model=bottle()))


def pixels() -> Image:
    """The example's picture with a sixth of its pixels a side: the object is some 35 pixels long."""
    example, size = make_example(Renderer()), (107, 80)
    camera = example.view.camera.resized(*size)
    x, y = camera.width / example.view.camera.width, camera.height / example.view.camera.height
    x0, y0, x1, y1 = example.box
    view = View(draw.fit(example.view.image, size), camera)
    return _case(replace(example, view=view, box=(x * x0, y * y0, x * x1, y * y1)))


def shiny() -> Image:
    """The locomotive with strong highlights, which the mesh does not have."""
    light = Light(ambient=0.35, direction=(-0.45, -0.75, -0.5), diffuse=0.5, specular=1.6, shininess=6.0)
    return _case(make_example(Renderer(), light=light))


def _case(example: Example) -> Image:
    """The picture's part with the object and the outline that is found from its box; the mesh in that pose."""
    found = estimate(example.view, example.model, box=example.box)
    x0, y0, x1, y1 = example.box
    camera = example.view.camera
    width = min(round(1.5 * max(x1 - x0, (y1 - y0) / 0.75)), camera.width)
    height = min(round(0.75 * width), camera.height)
    left = int(np.clip(round((x0 + x1 - width) / 2), 0, camera.width - width))
    top = int(np.clip(round((y0 + y1 - height) / 2), 0, camera.height - height))
    part = example.view.image[top : top + height, left : left + width]
    window = camera.cropped(left, top, width, height).resized(*HALF)
    renderer, T_cam_obj = Renderer(samples=4), found.T_cam_obj
    photo = cv2.resize(part, HALF, interpolation=cv2.INTER_AREA if width > HALF[0] else cv2.INTER_NEAREST)
    photo = figures.outlined(renderer, photo.astype(np.uint8), window, example.model, T_cam_obj)
    [drawn] = renderer.render(example.model, [T_cam_obj], window, coords=False)
    assert drawn.mask is not None
    mesh = np.where(drawn.mask[..., None], drawn.image, np.uint8(235)).astype(np.uint8)
    nearest = example.model.symmetries.nearest(T_cam_obj, example.T_cam_obj)
    turn = float(rotation_error(nearest, example.T_cam_obj))
    rating = "reliable" if found.reliable else "NOT RELIABLE"
    error = f"{np.rad2deg(turn):.0f} degree{'s' if round(np.rad2deg(turn)) != 1 else ''}"
    return draw.grid([photo, mesh], 2, [f"{rating}, true error {error}", "the mesh in that pose"])


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
PICTURES |= {f"object-{case.__name__}": case for case in (texture, pixels, symmetric, shiny, grey)}


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
