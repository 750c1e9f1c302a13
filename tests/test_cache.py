"""What is kept on disk: shown, cleared, bounded."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from posekit.cli.app import app
from posekit.io.array_cache import keep_arrays, read_arrays
from posekit.io.cache_folder import clear, kept, make_room


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "posekit"


def filled(folder: Path) -> None:
    for name in (
        "features/a.npz", "templates-200/b.npz", "openvino/d-1/svnet.bin", "openvino/compiled/c.blob", "lmo/test.zip"
    ):  # fmt: skip
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(bytes(1_000_000))


def run(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["cache", *arguments])
    assert result.exit_code == 0, result.output
    return result.output


def test_an_empty_cache_is_said(folder: Path) -> None:
    assert "nothing is kept" in run()
    assert "0.0 MB deleted" in run("--clear")


def test_sizes_are_told_by_kind(folder: Path) -> None:
    filled(folder)
    lines = run().splitlines()
    assert [line.split()[:4] for line in lines[:-1]] == [
        ["openvino", "1", "1.0", "MB"],
        ["openvino/compiled", "1", "1.0", "MB"],
        ["templates-200", "1", "1.0", "MB"],
        ["features", "1", "1.0", "MB"],
    ]
    assert lines[-1].startswith("4.0 MB in")


def test_clearing_leaves_everything_else(folder: Path) -> None:
    filled(folder)
    assert "4.0 MB deleted" in run("--clear")
    assert [path.name for path in folder.rglob("*") if path.is_file()] == ["test.zip"]
    assert sum(each.count for each in kept()) == 0
    assert clear() == 0


def test_the_oldest_make_room(folder: Path) -> None:
    folder.mkdir()
    for age, name in enumerate("cab"):
        (folder / name).mkdir()
        os.utime(folder / name, (1000 - age, 1000 - age))
    make_room(folder.iterdir(), 2)
    assert sorted(path.name for path in folder.iterdir()) == ["a", "c"]
    make_room([*folder.iterdir(), folder / "gone"], 2)
    assert len(list(folder.iterdir())) == 2


@pytest.mark.parametrize("compressed", [True, False])
def test_arrays_come_back_and_are_bounded(folder: Path, compressed: bool) -> None:
    for k in range(3):
        keep_arrays(folder / f"{k}.npz", {"a": np.arange(k)}, most=2, compressed=compressed)
        os.utime(folder / f"{k}.npz", (k + 1, k + 1))
    assert read_arrays(folder / "0.npz") is None
    found = read_arrays(folder / "2.npz")
    assert found is not None
    np.testing.assert_array_equal(found["a"], [0, 1])
