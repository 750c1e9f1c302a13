"""The house's rules, read from the imports: layers, doors, no cycles."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parent.parent / "src" / "posekit"

# A room (a module of the top level, or a package) and its layer. Imports go down only.
# Rooms that are planned stand here too; a room that is built must stand here.
LAYERS = {
    0: {"geometry", "camera", "lens"},
    1: {"view", "results", "machines", "nearest"},
    2: {"io", "metrics"},
    3: {"mesh"},
    4: {"zoom", "render", "nets", "object_model"},
    5: {"align", "visualise"},
    6: {"detect", "first_pose"},
    7: {"estimate", "datasets"},
    8: {"tracking", "synth"},
    9: {"evaluate", "train", "api", "viewer", "batch"},
    10: {"cli"},
    11: {"__main__"},
}
ANYWHERE = {"errors", "_version"}
# A camera turns rays, a lens belongs to a camera; the detector of objects that were never trained on compares them with
# the views that first poses come from.
SIBLINGS = {("camera", "geometry"), ("lens", "camera"), ("detect", "first_pose")}

# A foreign library and the rooms whose door it is.
DOORS = {
    "moderngl": {"render"},
    "glcontext": {"render"},
    "trimesh": {"mesh"},
    "mapbox_earcut": {"mesh"},
    "yaml": {"io"},
    "torchvision": {"detect", "train"},
    "lightning_fabric": {"train"},
    "typer": {"cli"},
    "rich": {"cli"},
    "huggingface_hub": {"datasets"},
    "pycocotools": {"detect"},
    "av": {"io"},
    "rerun": {"visualise"},
    "viser": {"viewer"},
    "websockets": {"viewer"},
    "openvino": {"nets", "cli"},
    "onnx": {"nets"},
    "onnxruntime": {"nets"},
    "supervision": {"detect"},
}

ROOM_LAYER = {room: layer for layer, rooms in LAYERS.items() for room in rooms}
FILES = sorted(SOURCE.rglob("*.py"))


def room_of(path: Path) -> str:
    first = path.relative_to(SOURCE).parts[0]
    return first.removesuffix(".py")


def imports_of(path: Path) -> Iterator[str]:
    """Dotted names of all that a file imports, lazily or not, under ``if TYPE_CHECKING`` too."""
    package = ["posekit", *path.relative_to(SOURCE).parts[:-1]]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = [*package[: len(package) - node.level + 1], *(node.module or "").split(".")] if node.level else []
            module = ".".join(filter(None, base)) or node.module or ""
            yield from (f"{module}.{alias.name}" for alias in node.names)


def rooms_imported_by(path: Path) -> set[str]:
    rooms = {name.split(".")[1] for name in imports_of(path) if name.startswith("posekit.")}
    return rooms - ANYWHERE - {"__version__"}


def relative(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


INNER = [path for path in FILES if room_of(path) not in ANYWHERE | {"__init__"}]


@pytest.mark.parametrize("path", INNER, ids=relative)
def test_imports_go_down_only(path: Path) -> None:
    room = room_of(path)
    assert room in ROOM_LAYER, f"{relative(path)} has no layer: give its room one in LAYERS and in the design"
    for other in rooms_imported_by(path) - {room}:
        assert other in ROOM_LAYER, f"{relative(path)} imports posekit.{other}, which has no layer"
        allowed = ROOM_LAYER[other] < ROOM_LAYER[room] or (room, other) in SIBLINGS
        assert allowed, f"{relative(path)} (layer {ROOM_LAYER[room]}) imports {other} (layer {ROOM_LAYER[other]})"


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_foreign_libraries_come_in_by_their_doors(path: Path) -> None:
    for name in imports_of(path):
        library = name.split(".")[0]
        doors = DOORS.get(library, {room_of(path)})
        assert room_of(path) in doors, f"{relative(path)} imports {library}, whose door is {sorted(doors)}"


def test_no_cycles() -> None:
    def dotted(path: Path) -> str:
        return ".".join(["posekit", *path.relative_to(SOURCE).with_suffix("").parts]).removesuffix(".__init__")

    modules = {dotted(path): path for path in FILES if path != SOURCE / "__init__.py"}

    def needs(name: str, path: Path) -> set[str]:
        found = set()
        for module in imports_of(path):
            while module and module not in modules:
                module = module.rpartition(".")[0]
            inside_out = name.startswith(f"{module}.")  # a module's own package is loaded before it in any case
            if module and module != name and not inside_out:
                found.add(module)
        return found

    try:
        tuple(TopologicalSorter({name: needs(name, path) for name, path in modules.items()}).static_order())
    except CycleError as error:
        pytest.fail(f"modules import each other: {' -> '.join(error.args[1])}")


def test_no_rooms_for_odds_and_ends() -> None:
    names = {path.stem for path in FILES} | {path.parent.name for path in FILES}
    assert not names & {"utils", "util", "common", "core", "helpers", "misc"}


def test_errors_know_nobody() -> None:
    assert not list(imports_of(SOURCE / "errors.py"))


def undocumented(scope: ast.Module | ast.ClassDef, prefix: str = "") -> Iterator[str]:
    """Public classes, methods and functions without a docstring."""
    for node in scope.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            if not ast.get_docstring(node):
                yield prefix + node.name
            if isinstance(node, ast.ClassDef):
                yield from undocumented(node, f"{prefix}{node.name}.")


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_public_names_have_docstrings(path: Path) -> None:
    module = ast.parse(path.read_text(encoding="utf-8"), str(path))
    assert ast.get_docstring(module) or not module.body, f"{relative(path)} has no docstring"
    assert not list(undocumented(module))
