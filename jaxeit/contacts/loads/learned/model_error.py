"""How far the model of a skin errs, by the evidence of frames in each of which one load presses."""

from collections.abc import Callable, Sequence

import numpy as np

from ....imaging.inputs import InverseError

# Ratio of consecutive model errors in the search, and its first and last error.
ERROR_RATIO, MIN_ERROR, MAX_ERROR = 2**0.5, 1e-3, 0.15
# Share of the frames whose model error is no larger than the one selected.
FRAME_SHARE = 0.9
# Largest number of frames listed in an error message.
MAX_LISTED = 10


def select_model_error(
    evidences: Sequence[Callable[[float], float]], smallest: float, min_log_ratio: float = 0.0
) -> float:
    """Select the model error that nine of ten frames stay below.

    The model error of a frame is the smallest one under which the frame is about as probable as under any (empirical
    Bayes; MacKay 1992, Neural Computation 4, 415): errors are tried from the smallest on, until the evidence falls.
    Presses differ: near an electrode a model may err ten times as much as elsewhere, and it must not be trusted there
    either.

    Args:
        evidences: log of the probability of each frame under a model error, -inf where no fit converges.
        smallest: model error that is tried first.
        min_log_ratio: log of the ratio of probabilities from which a frame speaks for a larger error.

    Raises:
        InverseError: if there is no frame, or fits converge for half of the frames or less.
    """
    smallest = max(smallest, MIN_ERROR)
    last = max(0, int(np.ceil(np.log(MAX_ERROR / smallest) / np.log(ERROR_RATIO))))
    errors = smallest * ERROR_RATIO ** np.arange(last + 1)
    supported = [_first_supported(evidence, errors, min_log_ratio) for evidence in evidences]
    fitted = [k for k in supported if k is not None]
    if 2 * len(fitted) <= len(supported):
        failed = [number for number, k in enumerate(supported) if k is None]
        raise InverseError(
            f"one contact is fitted to {len(fitted)} of {len(supported)} frames, and its fit does not converge for "
            f"frames {failed[:MAX_LISTED]}; give frames in each of which one contact presses and rests"
        )
    return float(errors[int(np.quantile(fitted, FRAME_SHARE, method="higher"))])


def _first_supported(evidence: Callable[[float], float], errors: np.ndarray, min_log_ratio: float) -> int | None:
    """Index of the first error whose evidence is within `min_log_ratio` of the largest. None: no fit converges.

    The evidence falls from its largest on.
    """
    values = [-np.inf]
    for error in errors:
        values.append(evidence(float(error)))
        if values[-1] < values[-2]:
            break
    largest = max(values)
    return int(np.argmax(np.array(values[1:]) >= largest - min_log_ratio)) if largest > -np.inf else None
