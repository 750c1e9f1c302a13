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
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the data set, new or empty.")],
    models: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR|FILE",
            help="Mesh or folder of meshes; repeat the option, or list more meshes after the options.",
            rich_help_panel=WHAT,
        ),
    ] = None,
    more: Annotated[
        list[Path] | None, typer.Argument(metavar="[MESH]...", help="Further meshes, beside --models.")
    ] = None,
    kind: Annotated[
        Literal["randomised", "photoreal", "scenes", "sequence"],
        typer.Option(
            help="Kind of images: randomised (objects before backgrounds), scenes (objects that lie together), "
            "sequence (videos), photoreal (path-traced rooms).",
            rich_help_panel=WHAT,
        ),
    ] = "randomised",
    images: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of images in all. Default: 5000 for each object (randomised), else 1000.",
            rich_help_panel=WHAT,
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Random seed; the same one gives the same data set.", rich_help_panel=WHAT)
    ] = 0,
    units: Annotated[
        Units,
        typer.Option(help="Length unit of the meshes' coordinates; auto decides by their size.", rich_help_panel=WHAT),
    ] = "auto",
    symmetry: Annotated[
        str,
        typer.Option(
            metavar="detect|none|TEXT",
            help="Symmetries of meshes without a models_info.json beside them: detect them, none, or as z:2 or z:inf.",
            rich_help_panel=WHAT,
        ),
    ] = "detect",
    split: Annotated[str, typer.Option(help="Name of the folder for the scenes.", rich_help_panel=WHAT)] = "train",
    shards: Annotated[
        int,
        typer.Option(
            min=0,
            metavar="IMAGES",
            help="Also write WebDataset shards of so many images each; 0: none.",
            rich_help_panel=WHAT,
        ),
    ] = 0,
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Width and height of the images, pixels.", rich_help_panel=LOOK)
    ] = "640x480",
    quality: Annotated[int, typer.Option(help="JPEG quality, percent; 0 writes PNG.", rich_help_panel=LOOK)] = 95,
    backgrounds: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of photographs, or Pascal VOC, for the backgrounds. Default: procedural ones.",
            rich_help_panel=LOOK,
        ),
    ] = None,
    hdri: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="photoreal: folder of environment maps (.exr, .hdr).", rich_help_panel=LOOK),
    ] = None,
    frames: Annotated[int, typer.Option(help="sequence: frames of each video.", rich_help_panel=LOOK)] = 100,
    motion: Annotated[
        Literal["mixed", "still", "slow", "smooth", "fast", "jerky", "hidden", "leaving"],
        typer.Option(help="sequence: how objects and camera move; mixed takes each in turn.", rich_help_panel=LOOK),
    ] = "mixed",
    rbot: Annotated[
        Literal["regular", "light", "noise", "occlusion", "all"] | None,
        typer.Option(
            help="sequence: in the manner of RBOT, one object that moves quickly; all makes the four variants of each "
            "sequence. --images defaults to one of each object.",
            rich_help_panel=LOOK,
        ),
    ] = None,
    views: Annotated[int, typer.Option(help="photoreal: views of each room.", rich_help_panel=LOOK)] = 4,
    samples: Annotated[int, typer.Option(help="photoreal: light paths for each pixel.", rich_help_panel=LOOK)] = 32,
    variant: Annotated[
        str,
        typer.Option(
            help="photoreal: Mitsuba's variant; auto takes the fastest that works here.", rich_help_panel=MACHINE
        ),
    ] = "auto",
    workers: Annotated[int, typer.Option(help="Number of processes on this machine.", rich_help_panel=MACHINE)] = 1,
    ray: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS|local", help="Use a Ray cluster whose machines share the folder.", rich_help_panel=MACHINE
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the data set in --out with the settings it was begun with.")
    ] = False,
) -> None:
    """Make a data set of your meshes: images, depth, masks and poses in BOP layout."""
    from posekit.machines import Machines
    from posekit.synth.plan import SynthConfig
    from posekit.synth.run import begin, run

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
        one_each = len(objects) * (4 if rbot == "all" else 1) * frames
        count = images or (PER_OBJECT * len(objects) if kind == "randomised" else one_each if rbot else DEFAULT)
        config = SynthConfig(
            kind, count, seed, split, parse_size(size), quality, _text(backgrounds), _text(hdri), frames, views,
            samples, variant, motion, rbot or "",
        )  # fmt: skip
        begin(config, out, objects)
    with progress_bar("count", "elapsed", "remaining", stage="making images") as update:
        made = run(out, machines, lambda done, total: update(completed=done, total=total), shards)
    typer.echo(f"{made} images made; data set: {out}")
    typer.echo(f"contact sheet: {out / 'contact_sheet.jpg'}\nstatistics: {out / 'statistics.json'}")


def _text(path: Path | None) -> str:
    return "" if path is None else str(path.resolve())
