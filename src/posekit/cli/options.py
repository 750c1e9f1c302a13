"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from posekit.errors import ConfigError

Units = Literal["auto", "mm", "cm", "m", "in"]
Update = Literal["auto", "correspondence", "regression"]
Stop = Literal["angle", "fixed"]
MaskFrom = Literal["none", "grabcut", "filled"]

INPUT, LOOP, OUTPUT = "Input", "Refinement", "Output"
SOURCES, SCHEDULE, MACHINE = "Sources", "Schedule", "Machine"  # of trainings
NOT_RELIABLE = 3  # exit code of --require-reliable

ImageArgument = Annotated[Path, typer.Argument(help="The photograph.", show_default=False)]
ModelOption = Annotated[
    Path, typer.Option("--model", "-m", metavar="MESH", help="PLY, OBJ, GLB or STL.", rich_help_panel=INPUT)
]
ModelsOption = Annotated[
    list[Path],
    typer.Option("--model", "-m", metavar="MESH", help="PLY, OBJ, GLB or STL; repeat it.", rich_help_panel=INPUT),
]
UnitsOption = Annotated[
    Units, typer.Option(help="Of the mesh; auto decides by its diameter and says so.", rich_help_panel=INPUT)
]
SymmetryOption = Annotated[
    str | None,
    typer.Option(
        metavar="TEXT|FILE",
        help="The mesh's symmetries, where no models_info.json lies beside it.",
        rich_help_panel=INPUT,
    ),
]
CameraOption = Annotated[
    str | None,
    typer.Option(
        metavar="fx,fy,cx,cy|FILE",
        help="Intrinsics in pixels, or a BOP or OpenCV file. Else EXIF, else a 60 degree field of view is assumed.",
        rich_help_panel=INPUT,
    ),
]
BoxOption = Annotated[
    str | None,
    typer.Option(metavar="x0,y0,x1,y1", help="Box round the object, pixels.", rich_help_panel=INPUT),
]
MaskOption = Annotated[
    Path | None,
    typer.Option(metavar="PNG", help="The object's mask, of the photograph's size.", rich_help_panel=INPUT),
]
DetectionsOption = Annotated[
    Path | None,
    typer.Option(
        metavar="JSON", help="Detections of another program, as BOP or COCO have them.", rich_help_panel=INPUT
    ),
]
DetectorOption = Annotated[
    str | None,
    typer.Option(
        metavar="novel|coco|FILE",
        help="Detector for an object whose place is not given: novel (the default) needs no training.",
        rich_help_panel=INPUT,
    ),
]
MaskFromOption = Annotated[
    MaskFrom, typer.Option(help="How a box becomes a mask; first poses need none.", rich_help_panel=INPUT)
]

PresetOption = Annotated[str, typer.Option(help="The networks: lite or paper.", rich_help_panel=LOOP)]
WeightsOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Weights in place of the shipped ones.", rich_help_panel=LOOP),
]
InitOption = Annotated[
    Literal["templates", "mvnet"], typer.Option(help="Where first poses come from.", rich_help_panel=LOOP)
]
HypothesesOption = Annotated[int, typer.Option(metavar="K", help="First poses to refine.", rich_help_panel=LOOP)]
UpdateOption = Annotated[
    Update,
    typer.Option(help="What moves the pose; auto: correspondences where the network gives them.", rich_help_panel=LOOP),
]
StopOption = Annotated[
    Stop,
    typer.Option(help="At a predicted angle (the paper), or after a fixed number (DeepIM).", rich_help_panel=LOOP),
]
IterationsOption = Annotated[int, typer.Option(help="At most; with --stop fixed exactly.", rich_help_panel=LOOP)]
StopAngleOption = Annotated[
    float, typer.Option(metavar="DEGREES", help="Predicted angle that ends the loop.", rich_help_panel=LOOP)
]
PerturbOption = Annotated[
    bool,
    typer.Option(
        "--perturb/--no-perturb",
        help="Also try poses turned by 12 degrees from the given one where that does not converge at once.",
        rich_help_panel=LOOP,
    ),
]
MaskEdgeOption = Annotated[
    bool,
    typer.Option(
        "--mask-edge/--no-mask-edge",
        help="Fit the pose to the edge of the given mask, where the mask is exact to the pixel.",
        rich_help_panel=LOOP,
    ),
]
ColourEdgeOption = Annotated[
    bool,
    typer.Option(
        "--colour-edge/--no-colour-edge",
        help="Fit poses to the silhouette's edge as the photograph's colours show it, where no exact mask decides.",
        rich_help_panel=LOOP,
    ),
]
DeviceOption = Annotated[
    Literal["auto", "cpu", "cuda"],
    typer.Option(help="What the networks run on; auto takes a GPU where there is one.", rich_help_panel=LOOP),
]
ThreadsOption = Annotated[
    int | None,
    typer.Option(min=1, help="Threads that the networks use; by default all.", rich_help_panel=LOOP),
]


def use_threads(count: int | None) -> None:
    """Let the networks use so many threads from now on in this process; their own choice where none is given."""
    if count is not None:
        from posekit.nets import precision

        precision.use_threads(count)


FormatOption = Annotated[
    list[str] | None,
    typer.Option(
        "--format",
        metavar="csv|ros|blender|unity|tum|json",
        help="Also write the poses for other programs: objects.csv, ros.yaml, blender.json, unity.json or NAME.tum; "
        "repeat it. json is result.json, which is written anyway.",
        rich_help_panel=OUTPUT,
    ),
]
BlendOption = Annotated[
    float,
    typer.Option(
        min=0, max=1, metavar="SHARE", help="How much of the rendered mesh the overlay shows, 0 to 1.",
        rich_help_panel=OUTPUT,
    ),
]  # fmt: skip
RequireReliableOption = Annotated[
    bool,
    typer.Option(
        "--require-reliable",
        help="End with exit code 3 where a result is not reliable, or nothing is found; results are written all the "
        "same.",
        rich_help_panel=OUTPUT,
    ),
]
OutOption = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder for the results, new or empty. By default in posekit-out, or the next free posekit-out-2, -3.",
        rich_help_panel=OUTPUT,
    ),
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Write into a folder that holds files already.", rich_help_panel=OUTPUT)
]
JsonOption = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|-",
        help="Write the result there, - for standard output; then a folder is written only with --out.",
        rich_help_panel=OUTPUT,
    ),
]

# --- trainings ---

TrainingOutOption = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Folder of the weights, curves and checkpoints.")
]
MeshFoldersOption = Annotated[
    list[Path] | None,
    typer.Option("--meshes", metavar="DIR", help="A folder of meshes.", rich_help_panel=SOURCES),
]
MeshUnitsOption = Annotated[Units | None, typer.Option("--units", help="Of the meshes; auto.", rich_help_panel=SOURCES)]
BackgroundsOption = Annotated[
    Path | None,
    typer.Option("--backgrounds", metavar="DIR", help="Photographs for backgrounds.", rich_help_panel=SOURCES),
]
ConfigFileOption = Annotated[
    Path | None, typer.Option("--config", metavar="TOML", help="Everything else; options override it.")
]
MinutesOption = Annotated[float | None, typer.Option(help="Of wall clock.", rich_help_panel=SCHEDULE)]
StepsOption = Annotated[int | None, typer.Option(help="Optimiser steps.", rich_help_panel=SCHEDULE)]
RateOption = Annotated[float | None, typer.Option(help="Highest learning rate.", rich_help_panel=SCHEDULE)]
TrainingSeedOption = Annotated[
    int | None, typer.Option("--seed", help="The same seed gives the same result.", rich_help_panel=SCHEDULE)
]
DevicesOption = Annotated[int | None, typer.Option(help="Processes on this machine.", rich_help_panel=MACHINE)]
AcceleratorOption = Annotated[
    Literal["auto", "cpu", "cuda"] | None, typer.Option(help="What computes.", rich_help_panel=MACHINE)
]
RenderWorkersOption = Annotated[
    int | None,
    typer.Option("--workers", help="Processes that render, for each that trains.", rich_help_panel=MACHINE),
]
TrainingThreadsOption = Annotated[
    int | None, typer.Option("--threads", help="Threads of torch per process.", rich_help_panel=MACHINE)
]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Go on with the training in --out, as it was begun.")]

# --- sizes ---

_LONGEST_SIDE = 4096


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) in pixels from "640x480". Raises ConfigError."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and 1 <= int(part) <= _LONGEST_SIDE for part in parts):
        raise ConfigError(f"--size {text}: give WIDTHxHEIGHT in pixels, each from 1 to {_LONGEST_SIDE}, as 640x480.")
    return int(parts[0]), int(parts[1])
