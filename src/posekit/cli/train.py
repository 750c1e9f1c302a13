"""``posekit train``: networks from meshes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from posekit.cli.messages import Command, Group, progress_console
from posekit.cli.options import ForceOption, Units
from posekit.io.files import check_writable

if TYPE_CHECKING:
    from posekit.train.config import TrainConfig
    from posekit.train.loop import Show

SOURCES, SCHEDULE, MACHINE = "Sources", "Schedule", "Machine"

train = typer.Typer(cls=Group, no_args_is_help=True, help="Train networks from meshes.")


@train.callback()
def _train() -> None:
    """Train networks from meshes."""


@train.command("pose", cls=Command)
def pose(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for weights, curves and checkpoints.")],
    model: Annotated[
        list[Path] | None,
        typer.Option(
            "--model",
            "-m",
            metavar="MESH",
            help="Mesh to train for; repeat the option for several.",
            rich_help_panel=SOURCES,
        ),
    ] = None,
    meshes: Annotated[
        list[Path] | None, typer.Option(metavar="DIR", help="Folder of meshes to train for.", rich_help_panel=SOURCES)
    ] = None,
    units: Annotated[
        Units | None,
        typer.Option(
            help="Length unit of the meshes' coordinates. Default: auto, by their size.", rich_help_panel=SOURCES
        ),
    ] = None,
    bop: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DIR[:SPLIT][=WEIGHT]",
            help="BOP data set to train on (recipe paper only), with its split and its weight among several.",
            rich_help_panel=SOURCES,
        ),
    ] = None,
    backgrounds: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of photographs for the backgrounds. Default: procedural ones.",
            rich_help_panel=SOURCES,
        ),
    ] = None,
    init: Annotated[
        str | None,
        typer.Option(
            metavar="WEIGHTS|shipped|none",
            help="Weights to start from. Default: the shipped ones if meshes are given and --config is not, else none.",
            rich_help_panel=SOURCES,
        ),
    ] = None,
    flownets: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="FlowNetS checkpoint to start the encoder of recipe paper from.",
            rich_help_panel=SOURCES,
        ),
    ] = None,
    validate_on: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="BOP data set to measure on during training.", rich_help_panel=SOURCES),
    ] = None,
    recipe: Annotated[
        Literal["lite", "paper"] | None,
        typer.Option(help="Network and training: lite (default), or paper (as published)."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="TOML", help="File with all settings; options given here override it.")
    ] = None,
    minutes: Annotated[float | None, typer.Option(help="Stop after so many minutes.", rich_help_panel=SCHEDULE)] = None,
    steps: Annotated[
        int | None, typer.Option(help="Stop after so many optimiser steps.", rich_help_panel=SCHEDULE)
    ] = None,
    batch: Annotated[
        int | None, typer.Option(help="Samples in each process and step.", rich_help_panel=SCHEDULE)
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Highest learning rate.", rich_help_panel=SCHEDULE)] = None,
    mvnet: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Samples of MV-Net (the first-pose network) in each step; 0 does not train it. Default: 0 where the "
            "shipped weights are trained on given meshes, else 8.",
            rich_help_panel=SCHEDULE,
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Random seed; the same one gives the same result.", rich_help_panel=SCHEDULE)
    ] = None,
    overfit: Annotated[
        bool, typer.Option("--overfit", help="Train on a single batch only, as a check.", rich_help_panel=SCHEDULE)
    ] = False,
    devices: Annotated[
        int | None, typer.Option(help="Number of training processes on this machine.", rich_help_panel=MACHINE)
    ] = None,
    num_nodes: Annotated[int | None, typer.Option(help="Number of machines.", rich_help_panel=MACHINE)] = None,
    accelerator: Annotated[
        Literal["auto", "cpu", "cuda"] | None,
        typer.Option(help="Where the training runs; auto: on a GPU where there is one.", rich_help_panel=MACHINE),
    ] = None,
    precision: Annotated[
        Literal["auto", "32-true", "bf16-mixed", "16-mixed"] | None,
        typer.Option(help="Number format of the computation; auto decides by the device.", rich_help_panel=MACHINE),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Rendering processes for each training process.", rich_help_panel=MACHINE)
    ] = None,
    threads: Annotated[
        int | None, typer.Option(help="CPU threads for torch in each process.", rich_help_panel=MACHINE)
    ] = None,
    profile: Annotated[
        bool, typer.Option("--profile", help="Write where the time goes to profile.txt.", rich_help_panel=MACHINE)
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the training in --out with the settings it was begun with.")
    ] = False,
    force: ForceOption = False,
) -> None:
    """Train the pose networks on renderings of your meshes, or of procedural shapes where none are given."""
    from posekit.train.pose import resume_pose, train_pose

    check_writable(out, f"the output folder {out} cannot be written")
    if resume:
        with _bar() as show:
            rows = resume_pose(out, show)
    else:
        objects = [*(model or ()), *(meshes or ())]
        asked = {
            "recipe": recipe, "minutes": minutes, "steps": steps, "seed": seed,
            "overfit": overfit or None, "profile": profile or None,
            "optimiser": {"rate": rate},
            "machine": {"devices": devices, "nodes": num_nodes, "accelerator": accelerator, "precision": precision,
                        "workers": workers, "threads": threads},
            "stream": {"batch": batch, "mvnet": mvnet},
            "sources": {"models": _texts(model), "meshes": _texts(meshes), "bop": bop or None, "init": init,
                        "backgrounds": _text(backgrounds), "flownets": _text(flownets), "units": units,
                        "validate_on": _text(validate_on)},
        }  # fmt: skip
        chosen = _config(config, asked, bool(objects))
        with _bar() as show:
            rows = train_pose(chosen, out, show, force)
    if rows:
        typer.echo(_report(rows))
        typer.echo(f"weights: {out}; use them with: posekit estimate --weights {out}")


@train.command("angle", cls=Command)
def angle(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the new weights.")],
    weights: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Weights to start from, in place of the shipped ones.")
    ] = None,
    preset: Annotated[
        Literal["lite", "paper"], typer.Option(help="Network architecture of the shipped weights.")
    ] = "lite",
    model: Annotated[
        list[Path] | None,
        typer.Option("--model", "-m", metavar="MESH", help="Mesh to render; repeat the option for several."),
    ] = None,
    meshes: Annotated[list[Path] | None, typer.Option(metavar="DIR", help="Folder of meshes to train for.")] = None,
    share: Annotated[
        float,
        typer.Option(
            min=0, max=1, help="Share of the renderings that show the meshes; the rest shows procedural shapes."
        ),
    ] = 1.0,
    units: Annotated[Units, typer.Option(help="Of the meshes.")] = "auto",
    backgrounds: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of photographs for the backgrounds. Default: procedural ones."),
    ] = None,
    cases: Annotated[int, typer.Option(min=1, help="Number of renderings that are refined.")] = 240,
) -> None:
    """Fit the predicted angle alone to what refinement leaves; `train pose` does so at its end."""
    from posekit.train.config import changed, default_config
    from posekit.train.pose import calibrate_angle

    check_writable(out, f"the output folder {out} cannot be written")
    asked = {
        "calibrate": cases, "stream": {"share": share},
        "sources": {"models": _texts(model), "meshes": _texts(meshes), "units": units,
                    "backgrounds": _text(backgrounds)},
    }  # fmt: skip
    chosen = changed(default_config(preset), _given(asked), "the command line")
    with _bar() as show:
        calibrate_angle(chosen, weights, out, show)
    typer.echo(f"weights: {out}; use them with: posekit estimate --weights {out}")


def _config(file: Path | None, asked: dict[str, Any], objects: bool) -> TrainConfig:
    """Defaults of the recipe, then the file, then what options ask for. Training for given objects starts from the
    shipped weights, at a lower rate."""
    from posekit.train.config import changed, default_config, read_config

    config = read_config(file) if file is not None else default_config(asked["recipe"] or "lite")
    if file is None and config.recipe == "lite" and objects and asked["sources"]["init"] is None:
        start = {"sources": {"init": "shipped"}, "optimiser": {"rate": 2e-4, "warmup": 100}, "stream": {"mvnet": 0}}
        config = changed(config, start, "defaults")
    if asked["sources"]["init"] == "none":
        asked["sources"]["init"] = ""
    if asked["minutes"] is not None and asked["steps"] is None:
        asked["steps"] = 10**9  # the clock ends the training
    if asked["steps"] is not None:
        asked["epochs"] = 0
    return changed(config, _given(asked), "the command line")


def _given(values: dict[str, Any]) -> dict[str, Any]:
    """Without what was not asked for."""
    nested = {k: _given(v) if isinstance(v, dict) else v for k, v in values.items()}
    return {k: v for k, v in nested.items() if v is not None}


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _texts(paths: list[Path] | None) -> list[str] | None:
    return [str(p) for p in paths] if paths else None


MEASURES = (("rotation", "rotation_deg", 1, 2, "degrees"), ("translation", "translation_cm", 1, 2, "cm"),
            ("within (5, 5)", "within_5", 100, 0, "%"))  # fmt: skip
FIRST = (("MV-Net's first poses: rotation", "first_rotation_deg", 1, 1, "degrees"),)


def _report(rows: list[dict[str, str]]) -> str:
    """The error before and after, for a person."""
    before, after = rows[0], rows[-1]
    lines = [f"{after['step']} steps in {float(after['seconds']) / 60:.1f} minutes; before -> after:"]
    for prefix, title in (("", "held-back renderings"), ("bop_", "the data set")):
        found = [
            f"{name} {float(before[key]) * scale:.{digits}f} -> {float(after[key]) * scale:.{digits}f} {unit}"
            for name, short, scale, digits, unit in (*MEASURES, *FIRST)
            if (key := prefix + short) in after and key in before
        ]
        if found:
            lines.append(f"{title}: {', '.join(found)}")
    return "\n".join(lines)


@contextmanager
def _bar() -> Iterator[Show]:
    """A progress bar on a terminal; elsewhere nothing."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), TimeRemainingColumn())
    console = progress_console()
    with Progress(*columns, console=console, transient=True, disable=console.quiet) as bar:
        task = bar.add_task("starting", total=1.0)

        def show(progress: Any) -> None:
            loss = progress.values.get("loss", float("nan"))
            told = progress.label or f"step {progress.step}, loss {loss:.3f}"
            bar.update(task, completed=progress.done, description=told)

        yield show


@train.command("detector", cls=Command)
def detector(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for weights, curves and checkpoints.")],
    models: Annotated[
        list[Path] | None,
        typer.Option(
            "--models",
            "--model",
            "-m",
            metavar="MESH",
            help="Mesh to find; repeat the option for several.",
            rich_help_panel=SOURCES,
        ),
    ] = None,
    meshes: Annotated[
        list[Path] | None, typer.Option(metavar="DIR", help="Folder of meshes to train for.", rich_help_panel=SOURCES)
    ] = None,
    agnostic: Annotated[
        bool,
        typer.Option("--agnostic", help="Learn to find objects of any kind, as one class.", rich_help_panel=SOURCES),
    ] = False,
    distractors: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            help="Folder of meshes that are in the scenes but are not to be found.",
            rich_help_panel=SOURCES,
        ),
    ] = None,
    units: Annotated[
        Units | None,
        typer.Option(
            help="Length unit of the meshes' coordinates. Default: auto, by their size.", rich_help_panel=SOURCES
        ),
    ] = None,
    backgrounds: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of photographs for the backgrounds. Default: procedural ones.",
            rich_help_panel=SOURCES,
        ),
    ] = None,
    init: Annotated[
        str | None,
        typer.Option(
            metavar="WEIGHTS|novel",
            help="Detector weights to start from; novel: the shipped ones. Default: ImageNet's backbone alone.",
            rich_help_panel=SOURCES,
        ),
    ] = None,
    backbone: Annotated[
        Literal["lite0", "resnet50"] | None,
        typer.Option(help="Backbone: lite0 (default, light) or resnet50 (the paper's)."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="TOML", help="File with all settings; options given here override it.")
    ] = None,
    minutes: Annotated[float | None, typer.Option(help="Stop after so many minutes.", rich_help_panel=SCHEDULE)] = None,
    epochs: Annotated[
        int | None, typer.Option(help="Stop after so many epochs of 2000 scenes.", rich_help_panel=SCHEDULE)
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help="Stop after so many optimiser steps.", rich_help_panel=SCHEDULE)
    ] = None,
    batch: Annotated[
        int | None, typer.Option(help="Scenes in each process and step.", rich_help_panel=SCHEDULE)
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Highest learning rate.", rich_help_panel=SCHEDULE)] = None,
    seed: Annotated[
        int | None, typer.Option(help="Random seed; the same one gives the same result.", rich_help_panel=SCHEDULE)
    ] = None,
    devices: Annotated[
        int | None, typer.Option(help="Number of training processes on this machine.", rich_help_panel=MACHINE)
    ] = None,
    accelerator: Annotated[
        Literal["auto", "cpu", "cuda"] | None,
        typer.Option(help="Where the training runs; auto: on a GPU where there is one.", rich_help_panel=MACHINE),
    ] = None,
    precision: Annotated[
        Literal["32-true", "bf16-mixed", "16-mixed"] | None,
        typer.Option(help="Number format of the computation; auto decides by the device.", rich_help_panel=MACHINE),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Rendering processes for each training process.", rich_help_panel=MACHINE)
    ] = None,
    threads: Annotated[
        int | None, typer.Option(help="CPU threads for torch in each process.", rich_help_panel=MACHINE)
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the training in --out with the settings it was begun with.")
    ] = False,
    force: ForceOption = False,
) -> None:
    """Train Mask R-CNN on composed scenes: for your meshes, or with --agnostic for objects of any kind."""
    from posekit.detect.maskrcnn import SHIPPED
    from posekit.train.config import changed
    from posekit.train.detector import default_config, read_config, resume_detector, train_detector

    check_writable(out, f"the output folder {out} cannot be written")
    if resume:
        with _bar() as show:
            rows = resume_detector(out, show)
    else:
        chosen = read_config(config) if config is not None else default_config(backbone or "lite0")
        timed = minutes is not None and steps is None and epochs is None
        asked = {
            "agnostic": agnostic or None, "minutes": minutes, "seed": seed,
            "steps": 10**9 if timed else steps, "epochs": 0 if timed or steps is not None else epochs,
            "optimiser": {"rate": rate},
            "machine": {"devices": devices, "accelerator": accelerator, "precision": precision, "workers": workers,
                        "threads": threads},
            "stream": {"batch": batch},
            "network": {"backbone": backbone},
            "sources": {"models": _texts(models), "meshes": _texts(meshes), "distractors": _texts(distractors),
                        "units": units, "backgrounds": _text(backgrounds),
                        "init": str(SHIPPED) if init == "novel" else init},
        }  # fmt: skip
        with _bar() as show:
            rows = train_detector(changed(chosen, _given(asked), "the command line"), out, show, force)
    if rows:
        typer.echo(_detector_report(rows))
        typer.echo(f"weights: {out}; use them with: posekit detect IMAGE --detector {out}")


def _detector_report(rows: list[dict[str, str]]) -> str:
    """Average precision before and after, for a person."""
    before, after = rows[0], rows[-1]
    names = (("box_ap", "box AP"), ("box_ap50", "box AP50"), ("mask_ap", "mask AP"), ("mask_ap50", "mask AP50"))
    found = [f"{name} {100 * float(before[key]):.0f} -> {100 * float(after[key]):.0f}" for key, name in names]
    minutes = float(after["seconds"]) / 60
    return f"{after['step']} steps in {minutes:.1f} minutes; held-back scenes, before -> after: {', '.join(found)}"
