"""How far the model of a skin errs, by the evidence of frames in each of which one load presses."""

from collections.abc import Callable, Sequence

import numpy as np

from ....imaging.noise import InverseError

# Model errors that are tried: each is larger than the one before by this factor, from the first at least to the last.
STEP, FIRST, LAST = 2**0.5, 1e-3, 0.15
# Share of the frames whose model error is no larger than the one that is found.
SHARE = 0.9
# Numbers of frames that an error names.
SHOWN = 10


def fitted_model_error(evidences: Sequence[Callable[[float], float]], least: float, surely: float = 0.0) -> float:
    """The model error that nine of ten frames stay below.

    The model error of a frame is the least one under which the frame is about as probable as under any (empirical
    Bayes; MacKay 1992, Neural Computation 4, 415): errors are tried from the least on, until the evidence falls.
    Presses differ: near an electrode a model may err ten times as much as elsewhere, and it must not be trusted there
    either.

    Args:
        evidences: log of the probability of each frame under a model error, -inf where no fit converges.
        least: model error that is tried first.
        surely: log of the ratio of probabilities from which a frame speaks for a larger error.

    Raises:
        InverseError: if there is no frame, or fits converge for half of the frames or less.
    """
    least = max(least, FIRST)
    last = max(0, int(np.ceil(np.log(LAST / least) / np.log(STEP))))
    tried = least * STEP ** np.arange(last + 1)
    found = [_told(evidence, tried, surely) for evidence in evidences]
    fitted = [k for k in found if k is not None]
    if 2 * len(fitted) <= len(found):
        failed = [number for number, k in enumerate(found) if k is None]
        raise InverseError(
            f"one contact is fitted to {len(fitted)} of {len(found)} frames, and its fit does not converge for frames "
            f"{failed[:SHOWN]}; give frames in each of which one contact presses and rests"
        )
    return float(tried[int(np.quantile(fitted, SHARE, method="higher"))])


def _told(evidence: Callable[[float], float], tried: np.ndarray, surely: float) -> int | None:
    """The first of the errors under which a frame is as probable as under any, for sure. None: no fit converges.

    The evidence falls from its largest on.
    """
    found = [-np.inf]
    for error in tried:
        found.append(evidence(float(error)))
        if found[-1] < found[-2]:
            break
    most = max(found)
    return int(np.argmax(np.array(found[1:]) >= most - surely)) if most > -np.inf else None
