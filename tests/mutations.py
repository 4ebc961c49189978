"""Guards broken one at a time, in a copy of the project: a test must fail for each, or the guard is dead.

    python -m tests.mutations [TEXT] [--log FILE | --check]

breaks those of mutations.txt whose line contains TEXT, all without it, runs the tests that concern each (first those
that are known to hold it, the slow ones last), and lists the ones that no test held; exit status 1 if there are any.
An hour for all of them; verdicts are kept in FILE, if one is given, and what has one there is not run again.
``--check`` only looks whether the list still fits the sources and the tests, as every run does first. Guards that only
save time are not in the list.

A section of mutations.txt names test files in brackets; a line of it reads ::

    Class.method: expression => other expression  # part of the name of a test that holds it, for pytest -k

The symbol is the qualified name of a function, class or constant, in whichever file it is defined. The expression (or
statement; ``=> pass`` leaves it out) must stand there once. Names in the list may differ from those in the source, as
long as they do so consistently, so that a line still fits where a variable, an attribute or a class is renamed.
"""

import argparse
import ast
import builtins
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).with_suffix(".txt")
PACKAGES = ("jaxeit", "calib")
COPIED = (*PACKAGES, "tests", "data", "benchmarks", "pyproject.toml", "README.md")

# Names of others, which no rename in this project changes: modules and builtins, methods of arrays and of strings.
MODULES = {"jax", "jnp", "np", "eqx", "optx", "os", "math", "je"}
GLOBALS = MODULES | set(dir(builtins))
METHODS = set(dir(np.ndarray)) | set(dir(jax.Array)) | set(dir(str))


class Misfit(ValueError):
    """A line of the list that does not fit the sources."""


class Mutant(NamedTuple):
    """What to replace by what within a symbol, the test files that should mind, and a test that does."""

    symbol: str
    old: str
    new: str
    tests: str
    first: str

    def __str__(self) -> str:
        return f"{self.symbol}: {self.old} => {self.new}"


def listed(text: str) -> list[Mutant]:
    """The mutants of a list."""
    found, tests = [], ""
    for line in filter(None, text.splitlines()):
        if line.startswith("["):
            tests = line.strip("[]")
            continue
        change, _, first = line.rpartition("  # ")
        symbol, _, change = change.partition(": ")
        old, _, new = change.partition(" => ")
        found.append(Mutant(symbol, old, new, tests, first))
    return found


# --- where a mutant applies


@cache
def symbols(root: Path) -> list[tuple[Path, list[str], ast.AST]]:
    """Every module, function, class and constant of the packages: file, path and qualified name as parts, syntax."""

    def within(node: ast.AST, path: Path, parts: list[str]) -> Iterator[tuple[Path, list[str], ast.AST]]:
        for child in ast.iter_child_nodes(node):
            name = _name(child, node)
            own = [*parts, name] if name else parts
            if name:
                yield path, own, child
            yield from within(child, path, own)

    found = []
    for path in (path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))):
        module, parts = ast.parse(path.read_text()), list(path.relative_to(root).with_suffix("").parts)
        found += [(path, parts, module), *within(module, path, parts)]
    return found


def _name(node: ast.AST, parent: ast.AST) -> str | None:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return node.name
    single = isinstance(node, ast.Assign) and isinstance(parent, ast.Module | ast.ClassDef)
    return getattr(node.targets[0], "id", None) if isinstance(node, ast.Assign) and single else None


Place = tuple[Path, Any, dict[str, str]]  # file, syntax, and what the pattern's names are called there


def place(mutant: Mutant, root: Path) -> tuple[Path, ast.AST, str]:
    """The file in which a mutant applies, the syntax that it replaces, and what goes there.

    Raises:
        Misfit: where the expression does not stand once in a symbol of that name.
    """
    (pattern,), (new,) = ast.parse(mutant.old).body, ast.parse(mutant.new).body
    if isinstance(pattern, ast.Expr) and isinstance(new, ast.Expr):
        pattern, new = pattern.value, new.value
    parts, every = mutant.symbol.split("."), symbols(root)
    within = [(path, node) for path, own, node in every if own[-len(parts) :] == parts]
    found = _alike(pattern, {id(node): (path, node) for path, symbol in within for node in ast.walk(symbol)}.values())
    if not found:  # anywhere, where the function or its class has another name now
        found = _exact(_alike(pattern, everywhere(root)[type(pattern)]))
    if len(found) != 1:
        raise Misfit(f"{mutant}: stands there {len(found)} times")
    path, node, names = found[0]
    text = ast.unparse(Renamed(names).visit(new))
    return path, node, f"({text})" if isinstance(node, ast.expr) else text


@cache
def everywhere(root: Path) -> dict[type[ast.AST], list[tuple[Path, ast.AST]]]:
    """All syntax of the packages by its type, with the files: half a million pieces are searched through once."""
    found = defaultdict(list)
    for path, _, module in symbols(root):
        if isinstance(module, ast.Module):
            for node in ast.walk(module):
                found[type(node)].append((path, node))
    return found


def _alike(pattern: ast.AST, there: Iterable[tuple[Path, ast.AST]]) -> list[Place]:
    """The places of a pattern and what its names are called there; if it stands once under its own names, that one.

    Of three names or more one must still be called the same: else it is another expression of that shape.
    """
    found = []
    for path, node in there:
        names: dict[str, str] = {}
        fits = isinstance(node, ast.expr | ast.stmt) and unified(pattern, node, names)
        if fits and (len(names) < 3 or any(name == own for name, own in names.items())):
            found.append((path, node, names))
    exact = _exact(found)
    return exact if len(exact) == 1 else found


def _exact(found: list[Place]) -> list[Place]:
    return [one for one in found if all(name == own for name, own in one[2].items())]


def unified(pattern: Any, node: Any, names: dict[str, str]) -> bool:
    """Whether two pieces of syntax are the same up to renaming; ``names`` is filled with what is called what."""
    if isinstance(pattern, list):
        return len(pattern) == len(node) and all(unified(p, n, names) for p, n in zip(pattern, node, strict=True))
    if not isinstance(pattern, ast.AST):
        return pattern == node
    if type(pattern) is not type(node):
        return False
    for field, value in ast.iter_fields(pattern):
        own = getattr(node, field)
        if (type(pattern), field) in IDENTIFIERS and isinstance(value, str):
            if not (value == own if _is_fixed(pattern, {value, own}) else _renamed(value, own, names)):
                return False
        elif field not in ("ctx", "kind") and not unified(value, own, names):
            return False
    return True


def _is_fixed(pattern: ast.AST, names: set[str]) -> bool:
    """Whether one of two names belongs to others: what is in a module, methods of arrays and strings, builtins."""
    if isinstance(pattern, ast.Attribute):
        return _root(pattern) in MODULES or bool(names & METHODS)
    return bool(names & GLOBALS)


IDENTIFIERS = {(ast.Name, "id"), (ast.Attribute, "attr"), (ast.keyword, "arg"), (ast.arg, "arg")}


def _renamed(name: str, own: str, names: dict[str, str]) -> bool:
    """Whether a name may stand for another: always for the same one, and no two for one."""
    return names.setdefault(name, own) == own and list(names.values()).count(own) == 1


def _root(node: ast.AST) -> str:
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


class Renamed(ast.NodeTransformer):
    """Syntax with other names."""

    def __init__(self, names: dict[str, str]) -> None:
        self.names = names

    def generic_visit(self, node: ast.AST) -> ast.AST:
        for kind, field in IDENTIFIERS:
            if isinstance(node, kind):
                setattr(node, field, self.names.get(getattr(node, field), getattr(node, field)))
        return super().generic_visit(node)


def broken(path: Path, node: Any, text: str) -> str:
    """The source of a file with one piece of its syntax replaced."""
    lines = path.read_bytes().splitlines(keepends=True)
    start, end = (
        sum(map(len, lines[: line - 1])) + column
        for line, column in ((node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset))
    )
    source = b"".join(lines)
    return (source[:start] + text.encode() + source[end:]).decode()


def misfits(mutants: Iterable[Mutant]) -> list[str]:
    """What of the list does not fit the sources, or the names of the tests; a line each."""
    return [line for mutant in mutants for line in _misfits(mutant)]


def _misfits(mutant: Mutant) -> Iterator[str]:
    try:
        place(mutant, ROOT)
    except (Misfit, SyntaxError) as error:
        yield str(error)
    paths = [path_of(name, ROOT) for name in mutant.tests.split()]
    names = [name for path in paths if path.exists() for name in re.findall(r"def (test_\w+)", path.read_text())]
    yield from (f"{path.name}: there is no such test file" for path in paths if not path.exists())
    if not any(mutant.first in name for name in names):
        yield f"{mutant.tests}: no test is called {mutant.first!r}, for {mutant}"


# --- what holds it


def path_of(name: str, root: Path) -> Path:
    """File of the test module of this name, in whichever room of ``tests/``."""
    return next((root / "tests").rglob(f"{name}.py"), root / "tests" / f"{name}.py")


def held(mutant: Mutant, copy: Path) -> str | None:
    """The first test to fail where this guard is broken, if any does; the copy is whole again afterwards."""
    path, node, text = place(mutant, copy)
    sound = path.read_bytes()
    path.write_text(broken(path, node, text))
    runs = ["-k", mutant.first], ["-m", "not slow"], ["-m", "slow"]
    try:
        return next(filter(None, (failure(mutant.tests, run, copy) for run in runs)), None)
    finally:
        path.write_bytes(sound)


def failure(names: str, chosen: list[str], copy: Path) -> str | None:
    """What the first of these tests to fail is called, or None."""
    tests = [str(path_of(name, copy).relative_to(copy)) for name in names.split()]
    command = [sys.executable, "-m", "pytest", "-n0", "-x", "-q", *chosen, "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, timeout=1800, check=False
        )
    except subprocess.TimeoutExpired:
        return "no end"
    if done.returncode in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        return None
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    if not failed:
        raise RuntimeError(done.stdout[-2000:] + done.stderr[-2000:])
    return failed[0]


def copied(folder: Path) -> Path:
    """What the tests need, and what they compiled before."""
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, folder / name)
    if (ROOT / ".pytest_cache" / "jax").is_dir():
        shutil.copytree(ROOT / ".pytest_cache" / "jax", folder / ".pytest_cache" / "jax")
    return folder


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("text", nargs="?", default="", help="break only guards whose line contains this")
    parser.add_argument("--log", type=Path, default=Path(os.devnull), help="verdicts: kept here, and taken from here")
    parser.add_argument("--check", action="store_true", help="break nothing: does the list fit the sources?")
    given = parser.parse_args()
    mutants = listed(LIST.read_text())
    if misfit := misfits(mutants):
        print(f"mend {LIST.name}:", *misfit, sep="\n  ")
        return 2
    if given.check:
        print(f"{len(mutants)} guards, all where the list says")
        return 0
    verdicts = dict(map(json.loads, given.log.open())) if given.log.exists() else {}
    chosen = {str(mutant): mutant for mutant in mutants if given.text in str(mutant)}
    with tempfile.TemporaryDirectory() as folder, given.log.open("a") as log:
        copy = copied(Path(folder))
        for key in [key for key in chosen if key not in verdicts]:
            verdicts[key] = held(chosen[key], copy)
            print(key, verdicts[key] or "SURVIVED", sep=" | ", flush=True)
            print(json.dumps([key, verdicts[key]]), file=log, flush=True)
    alive = [key for key in chosen if verdicts[key] is None]
    print(f"{len(chosen)} guards broken, {len(alive)} of them held by no test", *alive, sep="\n  ")
    return 1 if alive else 0


if __name__ == "__main__":
    sys.exit(main())
