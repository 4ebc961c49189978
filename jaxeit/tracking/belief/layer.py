"""The gain of the contact layer over the sheet: its prior, and what is learned of it from contacts.

The model of a contact errs: tips are not Gaussian, and the layer of a skin may follow another law. During a press such
an error is the same in all frames, and looks like another gain there; the next press brings another error. So the gain
under a press is that of the layer plus an effect of the press, a random effect (Laird and Ware 1982, Biometrics 38,
963): drawn anew for each press from the distribution of the gain before any contact, with the variance times a number
that is the same for all presses. How large this number is, presses tell by how far they differ from what was known
before them: a bank of Kalman filters, one for each of some variances, is weighted by the probabilities that they gave
to the presses (Magill 1965, IEEE Trans. Automatic Control 10, 434).
"""

from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import eigh
from scipy.special import softmax

from ...contacts.loads.settings import LoadSettings
from ...contacts.loads.sheet import AbstractGain
from ...imaging.inputs import InverseError
from ...model.gaussian_field import field_bumps, field_nodes, field_norm

# Relative tolerance within which two fields count as equal; of places, relative to the length of the field.
FIELD_RTOL = 1e-5
# Variances of the effect of a press in the bank of filters, over that of the gain before any contact; and the variance
# below which they are about as probable as zero before any press. Larger ones are less probable the larger they are.
PRESS_VARIANCES = np.array([0.0, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
TYPICAL_VARIANCE = 0.03
# Largest variance of the effect of a press in the filter of contacts, over that of the gain before any contact.
# An effect may have any shape, and one that is odd about the contact looks like another place; those of tips are mostly
# even. With 10 in place of 0.1 places on the second simulator err twice as much. What is left out is in the error of
# the force (`consider_covariance`).
MAX_FILTER_VARIANCE = 0.1
# Smallest share of the variance of a direction of the gain that a press must take away for the direction to count.
MIN_LEARNED_SHARE = 1e-4
# Smallest share of the variance that a press leaves: less is rounding.
MIN_REMAINING_SHARE = 1e-9
# Probability of an outlier, a press of none of these variances: it bounds what one press says against any of them.
OUTLIER_PROBABILITY = 1e-3
HOUR = 3600.0  # s


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
    | sheet_error: modes that an error of the untouched sheet    | (g, c) | 1    |
    |   looks like, for each mode of this error (`apparent_gain`) |        |      |
    | mesh_error: standard deviation of the log gain that errors | ()     | 1    |
    |   of the mesh look like at a place                         |        |      |
    | depth: of the sheet, by which loads spread; under another  | ()     | m    |
    |   one presses show another gain                            |        |      |
    """

    places: Float[np.ndarray, "g 2"]
    length: float
    level: float
    deviation: float
    norm: float
    sheet_error: Float[np.ndarray, "g c"]
    mesh_error: float
    depth: float = 0.0

    @classmethod
    def on_sheet(
        cls, corners: Float[np.ndarray, "2 2"], points: Float[np.ndarray, "n 2"], loads: LoadSettings, level: float
    ) -> "GainField":
        """The field of load settings over a sheet between two corners, m, of variance one at its points on average.

        The sheet counts as known, and the mesh as without error.
        """
        length = loads.gain_length
        nodes = field_nodes(corners[0], corners[1], length)
        norm = field_norm(field_bumps(points, nodes, length))
        places = np.concatenate([np.full((1, 2), np.inf), nodes])
        return cls(places, length, level, loads.gain, norm, np.zeros((len(places), 0)), 0.0, loads.depth or 0.0)

    def modes_at(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n g"]:
        """Log gain of each mode at points (n, 2) m, per prior standard deviation of the mode."""
        bumps = field_bumps(points, self.places[1:], self.length)
        return np.concatenate([np.full((len(points), 1), self.level), self.deviation / self.norm * bumps], 1)

    def errors(self) -> Float[np.ndarray, "g e"]:
        """Modes that errors of sheet and mesh look like in all presses, for each of some standard normal numbers.

        What the mesh errs by looks like a field of gain with the covariance of that of the layer.
        """
        mesh_errors = np.eye(len(self.places))[:, 1:] * (self.mesh_error / self.deviation if self.deviation else 0.0)
        return np.concatenate([self.sheet_error, mesh_errors], 1)

    def require_same(self, other: "GainField") -> None:
        """Refuse what was learned under another field.

        Raises:
            InverseError: if places or deviations differ.
        """
        tolerance = FIELD_RTOL * self.length
        same = self.places.shape == other.places.shape and np.allclose(self.places[1:], other.places[1:], 0, tolerance)
        own, others = ([one.length, one.level, one.deviation, one.norm, one.depth] for one in (self, other))
        if not (same and np.allclose(own, others, rtol=FIELD_RTOL)):
            raise InverseError(
                "the gain of the contact layer was learned on another sheet or under other settings; learn it again"
            )


class LearnedLayer(AbstractGain):
    """Gain of the contact layer as learned from contacts: a normal distribution of its modes for each press variance.

    | meaning                                                          | shape     | unit |
    |------------------------------------------------------------------|-----------|------|
    | field: before the first contact                                  |           |      |
    | means of the modes, in units of their prior standard deviations  | (v, g)    | 1    |
    | covariances of the modes                                         | (v, g, g) | 1    |
    | evidence: log of the probability of each of `PRESS_VARIANCES`,   | (v,)      | 1    |
    |   up to a constant                                               |           |      |
    | contacts: number of contacts that it was learned from            |           |      |

    Example:
        layer = tracker.learned(now)  # the gain of the contact layer, as contacts tell it
        mean, deviation = layer.at(np.array([[0.06, 0.13]]))  # of its logarithm
        another_day = tracker.start(layer.aged(0.2))  # a fifth forgotten
    """

    field: GainField
    means: Float[np.ndarray, "v g"]
    covariances: Float[np.ndarray, "v g g"]
    evidence: Float[np.ndarray, " v"]
    contacts: int = 0

    @classmethod
    def normal(
        cls, field: GainField, mean: Float[np.ndarray, " g"], covariance: Float[np.ndarray, "g g"], contacts: int = 0
    ) -> "LearnedLayer":
        """A normal distribution, of which nothing is known how far presses differ from it."""
        count = len(PRESS_VARIANCES)
        evidence = -np.log1p(PRESS_VARIANCES / TYPICAL_VARIANCE)
        return cls(field, np.tile(mean, (count, 1)), np.tile(covariance, (count, 1, 1)), evidence, contacts)

    @classmethod
    def unknown(cls, field: GainField) -> "LearnedLayer":
        """Nothing is learned."""
        size = len(field.places)
        return cls.normal(field, np.zeros(size), np.eye(size))

    @property
    def probabilities(self) -> Float[np.ndarray, " v"]:
        """Probability of each variance of the effect of a press (`PRESS_VARIANCES`)."""
        return np.asarray(softmax(self.evidence))

    @property
    def press_variance(self) -> float:
        """Mean variance of the effect of a press, in those of the gain before any contact."""
        return float(self.probabilities @ PRESS_VARIANCES)

    @property
    def mean(self) -> Float[np.ndarray, " g"]:
        """Mean of the modes, in units of their prior standard deviations."""
        return np.asarray(self.probabilities @ self.means)

    @property
    def covariance(self) -> Float[np.ndarray, "g g"]:
        """Covariance of the modes: that which the variances have on average, and that of their means."""
        probabilities, deviations = self.probabilities, self.means - self.mean
        found = np.tensordot(probabilities, self.covariances, 1) + (deviations.T * probabilities) @ deviations
        return np.asarray(0.5 * (found + found.T))

    @property
    def under_press(self) -> Float[np.ndarray, "g g"]:
        """Covariance of the gain under the next press, whose effect is not known; its mean is that of the layer."""
        return self.covariance + self.press_variance * np.eye(len(self.field.places))

    @property
    def before_press(self) -> Float[np.ndarray, "g g"]:
        """Covariance of the gain under a new contact, with at most `MAX_FILTER_VARIANCE` of the effect of the press."""
        return self.covariance + min(self.press_variance, MAX_FILTER_VARIANCE) * np.eye(len(self.field.places))

    @property
    def unexplained(self) -> float:
        """Variance of the effect of a press beyond `MAX_FILTER_VARIANCE`, which the filter leaves out."""
        return max(self.press_variance - MAX_FILTER_VARIANCE, 0.0)

    @property
    def true_covariance(self) -> Float[np.ndarray, "g g"]:
        """Covariance of the modes of the true gain, with errors of sheet and mesh that are the same in all presses.

        `covariance` is that of the gain with which the model's sheet shows what was read, and tells forces by readings.
        Errors b of this gain that all presses share move the mean by (1 - P) b, where P is the covariance: to the whole
        of b where presses have told the gain, and not at all elsewhere (a consider covariance: Schmidt 1966, Advances
        in Control Systems 3).
        """
        covariance, errors = self.covariance, self.field.errors()
        shift = errors - covariance @ errors
        return np.asarray(covariance + shift @ shift.T)

    def told(
        self, gain: Float[Array | np.ndarray, " g"], covariance: Float[Array | np.ndarray, "n n"], contacts: int
    ) -> "LearnedLayer":
        """The gain of the layer after a press that began with `mean` and `before_press`.

        What the press told of the gain under it is a measurement y = H (g + e) + noise, along directions H of which it
        took variance away. With the gain g ~ N(m, P) and the effect e ~ N(0, v), g and the probability of v follow by
        conditioning, for each of `PRESS_VARIANCES`.

        Args:
            gain: under the press, as it was told.
            covariance: (n, n), which ends with that of this gain (g, g).
            contacts: number of contacts of the press.
        """
        after = np.asarray(covariance, float)[-len(gain) :, -len(gain) :]
        after, interval = 0.5 * (after + after.T), (-np.inf, 1 - MIN_LEARNED_SHARE)
        # x' U x = 1 and x' C x = share of the variance that remains, with the covariances U before and C after
        remaining, directions = eigh(after, self.before_press, subset_by_value=interval)
        remaining, mean = np.maximum(remaining, MIN_REMAINING_SHARE), self.mean
        measured = directions.T @ mean + directions.T @ (np.asarray(gain, float) - mean) / (1 - remaining)
        cross = self.covariances @ directions
        effects = PRESS_VARIANCES[:, None, None] * (directions.T @ directions)
        root = np.linalg.cholesky(directions.T @ cross + effects + np.diag(remaining / (1 - remaining)))
        right_side = np.concatenate([cross.mT, (measured - self.means @ directions)[..., None]], -1)
        whitened_cross, innovation = np.split(np.linalg.solve(root, right_side), [-1], -1)
        log_volume = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(1)
        return replace(
            self,
            means=self.means + (whitened_cross.mT @ innovation)[..., 0],
            covariances=self.covariances - whitened_cross.mT @ whitened_cross,
            evidence=self.evidence + _bound_evidence(-0.5 * (innovation**2).sum((1, 2)) - log_volume),
            contacts=self.contacts + contacts,
        )

    def at(self, points: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Mean and standard deviation of the log gain at points (n, 2) m, by `true_covariance`."""
        modes = self.field.modes_at(points)
        variance = ((modes @ self.true_covariance) * modes).sum(1)
        return modes @ self.mean, np.sqrt(np.maximum(variance, 0))

    def distribution(
        self, points: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n g"], Float[np.ndarray, "g g"]]:
        """Mean of the log gain at points (n, 2) m, its modes there, and their covariance under the next press."""
        modes = self.field.modes_at(points)
        return modes @ self.mean, modes, self.under_press

    def aged(self, share: float) -> "LearnedLayer":
        """After a time in which this share of what was learned, from 0 to 1, has been forgotten.

        Each mode follows an Ornstein-Uhlenbeck process about its prior: ``exp(-t / tau) = 1 - share``.
        """
        if not 0 <= share <= 1:
            raise InverseError(f"the share that is forgotten is {share}; give 0 to 1")
        kept, prior = 1 - share, LearnedLayer.unknown(self.field)
        return replace(
            self,
            means=kept * self.means,
            covariances=prior.covariances + kept**2 * (self.covariances - prior.covariances),
            evidence=prior.evidence + kept * (self.evidence - prior.evidence),
        )

    def after_use(self, seconds: float, forgetting: float) -> "LearnedLayer":
        """After so many seconds of use, where an hour gives back a part of the variance that contacts have taken away.

        The prediction step between the presses that the layer learns from: after t hours the covariance P of the modes
        is ``I + (1 - forgetting)^t (P - I)``, and their mean m is ``(1 - forgetting)^(t / 2) m``.

        Args:
            forgetting: that part, from 0 to less than 1.

        Raises:
            InverseError: if a number is out of range.
        """
        if not 0 <= seconds < np.inf:
            raise InverseError(f"seconds is {seconds}; give a time of use, zero or more")
        if not 0 <= forgetting < 1:
            raise InverseError(f"forgetting is {forgetting}; give 0 to less than 1")
        return self.aged(1 - (1 - forgetting) ** (seconds / (2 * HOUR)))

    def restarted(self) -> "LearnedLayer":
        """Without the gain, where it cannot be believed; how far presses differ stays known."""
        return replace(LearnedLayer.unknown(self.field), contacts=self.contacts, evidence=self.evidence)


def _bound_evidence(evidence: Float[np.ndarray, " v"]) -> Float[np.ndarray, " v"]:
    """Logs of probabilities of a press over that of the most probable variance, bounded by that of an outlier."""
    return np.asarray(np.logaddexp(evidence - evidence.max(), np.log(OUTLIER_PROBABILITY)))
