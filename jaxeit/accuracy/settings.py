"""The input of a ladder: fidelities and imaging methods to compare, and the touches that define their errors."""

from dataclasses import dataclass, field, replace

import numpy as np

from ..imaging.methods import NonNegative, SparseBayes
from ..imaging.settings import Imaging
from ..linalg import ConjugateGradient, NestedDissection, Single
from ..model.bases import Pixels
from ..model.fidelity import Fidelity
from ..skin.description import Skin


class LadderError(ValueError):
    """Rungs that cannot be compared, or a limit that no rung meets; the message says what to change.

    Example:
        try:
            table.recommend(error=1e-9)
        except accuracy.LadderError as error:
            print(error)
    """


@dataclass(frozen=True)
class Touch:
    """A contact: a Gaussian bump of pressure, or of conductivity if no effect of the scene depends on pressure.

    | meaning                                                     | unit |
    |-------------------------------------------------------------|------|
    | name                                                        |      |
    | position of the centre in the sheet's flat coordinates      | m    |
    | width: standard deviation                                   | m    |
    | pressure at the centre                                      | Pa   |
    | rise: relative change of conductivity at the centre, for a scene without such an effect | 1 |
    """

    name: str
    position: tuple[float, float]
    width: float
    pressure: float = 5e4
    rise: float = 0.5

    def __post_init__(self) -> None:
        if not (np.isfinite(self.position).all() and self.width > 0 and self.pressure > 0 and self.rise > 0):
            raise LadderError(f"{self}: give a finite position, and width, pressure and rise above zero")


@dataclass(frozen=True, eq=False)
class Choice:
    """A fidelity and an imaging method with a label; ``imaging`` None: no images are made."""

    label: str
    fidelity: Fidelity
    imaging: Imaging | None = field(default_factory=Imaging)


def few_choices() -> tuple[Choice, ...]:
    """Rungs for a first comparison, which takes less than a minute."""
    return (
        Choice("draft", Fidelity.draft()),
        Choice("draft f32", Fidelity.draft(dtype=np.float32), None),
    )


def fidelity_choices() -> tuple[Choice, ...]:
    """Rungs over edge length, order, precision and solver; some have images, which differ little between rungs.

    Example:
        # what je.ladder compares by default
        everything = accuracy.fidelity_choices() + accuracy.image_choices()
        quick = accuracy.few_choices()  # in less than a minute
        print(len(everything), "rungs, or", len(quick))
    """
    draft, standard, reference = Fidelity.draft, Fidelity.standard, Fidelity.reference
    single = Single(NestedDissection())
    named = {
        "coarse P2": draft(edge_length=0.12, order=2),
        "draft": draft(),
        "draft f32": draft(dtype=np.float32),
        "draft P2": draft(order=2),
        "draft P2 f32": draft(order=2, dtype=np.float32),
        "standard": standard(),
        "standard f32": standard(dtype=np.float32),
        "standard cg": standard(solver=ConjugateGradient(single)),
        "standard P2": standard(order=2),
        "standard P2 f32": standard(order=2, dtype=np.float32),
        "standard P2 f32 solve": standard(order=2, solver=single),
        "fine": reference(order=1),
        "reference f32": reference(dtype=np.float32),
        "reference": reference(),
    }
    images = {
        label: Imaging() for label in ("draft", "draft P2", "standard", "standard f32", "standard P2", "reference")
    }
    return tuple(Choice(label, fidelity, images.get(label)) for label, fidelity in named.items())


def image_choices() -> tuple[Choice, ...]:
    """Rungs over the number of pixels and the imaging method, at the standard fidelity."""
    settings = {
        "20 pixels": Imaging(Pixels(20)),
        "80 pixels": Imaging(Pixels(80)),
        "non-negative": Imaging(method=NonNegative()),
        "sparse Bayes": Imaging(method=SparseBayes()),
    }
    return tuple(Choice(label, Fidelity.standard(), imaging) for label, imaging in settings.items())


def default_touches(skin: Skin) -> tuple[Touch, ...]:
    """Touches at the typical places: mid-pad, near a pad's edge, near the rim, between two electrodes.

    Their width is a twentieth of the square root of the sheet's area: 10 mm on the testbed.
    """
    width, middle = 0.05 * np.sqrt(skin.domain.area), np.mean(skin.domain.bounds, 0)
    places = {"middle": middle} | _on_pad(skin, middle) | {"by the rim": _by_the_rim(skin, middle)}
    places["between electrodes"] = _between_electrodes(skin, middle)
    inside = {name: tuple(place.tolist()) for name, place in places.items() if skin.domain.contains(place[None])[0]}
    return tuple(Touch(name, place, float(width)) for name, place in inside.items())


def _on_pad(skin: Skin, middle: np.ndarray) -> dict[str, np.ndarray]:
    if not skin.pads:
        return {}
    corners = skin.pads[0].outline
    centre, sides = corners.mean(0), (corners + np.roll(corners, -1, 0)) / 2
    side = sides[np.argmin(np.round(np.linalg.norm(sides - middle, axis=1), 9))]
    return {"middle": centre, "by a pad's edge": side + (centre - side) / 8}


def _by_the_rim(skin: Skin, middle: np.ndarray) -> np.ndarray:
    """The first place along the rim, a tenth of the way from the rim to the middle, that lies on the sheet."""
    rim = skin.domain.boundary_point(np.linspace(0.3, 1.3, 20, endpoint=False) * skin.domain.perimeter)
    places = rim + (middle - rim) / 10
    return np.asarray(places[np.argmax(skin.domain.contains(places))])


def _between_electrodes(skin: Skin, middle: np.ndarray) -> np.ndarray:
    """The midpoint of two neighbouring electrodes that is nearest to the middle of the sheet."""
    at = skin.electrode_positions
    first, second = np.triu_indices(len(at), 1)
    apart = np.round(np.linalg.norm(at[first] - at[second], axis=1), 9)
    halfway = ((at[first] + at[second]) / 2)[apart <= 1.01 * apart.min()]
    return np.asarray(halfway[np.argmin(np.round(np.linalg.norm(halfway - middle, axis=1), 9))])


def refined(fidelity: Fidelity, factor: float) -> Fidelity:
    """``factor`` times finer everywhere, with more electrode segments in proportion and a growth rate to match.

    Quadratic elements in float64: the family of the reference.
    """
    return replace(
        fidelity,
        edge_length=fidelity.edge_length / factor,
        electrode_segments=_sides(fidelity.electrode_segments * factor),
        growth=max(1.05, fidelity.growth ** (1 / factor)),
        order=2,
        dtype=np.float64,
        solver=None,
    )


def _sides(least: float) -> int:
    """The next number of polygon sides that a mesh can halve repeatedly to 6 to 12: 6 to 12 times a power of two."""
    power = int(2 ** max(0, int(np.floor(np.log2(least / 6)))))
    return max(6, round(least / power)) * power
