"""The force of a contact by what readings tell of it: a law that is learned from contacts whose force the pads tell.

Readings tell a force through the law by which pressure makes the contact layer conduct. Where the layer follows another
law, the force that readings alone tell is wrong by a factor that depends on the force and on the width of the load, and
no gain of a place can mend that. With the true force F, and with f and w as readings alone tell force and width,

    log f = log F + a + b log(F / F0) + c log(w / w0) + e,

where a, b and c and the scatter of e are learned: a linear model with conjugate priors (normal and inverse gamma;
Gelman et al. 2013, Bayesian Data Analysis, ch. 14), whose updates are exact. The force follows by solving for F. The
regression is that of readings on force, and not the reverse: its numbers then do not depend on which forces happened to
press, and presses of one force alone do not teach that every force is that one.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..contacts.loads.settings import LoadSettings
from ..imaging.inputs import InverseError
from .tracks import Track

# Prior standard deviations of a, b and c, and prior scatter of e, which counts as `PRIOR_SHAPE` times two contacts.
PRIOR_STD, PRIOR_SCATTER, PRIOR_SHAPE = np.array([1.0, 1.0, 2.0]), 0.3, 1.5
# Smallest number of contacts, and smallest log of the ratio of probabilities of their forces with and without the law,
# with which the law is used: 20 to 1.
MIN_CONTACTS, MIN_LOG_RATIO = 5, 3.0
# Range beyond the logs of force and width of the contacts learned from, in which the law is extrapolated; its largest
# log factor; and its smallest slope 1 + b, below which readings hardly inform on a force.
EXTRAPOLATION, MAX_LOG_FACTOR, MIN_SLOPE = 0.5, 3.0, 0.3
REFERENCE_LOGS = np.log([LoadSettings.force, LoadSettings.width])


class ContactLaw(NamedTuple):
    """What contacts have told of the force by which readings err.

    With f and w the force and the width that readings alone tell, F the true force, F0 and w0 usual ones,
    ``log f = log F + a + b log(F / F0) + c log(w / w0) + e`` with a normal error e.

    | meaning                                                                     | shape  | unit |
    |-----------------------------------------------------------------------------|--------|------|
    | mean of a, b and c                                                          | (3,)   | 1    |
    | covariance of these, in units of the variance of e                          | (3, 3) | 1    |
    | shape, rate: of the inverse gamma distribution of the variance of e         | ()     | 1    |
    | plain: that rate if a, b and c were zero                                    | ()     | 1    |
    | evidence: log ratio of the probabilities of what readings told of all contacts, | () | 1    |
    |   with the law and without                                                  |        |      |
    | low, high: least and largest logs of force and width learned from           | (2,)   | 1    |
    | contacts: number of contacts that it was learned from                       |        |      |

    Example:
        law = tracking.ContactLaw.unknown()
        for track in now.tracks:  # of a frame without pads, whose force is 5 N
            law = law.told(track, 5.0)
        print(law.is_better, [law.applied(track).force for track in now.tracks])
    """

    mean: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    shape: float
    rate: float
    plain: float
    evidence: float
    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]
    contacts: int = 0

    @classmethod
    def unknown(cls) -> "ContactLaw":
        """Nothing is learned."""
        rate = PRIOR_SHAPE * PRIOR_SCATTER**2
        covariance = np.diag((PRIOR_STD / PRIOR_SCATTER) ** 2)
        return cls(np.zeros(3), covariance, PRIOR_SHAPE, rate, rate, 0.0, REFERENCE_LOGS, REFERENCE_LOGS)

    @property
    def is_better(self) -> bool:
        """Whether what readings told of contacts so far was more probable with the law than without, each before it was
        told.

        Where the law of the model is right this stays false, and nothing is changed.
        """
        return self.contacts >= MIN_CONTACTS and self.evidence > MIN_LOG_RATIO

    @property
    def slope(self) -> float:
        """Slope 1 + b of the log force that readings alone tell, over the log of the true force."""
        return max(1 + float(self.mean[1]), MIN_SLOPE)

    @property
    def scatter(self) -> float:
        """Standard deviation of e."""
        return math.sqrt(self.rate / (self.shape - 1))

    def render(self) -> str:
        """By which law readings alone tell the force, in one line."""
        if not self.is_better:
            return f"as the model tells it; {self.contacts} contacts do not speak for another law"
        return (
            f"the model's force goes as the power {self.slope:.2f} of the true force and {self.mean[2]:.2f} of the "
            f"width, learned from {self.contacts} contacts; standard error {100 * self.scatter / self.slope:.0f} %"
        )

    def told(self, seen: Track, force: float) -> "ContactLaw":
        """The law after one more contact.

        Args:
            seen: the contact as readings alone tell it, without the law.
            force: of the contact, as pads tell it, N.

        Raises:
            InverseError: if a force is not above zero.
        """
        if not (0 < force < math.inf and 0 < seen.force < math.inf):
            raise InverseError(f"forces {seen.force} and {force} N do not tell a law; give numbers above zero")
        row, error = np.log([force, seen.width]), math.log(seen.force / force)
        x = _regressors(row)
        cross = self.covariance @ x
        spread, residual = 1 + float(x @ cross), error - float(x @ self.mean)
        # Evidence is that of predictions: each contact is predicted by the law before it changes the law.
        log_density = _log_student(residual, self.shape, self.rate, spread)
        log_density_without = _log_student(error, self.shape, self.plain, 1.0)
        learned = self.contacts > 0
        return ContactLaw(
            mean=self.mean + cross * residual / spread,
            covariance=self.covariance - np.outer(cross, cross) / spread,
            shape=self.shape + 0.5,
            rate=self.rate + 0.5 * residual**2 / spread,
            plain=self.plain + 0.5 * error**2,
            evidence=self.evidence + (log_density - log_density_without),
            low=np.minimum(self.low, row) if learned else row,
            high=np.maximum(self.high, row) if learned else row,
            contacts=self.contacts + 1,
        )

    def aged(self, share: float) -> "ContactLaw":
        """After a time in which this share of what was learned, from 0 to 1, has been forgotten."""
        if not 0 <= share <= 1:
            raise InverseError(f"the share that is forgotten is {share}; give 0 to 1")
        kept, prior = 1 - share, ContactLaw.unknown()
        return self._replace(
            mean=kept * self.mean,
            covariance=prior.covariance + kept**2 * (self.covariance - prior.covariance),
            shape=prior.shape + kept * (self.shape - prior.shape),
            rate=prior.rate + kept * (self.rate - prior.rate),
            plain=prior.plain + kept * (self.plain - prior.plain),
            evidence=kept * self.evidence,
        )

    def applied(self, track: Track) -> Track:
        """A contact that readings alone tell, with the force and its error as the law tells them.

        The contact is unchanged unless the law `is_better`. Beyond the forces and widths from which the law was learned
        its factor stays that at their end.
        """
        if not self.is_better:
            return track
        seen, width = np.log([track.force, track.width]) - REFERENCE_LOGS
        low, high = self.low - REFERENCE_LOGS - EXTRAPOLATION, self.high - REFERENCE_LOGS + EXTRAPOLATION
        width = float(np.clip(width, low[1], high[1]))
        log_force = float(np.clip((seen - self.mean[0] - self.mean[2] * width) / self.slope, low[0], high[0]))
        factor = -(self.mean[0] + (self.slope - 1) * log_force + self.mean[2] * width)
        x = np.array([1.0, log_force, width])
        error = self.scatter * math.sqrt(1 + float(x @ self.covariance @ x)) / self.slope
        force = track.force * math.exp(float(np.clip(factor, -MAX_LOG_FACTOR, MAX_LOG_FACTOR)))
        return track._replace(force=force, log_force_error=error)

    def without_pads(self, tracks: tuple[Track, ...], told: Bool[np.ndarray, " n"]) -> tuple[Track, ...]:
        """Contacts of which some are told by pads (`Tracker.told_by_pads`), with the law for the others."""
        return tuple(one if known else self.applied(one) for one, known in zip(tracks, told, strict=True))


def _regressors(row: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3"]:
    """Factors of a, b and c at logs of force and width."""
    return np.array([1.0, *(row - REFERENCE_LOGS)])


def _log_student(residual: float, shape: float, rate: float, spread: float) -> float:
    """Log density of an error whose variance is ``spread`` times that of e, over all variances of e."""
    scale = 2 * rate * spread
    ratio = math.lgamma(shape + 0.5) - math.lgamma(shape) - 0.5 * math.log(math.pi * scale)
    return ratio - (shape + 0.5) * math.log1p(residual**2 / scale)
