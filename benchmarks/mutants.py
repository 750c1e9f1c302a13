"""How many small faults the tests catch: single-operator mutants of modules, each run against its own test files.

    python benchmarks/mutants.py [MODULE ...] [--count N] [--seed N] [--seconds N] [--among FILE]

A mutant changes one operator, comparison, sign, number, or call (abs, min, max) of a module, in memory alone. Each is
run in a process of its own, forked from this one; a mutant that runs longer than --seconds counts as killed. Prints
each living mutant with its line, and the share of killed ones of every module. --among: only the mutants that an
earlier run printed as living, to see which of them new tests catch. docs/mutation.md has the result.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import importlib.machinery
import inspect
import io
import multiprocessing
import os
import random
import signal
import sys
import time
import types
from collections.abc import Iterator
from pathlib import Path

import cv2
import moderngl  # noqa: F401 - what tests import is loaded once, before the forks
import numpy as np  # noqa: F401
import PIL.Image
import pycocotools.cocoeval  # noqa: F401
import pytest
import scipy.spatial  # noqa: F401
import torch
import trimesh  # noqa: F401
from _pytest.main import pytest_runtestloop
from hypothesis import Phase, settings

HERE = Path(__file__).resolve().parent.parent
MODULES = {
    "geometry": ["test_geometry"],
    "camera": ["test_camera", "test_zoom"],
    "zoom": ["test_zoom"],
    "metrics": ["test_metrics", "test_nearest"],
    "align/gauss_newton": ["test_gauss_newton", "test_pnp"],
    "align/pnp": ["test_pnp"],
    "align/mask_edge": ["test_gauss_newton", "test_mask_edge"],
    "align/colour_edge": ["test_colour_edge"],
    "results": ["test_results"],
    "datasets/bop": ["test_bop"],
}
RENDERED = {"align/mask_edge"}
OPERATORS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.MatMult: ast.Add, ast.Pow: ast.Mult, ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
CALLS = {"abs": None, "min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "argmin": "argmax",
         "any": "all", "all": "any", "sin": "cos", "cos": "sin"}  # fmt: skip


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """What may stand in a node's place."""
    new = copy.deepcopy(node)
    if isinstance(new, (ast.BinOp, ast.BoolOp, ast.AugAssign)) and type(new.op) in OPERATORS:
        new.op = OPERATORS[type(new.op)]()
        yield new
    elif isinstance(new, ast.Compare) and type(new.ops[0]) in OPERATORS:
        new.ops[0] = OPERATORS[type(new.ops[0])]()
        yield new
    elif isinstance(new, ast.UnaryOp) and isinstance(new.op, (ast.USub, ast.Not)):
        yield new.operand
    elif isinstance(new, ast.Constant) and type(new.value) in (int, float):
        new.value = new.value + 1 if new.value in (0, 1, 2) else new.value * 2
        yield new
    elif isinstance(new, ast.Call):
        name = new.func.attr if isinstance(new.func, ast.Attribute) else getattr(new.func, "id", "")
        if name == "abs":
            yield new.args[0]
        elif name in CALLS and isinstance(new.func, ast.Attribute):
            new.func.attr = str(CALLS[name])
            yield new
        elif name in CALLS and isinstance(new.func, ast.Name):
            new.func.id = str(CALLS[name])
            yield new


def mutants(source: str) -> list[tuple[int, str, ast.Module]]:
    """(line, the new expression, the new module) for every place."""
    tree, found = ast.parse(source), []
    skipped = {id(n) for a in ast.walk(tree) if isinstance(a, (ast.AnnAssign, ast.arg)) and a.annotation is not None
               for n in ast.walk(a.annotation)}  # fmt: skip
    skipped |= {
        id(n) for f in ast.walk(tree) if isinstance(f, ast.FunctionDef) and f.returns for n in ast.walk(f.returns)
    }
    skipped |= {id(n) for j in ast.walk(tree) if isinstance(j, (ast.JoinedStr, ast.Raise)) for n in ast.walk(j)}
    skipped |= {id(n) for a in tree.body if isinstance(a, ast.Assign) for n in ast.walk(a)}  # constants and types
    for parent in ast.walk(tree):
        for name, value in ast.iter_fields(parent):
            for k, child in enumerate(value if isinstance(value, list) else [value]):
                if not isinstance(child, ast.AST) or id(child) in skipped:
                    continue
                for new in changes(child):
                    kept = value[k] if isinstance(value, list) else value
                    _put(parent, name, k, new)
                    found.append((child.lineno, ast.unparse(new), copy.deepcopy(tree)))  # type: ignore[attr-defined]
                    _put(parent, name, k, kept)
    return found


def _put(parent: ast.AST, name: str, k: int, child: ast.AST) -> None:
    value = getattr(parent, name)
    if isinstance(value, list):
        value[k] = child
    else:
        setattr(parent, name, child)


def _told(module: str, line: int, text: str) -> str:
    return f"lives: {module}:{line}: {text}"


class Mutation:
    """A pytest plugin that runs the collected tests once as they are and then once for every mutant, each in a process
    forked after the collection, so that a mutant costs its tests alone. lost: how many were killed; None where the
    tests fail without a mutant."""

    def __init__(self, module: str, chosen: list[tuple[int, str, ast.Module]], seconds: float) -> None:
        self.module, self.chosen, self.seconds = module, chosen, seconds
        self.path = HERE / "src/posekit" / f"{module}.py"
        self.lost: int | None = None

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        # what renders does not survive a fork: where tests render, all of it happens in the children
        if self._killed(session, None) if self.module in RENDERED else _fails(session):
            return True
        self.lost = 0
        for line, text, mutant in self.chosen:
            if self._killed(session, mutant):
                self.lost += 1
            else:
                os.write(1, f"{_told(self.module, line, text)}\n".encode())
        return True

    def _killed(self, session: pytest.Session, mutant: ast.Module | None) -> bool:
        child = os.fork()
        if child == 0:
            code = 1
            with contextlib.suppress(BaseException):
                if mutant is None or _exchanged(self.path, mutant):
                    code = _fails(session)
                else:
                    _import_mutant(self.path, mutant)
                    code = int(pytest.main(_options(self.module)))
            os._exit(code)
        until = time.monotonic() + self.seconds
        while time.monotonic() < until:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status) != 0
            time.sleep(0.02)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return True


def _fails(session: pytest.Session) -> bool:
    with contextlib.suppress(session.Failed):
        pytest_runtestloop(session)
    return bool(session.testsfailed)


def _options(module: str) -> list[str]:
    return ["-x", "-q", "--tb=no", "-p", "no:cacheprovider", *(f"tests/{name}.py" for name in MODULES[module])]


def _exchanged(path: Path, tree: ast.Module) -> bool:
    """Put the mutant's code into the functions of a module that is imported already. False where it is not, or where
    the mutant is outside functions."""
    name = ".".join(path.relative_to(HERE / "src").with_suffix("").parts)
    if name not in sys.modules:
        return False
    new = _functions(compile(ast.fix_missing_locations(tree), str(path), "exec"))
    old = _functions(compile(path.read_text(), str(path), "exec"))
    changed = [key for key in new if new[key] != old[key]]
    for key in changed:
        found: object = sys.modules[name]
        for part in key.split("."):
            found = vars(found)[part]
        for inner in ("fget", "__func__", "func", "__wrapped__"):
            found = getattr(found, inner, found)
        found.__code__ = new[key]  # type: ignore[attr-defined]
    return bool(changed)


def _functions(code: types.CodeType) -> dict[str, types.CodeType]:
    """The code of every function of a module and its classes, by qualified name."""
    found = {}
    for inner in (c for c in code.co_consts if isinstance(c, types.CodeType)):
        if inner.co_flags & inspect.CO_NEWLOCALS and inner.co_flags & inspect.CO_OPTIMIZED:
            found[inner.co_qualname] = inner
        else:
            found |= _functions(inner)
    return {key: value for key, value in found.items() if "<" not in key}


def _import_mutant(path: Path, tree: ast.Module) -> None:
    """Have the mutant imported in place of the module."""
    usual = importlib.machinery.SourceFileLoader.get_code

    def get_code(loader: importlib.machinery.SourceFileLoader, name: str):  # type: ignore[no-untyped-def]
        if Path(loader.path) == path:
            return compile(ast.fix_missing_locations(tree), loader.path, "exec")
        return usual(loader, name)

    importlib.machinery.SourceFileLoader.get_code = get_code  # type: ignore[method-assign]
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None)).startswith((str(HERE / "src"), str(HERE / "tests"))):
            del sys.modules[name]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=list(MODULES))
    parser.add_argument("--count", type=int, default=0, help="of each module, drawn at random; 0 = all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--among", type=Path, help="a former run's output")
    args = parser.parse_args()
    for path in ("src", "tests"):
        sys.path.insert(0, str(HERE / path))
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    os.chdir(HERE)
    PIL.Image.init()
    # a failing example need not be made smaller; the profiles of the tests start from this one
    settings.register_profile("mutants", phases=[Phase.explicit, Phase.generate], database=None, deadline=None)
    settings.load_profile("mutants")
    former = set(args.among.read_text().splitlines()) if args.among else None
    total = dead = 0
    for module in args.modules:
        chosen = _chosen(module, args.count, args.seed, former)
        lost = _killed_of(module, chosen, args.seconds)
        total, dead = total + len(chosen), dead + lost
        print(f"{module}: {lost} of {len(chosen)} killed", flush=True)
    print(f"all: {dead} of {total} killed, {100 * dead / max(1, total):.0f} %")


def _chosen(module: str, count: int, seed: int, former: set[str] | None) -> list[tuple[int, str, ast.Module]]:
    every = mutants((HERE / "src/posekit" / f"{module}.py").read_text())
    if former is not None:
        every = [m for m in every if _told(module, m[0], m[1]) in former]
    drawn = random.Random(seed).sample(every, min(count or len(every), len(every)))
    return sorted(drawn, key=lambda m: m[0])


def _killed_of(module: str, chosen: list[tuple[int, str, ast.Module]], seconds: float) -> int:
    """How many of a module's mutants are killed, counted in a process of its own."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    child = os.fork()
    if child == 0:
        mutation = Mutation(module, chosen, seconds)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(BaseException):
            pytest.main(["-s", *_options(module)], plugins=[mutation])
        sender.send(mutation.lost)
        os._exit(0)
    lost = receiver.recv()
    os.waitpid(child, 0)
    if lost is None:
        raise SystemExit(f"the tests of {module} fail without a mutant.")
    return int(lost)


if __name__ == "__main__":
    main()
