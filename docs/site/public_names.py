"""Public names by room, and the pages that show them. What several rooms list is shown with the first of them."""

import importlib
from collections.abc import Iterator, Mapping
from functools import cache
from inspect import getdoc, isclass, isroutine
from types import ModuleType

from programs import Program, Relations, examples, relations, used_in, with_fences, written_programs

SHORT = {"jaxeit": "je", "calib": "calib"}
GROUPS = ("Functions", "Classes", "Values", "Errors")
SUBROOMS = ("calib.fitting.logs", "calib.session.importers")
"""Rooms inside of rooms, whose names no other room lists."""


MOST_LINKS = 4


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
    return text + (f"\n{GO_ON}" if goes_on else "")


def room_page(path: str, names: Mapping[str, object]) -> str:
    """The page of a room: its docstring, its names with a line for each, and each in full, by mkdocstrings."""
    package, _, room = path.partition(".")
    lines = [f"# {SHORT[package]}{room and '.'}{room}", "", _introduction(path, names), ""]
    groups = {group: [n for n in names if _group(names[n]) == group] for group in GROUPS}
    lines += [f"- {_link(path, n)}: {_summary(names[n])}" for inside in groups.values() for n in inside]
    for group, inside in groups.items():
        entries = [entry for name in inside for entry in _entry(path, name)]
        lines += ["", f"## {group}", "", *entries] if entries else []
    return "\n".join(lines) + "\n"
