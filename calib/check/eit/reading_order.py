"""Check the order and the signs of the readings of a frame by comparison with a model.

Every four-terminal reading is a difference of four entries of the skin's transfer matrix. One solve therefore
predicts the frame under any numbering of electrodes and any order of readings.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

import jaxeit as je

from ...session.mixing import count_readings

# A uniform sheet reaches 0.99 on healthy sessions; two swapped electrodes leave 0.93 at most.
SUFFICIENT_CORRELATION = 0.95
MIN_BEST_CORRELATION = 0.7  # of the other order, to be reported
MAX_RESIDUAL_RATIO = 1 / 3  # of 1 - correlation under the other order to that of the recorded one, to be reported
MAX_SHIFTS, MAX_SWAPPED_ELECTRODES = 4096, 64  # limits of the search, so that large skins are checked in seconds
CORRELATION_TOLERANCE = 0.005  # a simpler explanation this close to the best one is preferred


def transfer_matrix(skin: je.Skin) -> np.ndarray:
    """Transfer impedances of the untouched, uniform sheet: volts on one electrode per ampere into another.

    Electrode 0 is grounded. The model has draft fidelity and JAX's default precision.

    Returns:
        (electrodes, electrodes) ohm, symmetric.

    Raises:
        ValueError: if the skin cannot be meshed.

    Example:
        z = calib.check.transfer_matrix(je.load_skin("testbed"))  # ohm, (electrodes, electrodes)
    """
    count = len(skin.electrodes)
    row = np.repeat(np.arange(1, count), count - 1)
    column = np.tile(np.arange(1, count), count - 1)
    ground = np.zeros_like(row)
    protocol = je.Protocol(np.stack([row, ground, column, ground], 1), 1.0)
    fidelity = je.Fidelity.draft(dtype=jnp.result_type(float), solver=je.linalg.Dense())
    model = je.discretise(je.Scene(replace(skin, protocol=protocol)), fidelity)
    matrix = np.zeros((count, count))
    matrix[1:, 1:] = np.asarray(je.forward(model)).reshape(count - 1, count - 1)
    return matrix


def predict_readings(transfer: np.ndarray, pattern: np.ndarray, mixing: sp.csr_array | None = None) -> np.ndarray:
    """Readings per ampere (readings,) in ohm for a ``pattern`` (rows, 4): drive+, drive-, sense+, sense-.

    With ``mixing``, (readings, rows), readings are sums of rows.
    """
    source, sink, plus, minus = pattern.T
    z = transfer
    rows = z[plus, source] - z[minus, source] - z[plus, sink] + z[minus, sink]
    return np.asarray(rows if mixing is None else mixing @ rows)


@dataclass(frozen=True, eq=False)
class OrderHypothesis:
    """A mistake that the recorder may have made, and what its readings then follow.

    ``pattern`` (rows, 4), and the ``order`` (readings,) of what is read by it; None: as it is.
    """

    what: str
    remedy: str
    pattern: np.ndarray
    order: np.ndarray | None = None
    magnitude: bool = False


@dataclass(frozen=True)
class OrderCheck:
    """Correlation of the readings with a uniform sheet, as recorded and under the best other order.

    | field        | meaning                                                                             |
    |--------------|-------------------------------------------------------------------------------------|
    | readings     | number of readings that were compared                                               |
    | as_is, best  | correlation in the recorded order, and in the best other one                        |
    | scale        | measured over modelled voltage; meaningful only if ``as_is`` is high                |
    | what, remedy | what the best other order is and how to correct it; empty if the recorded one fits  |
    | same         | other explanations that predict exactly the same readings                           |
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
        """Whether the other order explains the readings so much better that it must be reported."""
        better = 1 - self.best < MAX_RESIDUAL_RATIO * (1 - self.as_is)
        return self.as_is < SUFFICIENT_CORRELATION and self.best > MIN_BEST_CORRELATION and better


def check_order(
    voltage: np.ndarray,
    good: np.ndarray,
    pattern: np.ndarray,
    transfer: np.ndarray,
    *,
    current: float = 1.0,
    positions: np.ndarray | None = None,
    usual: np.ndarray | None = None,
    mixing: sp.csr_array | None = None,
) -> OrderCheck:
    """Compare mean readings of the untouched skin with a uniform sheet under many orders.

    Args:
        voltage: mean readings (readings,) V.
        good: which readings to trust (readings,).
        pattern: as recorded (rows, 4).
        transfer: from `transfer_matrix`.
        current: drive current, A.
        positions: positions of the electrodes (electrodes, 2) m, to try the numberings of a grid.
        usual: the skin's own pattern, to try if the recorded pattern differs from it.
        mixing: readings as sums of rows of the pattern (readings, rows); default: each row is one.
    """

    def predicted(hypothesis: OrderHypothesis) -> np.ndarray:
        found: np.ndarray = current * predict_readings(transfer, hypothesis.pattern, mixing)
        kept: np.ndarray = (found if hypothesis.order is None else found[hypothesis.order])[good]
        return kept

    v, model = voltage[good], current * predict_readings(transfer, pattern, mixing)[good]
    power = model @ model
    as_is = OrderCheck(
        readings=len(v),
        as_is=_correlation(v, model),
        best=_correlation(v, model),
        scale=float(v @ model / power) if power > 0 else float("nan"),
    )
    if as_is.as_is >= SUFFICIENT_CORRELATION:
        return as_is
    scored = [
        _ScoredHypothesis(h.what, h.remedy, _signed_correlation(v, predicted(h), h))
        for h in _hypotheses(pattern, mixing, len(transfer), positions, usual)
    ]
    return _best_explanation(as_is, scored)


class _ScoredHypothesis(NamedTuple):
    """A hypothesis and the correlation that it reaches."""

    what: str
    remedy: str
    signed: float


def _best_explanation(as_is: OrderCheck, scored: list[_ScoredHypothesis]) -> OrderCheck:
    """The simplest of the hypotheses with the highest absolute correlation."""
    fit = np.abs([g.signed for g in scored])
    fit[0] = -scored[0].signed  # the recorded order is an explanation only with its signs reversed
    first = int(np.flatnonzero(fit >= fit.max() - CORRELATION_TOLERANCE)[0])
    equal = np.flatnonzero(np.abs(fit - fit[first]) < 1e-9).tolist()
    chosen = scored[first]
    flips = first > 0 and chosen.signed < 0
    return replace(
        as_is,
        best=float(fit[first]),
        what=chosen.what + (", and every sign is reversed" if flips else ""),
        remedy=chosen.remedy + (", and exchange sense+ with sense-" if flips else ""),
        same=tuple(scored[i].what for i in equal if i != first)[:3],
    )


def _one_sign(v: np.ndarray, model: np.ndarray) -> bool:
    """Whether magnitudes may have been recorded: the readings have one sign where the model has two."""
    return bool((np.all(v >= 0) or np.all(v <= 0)) and (model < 0).any() and (model > 0).any())


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = np.linalg.norm(a) * np.linalg.norm(b)
    return float(a @ b / size) if size > 0 else 0.0


def _signed_correlation(v: np.ndarray, model: np.ndarray, hypothesis: OrderHypothesis) -> float:
    if not hypothesis.magnitude:
        return _correlation(v, model)
    return _correlation(np.abs(v), np.abs(model)) if _one_sign(v, model) else 0.0


def _hypotheses(
    pattern: np.ndarray,
    mixing: sp.csr_array | None,
    electrodes: int,
    positions: np.ndarray | None,
    usual: np.ndarray | None,
) -> Iterator[OrderHypothesis]:
    """All hypotheses, from the simplest to the most unusual; the first is the recorded order itself."""
    yield OrderHypothesis(
        "every sign is reversed (drive pairs, sense pairs or the amplifier's inputs)",
        "exchange sense+ and sense- in the pattern, or negate the voltages at import",
        pattern,
    )
    yield OrderHypothesis(
        "the recorder stored magnitudes without sign",
        "record the signed (in-phase) voltage, not its amplitude",
        pattern,
        magnitude=True,
    )
    yield from _reading_orders(pattern, mixing, usual)
    yield from _renumbered(pattern, electrodes)
    yield from _grid_numberings(pattern, positions)
    yield from _shifted_frames(pattern, count_readings(pattern, mixing))
    yield from _swapped(pattern, electrodes)


REORDER_REMEDY = "write the rows of the pattern in the order in which the readings come"


def _reading_orders(
    pattern: np.ndarray, mixing: sp.csr_array | None, usual: np.ndarray | None
) -> Iterator[OrderHypothesis]:
    if usual is not None and usual.shape == pattern.shape and (usual != pattern).any():
        yield OrderHypothesis(
            "the readings are in the order of the skin's protocol, not of the recorded pattern",
            "write the skin's own pattern into the session",
            usual,
        )
    backwards = np.arange(count_readings(pattern, mixing))[::-1]
    yield OrderHypothesis("the readings of a frame come in reversed order", REORDER_REMEDY, pattern, backwards)
    if mixing is not None:  # a reading has no pair of its own to be ordered by
        return
    drive, sense = _rank(pattern[:, :2]), _rank(pattern[:, 2:])
    orders = {
        "within each drive the readings start at sense electrode 0": np.lexsort((pattern[:, 2], drive)),
        "the readings come sense pair by sense pair, not drive by drive": np.lexsort((drive, sense)),
        "the readings come sense electrode by sense electrode": np.lexsort((drive, pattern[:, 2])),
    }
    for what, order in orders.items():
        yield OrderHypothesis(what, REORDER_REMEDY, pattern, order)


def _rank(pairs: np.ndarray) -> np.ndarray:
    """Rank of each pair in the order of first appearance."""
    _, first, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse.ravel()]


RENUMBER_REMEDY = "reorder the electrodes in the skin's TOML file, or the wires"


def _renumbered(pattern: np.ndarray, electrodes: int) -> Iterator[OrderHypothesis]:
    number = np.arange(electrodes)
    for first in range(1, electrodes):
        what = f"electrodes are counted from another one: the recorder's 0 is the skin's {first}"
        yield OrderHypothesis(what, RENUMBER_REMEDY, ((number + first) % electrodes)[pattern])
    for first in range(electrodes):
        what = f"electrodes are numbered backwards: the recorder's 0 is the skin's {first}"
        yield OrderHypothesis(what, RENUMBER_REMEDY, ((first - number) % electrodes)[pattern])


def _grid_numberings(pattern: np.ndarray, positions: np.ndarray | None) -> Iterator[OrderHypothesis]:
    """Numberings of a grid of electrodes, row by row and in a snake, from every corner."""
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
                remedy = f'{RENUMBER_REMEDY} ("order" in [electrodes.grid])'
                yield OrderHypothesis(
                    f"electrodes are numbered {name}, all alike, {start}", remedy, plain.ravel()[pattern]
                )
                yield OrderHypothesis(
                    f"electrodes are numbered {name} in a snake, {start}", remedy, snake.ravel()[pattern]
                )


def _shifted_frames(pattern: np.ndarray, readings: int) -> Iterator[OrderHypothesis]:
    for start in range(1, min(readings, MAX_SHIFTS)):
        what = f"each frame starts at reading {start} of the pattern"
        yield OrderHypothesis(
            what, "synchronise the recorder with the scan", pattern, np.roll(np.arange(readings), -start)
        )


def _swapped(pattern: np.ndarray, electrodes: int) -> Iterator[OrderHypothesis]:
    for i in range(min(electrodes, MAX_SWAPPED_ELECTRODES)):
        for j in range(i + 1, min(electrodes, MAX_SWAPPED_ELECTRODES)):
            number = np.arange(electrodes)
            number[[i, j]] = j, i
            what = f"electrodes {i} and {j} are exchanged"
            yield OrderHypothesis(what, f"exchange the wires of electrodes {i} and {j}", number[pattern])
