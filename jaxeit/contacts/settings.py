"""What a search of contacts looks for."""

from dataclasses import dataclass

import numpy as np

from ..imaging.noise import InverseError


@dataclass(frozen=True)
class ContactSettings:
    """Which contacts a `ContactFinder` looks for, and when it stops; `prepare_contacts` has the rules.

    | meaning                                                              | default       | unit |
    |----------------------------------------------------------------------|---------------|------|
    | most: largest number of contacts, K                                  | 3             |      |
    | widths: smallest and largest standard deviation of a contact         | 0.005 to 0.03 | m    |
    | columns: nodes of the table along x, from rim to rim                 | 41            |      |
    | false_alarm: fraction of blank frames in which a contact is found    | 0.01          |      |
    | model_error: fraction of the signal that a bump may fail to explain  | 0.015         |      |
    | ratio: fraction of the rest that a further contact must explain      | 0.8           |      |
    | separation: least distance of two contacts, in mean widths           | 1.2           |      |

    A table whose pitch is above the smallest width loses accuracy there.

    Raises:
        InverseError: for a value out of range.
    """

    most: int = 3
    widths: tuple[float, float] = (0.005, 0.03)
    columns: int = 41
    false_alarm: float = 0.01
    model_error: float = 0.015
    ratio: float = 0.8
    separation: float = 1.2

    def __post_init__(self) -> None:
        for name, fine, wanted in (
            ("most", self.most >= 1, "one or more"),
            ("widths", 0 < self.widths[0] < self.widths[1] < np.inf, "smallest and largest, m"),
            ("columns", 5 <= self.columns <= 500, "5 to 500"),
            ("false_alarm", 0 < self.false_alarm < 0.5, "above 0 and below 0.5"),
            ("model_error", 0 <= self.model_error < 1, "0 or more, below 1"),
            ("ratio", 0 <= self.ratio < np.inf, "0 or more"),
            ("separation", 0 <= self.separation < np.inf, "0 or more"),
        ):
            if not fine:
                raise InverseError(f"{name} is {getattr(self, name)}; give {wanted}")
