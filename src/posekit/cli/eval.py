"""``posekit eval``: a data set and an estimator in, a table out."""

from __future__ import annotations

from collections.abc import Mapping
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
    from posekit.evaluate import Comparison

DATA, STAGE = "Data", "Stage"


def evaluate(
    stage: Annotated[
        Literal["refine", "estimate", "track", "score"],
        typer.Option(
            help="From disturbed truth; from detections; through sequences; or only score a CSV.", rich_help_panel=STAGE
        ),
    ] = "estimate",
    dataset: Annotated[
        str | None, typer.Option(metavar="NAME", help="lmo, lm, linemod, ycbv, tless, ...", rich_help_panel=DATA)
    ] = None,
    root: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="The data set, or the folder that holds it.", rich_help_panel=DATA),
    ] = None,
    split: Annotated[str | None, typer.Option(help="Folder with the scenes.", rich_help_panel=DATA)] = None,
    units: Annotated[
        Units, typer.Option(help="Of the meshes; auto: BOP's mm, or what fits models_info.json.", rich_help_panel=DATA)
    ] = "auto",
    objects: Annotated[
        str | None, typer.Option(metavar="1,9|ape,duck", help="Only these objects.", rich_help_panel=DATA)
    ] = None,
    images: Annotated[
        str | None,
        typer.Option(metavar="N|SCENE/IMAGE,...", help="N pictures spread evenly, or these.", rich_help_panel=DATA),
    ] = None,
    min_visible: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE", help="All instances at least as visible; else the test's targets.", rich_help_panel=DATA
        ),
    ] = None,
    detections: Annotated[
        str,
        typer.Option(
            metavar="gt-boxes|gt-masks|detector|FILE.json", help="What estimate starts from.", rich_help_panel=STAGE
        ),
    ] = "gt-masks",
    detector: Annotated[
        str, typer.Option(metavar="novel|FILE", help="With --detections detector: which.", rich_help_panel=STAGE)
    ] = "novel",
    masks: Annotated[
        Literal["true", "none"], typer.Option(help="What refine knows of the silhouette.", rich_help_panel=STAGE)
    ] = "true",
    noise: Annotated[
        str,
        typer.Option(metavar="DEG,X,Y,Z", help="Refine: standard deviations, degrees and cm.", rich_help_panel=STAGE),
    ] = "15,1,1,5",
    csv: Annotated[Path | None, typer.Option(metavar="FILE", help="Score: BOP results.", rich_help_panel=STAGE)] = None,
    vsd: Annotated[
        bool, typer.Option("--vsd/--no-vsd", help="VSD, where there is depth.", rich_help_panel=STAGE)
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
        typer.Option(help="Of the refine stage's disturbances, and of --compare's bootstrap.", rich_help_panel=STAGE),
    ] = 0,
    threads: Annotated[int, typer.Option(min=1, help="Of torch, in each worker.", rich_help_panel=LOOP)] = 1,
    device: DeviceOption = "auto",
    workers: Annotated[int, typer.Option(min=1, help="Processes.", rich_help_panel=LOOP)] = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder for the results; the same run in it is continued.", rich_help_panel=OUTPUT
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Delete an evaluation in that folder.", rich_help_panel=OUTPUT)
    ] = False,
    comparison: Annotated[
        tuple[Path, Path] | None,
        typer.Option("--compare", metavar="A B", help="Two result folders side by side.", rich_help_panel=OUTPUT),
    ] = None,
) -> None:
    """Measure poses as the field does: tables, results.json, a BOP CSV and an HTML report.

    A killed run continues when the same command is given again.
    """
    if comparison is not None:
        from posekit.evaluate import compare

        _print_comparison(compare(*comparison, seed=seed))
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
    with progress_bar("count", "remaining") as update_bar:
        outcome = run(
            options, folder, command=_command(), csv=csv, force=force, with_vsd=vsd,
            progress=lambda done, every: update_bar(completed=done, total=every),
        )  # fmt: skip
    _print_results(outcome.results)
    for path in outcome.files:
        typer.echo(f"{path}")


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


def _print_results(results: Mapping[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    data, counts, weights = results["dataset"], results["counts"], results["weights"]
    shown = [m for m in _SHOWN if m in results["mean"]]
    table = Table(title=f"{data['title']}: {results['stage']}, percent", title_justify="left")
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
    console = Console(width=None if Console().is_terminal else 160)
    console.print(table)
    _say(
        f"instances: {data['instances']}; s: with symmetries; AR is BOP's over all instances, AP its mean over objects"
    )
    if data["masks"].get("rendered"):
        _say(f"visible masks: {data['masks']['rendered']} of {counts['instances']} rendered from the ground truth")
    if data["split_list"]:
        _say(f"split: {data['split_list']}, hash {data['split_hash']}")
    for kind, value in (results.get("detection_ap") or {}).items():
        _say(f"{kind}: {'none' if value is None else f'{value:.1f}'}")
    seconds = results["seconds_per_instance"]
    if seconds["median"] is not None:
        _say(f"{seconds['median']:.2f} s per instance in the median, {seconds['mean']:.2f} in the mean; "
             f"weights {weights['hash']}; commit {results['commit']}; {results['machine']}")  # fmt: skip
    if data["name"] == "linemod":
        _print_paper(results)


def _say(text: str) -> None:
    typer.echo(text)


def _print_paper(results: Mapping[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    from posekit.evaluate.table import PAPER_MEASURES, paper_table

    table = Table(title="as in the paper: LINEMOD, RGB only, percent", title_justify="left")
    table.add_column("method")
    for head in ("(2, 2)", "(5, 5)", "(10, 10)", "ADD(-S) 0.1d"):
        table.add_column(head, justify="right")
    for name, values in paper_table(results):
        table.add_row(name, *("-" if (v := values[m]) is None else f"{v:.1f}" for m in PAPER_MEASURES))
    Console(width=None if Console().is_terminal else 160).print(table)


def _print_comparison(found: Comparison) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{found.instances} instances in both, mean over objects, percent", title_justify="left")
    table.add_column("measure")
    for head in ("A", "B", "B - A", "95 % interval"):
        table.add_column(head, justify="right")
    for d in found.differences:
        mark = " *" if d.clear else ""
        interval = f"{d.low:+.1f} to {d.high:+.1f}{mark}"
        table.add_row(d.measure, f"{d.a:.1f}", f"{d.b:.1f}", f"{d.difference:+.1f}", interval)
    Console(width=None if Console().is_terminal else 120).print(table)
    _say("interval: paired bootstrap over instances within each object; *: it leaves out zero")
    if found.only_a or found.only_b:
        _say(f"left out: {found.only_a} instances only in A, {found.only_b} only in B")
    for note in found.notes:
        _say(f"differs: {note}")
