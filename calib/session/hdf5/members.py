"""Members of a session file that are read whole: checked columns, small arrays and units."""

import numpy as np

from ..errors import printable, problem
from ..units import KNOWN_UNITS, UNITS, VARIABLE_UNIT, Unit
from .chunks import GuardedArray
from .guard import Node, translated

SCHEMA = "see data/schema/README.md"


def required(parent: Node, name: str, node: Node | None) -> Node:
    """`node`, or a `SessionError` that says that `name` is missing."""
    if node is None:
        where = f"{parent.where.rstrip('/')}/{name}"
        raise problem(parent.path, where, "missing", SCHEMA)
    return node


def small_array(node: Node, shape: tuple[int | None, ...], kinds: str) -> np.ndarray:
    """A whole small array of the given shape (None for any length) and of one of the NumPy `kinds`."""
    array = GuardedArray(node)
    fits = len(array.shape) == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in kinds:
        want = "(" + ", ".join("rows" if n is None else str(n) for n in shape) + ")"
        raise node.error(f"is {array.dtype} of shape {array.shape}", f"write shape {want}; {SCHEMA}")
    node.require("table_rows", (array.shape or (1,))[0])
    return array.read()


def declared_unit(node: Node, variable: str) -> Unit:
    """The unit that a dataset declares. Unknown units, and units of another quantity than `variable`, are refused."""
    name = node.text("units")
    if name not in UNITS:
        raise node.error(f"units {printable(name)!r} are not known", f"use one of: {KNOWN_UNITS}")
    expected = VARIABLE_UNIT.get(variable, UNITS[name].si)
    if UNITS[name].si != expected:
        what = f"{variable} in {name} is mislabelled"
        raise node.error(what, f"use units of {expected}, or another variable name")
    return UNITS[name]


def column(node: Node, name: str, dtype: str) -> np.ndarray | tuple[str, ...]:
    """One column of a table: numbers of `dtype` in SI, or texts."""
    member = required(node, name, node.dataset(name))
    kinds = {"f": "fiu", "S": "S"}.get(dtype[0], "iu")
    values = small_array(member, (None,), kinds)
    if dtype == "S":
        with translated(node.path, member.where):
            return tuple(v.decode() for v in values.tolist())
    if name != "reason" and dtype[0] == "f":
        unit = declared_unit(member, "")
        return values * unit.factor + unit.offset
    return values.astype(dtype)
