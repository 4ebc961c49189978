"""What griffe must be told of the source: classes of equinox are dataclasses, and `Name` in a docstring is a link."""

import re
from collections.abc import Iterator

import griffe
from programs import with_fences
from public_names import identifiers

DATACLASS = griffe.Decorator(griffe.ExprName("dataclasses.dataclass"), lineno=None, endlineno=None)
DECLARES = (".parameter", "equinox.field", ".computed", ".limited")
MADE_OF_FIELDS = {"equinox.Module", "typing.NamedTuple"}
PROGRAM = re.compile(r"(```python\n.*?^```$)", re.DOTALL | re.MULTILINE)
NAME = re.compile(r"(?<![`\[])`([A-Za-z]\w*)((?:\.\w+)*)`(?!`)")


def _objects(parent: griffe.Module | griffe.Class) -> Iterator[griffe.Object]:
    for member in parent.members.values():
        if isinstance(member, griffe.Object):
            yield member
            if isinstance(member, griffe.Module | griffe.Class):
                yield from _objects(member)


def _has_fields(cls: griffe.Class) -> bool:
    """Whether a class is a module of equinox or a named tuple."""
    try:
        family = [cls, *cls.mro()]
    except ValueError:
        family = [cls]
    return any(
        isinstance(base, griffe.Expr) and base.canonical_path in MADE_OF_FIELDS for c in family for base in c.bases
    )


def _plain_default(attribute: griffe.Attribute) -> None:
    """Give a field its default alone, in place of the call that declares it."""
    call = attribute.value
    if isinstance(call, griffe.ExprCall) and call.canonical_path.endswith(DECLARES):
        named = {a.name: a.value for a in call.arguments if isinstance(a, griffe.ExprKeyword)}
        plain = [a for a in call.arguments if not isinstance(a, griffe.ExprKeyword)]
        attribute.value = named.get("default", plain[0] if plain else None)


def _joined(text: str) -> str:
    """The text with each row of its tables on one line. A row goes on where its first cell is empty or indented."""
    lines: list[str] = []
    for line in text.splitlines():
        if re.match(r"\|( {2,}|  *\|)", line.strip()) and lines and lines[-1].strip().startswith("|"):
            above, below = ([cell.strip() for cell in row.strip().strip("|").split("|")] for row in (lines[-1], line))
            line = f"| {' | '.join(f'{a} {b}'.strip() for a, b in zip(above, below, strict=True))} |"
            lines.pop()
        lines.append(line)
    return "\n".join(lines)


def _linked(text: str, paths: dict[str, str]) -> str:
    """The text with names in code linked; programs stay as they are."""

    def link(found: re.Match[str]) -> str:
        path = paths.get(found[1])
        return f"[{found[0]}][{path}]" if path else found[0]

    parts = PROGRAM.split(text)
    return "".join(part if part.startswith("```") else NAME.sub(link, part) for part in parts)


class Docstrings(griffe.Extension):
    def on_package(self, *, pkg: griffe.Module, **_: object) -> None:
        paths = identifiers()
        for thing in _objects(pkg):
            if isinstance(thing, griffe.Class) and _has_fields(thing):
                thing.decorators.append(DATACLASS)
            if isinstance(thing, griffe.Attribute):
                _plain_default(thing)
            if thing.docstring:
                text = re.sub(r" ?::$", ":", thing.docstring.value, flags=re.MULTILINE)
                thing.docstring.value = _linked(_joined(with_fences(text)), paths)
