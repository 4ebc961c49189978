"""What is wrong with a simulated recording, one number for each fault; without arguments only noise is left."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Faults:
    """Faults of skin, pads and bench.

    | meaning                                                                                       |
    |-----------------------------------------------------------------------------------------------|
    | crosstalk: share of a pad's pressure that every other pad shows                               |
    | misplaced: standard deviation of the bolts' places along x and y, m                           |
    | shape: of the tip: flat, hertz, ring, tilted or ellipse; tip: its diameter, m                 |
    | hysteresis: widest opening of a pad's loop over 20 N                                          |
    | creep: growth per decade of time of contact conductance, and share of the pads' load that     |
    | comes late                                                                                    |
    | coating: standard deviation of the log of the sheet's conductance                             |
    | scatter: standard deviation of the log of the protrusions' loads of first touch and gains     |
    | drift: slow changes of baselines, in multiples of a usual bench's                             |
    | temperature: amplitude of its swing, K                                                        |
    | noise: of all sensors, in multiples of a usual bench's                                        |
    | moved_gain, moved_offset: change of the pads since the skin was made: of the log of their     |
    | gains, and of their offsets in Pa (standard deviations; every later session of a skin has the |
    | same change); moved_layer: change of the log of the protrusions' gains, one number            |
    """

    crosstalk: float = 0.0
    misplaced: float = 0.0
    shape: str = "flat"
    tip: float = 0.02
    hysteresis: float = 0.0
    creep: float = 0.0
    coating: float = 0.0
    scatter: float = 0.1
    drift: float = 1.0
    temperature: float = 0.0
    noise: float = 1.0
    moved_gain: float = 0.0
    moved_offset: float = 0.0
    moved_layer: float = 0.0
