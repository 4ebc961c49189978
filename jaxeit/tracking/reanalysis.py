"""Readings of a sheet of which a small part has changed, without a new solution of the whole sheet.

A contact changes the conductivity of the elements under it, a tenth of a mesh. With the fields x_a of unit currents
into the electrodes of the untouched sheet, the inverse G of its matrix, and the change D of its matrix among the m
unknowns S of the changed elements, the transfer matrix changes exactly by (Woodbury's identity; in structural analysis
"reanalysis", Kirsch 2002)

    dZ = -P^T Y,      (1 + D G_SS) Y = D P,      P = x_S,

and the fields among these unknowns become ``U = P - G_SS Y``, from which the adjoint identity of `forward_model` gives
the derivative of dZ in each element's conductivity: an m by m matrix is factored in place of the whole. What changes
beyond the m unknowns, the tails of a contact, is taken to first order about the untouched sheet.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse.linalg import splu

from ..linalg import lapack
from ..model.bases import Elements
from ..model.discretisation import Model
from ..model.forward_model import assemble, coefficients, fields
from ..model.sensitivity import pair_jacobian


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
    | linear: readings per change of each element, to first order                          | (elements, r)  | 1/S   |
    """

    green: Float[Array, "n n"]
    potential: Float[Array, "n electrodes"]
    dofs: Int[Array, "elements k"]
    slopes: Float[Array, "elements k s"]
    pairs: Int[Array, "p 2"]
    mixing: Float[Array, "p r"]
    linear: Float[Array, "elements r"]

    def readings(self, elements: Int[Array, " e"], change: Float[Array, " e"], size: int) -> Float[Array, " r"]:
        """Readings of the changed sheet less those of the untouched one.

        Derivatives of first order with respect to ``change`` cost no further factorisation.

        Args:
            elements: that change, each once.
            change: of their conductivity, S.
            size: number m of unknowns around the largest changes that are solved anew.
        """
        found: Array = _readings(change, elements, self, size)
        return found


class _Solved(NamedTuple):
    """What a change of the elements does.

    | meaning                                                                  | shape     |
    |--------------------------------------------------------------------------|-----------|
    | readings                                                                 | (r,)      |
    | core: places among the elements of those that are solved anew            | (c,)      |
    | inside: whether an element of the core is, with all its unknowns         | (c,)      |
    | products: of the fields after the change, for each pair of electrodes    | (c, p)    |
    """

    readings: Float[Array, " r"]
    core: Int[Array, " c"]
    inside: Bool[Array, " c"]
    products: Float[Array, "c p"]


def _solve(change: Float[Array, " e"], elements: Int[Array, " e"], sheet: Reanalysis, size: int) -> _Solved:
    unknowns = len(sheet.green)
    dofs = sheet.dofs[elements]
    around = jnp.zeros(unknowns, change.dtype).at[dofs].max(jnp.abs(change)[:, None])
    chosen = jax.lax.top_k(around, size)[1]
    place = jnp.full(unknowns, size).at[chosen].set(jnp.arange(size))
    core = jax.lax.top_k(jnp.abs(change), min(2 * size, len(change)))[1]
    local = place[dofs[core]]
    inside = jnp.all(local < size, 1)
    own, slopes = jnp.where(inside, change[core], 0), sheet.slopes[elements[core]]
    blocks = jnp.einsum("c,cks,cls->ckl", own, slopes, slopes)
    matrix = jnp.zeros((size + 1, size + 1), change.dtype).at[local[:, :, None], local[:, None, :]].add(blocks)
    matrix = matrix[:size, :size]
    green, before = sheet.green[chosen[:, None], chosen], sheet.potential[chosen]
    y = lapack.solve(jnp.eye(size, dtype=change.dtype) + matrix @ green, matrix @ before)
    first, second = sheet.pairs.T
    moved = -before.T @ y
    after = jnp.concatenate([before - green @ y, jnp.zeros_like(before[:1])])
    fields = jnp.einsum("cks,cka->csa", slopes, after[local])
    products = jnp.sum(fields[..., first] * fields[..., second], 1)
    readings = moved[first, second] @ sheet.mixing + change.at[core].add(-own) @ sheet.linear[elements]
    return _Solved(readings, core, inside, products)


@eqx.filter_custom_jvp
def _readings(
    change: Float[Array, " e"], elements: Int[Array, " e"], sheet: Reanalysis, size: int
) -> Float[Array, " r"]:
    return _solve(change, elements, sheet, size).readings


def _readings_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Float[Array, " r"], Float[Array, " r"]]:
    change, elements, sheet, size = primals
    found = _solve(change, elements, sheet, size)
    if tangents[0] is None:
        return found.readings, jnp.zeros_like(found.readings)
    direction = tangents[0]
    own = jnp.where(found.inside, direction[found.core], 0)
    rest = direction.at[found.core].add(-own)
    return found.readings, rest @ sheet.linear[elements] - (own @ found.products) @ sheet.mixing


_readings.def_jvp(_readings_jvp)


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
    system = model.system
    theta = coefficients(model, sigma)
    matrix = assemble(system, theta)
    share = np.append(np.asarray(matrix.share, float), 0.0)[np.asarray(system.under)]
    unknowns = system.unknowns
    electrode = np.append(np.asarray(system.electrode_dof), 0)[np.asarray(system.under)]
    lift = sp.eye_array(unknowns, format="csr") + sp.csr_array(
        (share, (np.arange(unknowns), electrode)), (unknowns, unknowns)
    )
    rows, cols = np.asarray(system.plan.rows), np.asarray(system.plan.cols)
    lower = sp.csc_array((np.asarray(matrix.values, float), (rows, cols)), (unknowns, unknowns))
    whole = lower + sp.tril(lower, -1).T
    green = lift @ splu(sp.csc_array(whole)).solve(lift.T.toarray())
    put = partial(jnp.asarray, dtype=dtype)
    slopes = pair_jacobian(model, sigma, Elements().on(model), jnp.asarray(pairs), jnp.asarray(mixing, model.dtype))
    return Reanalysis(
        green=put(green),
        potential=put(fields(model, theta).potential),
        dofs=jnp.asarray(system.dofs, jnp.int32),
        slopes=put(system.slopes),
        pairs=jnp.asarray(pairs, jnp.int32),
        mixing=put(mixing.T),
        linear=put(slopes.T),
    )
