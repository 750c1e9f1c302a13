"""``posekit train``: networks from meshes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from posekit.cli.messages import Command, Group
from posekit.cli.options import (
    MACHINE,
    SCHEDULE,
    SOURCES,
    AcceleratorOption,
    BackgroundsOption,
    ConfigFileOption,
    DevicesOption,
    ForceOption,
    MeshFoldersOption,
    MeshUnitsOption,
    MinutesOption,
    RateOption,
    RenderWorkersOption,
    ResumeOption,
    StepsOption,
    TrainingOutOption,
    TrainingSeedOption,
    TrainingThreadsOption,
)
from posekit.cli.progress import progress_bar
from posekit.io.files import check_writable

if TYPE_CHECKING:
    from posekit.train.config import TrainConfig
    from posekit.train.loop import Show

train = typer.Typer(cls=Group, no_args_is_help=True, help="Train networks from meshes.")


@train.callback()
def _train() -> None:
    """Train networks from meshes."""


@train.command("pose", cls=Command)
def pose(
    out: TrainingOutOption,
    model: Annotated[
        list[Path] | None,
        typer.Option(
            "--model", "-m", metavar="MESH", help="An object to train for; repeat it.", rich_help_panel=SOURCES
        ),
    ] = None,
    meshes: MeshFoldersOption = None,
    units: MeshUnitsOption = None,
    bop: Annotated[
        list[str] | None,
        typer.Option(metavar="DIR[:SPLIT][=WEIGHT]", help="A BOP data set (paper recipe).", rich_help_panel=SOURCES),
    ] = None,
    backgrounds: BackgroundsOption = None,
    init: Annotated[
        str | None,
        typer.Option(
            metavar="WEIGHTS|shipped|none",
            help="Weights to start from; by default the shipped ones for given meshes, without --config.",
            rich_help_panel=SOURCES,
        ),
    ] = None,
    flownets: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="FlowNetS checkpoint for the paper's encoder.", rich_help_panel=SOURCES),
    ] = None,
    validate_on: Annotated[
        Path | None, typer.Option(metavar="DIR", help="A BOP data set to measure on.", rich_help_panel=SOURCES)
    ] = None,
    recipe: Annotated[Literal["lite", "paper"] | None, typer.Option(help="What is trained, and how.")] = None,
    config: ConfigFileOption = None,
    minutes: MinutesOption = None,
    steps: StepsOption = None,
    batch: Annotated[int | None, typer.Option(help="Samples per process and step.", rich_help_panel=SCHEDULE)] = None,
    rate: RateOption = None,
    mvnet: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="MV-Net's samples beside them; by default 8, but 0 where shipped weights learn given meshes, "
            "which leaves the first pose to the template search.",
            rich_help_panel=SCHEDULE,
        ),
    ] = None,
    seed: TrainingSeedOption = None,
    overfit: Annotated[
        bool, typer.Option("--overfit", help="Train on one batch only.", rich_help_panel=SCHEDULE)
    ] = False,
    devices: DevicesOption = None,
    num_nodes: Annotated[int | None, typer.Option(help="Machines.", rich_help_panel=MACHINE)] = None,
    accelerator: AcceleratorOption = None,
    precision: Annotated[
        Literal["auto", "32-true", "bf16-mixed", "16-mixed"] | None,
        typer.Option(help="Of numbers.", rich_help_panel=MACHINE),
    ] = None,
    workers: RenderWorkersOption = None,
    threads: TrainingThreadsOption = None,
    profile: Annotated[bool, typer.Option("--profile", help="Write profile.txt.", rich_help_panel=MACHINE)] = False,
    resume: ResumeOption = False,
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
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the weights.")],
    weights: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Weights to start from, in place of the shipped ones.")
    ] = None,
    preset: Annotated[Literal["lite", "paper"], typer.Option(help="The networks.")] = "lite",
    model: Annotated[
        list[Path] | None,
        typer.Option("--model", "-m", metavar="MESH", help="An object; repeat it.", rich_help_panel=SOURCES),
    ] = None,
    meshes: MeshFoldersOption = None,
    share: Annotated[
        float,
        typer.Option(min=0, max=1, help="Of the meshes; the rest is procedural.", rich_help_panel=SOURCES),
    ] = 1.0,
    units: MeshUnitsOption = None,
    backgrounds: BackgroundsOption = None,
    cases: Annotated[int, typer.Option(min=1, help="Renderings to refine.")] = 240,
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
    """The share of the training that is done, its step and its loss."""
    with progress_bar("text", "elapsed", "remaining", total=1.0, text="starting") as update:

        def show(progress: Any) -> None:
            loss = progress.values.get("loss", float("nan"))
            told = progress.label or f"step {progress.step}, loss {loss:.3f}"
            update(stage=progress.label or "training", completed=progress.done, description=told)

        yield show


@train.command("detector", cls=Command)
def detector(
    out: TrainingOutOption,
    models: Annotated[
        list[Path] | None,
        typer.Option(
            "--models", "--model", "-m", metavar="MESH", help="What to find; repeat it.", rich_help_panel=SOURCES
        ),
    ] = None,
    meshes: MeshFoldersOption = None,
    agnostic: Annotated[
        bool, typer.Option("--agnostic", help="Objects of any kind, as one class.", rich_help_panel=SOURCES)
    ] = False,
    distractors: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            help="A folder of further meshes for the scenes, not to be detected.",
            rich_help_panel=SOURCES,
        ),
    ] = None,
    units: MeshUnitsOption = None,
    backgrounds: BackgroundsOption = None,
    init: Annotated[
        str | None,
        typer.Option(
            metavar="WEIGHTS|novel", help="A detector to start from; else ImageNet's backbone.", rich_help_panel=SOURCES
        ),
    ] = None,
    backbone: Annotated[Literal["lite0", "resnet50"] | None, typer.Option(help="Light, or the paper's.")] = None,
    config: ConfigFileOption = None,
    minutes: MinutesOption = None,
    epochs: Annotated[int | None, typer.Option(help="Of 2000 scenes.", rich_help_panel=SCHEDULE)] = None,
    steps: StepsOption = None,
    batch: Annotated[int | None, typer.Option(help="Scenes per process and step.", rich_help_panel=SCHEDULE)] = None,
    rate: RateOption = None,
    seed: TrainingSeedOption = None,
    devices: DevicesOption = None,
    accelerator: AcceleratorOption = None,
    precision: Annotated[
        Literal["32-true", "bf16-mixed", "16-mixed"] | None, typer.Option(help="Of numbers.", rich_help_panel=MACHINE)
    ] = None,
    workers: RenderWorkersOption = None,
    threads: TrainingThreadsOption = None,
    resume: ResumeOption = False,
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
