"""The structure of a model's matrix: the place of every coefficient, without the values.

This module computes once, on the host; `forward_model.assemble` adds the values.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer

from ...linalg import AbstractPlan, SparsityPattern
from ...meshing.elements import Space
from ...skin.electrodes.base import DiscreteElectrode
from .unknowns import Unknowns


class Entries(eqx.Module):
    """Matrix entries that at most c elements contribute to: the sum of weight times sigma[element]."""

    element: Integer[Array, "n c"]
    weight: Float[Array, "n c"]


class System(eqx.Module):
    """The structure of the assembled problem: the place of every coefficient, without the values.

    The index ``electrodes`` stands for no electrode.

    | meaning                                                                 | shape           |
    |-------------------------------------------------------------------------|-----------------|
    | dofs: unknowns of each element                                          | (elements, k)   |
    | slopes of each element, weighted (`elements`)                           | (elements, k, r)|
    | sheet: the matrix at unit contact, in the order of its entries          |                 |
    | contact_dofs, contact_mass (m^2 or m): pieces under complete electrodes | (p, k), (p, k, k)|
    | contact_electrode: electrode of each piece                              | (p,)            |
    | rim_element, rim_electrode: elements around an electrode                | (e,), (e,)      |
    | rim_chi, rim_flux: chi at their nodes, and their stiffness times chi    | (e, k), (e, k)  |
    | bridge_element, bridge_electrodes: elements between two electrodes      | (b,), (b, 2)    |
    | bridge_flux: chi of the one, times their stiffness, times chi of the other | (b,)         |
    | measure: area (m^2) or length (m) of each electrode, 0 if tied          | (electrodes,)   |
    | under: the complete electrode over each unknown                         | (unknowns,)     |
    | electrode_dof: the unknown that is each electrode's potential           | (electrodes,)   |
    | electrode_root: its place in the root of the plan                       | (electrodes,)   |
    | ground: unknowns that may be grounded                                   | (g,)            |
    | ground_weight: suitability of each on a sheet without tears             | (g,)            |
    | slots: place in the matrix of what contacts add (`forward_model.assemble`)    | (contributions,)|
    | lumped: radius of discs whose contact is in closed form, else 0, m      | (electrodes,)   |
    | near_element, near_electrode, near_share: elements under those discs,   | (q,), (q,), (q,)|
    |   and their shares of each disc's area                                  |                 |
    | moved: whether the arrays depend on where the electrodes sit (`motion`) | static          |
    """

    dofs: Int[Array, "elements k"]
    slopes: Float[Array, "elements k r"]
    sheet: tuple[Entries, ...]
    contact_dofs: Int[Array, "p k"]
    contact_mass: Float[Array, "p k k"]
    contact_electrode: Int[Array, " p"]
    rim_element: Int[Array, " e"]
    rim_electrode: Int[Array, " e"]
    rim_chi: Float[Array, "e k"]
    rim_flux: Float[Array, "e k"]
    bridge_element: Int[Array, " b"]
    bridge_electrodes: Int[Array, "b 2"]
    bridge_flux: Float[Array, " b"]
    measure: Float[Array, " electrodes"]
    under: Int[Array, " unknowns"]
    electrode_dof: Int[Array, " electrodes"]
    electrode_root: Int[Array, " electrodes"]
    ground: Int[Array, " g"]
    ground_weight: Float[Array, " g"]
    slots: Int[Array, " contributions"]
    lumped: Float[Array, " electrodes"]
    near_element: Int[Array, " q"]
    near_electrode: Int[Array, " q"]
    near_share: Float[Array, " q"]
    plan: AbstractPlan
    moved: bool = eqx.field(static=True, default=False)

    @property
    def unknowns(self) -> int:
        """Number of unknowns solved for."""
        return self.under.shape[0]

    def gradients(
        self, potential: Float[Array, "unknowns a"], element: Int[Array, " e"] | None = None
    ) -> Float[Array, "e r a"]:
        """Weighted gradients of potentials in each element, or in some: their products are integrals over elements."""
        slopes, dofs = (self.slopes, self.dofs) if element is None else (self.slopes[element], self.dofs[element])
        return jnp.einsum("ekr,eka->era", slopes, potential[dofs])


class _ElectrodePieces(NamedTuple):
    """Pieces under complete electrodes: their unknowns (p, k), masses (p, k, k), and electrodes (p,)."""

    dofs: np.ndarray
    mass: np.ndarray
    electrode: np.ndarray


class _Rims(NamedTuple):
    """Elements around an electrode, their electrodes, chi at their nodes and their stiffness times chi."""

    element: np.ndarray
    electrode: np.ndarray
    chi: np.ndarray
    flux: np.ndarray


class _Bridges(NamedTuple):
    """Elements between two electrodes: the elements, both electrodes, and chi of one times the flux of the other."""

    element: np.ndarray
    electrodes: np.ndarray
    flux: np.ndarray


def system_arrays(
    space: Space, unknowns: Unknowns, touched: Sequence[DiscreteElectrode]
) -> tuple[dict[str, Any], SparsityPattern]:
    """The fields of a `System` but for its plan, as NumPy arrays, and the pattern of its matrix."""
    dofs, stiffness = unknowns.index[space.dofs], space.stiffness
    contacts = _contacts(space, unknowns, touched)
    measure = np.bincount(contacts.electrode, contacts.mass.sum((1, 2)), minlength=len(touched))
    under = _electrode_above(contacts, unknowns)
    rims = _rims(dofs, stiffness, under, len(touched))
    bridges = _bridges(rims)
    added = _contact_places(dofs, contacts, rims, bridges, unknowns.electrode)
    sheet, slots, (rows, cols) = _matrix(dofs, stiffness, added, unknowns.count)
    roots = np.unique(unknowns.electrode)
    arrays = {
        "dofs": dofs,
        "slopes": space.slopes,
        "sheet": sheet,
        **{f"contact_{name}": array for name, array in contacts._asdict().items()},
        **{f"rim_{name}": array for name, array in rims._asdict().items()},
        **{f"bridge_{name}": array for name, array in bridges._asdict().items()},
        "measure": measure.astype(float),  # `np.bincount` of no pieces is an integer array, also with weights
        "under": under,
        "electrode_dof": unknowns.electrode,
        "electrode_root": np.searchsorted(roots, unknowns.electrode),
        "ground": unknowns.ground,
        "ground_weight": unknowns.ground_weight,
        "slots": slots,
        "lumped": np.array([electrode.lumped for electrode in touched]),
    }
    pattern = SparsityPattern(unknowns.count, rows, cols, unknowns.coords, roots)
    return arrays | _under_discs(space, touched), pattern


def system_of(arrays: dict[str, Any], plan: AbstractPlan, put: Callable[[np.ndarray], Array]) -> System:
    """The `System` of these arrays, each moved to the device by ``put``."""
    moved = jax.tree.map(put, arrays)
    return System(**moved | {"sheet": tuple(Entries(*table) for table in moved["sheet"])}, plan=plan)


def stiffness_places(system: System) -> list[np.ndarray]:
    """Where each contribution to the tables of ``system.sheet`` is found among all stiffnesses of the elements,
    (elements, k, k) as one row; -1 for padding."""
    dofs = np.asarray(system.dofs, int)
    numbers = 1.0 + np.arange(dofs.size * dofs.shape[1]).reshape(*dofs.shape, -1)
    contacts = _ElectrodePieces(np.asarray(system.contact_dofs), np.zeros(0), np.asarray(system.contact_electrode))
    rims = _Rims(np.asarray(system.rim_element), np.asarray(system.rim_electrode), np.zeros(0), np.zeros(0))
    bridges = _Bridges(np.asarray(system.bridge_element), np.asarray(system.bridge_electrodes), np.zeros(0))
    added = _contact_places(dofs, contacts, rims, bridges, np.asarray(system.electrode_dof))
    tables, *_ = _matrix(dofs, numbers, added, system.unknowns)
    return [number.astype(int) - 1 for _, number in tables]


def _under_discs(space: Space, touched: Sequence[DiscreteElectrode]) -> dict[str, np.ndarray]:
    """Elements under discs with a closed form, which uses their mean conductivity."""
    areas = [space.mesh.areas[electrode.elements] for electrode in touched]
    owners = [np.full(len(part), number) for number, part in enumerate(areas)]
    return {
        "near_element": np.concatenate([np.zeros(0, int), *(electrode.elements for electrode in touched)]),
        "near_electrode": np.concatenate([np.zeros(0, int), *owners]),
        "near_share": np.concatenate([np.zeros(0), *(part / part.sum() for part in areas if len(part))]),
    }


def _contacts(space: Space, unknowns: Unknowns, touched: Sequence[DiscreteElectrode]) -> _ElectrodePieces:
    """All pieces in one array; edges have fewer nodes than triangles and are padded with zeros."""
    width = space.dofs.shape[1]
    dofs, masses, owners = [np.zeros((0, width), int)], [np.zeros((0, width, width))], [np.zeros(0, int)]
    for number in unknowns.complete:
        pieces = touched[number].pieces
        short = width - pieces.dofs.shape[1]
        dofs.append(np.pad(unknowns.index[pieces.dofs], ((0, 0), (0, short)), mode="edge"))
        masses.append(np.pad(pieces.mass, ((0, 0), (0, short), (0, short))))
        owners.append(np.full(len(pieces.dofs), number))
    return _ElectrodePieces(np.concatenate(dofs), np.concatenate(masses), np.concatenate(owners))


def _electrode_above(contacts: _ElectrodePieces, unknowns: Unknowns) -> np.ndarray:
    """The complete electrode over each unknown, or the number of electrodes; (unknowns,)."""
    under = np.full(unknowns.count, len(unknowns.electrode))
    real = contacts.mass.any(2)  # padding has no mass
    under[contacts.dofs[real]] = np.repeat(contacts.electrode, real.sum(1))
    return under


def _rims(dofs: np.ndarray, stiffness: np.ndarray, under: np.ndarray, electrodes: int) -> _Rims:
    """Elements with some nodes under an electrode; K chi vanishes for elements with all nodes under it."""
    above = under[dofs]
    element, corner = np.nonzero(above < electrodes)
    pairs = np.unique(np.stack([element, above[element, corner]], 1), axis=0)
    chi = above[pairs[:, 0]] == pairs[:, 1:]
    partly = ~chi.all(1)
    elements, weights = pairs[partly, 0], chi[partly].astype(float)
    return _Rims(elements, pairs[partly, 1], weights, np.einsum("eij,ej->ei", stiffness[elements], weights))


def _bridges(rims: _Rims) -> _Bridges:
    """Elements around two electrodes, which occur twice in the ascending list of elements around one."""
    element = rims.element
    first, second = np.concatenate(
        [np.stack([np.arange(len(element) - k), np.arange(k, len(element))]) for k in (1, 2)], 1
    )
    alike = element[first] == element[second]
    first, second = first[alike], second[alike]
    flux = np.sum(rims.chi[first] * rims.flux[second], 1)
    return _Bridges(element[first], rims.electrode[np.stack([first, second], 1)], flux)


def _contact_places(
    dofs: np.ndarray, contacts: _ElectrodePieces, rims: _Rims, bridges: _Bridges, electrode_dof: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of every contribution of the contacts, in the order of `forward_model.assemble`."""
    rows, cols = _blocks(contacts.dofs)
    nodes = np.concatenate([dofs[rims.element], contacts.dofs])
    potential = np.repeat(electrode_dof[np.concatenate([rims.electrode, contacts.electrode])], dofs.shape[1])
    # A node and the electrode over it have one entry, which the lower triangle holds once; a block
    # contributes each of its entries twice, and the upper one is dropped.
    low, high = np.sort([nodes.ravel(), potential], axis=0)
    left, right = np.sort(electrode_dof[bridges.electrodes], axis=1).T
    return np.concatenate([rows, high, electrode_dof, right]), np.concatenate([cols, low, electrode_dof, left])


def _blocks(dofs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    width = dofs.shape[1]
    return np.repeat(dofs, width, 1).ravel(), np.tile(dofs, (1, width)).ravel()


def _matrix(
    dofs: np.ndarray, stiffness: np.ndarray, added: tuple[np.ndarray, np.ndarray], unknowns: int
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Contributions of elements to each entry of the lower triangle; places of the contributions of contacts;
    rows and columns of the entries.

    Entries are ordered by the number of elements that contribute, rounded up to a power of two, so that
    entries of one number are summed as one table.
    """
    rows, cols = (np.concatenate(pair) for pair in zip(_blocks(dofs), added, strict=True))
    kept = rows >= cols
    keys, entry = np.unique(rows[kept] * np.int64(unknowns) + cols[kept], return_inverse=True)
    whole = np.full(len(rows), len(keys))
    whole[kept] = entry
    of_sheet, slots = np.split(whole, [stiffness.size])
    counts = np.bincount(of_sheet, minlength=len(keys) + 1)[:-1]
    width = np.where(counts > 1, 2 ** np.ceil(np.log2(np.maximum(counts, 1))).astype(int), counts)
    order = np.argsort(width, kind="stable")
    place = np.append(np.argsort(order), len(keys))
    tables = _tables(place[of_sheet], stiffness, width[order])
    return tables, place[slots], (keys[order] // unknowns, keys[order] % unknowns)


def _tables(entry: np.ndarray, stiffness: np.ndarray, width: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Element and weight of each contribution to the entries of one width, for each width."""
    used = np.flatnonzero(entry < len(width))
    used = used[np.argsort(entry[used], kind="stable")]
    entry = entry[used]
    rank = np.arange(len(entry)) - np.searchsorted(entry, entry)
    tables = []
    for columns in np.unique(width):
        first, end = np.searchsorted(width, [columns, columns + 1])
        mine = (entry >= first) & (entry < end)
        element, weight = np.zeros((end - first, columns), int), np.zeros((end - first, columns))
        at = entry[mine] - first, rank[mine]
        element[at], weight[at] = used[mine] // stiffness[0].size, stiffness.ravel()[used[mine]]
        tables.append((element.astype(np.uint32), weight))
    return tables
