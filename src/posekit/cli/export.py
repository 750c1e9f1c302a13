"""``posekit export``: the network as a file for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from posekit.cli.options import ForceOption, WeightsOption
from posekit.errors import OutputError


def export(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the files, new or empty.")],
    format: Annotated[
        Literal["openvino", "onnx"],
        typer.Option("--format", help="openvino: svnet.xml and svnet.bin. onnx: svnet.onnx (extra export)."),
    ] = "openvino",
    weights: WeightsOption = None,
    force: ForceOption = False,
) -> None:
    """Write the network that compares a photograph with a rendering, and compare its answers with PyTorch's."""
    from posekit.nets.export import BOUND, export_svnet
    from posekit.nets.weights import load_networks

    if out.is_dir() and any(out.iterdir()) and not force:
        raise OutputError(f"the output folder {out} holds files already: choose another one, or give --force.")
    done = export_svnet(load_networks("lite", weights), out, format)
    for name, difference in done.differences.items():
        typer.echo(f"{name:12} {difference:.1e}")
    typer.echo(f"largest difference from PyTorch: {max(done.differences.values()):.1e}, at most {BOUND:g} is allowed")
    typer.echo(f"written: {done.file}")
