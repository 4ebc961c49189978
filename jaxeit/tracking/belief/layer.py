"""The gain of the contact layer over the sheet: what is known of it beforehand, and what contacts have told of it."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ...contacts.loads.preparation import field_bumps, field_nodes, field_norm
from ...contacts.loads.settings import LoadSettings
from ...imaging.noise import InverseError

# Difference within which numbers of two fields count as equal, relative to the length of the field.
SAME = 1e-5


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

    Example:
        layer = tracker.learned(now)  # the gain of the contact layer, as contacts tell it
        mean, deviation = layer.at(np.array([[0.06, 0.13]]))  # of its logarithm
        another_day = tracker.start(layer.aged(0.2))  # a fifth forgotten
    """

    field: GainField
    mean: Float[np.ndarray, " g"]
    covariance: Float[np.ndarray, "g g"]
    contacts: int = 0

    @classmethod
    def unknown(cls, field: GainField) -> "LearnedLayer":
        """Nothing is learned."""
        size = len(field.places)
        return cls(field, np.zeros(size), np.eye(size))

    @classmethod
    def of_belief(
        cls,
        field: GainField,
        gain: Float[Array | np.ndarray, " g"],
        covariance: Float[Array | np.ndarray, "n n"],
        contacts: int,
    ) -> "LearnedLayer":
        """The gain of a belief of contacts and gain, whose covariance (n, n) ends with that of the gain (g, g)."""
        mean, own = np.asarray(gain, float), np.asarray(covariance, float)[-len(gain) :, -len(gain) :]
        return cls(field, mean, 0.5 * (own + own.T), contacts)

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
        return self._replace(mean=kept * self.mean, covariance=unit + kept**2 * (self.covariance - unit))
