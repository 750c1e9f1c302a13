"""``posekit calibrate``: a camera file from pictures of a board, and the board to print."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from posekit.errors import ConfigError

if TYPE_CHECKING:
    from posekit.io.calibrate import CalibrationResult

BOARD, OUTPUT = "Board", "Output"
_MOST_TOLD = 12  # pictures that were left out


def calibrate(
    sources: Annotated[
        list[str] | None,
        typer.Argument(metavar="IMAGES|FOLDER|VIDEO", help="What shows the board, at least 8 times."),
    ] = None,
    pattern: Annotated[Literal["charuco", "chessboard"], typer.Option(help="Of the board.", rich_help_panel=BOARD)] = (
        "charuco"
    ),
    squares: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMNSxROWS",
            help="Squares, not inner corners. By default as printed: 7x5, of a chessboard 10x7.",
            rich_help_panel=BOARD,
        ),
    ] = None,
    square_mm: Annotated[
        float | None,
        typer.Option(metavar="MM", help="A square's side. By default 35, of a chessboard 25.", rich_help_panel=BOARD),
    ] = None,
    marker_mm: Annotated[
        float | None,
        typer.Option(
            metavar="MM", help="A marker's side. By default 26 of 35 parts of a square's.", rich_help_panel=BOARD
        ),
    ] = None,
    dictionary: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Of the markers, as 4X4_50. By default 5X5_50.", rich_help_panel=BOARD),
    ] = None,
    board_pdf: Annotated[
        Path | None,
        typer.Option(metavar="PDF", help="Write the board to print, and nothing else.", rich_help_panel=BOARD),
    ] = None,
    paper: Annotated[Literal["a4", "letter"], typer.Option(help="Of --board-pdf.", rich_help_panel=BOARD)] = "a4",
    fisheye: Annotated[
        bool, typer.Option("--fisheye", help="OpenCV's fisheye model, for a field of view over about 110 degrees.")
    ] = False,
    views: Annotated[int, typer.Option(min=3, help="At most so many are used, the most different ones.")] = 40,
    out: Annotated[
        Path, typer.Option(metavar="JSON", help="The camera file, for --camera.", rich_help_panel=OUTPUT)
    ] = Path("camera.json"),
    force: Annotated[
        bool, typer.Option("--force", help="Replace a file that is there already.", rich_help_panel=OUTPUT)
    ] = False,
) -> None:
    """Calibrate a camera from pictures or a video of a ChArUco board or a chessboard."""
    if board_pdf is not None and sources:
        raise ConfigError("--board-pdf writes the board and nothing else: leave the pictures out, or the option.")
    if board_pdf is None and not sources:
        raise ConfigError(
            "nothing to calibrate from: give pictures, a folder or a video of the board; --board-pdf board.pdf writes "
            "the board to print."
        )
    target = out if board_pdf is None else board_pdf
    _check(target, ".json" if board_pdf is None else ".pdf", "--out" if board_pdf is None else "--board-pdf", force)

    from posekit.io.board import Board
    from posekit.io.files import write_bytes_atomic, write_text_atomic

    board = Board.chosen(pattern, squares, square_mm, marker_mm, dictionary)
    if board_pdf is not None:
        write_bytes_atomic(board_pdf, board.page(paper))
        typer.echo(f"{board_pdf}: {board}, on {paper.upper()} paper")
        typer.echo("print it at 100 %, not fitted to the page; measure the squares; glue it to something flat")
        return

    from posekit.io.calibrate import CalibrationConfig, calibrate

    with _showing() as told:
        found = calibrate(sources or [], CalibrationConfig(board, fisheye, views), told)
    write_text_atomic(out, found.to_json())
    _tell(found)
    typer.echo(f"camera: {out}\nnext: posekit estimate PHOTO --model MESH --camera {out}")


def _check(path: Path, suffix: str, option: str, force: bool) -> None:
    """Raises ConfigError or OutputError where a file cannot be written, before any work."""
    from posekit.errors import OutputError
    from posekit.io.files import check_writable

    if path.suffix.lower() != suffix:
        raise ConfigError(f"{option} {path}: name a file that ends in {suffix}.")
    if not path.parent.is_dir():
        raise OutputError(f"{option} {path}: there is no folder {path.parent}. Make it first.")
    if path.is_dir():
        raise OutputError(f"{option} {path} is a folder: name a file.")
    if path.exists() and not force:
        raise OutputError(f"{path} is there already: pass --force to replace it, or another {option}.")
    check_writable(path.parent, f"{option} {path} cannot be written")


@contextmanager
def _showing() -> Iterator[Callable[[str], None]]:
    """What is looked at, on a terminal only."""
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status("looking for the board ...") as status:
        yield lambda text: status.update(f"looking for the board: {escape(text)}")


def _tell(found: CalibrationResult) -> None:
    """A calibration for a person: how good, of what, and what was left out."""
    import logging

    camera, (worst, worst_px) = found.camera, found.worst
    typer.echo(f"reprojection error {found.rms_px:.2f} pixels (RMS), of the worst picture {worst_px:.2f} ({worst})")
    more = f"; {found.unneeded} more show the board much like these" if found.unneeded else ""
    typer.echo(f"{len(found.errors_px)} pictures used{more}")
    if found.left_out:
        typer.echo(f"{len(found.left_out)} left out:")
        for label, reason in list(found.left_out.items())[:_MOST_TOLD]:
            typer.echo(f"    {label}: {reason}")
        if len(found.left_out) > _MOST_TOLD:
            typer.echo(f"    and {len(found.left_out) - _MOST_TOLD} more")
    values = zip(("fx", "fy", "cx", "cy"), (camera.fx, camera.fy, camera.cx, camera.cy), strict=True)
    std = found.std_px or (None,) * 4
    numbers = [
        f"{name} {value:.2f}" + ("" if doubt is None else f" ± {doubt:.2f}")
        for (name, value), doubt in zip(values, std, strict=True)
    ]
    typer.echo(f"{', '.join(numbers)}, pictures of {camera.width}x{camera.height} pixels")
    typer.echo(f"distortion ({found.model}): {', '.join(f'{value:.4g}' for value in found.coefficients)}")
    near, far = found.distance_m
    typer.echo(
        f"the board: in {100 * found.coverage:.0f} % of the picture, {near:.2f} to {far:.2f} m away, turned by up to "
        f"{found.tilt_deg:.0f} degrees"
    )
    for text in found.warnings:
        logging.getLogger("posekit").warning(text)
