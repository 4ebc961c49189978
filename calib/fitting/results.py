"""Outcome of a fit as a code, with what to do about it."""

import enum


class FitError(ValueError):
    """Samples that no fit can take, such as wrong shapes or weights that are not positive.

    Example:
        try:
            calib.fit_curves(calib.Linear(), pressures, forces[:, :10])
        except fitting.FitError as error:
            print(error)
    """


class FitResult(enum.IntEnum):
    """Outcome of a fit. Use its numbers only after SUCCESS; otherwise `message` says what to do."""

    SUCCESS = 0  # fitted
    NOT_FINITE = 1  # no finite samples, or the fit diverged
    TOO_FEW = 2  # too few samples or presses for this curve
    MAX_STEPS = 3  # the solver ran out of steps
    NO_RESPONSE = 4  # the force does not rise with the pressure
    SINGULAR = 5  # the samples do not determine all parameters
    AT_BOUND = 6  # somewhere the force does not rise, and this curve must

    @property
    def message(self) -> str:
        """The outcome in one sentence, and what to do about it."""
        return _MESSAGES[self]


_MESSAGES = {
    FitResult.SUCCESS: "fitted",
    FitResult.NOT_FINITE: "no finite samples, or the fit diverged: is this pad connected? see `jaxeit check`",
    FitResult.TOO_FEW: "too few samples or presses for this curve: record more presses, or choose a curve "
    "with fewer parameters",
    FitResult.MAX_STEPS: "the solver ran out of steps: raise max_steps, or choose a curve with fewer parameters",
    FitResult.NO_RESPONSE: "force does not rise with pressure, or there is only one pressure: check the pad's tube, "
    "its sign and its number, and record presses at more load levels",
    FitResult.SINGULAR: "the samples do not determine all parameters: record presses at more load levels, or choose a "
    "curve with fewer parameters (affine, power)",
    FitResult.AT_BOUND: "somewhere the force falls with pressure or does not rise, and this curve must: choose a curve "
    "with fewer parameters, and check the range of the pressure sensor",
}
