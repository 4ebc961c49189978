"""What presses contradict: single ones the others, as after a slip of the stage; pads that drift; places of a stage
that is off as a whole."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from .pooled import PooledPresses
from .streams import robust_deviation

# How far a press must lie from what the others tell: so many times the usual error, and for a force this part of it,
# for a place this part of the shorter side of the box of places.
FAR, PART_OF_FORCE, PART_OF_BOX = 10.0, 0.25, 0.15
MAX_SHARE = 0.05  # of presses; if more are far, and more than one, the fit does not hold, and no press is to blame
NAMED = 3  # presses that a line names
# Least drift of what a pad reads for a force that is told, and least error of places, as a part of distances, and m.
LEAST_DRIFT, LEAST_STRETCH, LEAST_OFFSET = 0.15, 0.06, 5e-3
SURE = 5.0  # standard errors of a drift or of an error of places, which presses alike make too small
MOST_OF_FORCE = 0.5  # of a press, borne by the pad whose drift it tells
MIN_SPARE = 5  # presses beyond the coefficients of a fit
OUTLYING = 4.0  # usual errors: presses further away are left out of a fit


def contradicted_presses(
    presses: PooledPresses, force: Float[np.ndarray, " n"], place: Float[np.ndarray, "n 2"] | None = None
) -> tuple[str, ...]:
    """Lines for the operator that name such presses; empty for none.

    Args:
        force: that a fit to the presses at other places tells of each press, (presses,) N; NaN: not known.
        place: that the image tells, (presses, 2) m; None: not known.
    """
    stated = presses.data.force
    far = _far(np.abs(force - stated), PART_OF_FORCE * np.maximum(force, stated))
    forces = [f"{stated[k]:.1f} N stated, {force[k]:.1f} N by its pressure" for k in far]
    lines = list(_lines(presses, far, "force", forces))
    if place is not None:
        away = np.hypot(*(place - presses.position).T)
        far = _far(away, PART_OF_BOX * np.ptp(presses.data.reach, axis=0).min())
        lines += _lines(
            presses, far, "place", [f"{_mm(presses.position[k])} stated, {_mm(place[k])} by its image" for k in far]
        )
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
        pad_force: that a fit to the presses at other places tells, N; NaN: not known.
        by_place: whether the fit corrects by location. Otherwise the ratio may also change with the square of the
            place, and a drift is told only where presses did not go along the skin as time went on.
    """
    data, session = presses.data, presses.groups["session"]
    time = np.concatenate([m.presses.t_hold0[m.presses.accepted] for m in presses.recordings])
    told = np.nan_to_num(pad_force.sum(1))
    known = (told > 0) & (data.force > 0) & (by_place | np.isfinite(presses.position).all(1))
    ratio = np.log(np.where(known, data.force, 1) / np.where(known, told, 1))
    lines = []
    for number, recording in enumerate(presses.recordings):
        found = {}
        for pad, name in enumerate(names):
            rows = np.flatnonzero((session == number) & known & (data.share[:, pad] > MOST_OF_FORCE))
            place = presses.position[rows][:, :0] if by_place else presses.position[rows]
            change = _drift(time[rows], ratio[rows], place)
            if abs(change) > np.log1p(LEAST_DRIFT):
                found[name] = 100 * np.expm1(-change)
        if found:
            said = ", ".join(f"{name!r} {part:+.0f} %" for name, part in found.items())
            lines.append(
                f"{recording.session.name}: what pads read for a force changes from the first of their presses to the "
                f"last: {said}; check tubes for leaks, the load cell and the supply, and calibrate from the part "
                "before the change"
            )
    return tuple(lines)


def _drift(time: np.ndarray, ratio: np.ndarray, place: Float[np.ndarray, "n d"]) -> float:
    """Change of a logarithm of ratios from the first time to the last beside what places explain; 0: not sure."""
    if len(time) < 2 or np.ptp(time) == 0:
        return 0.0
    along = (time - time.min()) / np.ptp(time)
    centred = (place - place.mean(0)) / np.maximum(np.ptp(place, axis=0), 1e-9)
    squares = [a * b for k, a in enumerate(centred.T) for b in centred.T[k:]]
    fit = _sure_fit(np.column_stack([along, np.ones_like(along), *centred.T, *squares]), ratio[:, None])
    return 0.0 if fit is None or abs(fit[0][0, 0]) < SURE * fit[1][0, 0] else float(fit[0][0, 0])


def moved_places(presses: PooledPresses, place: Float[np.ndarray, "n 2"]) -> tuple[str, ...]:
    """A line for each session whose stated places as a whole lie elsewhere than the contacts of the images.

    Args:
        place: that fitted contacts tell, (presses, 2) m; NaN: not known. Centroids of images lie inwards as a whole.
    """
    session, lines = presses.groups["session"], []
    for number, recording in enumerate(presses.recordings):
        rows = np.flatnonzero((session == number) & np.isfinite(place).all(1) & np.isfinite(presses.position).all(1))
        if not len(rows):
            continue
        stated = presses.position[rows]
        middle = (stated.min(0) + stated.max(0)) / 2
        fit = _sure_fit(np.column_stack([np.ones(len(rows)), stated - middle]), stated - place[rows])
        if fit is None:
            continue
        size, error = fit
        sure = np.abs(size) > SURE * error
        (shift, *stretch), (shift_sure, *stretch_sure) = size, sure
        off = (np.abs(shift) > LEAST_OFFSET) & shift_sure
        bent = (np.abs(stretch) > LEAST_STRETCH) & stretch_sure
        if off.any() or bent.any():
            said = (
                [f"{1e3 * shift[0]:+.0f} mm in x and {1e3 * shift[1]:+.0f} mm in y at the middle"] if off.any() else []
            )
            said += [
                f"{100 * stretch[a][b]:+.0f} % of {'xy'[a]} in {'xy'[b]}" for a in (0, 1) for b in (0, 1) if bent[a, b]
            ]
            lines.append(
                f"{recording.session.name}: the places of presses as a whole lie aside of the contacts that EIT shows: "
                f"{', '.join(said)}; check origin, axes and pitch of the stage, and the places of the electrodes"
            )
    return tuple(lines)


def _sure_fit(
    columns: Float[np.ndarray, "n k"], values: Float[np.ndarray, "n m"]
) -> tuple[Float[np.ndarray, "k m"], Float[np.ndarray, "k m"]] | None:
    """Least squares without outliers, and the standard errors; None where too few rows, or alike ones, tell nothing."""
    for _ in range(2):
        if len(columns) < columns.shape[1] + MIN_SPARE or np.linalg.matrix_rank(columns) < columns.shape[1]:
            return None
        found = np.linalg.lstsq(columns, values, rcond=None)[0]
        left = values - columns @ found
        scale = np.array([robust_deviation(one) for one in left.T])
        error = np.linalg.norm(np.linalg.lstsq(columns, np.eye(len(columns)), rcond=None)[0], axis=1)
        near = (np.abs(left) <= OUTLYING * scale).all(1)
        columns, values = columns[near], values[near]
    return found, np.outer(error, scale)


def _far(error: Float[np.ndarray, " n"], least: Float[np.ndarray, "..."] | float) -> np.ndarray:
    """Rows of the presses whose error is far larger than usual."""
    known = np.isfinite(error)
    far = np.flatnonzero(known & (error > np.maximum(FAR * robust_deviation(error[known]), least)))
    return far if len(far) <= max(1, MAX_SHARE * len(error)) else far[:0]


def _lines(presses: PooledPresses, far: np.ndarray, what: str, said: list[str]) -> Iterator[str]:
    session = presses.groups["session"]
    rows = np.concatenate([np.flatnonzero(m.presses.accepted) for m in presses.recordings])
    for number, recording in enumerate(presses.recordings):
        own = [(rows[k], text) for k, text in zip(far, said, strict=True) if session[k] == number]
        if own:
            named = "; ".join(f"press {row}: {text}" for row, text in own[:NAMED])
            more = f"; and {len(own) - NAMED} more" if len(own) > NAMED else ""
            yield (
                f"{recording.session.name}: the other presses contradict the {what} of {named}{more}; check the log of "
                "the stage, and set such a press aside (accepted = 0 in /presses)"
            )


def _mm(place: Float[np.ndarray, "2"]) -> str:
    return f"({1e3 * place[0]:.0f}, {1e3 * place[1]:.0f}) mm"
