"""In which order, and with which signs, do the readings come? Answered by comparison with a model.

Every four-terminal reading is a difference of four entries of the skin's transfer matrix, so one
solve predicts the frame under any numbering of electrodes and any order of readings.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxeit as je

_AS_IS_ENOUGH = 0.95  # a uniform sheet reaches 0.99 on healthy sessions; two swapped bolts 0.93 at most
_SHRINKS = 1 / 3  # what a better order must leave of 1 - correlation
_CONVINCING = 0.7
_LATEST, _SWAPPED = 4096, 64  # readings and electrodes tried, so that large skins are checked in seconds
_TIE = 0.005  # a simpler explanation this close to the best is preferred


def transfer_matrix(skin: je.Skin) -> np.ndarray:
    """Potential of each electrode per ampere into each other one, electrode 0 grounded.

    Of the untouched, uniform sheet at draft fidelity, in JAX's default precision.

    Returns:
        (electrodes, electrodes) ohm, symmetric.

    Raises:
        ValueError: if the skin cannot be meshed.
    """
    count = len(skin.electrodes)
    row = np.repeat(np.arange(1, count), count - 1)
    column = np.tile(np.arange(1, count), count - 1)
    ground = np.zeros_like(row)
    protocol = je.Protocol(np.stack([row, ground, column, ground], 1), 1.0)
    fidelity = je.Fidelity.draft(dtype=jnp.result_type(float), solver=je.Dense())
    model = je.discretise(je.Scene(replace(skin, protocol=protocol)), fidelity)
    matrix = np.zeros((count, count))
    matrix[1:, 1:] = np.asarray(je.forward(model)).reshape(count - 1, count - 1)
    return matrix


def predict(transfer: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Readings per ampere, (readings,) ohm, of a ``pattern`` (readings, 4)."""
    source, sink, plus, minus = pattern.T
    z = transfer
    return z[plus, source] - z[minus, source] - z[plus, sink] + z[minus, sink]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """What the recorder may have done: the rows that its readings would then be, (readings, 4)."""

    what: str
    remedy: str
    pattern: np.ndarray
    magnitude: bool = False


@dataclass(frozen=True)
class OrderCheck:
    """How well the readings fit a uniform sheet, as they are and under the best other order.

    ``as_is`` and ``best`` are correlations; ``what`` and ``remedy`` belong to ``best`` and are empty
    where the recorded order fits; ``same`` are other explanations that predict the very same
    readings; ``scale`` is measured over modelled voltage, of no meaning unless ``as_is`` is high.
    """

    readings: int
    as_is: float
    best: float
    scale: float
    what: str = ""
    remedy: str = ""
    same: tuple[str, ...] = ()

    @property
    def claimed(self) -> bool:
        """Whether the other order explains the readings so much better that it is worth saying."""
        better = 1 - self.best < _SHRINKS * (1 - self.as_is)
        return self.as_is < _AS_IS_ENOUGH and self.best > _CONVINCING and better


def check_order(
    voltage: np.ndarray,
    good: np.ndarray,
    pattern: np.ndarray,
    transfer: np.ndarray,
    *,
    current: float = 1.0,
    positions: np.ndarray | None = None,
    usual: np.ndarray | None = None,
) -> OrderCheck:
    """Compare mean readings of the untouched skin with a uniform sheet under many orders.

    Args:
        voltage: (readings,) V. good: (readings,) which of them to trust.
        pattern: as recorded, (readings, 4). transfer: from `transfer_matrix`. current: A.
        positions: of the electrodes, (electrodes, 2) m, for numberings of a grid.
        usual: the skin's own pattern, should the recorded one be a wrong claim.
    """
    v, model = voltage[good], current * predict(transfer, pattern[good])
    power = model @ model
    as_is = OrderCheck(
        readings=len(v),
        as_is=_correlation(v, model),
        best=_correlation(v, model),
        scale=float(v @ model / power) if power > 0 else float("nan"),
    )
    if as_is.as_is >= _AS_IS_ENOUGH:
        return as_is
    guesses = [
        _Guess(h.what, h.remedy, _fit(v, current * predict(transfer, h.pattern[good]), h))
        for h in _hypotheses(pattern, len(transfer), positions, usual)
    ]
    return _best(as_is, guesses)


class _Guess(NamedTuple):
    """A hypothesis and the correlation that it reaches."""

    what: str
    remedy: str
    signed: float


def _best(as_is: OrderCheck, guesses: list[_Guess]) -> OrderCheck:
    """The simplest of the guesses whose correlations, but for the sign, are highest."""
    fit = np.abs([g.signed for g in guesses])
    fit[0] = -guesses[0].signed  # the recorded order explains something only with its signs reversed
    first = int(np.flatnonzero(fit >= fit.max() - _TIE)[0])
    equal = np.flatnonzero(np.abs(fit - fit[first]) < 1e-9).tolist()
    chosen = guesses[first]
    flips = first > 0 and chosen.signed < 0
    return replace(
        as_is,
        best=float(fit[first]),
        what=chosen.what + (", and every sign is reversed" if flips else ""),
        remedy=chosen.remedy + (", and exchange sense+ with sense-" if flips else ""),
        same=tuple(guesses[i].what for i in equal if i != first)[:3],
    )


def _one_sign(v: np.ndarray, model: np.ndarray) -> bool:
    """Whether magnitudes may have been recorded: one sign where the model has two."""
    return bool((np.all(v >= 0) or np.all(v <= 0)) and (model < 0).any() and (model > 0).any())


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = np.linalg.norm(a) * np.linalg.norm(b)
    return float(a @ b / size) if size > 0 else 0.0


def _fit(v: np.ndarray, model: np.ndarray, hypothesis: Hypothesis) -> float:
    if not hypothesis.magnitude:
        return _correlation(v, model)
    return _correlation(np.abs(v), np.abs(model)) if _one_sign(v, model) else 0.0


def _hypotheses(
    pattern: np.ndarray, electrodes: int, positions: np.ndarray | None, usual: np.ndarray | None
) -> Iterator[Hypothesis]:
    """From the simplest to the strangest; the first is the recorded order."""
    yield Hypothesis(
        "every sign is reversed (drive pairs, sense pairs or the amplifier's inputs)",
        "exchange sense+ and sense- in the pattern, or negate the voltages at import",
        pattern,
    )
    yield Hypothesis(
        "the recorder stored magnitudes without sign",
        "record the signed (in-phase) voltage, not its amplitude",
        pattern,
        magnitude=True,
    )
    yield from _reading_orders(pattern, usual)
    yield from _renumbered(pattern, electrodes)
    yield from _grid_numberings(pattern, positions)
    yield from _late_frames(pattern)
    yield from _swapped(pattern, electrodes)


_REORDER = "write the rows of the pattern in the order in which the readings come"


def _reading_orders(pattern: np.ndarray, usual: np.ndarray | None) -> Iterator[Hypothesis]:
    drive, sense = _rank(pattern[:, :2]), _rank(pattern[:, 2:])
    if usual is not None and usual.shape == pattern.shape and (usual != pattern).any():
        yield Hypothesis(
            "the readings are in the order of the skin's protocol, not of the recorded pattern",
            "write the skin's own pattern into the session",
            usual,
        )
    orders = {
        "the readings of a frame come in reversed order": np.arange(len(pattern))[::-1],
        "within each drive the readings start at sense electrode 0": np.lexsort((pattern[:, 2], drive)),
        "the readings come sense pair by sense pair, not drive by drive": np.lexsort((drive, sense)),
        "the readings come sense electrode by sense electrode": np.lexsort((drive, pattern[:, 2])),
    }
    for what, order in orders.items():
        yield Hypothesis(what, _REORDER, pattern[order])


def _rank(pairs: np.ndarray) -> np.ndarray:
    """Each pair's place in the order of first appearance."""
    _, first, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse.ravel()]


_RENUMBER = "reorder the electrodes in the skin's TOML file, or the wires"


def _renumbered(pattern: np.ndarray, electrodes: int) -> Iterator[Hypothesis]:
    number = np.arange(electrodes)
    for first in range(1, electrodes):
        what = f"electrodes are counted from another one: the recorder's 0 is the skin's {first}"
        yield Hypothesis(what, _RENUMBER, ((number + first) % electrodes)[pattern])
    for first in range(electrodes):
        what = f"electrodes are numbered backwards: the recorder's 0 is the skin's {first}"
        yield Hypothesis(what, _RENUMBER, ((first - number) % electrodes)[pattern])


def _grid_numberings(pattern: np.ndarray, positions: np.ndarray | None) -> Iterator[Hypothesis]:
    """Row by row and in a snake, from every corner, where the electrodes form a grid."""
    if positions is None:
        return
    (columns, x), (rows, y) = (np.unique(p.round(9), return_inverse=True) for p in positions.T)
    if len(columns) * len(rows) != len(positions):
        return
    at = np.full((len(rows), len(columns)), -1)
    at[y, x] = np.arange(len(positions))
    for name, grid in (("row by row", at), ("column by column", at.T)):
        for up in (1, -1):
            for right in (1, -1):
                plain = grid[::up, ::right].copy()
                snake = plain.copy()
                snake[1::2] = snake[1::2, ::-1]
                start = f"starting at the skin's electrode {plain[0, 0]}"
                remedy = f'{_RENUMBER} ("order" in [electrodes.grid])'
                yield Hypothesis(f"electrodes are numbered {name}, all alike, {start}", remedy, plain.ravel()[pattern])
                yield Hypothesis(f"electrodes are numbered {name} in a snake, {start}", remedy, snake.ravel()[pattern])


def _late_frames(pattern: np.ndarray) -> Iterator[Hypothesis]:
    for start in range(1, min(len(pattern), _LATEST)):
        what = f"each frame starts at reading {start} of the pattern"
        yield Hypothesis(what, "synchronise the recorder with the scan", np.roll(pattern, -start, 0))


def _swapped(pattern: np.ndarray, electrodes: int) -> Iterator[Hypothesis]:
    for i in range(min(electrodes, _SWAPPED)):
        for j in range(i + 1, min(electrodes, _SWAPPED)):
            number = np.arange(electrodes)
            number[[i, j]] = j, i
            what = f"electrodes {i} and {j} are exchanged"
            yield Hypothesis(what, f"exchange the wires of electrodes {i} and {j}", number[pattern])
