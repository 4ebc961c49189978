"""Public names by room, and the pages that show them. What several rooms list is shown with the first of them."""

import ast
import importlib
import re
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from inspect import getdoc, isclass, isroutine
from itertools import pairwise
from pathlib import Path
from types import ModuleType

from programs import Program, Relations, examples, relations, used_in, with_fences, written_programs

SHORT = {"jaxeit": "je", "calib": "calib"}
GROUPS = ("Functions", "Classes", "Values", "Errors")
SUBROOMS = ("calib.fitting.logs", "calib.session.importers")
"""Rooms inside of rooms, whose names no other room lists."""

MOST_LINKS = 4
CODE = re.compile(r"^( *)```.*?^\1```|(?<![`\[])`[^`\n]+`(?![`\]])", re.DOTALL | re.MULTILINE)
NAME = re.compile(r"`(?:(?:je|jaxeit|calib)\.)?([A-Za-z][\w.]*)(?:\(.*\))?`")
PAGE = re.compile(r"``((?:docs|data)/[\w/-]+)\.md``")


@cache
def rooms() -> dict[str, ModuleType]:
    """The packages, and the rooms that they show, by their paths; the packages come last."""
    packages = {path: importlib.import_module(path) for path in SHORT}
    inside = {f"{path}.{n}": getattr(package, n) for path, package in packages.items() for n in package.__all__}
    listing = {path: room for path, room in inside.items() if isinstance(room, ModuleType) and hasattr(room, "__all__")}
    return listing | {path: importlib.import_module(path) for path in SUBROOMS} | packages


@cache
def public_names() -> dict[str, dict[str, object]]:
    """Names of each room, and what they stand for."""
    seen: set[str] = set()
    found: dict[str, dict[str, object]] = {}
    for path, room in rooms().items():
        things = {name: getattr(room, name) for name in sorted(room.__all__) if name not in seen}
        found[path] = {name: thing for name, thing in things.items() if not isinstance(thing, ModuleType)}
        seen |= found[path].keys()
    return found


@cache
def identifiers() -> dict[str, str]:
    """Public name -> its path, under which its page shows it."""
    return {name: f"{path}.{name}" for path, names in public_names().items() for name in names}


def public_path(identifier: str) -> str | None:
    """Path under which a name is shown, from where it is defined or imported; None for what is not public."""
    module, _, name = identifier.rpartition(".")
    path = identifiers().get(name)
    if path is None or not module:
        return path
    public = public_names()[path.rpartition(".")[0]][name]
    return path if getattr(sys.modules.get(module), name, None) is public else None


def linked(text: str, module: str | None = None) -> str:
    """The text with names in code linked, and pages; programs and links stay as they are.

    Args:
        module: module whose docstring the text is, where a name alone is a name too; in others only `je.prepare` is.
    """

    def link(found: re.Match[str]) -> str:
        named = NAME.fullmatch(found[0])
        alone = named and not found[0].startswith(("`je.", "`jaxeit.", "`calib."))
        if not named or (alone and (module is None or "(" in found[0])):
            return found[0]
        if alone and not _is_public(named[1].partition(".")[0], module):
            return found[0]
        known = [part for part in named[1].split(".") if part in identifiers()]
        return f"[{found[0]}][{identifiers()[known[0]]}]" if known else found[0]

    return CODE.sub(link, text)


def _is_public(name: str, module: str | None) -> bool:
    """Whether a name in a docstring of a module is the public one, and not another that the module has."""
    path = identifiers().get(name)
    if path is None:
        return False
    public = public_names()[path.rpartition(".")[0]][name]
    return getattr(sys.modules.get(module or ""), name, public) is public


def shown(path: str, name: str) -> str:
    """A name as users type it: by its package, if that has it, or else by its room."""
    package, _, room = path.partition(".")
    everyday = not room or name in importlib.import_module(package).__all__
    return f"{SHORT[package]}.{name}" if everyday else f"{SHORT[package]}.{room}.{name}"


def _group(thing: object) -> str:
    if isclass(thing):
        return "Errors" if issubclass(thing, Exception) else "Classes"
    return "Functions" if isroutine(thing) else "Values"


@cache
def _described_values() -> dict[tuple[str, int], str]:
    """The docstring below each value of a module, by the name of the value and its identity."""
    found = {}
    for path, module in list(sys.modules.items()):
        if path.partition(".")[0] in SHORT and getattr(module, "__file__", None):
            lines = ast.parse(Path(module.__file__).read_text(encoding="utf-8")).body
            for line, after in pairwise(lines):
                names = line.targets if isinstance(line, ast.Assign) else [getattr(line, "target", None)]
                text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and after.value.value
                if text and isinstance(names[0], ast.Name):
                    found[names[0].id, id(vars(module).get(names[0].id))] = str(text)
    return found


def _summary(name: str, thing: object) -> str:
    """The first paragraph of a docstring; of a table of names, the names."""
    if isinstance(thing, Mapping):
        return ", ".join(f"`{key}`" for key in thing)
    text = _described_values()[name, id(thing)] if _group(thing) == "Values" else getdoc(thing) or ""
    return " ".join(text.split("\n\n")[0].removesuffix(":").removesuffix(":").split())


def _programs(thing: object) -> list[str]:
    """The programs in the docstring of a thing itself; that of a value is its class's."""
    return [] if _group(thing) == "Values" else examples(getdoc(thing))


def _link(path: str, name: str) -> str:
    """A link to where a name is shown."""
    return f"[`{shown(path, name)}`][{path}.{name}]"


def programs_of(path: str) -> Iterator[tuple[str, str]]:
    """The programs on the page of a room, from top to bottom, each after the name whose docstring holds it."""
    names = public_names()[path]
    in_order = [name for group in GROUPS for name in names if _group(names[name]) == group]
    yield from (("", program) for program in examples(getdoc(rooms()[path])))
    yield from ((name, program) for name in in_order for program in _programs(names[name]))


def room_program(path: str) -> str:
    """The program at the top of the page of a room, from which those of names go on."""
    return "\n".join(examples(getdoc(rooms()[path])))


def _documented_programs() -> Iterator[tuple[str, Program]]:
    """The programs of rooms and of names, each after the path of its room and its name; those of rooms come first."""
    for path in rooms():
        short = SHORT[path.partition(".")[0]] + path[len(path.partition(".")[0]) :]
        yield path, Program(f"[`{short}`]({path}.md)", room_program(path))
    for path, names in public_names().items():
        for name, thing in names.items():
            yield f"{path}.{name}", Program(_link(path, name), "\n".join(_programs(thing)), room_program(path))


@cache
def uses() -> dict[str, list[str]]:
    """Links to the programs that use a public name, by name: whole ones, the shortest first, then those of names."""
    public, found = identifiers(), {}
    programs = [*(("", program) for program in written_programs()), *_documented_programs()]
    for owner, program in sorted(programs, key=lambda pair: (bool(pair[1].above), len(pair[1].text))):
        for name in used_in(program.text, public, rooms(), program.above):
            if owner != public[name]:
                found.setdefault(name, []).append(program.link)
    return found


@cache
def _relations() -> Relations:
    return relations({name: thing for names in public_names().values() for name, thing in names.items()})


def _own(name: str) -> bool:
    """Whether the docstring of a name holds a program."""
    path = identifiers()[name].rpartition(".")[0]
    return bool(_programs(public_names()[path][name]))


def has_program(name: str) -> bool:
    """Whether a program uses a name."""
    return name in uses() or _own(name)


def leads_to_program(name: str, steps: int = 2) -> bool:
    """Whether the links of a name lead to a program that uses it, or what returns, takes, raises or holds it."""
    related = {path.partition(".")[0] for kind in _relations() for path in kind.get(name, [])}
    return has_program(name) or (steps > 0 and any(leads_to_program(other, steps - 1) for other in related))


def related(name: str) -> list[str]:
    """Sentences on the functions and classes that a name belongs to, those with programs first."""
    said, paths = [], identifiers()
    words = ("Returned by", "Raised by", "Argument of", "Kinds", "Part of")
    for word, kind in zip(words, _relations(), strict=True):
        others: list[tuple[bool, bool, int, str]] = []
        for other in kind.get(name, []):
            owner, dot, method = other.partition(".")
            room = paths[owner].rpartition(".")[0]
            typed = f"{shown(room, owner)}{dot}{method}"
            far = room.partition(".")[0] != paths[name].partition(".")[0]
            others.append((not has_program(owner), far, typed.count("."), f"[`{typed}`][{room}.{other}]"))
        links = [link for *_, link in sorted(set(others))]
        more = f" and {len(links) - MOST_LINKS} more" if len(links) > MOST_LINKS else ""
        if links:
            said.append(f"{word}: {', '.join(links[:MOST_LINKS])}{more}.")
    return said


def _entry(path: str, name: str) -> list[str]:
    """A name in full, where programs use it, and what it belongs to."""
    shows = f"::: {path}.{name}\n    options: {{heading: {shown(path, name)}}}\n"
    links = uses().get(name, [])[:MOST_LINKS]
    said = [f"In use: {', '.join(links)}."] if links else []
    return [shows, " ".join([*said, *related(name)]) + "\n"]


GO_ON = "The examples of single names below go on from this program.\n"


def _introduction(path: str, names: Mapping[str, object]) -> str:
    """The docstring of a room with its program."""
    text = with_fences(getdoc(rooms()[path]) or "")
    goes_on = "```python" in text and any(_programs(thing) for thing in names.values())
    return linked(text, path) + (f"\n{GO_ON}" if goes_on else "")


def room_page(path: str, names: Mapping[str, object]) -> str:
    """The page of a room: its docstring, its names with a line for each, and each in full, by mkdocstrings."""
    package, _, room = path.partition(".")
    lines = [f"# {SHORT[package]}{room and '.'}{room}", "", _introduction(path, names), ""]
    groups = {group: [n for n in names if _group(names[n]) == group] for group in GROUPS}
    summaries = {n: linked(_summary(n, names[n]), path) for inside in groups.values() for n in inside}
    lines += [f"- {_link(path, n)}: {summary}" for n, summary in summaries.items()]
    for group, inside in groups.items():
        entries = [entry for name in inside for entry in _entry(path, name)]
        lines += ["", f"## {group}", "", *entries] if entries else []
    return PAGE.sub(r"[`\1.md`](../\1.md)", "\n".join(lines) + "\n")
