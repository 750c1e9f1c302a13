"""The data sets that posekit knows by name: objects, folders, archives; and where they lie."""

from __future__ import annotations

import difflib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path

from posekit.datasets.bop import BopDataset
from posekit.datasets.linemod import CLASSES, DeepimDataset, LinemodDataset, is_deepim
from posekit.datasets.sequences import BcotDataset, RbotDataset, SequenceDataset, is_bcot, is_rbot
from posekit.errors import ConfigError, InputError

NAMES = "objects.json"  # of synthetic data sets: names by number

Dataset = BopDataset | LinemodDataset | DeepimDataset | SequenceDataset


@dataclass(frozen=True)
class DatasetInfo:
    """names: of objects, by number. split, models: folders. folder: its name below the data folder. archives: on the
    BOP hub. vsd_delta: metres. flipped: objects that DeepIM's measure turns by
    180 degrees."""

    name: str
    title: str
    objects: tuple[int, ...]
    names: dict[int, str] = field(default_factory=dict)
    split: str = "test"
    models: str = "models"
    folder: str = ""
    archives: tuple[str, ...] = ()
    vsd_delta: float = 0.015
    flipped: tuple[int, ...] = ()

    @property
    def below(self) -> str:
        """The folder's name below the data folder, and the repository's on the hub."""
        return self.folder or self.name

    def label(self, obj_id: int) -> str:
        """An object's name, or "object N" where it has none."""
        return self.names.get(obj_id, f"object {obj_id}")

    def number(self, name: str) -> int:
        """Of the object of this name. Raises ConfigError."""
        numbers = {_plain(known): obj_id for obj_id, known in self.names.items() if obj_id in self.objects}
        if _plain(name) not in numbers:
            known = ", ".join(f"{k} {v}" for k, v in self.names.items() if k in self.objects) or "numbers only"
            raise ConfigError(f"{self.title} has no object {name!r}; it has {known}.")
        return numbers[_plain(name)]


def _plain(name: str) -> str:
    return name.lower().replace("_", " ").strip()


_LM = {1: "ape", 2: "benchvise", 3: "bowl", 4: "cam", 5: "can", 6: "cat", 7: "cup", 8: "driller", 9: "duck",
       10: "eggbox", 11: "glue", 12: "holepuncher", 13: "iron", 14: "lamp", 15: "phone"}  # fmt: skip
_YCB = dict(enumerate(
    ("master chef can", "cracker box", "sugar box", "tomato soup can", "mustard bottle", "tuna fish can",
     "pudding box", "gelatin box", "potted meat can", "banana", "pitcher base", "bleach cleanser", "bowl", "mug",
     "power drill", "wood block", "scissors", "large marker", "large clamp", "extra large clamp", "foam brick"), 1,
))  # fmt: skip


def _bop(name: str, title: str, objects: tuple[int, ...], test: str, **more: object) -> DatasetInfo:
    archives = (f"{name}_base.zip", f"{name}_models.zip", f"{name}_{test}.zip")
    return DatasetInfo(name, title, objects, archives=archives, **more)  # type: ignore[arg-type]


def _upto(n: int) -> tuple[int, ...]:
    return tuple(range(1, n + 1))


_KNOWN = (
    _bop("lm", "LINEMOD", _upto(15), "test_all", names=_LM, flipped=(10,)),
    _bop("lmo", "LINEMOD-Occluded", (1, 5, 6, 8, 9, 10, 11, 12), "test_bop19", names=_LM, flipped=(10,)),
    DatasetInfo(
        "linemod",
        "LINEMOD, 13 objects, 15-degree split",
        tuple(CLASSES),
        _LM,
        folder="lm",
        archives=("lm_base.zip", "lm_models.zip", "lm_test_all.zip"),
        flipped=(10,),
    ),
    _bop("ycbv", "YCB-Video", _upto(21), "test_bop19", names=_YCB),
    _bop("tless", "T-LESS", _upto(30), "test_primesense_bop19", split="test_primesense", models="models_cad"),
    _bop("tudl", "TU Dresden Light", _upto(3), "test_bop19", names={1: "dragon", 2: "frog", 3: "can"}),
    _bop("icbin", "IC-BIN", _upto(2), "test_bop19", names={1: "coffee cup", 2: "juice carton"}),
    _bop("itodd", "MVTec ITODD", _upto(28), "test_bop19", vsd_delta=0.005),
    _bop(
        "hb",
        "HomebrewedDB",
        (1, 3, 4, 8, 9, 10, 12, 15, 17, 18, 19, 22, 23, 29, 32, 33),
        "test_primesense_bop19",
        split="test_primesense",
    ),
    _bop("tyol", "Toyota Light", _upto(21), "test_bop19"),
    _bop("icmi", "IC-MI", _upto(6), "test_bop19"),
    _bop("ruapc", "Rutgers APC", _upto(14), "test_bop19"),
)
DATASETS = {info.name: info for info in _KNOWN}


def dataset_info(name: str) -> DatasetInfo:
    """What is known of a data set. Raises ConfigError for an unknown name."""
    if name not in DATASETS:
        near = difflib.get_close_matches(name, DATASETS, 1)
        meant = f" Did you mean {near[0]}?" if near else ""
        raise ConfigError(
            f"there is no data set {name!r}; there are {', '.join(DATASETS)}.{meant} Any other one in BOP layout: "
            "give its folder (--root DIR, root= in Python) without a name."
        )
    return DATASETS[name]


def data_folder() -> Path:
    """Where data sets lie: ``$POSEKIT_DATA``, else posekit's folder in the user's cache."""
    given = os.environ.get("POSEKIT_DATA")
    if given:
        return Path(given).expanduser()
    cache = os.environ.get("XDG_CACHE_HOME")
    return (Path(cache) if cache else Path.home() / ".cache") / "posekit" / "data"


def find_root(info: DatasetInfo, root: Path | None, split: str | None = None) -> Path:
    """The data set's folder with a split (by default its usual one): ``root`` itself or the one of its name in it, else
    in `data_folder`.

    Raises InputError where it is not there; the message has the command that fetches it.
    """
    base = data_folder() if root is None else root
    candidates = [base / info.below, base / info.name] if root is None else [base, base / info.below, base / info.name]
    folder = (split or info.split).partition(":")[0]
    for candidate in candidates:
        if (candidate / folder).is_dir() or is_deepim(candidate):
            return candidate
    raise InputError(
        f"the data set {info.name} ({info.title}) is not in {base}: there is no folder {folder}/ in it or in "
        f"{info.below}/. Fetch it with: posekit download {info.name} --root {base}; or give the folder that "
        "has it (--root DIR, root= in Python)."
    )


def own_names(root: Path) -> dict[int, str]:
    """The names of a synthetic data set's objects, by number; empty where it has none. Raises InputError."""
    path = root / NAMES
    if not path.is_file():
        return {}
    try:
        return {int(number): str(name) for number, name in json.loads(path.read_text(encoding="utf-8")).items()}
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"{path} cannot be read ({error}): it holds the objects' names by number.") from error


def open_dataset(
    name: str | None, root: Path | None, split: str | None = None, units: str = "auto", targets: str | None = "auto"
) -> tuple[Dataset, DatasetInfo]:
    """A data set by its name, its folder, or both. units: of the meshes. targets: as `BopDataset` takes them. Raises
    ConfigError, InputError.

    Without a name the folder's own is taken where it is a known one; RBOT's and BCOT's folders are known by their
    files.
    """
    if name is None and root is None:
        raise ConfigError(
            "which data set? Give its name (--dataset NAME, dataset= in Python), or the folder of one in BOP layout "
            "(--root DIR, root=)."
        )
    if name is None:
        assert root is not None
        if is_rbot(root) or is_bcot(root):
            return _sequences(root, split, units)
        known = DATASETS.get(root.resolve().name)
        if known is None or not (root / (split or known.split).partition(":")[0]).is_dir():
            data = BopDataset(root, split or "test", targets, units=units)
            return data, DatasetInfo(data.name, data.name, tuple(data.model_ids()), own_names(root))
        name = known.name
    info = dataset_info(name)
    folder = find_root(info, root, split)
    if name == "linemod":
        if units != "auto":
            raise ConfigError(f"the units of {info.title}'s meshes are known: leave the units {units} out.")
        chosen = DeepimDataset(folder) if is_deepim(folder) else LinemodDataset(folder, split or info.split)
        return chosen, info
    models = info.models if (folder / info.models).is_dir() else "models"
    return BopDataset(folder, split or info.split, targets, models=models, units=units), info


def _sequences(root: Path, split: str | None, units: str) -> tuple[Dataset, DatasetInfo]:
    data = RbotDataset(root, split, units) if is_rbot(root) else BcotDataset(root, split, units)
    return data, DatasetInfo(data.name, data.name.upper(), tuple(data.model_ids()), data.object_names())
