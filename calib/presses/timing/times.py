"""Times of presses: contact, full load, unloading and release.

All times are int64 nanoseconds since the session's epoch. A press is

    t_press    contact begins          ramp     [t_press,   t_hold0)
    t_hold0    full load is reached    hold     [t_hold0,   t_hold1)
    t_hold1    unloading begins        release  [t_hold1,   t_release)
    t_release  contact ends

Functions of this room accept any table with the columns of `PressColumns`: the `PressTable` of a session, or the
`PressTimes` that `find_presses` detects in a force stream. A press that cannot be used stays in the table;
`accepted` is then false and `reason` says why in words.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np


@dataclass(frozen=True, eq=False)
class PressTimes:
    """Times of presses without positions: the time columns of a `PressTable`, one entry per press.

    | field                                | meaning                                        | unit |
    |--------------------------------------|------------------------------------------------|------|
    | t_press, t_hold0, t_hold1, t_release | see the module's text                          | ns   |
    | level                                | median force over the hold                     | N    |
    | accepted, reason                     | whether the press can be used; if not, why     |      |
    """

    t_press: np.ndarray
    t_hold0: np.ndarray
    t_hold1: np.ndarray
    t_release: np.ndarray
    level: np.ndarray
    accepted: np.ndarray
    reason: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.t_press)


@runtime_checkable
class PressColumns(Protocol):
    """The columns that windows, means and samples are computed from."""

    @property
    def t_press(self) -> np.ndarray:
        """Beginning of the contact, (presses,) ns."""

    @property
    def t_hold0(self) -> np.ndarray:
        """Beginning of the full load, (presses,) ns."""

    @property
    def t_hold1(self) -> np.ndarray:
        """Beginning of the unloading, (presses,) ns."""

    @property
    def t_release(self) -> np.ndarray:
        """End of the contact, (presses,) ns."""

    @property
    def accepted(self) -> np.ndarray:
        """Whether a press can be used, (presses,) bool."""

    @property
    def reason(self) -> tuple[str, ...]:
        """Why a press cannot be used; an empty text for an accepted press."""

    def __len__(self) -> int:
        """Number of presses."""


P = TypeVar("P", bound=PressColumns)


def reject(presses: P, reasons: Sequence[str]) -> P:
    """Set `accepted` to false for each press with a non-empty reason. A press keeps the reason it already has."""
    why = tuple(old or new for old, new in zip(presses.reason, reasons, strict=True))
    accepted = presses.accepted & np.array([not r for r in reasons], bool)
    return replace(presses, accepted=accepted, reason=why)  # type: ignore[type-var]


def select(presses: P, rows: np.ndarray) -> P:
    """Some of the presses, in the order of `rows`."""
    columns = {f.name: getattr(presses, f.name) for f in fields(presses)}  # type: ignore[arg-type]
    chosen = {n: tuple(c[i] for i in rows.tolist()) if isinstance(c, tuple) else c[rows] for n, c in columns.items()}
    return replace(presses, **chosen)  # type: ignore[type-var]
