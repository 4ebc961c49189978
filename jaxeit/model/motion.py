"""Electrodes that move and grow: readings as a differentiable function of where the electrodes sit, and of their sizes.

The mesh follows its electrodes: the nodes of an electrode move with it, those around it by a part that falls to zero
before the next electrode and the rim; an electrode that grows moves them away from its middle in the same way. No node
changes its neighbours, so that the arrays of the model are smooth functions of the shifts. With x_a the field of a unit
current into electrode a, the transfer matrix ``Z[a, b]`` has the derivative ``-dA(x_a, x_b)``, that of the energy with
the fields held (`forward_model`), as for a conductivity: the fields are stationary, and no further solve is needed. The
conductivity of an element moves with it.
"""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from .._compile import is_traced, require_known, verb
from ..geometry.plane_vectors import cross
from ..linalg.base import on_device
from ..meshing.elements import BY_ORDER, P1, element_slopes
from ..meshing.rim_nodes import RimNodes
from ..meshing.triangles import Mesh
from .discretisation import Model, require_model
from .forward_model import Fields, fields, series_resistance, terminal_matrix, voltages
from .matrix.stiffness import TableBatch
from .matrix.system import Entries, System, stiffness_places
from .sheet_conductivity import Coefficients, coefficients

# Parts of an electrode's radius that the mesh needs around it, so that its triangles are not flattened.
LEAST_REACH = 1.25
# In a batch, whose products of fields stay in a core's cache.
BATCH_ELEMENTS = 128


class MotionError(ValueError):
    """Electrodes that cannot be moved on this mesh."""


class Motion(eqx.Module):
    """How the mesh of a model follows its electrodes, from `electrode_motion`.

    | meaning                                                               | shape           | unit |
    |-----------------------------------------------------------------------|-----------------|------|
    | electrode: that each node follows                                     | (nodes,)        |      |
    | chart_step: change of a node's flat coordinates per shift of that     | (nodes, 2, 2)   | 1    |
    | space_step: the same of its place in space                            | (nodes, d, 2)   | 1    |
    | arm: of each node, from the middle of the electrode that it follows   | (nodes, 2)      | m    |
    | radius: of what an electrode touches; 0: it is a point                | (electrodes,)   | m    |
    | reach: distance from its middle within which nodes follow an electrode | (electrodes,)  | m    |
    | places: of each contribution to the matrix, among the stiffnesses     | (n, c) each     |      |
    | corners: nodes of each piece under an electrode; of an edge the last one twice | (p, 3) |      |
    """

    electrode: Int[Array, " nodes"]
    chart_step: Float[Array, "nodes 2 2"]
    space_step: Float[Array, "nodes d 2"]
    arm: Float[Array, "nodes 2"]
    radius: Float[Array, " electrodes"]
    reach: Float[Array, " electrodes"]
    places: tuple[Int[Array, "_ _"], ...]
    corners: Int[Array, "p 3"]


def electrode_motion(model: Model) -> Motion:
    """Prepare a model for `moved`, on the host, once for each mesh.

    Electrodes inside the sheet move in both directions. Electrodes on the rim move along it, and not around corners.

    Raises:
        SceneError: if ``model`` is no model, such as a skin.
        MotionError: for a metal coat, or for electrodes so near to each other or to a corner that none can move.
    """
    require_model(model)
    require_known("electrode_motion", MotionError, model.nodes)
    if model.coat is not None:
        raise MotionError(
            "the electrodes of a sheet with a metal coat cannot be moved; leave the coat out of the scene"
        )
    mesh = model.mesh
    unknown = np.zeros(len(mesh.nodes), int)
    unknown[mesh.triangles] = np.asarray(model.system.dofs)[:, :3]
    follows = _follow(mesh, _nodes_of_electrodes(model, unknown))
    # The derivative of the place in space by the flat coordinates, constant on a triangle; at a node the mean.
    flat, space = (_sides(places[mesh.triangles]) for places in (mesh.chart, mesh.nodes))
    slope = np.linalg.solve(flat, space).swapaxes(1, 2)
    tangents, around = np.zeros((len(mesh.nodes), *slope.shape[1:])), np.zeros((len(mesh.nodes), 1, 1))
    np.add.at(tangents, mesh.triangles, slope[:, None])
    np.add.at(around, mesh.triangles, 1.0)
    return Motion(
        on_device(follows.electrode, jnp.int32),
        on_device(follows.step, model.dtype),
        on_device(tangents / around @ follows.step, model.dtype),
        on_device(follows.arm, model.dtype),
        on_device(follows.radius, model.dtype),
        on_device(follows.reach, model.dtype),
        tuple(on_device(table, jnp.int32) for table in stiffness_places(model.system)),
        on_device(_corners_of_pieces(model, unknown), jnp.int32),
    )


def _sides(corners: np.ndarray) -> np.ndarray:
    """Two sides of each triangle, (elements, 2, d)."""
    sides: np.ndarray = corners[:, 1:] - corners[:, :1]
    return sides


def _nodes_of_electrodes(model: Model, unknown: np.ndarray) -> list[np.ndarray]:
    """Nodes that each electrode touches."""
    under, own = np.asarray(model.system.under)[unknown], np.asarray(model.system.electrode_dof)
    return [np.flatnonzero((under == k) | (unknown == own[k])) for k in range(model.electrodes)]


def _corners_of_pieces(model: Model, unknown: np.ndarray) -> np.ndarray:
    """Nodes at the corners of each piece under an electrode; no unknown under a complete electrode is shared."""
    node = np.zeros(model.system.unknowns, int)
    node[unknown] = np.arange(len(unknown))
    corners: np.ndarray = node[np.asarray(model.system.contact_dofs)[:, :3]]
    last = np.asarray(model.system.contact_mass)[:, -1]  # of a piece on the rim: padding, without mass
    corners[~last.any(1), 2] = corners[~last.any(1), 1]
    return corners


class _NodeDisplacement(NamedTuple):
    """How nodes follow electrodes; see `Motion`."""

    electrode: np.ndarray
    step: np.ndarray
    arm: np.ndarray
    radius: np.ndarray
    reach: np.ndarray


def _follow(mesh: Mesh, electrodes: list[np.ndarray]) -> _NodeDisplacement:
    rim = RimNodes(mesh)
    middles = np.stack([mesh.chart[nodes].mean(0) for nodes in electrodes])
    away = np.linalg.norm(mesh.chart[:, None] - middles, axis=2)
    radii = np.array([away[nodes, k].max() for k, nodes in enumerate(electrodes)])
    gaps = np.linalg.norm(middles[:, None] - middles, axis=2)
    np.fill_diagonal(gaps, np.inf)
    on_rim = np.array([rim.inside[nodes].all() for nodes in electrodes])
    stops = np.where(on_rim[None], rim.corner[:, None], rim.inside[:, None])
    reach = np.minimum(0.5 * gaps.min(1), np.where(stops, away, np.inf).min(0))
    tight = reach <= LEAST_REACH * radii
    if tight.any():
        k = int(np.argmax(tight))
        raise MotionError(
            f"electrode {k} cannot be moved: from its middle it is {1e3 * reach[k]:.3g} mm to the rim, to a corner or "
            f"half of the way to the next electrode, and it reaches {1e3 * radii[k]:.3g} mm itself"
        )
    follows = np.argmin(away / reach, axis=1)
    every = np.arange(len(away))
    beyond = np.clip((away[every, follows] - radii[follows]) / (reach - radii)[follows], 0, 1)
    share = 1 - beyond**2 * (3 - 2 * beyond)
    own = np.stack(
        [rim.direction(nodes) if flat else np.zeros(2) for nodes, flat in zip(electrodes, on_rim, strict=True)]
    )
    along = np.where(rim.inside[:, None], rim.tangent, own[follows])
    bound = along[:, :, None] * own[follows][:, None, :]  # the part along the rim, turned with the rim
    step = share[:, None, None] * np.where(on_rim[follows][:, None, None], bound, np.eye(2))
    return _NodeDisplacement(follows, step, mesh.chart - middles[follows], radii, reach)


def moved(
    model: Model,
    motion: Motion,
    shift: Float[ArrayLike, "electrodes 2"] | None = None,
    growth: Float[ArrayLike, " electrodes"] | None = None,
) -> Model:
    """The model with its electrodes moved and grown, differentiable with respect to both under jit, vmap and grad.

    Conductivities, and a basis that was laid over the model, move with the elements.

    Args:
        model: with which `electrode_motion` made the motion.
        shift: of each electrode in the sheet's flat coordinates, (electrodes, 2) m; of an electrode on the rim, the
            part along the rim counts. Triangles turn over at about half of the reach. Default: none.
        growth: of the diameter or length of each electrode, (electrodes,), as a part of itself. Default: none.

    Returns:
        A model whose readings are not finite if a triangle turns over.

    Raises:
        MotionError: if shift or growth has another shape, an electrode that is a point should grow, or (unless JAX
            traces it) a triangle turns over.

    Example:
        motion = je.model.electrode_motion(model)
        # electrode 7, 1 mm along x
        there = je.model.moved(model, motion, jnp.zeros((25, 2)).at[7, 0].set(1e-3))
        print(jnp.abs(je.forward(there) - je.forward(model)).max())  # V
    """
    shift = jnp.zeros((model.electrodes, 2), model.dtype) if shift is None else jnp.asarray(shift, model.dtype)
    if shift.shape != (model.electrodes, 2):
        raise MotionError(
            f"the shift has shape {shift.shape}; give one of 2 coordinates to each of {model.electrodes} electrodes"
        )
    grown = None if growth is None else _checked_growth(model, motion, growth)
    if len(motion.electrode) != len(model.nodes):
        raise MotionError("the motion is that of another mesh; make electrode_motion(model) of this model")
    found = _moved(model, motion, shift, grown)
    if not is_traced((model, shift, growth)) and not bool(jnp.isfinite(found.system.slopes[0, 0, 0])):
        far = np.linalg.norm(np.asarray(shift), axis=1)
        k = int(np.argmax(far / np.asarray(motion.reach)))
        raise MotionError(
            f"a triangle turns over: electrode {k} moves {1e3 * far[k]:.3g} mm, and the mesh follows it within "
            f"{1e3 * float(motion.reach[k]):.3g} mm; make smaller shifts, let electrodes grow less, or make a new mesh"
        )
    return found


def _checked_growth(
    model: Model, motion: Motion, growth: Float[ArrayLike, " electrodes"]
) -> Float[Array, " electrodes"]:
    growth = jnp.asarray(growth, model.dtype)
    if growth.shape != (model.electrodes,):
        raise MotionError(f"growth has shape {growth.shape}; give one number to each of {model.electrodes} electrodes")
    if not is_traced((motion, growth)) and bool(jnp.any((growth != 0) & (motion.radius == 0))):
        k = int(jnp.argmax((growth != 0) & (motion.radius == 0)))
        raise MotionError(f"electrode {k} is a point of this mesh and cannot grow; give it a growth of 0")
    return growth


@verb
def _moved(
    model: Model, motion: Motion, shift: Float[Array, "electrodes 2"], growth: Float[Array, " electrodes"] | None = None
) -> Model:
    system, own = model.system, shift[motion.electrode]
    if growth is not None:
        own += growth[motion.electrode, None] * motion.arm
    chart = model.chart + jnp.einsum("nij,nj->ni", motion.chart_step, own)
    nodes = model.nodes + jnp.einsum("nij,nj->ni", motion.space_step, own)
    areas = _areas(nodes[model.triangles])
    order = 1 if system.dofs.shape[1] == 3 else 2
    slopes = jnp.asarray(element_slopes(nodes[model.triangles], areas, BY_ORDER[order]))
    flat = chart[model.triangles]
    upright = cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]) > 0
    slopes = jnp.where(jnp.all(upright), slopes, jnp.nan)
    stretch = _sizes(nodes, motion.corners) / _sizes(model.nodes, motion.corners)
    after = _moved_system(system, motion, slopes, areas, stretch)
    # What is pressed on the sheet, and the places of an image, stay with the elements: they have no derivative.
    fixed = (nodes, chart, chart[model.triangles].mean(1), areas)
    nodes, chart, centroids, areas = jax.tree.map(jax.lax.stop_gradient, fixed)
    return replace(model, nodes=nodes, chart=chart, centroids=centroids, areas=areas, system=after)


def _moved_system(
    system: System,
    motion: Motion,
    slopes: Float[Array, "elements k r"],
    areas: Float[Array, " elements"],
    stretch: Float[Array, " p"],
) -> System:
    """The system of elements with other slopes and areas, m^2, and of pieces of contacts that are stretched."""
    stiffness = slopes @ slopes.swapaxes(1, 2)
    entries = [jnp.where(place < 0, 0, stiffness.ravel()[jnp.maximum(place, 0)]) for place in motion.places]
    above = system.under[system.dofs[system.bridge_element]]
    one, other = ((above == system.bridge_electrodes[:, k, None]).astype(slopes.dtype) for k in (0, 1))
    mass = system.contact_mass * stretch[:, None, None]
    near = areas[system.near_element]
    discs = jnp.zeros_like(system.measure).at[system.near_electrode].add(near)
    return replace(
        system,
        slopes=slopes,
        sheet=tuple(Entries(old.element, weight) for old, weight in zip(system.sheet, entries, strict=True)),
        contact_mass=mass,
        rim_flux=jnp.einsum("eij,ej->ei", stiffness[system.rim_element], system.rim_chi),
        bridge_flux=jnp.einsum("bi,bij,bj->b", one, stiffness[system.bridge_element], other),
        measure=jnp.zeros_like(system.measure).at[system.contact_electrode].add(mass.sum((1, 2))),
        near_share=near / discs[system.near_electrode],
        moved=True,
    )


def _areas(corners: Float[Array, "n 3 d"]) -> Float[Array, " n"]:
    """Areas of triangles, m^2."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    gram = jnp.sum(u * u, 1) * jnp.sum(v * v, 1) - jnp.sum(u * v, 1) ** 2
    return 0.5 * jnp.sqrt(jnp.maximum(gram, jnp.finfo(corners.dtype).tiny))


def _sizes(nodes: Float[Array, "nodes d"], corners: Int[Array, "p 3"]) -> Float[Array, " p"]:
    """Areas of pieces that are triangles, lengths of those that are edges."""
    places, is_edge = nodes[corners], corners[:, 1] == corners[:, 2]
    side = places[:, 1] - places[:, 0]
    # An edge has no area, and the root of zero no derivative: a right angle stands in.
    third = jnp.where(is_edge[:, None], places[:, 0] + side[:, ::-1], places[:, 2])
    triangle = _areas(jnp.stack([places[:, 0], places[:, 1], third], 1))
    return jnp.where(is_edge, jnp.sqrt(jnp.sum(side**2, 1)), triangle)


@verb
def shift_jacobian(
    model: Model, motion: Motion, sigma: Float[Array, " elements"] | None = None
) -> Float[Array, "readings electrodes 2"]:
    """Derivative of `forward` with respect to the shift of each electrode, V/m; one factorisation, as `jacobian`.

    With V the velocity of the elements, fields x and y that are held have the energy's derivative
    ``integral of sigma (div V grad x . grad y - grad x . (grad V + grad V^T) grad y)`` (Sokolowski and Zolesio 1992).

    Args:
        model: as given to `electrode_motion`, or moved.
        sigma: (elements,) S; default: the untouched sheet.
    """
    theta = coefficients(model, sigma)
    return field_shift_jacobian(model, motion, theta, fields(model, theta))


def field_shift_jacobian(
    model: Model, motion: Motion, theta: Coefficients, x: Fields
) -> Float[Array, "readings electrodes 2"]:
    """`shift_jacobian` from the fields x at theta, without a factorisation."""
    change = -_sheet_change(model, motion, theta.sigma, x.potential)
    each = np.arange(model.electrodes)

    def at_contacts(shift: Float[Array, "electrodes 2"]) -> Float[Array, "electrodes a b"]:
        """What each electrode's own contact adds to the energy, and its resistance in closed form."""
        system = _moved(model, motion, shift).system
        drop = x.drop[system.contact_dofs]
        mass = theta.contact[system.contact_electrode][:, None, None] * system.contact_mass
        parts = jnp.einsum("pia,pij,pjb->pab", drop, mass, drop)
        own = jnp.zeros((model.electrodes, *x.terminal.shape), mass.dtype)
        own = own.at[each, each, each].set(series_resistance(system, theta))
        return own.at[system.contact_electrode].add(-parts)

    still = jnp.zeros((model.electrodes, 2), model.dtype)
    for axis in range(2):  # an electrode's contact depends on its own shift only: all move at once
        step = still.at[:, axis].set(1)
        change = change.at[:, axis].add(jax.jvp(at_contacts, (still,), (step,))[1])
    z = terminal_matrix(model, theta, x)
    felt: Array = jax.vmap(lambda slope: jax.jvp(lambda z: voltages(model, z), (z,), (slope,))[1])(
        change.reshape(-1, *z.shape)
    )
    return felt.T.reshape(-1, model.electrodes, 2)


def _sheet_change(
    model: Model,
    motion: Motion,
    sigma: Float[Array, " elements"],
    potential: Float[Array, "unknowns electrodes"],
) -> Float[Array, "electrodes 2 a b"]:
    """Change of the sheet's energy of all pairs of fields by the shift of each electrode, in batches of elements."""
    system = model.system
    batch = min(BATCH_ELEMENTS, len(model.triangles))

    def add(i: Int[Array, ""], sums: Float[Array, "electrodes 2 a b"]) -> Float[Array, "electrodes 2 a b"]:
        part = TableBatch.number(i, batch, len(model.triangles))
        corners, dofs, slopes = part.cut(model.triangles), part.cut(system.dofs), part.cut(system.slopes)
        weight = jnp.where(part.fresh, part.cut(sigma), 0)
        flat = jnp.einsum("ekr,eka->era", slopes, potential[dofs]).reshape(batch, -1, 2, model.electrodes)
        xx, yy, xy = (jnp.einsum("eqa,eqb->eab", flat[:, :, c], flat[:, :, d]) for c, d in ((0, 0), (1, 1), (0, 1)))
        products = jnp.stack([xx, yy, xy], 1)
        shares = _corner_shares(model.nodes[corners], weight, motion.space_step[corners])
        owner = motion.electrode[corners]
        rows = jnp.zeros((model.electrodes, batch, 2, 3), model.dtype).at[owner, jnp.arange(batch)[:, None]].add(shares)
        return sums + jnp.einsum("oesk,ekab->osab", rows, products)

    none = jnp.zeros((model.electrodes, 2, model.electrodes, model.electrodes), model.dtype)
    found: Array = jax.lax.fori_loop(0, -(-len(model.triangles) // batch), add, none)
    return 0.5 * (found + found.swapaxes(2, 3))


def _corner_shares(
    places: Float[Array, "e 3 d"], weight: Float[Array, " e"], step: Float[Array, "e 3 d 2"]
) -> Float[Array, "e 3 2 3"]:
    """Change of the energy of elements by each shift of each corner, per product xx, yy and xy of slopes of two fields.

    Args:
        places: of the corners, m.
        weight: conductivity of each element, S.
        step: change of each place per shift of its electrode.
    """
    areas = _areas(places)
    # The slopes of the barycentric coordinates l_i, 1/m, and the frame that they are in: its axes are those of the
    # place, which is the sum of l_i times corner i.
    slope = jnp.asarray(element_slopes(places, areas, P1)) / jnp.sqrt(areas)[:, None, None]
    frame = jnp.einsum("enc,enx->ecx", slope, places)
    velocity = weight[:, None, None, None] * jnp.einsum("ecx,enxs->encs", frame, step)
    bent = jnp.einsum("encs,end->ensdc", velocity, slope)
    spread = bent[..., 0, 0] + bent[..., 1, 1]
    crossed = -2 * (bent[..., 0, 1] + bent[..., 1, 0])  # of which the result keeps the symmetric half
    return jnp.stack([spread - 2 * bent[..., 0, 0], spread - 2 * bent[..., 1, 1], crossed], -1)
