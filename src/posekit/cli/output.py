"""Where results go: a folder, a JSON file, standard output."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from posekit.cli.messages import Tell, working
from posekit.cli.options import NOT_RELIABLE
from posekit.errors import OutputError
from posekit.geometry import rotation_angle
from posekit.io.files import check_writable, write_bytes_atomic, write_text_atomic
from posekit.io.pose_formats import NamedPose, check_formats, pose_files
from posekit.results import Estimate

SMALL = 40  # pixels, longer side of an object's box below which that is said
log = logging.getLogger("posekit")

if TYPE_CHECKING:
    from posekit.estimate.estimator import PoseEstimator
    from posekit.mesh.model import ObjectModel
    from posekit.view import View


@dataclass(frozen=True)
class OutputFolder:
    """A folder that is made when the first file is written.

    Raises OutputError where it is a file, or holds files already and ``force`` is not given.
    """

    path: Path
    force: bool = False

    def __post_init__(self) -> None:
        occupied = _occupied(self.path)
        if self.path.exists() and not self.path.is_dir():
            raise OutputError(f"{self.path} is a file: --out names a folder.")
        if occupied and not self.force:
            raise OutputError(f"the folder {self.path} holds files: pass --force to write into it, or another --out.")
        check_writable(self.path, f"the output folder {self.path} cannot be written")

    @classmethod
    def chosen(cls, out: Path | None, default: Path, force: bool) -> OutputFolder:
        """``out`` where it is given; else the default, with a number behind its first part where that holds files:
        posekit-out/photo, posekit-out-2/photo, posekit-out-3/photo."""
        if out is not None or force:
            return cls(out or default, force)
        first, *rest = default.parts
        for number in itertools.count(1):
            path = Path(first if number == 1 else f"{first}-{number}", *rest)
            if not _occupied(path):
                return cls(path)
        raise AssertionError("counting has no end")

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


def _occupied(folder: Path) -> bool:
    """Whether there is such a folder and it holds something. Raises OutputError where it cannot be read."""
    try:
        return folder.is_dir() and any(folder.iterdir())
    except OSError as error:
        raise OutputError(f"the output folder {folder} cannot be read: {error.strerror}.") from error


def check_json(json: str | None) -> None:
    """Whether ``--json`` can be written. Raises OutputError."""
    if json is None or json == "-":
        return
    if Path(json).is_dir():
        raise OutputError(f"--json {json} is a folder: give a file, or - for standard output.")
    if not Path(json).parent.is_dir():
        raise OutputError(f"--json {json}: there is no folder {Path(json).parent}. Make it first.")
    check_writable(Path(json).parent, f"--json {json} cannot be written")


def write_json(json: str | None, text: str) -> None:
    """A document where ``--json`` asks for it: nowhere, on standard output (-) or in a file."""
    if json == "-":
        typer.echo(text, nl=False)
    elif json is not None:
        write_text_atomic(Path(json), text)
        typer.echo(f"JSON: {json}")


@dataclass(frozen=True)
class Destination:
    """What ``--out``, ``--force`` and ``--json`` ask for, checked before any work is done.

    json: None, "-" or a file. With ``--json`` and no ``--out`` no folder is written. formats: of further files with
    the poses. recording: the name of a recording for Rerun, None for none.
    """

    folder: OutputFolder | None
    json: str | None
    formats: tuple[str, ...] = ()
    recording: str | None = None

    @classmethod
    def chosen(
        cls,
        out: Path | None,
        default: Path,
        force: bool,
        json: str | None,
        formats: Sequence[str] = (),
        recording: str | None = None,
    ) -> Destination:
        """Raises OutputError where something cannot be written there, ConfigError for an unknown format."""
        check_json(json)
        check_formats(formats)
        if out is None and json is not None:
            if set(formats) - {"json"}:
                raise OutputError(f"--format {formats[0]} with --json writes into a folder: pass --out DIR too.")
            if recording is not None:
                raise OutputError("--rerun with --json writes into a folder: pass --out DIR too.")
            return cls(None, json)
        if recording is not None:
            from posekit.visualise.recording import load_rerun

            load_rerun()
        return cls(OutputFolder.chosen(out, default, force), json, tuple(formats), recording)

    def say(self, text: str) -> None:
        """Tell the person something; on standard error where standard output is for JSON."""
        typer.echo(text, err=self.json == "-")

    @contextmanager
    def working(self, what: str) -> Iterator[Tell]:
        """As `posekit.cli.messages.working`."""
        with working(what) as tell:
            yield tell

    def deliver(
        self,
        estimator: PoseEstimator,
        view: View,
        estimates: Sequence[Estimate],
        files: Mapping[str, Path],
        blend: float = 0.0,
        symmetry: str | None = "none",
        overlay: bool = True,
    ) -> None:
        """`deliver_all` of one mesh. files: what they were made from, by name, for the result."""
        self.deliver_all(view, [(estimator, estimates)], [files], blend, symmetry, overlay)

    def deliver_all(
        self,
        view: View,
        results: Sequence[tuple[PoseEstimator, Sequence[Estimate]]],
        files: Sequence[Mapping[str, Path]],
        blend: float = 0.0,
        symmetry: str | None = "none",
        overlay: bool = True,
    ) -> None:
        """Print the estimates and write them: one result as JSON, and one overlay where that is wanted. files: by mesh.
        blend: how much of the rendered meshes the overlay shows. symmetry: what was said of the meshes, None where
        nothing was."""
        from posekit.estimate.document import result_json

        for (estimator, estimates), made_from in zip(results, files, strict=True):
            for estimate in estimates:
                self.say(describe(estimate))
            if not estimates:
                self.say(f"{estimator.model.name} not found: no pose.")
            seen = _unstated_symmetry(estimator, made_from["mesh"]) if estimates and symmetry is None else "none"
            for note in limits(estimator.model, estimates, seen):
                log.info(note)
        about: dict[str, object] = dict(files[0])
        if len(files) > 1:
            about["mesh"] = [each["mesh"] for each in files]
        found = [estimate for _, estimates in results for estimate in estimates]
        result = result_json(view, found, results[0][0].weights_hash, about)
        if self.folder is not None:
            if overlay:
                self.say(f"overlay: {self.folder.write('overlay.png', _overlay(view, results, blend))}")
            self.say(f"result: {self.folder.write('result.json', result)}")
            for format_ in dict.fromkeys(self.formats):
                for name, text in pose_files(format_, [named_pose(each) for each in found]).items():
                    self.say(f"{format_}: {self.folder.write(name, text)}")
            if self.recording is not None:
                from posekit.visualise.recording import record_estimates

                shown = [(estimator.model, each) for estimator, estimates in results for each in estimates]
                record_estimates(self.folder.path / self.recording, view, shown)
                self.say(f"recording: {self.folder.path / self.recording}")
        self.write_json(result)

    def write_json(self, text: str) -> None:
        """Where ``--json`` asks for it."""
        write_json(self.json, text)


def _overlay(view: View, results: Sequence[tuple[PoseEstimator, Sequence[Estimate]]], blend: float) -> bytes:
    """All objects in one picture, PNG."""
    from posekit.visualise import draw
    from posekit.visualise.figures import overlay

    found = [(estimator.model, estimate) for estimator, estimates in results for estimate in estimates]
    return draw.png(overlay(results[0][0].renderer, view, found, blend))


def describe(estimate: Estimate) -> str:
    """An estimate for a person, some lines: first whether it can be used."""
    rows = "\n".join("    " + " ".join(f"{value:9.5f}" for value in row) for row in estimate.T_cam_obj.matrix)
    steps = f"{estimate.iterations} iteration{'' if estimate.iterations == 1 else 's'}"
    colour = None if estimate.reliable else typer.colors.RED
    return (
        f"{estimate.model}: {typer.style(estimate.verdict, fg=colour, bold=True)}\n"
        f"    score {estimate.score:.2f}, {steps}, {estimate.timings['total']:.1f} s\n"
        f"    T_cam_obj (metres)\n{rows}"
        + "".join(f"\n    {_alternative(k, estimate)}" for k in range(len(estimate.alternatives)))
    )


def _alternative(k: int, estimate: Estimate) -> str:
    """The k-th alternative, how it differs, in a line; its matrix is in result.json."""
    other = estimate.alternatives[k]
    turn = math.degrees(rotation_angle(other.T_cam_obj.R.T @ estimate.T_cam_obj.R))
    return f"alternative {k + 2}: turned by {turn:.0f} degrees, score {other.score:.2f}; {other.verdict}"


def named_pose(estimate: Estimate, frame: int = 0, seconds: float | None = None) -> NamedPose:
    """An estimate as other programs' formats take it."""
    return NamedPose(
        estimate.model, estimate.T_cam_obj, estimate.score, estimate.angle_deg, estimate.reliable, frame, seconds
    )


def _unstated_symmetry(estimator: PoseEstimator, mesh: Path) -> str:
    """The symmetry that a mesh has by the looks of it and nobody told; "none" without one."""
    from posekit.datasets.symmetry import declared, detected_symmetry

    model = estimator.model
    return "none" if model.symmetries or declared(mesh) else detected_symmetry(estimator.renderer, model)


def limits(model: ObjectModel, estimates: Sequence[Estimate], symmetry: str = "none") -> list[str]:
    """What the mesh and the picture do not allow, each once, with what helps. symmetry: that nobody told, as
    ``--symmetry`` takes it."""
    notes = []
    if estimates and symmetry != "none":
        from posekit.datasets.symmetry import in_words

        notes.append(
            f"{model.name} looks the same after {in_words(symmetry)}, so that several poses fit equally well and any "
            f"of them may be given: pass --symmetry {symmetry} to have it considered, or --symmetry none."
        )
    if estimates and not model.coloured:
        notes.append(
            f"{model.name} has no colours: only its shape is compared, and a turn that leaves the silhouette as it is "
            "may go unseen. A mesh with vertex colours or a texture helps."
        )
    sizes = [max(x1 - x0, y1 - y0) for x0, y0, x1, y1 in (estimate.box for estimate in estimates)]
    small = [size for size in sizes if size < SMALL]
    if small:
        count = f"{len(small)} of {len(sizes)} times " if len(sizes) > 1 else ""
        notes.append(
            f"{model.name} is only {min(small):.0f} pixels large {count}in the picture: its rotation is uncertain "
            f"below {SMALL}. Take the photograph from nearer, or with more pixels."
        )
    return notes


def end_unless_reliable(estimates: Sequence[Estimate]) -> None:
    """For ``--require-reliable``: exit code 3 where there is no estimate, or one that is not reliable."""
    if not estimates or not all(estimate.reliable for estimate in estimates):
        raise typer.Exit(NOT_RELIABLE)
