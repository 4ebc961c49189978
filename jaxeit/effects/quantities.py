"""The quantities that effects act on: motion of the stage, sheet, circuit, series of samples and packets."""

import enum
from typing import NamedTuple, TypeAlias

from jaxtyping import Array, Bool, Float, Int, Key, PyTree


class StreamKind(enum.Enum):
    """The recorded stream that a readout effect disturbs."""

    EIT = "eit"
    PRESSURE = "pressure"
    FORCE = "force"


class Path(NamedTuple):
    """The motion of the stage, press by press.

    | meaning                                    | shape         | unit |
    |--------------------------------------------|---------------|------|
    | places of the tip                          | (presses, 2)  | m    |
    | delay of the press behind its plan         | (presses,)    | s    |
    | pace: speed of its ramps over the planned  | (presses,)    | 1    |
    """

    places: Float[Array, "presses 2"]
    delay: Float[Array, " presses"]
    pace: Float[Array, " presses"]


class Indenter(NamedTuple):
    """An indenter on the skin: its centre, (2,) m, and the diameter of its flat tip, m."""

    centre: Float[Array, "2"]
    diameter: Float[Array, ""]


class Sheet(NamedTuple):
    """The state of the sheet and the places of its elements.

    | meaning                                              | shape         | unit |
    |------------------------------------------------------|---------------|------|
    | sigma: conductivity                                  | (elements,)   | S    |
    | pressure on it                                       | (elements,)   | Pa   |
    | centroids                                            | (elements, 2) | m    |
    | size: side of a square of the element's area         | (elements,)   | m    |
    | temperature above that at which sigma was given      | ()            | K    |
    | share of its area under pressure; None: all of it    | (elements,)   | 1    |
    | metal: conductivity of a coat; None: no coat         | ()            | S    |
    | coupling: contact conductance to the coat            | (elements,)   | S/m^2 |
    """

    sigma: Float[Array, " elements"]
    pressure: Float[Array, " elements"]
    centroids: Float[Array, "elements 2"]
    size: Float[Array, " elements"]
    temperature: Float[Array, ""]
    share: Float[Array, " elements"] | None = None
    metal: Float[Array, ""] | None = None
    coupling: Float[Array, " elements"] | None = None


class Circuit(NamedTuple):
    """The electrical circuit between the terminals of the sheet.

    | meaning                                                           | shape                    | unit |
    |-------------------------------------------------------------------|--------------------------|------|
    | z: potential of a per ampere into b, up to one potential per b    | (electrodes, electrodes) | ohm  |
    | pattern: drive+, drive-, sense+, sense-                           | (readings, 4)            |      |
    | current                                                           | ()                       | A    |
    """

    z: Float[Array, "electrodes electrodes"]
    pattern: Int[Array, "readings 4"]
    current: Float[Array, ""]


class HistoryInputs(NamedTuple):
    """The inputs of a history effect besides its series.

    | meaning                                                       | shape         | unit |
    |---------------------------------------------------------------|---------------|------|
    | key of all chance in this block                               | ()            |      |
    | interval between samples                                      | ()            | s    |
    | temperature of the air above that at the start                | (time,)       | K    |
    | barometer: air pressure above that at the start               | (time,)       | Pa   |
    | pattern of the EIT stream; no rows elsewhere, nor of a protocol of matrices | (channels, 4) | |
    """

    key: Key[Array, ""]
    interval: Float[Array, ""]
    temperature: Float[Array, " time"]
    barometer: Float[Array, " time"]
    pattern: Int[Array, "channels 4"]


class Packets(NamedTuple):
    """The samples of a block between the device and the host.

    | meaning                                        | shape   | unit |
    |------------------------------------------------|---------|------|
    | device: when taken, by the clock of the device | (time,) | s    |
    | host: when received, by that of the host       | (time,) | s    |
    | lost on the way                                | (time,) |      |
    """

    device: Float[Array, " time"]
    host: Float[Array, " time"]
    lost: Bool[Array, " time"]


# A block of a series of samples, and the state that a history effect keeps between blocks.
Series = Float[Array, "time channels"]
State: TypeAlias = PyTree[Array]
