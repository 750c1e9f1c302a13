"""``posekit doctor``: what is here, and what to do about what is not."""

from __future__ import annotations

import platform
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from json import dumps
from typing import Any

import typer

from posekit._version import __version__
from posekit.cli.options import JsonOption
from posekit.errors import RenderError, WeightsError


@dataclass(frozen=True)
class Finding:
    """One line of the report. state: ok, note (works, but could be better) or problem. todo: what to do about it."""

    topic: str
    text: str
    state: str = "ok"
    todo: str = ""


CPU_INDEX = "https://download.pytorch.org/whl/cpu"  # PyTorch's own, of builds without CUDA
_STYLES = {"ok": "green", "note": "yellow", "problem": "bold red"}


def doctor(json: JsonOption = None) -> None:
    """Check OpenGL, torch, OpenVINO and the weights; exit code 1 where something essential is missing."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from posekit.cli.output import check_json, write_json

    check_json(json)
    findings = examine()
    table = Table.grid(padding=(0, 2))
    for finding in findings:
        text = Text(finding.text)
        if finding.todo:
            text.append(f"\n-> {finding.todo}", style="bold")
        table.add_row(Text(finding.state, style=_STYLES[finding.state]), finding.topic, text)
    console = Console(stderr=json == "-")
    console.print(table)
    problems = sum(finding.state == "problem" for finding in findings)
    entries = [asdict(finding) for finding in findings]
    write_json(json, dumps({"posekit": __version__, "problems": problems, "findings": entries}, indent=1) + "\n")
    if problems:
        console.print(
            f"{problems} problem{'s' if problems > 1 else ''}: posekit cannot work here yet.", style="bold red"
        )
        raise typer.Exit(1)


def examine() -> list[Finding]:
    """All findings, in the report's order."""
    system = f"posekit {__version__}, Python {platform.python_version()}, {platform.platform()}"
    checks: list[Callable[[], list[Finding]]] = [_opengl, _torch, _openvino, _weights]
    return [Finding("system", system), *(finding for check in checks for finding in check())]


def _opengl() -> list[Finding]:
    from posekit import render

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            info = render.info()
        except RenderError as error:
            return [Finding("OpenGL", str(error), "problem", "Install what the line above names.")]
    text = f"{info['renderer']} ({info['vendor']}), OpenGL {info['version']}, through {info['backend']}"
    found = [Finding("OpenGL", text)]
    found += [Finding("OpenGL", str(warning.message), "note") for warning in caught]
    return found


def _torch() -> list[Finding]:
    try:
        import torch
    except (ImportError, OSError) as error:
        return [Finding("torch", f"cannot be imported: {error}", "problem", _reinstall("torch torchvision"))]
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    text = f"{torch.__version__}, {torch.get_num_threads()} threads, {device}"
    if torch.version.cuda is None or torch.cuda.is_available():
        return [Finding("torch", text)]
    todo = f"In a new environment: pip install torch torchvision --index-url {CPU_INDEX}, then posekit."
    return [Finding("torch", f"{text}; a build for NVIDIA GPUs, none is usable here: 4 GB too much", "note", todo)]


def _openvino() -> list[Finding]:
    from posekit.nets.telemetry import without_telemetry

    try:
        with without_telemetry():
            import openvino
    except (ImportError, OSError) as error:
        return [Finding("OpenVINO", f"cannot be imported: {error}", "problem", _reinstall("openvino"))]
    return [Finding("OpenVINO", str(openvino.__version__).partition("-")[0])]


def _weights() -> list[Finding]:
    try:
        from posekit.nets.config import PRESETS, find_weights
        from posekit.nets.weights import load_networks
    except (ImportError, OSError):
        return []  # torch's own finding says why
    found = []
    for preset in PRESETS:
        topic = f"weights {preset}"
        try:
            path, networks = find_weights(preset), load_networks(preset)
        except WeightsError as error:
            essential = preset == PRESETS[0]
            todo = _reinstall("posekit") if essential else ""
            found.append(Finding(topic, str(error), "problem" if essential else "note", todo))
            continue
        found.append(Finding(topic, f"{path}\nhash {networks.digest}\n{_line(networks.about)}".strip()))
    return found


def _line(about: Mapping[str, Any]) -> str:
    """What the weights' TOML says of their training and figures, in one line."""
    parts = []
    for key, value in about.items():
        if isinstance(value, list):
            parts.append(f"{key.replace('_', ' ')} {len(value)}")
            continue
        text = (
            f"({_line(value)})" if isinstance(value, Mapping) else f"{value:.4g}" if isinstance(value, float) else value
        )
        parts.append(f"{key.replace('_', ' ')} {text}")
    return ", ".join(parts)


def _reinstall(packages: str) -> str:
    return f"{sys.executable} -m pip install --force-reinstall {packages}"
