"""``posekit synth``: synthetic data sets in BOP layout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from posekit.cli.options import MACHINE, Units, parse_size
from posekit.cli.progress import progress_bar
from posekit.errors import ConfigError

WHAT, LOOK = "What", "Look"
PER_OBJECT, DEFAULT = 5000, 1000  # images, the paper's for each object (section 4.1), and of other kinds


def synth(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the data set; it must be new or empty.")],
    models: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR|FILE", help="Meshes; repeat it, or name more behind it.", rich_help_panel=WHAT),
    ] = None,
    more: Annotated[list[Path] | None, typer.Argument(metavar="[MESH]...", help="More meshes.")] = None,
    kind: Annotated[
        Literal["randomised", "photoreal", "scenes", "sequence"], typer.Option(help="Of images.", rich_help_panel=WHAT)
    ] = "randomised",
    images: Annotated[
        int | None,
        typer.Option(
            min=1, help="In all; by default 5000 for each object (randomised), else 1000.", rich_help_panel=WHAT
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same data set.", rich_help_panel=WHAT)] = 0,
    units: Annotated[Units, typer.Option(help="Of the meshes.", rich_help_panel=WHAT)] = "auto",
    symmetry: Annotated[
        str,
        typer.Option(
            metavar="detect|none|TEXT",
            help="Of meshes that no models_info.json beside them describes; TEXT as z:2 or z:inf.",
            rich_help_panel=WHAT,
        ),
    ] = "detect",
    split: Annotated[str, typer.Option(help="The folder of the scenes.", rich_help_panel=WHAT)] = "train",
    shards: Annotated[
        int, typer.Option(min=0, metavar="IMAGES", help="Write WebDataset shards too.", rich_help_panel=WHAT)
    ] = 0,
    size: Annotated[str, typer.Option(metavar="WxH", help="Of the images, pixels.", rich_help_panel=LOOK)] = "640x480",
    quality: Annotated[int, typer.Option(help="Of JPEG, percent; 0 writes PNG.", rich_help_panel=LOOK)] = 95,
    backgrounds: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Photographs, or Pascal VOC; else procedural.", rich_help_panel=LOOK),
    ] = None,
    hdri: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Environments (.exr, .hdr) of photoreal.", rich_help_panel=LOOK)
    ] = None,
    frames: Annotated[int, typer.Option(help="Of a sequence.", rich_help_panel=LOOK)] = 100,
    motion: Annotated[
        Literal["mixed", "still", "slow", "smooth", "fast", "jerky", "hidden", "leaving"],
        typer.Option(help="Of sequences; mixed: each in its turn.", rich_help_panel=LOOK),
    ] = "mixed",
    views: Annotated[int, typer.Option(help="Of a photoreal room.", rich_help_panel=LOOK)] = 4,
    samples: Annotated[int, typer.Option(help="Light paths per pixel of photoreal.", rich_help_panel=LOOK)] = 32,
    variant: Annotated[
        str, typer.Option(help="Mitsuba's; auto takes the fastest one here.", rich_help_panel=MACHINE)
    ] = "auto",
    workers: Annotated[int, typer.Option(help="Processes on this machine.", rich_help_panel=MACHINE)] = 1,
    ray: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS|local", help="A Ray cluster that shares the folder.", rich_help_panel=MACHINE),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the data set in --out, as it was begun.")
    ] = False,
) -> None:
    """Make a data set of your meshes: images, depth, masks and poses in BOP layout."""
    from posekit.synth.plan import SynthConfig
    from posekit.synth.run import Machines, begin, run

    machines, given = Machines(workers, ray), [*(models or ()), *(more or ())]
    if resume and given:
        raise ConfigError("--resume goes on with the models of the data set in --out: leave --models out.")
    if not resume:
        if not given:
            raise ConfigError("a data set needs meshes: pass --models DIR or --models FILE.")
        from posekit.synth.objects import read_objects
        from posekit.synth.run import check_new

        check_new(out)
        objects = read_objects(given, units, symmetry)
        count = images or (PER_OBJECT * len(objects) if kind == "randomised" else DEFAULT)
        config = SynthConfig(
            kind, count, seed, split, parse_size(size), quality, _text(backgrounds), _text(hdri), frames, views,
            samples, variant, motion,
        )  # fmt: skip
        begin(config, out, objects)
    with progress_bar("count", "elapsed", "remaining") as update:
        made = run(out, machines, lambda done, total: update(completed=done, total=total), shards)
    typer.echo(f"{made} images made; data set: {out}")
    typer.echo(f"contact sheet: {out / 'contact_sheet.jpg'}\nstatistics: {out / 'statistics.json'}")


def _text(path: Path | None) -> str:
    return "" if path is None else str(path.resolve())
