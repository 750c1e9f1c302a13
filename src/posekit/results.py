"""Detection and Estimate, and their JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit._version import __version__
from posekit.camera import Box
from posekit.errors import PromptError
from posekit.geometry import Pose

# An estimate is reliable from this score on and up to this predicted rotation error (docs/conventions.md).
RELIABLE_SCORE = 0.5
RELIABLE_ANGLE_DEG = 15.0

# The documents that posekit writes as JSON (docs/result-json.md): their kinds, and the version of their form. A new
# entry leaves the version as it is; an entry that goes or changes its meaning raises it.
RESULT_SCHEMA, FRAME_SCHEMA, DETECTIONS_SCHEMA = "posekit-result", "posekit-frame", "posekit-detections"
SCHEMA_VERSION = 1
FRAME_SCHEMA_VERSION = 2  # 1 had the state "restarted" and none that is uncertain


class Source(StrEnum):
    """Where a detection comes from."""

    BOX = "box"  # a person's box
    GRABCUT = "box+grabcut"  # a person's box, with GrabCut's mask
    FILLED = "box+filled"  # a person's box, taken as the mask
    MASK = "mask"  # a person's mask
    FILE = "file"  # another program's result
    FEATURES = "features"  # local features of a textured mesh
    NOVEL = "novel"  # the detector for any mesh; its score is the similarity to the mesh
    TRAINED = "mask-rcnn"  # a detector that was trained for its classes

    @property
    def by_hand(self) -> bool:
        """Whether a person says where the object is."""
        return self in (Source.BOX, Source.GRABCUT, Source.FILLED, Source.MASK)

    @property
    def given(self) -> bool:
        """Whether somebody else vouches for the detection: a person, or another program."""
        return self.by_hand or self is Source.FILE


@dataclass(frozen=True, eq=False)
class Detection:
    """Where an object is in a picture.

    box: edges, pixels. mask: bool (H, W), of the picture's size, or None. score: in [0, 1]. label: the object's
    name, where it is known. source: what found it. rough: a network's own mask, where
    ``mask`` is that one laid onto the picture's colours: first poses are sought for both.
    """

    box: Box
    mask: NDArray[np.bool_] | None = None
    score: float = 1.0
    label: str | None = None
    source: Source = Source.BOX
    rough: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class Step:
    """A pose on the refinement's way, and the rotation error (radians) that was predicted for it."""

    T_cam_obj: Pose
    angle: float

    @property
    def angle_deg(self) -> float:
        """The predicted rotation error, degrees."""
        return math.degrees(self.angle)


class Branch(StrEnum):
    """Which of the poses in which a symmetric object looks the same was taken."""

    ANY = "any"  # there was nothing to choose by
    GIVEN = "given"  # the one nearest to the pose that was given
    LAST = "last"  # the one nearest to the last frame's


@dataclass(frozen=True, eq=False)
class Estimate:
    """An object's pose in a photograph.

    angle: the rotation error, radians, that the network predicts for T_cam_obj itself; for a tracked frame, for the
    pose at which the frame was compared. mask_edge_std: where the pose was laid onto an exact mask's outline, the
    standard deviation of its rotation, radians. iterations: used for this result. converged: whether mask_edge_std, or
    else the angle, is below the threshold. branch: None for an object without symmetries. score: in [0, 1], how likely
    the object is there in this pose. box: of the object at this pose, edges, pixels. model: the mesh's name.
    detection: what it started from. trace: the poses on the way, first to last. timings: seconds by stage.
    alternatives: other poses that were refined to the end, best first, where they were asked for.
    """

    T_cam_obj: Pose
    angle: float
    iterations: int
    converged: bool
    score: float
    box: Box
    model: str
    detection: Detection | None = None
    trace: tuple[Step, ...] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    mask_edge_std: float | None = None
    branch: Branch | None = None
    alternatives: tuple[Estimate, ...] = ()

    @property
    def angle_deg(self) -> float:
        """The predicted rotation error, degrees."""
        return math.degrees(self.angle)

    @property
    def reliable(self) -> bool:
        """Whether score and predicted rotation error say that the pose can be used; an angle that is NaN says no."""
        return self.score >= RELIABLE_SCORE and self.angle_deg <= RELIABLE_ANGLE_DEG

    @property
    def verdict(self) -> str:
        """Whether the estimate is reliable, in words, and how far it may be off."""
        error = f"rotation error {angle_in_words(self.angle_deg)}"
        if self.reliable:
            return f"reliable: expected {error}"
        if self.score >= RELIABLE_SCORE:
            return f"NOT RELIABLE: estimated {error}"
        return f"NOT RELIABLE: the picture hardly shows this object in this pose; estimated {error}"


def angle_in_words(degrees: float) -> str:
    """ "about 2 degrees", rounded as far as a predicted error is meaningful."""
    if math.isnan(degrees):
        return "unknown"
    if degrees < 1:
        return "below 1 degree"
    return f"about {degrees:.0f} degree{'' if round(degrees) == 1 else 's'}"


def estimates_to_json(
    estimates: Sequence[Estimate],
    *,
    weights_hash: str | None = None,
    versions: Mapping[str, str] | None = None,
    about: Mapping[str, Any] | None = None,
    indent: int | None = 1,
) -> str:
    """The result file's text: strict JSON, numbers that are not finite are null.

    versions: of other software, besides posekit's own. about: further entries of the file (image, camera, ...). indent:
    None writes one line.
    """
    origin = {"weights_hash": weights_hash, "versions": {"posekit": __version__, **(versions or {})}}
    entries = [_estimate_to_dict(estimate) | origin for estimate in estimates]
    return document_to_json(RESULT_SCHEMA, {**(about or {}), "estimates": entries}, indent)


def document_to_json(schema: str, entries: Mapping[str, Any], indent: int | None = 1) -> str:
    """A document's text, which begins with its kind (RESULT_SCHEMA and so on) and version: strict JSON, numbers that
    are not finite are null. indent: None writes one line."""
    document = {"schema": schema, "schema_version": _version_of(schema), **entries}
    return json.dumps(_strict(document), indent=indent, allow_nan=False) + "\n"


def _version_of(schema: Any) -> int:
    """The newest version of a kind of document."""
    return FRAME_SCHEMA_VERSION if schema == FRAME_SCHEMA else SCHEMA_VERSION


def check_schema(document: Any, label: str = "the file") -> None:
    """Whether this posekit knows the form of a document; one without a version is of posekit 0.1, or of another
    program. Raises PromptError where the version is a newer one."""
    version = document.get("schema_version") if isinstance(document, Mapping) else None
    known = _version_of(document["schema"]) if isinstance(version, int) and "schema" in document else SCHEMA_VERSION
    if isinstance(version, int) and version > known:
        raise PromptError(
            f"{label} has schema_version {version}, and posekit {__version__} reads versions up to {known}: "
            "a newer posekit wrote it. Update posekit, or write the file again with this one."
        )


def estimates_from_json(text: str) -> list[Estimate]:
    """What `estimates_to_json` wrote, also that of posekit 0.1; masks are not in the file. Raises PromptError where it
    is something else, or of a newer posekit."""
    try:
        document = json.loads(text)
        check_schema(document)
        return [_estimate_from_dict(entry) for entry in document["estimates"]]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise PromptError(
            f"this is no posekit result ({_why(error)}): give a result.json of posekit estimate."
        ) from error


def _why(error: Exception) -> str:
    return f"it has no {error.args[0]}" if isinstance(error, KeyError) else str(error)


def _estimate_to_dict(estimate: Estimate) -> dict[str, Any]:
    found = estimate.detection
    return {
        "model": estimate.model,
        "T_cam_obj": estimate.T_cam_obj.matrix.tolist(),
        "quat_wxyz": estimate.T_cam_obj.quat_wxyz.tolist(),
        "t_m": estimate.T_cam_obj.t.tolist(),
        "reliable": estimate.reliable,
        "angle_deg": estimate.angle_deg,
        "iterations": estimate.iterations,
        "mask_edge_std_deg": None if estimate.mask_edge_std is None else math.degrees(estimate.mask_edge_std),
        "converged": estimate.converged,
        "branch": None if estimate.branch is None else estimate.branch.value,
        "score": estimate.score,
        "box": list(estimate.box),
        "detection": found
        and {"box": list(found.box), "score": found.score, "label": found.label, "source": found.source.value},
        "trace": [
            {"T_cam_obj": step.T_cam_obj.matrix.tolist(), "angle_deg": step.angle_deg} for step in estimate.trace
        ],
        "timings_s": dict(estimate.timings),
        "alternatives": [_estimate_to_dict(other) for other in estimate.alternatives],
    }


def _estimate_from_dict(entry: Mapping[str, Any]) -> Estimate:
    found = entry["detection"]
    mask_edge_std_deg = entry.get("mask_edge_std_deg", entry.get("contour_std_deg"))  # the latter in 0.1
    return Estimate(
        T_cam_obj=Pose.from_matrix(entry["T_cam_obj"]),
        angle=_radians(entry["angle_deg"]),
        iterations=int(entry["iterations"]),
        converged=bool(entry["converged"]),
        score=_number(entry["score"]),
        box=_box(entry["box"]),
        model=entry["model"],
        detection=found
        and Detection(_box(found["box"]), None, _number(found["score"]), found["label"], Source(found["source"])),
        trace=tuple(Step(Pose.from_matrix(s["T_cam_obj"]), _radians(s["angle_deg"])) for s in entry["trace"]),
        timings={stage: _number(seconds) for stage, seconds in entry["timings_s"].items()},
        mask_edge_std=None if mask_edge_std_deg is None else _radians(mask_edge_std_deg),
        branch=None if entry.get("branch") is None else Branch(entry["branch"]),
        alternatives=tuple(_estimate_from_dict(other) for other in entry.get("alternatives", ())),
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _radians(degrees: float | None) -> float:
    return math.radians(_number(degrees))


def _box(values: Sequence[float | None]) -> Box:
    x0, y0, x1, y1 = map(_number, values)
    return x0, y0, x1, y1


def _strict(value: Any) -> Any:
    """The value with NumPy's scalars and arrays as Python's, and None for NaN and infinities, which JSON lacks."""
    if isinstance(value, Mapping):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _strict(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_strict(item) for item in value]
    if isinstance(value, np.generic):
        return _strict(value.item())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
