"""Public names by room, and the pages that show them. What several rooms list is shown with the first of them."""

import importlib
import re
from collections.abc import Iterator, Mapping
from functools import cache
from inspect import getdoc, isclass, isroutine
from pathlib import Path
from types import ModuleType

SHORT = {"jaxeit": "je", "calib": "calib"}
GROUPS = ("Functions", "Classes", "Values", "Errors")
SUBROOMS = ("calib.fitting.logs", "calib.session.importers")
"""Rooms inside of rooms, whose names no other room lists."""


ROOT = Path(__file__).parents[2]
USED = re.compile(r"\b(?:je|calib)\.(?:\w+\.)*(\w+)")
IMPORTED = re.compile(r"^from (?:jaxeit|calib)\S* import (.*)", re.MULTILINE)
PROGRAM = re.compile(r"```python.*?\n(.*?)```", re.DOTALL)
MOST_USES = 4


def _programs() -> Iterator[tuple[str, str, str]]:
    """Name, address from the pages of names, and programs of each example and of each page that has some."""
    for path in sorted(ROOT.glob("examples/*.py")):
        yield path.stem, f"../examples/README.md#{path.stem}", path.read_text(encoding="utf-8")
    for path in [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]:
        text = path.read_text(encoding="utf-8")
        yield text.partition("\n")[0].lstrip("# "), f"../{path.relative_to(ROOT)}", "\n".join(PROGRAM.findall(text))


@cache
def uses() -> dict[str, list[str]]:
    """Links to the examples and the pages whose programs use a public name, by name."""
    found: dict[str, list[str]] = {}
    for title, address, program in _programs():
        imported = ", ".join(IMPORTED.findall(program)).split(", ")
        for name in {*USED.findall(program), *imported}:
            found.setdefault(name, []).append(f"[{title}]({address})")
    return found


def rooms() -> dict[str, ModuleType]:
    """The packages, and the rooms that they show, by their paths; the packages come last."""
    packages = {path: importlib.import_module(path) for path in SHORT}
    inside = {f"{path}.{n}": getattr(package, n) for path, package in packages.items() for n in package.__all__}
    listing = {path: room for path, room in inside.items() if isinstance(room, ModuleType) and hasattr(room, "__all__")}
    return listing | {path: importlib.import_module(path) for path in SUBROOMS} | packages


def public_names() -> dict[str, dict[str, object]]:
    """Names of each room, and what they stand for."""
    seen: set[str] = set()
    found: dict[str, dict[str, object]] = {}
    for path, room in rooms().items():
        things = {name: getattr(room, name) for name in sorted(room.__all__) if name not in seen}
        found[path] = {name: thing for name, thing in things.items() if not isinstance(thing, ModuleType)}
        seen |= found[path].keys()
    return found


def identifiers() -> dict[str, str]:
    """Public name -> its path, under which its page shows it."""
    return {name: f"{path}.{name}" for path, names in public_names().items() for name in names}


def shown(path: str, name: str) -> str:
    """A name as users type it: by its package, if that has it, or else by its room."""
    package, _, room = path.partition(".")
    everyday = not room or name in importlib.import_module(package).__all__
    return f"{SHORT[package]}.{name}" if everyday else f"{SHORT[package]}.{room}.{name}"


def _group(thing: object) -> str:
    if isclass(thing):
        return "Errors" if issubclass(thing, Exception) else "Classes"
    return "Functions" if isroutine(thing) else "Values"


def _summary(thing: object) -> str:
    """The first line of a docstring; of a table of names, the names."""
    if isinstance(thing, Mapping):
        return ", ".join(f"`{key}`" for key in thing)
    return " ".join((getdoc(thing) or "").split("\n\n")[0].removesuffix("::").split())


def _entry(path: str, name: str) -> list[str]:
    """A name in full, and where programs use it."""
    shows = f"::: {path}.{name}\n    options: {{heading: {shown(path, name)}}}\n"
    links = uses().get(name, [])[:MOST_USES]
    return [shows, f"In use: {', '.join(links)}.\n"] if links else [shows]


def room_page(path: str, names: Mapping[str, object]) -> str:
    """The page of a room: its docstring, its names with a line for each, and each in full, by mkdocstrings."""
    package, _, room = path.partition(".")
    lines = [f"# {SHORT[package]}{room and '.'}{room}", "", getdoc(rooms()[path]) or "", ""]
    groups = {group: [n for n in names if _group(names[n]) == group] for group in GROUPS}
    lines += [f"- [`{shown(path, n)}`][{path}.{n}]: {_summary(names[n])}" for inside in groups.values() for n in inside]
    for group, inside in groups.items():
        entries = [entry for name in inside for entry in _entry(path, name)]
        lines += ["", f"## {group}", "", *entries] if entries else []
    return "\n".join(lines) + "\n"
