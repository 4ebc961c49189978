"""Programs of the documentation, the public names that they use, and how other names are related to these."""

import ast
import re
from collections.abc import Iterable, Iterator, Mapping
from inspect import getdoc, isclass, isroutine, signature
from pathlib import Path
from textwrap import dedent
from types import FunctionType
from typing import NamedTuple, get_args, get_origin

ROOT = Path(__file__).parents[2]
PACKAGES = {"je": "jaxeit", "jaxeit": "jaxeit", "calib": "calib"}
PROGRAM = re.compile(r"^( *)```python.*?\n(.*?)^\1```", re.DOTALL | re.MULTILINE)
EXAMPLE = re.compile(r"^Example:(.*)\n((?:\n*^ +\S.*\n?)+)", re.MULTILINE)
"""A section of a docstring; its indented lines are a program."""

WRAPPED = ("__func__", "fget", "func")
"""Where class methods, properties and cached properties keep their function."""

RAISED = re.compile(r"^Raises:\n((?:\n*^ +\S.*\n?)+)", re.MULTILINE)
ERRORS = re.compile(r"^ {2,4}((?:\w+, )*\w+):", re.MULTILINE)


class Program(NamedTuple):
    """A program, the Markdown of a link to it from the pages of names, and the program that it goes on from."""

    link: str
    text: str
    above: str = ""


def examples(docstring: str | None) -> list[str]:
    """The programs in the sections Example of a docstring."""
    return [dedent(text).strip("\n") + "\n" for _, text in EXAMPLE.findall(docstring or "")]


def with_fences(docstring: str) -> str:
    """A docstring whose sections Example are Markdown."""

    def fenced(section: re.Match[str]) -> str:
        title = f"Example, {section[1].strip()}:" if section[1].strip() else "Example:"
        return f"**{title}**\n\n```python\n{dedent(section[2]).strip()}\n```\n"

    return EXAMPLE.sub(fenced, docstring)


def _aliases(tree: ast.AST) -> dict[str, tuple[str, ...]]:
    """Names that stand for a package of ours or a part of one, by the imports of a program, and the parts of each."""
    known: dict[str, tuple[str, ...]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            inside = tuple((node.module or "").split("."))
            known |= {name.asname or name.name: (*inside, name.name) for name in node.names}
        if isinstance(node, ast.Import):
            known |= {name.asname: tuple(name.name.split(".")) for name in node.names if name.asname}
    return {name: parts for name, parts in known.items() if parts[0] in PACKAGES.values()}


def _dotted(node: ast.AST) -> tuple[str, ...]:
    """The parts of ``a.b.c``; nothing for another expression."""
    if isinstance(node, ast.Name):
        return (node.id,)
    inner = _dotted(node.value) if isinstance(node, ast.Attribute) else ()
    return (*inner, node.attr) if inner and isinstance(node, ast.Attribute) else ()


def dotted_names(program: str, above: str = "") -> set[tuple[str, ...]]:
    """Paths of what a program uses of our packages, such as ``("jaxeit", "Fidelity", "draft")``.

    Args:
        above: the program that this one goes on from, whose imports hold here too.
    """
    tree = ast.parse(program)
    own = _aliases(tree)
    aliases = {name: (package,) for name, package in PACKAGES.items()} | _aliases(ast.parse(above)) | own
    dotted = {parts for node in ast.walk(tree) if (parts := _dotted(node)) and parts[0] in aliases}
    return {path for path in own.values() if len(path) > 1} | {aliases[parts[0]] + parts[1:] for parts in dotted}


def used_in(program: str, public: Iterable[str], rooms: Iterable[str], above: str = "") -> set[str]:
    """Public names that a program uses: ``je.prepare``, ``je.Fidelity.draft``, or imported ones."""
    names, inside = set(public), sorted((tuple(room.split(".")) for room in rooms), key=len, reverse=True)
    found = set()
    for path in dotted_names(program, above):
        outside = next(len(room) for room in inside if path[: len(room)] == room)
        found |= {*[part for part in path[outside:] if part in names][:1]}
    return found


def written_programs() -> Iterator[Program]:
    """The programs of the examples and of the pages, which tests run."""
    for path in sorted(ROOT.glob("examples/*.py")):
        yield Program(f"[{path.stem}](../examples/README.md#{path.stem})", path.read_text(encoding="utf-8"))
    for path in [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]:
        text = path.read_text(encoding="utf-8")
        blocks = [dedent(indent + block) for indent, block in PROGRAM.findall(text)]
        title = text.partition("\n")[0].lstrip("# ")
        yield Program(f"[{title}](../{path.relative_to(ROOT)})", "\n".join(blocks))


def _annotated(annotation: object, known: Mapping[str, type]) -> set[str]:
    """Names of the known classes in an annotation. What is a text stands for the classes of its words."""
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__forward_arg__", "")
    parts = annotation if isinstance(annotation, list | tuple) else (get_origin(annotation), *get_args(annotation))
    inside = (_annotated(part, known) for part in parts if part is not None)
    own = {name for name, kind in known.items() if kind is annotation}
    return own.union(known.keys() & set(re.findall(r"\w+", text)), *inside)


def _functions(name: str, thing: object) -> Iterator[tuple[str, FunctionType]]:
    """The name and the function itself, or of a class its own methods; those that have no entry, as the class."""
    if isclass(thing):
        for method, found in vars(thing).items():
            inner = next((getattr(found, part) for part in WRAPPED if getattr(found, part, None)), found)
            own = isroutine(inner) and inner.__qualname__.startswith(f"{name}.")
            if own and (method == "__call__" or not method.startswith("_")):
                shown = inner.__doc__ and method != "__call__"
                yield f"{name}.{method}" if shown else name, inner
    elif callable(thing):
        yield name, thing


def _signature(function: object) -> tuple[list[object], object]:
    """Annotations of the parameters and of the result."""
    try:
        found = signature(function)
    except (TypeError, ValueError):
        return [], ""
    return [parameter.annotation for parameter in found.parameters.values()], found.return_annotation


class Relations(NamedTuple):
    """For public names, the names related to each; methods have the names of their classes before them."""

    returned: dict[str, list[str]]
    raised: dict[str, list[str]]
    taken: dict[str, list[str]]
    kinds: dict[str, list[str]]
    field: dict[str, list[str]]


def relations(public: Mapping[str, object]) -> Relations:
    """What returns or takes a class, what raises an error, which classes a base has, and which hold another."""
    classes = {name: thing for name, thing in public.items() if isclass(thing)}
    found = Relations({}, {}, {}, {}, {})
    for name, thing in public.items():
        for path, function in _functions(name, thing):
            given, result = _signature(function)
            for kind, annotations in ((found.returned, [result]), (found.taken, given)):
                for other in sorted(set().union(*(_annotated(a, classes) for a in annotations)) - {name}):
                    kind.setdefault(other, []).append(path)
        if isclass(thing):
            for other in sorted(set().union(*(_annotated(a, classes) for a in _signature(thing)[0])) - {name}):
                found.field.setdefault(other, []).append(name)
            for base in {b.__name__ for b in thing.__mro__[1:] if public.get(b.__name__) is b}:
                found.kinds.setdefault(base, []).append(name)
        documented = {path: getdoc(f) or "" for path, f in [*_functions(name, thing), (name, thing)]}
        for path, text in documented.items():
            named = ", ".join(names for section in RAISED.findall(text) for names in ERRORS.findall(section))
            for error in set(named.split(", ")) - {""}:
                found.raised.setdefault(error, []).append(path)
    return found
