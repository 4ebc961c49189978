"""Contradictions between presses: outliers, as after a slip of the stage; drifts of pads; errors of all places."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from .pooled import PooledPresses
from .streams import robust_deviation

# Least error of an outlier: in robust standard deviations, of a force over the force, and of a place over the shorter
# side of the box of places.
OUTLIER_DEVIATIONS, MIN_FORCE_SHARE, MIN_BOX_SHARE = 10.0, 0.25, 0.15
MAX_OUTLIER_SHARE = 0.05  # of presses; with more outliers, and more than one, the fit is at fault, and none is named
MAX_LISTED = 3  # presses in a line
# Least relative drift of a pad's reading at equal force; least errors of places, over distances and in m.
MIN_DRIFT, MIN_STRETCH, MIN_OFFSET = 0.15, 0.06, 5e-3
SIGNIFICANCE = 5.0  # standard errors of a drift or of an error of places; many, since errors of presses are correlated
MIN_PAD_SHARE = 0.5  # least share of a pad in a press from which its drift is estimated
MIN_RESIDUAL_DOF = 5  # least residual degrees of freedom of a fit
TRIM_DEVIATIONS = 4.0  # robust standard deviations, beyond which a press is trimmed from a fit


def outlying_presses(
    presses: PooledPresses, force: Float[np.ndarray, " n"], place: Float[np.ndarray, "n 2"] | None = None
) -> tuple[str, ...]:
    """Lines for the operator on presses whose stated force or place is an outlier; empty for none.

    Args:
        force: of each press by a fit to the presses at other places, (presses,) N; NaN: not known.
        place: by the image, (presses, 2) m; None: not known.
    """
    stated = presses.data.force
    outliers = _outliers(np.abs(force - stated), MIN_FORCE_SHARE * np.maximum(force, stated))
    forces = [f"{stated[k]:.1f} N stated, {force[k]:.1f} N by its pressure" for k in outliers]
    lines = list(_outlier_lines(presses, outliers, "force", forces))
    if place is not None:
        distance = np.hypot(*(place - presses.position).T)
        outliers = _outliers(distance, MIN_BOX_SHARE * np.ptp(presses.data.reach, axis=0).min())
        places = [f"{_mm(presses.position[k])} stated, {_mm(place[k])} by its image" for k in outliers]
        lines += _outlier_lines(presses, outliers, "place", places)
    return tuple(lines)


def drifting_pads(
    presses: PooledPresses,
    names: Sequence[str],
    pad_force: Float[np.ndarray, "n pads"],
    *,
    by_place: bool,
) -> tuple[str, ...]:
    """Lines on pads that read less and less, or more and more, for a force through a session, as by a leak.

    Args:
        names: of the pads.
        pad_force: by a fit to the presses at other places, N; NaN: not known.
        by_place: whether the fit corrects by location. Otherwise the ratio may also change with the square of the
            place, and a drift is detected only where places and times of presses are independent.
    """
    data, session = presses.data, presses.groups["session"]
    time = np.concatenate([m.presses.t_hold0[m.presses.accepted] for m in presses.recordings])
    fitted = np.nan_to_num(pad_force.sum(1))
    known = (fitted > 0) & (data.force > 0) & (by_place | np.isfinite(presses.position).all(1))
    ratio = np.log(np.where(known, data.force, 1) / np.where(known, fitted, 1))
    lines = []
    for number, recording in enumerate(presses.recordings):
        drifts = {}
        for pad, name in enumerate(names):
            rows = np.flatnonzero((session == number) & known & (data.share[:, pad] > MIN_PAD_SHARE))
            place = presses.position[rows][:, :0] if by_place else presses.position[rows]
            change = _drift(time[rows], ratio[rows], place)
            if abs(change) > np.log1p(MIN_DRIFT):
                drifts[name] = 100 * np.expm1(-change)
        if drifts:
            text = ", ".join(f"{name!r} {part:+.0f} %" for name, part in drifts.items())
            lines.append(
                f"{recording.session.name}: what pads read for a force changes from the first of their presses to the "
                f"last: {text}; check tubes for leaks, the load cell and the supply, and calibrate from the part "
                "before the change"
            )
    return tuple(lines)


def _drift(time: np.ndarray, ratio: np.ndarray, place: Float[np.ndarray, "n d"]) -> float:
    """Change of log ratios from the first time to the last, adjusted for places; 0 where it is not significant."""
    if len(time) < 2 or np.ptp(time) == 0:
        return 0.0
    progress = (time - time.min()) / np.ptp(time)
    centred = (place - place.mean(0)) / np.maximum(np.ptp(place, axis=0), 1e-9)
    squares = [a * b for k, a in enumerate(centred.T) for b in centred.T[k:]]
    fit = _trimmed_fit(np.column_stack([progress, np.ones_like(progress), *centred.T, *squares]), ratio[:, None])
    return 0.0 if fit is None or abs(fit[0][0, 0]) < SIGNIFICANCE * fit[1][0, 0] else float(fit[0][0, 0])


def place_errors(presses: PooledPresses, place: Float[np.ndarray, "n 2"]) -> tuple[str, ...]:
    """A line for each session with a systematic error, a shift or a stretch, of stated places.

    Args:
        place: by fitted contacts, (presses, 2) m; NaN: not known. Centroids of images are biased inwards.
    """
    session, lines = presses.groups["session"], []
    for number, recording in enumerate(presses.recordings):
        rows = np.flatnonzero((session == number) & np.isfinite(place).all(1) & np.isfinite(presses.position).all(1))
        if not len(rows):
            continue
        stated = presses.position[rows]
        middle = (stated.min(0) + stated.max(0)) / 2
        fit = _trimmed_fit(np.column_stack([np.ones(len(rows)), stated - middle]), stated - place[rows])
        if fit is None:
            continue
        coefficients, error = fit
        significant = np.abs(coefficients) > SIGNIFICANCE * error
        shift, *stretch = coefficients
        shifted = (np.abs(shift) > MIN_OFFSET) & significant[0]
        stretched = (np.abs(stretch) > MIN_STRETCH) & significant[1:]
        if shifted.any() or stretched.any():
            texts = []
            if shifted.any():
                texts.append(f"{1e3 * shift[0]:+.0f} mm in x and {1e3 * shift[1]:+.0f} mm in y at the middle")
            texts += [f"{100 * stretch[a][b]:+.0f} % of {'xy'[a]} in {'xy'[b]}" for a, b in np.argwhere(stretched)]
            lines.append(
                f"{recording.session.name}: the places of presses as a whole lie aside of the contacts that EIT shows: "
                f"{', '.join(texts)}; check origin, axes and pitch of the stage, and the places of the electrodes"
            )
    return tuple(lines)


def _trimmed_fit(
    columns: Float[np.ndarray, "n k"], values: Float[np.ndarray, "n m"]
) -> tuple[Float[np.ndarray, "k m"], Float[np.ndarray, "k m"]] | None:
    """Least squares trimmed of outliers, and its standard errors; None with too few rows or dependent columns."""
    for _ in range(2):
        if len(columns) < columns.shape[1] + MIN_RESIDUAL_DOF or np.linalg.matrix_rank(columns) < columns.shape[1]:
            return None
        coefficients = np.linalg.lstsq(columns, values, rcond=None)[0]
        residual = values - columns @ coefficients
        scale = np.array([robust_deviation(column) for column in residual.T])
        error = np.linalg.norm(np.linalg.lstsq(columns, np.eye(len(columns)), rcond=None)[0], axis=1)
        kept = (np.abs(residual) <= TRIM_DEVIATIONS * scale).all(1)
        columns, values = columns[kept], values[kept]
    return coefficients, np.outer(error, scale)


def _outliers(error: Float[np.ndarray, " n"], least: Float[np.ndarray, "..."] | float) -> np.ndarray:
    """Rows of the presses whose error is an outlier."""
    known = np.isfinite(error)
    outliers = np.flatnonzero(known & (error > np.maximum(OUTLIER_DEVIATIONS * robust_deviation(error[known]), least)))
    return outliers if len(outliers) <= max(1, MAX_OUTLIER_SHARE * len(error)) else outliers[:0]


def _outlier_lines(presses: PooledPresses, outliers: np.ndarray, kind: str, texts: list[str]) -> Iterator[str]:
    session = presses.groups["session"]
    rows = np.concatenate([np.flatnonzero(m.presses.accepted) for m in presses.recordings])
    for number, recording in enumerate(presses.recordings):
        own = [(rows[k], text) for k, text in zip(outliers, texts, strict=True) if session[k] == number]
        if own:
            listed = "; ".join(f"press {row}: {text}" for row, text in own[:MAX_LISTED])
            more = f"; and {len(own) - MAX_LISTED} more" if len(own) > MAX_LISTED else ""
            yield (
                f"{recording.session.name}: the other presses contradict the {kind} of {listed}{more}; check the log "
                "of the stage, and set such a press aside (accepted = 0 in /presses)"
            )


def _mm(place: Float[np.ndarray, "2"]) -> str:
    return f"({1e3 * place[0]:.0f}, {1e3 * place[1]:.0f}) mm"
