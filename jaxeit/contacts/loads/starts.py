"""Where fits of loads begin."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import orth, solve_triangular
from scipy.special import logsumexp

from ...effects.material import ContactPiezoresistance
from ..result import Contacts
from ..starts import MIN_INDEPENDENT_FRACTION

MIN_REACH, MAX_REACH = 0.5, 1.6  # of the halves of a split load from its middle, in its widths


class Starts(eqx.Module):
    """Where fits of loads begin.

    | meaning                                                       | shape  | unit |
    |---------------------------------------------------------------|--------|------|
    | atoms: whitened readings of usual loads all over the sheet    | (b, r) |      |
    | places: of these, x and y; and their log width, log force     | (b, 4) |      |
    | background: mean conductivity of the sheet                    | ()     | S    |
    """

    atoms: Float[Array, "b r"]
    places: Float[Array, "b 4"]
    background: Float[Array, ""]
    law: ContactPiezoresistance

    def single(self, y: np.ndarray, contacts: Contacts) -> np.ndarray:
        """One load in the place of all contacts, or the atom that explains most; (1, 4)."""
        present = np.asarray(contacts.present)
        if not present.any():
            return self.best_atom(y, np.eye(len(y)))[1]
        rows, weight = self.as_loads(contacts), np.where(present, np.asarray(contacts.strength), 0)
        centre = weight @ rows[:, :3] / weight.sum()
        return np.append(centre, logsumexp(rows[present, 3]))[None]

    def strongest(self, contacts: Contacts, count: int) -> list[np.ndarray]:
        """The strongest contacts (count, 4), if there are so many."""
        return [self.as_loads(contacts)[:count]] if np.sum(contacts.present) >= count else []

    def split(self, load: np.ndarray, moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A load as two narrower ones (2, 4), and as an edge (1, 6), with second moments by a frame.

        Halves at d from the middle change the pressure by ``(dx^2 - dy^2) / 2`` and ``dx dy`` times `elongations`, in
        units of the width.
        """
        angle = 0.5 * np.arctan2(moments[1], moments[0])
        length = np.clip(np.sqrt(2 * np.hypot(*moments)), MIN_REACH, MAX_REACH)
        step = length * np.exp(load[2]) * np.array([np.cos(angle), np.sin(angle)])
        width = load[2] + 0.5 * np.log(max(1 - 0.5 * length**2, 0.25))
        half = np.array([width, load[3] - np.log(2)])
        halves = np.stack([np.append(load[:2] + step, half), np.append(load[:2] - step, half)])
        return halves, np.concatenate([load[:2], [width, load[3]], np.sqrt(3) * step])[None]

    @staticmethod
    def edge_between(two: np.ndarray) -> tuple[float, np.ndarray]:
        """Share of the weaker of two loads, and an edge (1, 6) with their force, middle and second moment along it."""
        share = np.exp(two[:, 3] - logsumexp(two[:, 3]))
        half = np.sqrt(3 * share[0] * share[1]) * (two[1, :2] - two[0, :2])
        return float(share.min()), np.concatenate([share @ two[:, :3], [logsumexp(two[:, 3])], half])[None]

    def with_third(
        self, two: np.ndarray, root: np.ndarray, residual: np.ndarray, slopes: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """Two loads and the atom that explains most of their residual, (3, 4); and by how much chi-square falls with
        it, with the two eliminated along their slopes (r, m)."""
        fall, atom = self.best_atom(residual, root, slopes)
        return fall, np.concatenate([two[:, :4], atom])

    def best_atom(
        self, residual: np.ndarray, root: np.ndarray, slopes: np.ndarray | None = None
    ) -> tuple[float, np.ndarray]:
        """The atom that explains most of a residual in units of errors: fall of chi-square, and the load (1, 4).

        An atom that the slopes explain nearly all of is no other load: its strength would be a quotient of roundings.
        """
        atoms = solve_triangular(root, np.asarray(self.atoms).T, lower=True)
        lengths = np.linalg.norm(atoms, axis=0)
        if slopes is not None:
            basis = orth(solve_triangular(root, slopes, lower=True))
            atoms, residual = (part - basis @ (basis.T @ part) for part in (atoms, residual))
        norms = np.linalg.norm(atoms, axis=0)
        independent = norms**2 > MIN_INDEPENDENT_FRACTION * lengths**2
        norms = np.where(independent, norms, 1)
        gain = np.where(independent, atoms.T @ residual / norms, -np.inf)
        best = int(np.argmax(gain))
        force = max(gain[best] / norms[best], 0.02)  # over that of the atom
        fall = float(max(gain[best], 0) ** 2)
        return fall, (np.asarray(self.places)[best] + [0, 0, 0, np.log(force)])[None]

    def as_loads(self, contacts: Contacts) -> np.ndarray:
        """Contacts as loads (K, 4): the force whose pressure changes the middle of the bump as much."""
        width, law = np.maximum(np.asarray(contacts.width), 1e-3), jax.tree.map(float, self.law)
        change = np.clip(np.asarray(contacts.amplitude) / float(self.background) / law.amplitude, 0.01, 0.95)
        pressure = law.half_pressure * (change / (1 - change)) ** (1 / law.exponent)
        force = np.log(2 * np.pi * width**2 * pressure)
        return np.concatenate([np.asarray(contacts.position), np.log(width)[:, None], force[:, None]], 1)
