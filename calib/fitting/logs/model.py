"""The fitted model of a log: channels to force, its standard error and the interval that a new reading falls into."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..curves.base import AbstractCurve
from ..curves.fitted import FittedCurve, predict_pads
from ..curves.samples import bucket
from .combination import AbstractCombination
from .directions import Travel
from .location import LogLocation
from .noise import LogNoise

# Part of the range of a channel by which a reading may lie outside it; as for the pressure of a curve.
RANGE_MARGIN = 0.05
# Fraction of the range of the fitted signal below which a sensor counts as at rest.
REST_FRACTION = 0.1


class LogPrediction(NamedTuple):
    """Forces over time.

    | field          | meaning                                                           | shape | unit |
    |----------------|-------------------------------------------------------------------|-------|------|
    | force          | NaN where a channel is missing                                    | (n,)  | N    |
    | standard_error | of a new reading: of model and start state, and of readings       | (n,)  | N    |
    | low, high      | the interval that 90 % of new readings fall into                  | (n,)  | N    |
    | valid          | channels and place within the ranges that the model was fitted to | (n,)  |      |
    """

    force: Float[np.ndarray, " n"]
    standard_error: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    valid: Bool[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class LogModel:
    """Channels to force: a combination of the channels into one signal, and a curve from the signal to force.

    | field       | meaning                                                       | shape         | unit     |
    |-------------|---------------------------------------------------------------|---------------|----------|
    | combination | channels to one signal                                        |               |          |
    | curve       | signal to force, with the covariance over blocks of time      |               |          |
    | noise       | of readings about the curve, which no fit had seen            |               |          |
    | reach       | lowest and highest fitted value of each channel               | (2, channels) | sensor's |
    | location    | how the place of contact is used; None: it is not             |               |          |
    | travel      | largest rise and fall of the fitted force                     |               | N        |

    The covariance is that of the curve for the combination as it is. What the combination's own numbers are uncertain
    by is part of the noise, because both were fitted without the samples that the noise was estimated from.
    """

    combination: AbstractCombination
    curve: FittedCurve
    noise: LogNoise
    reach: Float[np.ndarray, "2 channels"]
    location: LogLocation | None
    travel: Travel

    @property
    def words(self) -> str:
        """What the signal is made of."""
        has_place = self.location is not None and self.location.gain is None
        return self.combination.words + (", the last two of which are the place" if has_place else "")

    def predict(
        self,
        time: np.ndarray,
        values: Float[np.ndarray, "n channels"],
        place: Float[np.ndarray, "n 2"] | None = None,
    ) -> LogPrediction:
        """Forces at times (n,) ns, which must rise, of contacts at places (n, 2) m, which only some models need.

        What the sensor went through before the log is unknown. The force is the mean over the histories that are
        possible, and the standard error holds their spread: the differences from lags that the calibrated log had
        when it was nearest to the first reading and, for a curve with hysteresis that begins under load, a rise from
        the lowest and a fall from the highest fitted signal. Histories come together as time goes on.
        """
        location = self.location
        place = np.full((len(values), 2), np.nan) if place is None else place
        inputs = values if location is None else location.inputs(values, place)
        possible = self.combination.possible_signals(time, inputs)
        signals = self.with_extreme_histories(filter_signals(self.curve.curve, possible))
        return with_noise(self.noise, time, *self.forces(signals, values, place))

    def forces(
        self,
        signals: Float[np.ndarray, "histories m"],
        values: Float[np.ndarray, "n channels"],
        place: Float[np.ndarray, "n 2"],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force, its standard error without the noise of readings, and validity of the last n signals."""
        location = self.location
        count = len(signals)
        curves = jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf), (count, *np.shape(leaf))), self.curve)
        force, error, valid = (part[:, len(signals[0]) - len(values) :] for part in curve_forces(curves, signals))
        deviation = np.sqrt((error**2).mean(0) + force.var(0))
        force, inside = force.mean(0), np.asarray(valid.all(0)) & in_ranges(self.reach, values)
        if location is not None:
            gain, variance = location.gains(place)
            deviation = gain * np.sqrt(deviation**2 + force**2 * variance)
            force, inside = gain * force, inside & location.inside(place)
        return force, deviation, inside

    def with_extreme_histories(self, signals: Float[np.ndarray, "histories n"]) -> Float[np.ndarray, "more m"]:
        """The signals after each extreme of a history, where the curve remembers and the log begins under load."""
        known = signals[0][np.isfinite(signals[0])]
        low, high = np.asarray(self.curve.pressure_range, float)
        if not self.curve.curve.path or not len(known) or known[0] <= low + REST_FRACTION * (high - low):
            return signals
        ends = [np.full((len(signals), 1), end) for end in (low, high)]
        return np.concatenate([np.concatenate([end, signals], 1) for end in ends])


def filter_signals(curve: AbstractCurve, signals: Float[np.ndarray, "fits n"]) -> Float[np.ndarray, "fits n"]:
    """The signals as a curve takes them: for one with hysteresis, medians of three readings in turn.

    Such a curve remembers extremes: one reading that is a spike would shift its force until the signal turns again. The
    first and the last reading stay as they are, so that the newest force waits for no reading after it. Missing
    readings are passed over.
    """
    if not curve.path:
        return signals
    known, out = np.isfinite(signals[0]), signals.copy()
    x = signals[:, known]
    if x.shape[1] > 2:
        out[:, np.flatnonzero(known)[1:-1]] = median_of_three(x[:, :-2], x[:, 1:-1], x[:, 2:])
    return out


def median_of_three(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Element by element."""
    return np.asarray(np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c)))


def with_noise(
    noise: LogNoise, time: np.ndarray, force: np.ndarray, error: np.ndarray, valid: np.ndarray
) -> LogPrediction:
    """Predicted forces (n,) N at times (ns) with the noise of new readings about the model's own error (n,) N."""
    deviation = np.sqrt(error**2 + noise.variance(time, force))
    half = float(noise.multiple) * deviation
    return LogPrediction(force, deviation, force - half, force + half, valid)


def in_ranges(reach: Float[np.ndarray, "2 channels"], values: Float[np.ndarray, "n channels"]) -> np.ndarray:
    """Flags (n,) of the rows whose channels all lie within their ranges, or less than `RANGE_MARGIN` of it outside."""
    low, high = reach
    margin = RANGE_MARGIN * (high - low)
    return np.asarray(((values >= low - margin) & (values <= high + margin)).all(1))


def channel_ranges(values: Float[np.ndarray, "n channels"]) -> Float[np.ndarray, "2 channels"]:
    """Lowest and highest value of each channel."""
    return np.stack([values.min(0), values.max(0)])


def curve_forces(
    curves: FittedCurve, signals: Float[np.ndarray, "fits n"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force, standard error and validity (fits, n) of curves with a leading axis, for signals (fits, n).

    Signals are filled up to a few lengths, because each new length compiles the program again.
    """
    n = signals.shape[1]
    wide = np.pad(signals, ((0, 0), (0, bucket(n) - n)), constant_values=np.nan)
    found = predict_pads(curves, jnp.asarray(wide, curves.parameters.dtype))
    force, error, valid = (np.asarray(part)[:, :n] for part in found)
    known = np.isfinite(signals)
    return np.where(known, force, np.nan), np.where(known, error, np.nan), valid & known
