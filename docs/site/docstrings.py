"""What griffe must be told of the source: classes of equinox are dataclasses, and `Name` in a docstring is a link.

Fields in tables are shown as code, numbers in place of the constants that hold them, enumerations with their members.
"""

import re
from collections.abc import Iterator
from contextlib import suppress

import griffe
from programs import with_fences
from public_names import PAGE, linked

DATACLASS = griffe.Decorator(griffe.ExprName("dataclasses.dataclass"), lineno=None, endlineno=None)
DECLARES = (".parameter", "equinox.field", ".computed", ".limited", ".metres", "._limit")
MADE_OF_FIELDS = {"equinox.Module", "typing.NamedTuple"}
ENUMERATIONS = {"enum.Enum", "enum.IntEnum", "enum.IntFlag"}
FIRST_CELL = re.compile(r"\| *(\w+(?:, \w+)*)")


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
        absent = "None" if call.canonical_path.endswith(".computed") else None
        attribute.value = named.get("default", plain[0] if plain else absent)


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


def _marked(text: str, fields: set[str]) -> str:
    """The text with the fields with which rows of its tables begin as code."""

    def mark(found: re.Match[str]) -> str:
        words = found[1].split(", ")
        count = next((k for k, word in enumerate(words) if word not in fields), len(words))
        return f"| {', '.join([*(f'`{word}`' for word in words[:count]), *words[count:]])}"

    return "\n".join(FIRST_CELL.sub(mark, line, count=1) if line[:1] == "|" else line for line in text.splitlines())


def _members(enumeration: griffe.Class) -> str:
    """The members of an enumeration with their values, and with the comments beside them."""
    members = [m for m in enumeration.members.values() if isinstance(m, griffe.Attribute) and m.value]
    comments = [m.source.partition("  # ")[2] for m in members]
    rows = [f"| `{m.name}` | `{m.value}` | {comment} |" for m, comment in zip(members, comments, strict=True)]
    meant = any(comments)
    head = "\n\n| member | value | meaning |\n|---|---|---|\n" if meant else "\n\n| member | value |\n|---|---|\n"
    return head + "\n".join(rows if meant else [row.removesuffix("  |") + "|" for row in rows])


def _values_for_constants(function: griffe.Function) -> None:
    """Give parameters the numbers that the constants in their defaults hold."""
    for parameter in function.parameters:
        if isinstance(parameter.default, griffe.ExprName):
            with suppress(griffe.GriffeError, KeyError):
                held = function.modules_collection[parameter.default.canonical_path]
                if isinstance(held, griffe.Alias):
                    held = held.final_target
                if isinstance(held, griffe.Attribute) and re.fullmatch(r"-?[\d_.e-]+", str(held.value)):
                    parameter.default = str(held.value)


class Docstrings(griffe.Extension):
    def on_package(self, *, pkg: griffe.Module, **_: object) -> None:
        for thing in _objects(pkg):
            if isinstance(thing, griffe.Class) and _has_fields(thing):
                thing.decorators.append(DATACLASS)
            if isinstance(thing, griffe.Attribute):
                _plain_default(thing)
            if isinstance(thing, griffe.Function):
                _values_for_constants(thing)
            if thing.docstring:
                text = re.sub(r" ?::$", ":", thing.docstring.value, flags=re.MULTILINE)
                text = linked(_joined(with_fences(text)), thing.module.path)
                text = PAGE.sub(r'<a href="../\1.html">`\1.md`</a>', text).replace("/README.html", "/index.html")
                if isinstance(thing, griffe.Class):
                    text = _marked(text, set(thing.members))
                    named = {base.canonical_path for base in thing.bases if isinstance(base, griffe.Expr)}
                    text += _members(thing) if named & ENUMERATIONS else ""
                thing.docstring.value = text
