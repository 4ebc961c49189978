"""From a scene and a fidelity to arrays: the one door between host and device, and the one place
that says no.

The unknowns are the potentials ``u`` of the sheet and ``U`` of the complete electrodes.  Solving
for them as they stand fails at both ends: at small contact resistance u and U differ by less than
rounding, at large resistance the reverse substitution subtracts.  So under each electrode

    u = w + s U chi,        s = G_c / (G_c + G_s)

is solved for ``w`` and ``U`` instead, chi being one on the nodes under the electrode, G_c its contact
conductance and G_s = chi^T K chi that of the sheet around it.  The diagonal entry of U becomes the
conductance of the two in series, no entry is formed by subtraction, and after diagonal scaling the
matrix is well conditioned from a perfect contact to none.  (Derived here; a congruence, so the
matrix stays symmetric positive definite.)

Potentials are known but for a constant, so one unknown is grounded: through a conductance as large as its
own, which decides nothing but the constant.  Which one is left to the conductivities, as all potentials are
then differences from that place (`forward.assemble`): one in a tear of the sheet would see the rest through
what the tear still conducts, and readings would be the last digits of far larger numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from .coat import Coat, lay_coat
from .effects import AbstractCoatEffect, AbstractEffect, chosen
from .electrodes import AbstractElectrode, AreaPatch, ElectrodeError
from .elements import Space, function_space
from .fidelity import Fidelity, require_dtype
from .footprints import Footprint
from .mesh import Mesh, triangulate
from .scene import Scene
from .skin import Skin
from .solvers import AbstractLinearSolver, AbstractPlan, Pattern, default_solver
from .solvers._base import on_device

# Edges of a coat's mesh over those of the sheet's.  The potential of the metal is a thousandth of what a
# touch does at 0.1 ohm; that thousandth is then right to 3 %.
_METAL_EDGES = 2.0


class Entries(eqx.Module):
    """Matrix entries that at most c elements contribute to: the sum of weight times sigma[element]."""

    element: Int[Array, "n c"]
    weight: Float[Array, "n c"]


class System(eqx.Module):
    """The assembled problem with its numbers left out: which coefficient goes where.

    An electrode of index ``electrodes`` stands for none.

    | meaning                                                                 | shape           |
    |-------------------------------------------------------------------------|-----------------|
    | dofs: unknowns of each element                                          | (elements, k)   |
    | slopes of each element, weighted (`elements`)                           | (elements, k, r)|
    | sheet: the matrix at unit contact, in the order of its entries          |                 |
    | contact_dofs, contact_mass (m^2 or m): pieces under complete electrodes | (p, k), (p, k, k)|
    | contact_electrode: whose piece it is                                    | (p,)            |
    | rim_element, rim_electrode: elements around an electrode                | (e,), (e,)      |
    | rim_chi, rim_flux: chi at their nodes, and their stiffness times chi    | (e, k), (e, k)  |
    | bridge_element, bridge_electrodes: elements between two electrodes      | (b,), (b, 2)    |
    | bridge_flux: chi of the one, times their stiffness, times chi of the other | (b,)         |
    | measure: area (m^2) or length (m) of each electrode, 0 if tied          | (electrodes,)   |
    | under: the complete electrode over each unknown                         | (unknowns,)     |
    | electrode_dof: the unknown that is each electrode's potential           | (electrodes,)   |
    | electrode_root: its place in the root of the plan                       | (electrodes,)   |
    | ground: unknowns that may be grounded                                   | (g,)            |
    | ground_weight: how fit each is on a sheet without tears                 | (g,)            |
    | slots: place in the matrix of what contacts add (`forward.assemble`)    | (contributions,)|
    | lumped: radius of discs whose contact is in closed form, else 0, m      | (electrodes,)   |
    | near_element, near_electrode, near_share: elements under those discs,   | (q,), (q,), (q,)|
    |   and their shares of each disc's area                                  |                 |
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

    @property
    def unknowns(self) -> int:
        """Number of unknowns solved for."""
        return self.under.shape[0]


class Model(eqx.Module):
    """A scene at a fidelity: arrays only, so that it can be an argument of any jitted function.

    | meaning                                             | shape           | unit              |
    |-----------------------------------------------------|-----------------|-------------------|
    | nodes of the mesh                                   | (nodes, 2 or 3) | m                 |
    | chart: nodes in the sheet's flat coordinates        | (nodes, 2)      | m                 |
    | triangles                                           | (elements, 3)   |                   |
    | centroids in the sheet's flat coordinates           | (elements, 2)   | m                 |
    | areas                                               | (elements,)     | m^2               |
    | background: sheet conductivity, before effects      | (elements,)     | S                 |
    | contact: contact conductance of each electrode      | (electrodes,)   | S/m^2 or S/m      |
    | pattern: drive+, drive-, sense+, sense-             | (readings, 4)   |                   |
    | current                                             | ()              | A                 |
    | effects of the scene                                |                 |                   |
    | coat: the second sheet, if an effect asks for one   |                 |                   |
    """

    nodes: Float[Array, "nodes d"]
    chart: Float[Array, "nodes 2"]
    triangles: Int[Array, "elements 3"]
    centroids: Float[Array, "elements 2"]
    areas: Float[Array, " elements"]
    background: Float[Array, " elements"]
    contact: Float[Array, " electrodes"]
    pattern: Int[Array, "readings 4"]
    current: Float[Array, ""]
    effects: tuple[AbstractEffect, ...]
    system: System
    solver: AbstractLinearSolver
    coat: Coat | None

    @property
    def electrodes(self) -> int:
        """Number of electrodes."""
        return self.contact.shape[0]

    @property
    def dtype(self) -> np.dtype:
        """Of every floating-point array of the model."""
        return self.background.dtype


def discretise(
    scene: Scene,
    fidelity: Fidelity | None = None,
    *,
    mesh: Mesh | None = None,
    ground: int | None = None,
) -> Model:
    """Build the model of ``scene`` at ``fidelity`` (default: `Fidelity.standard`).

    Args:
        mesh: use this mesh instead of making one, for a metal coat too; it must follow the electrodes.
        ground: the mesh node held at zero volts; readings do not depend on it.

    Raises:
        FidelityError: float64 asked for while JAX is in 32-bit mode.
        ElectrodeError, MeshError: the electrodes do not fit the sheet, each other or the mesh.
    """
    fidelity = Fidelity.standard() if fidelity is None else fidelity
    require_dtype(fidelity.dtype)
    skin, given = scene.skin, mesh
    mesh = make_mesh(scene, fidelity) if given is None else given.check()
    space = function_space(mesh, fidelity.order)
    layout = _lay_out(space, scene, ground)
    system, solver = _system(space, layout, skin.electrodes, fidelity)
    contact = [1 / e.contact if e.contact > 0 else 0.0 for e in skin.electrodes]
    put = partial(_put, dtype=fidelity.dtype)
    coat = None
    if chosen(scene.effects, AbstractCoatEffect):
        metal = _mesh(skin, [], fidelity, _METAL_EDGES) if given is None else given
        coat = _coat(metal, space, layout, system, solver, put)
    return Model(
        nodes=put(mesh.nodes),
        chart=put(mesh.chart),
        triangles=put(mesh.triangles),
        centroids=put(mesh.chart_centroids),
        areas=put(mesh.areas),
        background=put(np.full(len(mesh.triangles), 1 / skin.sheet_resistance)),
        contact=put(np.array(contact)),
        pattern=put(skin.protocol.pattern),
        current=put(np.array(skin.protocol.current)),
        effects=jax.tree.map(put, scene.effects),
        system=system,
        solver=solver,
        coat=coat,
    )


def make_mesh(scene: Scene, fidelity: Fidelity) -> Mesh:
    """The mesh that `discretise` makes: graded around the electrodes, checked."""
    return _mesh(scene.skin, [e.footprint(fidelity.electrode_segments) for e in scene.skin.electrodes], fidelity)


def _mesh(skin: Skin, footprints: list[Footprint], fidelity: Fidelity, coarser: float = 1.0) -> Mesh:
    length = coarser * fidelity.edge_length * np.sqrt(skin.domain.area)
    mesh = triangulate(skin.domain, footprints, length, growth=fidelity.growth).check()
    return mesh if skin.surface is None else mesh.lift(skin.surface).check()


def _put(values: np.ndarray | Array, dtype: np.dtype) -> Array:
    """An array on the device: numbers in the model's precision, indices as 32-bit integers."""
    floating = np.issubdtype(np.asarray(values).dtype, np.floating)
    return on_device(values, dtype if floating else np.int32)


@dataclass(frozen=True, eq=False)
class _Layout:
    """Numbering of the unknowns; indices of the space's dofs go through ``index``."""

    index: np.ndarray  # (space dofs + electrodes,) -> unknown
    unknowns: int
    coords: np.ndarray  # (unknowns, 2), NaN for electrodes
    electrode_dof: np.ndarray
    ground: np.ndarray  # (g,) unknowns that may be grounded
    ground_weight: np.ndarray
    complete: list[tuple[int, np.ndarray, np.ndarray]]  # electrode, dofs and mass of its pieces
    lumped: np.ndarray  # (electrodes,) radius of the disc, or 0


def _lay_out(space: Space, scene: Scene, ground: int | None) -> _Layout:
    electrodes, domain = scene.skin.electrodes, scene.skin.domain
    count = len(space.points)
    alias = np.arange(count + len(electrodes))
    owner = np.full(count, -1)
    complete, lumped = [], np.zeros(len(electrodes))
    for number, electrode in enumerate(electrodes):
        pieces = electrode.pieces(space, domain)
        patch = np.unique(pieces.dofs)
        _claim(owner, patch, number)
        lumped[number] = electrode.lumped_radius(space, scene.skin.sheet_resistance)
        if electrode.contact > 0 and not lumped[number]:
            complete.append((number, pieces.dofs, pieces.mass))
        else:  # a perfect contact, or one in series: one potential under the whole electrode
            alias[patch] = alias[count + number] = patch[0]
    covered = [number for number, _, _ in complete]
    names, index = np.unique(alias, return_inverse=True)
    places = np.concatenate([space.chart, np.full((len(electrodes), 2), np.nan)])
    chosen, weight = _grounds(space, np.isin(owner, covered), len(electrodes), ground)
    return _Layout(index, len(names), places[names], index[count:], index[chosen], weight, complete, lumped)


def _claim(owner: np.ndarray, patch: np.ndarray, number: int) -> None:
    taken = owner[patch] >= 0
    if taken.any():
        other = int(owner[patch][taken][0])
        raise ElectrodeError(
            f"electrodes {other} and {number} touch the same mesh node; move them apart or make the mesh finer"
        )
    owner[patch] = number


def _grounds(space: Space, covered: np.ndarray, electrodes: int, ground: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Which dofs may be grounded, and how fit each is: best amid the sheet, as one at the rim sees more
    resistance, and none that a complete electrode covers; electrodes themselves where these cover all."""
    if ground is None:
        if covered.all():
            return len(covered) + np.arange(electrodes), np.ones(electrodes)
        away = np.linalg.norm(space.chart - space.chart.mean(0), axis=1) / np.ptp(space.chart)
        return np.flatnonzero(~covered), 1 / (1 + 10 * away[~covered] ** 2)
    if not (0 <= ground < len(covered)) or covered[ground]:
        raise ElectrodeError(f"node {ground} cannot be the ground: it is under an electrode")
    return np.array([ground]), np.ones(1)


def _system(
    space: Space,
    layout: _Layout,
    hardware: tuple[AbstractElectrode, ...],
    fidelity: Fidelity,
) -> tuple[System, AbstractLinearSolver]:
    electrodes = len(layout.electrode_dof)
    width = space.dofs.shape[1]
    dofs = layout.index[space.dofs]
    contact_dofs, contact_mass, contact_electrode = _contacts(layout, width)
    measure = np.bincount(contact_electrode, contact_mass.sum((1, 2)), minlength=electrodes)
    under = np.full(layout.unknowns, electrodes)
    under[contact_dofs[contact_mass.any(2)]] = np.repeat(contact_electrode, contact_mass.any(2).sum(1))
    rim_element, rim_electrode, rim_chi = _rims(dofs, under, electrodes)
    stiffness = space.stiffness
    rim_flux = np.einsum("eij,ej->ei", stiffness[rim_element], rim_chi)
    first, second = _bridges(rim_element)
    bridge = rim_electrode[np.stack([first, second], 1)]
    added = _contact_places(
        dofs, contact_dofs, contact_electrode, rim_element, rim_electrode, bridge, layout.electrode_dof
    )
    sheet, slots, (rows, cols) = _matrix(dofs, stiffness, added, layout.unknowns)
    roots = np.unique(layout.electrode_dof)
    pattern = Pattern(layout.unknowns, rows, cols, layout.coords, roots)
    solver = fidelity.solver or default_solver(layout.unknowns)
    put = partial(_put, dtype=fidelity.dtype)
    system = System(
        dofs=put(dofs),
        slopes=put(space.slopes),
        sheet=tuple(Entries(on_device(element, np.uint32), put(weight)) for element, weight in sheet),
        contact_dofs=put(contact_dofs),
        contact_mass=put(contact_mass),
        contact_electrode=put(contact_electrode),
        rim_element=put(rim_element),
        rim_electrode=put(rim_electrode),
        rim_chi=put(rim_chi),
        rim_flux=put(rim_flux),
        bridge_element=put(rim_element[first]),
        bridge_electrodes=put(bridge),
        bridge_flux=put(np.sum(rim_chi[first] * rim_flux[second], 1)),
        measure=put(measure),
        under=put(under),
        electrode_dof=put(layout.electrode_dof),
        electrode_root=put(np.searchsorted(roots, layout.electrode_dof)),
        ground=put(layout.ground),
        ground_weight=put(layout.ground_weight),
        slots=put(slots),
        lumped=put(layout.lumped),
        **{name: put(part) for name, part in _near(space, layout, hardware).items()},
        plan=solver.analyse(pattern),
    )
    return system, solver


def _coat(
    metal: Mesh,
    space: Space,
    layout: _Layout,
    system: System,
    solver: AbstractLinearSolver,
    put: Callable[[np.ndarray], Array],
) -> Coat:
    plan, index = system.plan, layout.index[: len(space.points)]
    rows, cols, root, under = (np.asarray(a) for a in (plan.rows, plan.cols, plan.root, system.under))
    sheet = Pattern(layout.unknowns, rows, cols, layout.coords, root)
    return lay_coat(metal, space, sheet, index, under[index], layout.electrode_dof, solver, put)


def _near(space: Space, layout: _Layout, electrodes: tuple[AbstractElectrode, ...]) -> dict[str, np.ndarray]:
    """Elements under discs in closed form, whose mean conductivity the closed form takes."""
    elements, owners, shares = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)]
    for number, electrode in enumerate(electrodes):
        if layout.lumped[number] and isinstance(electrode, AreaPatch):
            inside = electrode.elements(space)
            areas = space.mesh.areas[inside]
            elements.append(inside)
            owners.append(np.full(len(inside), number))
            shares.append(areas / areas.sum())
    parts = (np.concatenate(part) for part in (elements, owners, shares))
    return dict(zip(("near_element", "near_electrode", "near_share"), parts, strict=True))


def _contacts(layout: _Layout, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All pieces in one array; edges have fewer nodes than triangles and are padded with zeros."""
    dofs, masses, owners = [np.zeros((0, width), int)], [np.zeros((0, width, width))], []
    for number, piece_dofs, mass in layout.complete:
        short = width - piece_dofs.shape[1]
        dofs.append(np.pad(layout.index[piece_dofs], ((0, 0), (0, short)), mode="edge"))
        masses.append(np.pad(mass, ((0, 0), (0, short), (0, short))))
        owners.append(np.full(len(piece_dofs), number))
    owner = np.concatenate([np.zeros(0, int), *owners])
    return np.concatenate(dofs), np.concatenate(masses), owner


def _rims(dofs: np.ndarray, under: np.ndarray, electrodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Elements with some nodes under an electrode: K chi vanishes where all are."""
    above = under[dofs]
    element, corner = np.nonzero(above < electrodes)
    pairs = np.unique(np.stack([element, above[element, corner]], 1), axis=0)
    chi = above[pairs[:, 0]] == pairs[:, 1:]
    partly = ~chi.all(1)
    return pairs[partly, 0], pairs[partly, 1], chi[partly].astype(float)


def _bridges(element: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of places in this ascending list of elements that hold the same one, each pair once."""
    first, second = np.concatenate(
        [np.stack([np.arange(len(element) - k), np.arange(k, len(element))]) for k in (1, 2)], 1
    )
    alike = element[first] == element[second]
    return first[alike], second[alike]


def _contact_places(
    dofs: np.ndarray,
    contact_dofs: np.ndarray,
    contact_electrode: np.ndarray,
    rim_element: np.ndarray,
    rim_electrode: np.ndarray,
    bridge: np.ndarray,
    electrode_dof: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of every contribution of the contacts, in the order of `forward.assemble`."""
    rows, cols = _blocks(contact_dofs)
    nodes = np.concatenate([dofs[rim_element], contact_dofs])
    potential = np.repeat(electrode_dof[np.concatenate([rim_electrode, contact_electrode])], dofs.shape[1])
    # A node and the electrode over it make one entry, which the lower triangle holds once; a block
    # makes each of its entries twice, and the upper one is dropped.
    low, high = np.sort([nodes.ravel(), potential], axis=0)
    left, right = np.sort(electrode_dof[bridge], axis=1).T
    return np.concatenate([rows, high, electrode_dof, right]), np.concatenate([cols, low, electrode_dof, left])


def _blocks(dofs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    width = dofs.shape[1]
    return np.repeat(dofs, width, 1).ravel(), np.tile(dofs, (1, width)).ravel()


def _matrix(
    dofs: np.ndarray, stiffness: np.ndarray, added: tuple[np.ndarray, np.ndarray], unknowns: int
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """What elements contribute to each entry of the lower triangle; where the contacts contribute;
    rows and columns of the entries.

    Entries are ordered by how many elements meet in them, to the next power of two, so that those
    alike can be summed as one table.
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
        tables.append((element, weight))
    return tables
