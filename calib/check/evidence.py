"""Changes of all streams during the presses of a recording, for the checks that compare streams with each other."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..presses.corrections import WindowMeans
from ..presses.means import hold_positions, press_means
from ..presses.timing.times import PressColumns, select
from ..presses.timing.windows import PressWindows
from ..session import PressTable, Stream

MAX_COMPARED_PRESSES = 40  # whose frames are read, spread over the recording, because frames are long


@dataclass(frozen=True, eq=False)
class PressEvidence:
    """Changes over the holds of the accepted presses; rows are those presses.

    | field       | meaning                                                          | shape               | unit |
    |-------------|------------------------------------------------------------------|---------------------|------|
    | presses     | all presses, with those that lack samples set aside              |                     |      |
    | windows     | windows of all presses                                           |                     |      |
    | number      | row of the press in the table                                    | (rows,)             |      |
    | site        | place of the tip; None: not known                                | (rows, 2)           | m    |
    | force       | change of the load cell; None: no force stream                   | (rows,)             | N    |
    | pressure    | change of the columns; None: no pressure stream                  | (rows, columns)     | Pa   |
    | arriving    | reads the same over the second half of the ramp, before the tip  | (rows, columns)     | Pa   |
    |             | slides; None: no pressure stream                                 |                     |      |
    | seen        | rows whose frames were read                                      | (seen,)             |      |
    | eit         | change of their frames with standard errors; None: no EIT stream | (seen, readings)    | V    |
    | rests       | mean frame of the rest before each of them; None: no EIT stream  | (seen, readings)    | V    |
    """

    presses: PressColumns
    windows: PressWindows
    number: np.ndarray
    site: np.ndarray | None
    force: np.ndarray | None
    pressure: np.ndarray | None
    arriving: Callable[[], np.ndarray] | None
    seen: np.ndarray
    eit: WindowMeans | None
    rests: np.ndarray | None

    @property
    def times(self) -> np.ndarray:
        """Times at which the presses of the rows begin, (rows,) ns."""
        return np.asarray(np.asarray(self.presses.t_press)[self.number])

    @property
    def tip_diameter(self) -> np.ndarray:
        """Diameter of the tip in each row, (rows,) m; 0 where the recording has no table of presses."""
        known = getattr(self.presses, "tip_diameter", np.zeros(len(self.presses.t_press)))
        return np.asarray(np.asarray(known, float)[self.number])

    def compared(self) -> tuple[PressColumns, PressWindows]:
        """The presses whose frames were read, and their windows."""
        return _chosen(self.presses, self.windows, self.number[self.seen])


def gather_evidence(streams: Mapping[str, Stream], presses: PressColumns, windows: PressWindows) -> PressEvidence:
    """Means over the holds of the accepted presses, without their rests; of at most so many presses for the frames."""
    number = np.flatnonzero(presses.accepted)
    seen = np.unique(np.linspace(0, len(number) - 1, min(len(number), MAX_COMPARED_PRESSES)).astype(int))
    _, within = _chosen(presses, windows, number)
    change = {n: press_means(streams[n], within).change.mean for n in ("force", "pressure") if n in streams}
    eit = press_means(streams["eit"], _chosen(presses, windows, number[seen])[1]) if "eit" in streams else None
    force = change.get("force")
    return PressEvidence(
        presses=presses,
        windows=windows,
        number=number,
        site=_sites(streams, presses, number),
        force=None if force is None else force[:, 0],
        pressure=change.get("pressure"),
        arriving=partial(_arriving, streams["pressure"], within) if "pressure" in streams else None,
        seen=seen,
        eit=None if eit is None else eit.change,
        rests=None if eit is None else eit.rest,
    )


def _arriving(pressure: Stream, windows: PressWindows) -> np.ndarray:
    """Mean change over the second half of each ramp, (rows, columns) Pa; few checks ask for it."""
    begin, end = windows.ramp.T
    late = replace(windows, hold=np.stack([begin + (end - begin) // 2, end], 1))
    return np.asarray(press_means(pressure, late).change.mean)


def _chosen(presses: PressColumns, windows: PressWindows, rows: np.ndarray) -> tuple[PressColumns, PressWindows]:
    """Some of the presses, with windows that take all presses into account."""
    return select(presses, rows), windows.rows(rows)


def _sites(streams: Mapping[str, Stream], presses: PressColumns, rows: np.ndarray) -> np.ndarray | None:
    """Places from the table, or from the stage over the holds."""
    if isinstance(presses, PressTable):
        return np.asarray(np.stack([presses.x, presses.y], 1)[rows])
    stage = streams.get("stage")
    if stage is None or stage.channels < 2:
        return None
    place = hold_positions(select(presses, rows), stage)[:, :2]
    return np.asarray(place) if np.isfinite(place).all() else None
