"""The gain of the contact layer over the sheet: what is known of it beforehand, and what contacts have told of it.

The model of a contact errs: tips are not Gaussian, and the layer of a skin may follow another law. During a press such
an error is the same in all frames, and looks like another gain there; the next press brings another error. So the gain
under a press is that of the layer plus an effect of the press, a random effect (Laird and Ware 1982, Biometrics 38,
963): drawn anew for each press from the distribution of the gain before any contact, with the variance times a number
that is the same for all presses. That number is learned from how far presses differ from what was known before them.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from ...contacts.loads.preparation import field_bumps, field_nodes, field_norm
from ...contacts.loads.settings import LoadSettings
from ...imaging.noise import InverseError

# Difference within which numbers of two fields count as equal, relative to the length of the field.
SAME = 1e-5
# Variances of the effect of a press that are considered, in those of the gain before any contact.
PRESS_VARIANCES = np.array([0.0, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
# Least share of the variance of a direction of the gain that a press takes away, for the direction to count.
LEAST_TOLD = 0.01
# Least share that it leaves: rounding.
TINY = 1e-9
# Probability of a press that is like none of these: it says no more than this against any of them.
OUTLIER = 1e-3


class GainField(eqx.Module):
    """The log gain before any contact: a level that all places share, and a Gaussian field made of bumps.

    The field has the covariance ``deviation^2 exp(-d^2 / (2 length^2))``. Mode 0 is the level; the others are bumps at
    the places of a grid of pitch ``length``.

    | meaning                                                    | shape  | unit |
    |------------------------------------------------------------|--------|------|
    | places: of the modes; that of the level is infinite        | (g, 2) | m    |
    | length: over which the field changes                       | ()     | m    |
    | level, deviation: standard deviations of level and field   | ()     | 1    |
    | norm: root of the sum of squares of the bumps at a place   | ()     | 1    |
    """

    places: Float[np.ndarray, "g 2"]
    length: float
    level: float
    deviation: float
    norm: float

    @classmethod
    def over(
        cls, corners: Float[np.ndarray, "2 2"], points: Float[np.ndarray, "n 2"], loads: LoadSettings, level: float
    ) -> "GainField":
        """The field of load settings over a sheet between two corners, m, of variance one at its points on average."""
        length = loads.gain_length
        nodes = field_nodes(corners[0], corners[1], length)
        norm = field_norm(field_bumps(points, nodes, length))
        return cls(np.concatenate([np.full((1, 2), np.inf), nodes]), length, level, loads.gain, norm)

    def modes_at(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n g"]:
        """Log gain of each mode at points (n, 2) m, per prior standard deviation of the mode."""
        bumps = field_bumps(points, self.places[1:], self.length)
        return np.concatenate([np.full((len(points), 1), self.level), self.deviation / self.norm * bumps], 1)

    def require_same(self, other: "GainField") -> None:
        """Refuse what was learned under another field.

        Raises:
            InverseError: if places or deviations differ.
        """
        near = SAME * self.length
        same = self.places.shape == other.places.shape and np.allclose(self.places[1:], other.places[1:], 0, near)
        mine, its = ([field.length, field.level, field.deviation, field.norm] for field in (self, other))
        if not (same and np.allclose(mine, its, rtol=SAME)):
            raise InverseError(
                "the gain of the contact layer was learned on another sheet or under other settings; learn it again"
            )


class LearnedLayer(NamedTuple):
    """Gain of the contact layer as learned from contacts: a normal distribution of its modes.

    | meaning                                                          | shape  | unit |
    |------------------------------------------------------------------|--------|------|
    | field: before the first contact                                  |        |      |
    | mean of the modes, in units of their prior standard deviations   | (g,)   | 1    |
    | covariance of the modes                                          | (g, g) | 1    |
    | contacts: number of contacts that it was learned from            |        |      |
    | evidence: log of the probability of all presses, for each of     | (v,)   | 1    |
    |   `PRESS_VARIANCES`, up to a constant                            |        |      |

    Example:
        layer = tracker.learned(now)  # the gain of the contact layer, as contacts tell it
        mean, deviation = layer.at(np.array([[0.06, 0.13]]))  # of its logarithm
        another_day = tracker.start(layer.aged(0.2))  # a fifth forgotten
    """

    field: GainField
    mean: Float[np.ndarray, " g"]
    covariance: Float[np.ndarray, "g g"]
    contacts: int = 0
    evidence: Float[np.ndarray, " v"] = np.zeros(len(PRESS_VARIANCES))

    @classmethod
    def unknown(cls, field: GainField) -> "LearnedLayer":
        """Nothing is learned."""
        size = len(field.places)
        return cls(field, np.zeros(size), np.eye(size))

    @property
    def press_variance(self) -> float:
        """The most probable of `PRESS_VARIANCES`: none where the model of contacts is right, and before any press."""
        return float(PRESS_VARIANCES[np.argmax(self.evidence)])

    @property
    def under_press(self) -> Float[np.ndarray, "g g"]:
        """Covariance of the gain under the next press, whose effect is not known; its mean is that of the layer."""
        return self.covariance + self.press_variance * np.eye(len(self.mean))

    def told(
        self, gain: Float[Array | np.ndarray, " g"], covariance: Float[Array | np.ndarray, "n n"], contacts: int
    ) -> "LearnedLayer":
        """The gain of the layer after a press that began with `mean` and `under_press`.

        What the press told of the gain under it is a measurement y = H (g + e) + noise, along directions H of which it
        took variance away. With the gain g ~ N(m, P), the effect e ~ N(0, v) and v the most probable variance
        after this press, g follows by conditioning. A press that was believed under a smaller variance than later ones
        show stays so believed: where effects are small beside the gain, the stated covariance is too small.

        Args:
            gain: under the press, as it was told.
            covariance: (n, n), which ends with that of this gain (g, g).
            contacts: number of contacts of the press.
        """
        own = np.asarray(covariance, float)[-len(gain) :, -len(gain) :]
        root = np.linalg.cholesky(self.under_press)
        white = solve_triangular(root, solve_triangular(root, 0.5 * (own + own.T), lower=True).T, lower=True)
        left, directions = np.linalg.eigh(0.5 * (white + white.T))
        kept = left < 1 - LEAST_TOLD
        left, along = np.maximum(left[kept], TINY), solve_triangular(root.T, directions[:, kept])
        seen, noise = along.T @ (np.asarray(gain, float) - self.mean) / (1 - left), left / (1 - left)
        towards, effect = self.covariance @ along, along.T @ along
        known = along.T @ towards + np.diag(noise)
        evidence = self.evidence + _bounded([_log_normal(seen, known + v * effect) for v in PRESS_VARIANCES])
        whole = cho_factor(known + PRESS_VARIANCES[np.argmax(evidence)] * effect)
        left_over = self.covariance - towards @ cho_solve(whole, towards.T)
        return self._replace(
            mean=self.mean + towards @ cho_solve(whole, seen),
            covariance=0.5 * (left_over + left_over.T),
            contacts=self.contacts + contacts,
            evidence=evidence,
        )

    def at(self, points: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Mean and standard deviation of the log gain at points (n, 2) m."""
        modes = self.field.modes_at(points)
        variance = ((modes @ self.covariance) * modes).sum(1)
        return modes @ self.mean, np.sqrt(np.maximum(variance, 0))

    def aged(self, share: float) -> "LearnedLayer":
        """After a time in which this share of what was learned, from 0 to 1, has been forgotten.

        Each mode follows an Ornstein-Uhlenbeck process about its prior: ``exp(-t / tau) = 1 - share``.
        """
        if not 0 <= share <= 1:
            raise InverseError(f"the share that is forgotten is {share}; give 0 to 1")
        kept = 1 - share
        unit = np.eye(len(self.mean))
        return self._replace(
            mean=kept * self.mean, covariance=unit + kept**2 * (self.covariance - unit), evidence=kept * self.evidence
        )

    def restarted(self) -> "LearnedLayer":
        """Without the gain, where it cannot be believed; how far presses differ stays known."""
        return LearnedLayer.unknown(self.field)._replace(contacts=self.contacts, evidence=self.evidence)


def _log_normal(seen: Float[np.ndarray, " k"], covariance: Float[np.ndarray, "k k"]) -> float:
    """Log density of a normal distribution about zero, up to a constant."""
    root = np.linalg.cholesky(covariance)
    return float(-0.5 * np.sum(np.linalg.solve(root, seen) ** 2) - np.sum(np.log(np.diag(root))))


def _bounded(evidence: list[float]) -> Float[np.ndarray, " v"]:
    """Logs of probabilities of a press, over that of the most probable variance, which one press cannot rule out."""
    found = np.array(evidence)
    return np.asarray(np.logaddexp(found - found.max(), np.log(OUTLIER)))
