"""The HTML report: one file that needs nothing else, no network, no script."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit import metrics
from posekit.datasets.registry import Dataset
from posekit.evaluate import charts, rbot, table
from posekit.evaluate.scoring import MEASURES, Case, Guess, Scored
from posekit.geometry import Pose
from posekit.render import Renderer
from posekit.visualise import draw
from posekit.visualise.figures import outlined
from posekit.zoom import zoom_to_pose

SHOWN = 20  # cases, the best and the worst
_TILE = (240, 180)
TITLES = {
    "2deg_2cm": "(2°, 2\u00a0cm)", "5deg_5cm": "(5°, 5\u00a0cm)", "10deg_10cm": "(10°, 10\u00a0cm)",
    "2deg_2cm_sym": "(2,\u00a02) sym", "5deg_5cm_sym": "(5,\u00a05) sym", "10deg_10cm_sym": "(10,\u00a010) sym",
    "add_01d": "ADD(-S) 0.1d", "add_auc": "ADD(-S) AUC", "adds_auc": "ADD-S AUC", "proj_5px": "Proj 5\u00a0px",
    "vsd_ar": "AR VSD", "mssd_ar": "AR MSSD", "mspd_ar": "AR MSPD", "ar": "AR", "ar_mssd_mspd": "AR MSSD, MSPD",
    "mssd_ap": "AP MSSD", "mspd_ap": "AP MSPD", "ap": "AP",
}  # fmt: skip
_MEANINGS = (
    ("(5°, 5\u00a0cm)", "poses with a rotation error below 5 degrees and a translation error below 5 cm"),
    ("sym", "the same, relative to the nearest of the poses that the object's symmetries make equal"),
    ("ADD(-S) 0.1d", "mean distance of the mesh's vertices below a tenth of the object's diameter; "
     "with symmetries, each to its nearest vertex. AUC: the area under the recall curve up to 10 cm"),
    ("Proj 5\u00a0px", "mean distance of the projected vertices below 5 pixels"),
    ("MSSD, MSPD, VSD", "the errors of the BOP benchmark: largest distance of a vertex in space, in the picture, "
     "and difference of the visible depth. AR: recall, mean over thresholds. AP: average precision"),
    ("training", "seen: the mesh was in the training of the weights; novel: it was not"),
)  # fmt: skip
_STYLE = """
:root{color-scheme:light dark;--ink:#1b1f24;--soft:#5b6570;--line:#d9dee3;--page:#fff;--card:#f6f7f9;
--c0:#2563eb;--c1:#d97706;--c2:#059669;--c3:#9333ea;--c4:#dc2626}
@media(prefers-color-scheme:dark){:root{--ink:#e6e9ec;--soft:#9aa4ae;--line:#343b43;--page:#15181c;--card:#1e2329;
--c0:#6ea8fe;--c1:#f0a94b;--c2:#43c59e;--c3:#c084fc;--c4:#f87171}}
*{box-sizing:border-box}body{margin:0 auto;max-width:1260px;padding:24px 20px 60px;background:var(--page);
color:var(--ink);font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
h1{font-size:25px;margin:0 0 4px}h2{font-size:18px;margin:36px 0 10px}p{margin:4px 0}.soft{color:var(--soft)}
.big{display:flex;flex-wrap:wrap;gap:12px;margin:18px 0}.big div{background:var(--card);border-radius:8px;
padding:10px 16px;min-width:120px}.big b{display:block;font-size:22px;font-variant-numeric:tabular-nums}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:12.5px;font-variant-numeric:tabular-nums}
th,td{padding:4px 5px;text-align:right;border-bottom:1px solid var(--line);white-space:nowrap}
th{font-weight:600;white-space:normal;vertical-align:bottom;
color:var(--soft)}th:first-child,td:first-child{text-align:left}tr.sum td{font-weight:600}
.charts{display:grid;grid-template-columns:repeat(auto-fill,minmax(320px,1fr));gap:14px}
figure{margin:0;background:var(--card);border-radius:8px;padding:10px}figcaption{font-size:13px;font-weight:600}
svg{width:100%;height:auto;display:block}svg.wide{max-width:760px}svg.spark{width:110px;height:24px;display:inline-block;vertical-align:middle}
svg text{font:11px system-ui,sans-serif;fill:var(--soft)}.left,.name{text-anchor:end}.middle{text-anchor:middle}
.grid{stroke:var(--line);stroke-width:1}.line{fill:none;stroke-width:2}.bar{fill:var(--c0)}
.line.c0{stroke:var(--c0)}.line.c1{stroke:var(--c1)}.line.c2{stroke:var(--c2)}.line.c3{stroke:var(--c3)}
.fill.c0{fill:var(--c0)}.fill.c1{fill:var(--c1)}.fill.c2{fill:var(--c2)}.fill.c3{fill:var(--c3)}.fill.c4{fill:var(--c4)}
.cases{display:grid;grid-template-columns:repeat(auto-fill,minmax(340px,1fr));gap:12px}
.cases div{background:var(--card);border-radius:8px;overflow:hidden;font-size:12.5px}
.cases img{width:100%;display:block}.cases p{padding:0 9px}.cases p:last-child{padding-bottom:7px}
details{margin:8px 0;font-size:13px;color:var(--soft)}summary{cursor:pointer}dl{margin:6px 0}dt{font-weight:600}
dd{margin:0 0 4px 14px}
code{font-size:13px;overflow-wrap:anywhere}
"""


def report(results: Mapping[str, Any], scored: Scored, data: Dataset) -> str:
    """The page's text. results: as in results.json."""
    body = "".join(
        [
            _head(results),
            _section("RBOT's protocol", _protocol(results["protocol"])) if "protocol" in results else "",
            _section("Per object", _object_table(results)),
            _section("Recall against threshold", _recall(scored)),
            _section("Errors", _histograms(scored)),
            _section("Objects side by side", _bars(results)),
            _section("Refinement", _traces(scored)) if _traced(scored) else "",
            _cases(scored, data),
            _provenance(results),
        ]
    )
    title = escape(results["title"])
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>posekit eval: {title}</title>'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<style>{_STYLE}</style></head><body>{body}</body></html>\n"
    )


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>"


def _head(results: Mapping[str, Any]) -> str:
    data, counts = results["dataset"], results["counts"]
    split = f", split: {data['split_list']}, hash {data['split_hash']}" if data["split_list"] else ""
    masks = f" {escape(table.TRUE_MASKS)}" if results["true_masks"] else ""
    masks += " Visible masks rendered from the ground truth." if data["masks"].get("rendered") else ""
    shown = [m for m in ("5deg_5cm", "10deg_10cm", "add_01d", "ar", "ar_mssd_mspd") if m in results["mean"]][:4]
    big = "".join(f"<div><b>{results['mean'][m]:.1f}</b>{escape(TITLES[m])}</div>" for m in shown)
    seconds = results["seconds_per_instance"]["median"]
    big += f"<div><b>{seconds:.2f} s</b>median per instance</div>" if seconds is not None else ""
    return (
        f"<h1>{escape(results['title'])}</h1><p class=soft>{counts['instances']} instances "
        f"({escape(data['instances'])}{escape(split)}), {counts['missing']} without an estimate.{masks} "
        f"Means over objects, percent.</p><div class=big>{big}</div>"
    )


def _protocol(protocol: Mapping[str, Any]) -> str:
    variants, lines = rbot.rows(protocol)
    head = "".join(f"<th>{escape(v)}</th>" for v in variants)
    body = "".join(
        f"<tr{' class=sum' if k == len(lines) - 1 else ''}><td>{escape(name)}</td>"
        + "".join(f"<td>{_percent(v)}</td>" for v in values)
        + "</tr>"
        for k, (name, values) in enumerate(lines)
    )
    return (
        f"<p class=soft>{escape(rbot.told(protocol))}</p>"
        f"<div class=scroll><table><tr><th>object</th>{head}</tr>{body}</table></div>"
    )


def _object_table(results: Mapping[str, Any]) -> str:
    columns = [m for m in (*MEASURES, *table.AP_MEASURES) if m in results["mean"]]
    head = "".join(f"<th>{escape(TITLES[m])}</th>" for m in columns)
    rows = []
    for obj_id, entry in results["per_object"].items():
        cells = "".join(f"<td>{_percent(entry.get(m))}</td>" for m in columns)
        rows.append(
            f"<tr><td>{escape(_name(obj_id, entry))}</td><td>{escape(entry.get('novelty', ''))}</td>"
            f"<td>{entry['instances']}</td><td>{entry['missing']}</td>{cells}</tr>"
        )
    counts = results["counts"]
    for name, values in (("mean over objects", results["mean"]), ("over all instances", results["pooled"])):
        cells = "".join(f"<td>{_percent(values.get(m))}</td>" for m in columns)
        numbers = f"<td></td><td>{counts['instances']}</td><td>{counts['missing']}</td>"
        rows.append(f"<tr class=sum><td>{name}</td>{numbers}{cells}</tr>")
    meanings = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in _MEANINGS)
    return (
        f"<div class=scroll><table><tr><th>object</th><th>training</th><th>instances</th><th>missing</th>{head}</tr>"
        f"{''.join(rows)}</table></div><details><summary>What the columns mean</summary><dl>{meanings}</dl></details>"
    )


def _name(obj_id: str, entry: Mapping[str, Any]) -> str:
    """The object's number and its name, where it has one."""
    return entry["name"] if entry["name"] == f"object {obj_id}" else f"{obj_id} {entry['name']}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


_CURVES = (
    ("rotation_deg", "rotation error, degrees", 20.0),
    ("rotation_sym_deg", "rotation error with symmetries, degrees", 20.0),
    ("translation_cm", "translation error, cm", 10.0),
    ("mssd_share", "MSSD, share of the diameter", 0.5),
    ("mspd_px", "MSPD, pixels (picture 640 wide)", 50.0),
    ("add_share", "ADD(-S), share of the diameter", 0.5),
)


def _recall(scored: Scored) -> str:
    parts = []
    for name, label, limit in _CURVES:
        x = np.linspace(0, limit, 101)
        y = 100 * (scored.errors[name][:, None] < x).mean(axis=0)
        parts.append(charts.lines(charts.Axes(label, "instances, %", limit), [(name, x, y)], label.split(",")[0]))
    return f"<div class=charts>{''.join(parts)}</div>"


def _histograms(scored: Scored) -> str:
    parts = []
    for name, label, limit in _CURVES:
        found = scored.errors[name][np.isfinite(scored.errors[name])]
        axes = charts.Axes(label, "estimates, %", limit)
        parts.append(charts.histogram(axes, found, 25, label.split(",")[0]))
    return f"<div class=charts>{''.join(parts)}</div><p class=soft>The last bar holds all larger errors.</p>"


def _bars(results: Mapping[str, Any]) -> str:
    shown = [m for m in ("2deg_2cm", "5deg_5cm", "10deg_10cm", "add_01d", "mssd_ar") if m in results["mean"]]
    entries = list(results["per_object"].items())
    names = [_name(o, e) for o, e in entries]
    groups = [(TITLES[m], [e[m] for _, e in entries]) for m in shown]
    return charts.bars(names, groups, "per object, percent")


# --- refinement -----------------------------------------------------------------------------------------------------


def _traced(scored: Scored) -> bool:
    return any(g is not None and g.about.get("trace") for g in scored.guesses)


def _trace_errors(case: Case, guess: Guess) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Degrees and cm at each step and at the end."""
    steps = np.array([m for m, _ in guess.about.get("trace", [])] + [guess.T_cam_obj.matrix])
    turn, shift = metrics.pose_error(steps, case.T_cam_obj)
    return np.rad2deg(turn), 100 * shift


def _traces(scored: Scored) -> str:
    pairs = [(c, g) for c, g in zip(scored.cases, scored.guesses, strict=True) if g is not None]
    traces = [_trace_errors(c, g) for c, g in pairs]
    longest = min(15, max(len(turn) for turn, _ in traces))
    x = np.arange(longest)
    parts = []
    for k, label in enumerate(("rotation error, degrees", "translation error, cm")):
        held = np.array([np.pad(t[k], (0, max(0, longest - len(t[k]))), mode="edge")[:longest] for t in traces])
        quartiles = np.percentile(held, [75, 50, 25], axis=0)
        top = charts.nice_top(max(float(quartiles.max()), 0.1))
        axes = charts.Axes("step", label, _whole_fifths(longest - 1), top)
        curves = [(name, x, q) for name, q in zip(("3 of 4 below", "median", "1 of 4 below"), quartiles, strict=True)]
        parts.append(charts.lines(axes, curves, f"{label.split(',')[0]} by step"))
    steps = np.array([len(turn) - 1 for turn, _ in traces])
    axes = charts.Axes("steps", "estimates, %", _whole_fifths(steps.max()))
    parts.append(charts.histogram(axes, steps, min(25, int(axes.x_to)), "steps taken"))
    note = "From the first to the final pose, without symmetries; finished ones keep their last error."
    return f"<div class=charts>{''.join(parts)}</div><p class=soft>{note}</p>"


def _whole_fifths(steps: int) -> float:
    """The end of an axis of steps: its five marks are whole numbers."""
    return 5.0 * max(1, -(-int(steps) // 5))


# --- cases ----------------------------------------------------------------------------------------------------------


def _cases(scored: Scored, data: Dataset) -> str:
    order = np.argsort(scored.errors["mssd_share"], kind="stable")
    renderer = Renderer()
    count = min(SHOWN, len(order) // 2)  # nothing is shown twice
    best = [_case(scored, int(k), data, renderer) for k in order[: len(order) - count][:SHOWN]]
    worst = [_case(scored, int(k), data, renderer) for k in order[::-1][:count]]
    note = (
        "<p class=soft>Left, orange: the true pose. Right, green: the estimate. After the object: scene/picture. "
        "d: the object's diameter. The line: rotation error by step.</p>"
    )
    return _section("Best cases", f"{note}<div class=cases>{''.join(best)}</div>") + _section(
        "Worst cases", f"<div class=cases>{''.join(worst)}</div>"
    )


def _case(scored: Scored, k: int, data: Dataset, renderer: Renderer) -> str:
    case, guess = scored.cases[k], scored.guesses[k]
    picture = base64.b64encode(_jpeg(tile(case, guess, data, renderer))).decode()
    errors = {name: float(v[k]) for name, v in scored.errors.items()}
    if guess is None:
        text, trace = "no estimate", ""
    else:
        text = (
            f"{errors['rotation_sym_deg']:.1f}°, {errors['translation_cm']:.1f} cm, MSSD {errors['mssd_share']:.2f} d"
        )
        turns = _trace_errors(case, guess)[0]
        trace = charts.spark(turns.tolist()) if len(turns) > 1 else ""
    alt = escape(f"object {case.obj_id} in scene {case.scene}, image {case.image}")
    seen = f", {100 * case.visible:.0f} % visible" if np.isfinite(case.visible) else ""
    return (
        f'<div><img alt="{alt}" src="data:image/jpeg;base64,{picture}"><p><b>object {case.obj_id}</b> '
        f"{case.scene}/{case.image}{seen}</p><p>{escape(text)} {trace}</p></div>"
    )


def tile(case: Case, guess: Guess | None, data: Dataset, renderer: Renderer) -> draw.Image:
    """The photograph round the object twice, side by side: with the outline of the truth, and of the estimate."""
    view, model = data.view(case.scene, case.image), data.model(case.obj_id)
    zoom = zoom_to_pose(view.camera, case.T_cam_obj @ model.T_obj_ctr, model.hull_ctr, _TILE, enlarge=1.8)
    picture = view.zoomed(zoom).image
    turn = Pose.rotation(zoom.R_view_cam)
    truth = outlined(renderer, picture, zoom.camera, model, turn @ case.T_cam_obj, draw.ORANGE)
    found = picture
    if guess is not None:
        found = outlined(renderer, picture, zoom.camera, model, turn @ guess.T_cam_obj, draw.GREEN)
    return draw.grid([truth, found], columns=2)


def _jpeg(image: draw.Image) -> bytes:
    done, encoded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 82])
    if not done:
        raise ValueError(f"a picture of shape {image.shape} cannot become a JPEG")
    return bytes(encoded)


def _provenance(results: Mapping[str, Any]) -> str:
    weights = results["weights"]
    lines: Sequence[tuple[str, Any]] = (
        ("command", results["command"]),
        ("commit", results["commit"]),
        ("machine", results["machine"]),
        ("weights", f"{weights['preset']} {weights['hash']}, trained on {weights['trained_on']}"),
        ("data", f"{results['dataset']['root']}, {results['dataset']['split']}"),
        ("date", results["date"]),
    )
    shown = [(k, v) for k, v in lines if not (k == "weights" and weights["hash"] is None)]
    return _section("How it was made", "".join(f"<p>{k}: <code>{escape(str(v))}</code></p>" for k, v in shown))
