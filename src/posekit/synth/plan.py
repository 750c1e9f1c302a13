"""What a synthetic data set is: its configuration, and which image lies where."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from posekit.datasets.bop_writer import Picture
from posekit.errors import ConfigError, InputError
from posekit.synth.motion import MIXED, MOTIONS

KINDS = ("randomised", "photoreal", "scenes", "sequence")
RBOT_VARIANTS, ALL = ("regular", "light", "noise", "occlusion"), "all"
PER_SCENE = 1000  # images in a folder, where nothing else says how many belong together
CONFIG = "synth.json"


@dataclass(frozen=True)
class SynthConfig:
    """A synthetic data set."""

    kind: str
    images: int  # in all
    seed: int = 0
    split: str = "train"
    size: tuple[int, int] = (640, 480)  # (width, height)
    quality: int = 95  # of JPEG, percent; 0 = PNG
    # backgrounds, hdri: folders; empty = procedural ones
    backgrounds: str = ""
    hdri: str = ""
    frames: int = 100  # in a sequence
    views: int = 4  # of a photoreal room
    samples: int = 32  # light paths for each pixel
    variant: str = "auto"  # Mitsuba's, "auto" = the fastest one here
    motion: str = MIXED  # of sequences, "mixed" = each of `MOTIONS` in turn
    rbot: str = ""  # sequences in RBOT's manner: one of its variants, or "all" of them in turn

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(f"the kind is one of {', '.join(KINDS)}, not {self.kind!r}.")
        if self.motion != MIXED and self.motion not in MOTIONS:
            raise ConfigError(f"the motion is {MIXED} or one of {', '.join(MOTIONS)}, not {self.motion!r}.")
        if self.rbot and self.rbot not in (*RBOT_VARIANTS, ALL):
            raise ConfigError(f"RBOT's variant is one of {', '.join((*RBOT_VARIANTS, ALL))}, not {self.rbot!r}.")
        if self.rbot and (self.kind != "sequence" or self.motion != MIXED):
            raise ConfigError(
                "RBOT's manner is one of sequences, with a motion of its own: pass --kind sequence, and no --motion."
            )
        if min(self.images, self.frames, self.views, self.samples) < 1:
            raise ConfigError("images, frames, views and samples are at least 1.")
        if min(self.size) < 32 or max(self.size) > 4096:
            raise ConfigError(f"a picture of {self.size[0]}x{self.size[1]}: its sides are from 32 to 4096 pixels.")
        if not 0 <= self.quality <= 100 or self.seed < 0:
            raise ConfigError("the JPEG quality is from 1 to 100, or 0 for PNG; the seed is not negative.")

    @property
    def per_block(self) -> int:
        """Images that are made together: a sequence, or a room's views."""
        return {"sequence": self.frames, "photoreal": self.views}.get(self.kind, 1)

    def address(self, number: int, obj_ids: Sequence[int]) -> tuple[int, int]:
        """(scene, image) of image ``number``: LINEMOD's scenes where each shows one object, sequences one by one."""
        if self.kind == "randomised":
            return obj_ids[number % len(obj_ids)], number // len(obj_ids)
        per_scene = self.frames if self.kind == "sequence" else PER_SCENE
        return 1 + number // per_scene, number % per_scene

    def to_json(self) -> str:
        """The text that `read` reads."""
        return json.dumps(dataclasses.asdict(self), indent=1) + "\n"

    @classmethod
    def read(cls, root: Path) -> SynthConfig:
        """Of the data set that was begun in a folder. Raises InputError."""
        path = root / CONFIG
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            return cls(**{**data, "size": tuple(data["size"])})
        except FileNotFoundError as error:
            raise InputError(f"there is no {path}: no data set was begun there. Leave --resume out.") from error
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise InputError(f"{path} is no configuration of a synthetic data set: {error}.") from error


class Maker(Protocol):
    """One kind of data set. What a block shows depends on the seed and its number alone."""

    def block(self, number: int, places: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """The pictures at these places of a block, each with its place."""
        ...
