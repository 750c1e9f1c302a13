"""What is done with each picture of many: `EstimateJob`, `DetectJob`, `RefineJob`.

A job is a description that goes to every worker; its ``worker()`` has the meshes, networks and renderers, made once.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from posekit._version import __version__
from posekit.batch.meshes import load_meshes
from posekit.batch.pictures import Picture
from posekit.batch.prompts import check_one, detector_for, prompt_for
from posekit.batch.start_poses import StartPoses
from posekit.detect import Detector
from posekit.detect.external import Detections, to_document
from posekit.errors import OutputError
from posekit.estimate.document import result_json
from posekit.estimate.estimator import EstimateOptions, Estimators, Tell
from posekit.estimate.instances import Found, SearchOptions, find_instances, scored_by_poses
from posekit.io.files import write_bytes_atomic, write_text_atomic
from posekit.io.load import load_view
from posekit.io.pose_formats import NamedPose, pose_files
from posekit.mesh.model import ObjectModel
from posekit.nets.config import WeightsFile
from posekit.results import DETECTIONS_SCHEMA, RESULT_SCHEMA, Detection, Estimate, document_to_json
from posekit.view import View

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

CANDIDATES = 3  # detections of a mesh that are estimated at least, of which the best estimate is kept


@dataclass(frozen=True)
class Answer:
    """Of one picture. line: its document, in one line. told: what a person reads of it. reliable: whether there are
    estimates and all are reliable."""

    line: str
    told: str
    reliable: bool = False


Worker = Callable[[Picture], Answer]  # raises what a picture does that cannot be used


@dataclass(frozen=True)
class PictureFiles:
    """Files that are written for each picture into a folder of its name. folder: that has them, None = no files.
    formats: as `posekit.io.pose_formats` has them. recording: name of a Rerun recording."""

    folder: Path | None = None
    overlay: bool = True
    blend: float = 0.0
    formats: tuple[str, ...] = ()
    recording: str | None = None

    def write(self, picture: Picture, name: str, data: bytes | str) -> None:
        """Nothing where no files are wanted. Raises OutputError."""
        folder = self.of(picture)
        if folder is None:
            return
        if isinstance(data, str):
            write_text_atomic(folder / name, data)
        else:
            write_bytes_atomic(folder / name, data)

    def of(self, picture: Picture) -> Path | None:
        """A picture's folder, made; None where no files are wanted."""
        if self.folder is None or not (self.overlay or self.formats or self.recording):
            return None
        folder = self.folder / picture.name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the folder {folder} cannot be made: {error.strerror}.") from error
        return folder

    def write_overlay(self, picture: Picture, draw: Callable[[], NDArray[np.uint8]]) -> None:
        """overlay.png, where it is wanted."""
        if self.overlay and self.folder is not None:
            from posekit.visualise.draw import png

            self.write(picture, "overlay.png", png(draw()))

    def write_estimates(self, picture: Picture, view: View, found: Sequence[tuple[ObjectModel, Estimate]],
                        draw: Callable[[], NDArray[np.uint8]]) -> None:  # fmt: skip
        """All that is wanted of a picture's estimates."""
        self.write_overlay(picture, draw)
        named = [NamedPose(e.model, e.T_cam_obj, e.score, e.angle_deg, e.reliable) for _, e in found]
        for format_ in dict.fromkeys(self.formats):
            for name, text in pose_files(format_, named).items():
                self.write(picture, name, text)
        folder = self.of(picture)
        if folder is not None and self.recording is not None:
            from posekit.visualise.recording import record_estimates

            record_estimates(folder / self.recording, view, found)


@dataclass(frozen=True)
class Meshes:
    """As the options --model, --units and --symmetry have them."""

    paths: tuple[Path, ...]
    units: str = "auto"
    symmetry: str | None = None

    def load(self) -> list[ObjectModel]:
        """Raises MeshError."""
        return load_meshes(self.paths, self.units, self.symmetry)


@dataclass(frozen=True)
class NetworkChoice:
    """As the options of the same names have them."""

    preset: str = "lite"
    weights: Path | None = None
    device: str = "auto"

    def load(self, options: EstimateOptions) -> Estimators:
        """Raises WeightsError, ConfigError."""
        return Estimators(preset=self.preset, weights=self.weights, options=options, device=self.device)


class Job(Protocol):
    """What is done with each picture."""

    @property
    def schema(self) -> str:
        """The kind of the lines."""

    @property
    def files(self) -> PictureFiles:
        """Further files of each picture."""

    def worker(self) -> Worker:
        """Loads what all pictures need. Raises PosekitError."""
        ...


def problem_line(job: Job, picture: Picture, problem: str) -> str:
    """The line of a picture that cannot be used."""
    key = "detections" if job.schema == DETECTIONS_SCHEMA else "estimates"
    return document_to_json(job.schema, {"image": picture.path, "problem": problem, key: []}, None).rstrip("\n")


def settings_of(job: Job) -> dict[str, Any]:
    """What lines depend on, for settings.json: every field of the job, files with a digest of what is in them."""
    found: dict[str, Any] = {"posekit": __version__, "job": type(job).__name__}
    for name, value in asdict(job).items():  # type: ignore[call-overload]
        nested = value if isinstance(value, dict) else {name: value}
        found |= {key: _stated(each) for key, each in nested.items() if key not in ("folder", "device")}
    if "preset" in found:
        found["weights"] = WeightsFile.read(found["preset"], getattr(job, "networks").weights).digest  # noqa: B009
    return found


def _stated(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return [_stated(each) for each in value]
    if isinstance(value, (str, Path)) and value and Path(value).is_file():
        with Path(value).open("rb") as file:
            return f"{value} (SHA-256 {hashlib.file_digest(file, 'sha256').hexdigest()[:16]})"
    return str(value) if isinstance(value, Path) else value


def search_for(found: Sequence[Detection], prompted: bool, instances: int, min_score: float | None) -> SearchOptions:
    """Which estimates are kept. prompted: whether somebody said where the objects are: then ``instances`` does not
    count. min_score: None = the usual one for such detections."""
    usual = SearchOptions.usual(found)
    return replace(usual, candidates=max(usual.candidates, instances + 1),
                   instances=usual.instances if prompted else instances,
                   min_score=usual.min_score if min_score is None else min_score)  # fmt: skip


# --- estimate ---


@dataclass(frozen=True)
class EstimateJob:
    """Poses. The fields are as the options of ``posekit estimate`` of the same names. Raises PromptError where several
    say where the object is."""

    meshes: Meshes
    camera: str | None = None
    box: str | None = None
    mask: Path | None = None
    mask_from: str = "none"
    detections: Path | None = None
    detector: str | None = None
    instances: int = 1
    min_score: float | None = None
    networks: NetworkChoice = NetworkChoice()
    options: EstimateOptions = EstimateOptions()
    files: PictureFiles = PictureFiles()

    schema = RESULT_SCHEMA

    def __post_init__(self) -> None:
        check_one(self.box, self.mask, self.detections)

    def worker(self) -> Worker:
        """Loads the meshes, the networks and what finds the objects."""
        return _Estimating(self)


class _Estimating:
    def __init__(self, job: EstimateJob) -> None:
        self.job, self.meshes = job, job.meshes.load()
        self.estimators = job.networks.load(job.options)
        self.detections = None if job.detections is None else Detections.read(job.detections)
        self.detector: Detector | None = None
        self.prompted = not (job.box is None and job.mask is None and job.detections is None)
        if not self.prompted:
            from posekit.detect.novel import make_detector

            candidates = max(CANDIDATES, job.instances + 1)
            self.detector, _ = make_detector(job.detector, self.meshes, max_detections=candidates, doubtful=True)

    def __call__(self, picture: Picture) -> Answer:
        job = self.job
        view = load_view(picture.path, job.camera)
        found = self._finder(view, picture.path).detect(view, self.meshes)
        search = search_for(found, self.prompted, job.instances, job.min_score)
        results = find_instances(self.estimators, view, self.meshes, found, search)
        pairs = [(each.model, estimate) for each in results for estimate in each.instances]
        return _estimated(job, self.estimators, picture, view, job.meshes.paths, pairs, self.meshes)

    def _finder(self, view: View, image: Path) -> Detector:
        if self.detections is not None:
            return self.detections.of(image)
        found = self.detector or prompt_for(self.job.box, self.job.mask, self.job.mask_from, lens=view.lens)
        assert found is not None
        return found


def _estimated(
    job: EstimateJob | RefineJob,
    estimators: Estimators,
    picture: Picture,
    view: View,
    paths: Sequence[Path],
    pairs: Sequence[tuple[ObjectModel, Estimate]],
    meshes: Sequence[ObjectModel],
) -> Answer:
    """The answer of estimates, whose files are written."""
    from posekit.visualise.figures import overlay

    job.files.write_estimates(
        picture, view, pairs, lambda: overlay(estimators(meshes[0]).renderer, view, pairs, job.files.blend)
    )
    about: dict[str, object] = {"image": picture.path, "mesh": paths[0] if len(paths) == 1 else list(paths)}
    found = [estimate for _, estimate in pairs]
    line = result_json(view, found, estimators.runtime.digest, about, None).rstrip("\n")
    told = [f"{e.model} {e.verdict}, score {e.score:.2f}" for e in found]
    told += [f"{m.name} not found" for m in meshes if all(m.name != e.model for e in found)]
    return Answer(line, "; ".join(told), bool(found) and all(e.reliable for e in found))


# --- refine ---


@dataclass(frozen=True)
class RefineJob:
    """Known poses made better. The fields are as the options of ``posekit refine`` of the same names."""

    meshes: Meshes
    pose: Path
    camera: str | None = None
    box: str | None = None
    mask: Path | None = None
    mask_from: str = "grabcut"
    networks: NetworkChoice = NetworkChoice()
    options: EstimateOptions = EstimateOptions()
    files: PictureFiles = PictureFiles()

    schema = RESULT_SCHEMA

    def __post_init__(self) -> None:
        check_one(self.box, self.mask)

    def worker(self) -> Worker:
        """Loads the mesh, the networks and the poses."""
        return _Refining(self)


class _Refining:
    def __init__(self, job: RefineJob) -> None:
        self.job, self.poses = job, StartPoses(job.pose)
        [self.mesh] = job.meshes.load()
        self.estimators = job.networks.load(job.options)

    def __call__(self, picture: Picture) -> Answer:
        job, mesh = self.job, self.mesh
        starts = self.poses.of(picture.path, mesh.name)
        view = load_view(picture.path, job.camera)
        if job.box is not None or job.mask is not None:
            [detection] = detector_for(job.box, job.mask, job.mask_from, view.lens).detect(view, [mesh])
            view = view.with_mask(detection.mask)
        refined = [(mesh, self.estimators(mesh).refine(view, start)) for start in starts]
        return _estimated(job, self.estimators, picture, view, job.meshes.paths, refined, [mesh])


# --- detect ---


@dataclass(frozen=True)
class DetectJob:
    """Boxes, masks and scores. The fields are as the options of ``posekit detect`` of the same names."""

    meshes: Meshes
    camera: str | None = None
    detector: str | None = None
    min_score: float | None = None
    max_detections: int = 3
    verify: bool | None = None
    files: PictureFiles = PictureFiles()

    schema = DETECTIONS_SCHEMA

    def worker(self) -> Worker:
        """Loads the meshes, the detector and what verifies."""
        return Detecting(self)


class Detecting:
    """The worker of a `DetectJob`, and what ``posekit detect`` does with one picture. classes: the names that its
    detections may have."""

    def __init__(self, job: DetectJob) -> None:
        from posekit.detect.novel import TO_VERIFY, NovelDetector, make_detector

        self.job, self.meshes = job, job.meshes.load()
        finder, self.classes = make_detector(
            job.detector,
            self.meshes,
            min_score=None if job.verify else job.min_score,
            max_detections=job.max_detections,
            doubtful=bool(job.verify),
        )
        usual = isinstance(finder, NovelDetector) and bool(self.meshes)
        verify = usual if job.verify is None else job.verify
        if verify and isinstance(finder, NovelDetector):  # poses are held to the minimum score, not detections
            finder = NovelDetector(finder.detector, finder.renderer, TO_VERIFY)
        self.finder: Detector = finder
        self.estimators = Estimators() if verify else None

    def __call__(self, picture: Picture) -> Answer:
        """Raises what a picture does that cannot be used."""
        from posekit.visualise.figures import detections_overlay

        view, started = load_view(picture.path, self.job.camera), time.perf_counter()
        found = self.found(view)
        self.job.files.write_overlay(picture, lambda: detections_overlay(view, found))
        line = to_document(found, view, picture.path, time.perf_counter() - started, None).rstrip("\n")
        told = [f"{each.label or 'object'} {each.score:.2f}" for each in found]
        return Answer(line, ", ".join(told) or "nothing found")

    def found(self, view: View, tell: Tell | None = None) -> list[Detection]:
        """Best first; verified ones are those that a pose confirms, with its score. tell: is told what is done."""
        found = sorted(self.finder.detect(view, self.meshes), key=lambda d: -d.score)
        if self.estimators is None:
            return found
        if tell is not None:
            self.estimators.tell = tell
        least = SearchOptions().min_score if self.job.min_score is None else self.job.min_score
        search = SearchOptions(min_score=least, candidates=max(SearchOptions().candidates, self.job.max_detections))
        results: list[Found] = find_instances(self.estimators, view, self.meshes, found, search)
        kept = [d for each in results for d in scored_by_poses(each) if d.score >= least]
        return sorted(kept, key=lambda d: -d.score)
