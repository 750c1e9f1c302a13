"""How many small faults the tests catch: single-operator mutants of modules, each run against its own test files.

    python benchmarks/mutants.py [MODULE ...] [--count N] [--seed N] [--seconds N]

A mutant changes one operator, comparison, sign, number, or call (abs, min, max) of a module, in memory alone. Each is
run in a process of its own, forked from this one; a mutant that runs longer than --seconds counts as killed. Prints
each living mutant with its line, and the share of killed ones of every module.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import importlib.machinery
import io
import os
import random
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2  # noqa: F401 - what tests import is loaded once, before the forks
import numpy as np  # noqa: F401
import pytest
import scipy.spatial  # noqa: F401
import torch  # noqa: F401

HERE = Path(__file__).resolve().parent.parent
MODULES = {
    "geometry": ["test_geometry"],
    "camera": ["test_geometry", "test_zoom"],
    "zoom": ["test_geometry", "test_zoom"],
    "metrics": ["test_metrics"],
    "align/gauss_newton": ["test_gauss_newton", "test_pnp"],
    "align/pnp": ["test_pnp"],
    "align/mask_edge": ["test_mask_edge", "test_gauss_newton"],
    "results": ["test_results"],
    "datasets/bop": ["test_bop"],
}
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


def killed(path: Path, tree: ast.Module, tests: list[str], seconds: float) -> bool:
    """Whether the tests fail with a module's mutant."""
    child = os.fork()
    if child == 0:
        _live(path, tree, tests)
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) != 0
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return True


def _live(path: Path, tree: ast.Module, tests: list[str]) -> None:
    usual = importlib.machinery.SourceFileLoader.get_code

    def get_code(loader: importlib.machinery.SourceFileLoader, name: str):  # type: ignore[no-untyped-def]
        if Path(loader.path) == path:
            return compile(ast.fix_missing_locations(tree), loader.path, "exec")
        return usual(loader, name)

    importlib.machinery.SourceFileLoader.get_code = get_code  # type: ignore[method-assign]
    os.chdir(HERE)
    files = [f"tests/{name}.py" for name in tests if Path(f"tests/{name}.py").exists()]
    code = 1
    quiet = contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO())
    with contextlib.suppress(BaseException), quiet[0], quiet[1]:
        code = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *files]))
    os._exit(code)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=list(MODULES))
    parser.add_argument("--count", type=int, default=0, help="of each module, drawn at random; 0 = all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0)
    args = parser.parse_args()
    for path in ("src", "tests"):
        sys.path.insert(0, str(HERE / path))
    total = dead = 0
    for module in args.modules:
        path = HERE / "src/posekit" / f"{module}.py"
        tree = ast.parse(path.read_text())
        if killed(path, tree, MODULES[module], 600):
            raise SystemExit(f"the tests of {module} fail without a mutant.")
        every = mutants(path.read_text())
        chosen = random.Random(args.seed).sample(every, min(args.count or len(every), len(every)))
        lost = 0
        for line, text, mutant in sorted(chosen, key=lambda m: m[0]):
            if killed(path, mutant, MODULES[module], args.seconds):
                lost += 1
            else:
                print(f"lives: {module}:{line}: {text}", flush=True)
        total, dead = total + len(chosen), dead + lost
        print(f"{module}: {lost} of {len(chosen)} killed ({len(every)} places)", flush=True)
    print(f"all: {dead} of {total} killed, {100 * dead / max(1, total):.0f} %")


if __name__ == "__main__":
    main()
