"""What one command may ask of the machine: every limit of size stands here, and is asked before memory is allocated.

A file or a device can claim any size. Whoever allocates by such a claim calls `require` first. The limits fit a machine
with 8 GB of memory; the environment variable `JAXEIT_BUDGET` multiplies all of them on a larger or a smaller one.
"""

import os
from dataclasses import dataclass, field, fields, replace
from typing import Any

VARIABLE = "JAXEIT_BUDGET"
"""Environment variable: the factor by which all limits are multiplied."""

OR_RAISE = f"or raise all limits with {VARIABLE}=4"
"""What a user can do about every limit."""


class BudgetError(ValueError):
    """More is asked for than the budget allows; the message says what, where, how much, the limit, and what to do.

    Example:
        try:
            je.discretise(je.Scene(skin), je.Fidelity(edge_length=1e-4))
        except je.BudgetError as error:
            print(error)
    """


def _limit(default: int, unit: str, todo: str) -> Any:
    """A limit, with the words of its refusal: what is counted, and what a user can do about it."""
    return field(default=default, metadata={"unit": unit, "todo": todo})


@dataclass(frozen=True)
class Budget:
    """Limits of size, for one text, file, array, skin or model each.

    | limit           | of                                                                      |
    |-----------------|-------------------------------------------------------------------------|
    | text_bytes      | a TOML text                                                             |
    | array_bytes     | one array in memory, such as a stream that is read whole, or a factor   |
    | file_bytes      | all arrays of a file together, as they would be in memory               |
    | table_rows      | a table that is read whole: presses, events, knots of a clock           |
    | channels        | a stream                                                                |
    | blend_channels  | a log whose force is blended from all products of two channels          |
    | electrodes      | a skin                                                                  |
    | corners         | the outline of a sheet, an electrode or a pad                           |
    | sites           | a simulated bench                                                       |
    | coefficients    | the basis of an image                                                   |
    | mesh_nodes      | a mesh                                                                  |
    | import_text     | a text file to import, unpacked, bytes                                  |
    | import_rows     | a table to import                                                       |
    | import_numbers  | all files of an import together                                         |
    | child_bytes     | address space of the process that reads a foreign binary file           |
    | child_seconds   | time of that process                                                    |

    Example:
        limits = je.Budget()
        # the second with JAXEIT_BUDGET=4 in the environment
        print(limits.mesh_nodes, limits.scaled(4).mesh_nodes)
    """

    text_bytes: int = _limit(1 << 20, "bytes of text", "describe less, such as outlines of fewer corners")
    array_bytes: int = _limit(2 << 30, "bytes at once", "use less of it, such as a shorter recording or fewer readings")
    file_bytes: int = _limit(64 << 30, "bytes of arrays", "split the recording into shorter sessions")
    table_rows: int = _limit(1 << 20, "rows", "split the table")
    channels: int = _limit(100_000, "channels", "record fewer channels in a stream")
    blend_channels: int = _limit(128, "channels to blend", "import fewer channels, those near the contact")
    electrodes: int = _limit(1024, "electrodes", "describe fewer")
    corners: int = _limit(10_000, "corners of one outline", "describe it by fewer")
    sites: int = _limit(1 << 20, "places to press", "simulate fewer at a time")
    coefficients: int = _limit(100_000, "coefficients of an image", "choose fewer pixels or bumps")
    mesh_nodes: int = _limit(500_000, "mesh nodes", "choose a coarser fidelity, and check that lengths are in metres")
    import_text: int = _limit(4 << 30, "bytes of text, unpacked", "split the recording into shorter ones")
    import_rows: int = _limit(20_000_000, "rows", "split the recording into shorter ones")
    import_numbers: int = _limit(100_000_000, "numbers in one import", "name fewer columns, or split the recording")
    child_bytes: int = _limit(4 << 30, "bytes of memory", "split the recording into shorter ones")
    child_seconds: int = _limit(300, "seconds", "split the recording into shorter ones")

    def scaled(self, factor: float) -> "Budget":
        """All limits times a factor."""
        return replace(self, **{f.name: int(getattr(self, f.name) * factor) for f in fields(self)})

    def excess(self, limit: str, asked: float) -> tuple[str, str] | None:
        """None within the limit of that name; beyond it, what is too large, and what to do."""
        allowed = getattr(self, limit)
        if asked <= allowed:
            return None
        words = self.__dataclass_fields__[limit].metadata
        what = f"{asked:,.0f} {words['unit']}, the limit is {allowed:,}"
        return what, f"{words['todo']}, {OR_RAISE}"


def current_budget() -> Budget:
    """The default limits times the factor in `JAXEIT_BUDGET`.

    Raises:
        BudgetError: if the variable is not a number above zero.
    """
    text = os.environ.get(VARIABLE, "1")
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not 0 < factor < 1e6:
        raise BudgetError(f"{VARIABLE} is {text[:20]!r}; give the factor by which limits are multiplied, such as 4")
    return Budget() if factor == 1 else Budget().scaled(factor)


def require(limit: str, asked: float, where: str, error: type[ValueError] = BudgetError) -> None:
    """Raise `error`, which begins with `where`, if more is asked for than the limit of that name allows."""
    beyond = current_budget().excess(limit, asked)
    if beyond:
        raise error(f"{where}: {beyond[0]}; {beyond[1]}")
