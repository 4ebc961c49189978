"""What is known of contacts over time before they are followed."""

from dataclasses import dataclass, field
from functools import partial

from ..contacts.loads import LoadSettings
from ..imaging.inputs import InverseError
from ..messages.kinds import require_kind
from ..model.fidelity import Fidelity
from ..registry import limited, require_limits

# Moments of the shapes of tips, as `pressure.shape_directions` counts them; ellipses depend on them, and no decision.
# Of a flat tip, a ring and a tilted tip, 36 mm wide, which the pad spreads by 6 mm, those in L2 and L3 are 0.1 to 0.3,
# and the others 0.12 or less.
SHAPE = 0.15
PRECISIONS = ("float32", "float64")


@dataclass(frozen=True)
class TrackerSettings:
    """How contacts move and press, and how closely they are followed.

    | meaning                                                                        | default | unit      |
    |--------------------------------------------------------------------------------|---------|-----------|
    | loads: law of pressure, gain of the contact layer, usual sizes, forces, and shapes, here of 0.15 |  |      |
    | level: standard deviation of the log of the gain that all places share         | 0.3     | 1         |
    | tail: part by which forces on pads may err of what a load twice as wide would change them | 0.3 | 1     |
    | persistence: time over which errors of mesh and load shape stay as they are    | 0.5     | s         |
    | acceleration: change of a contact's velocity                                   | 0.3     | m/s/sqrt(s) |
    | width_rate, force_rate: change of the logs of width and force                  | 0.5, 5  | 1/sqrt(s) |
    | gain_rate: change of the log of the gain during a press, within what was known of it before | 0.1 | 1/sqrt(s) |
    | birth_rate: of contacts anywhere on the skin                                   | 0.5     | 1/s       |
    | most: contacts followed at once                                                | 3       |           |
    | learn: whether contacts teach the gain of the contact layer; otherwise it stays as at the start | True | |
    | forgetting: part of the variance that contacts have taken from the gain which an hour of use gives back | 0 | |
    | unknowns: of the mesh around a contact that are solved anew in each frame      | 96      |           |
    | modes: of the gain around a contact that a frame updates                       | 24      |           |
    | columns: pixels along x of the first order; None: three to the usual width of a load | None |      |
    | pixels: around a contact; 400 of a third of the width reach to 3.75 widths     | 400     |           |
    | fidelity: of the mesh that is solved anew; its first order is the model's      | draft   |           |
    | dtype: of these solutions; errors of float32 are far below noise               | float32 |           |

    Raises:
        InverseError: for a value out of range, or a layer that is not to learn and to forget.
    """

    loads: LoadSettings = field(default_factory=partial(LoadSettings, shape=SHAPE))
    level: float = limited(0.3, above=0)
    tail: float = limited(0.3, least=0)
    persistence: float = limited(0.5, above=0, unit="s")
    acceleration: float = limited(0.3, above=0)
    width_rate: float = limited(0.5, above=0)
    force_rate: float = limited(5.0, above=0)
    gain_rate: float = limited(0.1, least=0)
    birth_rate: float = limited(0.5, above=0)
    most: int = limited(3, least=1)
    learn: bool = True
    forgetting: float = limited(0.0, least=0, below=1)
    unknowns: int = limited(96, least=1)
    modes: int = limited(24, least=1)
    columns: int | None = limited(None, least=1, whole=True)
    pixels: int = limited(400, least=1)
    fidelity: Fidelity = field(default_factory=Fidelity.draft)
    dtype: str = "float32"

    def __post_init__(self) -> None:
        where = "TrackerSettings"
        loads = "an object, such as je.contacts.LoadSettings()"
        require_kind(self.loads, LoadSettings, InverseError, "what is known of loads", loads, where)
        fidelity = "an object, such as je.Fidelity.draft()"
        require_kind(self.fidelity, Fidelity, InverseError, "a fidelity", fidelity, where)
        require_limits(self, InverseError)
        if not isinstance(self.learn, bool):
            raise InverseError(f"{where}: learn is {self.learn!r}; give True or False")
        if self.forgetting and not self.learn:
            raise InverseError(
                f"{where}: forgetting is {self.forgetting:g}, but a layer that is not to learn stays as it is; "
                "leave out learn or forgetting"
            )
        if self.dtype not in PRECISIONS:
            raise InverseError(f"{where}: dtype is {self.dtype!r}; give {' or '.join(map(repr, PRECISIONS))}")
