"""Facts about a session and its streams, apart from the samples."""

from dataclasses import dataclass
from datetime import datetime

import scipy.sparse as sp
from numpy.typing import ArrayLike, DTypeLike


@dataclass(frozen=True, kw_only=True, eq=False)
class SessionFacts:
    """Facts of a whole session.

    | field             | meaning                                                                    | unit |
    |-------------------|----------------------------------------------------------------------------|------|
    | epoch             | zero of the time axis, with a time zone                                    |      |
    | title, license    | title of the session, one line; its licence                                 |      |
    | skin_name         | name of the skin that was recorded                                         |      |
    | skin_toml         | its description                                                            |      |
    | pattern           | zero-based electrodes drive+, drive-, sense+, sense- of each reading, (M, 4) |    |
    | mixing            | readings as sums of rows of the pattern, (readings, M); None: each row is one |   |
    | current           | amplitude of the stimulation                                               | A    |
    | frequency         | of the stimulation                                                         | Hz   |
    | offset            | when each reading is taken after the frame's time, (readings,)             | s    |
    | simulated         | whether it was simulated; `scene` and `seed` must then say how             |      |
    | scene, seed       | TOML text of the simulated scene, and seed of its noise                    |      |
    | creator           | name and version of the program that made it; default: this one            |      |
    | session_id        | default: a new one                                                         |      |
    | complete          | false: the recording ended early                                           |      |
    | recovered         | true: made whole from what a crash left                                    |      |
    """

    epoch: datetime
    title: str = ""
    license: str = ""
    skin_name: str = ""
    skin_toml: str = ""
    pattern: ArrayLike | None = None
    mixing: sp.csr_array | None = None
    current: float | None = None
    frequency: float | None = None
    offset: ArrayLike | None = None
    simulated: bool = False
    scene: str | None = None
    seed: int | None = None
    creator: str | None = None
    session_id: str | None = None
    complete: bool = True
    recovered: bool = False


@dataclass(frozen=True)
class StreamFacts:
    """Facts of one stream.

    | field                    | meaning                                                       | unit  |
    |--------------------------|---------------------------------------------------------------|-------|
    | variable                 | name of the quantity, such as "voltage"                       |       |
    | units                    | SI unit of the values                                         |       |
    | channels                 | columns                                                       |       |
    | rate_hz                  | nominal sample rate                                           | Hz    |
    | dtype                    | type in which values are stored                               |       |
    | scale_factor, add_offset | packing of integers, ``(value - add_offset) / scale_factor``  | units |
    | long_name                | meaning in words; default: name of the stream and variable    |       |
    | clock                    | clock that the times are of                                   |       |
    | transport                | where the stream came from                                    |       |
    """

    variable: str
    units: str
    channels: int
    rate_hz: float
    dtype: DTypeLike = "f4"
    scale_factor: float | None = None
    add_offset: float | None = None
    long_name: str = ""
    clock: str = "host"
    transport: str = ""
