"""What a search of contacts looks for."""

from dataclasses import dataclass

from ..imaging.inputs import InverseError
from ..registry import limited, require_limits
from ..registry.limits import LONGEST


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

    most: int = limited(3, least=1)
    widths: tuple[float, float] = limited((0.005, 0.03), above=0, most=LONGEST, unit="m", size=2)
    columns: int = limited(41, least=5, most=500)
    false_alarm: float = limited(0.01, above=0, below=0.5)
    model_error: float = limited(0.015, least=0, below=1)
    ratio: float = limited(0.8, least=0)
    separation: float = limited(1.2, least=0)

    def __post_init__(self) -> None:
        require_limits(self, InverseError)
        if not self.widths[0] < self.widths[1]:
            raise InverseError(f"ContactSettings: widths is {self.widths}; give the smallest, then the largest, m")
