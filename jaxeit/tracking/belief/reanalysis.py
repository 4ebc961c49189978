"""Readings of a sheet of which a small part has changed, without a new solution of the whole sheet.

A contact changes the conductivity of the elements under it, a tenth of a mesh. With the fields x_a of unit currents
into the electrodes of the untouched sheet, the inverse G of its matrix, and the change D of its matrix among the m
unknowns S of the changed elements, the transfer matrix changes exactly by (Woodbury's identity; in structural analysis
"reanalysis", Kirsch 2002)

    dZ = -P^T Y,      (1 + D G_SS) Y = D P,      P = x_S,

and the fields among these unknowns become ``U = P - G_SS Y``, from which the adjoint identity of `forward_model` gives
the derivative of dZ in each element's conductivity: an m by m matrix is factored in place of the whole. What changes
beyond the m unknowns, the tails of a contact, counts to first order only.

The error of a coarse mesh is mostly one of first order: it is half as long as a contact is wide. So the first order is
left to an image on a fine mesh, and a coarse one tells what is beyond the first order.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse.linalg import splu

from ..._compile import full_precision, verb
from ...linalg import lapack
from ...linalg.base import on_device
from ...model.discretisation import Model
from ...model.forward_model import assemble, fields
from ...model.sheet_conductivity import Coefficients, coefficients


class Reanalysis(eqx.Module):
    """Linear mixtures of the pairs of electrodes, such as whitened readings, of a sheet with a local change.

    | meaning                                                                              | shape          | unit  |
    |--------------------------------------------------------------------------------------|----------------|-------|
    | green: potential of each unknown per ampere into each other, of the untouched sheet  | (n, n)         | ohm   |
    | potential: of unit currents into the electrodes                                      | (n, electrodes) | ohm  |
    | dofs: unknowns of each element                                                       | (elements, k)  |       |
    | slopes of each element, weighted (`System`)                                          | (elements, k, s) |     |
    | pairs: of electrodes                                                                 | (p, 2)         |       |
    | mixing: from the pairs' entries of the transfer matrix to readings                   | (p, r)         | 1/ohm |
    """

    green: Float[Array, "n n"]
    potential: Float[Array, "n electrodes"]
    dofs: Int[Array, "elements k"]
    slopes: Float[Array, "elements k s"]
    pairs: Int[Array, "p 2"]
    mixing: Float[Array, "p r"]

    def nonlinear_part(
        self, elements: Int[Array, " e"], unknowns: Int[Array, " m"], change: Float[Array, " e"]
    ) -> "NonlinearPart":
        """Nonlinear part of the change of the readings: the change less its first order.

        Args:
            elements: that change. One that occurs twice has a change of zero once.
            unknowns: m of them, solved anew; an element some of whose unknowns are not among them counts as unchanged.
                One may occur twice.
            change: of the conductivity of each element, S.
        """
        place, inside, y, after = self._solve_locally(elements, unknowns, change)
        own, before = jnp.where(inside, change, 0), self.potential[unknowns]
        untouched = self._products(self.slopes[elements], self.potential[self.dofs[elements]])
        first, second = self.pairs.T
        moved = -(before.T @ y)[first, second] + untouched @ own
        products = self._products(self.slopes[elements], after[place])
        return NonlinearPart(moved @ self.mixing, inside, products - untouched)

    def _solve_locally(
        self, elements: Int[Array, " e"], unknowns: Int[Array, " m"], change: Float[Array, " e"]
    ) -> tuple[Int[Array, "e k"], Bool[Array, " e"], Float[Array, "m electrodes"], Float[Array, "n electrodes"]]:
        """Solve the changed sheet among the unknowns: rows of each element's unknowns (m: none of these); whether they
        hold all of its unknowns; Y; and U with a row of zeros more."""
        dofs, slopes, size = self.dofs[elements], self.slopes[elements], len(unknowns)
        place = jnp.full(len(self.green), size).at[unknowns].set(jnp.arange(size))[dofs]
        inside = jnp.all(place < size, 1)
        own = jnp.where(inside, change, 0)
        blocks = jnp.einsum("e,eks,els->ekl", own, slopes, slopes)
        matrix = jnp.zeros((size + 1, size + 1), change.dtype).at[place[:, :, None], place[:, None, :]].add(blocks)
        matrix = matrix[:size, :size]
        green, before = self.green[unknowns[:, None], unknowns], self.potential[unknowns]
        y = lapack.solve(jnp.eye(size, dtype=change.dtype) + matrix @ green, matrix @ before)
        return place, inside, y, jnp.concatenate([before - green @ y, jnp.zeros_like(before[:1])])

    def potential_after(
        self, elements: Int[Array, " e"], unknowns: Int[Array, " m"], change: Float[Array, " e"]
    ) -> Float[Array, "n electrodes"]:
        """Potentials of unit currents into the electrodes after a change, on the whole sheet, ohm.

        Arguments are as for `nonlinear_part`.
        """
        _, _, y, _ = self._solve_locally(elements, unknowns, change)
        return self.potential - self.green[:, unknowns] @ y

    @verb
    def slopes_along(
        self, directions: Float[Array, "d elements"], potential: Float[Array, "n electrodes"]
    ) -> Float[Array, "d r"]:
        """Derivatives of the readings along changes of all elements, S, where unit currents have these potentials."""
        return -(directions @ self._products(self.slopes, potential[self.dofs]).T) @ self.mixing

    def _products(
        self, slopes: Float[Array, "e k s"], potential: Float[Array, "e k electrodes"]
    ) -> Float[Array, "p e"]:
        """Products of the fields of each pair of electrodes in elements."""
        fields = jnp.einsum("eks,eka->sae", slopes, potential)
        first, second = self.pairs.T
        return jnp.sum(fields[:, first] * fields[:, second], 0)

    def nonlinear_slopes(self, found: "NonlinearPart", directions: Float[Array, "d e"]) -> Float[Array, "d r"]:
        """Derivatives of `NonlinearPart.readings` along changes of the elements, by the adjoint identity."""
        own = jnp.where(found.inside, directions, 0)
        return -(own @ found.products.T) @ self.mixing


class NonlinearPart(NamedTuple):
    """Nonlinear part of the change of readings by a change of some elements.

    | meaning                                                                  | shape     |
    |--------------------------------------------------------------------------|-----------|
    | readings                                                                 | (r,)      |
    | inside: whether an element has all its unknowns among those solved anew  | (e,)      |
    | products: of the fields after the change, for each pair of electrodes, less those before | (p, e) |
    """

    readings: Float[Array, " r"]
    inside: Bool[Array, " e"]
    products: Float[Array, "p e"]


@full_precision
def prepare_reanalysis(
    model: Model,
    sigma: Float[Array, " elements"],
    pairs: Int[np.ndarray, "p 2"],
    mixing: Float[np.ndarray, "r p"],
    dtype: np.dtype,
) -> Reanalysis:
    """The untouched sheet of `Reanalysis`, in ``dtype``; memory: the square of the number of unknowns.

    Args:
        sigma: of the untouched sheet, (elements,) S.
        pairs, mixing: as in `Reanalysis`.
    """
    theta = coefficients(model, sigma)
    put = partial(on_device, dtype=dtype)
    return Reanalysis(
        green=put(_green(model, theta)),
        potential=put(fields(model, theta).potential),
        dofs=on_device(model.system.dofs, np.int32),
        slopes=put(model.system.slopes),
        pairs=on_device(pairs, np.int32),
        mixing=put(mixing.T),
    )


_assembled = verb(assemble)


def _green(model: Model, theta: Coefficients) -> Float[np.ndarray, "n n"]:
    """Potential of each unknown per ampere into each other, ohm.

    The unknowns of the matrix are potentials but for a share of the electrode's above them (`Unknowns`).
    """
    system, matrix = model.system, _assembled(model.system, theta)
    count, under = system.unknowns, np.asarray(system.under)
    share = np.append(np.asarray(matrix.share, float), 0.0)[under]
    electrode = np.append(np.asarray(system.electrode_dof), 0)[under]
    potential = sp.eye_array(count) + sp.csr_array((share, (np.arange(count), electrode)), (count, count))
    place = np.asarray(system.plan.rows), np.asarray(system.plan.cols)
    lower = sp.csc_array((np.asarray(matrix.values, float), place), (count, count))
    inverse = splu(sp.csc_array(lower + sp.tril(lower, -1).T))
    return np.asarray(potential @ inverse.solve(potential.T.toarray()))
