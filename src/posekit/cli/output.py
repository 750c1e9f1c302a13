"""Where results go: a folder, a JSON file, standard output."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import typer

from posekit.errors import OutputError
from posekit.files import check_writable, write_bytes_atomic, write_text_atomic
from posekit.results import Estimate, estimates_to_json

if TYPE_CHECKING:
    from posekit.estimate import PoseEstimator
    from posekit.view import View


@dataclass(frozen=True)
class OutputFolder:
    """A folder that is made when the first file is written.

    Raises OutputError where it is a file, or holds files already and ``force`` is not given.
    """

    path: Path
    force: bool = False

    def __post_init__(self) -> None:
        try:
            occupied = self.path.is_dir() and any(self.path.iterdir())
        except OSError as error:
            raise OutputError(f"the output folder {self.path} cannot be read: {error.strerror}.") from error
        if self.path.exists() and not self.path.is_dir():
            raise OutputError(f"{self.path} is a file: --out names a folder.")
        if occupied and not self.force:
            raise OutputError(f"the folder {self.path} holds files: pass --force to write into it, or another --out.")
        check_writable(self.path, f"the output folder {self.path} cannot be written")

    def write(self, name: str, data: bytes | str) -> Path:
        """Write one file, whole or not at all, and return its path."""
        path = self.path / name
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the folder {self.path} cannot be made: {error.strerror}.") from error
        if isinstance(data, str):
            write_text_atomic(path, data)
        else:
            write_bytes_atomic(path, data)
        return path


@dataclass(frozen=True)
class Destination:
    """What ``--out``, ``--force`` and ``--json`` ask for, checked before any work is done.

    json: None, "-" or a file. With ``--json`` and no ``--out`` no folder is written.
    """

    folder: OutputFolder | None
    json: str | None

    @classmethod
    def chosen(cls, out: Path | None, default: Path, force: bool, json: str | None) -> Destination:
        if json is not None and json != "-":
            if Path(json).is_dir():
                raise OutputError(f"--json {json} is a folder: give a file, or - for standard output.")
            if not Path(json).parent.is_dir():
                raise OutputError(f"--json {json}: there is no folder {Path(json).parent}. Make it first.")
            check_writable(Path(json).parent, f"--json {json} cannot be written")
        if out is None and json is not None:
            return cls(None, json)
        return cls(OutputFolder(out or default, force), json)

    def say(self, text: str) -> None:
        """Tell the person something; on standard error where standard output is for JSON."""
        typer.echo(text, err=self.json == "-")

    @contextmanager
    def working(self, what: str) -> Iterator[None]:
        """Show what is being done, on a terminal only."""
        from rich.console import Console

        with Console(stderr=True).status(f"{what} ..."):
            yield

    def deliver(
        self, estimator: PoseEstimator, view: View, estimates: Sequence[Estimate], files: Mapping[str, Path]
    ) -> None:
        """`deliver_all` of one mesh. files: what they were made from, by name, for the result."""
        self.deliver_all(view, [(estimator, estimates)], [files])

    def deliver_all(
        self,
        view: View,
        results: Sequence[tuple[PoseEstimator, Sequence[Estimate]]],
        files: Sequence[Mapping[str, Path]],
    ) -> None:
        """Print the estimates and write them: one result as JSON, and an overlay for each mesh. files: by mesh."""
        for estimator, estimates in results:
            for estimate in estimates:
                self.say(describe(estimate))
            if not estimates:
                self.say(f"no pose: nothing in the picture could be taken for {estimator.model.name}.")
        result = _result(view, results, files)
        if self.folder is not None:
            for name, data in _overlays(view, results):
                self.say(f"overlay: {self.folder.write(name, data)}")
            self.say(f"result: {self.folder.write('result.json', result)}")
        if self.json == "-":
            typer.echo(result, nl=False)
        elif self.json is not None:
            write_text_atomic(Path(self.json), result)
            self.say(f"result: {self.json}")


def _overlays(view: View, results: Sequence[tuple[PoseEstimator, Sequence[Estimate]]]) -> Iterator[tuple[str, bytes]]:
    """Names of files and PNGs: overlay.png of one mesh; of several overlay-1-NAME.png and so on."""
    from posekit import draw
    from posekit.figures import overlay

    for k, (estimator, estimates) in enumerate(results):
        name = "overlay.png" if len(results) == 1 else f"overlay-{k + 1}-{estimator.model.name}.png"
        yield name, draw.png(overlay(estimator.renderer, estimator.model, view, estimates))


def describe(estimate: Estimate) -> str:
    """An estimate for a person, some lines."""
    rows = "\n".join("    " + " ".join(f"{value:9.5f}" for value in row) for row in estimate.T_cam_obj.matrix)
    state = "converged" if estimate.converged else "not converged"
    steps = f"{estimate.iterations} iteration{'' if estimate.iterations == 1 else 's'}"
    return (
        f"{estimate.model}: T_cam_obj (metres)\n{rows}\n"
        f"    predicted error {np.rad2deg(estimate.angle):.1f} degrees, {state} after {steps}, "
        f"score {estimate.score:.2f}, {estimate.timings['total']:.1f} s"
    )


def _result(
    view: View, results: Sequence[tuple[PoseEstimator, Sequence[Estimate]]], files: Sequence[Mapping[str, Path]]
) -> str:
    """The entries of one mesh as they are; of several, ``mesh`` lists them."""
    camera, lens = view.camera, view.lens
    about: dict[str, object] = dict(files[0])
    seen_by: dict[str, object] = {"K": camera.K, "width": camera.width, "height": camera.height}
    if lens is not None:  # boxes, masks and overlays are of the undistorted picture
        taken = {"K": lens.camera.K, "width": lens.camera.width, "height": lens.camera.height}
        seen_by["undistorted_from"] = {**taken, "model": lens.model, "distortion_coefficients": list(lens.coefficients)}
    if len(files) > 1:
        about["mesh"] = [each["mesh"] for each in files]
    return estimates_to_json(
        [estimate for _, estimates in results for estimate in estimates],
        weights_hash=results[0][0].weights_hash,
        versions={name: version(name) for name in ("torch", "numpy", "opencv-python-headless", "moderngl")},
        about={**about, "camera": seen_by},
    )
