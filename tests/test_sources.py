"""Folders of meshes that a training is fed with."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from objects import bracket
from posekit.errors import MeshError
from posekit.mesh.model import ObjectModel
from posekit.synth.example import ply
from posekit.train.config import SourceConfig
from posekit.train.sources import read_sources

OFF = "OFF\n4 4 0\n0 0 0\n0.1 0 0\n0 0.1 0\n0 0 0.1\n3 0 1 2\n3 0 1 3\n3 0 2 3\n3 1 2 3\n"


def ambiguous() -> str:
    """A mesh whose diameter, about 10, is neither metres nor millimetres."""
    model = bracket()
    scaled = ObjectModel.from_arrays(model.vertices * (10 / model.diameter), model.faces, colors=model.colors)
    return ply(scaled)


def test_a_mesh_of_unknown_units_is_left_out_with_a_note(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "good.ply").write_text(ply(bracket()))
    (tmp_path / "which.ply").write_text(ambiguous())
    (tmp_path / "broken.stl").write_text("solid nothing")
    with caplog.at_level(logging.WARNING, "posekit"):
        sources = read_sources(SourceConfig(meshes=(str(tmp_path),)))
    assert [m.name for m in sources.models] == ["good"] and sources.folders == ((tmp_path.name, 1),)
    told = [r.getMessage() for r in caplog.records if "left out" in r.getMessage()]
    assert len(told) == 2 and any("which.ply" in t for t in told) and any("broken.stl" in t for t in told)


def test_a_folder_without_a_usable_mesh_is_refused(tmp_path: Path) -> None:
    (tmp_path / "which.ply").write_text(ambiguous())
    with pytest.raises(MeshError, match="none of the 1 meshes"):
        read_sources(SourceConfig(meshes=(str(tmp_path),)))


def test_formats_that_no_loader_reads_are_no_meshes(tmp_path: Path) -> None:
    (tmp_path / "shape.off").write_text(OFF)
    with pytest.raises(MeshError, match="holds no meshes"):
        read_sources(SourceConfig(meshes=(str(tmp_path),)))
    (tmp_path / "good.ply").write_text(ply(bracket()))
    assert len(read_sources(SourceConfig(meshes=(str(tmp_path),))).models) == 1
