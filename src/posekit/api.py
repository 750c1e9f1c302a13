"""A pose in one call: ``from posekit import estimate``."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.detect import BoxPrompt, MaskPrompt, from_supervision
from posekit.detect.prompts import clip_box
from posekit.errors import ImageError, OutputError, PromptError
from posekit.estimate.document import result_json
from posekit.estimate.estimator import EstimateOptions, PoseEstimator
from posekit.estimate.instances import find_instances
from posekit.geometry import Pose
from posekit.io.calibration import Calibration, load_calibration
from posekit.io.files import write_bytes_atomic, write_text_atomic
from posekit.io.load import ASSUMED_FOV, load_mask, load_view
from posekit.lens import Lens
from posekit.mesh.model import ObjectModel
from posekit.results import Detection, Estimate
from posekit.view import View
from posekit.visualise import draw, figures

log = logging.getLogger("posekit")

Picture = str | Path | NDArray[np.uint8] | View
CANDIDATES = 3  # detections that are estimated where the object is looked for, of which the best one is kept


@dataclass(frozen=True, eq=False)
class Result(Sequence[Estimate]):
    """What `estimate` found, best first; a sequence of Estimate. view: the photograph as it was used, undistorted."""

    view: View
    estimator: PoseEstimator
    estimates: tuple[Estimate, ...]

    @overload
    def __getitem__(self, index: int) -> Estimate: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Estimate, ...]: ...
    def __getitem__(self, index: int | slice) -> Estimate | tuple[Estimate, ...]:
        return self.estimates[index]

    def __len__(self) -> int:
        return len(self.estimates)

    def __iter__(self) -> Iterator[Estimate]:
        return iter(self.estimates)

    @property
    def best(self) -> Estimate:
        """The first estimate. Raises PromptError where nothing was found."""
        if not self.estimates:
            raise PromptError(f"{self.estimator.model.name} not found: give a box or a mask of it.")
        return self.estimates[0]

    @property
    def T_cam_obj(self) -> Pose:
        """The best estimate's pose, metres."""
        return self.best.T_cam_obj

    @property
    def angle_deg(self) -> float:
        """The best estimate's predicted rotation error, degrees."""
        return self.best.angle_deg

    @property
    def score(self) -> float:
        """The best estimate's score, 0 to 1: how likely the object is there in this pose."""
        return self.best.score

    @property
    def reliable(self) -> bool:
        """Whether there is an estimate, and the best one can be used."""
        return bool(self.estimates) and self.best.reliable

    def draw(self, blend: float = 0.0) -> NDArray[np.uint8]:
        """The overlay, RGB (H, W, 3). blend: how much of the rendered mesh is mixed in, 0 to 1."""
        shown = [(self.estimator.model, each) for each in self.estimates]
        return figures.overlay(self.estimator.renderer, self.view, shown, blend)

    def to_json(self) -> str:
        """The text of result.json."""
        return result_json(self.view, self.estimates, self.estimator.weights_hash)

    def save(self, folder: str | Path, blend: float = 0.0) -> Path:
        """Write result.json and overlay.png into a folder, which is made where it is missing, and return it. Files of
        these names are replaced. Raises OutputError."""
        folder = Path(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the folder {folder} cannot be made: {error.strerror}.") from error
        write_text_atomic(folder / "result.json", self.to_json())
        write_bytes_atomic(folder / "overlay.png", draw.png(self.draw(blend)))
        return folder


def estimate(
    image: Picture,
    model: str | Path | ObjectModel | PoseEstimator,
    box: Sequence[float] | None = None,
    mask: str | Path | NDArray[np.bool_] | None = None,
    *,
    detections: Sequence[Detection] | Any | None = None,
    camera: Camera | str | Path | None = None,
    units: str = "auto",
    symmetry: str | None = None,
    preset: str = "lite",
    weights: str | Path | None = None,
    device: str = "auto",
    options: EstimateOptions = EstimateOptions(),
) -> Result:
    """The pose of an object in a photograph.

    image: a file, uint8 RGB (H, W, 3), or a View, whose own camera counts.
    model: a mesh's file (with ``units`` and ``symmetry``), an ObjectModel, or a PoseEstimator, which spares loading the
    networks again for the next picture (and has its own weights and options).
    box: edges (x0, y0, x1, y1), pixels. mask: a file or bool (H, W).
    detections: of another program, a list of Detection or ``supervision.Detections``: those whose label is the mesh's
    name (case does not count), or all where they have no label, or one label only.
    Box, mask and detections are of the photograph as it was taken; without any of them the object is looked for.
    camera: a Camera, or what ``--camera`` takes; without it the photograph's EXIF data, else a field of view of 60
    degrees, with a warning.
    Raises PosekitError's children: ImageError, MeshError, CameraError, PromptError, WeightsError, RenderError.
    """
    given = [name for name, it in (("box", box), ("mask", mask), ("detections", detections)) if it is not None]
    if len(given) > 1:
        raise PromptError(f"{' and '.join(given)} were both given; one says where the object is: give one of them.")
    view = _view_of(image, camera)
    if isinstance(model, PoseEstimator):
        estimator = model
    else:
        mesh = model if isinstance(model, ObjectModel) else ObjectModel.load(model, units=units, symmetry=symmetry)
        file = None if weights is None else Path(weights)
        estimator = PoseEstimator(mesh, preset=preset, weights=file, options=options, device=device)
    if detections is not None:
        where = _of_model(view, estimator.model, detections)
    else:
        where = _found(view, estimator, box, mask)
    [found] = find_instances(lambda _: estimator, view, [estimator.model], where)
    return Result(view, estimator, tuple(found.instances))


def _view_of(image: Picture, camera: Camera | str | Path | None) -> View:
    if isinstance(image, View):
        return image.with_mask(None)
    if isinstance(image, (str, Path)):
        if not isinstance(camera, Camera):
            return load_view(image, camera)
        view = load_view(image, f"{camera.fx},{camera.fy},{camera.cx},{camera.cy}")
        _check_size(camera, view.image)
        return view
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ImageError(f"an image is uint8 RGB (H, W, 3), not {image.dtype} {image.shape}.")
    size = (image.shape[1], image.shape[0])
    if isinstance(camera, Camera):
        _check_size(camera, image)
        return View(image, camera)
    if camera is not None:
        found = load_calibration(camera, size)
        return View(found.undistorted(image), found.ideal, lens=found.lens)
    log.warning("the array's camera is not known, so a field of view of 60 degrees is assumed: pass camera=.")
    return View(image, Calibration(Camera.from_fov(ASSUMED_FOV, *size)).ideal)


def _check_size(camera: Camera, image: NDArray[np.uint8]) -> None:
    if camera.size != (image.shape[1], image.shape[0]):
        raise ImageError(
            f"the camera's picture has {camera.width}x{camera.height} pixels, the image "
            f"{image.shape[1]}x{image.shape[0]}: use Camera.resized."
        )


def _of_model(view: View, model: ObjectModel, detections: Any) -> list[Detection]:
    """What is said of a mesh, in the undistorted picture. Raises PromptError."""
    found = from_supervision(detections) if hasattr(detections, "xyxy") else list(detections)
    for each in found:
        if not isinstance(each, Detection):
            raise PromptError(f"detections are a list of Detection or supervision.Detections, not of {type(each)}.")
    labels = {each.label.lower() for each in found if each.label is not None}
    if len(labels) > 1 or model.name.lower() in labels:
        own = [each for each in found if each.label is not None and each.label.lower() == model.name.lower()]
        if not own:
            raise PromptError(
                f"the detections are of {', '.join(sorted(labels))}, none of {model.name}: name the mesh after its "
                "class, or give those of its class alone."
            )
        found = own
    lens, camera = view.lens, view.camera
    taken = camera.size if lens is None else lens.camera.size
    placed = []
    for each in found:
        box, mask = each.box, each.mask
        if mask is not None and mask.shape != taken[::-1]:
            raise PromptError(f"a mask is {mask.shape[1]}x{mask.shape[0]}, its picture {taken[0]}x{taken[1]}.")
        if lens is not None:
            box = lens.undistorted_box(box)
            mask = None if mask is None else lens.undistorted_mask(mask)
        placed.append(replace(each, box=clip_box(box, camera), mask=mask, label=model.name))
    return placed


def _found(
    view: View,
    estimator: PoseEstimator,
    box: Sequence[float] | None,
    mask: str | Path | NDArray[np.bool_] | None,
) -> list[Detection]:
    if box is not None:
        if len(box) != 4:
            raise PromptError(f"a box is four numbers (x0, y0, x1, y1) in pixels, not {len(box)}.")
        x0, y0, x1, y1 = (float(v) for v in box)
        edges = (x0, y0, x1, y1) if view.lens is None else view.lens.undistorted_box((x0, y0, x1, y1))
        return BoxPrompt(edges).detect(view, [estimator.model])
    if mask is not None:
        return MaskPrompt(_mask_of(mask, view.lens)).detect(view, [estimator.model])
    from posekit.detect.novel import make_detector

    finder, _ = make_detector(None, [estimator.model], max_detections=CANDIDATES, doubtful=True)
    return finder.detect(view, [estimator.model])


def _mask_of(mask: str | Path | NDArray[np.bool_], lens: Lens | None) -> NDArray[np.bool_]:
    pixels = load_mask(mask) if isinstance(mask, (str, Path)) else np.asarray(mask, np.bool_)
    return pixels if lens is None else lens.undistorted_mask(pixels)
