"""``posekit eval``: a data set and an estimator in, a table out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from posekit.cli.options import (
    LOOP,
    OUTPUT,
    ColourEdgeOption,
    DeviceOption,
    HypothesesOption,
    InitOption,
    IterationsOption,
    JsonOption,
    MaskEdgeOption,
    PerturbOption,
    PresetOption,
    StopAngleOption,
    StopOption,
    Units,
    UpdateOption,
    WeightsOption,
)
from posekit.cli.progress import progress_bar

if TYPE_CHECKING:
    from rich.table import Table

    from posekit.evaluate import Comparison

DATA, STAGE = "Data", "Stage"


def evaluate(
    stage: Annotated[
        Literal["refine", "estimate", "track", "score"],
        typer.Option(
            help="What is measured: refine (from disturbed true poses), estimate (from detections), track (through "
            "sequences), or score (the poses in --csv).",
            rich_help_panel=STAGE,
        ),
    ] = "estimate",
    dataset: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Name of the data set: lmo, lm, linemod, ycbv, tless, ... Not needed with --root.",
            rich_help_panel=DATA,
        ),
    ] = None,
    root: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the data set, or the one that holds it. Default: as posekit download has it.",
            rich_help_panel=DATA,
        ),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(help="Name of the folder with the scenes, such as test or test_primesense.", rich_help_panel=DATA),
    ] = None,
    units: Annotated[
        Units,
        typer.Option(
            help="Length unit of the meshes; auto: mm as in BOP, or what models_info.json shows.", rich_help_panel=DATA
        ),
    ] = "auto",
    objects: Annotated[
        str | None,
        typer.Option(metavar="1,9|ape,duck", help="Only these objects, by number or name.", rich_help_panel=DATA),
    ] = None,
    images: Annotated[
        str | None,
        typer.Option(
            metavar="N|SCENE/IMAGE,...", help="Only N pictures, spread evenly, or only these.", rich_help_panel=DATA
        ),
    ] = None,
    min_visible: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="Measure all instances of which at least this share (0 to 1) is visible. Default: the test's targets.",
            rich_help_panel=DATA,
        ),
    ] = None,
    detections: Annotated[
        str,
        typer.Option(
            metavar="gt-boxes|gt-masks|detector|FILE.json",
            help="What estimate starts from: true boxes, true masks, the detector, or a file in BOP's format.",
            rich_help_panel=STAGE,
        ),
    ] = "gt-boxes",
    detector: Annotated[
        str,
        typer.Option(metavar="novel|FILE", help="With --detections detector: which detector.", rich_help_panel=STAGE),
    ] = "novel",
    masks: Annotated[
        Literal["true", "none"],
        typer.Option(help="Whether refine is given the true mask (drawn from the annotation).", rich_help_panel=STAGE),
    ] = "none",
    noise: Annotated[
        str,
        typer.Option(
            metavar="DEG,X,Y,Z",
            help="refine: standard deviations of the disturbance, in degrees and cm.",
            rich_help_panel=STAGE,
        ),
    ] = "15,1,1,5",
    protocol: Annotated[
        Literal["redetect", "rbot"],
        typer.Option(
            help="track: redetect (a lost object is found again in its true mask) or rbot (RBOT's: reset to the true "
            "pose after each frame that is 5 degrees or 5 cm off, nothing else told).",
            rich_help_panel=STAGE,
        ),
    ] = "redetect",
    resets: Annotated[
        bool,
        typer.Option(
            "--resets/--no-resets", help="track, protocol rbot: whether wrong poses are reset.", rich_help_panel=STAGE
        ),
    ] = True,
    csv: Annotated[
        Path | None, typer.Option(metavar="FILE", help="score: a file of poses in BOP's format.", rich_help_panel=STAGE)
    ] = None,
    vsd: Annotated[
        bool,
        typer.Option("--vsd/--no-vsd", help="Compute BOP's VSD, where the data set has depth.", rich_help_panel=STAGE),
    ] = True,
    preset: PresetOption = "lite",
    weights: WeightsOption = None,
    init: InitOption = "templates",
    hypotheses: HypothesesOption = 5,
    update: UpdateOption = "auto",
    stop: StopOption = "angle",
    iterations: IterationsOption = 50,
    stop_angle: StopAngleOption = 2.0,
    perturb: PerturbOption = True,
    mask_edge: MaskEdgeOption = True,
    colour_edge: ColourEdgeOption = True,
    seed: Annotated[
        int,
        typer.Option(help="Random seed of refine's disturbances and of --compare.", rich_help_panel=STAGE),
    ] = 0,
    threads: Annotated[
        int, typer.Option(min=1, help="CPU threads for torch in each process.", rich_help_panel=LOOP)
    ] = 1,
    device: DeviceOption = "auto",
    workers: Annotated[int, typer.Option(min=1, help="Number of processes.", rich_help_panel=LOOP)] = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the results; an interrupted run of the same command is continued.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="Start anew where --out holds another evaluation, which is deleted.", rich_help_panel=OUTPUT
        ),
    ] = False,
    comparison: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            "--compare",
            metavar="A B",
            help="Compare two result folders, with confidence intervals; nothing is measured.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Measure poses as the field does: tables, results.json, a BOP CSV and an HTML report.

    A killed run continues when the same command is given again.
    """
    from posekit.cli.output import check_json, write_json

    check_json(json)
    apart = json == "-"  # standard output is for JSON alone
    if comparison is not None:
        from posekit.evaluate import compare

        found = compare(*comparison, seed=seed)
        _print_comparison(found, apart)
        write_json(json, dumps(asdict(found), indent=1) + "\n")
        return
    from posekit.estimate.estimator import EstimateOptions
    from posekit.evaluate import EvalOptions
    from posekit.evaluate import evaluate as run

    limit, chosen = _images(images)
    options = EvalOptions(
        stage=stage,
        dataset=dataset,
        root=root,
        split=split,
        units=units,
        objects=_objects(objects, dataset, root, split),
        images=chosen,
        limit=limit,
        min_visible=min_visible,
        detections=detections,
        detector=detector,
        masks=masks,
        noise=_noise(noise),
        seed=seed,
        protocol=protocol,
        resets=resets,
        preset=preset,
        weights=weights,
        estimate=EstimateOptions(
            init, hypotheses, update, stop, iterations, stop_angle, perturb, mask_edge, colour_edge
        ),
        threads=threads,
        device=device,
        workers=workers,
    )
    name = dataset or (root.resolve().name if root is not None else "data")
    folder = out or Path("posekit-out") / f"eval-{name}-{stage}"
    with progress_bar("count", "remaining", stage="evaluating") as update_bar:
        outcome = run(
            options, folder, command=_command(), csv=csv, force=force, with_vsd=vsd,
            progress=lambda done, every: update_bar(completed=done, total=every),
        )  # fmt: skip
    _print_results(outcome.results, apart)
    for path in outcome.files:
        typer.echo(f"{path}", err=apart)
    write_json(json, dumps(outcome.results, indent=1, allow_nan=False) + "\n")


def _command() -> str:
    import shlex
    import sys

    return shlex.join(["posekit", *sys.argv[1:]])


def _objects(text: str | None, dataset: str | None, root: Path | None, split: str | None) -> tuple[int, ...]:
    """Numbers, or names as the data set has them."""
    if not text:
        return ()
    parts = [part.strip() for part in text.split(",")]
    if all(part.isdigit() for part in parts):
        return tuple(int(part) for part in parts)
    from posekit.datasets.registry import open_dataset

    _, info = open_dataset(dataset, root, split)
    return tuple(int(part) if part.isdigit() else info.number(part) for part in parts)


def _images(text: str | None) -> tuple[int | None, tuple[tuple[int, int], ...]]:
    """A limit, or (scene, image) pairs."""
    import re

    from posekit.errors import ConfigError

    if text is None:
        return None, ()
    if text.isdigit():
        return int(text), ()
    if not re.fullmatch(r"\d+/\d+(,\d+/\d+)*", text):
        raise ConfigError(f"--images {text}: give a number, or SCENE/IMAGE pairs such as 2/3,2/17.")
    return None, tuple((int(a), int(b)) for a, b in re.findall(r"(\d+)/(\d+)", text))


def _noise(text: str) -> tuple[float, float, float, float]:
    from posekit.errors import ConfigError

    try:
        degrees, x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"--noise {text}: give four numbers, degrees and x, y, z in cm, such as 15,1,1,5.") from error
    return degrees, x, y, z


_SHOWN = ("2deg_2cm", "5deg_5cm", "10deg_10cm", "5deg_5cm_sym", "10deg_10cm_sym", "add_01d", "adds_auc", "proj_5px",
          "vsd_ar", "mssd_ar", "mspd_ar", "ar", "ap")  # fmt: skip
_HEADS = {"2deg_2cm": "(2,2)", "5deg_5cm": "(5,5)", "10deg_10cm": "(10,10)", "5deg_5cm_sym": "(5,5)s",
          "10deg_10cm_sym": "(10,10)s", "add_01d": "ADD.1d", "adds_auc": "ADDS-AUC", "proj_5px": "2D-5px",
          "vsd_ar": "VSD", "mssd_ar": "MSSD", "mspd_ar": "MSPD", "ar": "AR", "ap": "AP"}  # fmt: skip


def _print_results(results: Mapping[str, Any], apart: bool) -> None:
    """apart: on standard error."""
    from rich.table import Table

    from posekit.evaluate.table import TRUE_MASKS

    say = partial(typer.echo, err=apart)
    data, counts, weights = results["dataset"], results["counts"], results["weights"]
    shown = [m for m in _SHOWN if m in results["mean"]]
    table = Table(title=f"{results['title']}, percent", title_justify="left")
    table.add_column("object")
    for head in ("training", "n", "missing", *(_HEADS[m] for m in shown)):
        table.add_column(head, justify="right")
    for obj_id, entry in results["per_object"].items():
        cells = [f"{entry[m]:.1f}" if m in entry else "" for m in shown]
        numbers = (str(entry["instances"]), str(entry["missing"]))
        table.add_row(f"{obj_id} {entry['name']}", entry["novelty"], *numbers, *cells)
    table.add_section()
    for name, values in (("mean over objects", results["mean"]), ("over all instances", results["pooled"])):
        cells = [f"{values[m]:.1f}" if m in values else "" for m in shown]
        table.add_row(name, "", str(counts["instances"]), str(counts["missing"]), *cells)
    _show(table, apart)
    say(f"instances: {data['instances']}; s: with symmetries; AR is BOP's over all instances, AP its mean over objects")
    if results["true_masks"]:
        say(TRUE_MASKS)
    if data["masks"].get("rendered"):
        say(f"visible masks: {data['masks']['rendered']} of {counts['instances']} rendered from the ground truth")
    if data["split_list"]:
        say(f"split: {data['split_list']}, hash {data['split_hash']}")
    for kind, value in (results.get("detection_ap") or {}).items():
        say(f"{kind}: {'none' if value is None else f'{value:.1f}'}")
    seconds = results["seconds_per_instance"]
    if seconds["median"] is not None:
        say(f"{seconds['median']:.2f} s per instance in the median, {seconds['mean']:.2f} in the mean; "
             f"weights {weights['hash']}; commit {results['commit']}; {results['machine']}")  # fmt: skip
    if "protocol" in results:
        _print_protocol(results["protocol"], apart)
    if data["name"] == "linemod":
        _print_paper(results, apart)


def _show(table: Table, apart: bool, width: int = 160) -> None:
    """width: where the output is no terminal, characters."""
    from rich.console import Console

    console = Console(stderr=apart)
    if not console.is_terminal:
        console = Console(stderr=apart, width=width)
    console.print(table)


def _print_protocol(protocol: Mapping[str, Any], apart: bool) -> None:
    from rich.table import Table

    from posekit.evaluate.rbot import rows, told

    variants, lines = rows(protocol)
    table = Table(title="RBOT's protocol", title_justify="left")
    table.add_column("object")
    for variant in variants:
        table.add_column(variant, justify="right")
    for name, values in lines:
        table.add_row(name, *("-" if v is None else f"{v:.1f}" for v in values), end_section=name == lines[-2][0])
    _show(table, apart)
    typer.echo(told(protocol), err=apart)


def _print_paper(results: Mapping[str, Any], apart: bool) -> None:
    from rich.table import Table

    from posekit.evaluate.table import PAPER_MEASURES, paper_table

    table = Table(title="as in the paper: LINEMOD, RGB only, percent", title_justify="left")
    table.add_column("method")
    for head in ("(2, 2)", "(5, 5)", "(10, 10)", "ADD(-S) 0.1d"):
        table.add_column(head, justify="right")
    for name, values in paper_table(results):
        table.add_row(name, *("-" if (v := values[m]) is None else f"{v:.1f}" for m in PAPER_MEASURES))
    _show(table, apart)


def _print_comparison(found: Comparison, apart: bool) -> None:
    from rich.table import Table

    say = partial(typer.echo, err=apart)
    table = Table(title=f"{found.instances} instances in both, mean over objects, percent", title_justify="left")
    table.add_column("measure")
    for head in ("A", "B", "B - A", "95 % interval"):
        table.add_column(head, justify="right")
    for d in found.differences:
        mark = " *" if d.clear else ""
        interval = f"{d.low:+.1f} to {d.high:+.1f}{mark}"
        table.add_row(d.measure, f"{d.a:.1f}", f"{d.b:.1f}", f"{d.difference:+.1f}", interval)
    _show(table, apart, 120)
    say("interval: paired bootstrap over instances within each object; *: it leaves out zero")
    if found.only_a or found.only_b:
        say(f"left out: {found.only_a} instances only in A, {found.only_b} only in B")
    for note in found.notes:
        say(f"differs: {note}")
