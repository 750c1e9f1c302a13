"""The configuration of an evaluation."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from posekit.errors import ConfigError
from posekit.estimate.estimator import EstimateOptions
from posekit.geometry import PoseNoise

STAGES = ("refine", "estimate", "track", "score")
GIVEN = ("gt-boxes", "gt-masks")  # detections that the truth gives
DETECTOR = "detector"
MASKS = ("true", "none")
REDETECT, RBOT = "redetect", "rbot"  # protocols of the track stage
NOT_RESULTS = ("workers",)  # what may differ between two runs of the same results


@dataclass(frozen=True)
class EvalOptions:
    """What an evaluation measures, and on what."""

    stage: str
    dataset: str | None = None  # a known name, or None
    root: Path | None = None  # its folder
    split: str | None = None
    units: str = "auto"  # of BOP's meshes, auto or one of object_model.UNITS
    objects: tuple[int, ...] = ()  # numbers, all where empty
    images: tuple[tuple[int, int], ...] = ()  # (scene, image), all where empty
    limit: int | None = None  # that many pictures, spread evenly
    min_visible: float | None = None  # instances at least as visible, in [0, 1]; None is the test's own targets
    detections: str = "gt-boxes"  # one of GIVEN, DETECTOR or a JSON file
    detector: str = "novel"  # which one, a name or file of weights, as `novel.make_detector` takes it
    masks: str = "none"  # whether the refiner is given the visible mask ("true")
    noise: tuple[float, float, float, float] = (15.0, 1.0, 1.0, 5.0)  # degrees and three cm, standard deviations;
    seed: int = 0  # of the disturbances
    # of track: whether a lost object's true mask stands for a detector ("redetect"), or nothing is told but the first
    # pose and, with resets, the true pose of each frame that went wrong ("rbot")
    protocol: str = REDETECT
    resets: bool = True
    preset: str = "lite"
    weights: Path | None = None
    estimate: EstimateOptions = EstimateOptions()
    threads: int = 1  # of torch, in each worker; the same whatever the number of workers, since sums depend on it
    device: str = "auto"  # of the networks. The rest is EstimateOptions'.
    workers: int = 1

    def __post_init__(self) -> None:
        if self.stage not in STAGES:
            raise ConfigError(f"the stage is one of {', '.join(STAGES)}, not {self.stage!r}.")
        if self.stage == "track" and (self.workers > 1 or self.limit is not None):
            raise ConfigError("tracking needs whole sequences in order: leave --workers and a number of --images out.")
        if self.protocol not in (REDETECT, RBOT):
            raise ConfigError(f"the protocol is {REDETECT} or {RBOT}, not {self.protocol!r}.")
        if self.protocol == RBOT and self.stage != "track":
            raise ConfigError(f"the protocol {RBOT} is one of tracking: pass --stage track with it, not {self.stage}.")
        if not self.resets and self.protocol != RBOT:
            raise ConfigError(f"resets belong to the protocol {RBOT}: pass --protocol {RBOT} with --no-resets.")
        if self.min_visible is not None and not 0 <= self.min_visible <= 1:
            raise ConfigError(f"the least visible share is between 0 and 1, not {self.min_visible:g}.")
        if self.masks not in MASKS:
            raise ConfigError(f"the refiner's masks are one of {', '.join(MASKS)}, not {self.masks!r}.")
        if self.limit is not None and self.limit < 1:
            raise ConfigError(f"at least 1 picture is needed, not {self.limit}.")
        if self.workers < 1 or self.threads < 1:
            raise ConfigError(f"at least 1 worker and 1 thread are needed, not {self.workers} and {self.threads}.")
        if len(self.noise) != 4 or min(self.noise) < 0:
            raise ConfigError(f"the noise is four numbers from 0 on, degrees and x, y, z in cm, not {self.noise}.")
        if self.detections not in (*GIVEN, DETECTOR) and not Path(self.detections).is_file():
            raise ConfigError(
                f"detections are {', '.join((*GIVEN, DETECTOR))} or a JSON file; there is no file {self.detections!r}."
            )

    @property
    def targets(self) -> str | None:
        """Of the data set, as `BopDataset` takes them: RBOT's protocol counts all frames."""
        return None if self.protocol == RBOT else "auto"

    @property
    def true_masks(self) -> bool:
        """Whether estimates start from masks that are drawn from the annotation, which no user has."""
        return self.masks == "true" if self.stage == "refine" else self._from_truth == "gt-masks"

    @property
    def title(self) -> str:
        """The stage, and what it is given of the truth."""
        if self.true_masks:
            return f"{self.stage}, true masks"
        if self.protocol == RBOT:
            return f"{self.stage}, RBOT's protocol" + ("" if self.resets else " without resets")
        return f"{self.stage} from true boxes" if self._from_truth == "gt-boxes" else self.stage

    @property
    def _from_truth(self) -> str | None:
        return self.detections if self.stage == "estimate" and self.detections in GIVEN else None

    @property
    def pose_noise(self) -> PoseNoise:
        """DeepIM's: rotations of more than three standard deviations (45 degrees) are drawn again."""
        degrees, x, y, z = self.noise
        return PoseNoise(degrees, 3 * degrees, (x / 100, y / 100, z / 100))

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        values = dataclasses.asdict(self)
        return {k: str(v) if isinstance(v, Path) else v for k, v in values.items()}

    def identity(self) -> dict[str, Any]:
        """What decides the results."""
        unused = () if self.protocol == RBOT else ("protocol", "resets")
        values = {k: v for k, v in self.as_dict().items() if k not in (*NOT_RESULTS, *unused)}
        return values | {"root": None if self.root is None else str(self.root.resolve())}
