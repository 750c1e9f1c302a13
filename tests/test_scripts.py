"""The scripts: sound bash, and what does not need a network of what they promise."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from posekit.mesh.model import ObjectModel

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = [ROOT / "scripts" / name for name in ("setup", "demo", "test", "check", "pictures", "docs", "meshes")] + [
    ROOT / ".ci" / "run"
]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_script_is_sound_bash(script: Path) -> None:
    text = script.read_text()
    assert text.startswith("#!/usr/bin/env bash\n")
    assert "set -euo pipefail" in text
    assert os.access(script, os.X_OK), f"{script.name} must be executable"
    subprocess.run(["bash", "-n", str(script)], check=True)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of what setup reads, in a folder with a space in its name."""
    root = tmp_path / "a clone"
    (root / "scripts").mkdir(parents=True)
    for name in ("pyproject.toml", "scripts/setup", "scripts/constraints.txt"):
        shutil.copy(ROOT / name, root / name)
    return root


def run(tree: Path, path: Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PATH": f"{path}:/usr/bin:/bin"}
    return subprocess.run(
        [str(tree / "scripts/setup")], env=env, cwd=cwd, capture_output=True, text=True, timeout=120, check=False
    )


def fake_venv(tree: Path, pip: str, index: str = "exit 1") -> None:
    """A .venv whose python runs everything but pip's install and index, in whose places ``pip`` and ``index`` (bash)
    run."""
    python = tree / ".venv/bin/python"
    python.parent.mkdir(parents=True)
    python.write_text(
        f'#!/usr/bin/env bash\ncase "$*" in *"pip install"*) {pip} ;; *"pip index"*) {index} ;;\n'
        f'*) exec {sys.executable} "$@" ;; esac\n'
    )
    python.chmod(0o755)


@pytest.mark.skipif(sys.platform != "linux", reason="the scripts install system libraries on Linux")
def test_setup_installs_once(tree: Path, tmp_path: Path) -> None:
    fake_venv(tree, f'echo "$*" >> "{tmp_path}/calls"; echo Collecting everything')
    first = run(tree, tmp_path, tmp_path)
    assert first.returncode == 0, first.stderr
    assert "log: .venv/setup.log" in first.stderr
    assert "Collecting everything" not in first.stdout + first.stderr
    assert "Collecting everything" in (tree / ".venv/setup.log").read_text()
    second = run(tree, tmp_path, tmp_path)
    assert (second.returncode, second.stdout, second.stderr) == (0, "", "")
    calls = (tmp_path / "calls").read_text()
    assert calls.count("\n") == 1
    assert "-c scripts/constraints.txt" in calls
    with (tree / "scripts/constraints.txt").open("a") as file:
        file.write("# changed\n")
    assert run(tree, tmp_path, tmp_path).returncode == 0
    assert (tmp_path / "calls").read_text().count("\n") == 2


NO_GPU = platform.machine() == "x86_64" and not Path("/proc/driver/nvidia").exists() and not shutil.which("nvidia-smi")


@pytest.mark.skipif(sys.platform != "linux" or not NO_GPU, reason="elsewhere the usual build of torch is right")
@pytest.mark.parametrize(("offered", "apart"), [("2.13.0+cpu, 2.12.1+cpu", True), ("2.13.0", False)])
def test_setup_takes_torch_without_cuda_where_it_is_offered(
    tree: Path, tmp_path: Path, offered: str, apart: bool
) -> None:
    fake_venv(tree, f'echo "$*" >> "{tmp_path}/calls"', f'echo "Available versions: {offered}"')
    assert run(tree, tmp_path, tmp_path).returncode == 0
    *torch, everything = (tmp_path / "calls").read_text().splitlines()
    assert len(torch) == apart and all("torch torchvision --index-url https://" in call for call in torch)
    assert "-e .[" in everything and "index-url" not in everything


@pytest.mark.skipif(sys.platform != "linux", reason="the scripts install system libraries on Linux")
def test_setup_shows_the_end_of_pips_log_when_pip_fails(tree: Path, tmp_path: Path) -> None:
    fake_venv(tree, "echo ERROR: no space left; exit 3")
    result = run(tree, tmp_path, tmp_path)
    assert result.returncode == 1
    assert "ERROR: no space left" in result.stderr
    assert "pip install failed" in result.stderr
    assert not (tree / ".venv/posekit-setup").exists()


def test_setup_says_that_python_is_too_old(tree: Path, tmp_path: Path) -> None:
    for name in ("python3", "python3.11", "python3.12", "python3.13", "python3.14"):
        (tmp_path / name).write_text("#!/bin/sh\nexit 1\n")
        (tmp_path / name).chmod(0o755)
    result = run(tree, tmp_path, tmp_path)
    assert result.returncode == 1
    assert "Python 3.11 or newer" in result.stderr
    assert not (tree / ".venv").exists()


def test_constraints_lie_within_the_ranges() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = [line for line in (ROOT / "scripts/constraints.txt").read_text().splitlines() if "==" in line]
    assert {line.split("==")[0] for line in pinned} >= {"torch", "torchvision", "viser", "mkdocs-material"}
    assert not any("==" in dependency for dependency in project["dependencies"])


def test_openly_licensed_meshes_are_collected(tmp_path: Path) -> None:
    cube = "\n".join(f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 2))
    faces = "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
    wheel, catalogues = tmp_path / "shapes.whl", tmp_path / "furniture"
    with zipfile.ZipFile(wheel, "w") as archive:
        for k in range(3):
            archive.writestr(f"pybullet_data/random_urdfs/{k:03}/{k:03}.obj", f"{cube}\n{faces}")
            archive.writestr(f"pybullet_data/random_urdfs/{k:03}/{k:03}.mtl", "newmtl a\n")
    catalogues.mkdir()
    listed = "license=CC-BY 3.0\nmodel#1=/m/box.obj\ncreator#1=A. Maker\nwidth#1=30\ndepth#1=40\nheight#1=120\n"
    for name, text in (("free", listed), ("closed", listed.replace("CC-BY", "CC-BY-NC"))):
        with zipfile.ZipFile(catalogues / f"{name}.sh3f", "w") as archive:
            archive.writestr("PluginFurnitureCatalog.properties", text)
            archive.writestr("m/box.obj", f"{cube}\n{faces}")
    command = ["--furniture", catalogues, "--shapes", wheel, "--out", tmp_path / "out", "--max-shapes", "2"]
    done = subprocess.run(
        [sys.executable, ROOT / "scripts/collect_meshes.py", *command], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "3 meshes" in done.stdout and "closed: left out" in done.stderr
    assert ObjectModel.load(tmp_path / "out/free_box/box.obj", units="m").diameter == pytest.approx(1.3, rel=1e-3)
    assert "| free_box | A. Maker | CC-BY 3.0 | free.sh3f |" in (tmp_path / "out/LICENCES.md").read_text()
