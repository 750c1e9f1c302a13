"""A training's curves: CSV files and TensorBoard."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from posekit.errors import ConfigError, OutputError
from posekit.io.files import write_text_atomic


class Curves:
    """``train.csv``, ``validation.csv`` and ``tensorboard/`` in a run's folder.

    What lies beyond ``step`` there is of steps that a kill took back, and is dropped.
    """

    def __init__(self, folder: Path, step: int) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise ConfigError("training needs TensorBoard: pip install 'posekit[train]'.") from error
        self.folder = folder
        for name in ("train", "validation"):
            self._take_back(folder / f"{name}.csv", step)
        self._writer: Any = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def add(self, name: str, step: int, seconds: float, values: Mapping[str, float]) -> None:
        """A row of ``name``.csv. Raises OutputError where it cannot be written."""
        path = self.folder / f"{name}.csv"
        row: dict[str, Any] = {"step": step, "seconds": f"{seconds:.1f}", **{k: f"{v:.6g}" for k, v in values.items()}}
        try:
            new = not path.exists()
            with path.open("a", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, list(row))
                if new:
                    writer.writeheader()
                writer.writerow(row)
            for key, value in values.items():
                self._writer.add_scalar(f"{name}/{key}", value, step)
            self._writer.flush()
        except OSError as error:
            raise OutputError(
                f"{path} cannot be written: {error.strerror}. Free some space, go on with --resume."
            ) from error

    def rows(self, name: str) -> list[dict[str, str]]:
        """What has been added so far."""
        return _rows(self.folder / f"{name}.csv")

    def close(self) -> None:
        """Write what is still held and close the files."""
        self._writer.close()

    def _take_back(self, path: Path, step: int) -> None:
        rows = _rows(path)
        kept = [row for row in rows if int(row["step"]) <= step]
        if len(kept) < len(rows):
            lines = [",".join(rows[0]), *(",".join(row.values()) for row in kept)]
            write_text_atomic(path, "".join(f"{line}\n" for line in lines))


def _rows(path: Path) -> list[dict[str, str]]:
    """A CSV file's whole rows; a last one that a kill cut short is left out."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if None not in row and None not in row.values() and row["step"]]
