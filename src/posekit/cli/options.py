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

ImagesArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="IMAGE",
        help="The photograph, or several: files, a folder of pictures or a glob.",
        show_default=False,
    ),
]
ModelOption = Annotated[
    Path,
    typer.Option(
        "--model", "-m", metavar="MESH", help="The object's mesh: PLY, OBJ, GLB or STL.", rich_help_panel=INPUT
    ),
]
ModelsOption = Annotated[
    list[Path],
    typer.Option(
        "--model",
        "-m",
        metavar="MESH",
        help="The object's mesh: PLY, OBJ, GLB or STL. Repeat the option for several objects.",
        rich_help_panel=INPUT,
    ),
]
UnitsOption = Annotated[
    Units,
    typer.Option(
        help="Length unit of the mesh's coordinates; auto decides by the mesh's size and prints its choice.",
        rich_help_panel=INPUT,
    ),
]
SymmetryOption = Annotated[
    str | None,
    typer.Option(
        metavar="z:2|z:inf|...|detect|none|FILE",
        help="The turns after which the object looks the same: z:2 is half a turn about the mesh's z axis, z:inf any "
        "turn; several with commas. detect looks for them; FILE is a models_info.json as BOP has it, which is also "
        "read where it lies beside the mesh.",
        rich_help_panel=INPUT,
    ),
]
CameraOption = Annotated[
    str | None,
    typer.Option(
        metavar="fx,fy,cx,cy|FILE",
        help="Intrinsics in pixels, or a calibration file (OpenCV, ROS, BOP; lens distortion is removed). Default: "
        "the focal length in EXIF, else a field of view of 60 degrees.",
        rich_help_panel=INPUT,
    ),
]
BoxOption = Annotated[
    str | None,
    typer.Option(
        metavar="x0,y0,x1,y1",
        help="Bounding box of the object in the photograph: left, top, right, bottom, pixels.",
        rich_help_panel=INPUT,
    ),
]
MaskOption = Annotated[
    Path | None,
    typer.Option(
        metavar="PNG",
        help="Mask of the object: white where it is seen, of the photograph's size.",
        rich_help_panel=INPUT,
    ),
]
DetectionsOption = Annotated[
    Path | None,
    typer.Option(
        metavar="JSON", help="Boxes or masks from another program, in COCO's or BOP's format.", rich_help_panel=INPUT
    ),
]
DetectorOption = Annotated[
    str | None,
    typer.Option(
        metavar="novel|coco|FILE",
        help="Detector that finds the object: novel (default; any mesh, no training), coco (COCO's classes), or a "
        "file of posekit train detector.",
        rich_help_panel=INPUT,
    ),
]
MaskFromOption = Annotated[
    MaskFrom,
    typer.Option(
        help="Mask made from --box: none, grabcut (segmented by colour), or filled (the whole box).",
        rich_help_panel=INPUT,
    ),
]

PresetOption = Annotated[
    str,
    typer.Option(
        help="Network architecture: lite, or paper (as published, which needs --weights).", rich_help_panel=LOOP
    ),
]
WeightsOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Network weights to use in place of the shipped ones: a file or folder of posekit train pose.",
        rich_help_panel=LOOP,
    ),
]
InitOption = Annotated[
    Literal["templates", "mvnet"],
    typer.Option(
        help="Where first poses come from: templates (renderings compared with the photograph) or mvnet (a network).",
        rich_help_panel=LOOP,
    ),
]
HypothesesOption = Annotated[
    int,
    typer.Option(
        metavar="K", help="Number of first poses that are refined; the best one is the result.", rich_help_panel=LOOP
    ),
]
UpdateOption = Annotated[
    Update,
    typer.Option(
        help="How the network's output moves the pose: by 2D-2D correspondences and PnP, or by its regressed pose "
        "change. auto: correspondences where the network has them.",
        rich_help_panel=LOOP,
    ),
]
StopOption = Annotated[
    Stop,
    typer.Option(
        help="When refinement ends: angle, once the predicted rotation error is below --stop-angle; fixed, after "
        "--iterations.",
        rich_help_panel=LOOP,
    ),
]
IterationsOption = Annotated[
    int,
    typer.Option(
        help="Largest number of refinement iterations; with --stop fixed the exact number.", rich_help_panel=LOOP
    ),
]
StopAngleOption = Annotated[
    float,
    typer.Option(metavar="DEGREES", help="Predicted rotation error below which refinement ends.", rich_help_panel=LOOP),
]
PerturbOption = Annotated[
    bool,
    typer.Option(
        "--perturb/--no-perturb",
        help="Where the given pose does not converge within a few iterations, also start from four poses turned by "
        "12 degrees.",
        rich_help_panel=LOOP,
    ),
]
MaskEdgeOption = Annotated[
    bool,
    typer.Option(
        "--mask-edge/--no-mask-edge",
        help="At the end, fit the silhouette to the edge of the mask, where that mask proves exact to the pixel.",
        rich_help_panel=LOOP,
    ),
]
ColourEdgeOption = Annotated[
    bool,
    typer.Option(
        "--colour-edge/--no-colour-edge",
        help="Also fit the silhouette to the edge between the object's colours and the background's.",
        rich_help_panel=LOOP,
    ),
]
DeviceOption = Annotated[
    Literal["auto", "cpu", "cuda"],
    typer.Option(help="Where the networks run; auto: on a GPU where there is one.", rich_help_panel=LOOP),
]
ThreadsOption = Annotated[
    int | None, typer.Option(min=1, help="CPU threads for the networks; by default all.", rich_help_panel=LOOP)
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
        help="Also write the poses for other programs: objects.csv, ros.yaml, blender.json, unity.json or MESH.tum. "
        "Repeat the option for several. json is posekit's own, which is written in any case.",
        rich_help_panel=OUTPUT,
    ),
]
BlendOption = Annotated[
    float,
    typer.Option(
        min=0, max=1, metavar="SHARE",
        help="Opacity of the rendered mesh in the overlay: 0 (contour and axes only) to 1.",
        rich_help_panel=OUTPUT,
    ),
]  # fmt: skip
RequireReliableOption = Annotated[
    bool,
    typer.Option(
        "--require-reliable",
        help="Exit with code 3 if a result is not reliable or nothing is found. Results are written in any case.",
        rich_help_panel=OUTPUT,
    ),
]
OverlayOption = Annotated[
    bool,
    typer.Option(
        "--overlay/--no-overlay",
        help="Draw what was found into the photograph: overlay.png.",
        rich_help_panel=OUTPUT,
    ),
]
RerunOption = Annotated[
    bool,
    typer.Option(
        "--rerun",
        help="Also write a recording (.rrd) for the Rerun viewer: photograph, camera and meshes at their poses in 3D.",
        rich_help_panel=OUTPUT,
    ),
]
OutOption = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder for the results, new or empty; of several pictures also one to go on with. Default: a folder in "
        "posekit-out, or in posekit-out-2 and so on where that holds results; none if --json is given.",
        rich_help_panel=OUTPUT,
    ),
]
ForceOption = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Write into --out even if it holds files; files of the same names are replaced.",
        rich_help_panel=OUTPUT,
    ),
]
JsonOption = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|-",
        help="Write the result as JSON to FILE. With - it goes to standard output, and everything else to standard "
        "error.",
        rich_help_panel=OUTPUT,
    ),
]

WorkersOption = Annotated[
    int,
    typer.Option(
        min=1, metavar="N", help="Number of processes that share the pictures, where there are several.",
        rich_help_panel=MACHINE,
    ),
]  # fmt: skip
RayOption = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS|local",
        help="Share the pictures over a Ray cluster whose machines see the same files; local: one on this machine, "
        "with --workers processes.",
        rich_help_panel=MACHINE,
    ),
]

# --- trainings ---

TrainingOutOption = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Folder of the weights, curves and checkpoints.")
]
MeshFoldersOption = Annotated[
    list[Path] | None,
    typer.Option("--meshes", metavar="DIR", help="Folder of meshes to train for.", rich_help_panel=SOURCES),
]
MeshUnitsOption = Annotated[
    Units | None,
    typer.Option(
        "--units", help="Length unit of the meshes' coordinates. Default: auto, by their size.", rich_help_panel=SOURCES
    ),
]
BackgroundsOption = Annotated[
    Path | None,
    typer.Option(
        "--backgrounds",
        metavar="DIR",
        help="Folder of photographs for the backgrounds. Default: procedural ones.",
        rich_help_panel=SOURCES,
    ),
]
ConfigFileOption = Annotated[
    Path | None,
    typer.Option("--config", metavar="TOML", help="File with all settings; options given here override it."),
]
MinutesOption = Annotated[
    float | None,
    typer.Option(help="End within so many minutes, the last validation and export included.", rich_help_panel=SCHEDULE),
]
StepsOption = Annotated[int | None, typer.Option(help="Stop after so many optimiser steps.", rich_help_panel=SCHEDULE)]
RateOption = Annotated[float | None, typer.Option(help="Highest learning rate.", rich_help_panel=SCHEDULE)]
TrainingSeedOption = Annotated[
    int | None,
    typer.Option("--seed", help="Random seed; the same one gives the same result.", rich_help_panel=SCHEDULE),
]
DevicesOption = Annotated[
    int | None, typer.Option(help="Number of training processes on this machine.", rich_help_panel=MACHINE)
]
AcceleratorOption = Annotated[
    Literal["auto", "cpu", "cuda"] | None,
    typer.Option(help="Where the training runs; auto: on a GPU where there is one.", rich_help_panel=MACHINE),
]
RenderWorkersOption = Annotated[
    int | None,
    typer.Option("--workers", help="Rendering processes for each training process.", rich_help_panel=MACHINE),
]
TrainingThreadsOption = Annotated[
    int | None, typer.Option("--threads", help="CPU threads for torch in each process.", rich_help_panel=MACHINE)
]
ResumeOption = Annotated[
    bool,
    typer.Option("--resume", help="Continue the training in --out with the settings it was begun with."),
]

# --- sizes ---

_LONGEST_SIDE = 4096


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) in pixels from "640x480". Raises ConfigError."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and 1 <= int(part) <= _LONGEST_SIDE for part in parts):
        raise ConfigError(f"--size {text}: give WIDTHxHEIGHT in pixels, each from 1 to {_LONGEST_SIDE}, as 640x480.")
    return int(parts[0]), int(parts[1])
