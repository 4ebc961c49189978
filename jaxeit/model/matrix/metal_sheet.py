"""A metal coat: a second conducting sheet, which touches the first under pressure.

With u and m the potentials of sheet and metal, g the conductance of their contact per area, and no
current through the metal's rim,

    -div(sigma grad u) + g (u - m) = 0,        -div(s grad m) + g (m - u) = 0.

The metal conducts a thousand times better, so that its potential is nearly constant: the metal has
linear elements on a mesh of its own, which is not refined at electrodes.  The metal floats: the contacts
alone determine the constant, and light contacts would do so in the last digits of a matrix for m.  The
unknowns are therefore v and c with ``m = v + c``, and v is zero at one node.  The row of c holds contact
conductances only and loses no digits to larger numbers.  Without any contact c is set to zero, which no
reading depends on.

The contact is integrated at the sheet's nodes (at midpoints of edges for P2): each exchanges current
with the metal at its own place only.  This avoids oscillations on a mesh that does not resolve the
transfer length ``(g / sigma)^-1/2``, which is below a millimetre.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from ...linalg import AbstractLinearSolver, AbstractPlan, SparsityPattern
from ...meshing.elements import Space
from ...meshing.triangles import Mesh

# The triangle around a point is searched among this many with the nearest centroids: in a graded mesh the nearest
# centroid may be that of another triangle.
CANDIDATE_TRIANGLES = 16


class Coat(eqx.Module):
    """The matrix of sheet and metal with its numbers left out; unknowns and entries of the sheet come first.

    Index ``unknowns`` of both stands for the v that is held at zero, and for no electrode.  A contact node
    joins six unknowns: w of the sheet and U of the electrode above (`unknowns`), v at the corners of the
    triangle of metal around it, and c.

    | meaning                                                                   | shape            |
    |---------------------------------------------------------------------------|------------------|
    | dofs: the v of each triangle of the metal                                 | (triangles, 3)   |
    | slopes of each triangle, weighted (`elements`)                            | (triangles, 3, r)|
    | stiffness: entries of the metal at unit conductivity                      | (entries,)       |
    | areas of the parts of an element at its contact nodes, m^2                | (elements, q)    |
    | touching: those nodes, among all contact nodes                            | (elements, q)    |
    | sides: the unknowns that a contact node joins                             | (contacts, 6)    |
    | corners: weights of the v                                                 | (contacts, 3)    |
    | under: the complete electrode above                                       | (contacts,)      |
    | slots: place in the matrix of what each pair of those six adds            | (contacts, 21)   |
    | plan for sheet and metal                                                  |                  |
    """

    dofs: Int[Array, "triangles 3"]
    slopes: Float[Array, "triangles 3 r"]
    stiffness: Float[Array, " entries"]
    areas: Float[Array, "elements q"]
    touching: Int[Array, "elements q"]
    sides: Int[Array, "contacts 6"]
    corners: Float[Array, "contacts 3"]
    under: Int[Array, " contacts"]
    slots: Int[Array, "contacts 21"]
    plan: AbstractPlan


class CoatCoefficients(NamedTuple):
    """The coefficients of the coat: conductivity of the metal, S; conductance of the contact, S/m^2."""

    metal: Float[Array, ""]
    coupling: Float[Array, " elements"]


class CoatFields(NamedTuple):
    """Potentials per ampere driven into each electrode, in ohm.

    | meaning                                                        | shape                      |
    |----------------------------------------------------------------|----------------------------|
    | potential: v of the metal at the unknowns of both              | (unknowns + 1, electrodes) |
    | drop from sheet to metal at the contact nodes                  | (contacts, electrodes)     |
    """

    potential: Float[Array, "unknowns_and_ground electrodes"]
    drop: Float[Array, "contacts electrodes"]


def assembled_coat(
    metal: Space,
    space: Space,
    sheet: SparsityPattern,
    index: Int[np.ndarray, " dofs"],
    above: Int[np.ndarray, " dofs"],
    electrode_dof: Int[np.ndarray, " electrodes"],
    solver: AbstractLinearSolver,
    put: Callable[[np.ndarray], Array],
) -> Coat:
    """The coat over a sheet of this pattern.

    Args:
        metal: linear elements on its mesh.
        index: the sheet's unknown at each dof.
        above: the complete electrode over each dof, or the number of electrodes.
        electrode_dof: the unknown that is each electrode's potential.
    """
    end = sheet.n + len(metal.points)
    v = np.append(end, np.arange(sheet.n, end - 1))
    nodes, areas, touching = _contact_nodes(space)
    triangle, corners = containing_triangles(metal.mesh, space.chart[nodes])
    potential = np.append(electrode_dof, end)[above[nodes]]
    common = np.full(len(nodes), end - 1)
    sides = np.column_stack([index[nodes], potential, v[metal.dofs[triangle]], common])
    entries, stiffness = _metal(v[metal.dofs], metal.stiffness, end)
    entries, slots = _with_contact_entries(np.append(_key(sheet.rows, sheet.cols, end), entries), sides, end)
    coords = np.concatenate([sheet.coords, metal.chart[1:], np.full((1, 2), np.nan)])
    return Coat(
        dofs=put(v[metal.dofs]),
        slopes=put(metal.slopes),
        stiffness=put(stiffness),
        areas=put(areas),
        touching=put(touching),
        sides=put(sides),
        corners=put(corners),
        under=put(above[nodes]),
        slots=put(slots),
        plan=solver.analyse(SparsityPattern(end, entries // end, entries % end, coords, sheet.root)),
    )


def _contact_nodes(space: Space) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nodes with an area of their own; those areas, element by element; and whose they are."""
    share = space.element.mass.sum(1)
    used = share > 1e-9  # the corners of P2 have none
    nodes, touching = np.unique(space.dofs[:, used], return_inverse=True)
    return nodes, space.mesh.areas[:, None] * share[used], touching.reshape(-1, np.count_nonzero(used))


def containing_triangles(mesh: Mesh, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The triangle around each place, and the weights of its corners; beyond the rim, the nearest triangle."""
    _, near = cKDTree(mesh.chart_centroids).query(places, min(CANDIDATE_TRIANGLES, len(mesh.triangles)))
    first, *others = np.moveaxis(mesh.chart[mesh.triangles[near]], 2, 0)
    edges = np.stack([corner - first for corner in others], -1)
    inner = np.linalg.solve(edges, (places[:, None] - first)[..., None])[..., 0]
    weights = np.concatenate([1 - inner.sum(-1, keepdims=True), inner], -1)
    best = np.arange(len(places)), weights.min(-1).argmax(1)
    inside = np.maximum(weights[best], 0)
    return near[best], inside / inside.sum(1, keepdims=True)


def _metal(dofs: np.ndarray, stiffness: np.ndarray, end: int) -> tuple[np.ndarray, np.ndarray]:
    """Places of the entries of the metal's own matrix, as keys, and their values at unit conductivity."""
    rows, cols = np.repeat(dofs, 3, 1).ravel(), np.tile(dofs, (1, 3)).ravel()
    kept = (rows >= cols) & (rows < end)
    entries, entry = np.unique(_key(rows[kept], cols[kept], end), return_inverse=True)
    return entries, np.bincount(entry, stiffness.ravel()[kept])


def _with_contact_entries(entries: np.ndarray, sides: np.ndarray, end: int) -> tuple[np.ndarray, np.ndarray]:
    """The keys of all entries, those of the contact last; and the position of each contribution of the contact."""
    low, high = np.sort(sides[:, np.stack(_pairs())], 1).transpose(1, 0, 2)
    kept = high < end
    wanted = _key(high[kept], low[kept], end)
    entries = np.append(entries, np.setdiff1d(wanted, entries))
    order = np.argsort(entries)
    slots = np.full(kept.shape, len(entries))
    slots[kept] = order[np.searchsorted(entries, wanted, sorter=order)]
    return entries, slots


def _key(rows: np.ndarray, cols: np.ndarray, end: int) -> np.ndarray:
    key: np.ndarray = rows.astype(np.int64) * end + cols
    return key


def _pairs() -> tuple[np.ndarray, np.ndarray]:
    """The entries of a small symmetric matrix over the unknowns that a contact node joins, each once."""
    return np.triu_indices(6)


def assemble_coat(
    coat: Coat, theta: CoatCoefficients, sheet: Float[Array, " nnz"], share: Float[Array, " electrodes"]
) -> Float[Array, " nnz_of_both"]:
    """Lower triangle of the matrix of both, from that of the sheet and the shares of its electrodes."""
    conductance, jump = _conductance(coat, theta), _jump(coat, share)
    first, second = _pairs()
    added = conductance[:, None] * jump[:, first] * jump[:, second]
    own = jnp.concatenate([sheet, theta.metal * coat.stiffness])
    between = jnp.zeros_like(own, shape=coat.plan.rows.size - own.size)
    values = jnp.concatenate([own, between]).at[coat.slots].add(added, mode="drop")
    return values.at[coat.plan.diagonal[-1]].add(jnp.where(_touches(conductance), 0.0, theta.metal))


def coat_fields(
    coat: Coat, theta: CoatCoefficients, x: Float[Array, "unknowns electrodes"], share: Float[Array, " electrodes"]
) -> CoatFields:
    """Fields of the metal from the unknowns of both."""
    potential = jnp.pad(x, ((0, 1), (0, 0)))
    drop = jnp.einsum("ck,cka->ca", _jump(coat, share), potential[coat.sides])
    # Without any contact the metal's potential is arbitrary. The drop is then zero, since the metal takes the potential
    # of the sheet at the first contact.
    return CoatFields(potential, jnp.where(_touches(_conductance(coat, theta)), drop, 0.0))


def coat_energy(coat: Coat, theta: CoatCoefficients, x: CoatFields) -> Float[Array, "a b"]:
    """The part of ``A(theta; x_a, x_b)`` (`forward_model`) in metal and contact, in ohm."""
    slopes = jnp.einsum("tkr,tka->tra", coat.slopes, x.potential[coat.dofs])
    contact = jnp.einsum("c,ca,cb->ab", _conductance(coat, theta), x.drop, x.drop)
    return theta.metal * jnp.einsum("tra,trb->ab", slopes, slopes) + contact


def _conductance(coat: Coat, theta: CoatCoefficients) -> Float[Array, " contacts"]:
    """Conductance of each contact node, S."""
    none = jnp.zeros_like(theta.coupling, shape=coat.under.shape)
    return none.at[coat.touching].add(theta.coupling[:, None] * coat.areas)


def _touches(conductance: Float[Array, " contacts"]) -> Bool[Array, ""]:
    return jnp.any(conductance > 0)


def _jump(coat: Coat, share: Float[Array, " electrodes"]) -> Float[Array, "contacts 6"]:
    """Coefficients of the six unknowns at each contact node whose sum is u - m, (contacts, 6)."""
    one = jnp.ones_like(share, shape=(len(coat.under), 1))
    above = jnp.append(share, 0)[coat.under][:, None]
    return jnp.concatenate([one, above, -coat.corners, -one], 1)
