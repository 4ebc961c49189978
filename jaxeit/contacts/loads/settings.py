"""What is known of loads before a frame."""

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from ...effects import EFFECTS, ContactPiezoresistance
from ...imaging.absolute.background import COATING_LENGTH, COATING_STD
from ...imaging.inputs import InverseError
from ...messages.kinds import require_kind
from ...registry import limited, require_limits
from ...registry.limits import LONGEST

KINDS = 5  # of `LoadKind`
NO_EDGE = (0.25, 0.25, 0.25, 0.0, 0.25)


@dataclass(frozen=True)
class ForceLaw:
    """By what the law that tells forces differs from the law under which loads are fitted; made by `learn_loads`.

    Fits of weak or long loads seldom find their end under a law of a large exponent. So they are made under a gentle
    one, and the forces that they end with are told by this law, to first order.

    | meaning                                                                       | default | shape  |
    |-------------------------------------------------------------------------------|---------|--------|
    | logs: of amplitude, half pressure and exponent, over those of the fits        | 0       | (3,)   |
    | covariance of these logs                                                      | 0       | (3, 3) |
    | variance: of the log of a force, over that which the fit states               | 1       |        |

    Raises:
        InverseError: for numbers that are not finite, or a variance that is not above zero.
    """

    logs: tuple[float, ...] = (0.0, 0.0, 0.0)
    covariance: tuple[tuple[float, ...], ...] = ((0.0, 0.0, 0.0),) * 3
    variance: float = 1.0

    def __post_init__(self) -> None:
        logs, covariance = np.asarray(self.logs, float), np.asarray(self.covariance, float)
        finite = np.isfinite(logs).all() and np.isfinite(covariance).all()
        if logs.shape != (3,) or covariance.shape != (3, 3) or not finite or not 0 < self.variance < np.inf:
            given = f"logs {self.logs}, covariance {self.covariance} and variance {self.variance}"
            raise InverseError(f"{given} are no law of forces; give three finite logs, (3, 3), and a number above zero")

    def __str__(self) -> str:
        amplitude, half_pressure, exponent = (f"{np.exp(log):.3g}" for log in self.logs)
        return (
            f"amplitude times {amplitude}, half_pressure times {half_pressure}, exponent times {exponent}, "
            f"variance times {self.variance:.2g}"
        )


def _length(default: float) -> Any:
    return limited(default, above=0, most=LONGEST, unit="m")


@dataclass(frozen=True)
class LoadSettings:
    """Prior knowledge of loads, and the response of the sheet to pressure.

    | meaning                                                                      | default      | unit |
    |------------------------------------------------------------------------------|--------------|------|
    | law: factor of conductivity by pressure                                      | Hill, 20 kPa |      |
    | forces: by what the law that tells forces differs (`learn_loads`)            | by nothing   |      |
    | gain: standard deviation of the log gain of the contact layer                | 0.12         | 1    |
    | gain_length: over which it changes                                           | 0.015        | m    |
    | texture: standard deviation of the log gain of protrusions and of what loads | 0            | 1    |
    |   are unlike the fit's in, which no number of presses teaches (`learn_loads`) |              |      |
    | texture_length: over which it changes                                        | 0.0075       | m    |
    | coat: standard deviation of the log conductivity that the sheet is not known | see below    | 1    |
    |   by; None: 0 for a sheet given or fitted to a frame, 0.15 for an even one    |              |      |
    | coat_length: over which it changes                                           | 0.03         | m    |
    | depth: of the sheet below the tips in an elastic half-space, by which loads  | None         | m    |
    |   spread (`je.effects.IndentationSpreading`); 0: loads are Gaussian; None:   |              |      |
    |   the same until presses tell another depth                                  |              |      |
    | shape: standard deviation of each moment by which a round load differs from a | 0.1          | 1    |
    |   Gaussian (`pressure.shape_directions`)                                     |              |      |
    | shapes: how many times `shape` the even moments may be, and the odd ones,    | 0, 1, 2, 4,  | 1    |
    |   each as probable as the others, for covariances and the place of a single  | 8            |      |
    |   load (`considered`); a ring has even moments of up to -2/3                 |              |      |
    | model_error: part of the signal by which all else errs                       | 0.005        | 1    |
    | width, width_spread: median of a load's width, standard deviation of its log | 0.012, 0.4   | m, 1 |
    | force, force_spread: median of a force, standard deviation of its log        | 8, 1.2       | N, 1 |
    | width_difference, force_difference: standard deviations of the differences   | 0.2, 0.8     | 1    |
    |   of these logs between loads that press at once                             |              |      |
    | length: standard deviation of half an edge, in each direction; of half the   | 0.02         | m    |
    |   distance of loads, of which half are near one another and half anywhere    |              |      |
    | nearest: distance below which two loads count as one of another shape         | 0.018        | m    |
    | shortest: length below which an edge counts as one load of another shape      | 0.024        | m    |
    | prior: probabilities of the kinds, in the order of `LoadKind`                | 1/5 each     | 1    |

    Raises:
        InverseError: for a value out of range.

    Example:
        settings = je.contacts.LoadSettings(force=5.0)  # N, usual here
        balls = je.contacts.LoadSettings.round_tips()  # nothing long, hollow or tilted touches the skin
    """

    law: ContactPiezoresistance = field(default_factory=ContactPiezoresistance)
    forces: ForceLaw = ForceLaw()
    gain: float = limited(0.12, least=0)
    gain_length: float = _length(0.015)
    texture: float = limited(0.0, least=0)
    texture_length: float = _length(0.0075)
    coat: float | None = limited(None, least=0)
    coat_length: float = _length(COATING_LENGTH)
    depth: float | None = limited(None, least=0, most=LONGEST, unit="m")
    shape: float = limited(0.1, least=0)
    shapes: tuple[float, ...] = limited((0.0, 1.0, 2.0, 4.0, 8.0), least=0)
    model_error: float = limited(0.005, least=0)
    width: float = _length(0.012)
    width_spread: float = limited(0.4, above=0)
    force: float = limited(8.0, above=0, unit="N")
    force_spread: float = limited(1.2, above=0)
    width_difference: float = limited(0.2, above=0)
    force_difference: float = limited(0.8, above=0)
    length: float = _length(0.02)
    nearest: float = _length(0.018)
    shortest: float = _length(0.024)
    prior: tuple[float, float, float, float, float] = limited((0.2, 0.2, 0.2, 0.2, 0.2), least=0, size=KINDS)

    def __post_init__(self) -> None:
        where, an_object = "LoadSettings", "an object, such as je.effects.ContactPiezoresistance()"
        require_kind(self.law, ContactPiezoresistance, InverseError, "a law of pressure", an_object, where)
        require_kind(self.forces, ForceLaw, InverseError, "a law of forces", "that of learn_loads", where)
        require_limits(self, InverseError)
        if not np.isclose(sum(self.prior), 1):
            raise InverseError(f"LoadSettings: prior is {self.prior}; give {KINDS} probabilities whose sum is 1")

    @classmethod
    def round_tips(cls, **others: Any) -> "LoadSettings":
        """Settings for a skin that only round tips touch, no wider than their spread in the skin; ``others`` as usual.

        Nothing is an edge, and the shape of a load is nearly a Gaussian. So what a tilted or a long tip would explain
        is two loads, and two are told apart at smaller distances; hollow and tilted tips may be told as several.
        """
        usual: dict[str, Any] = {"shape": 0.03, "shapes": (0.0, 1.0), "nearest": 8e-3, "prior": NO_EDGE}
        return cls(**usual | others)

    def changed(self) -> str:
        """What differs from the usual settings, in words; empty for the usual ones."""
        own, usual = self._stated(), LoadSettings()._stated()
        return ", ".join(f"{name} = {text}" for name, text in own.items() if text != usual[name])

    def _stated(self) -> dict[str, str]:
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        return {name: str(value) for name, value in values.items()} | {"law": EFFECTS.text(self.law)}

    def coat_spread(self, known: bool) -> float:
        """Standard deviation of the log conductivity that the sheet is not known by."""
        default = 0.0 if known else COATING_STD
        return default if self.coat is None else self.coat
