"""From a scene and a fidelity to arrays: the only transfer from host to device, and the only module that
refuses models that cannot be computed."""

import pickle
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._compile import is_traced
from ..budget import require
from ..effects import AbstractCoatEffect, AbstractEffect, chosen
from ..geometry.shapes import Domain
from ..linalg import AbstractLinearSolver, default_solver
from ..linalg.base import on_device
from ..meshing.elements import Space, function_space
from ..meshing.footprints import AbstractFootprint
from ..meshing.generation import expected_nodes, triangulate
from ..meshing.triangles import CROWDED, MIN_ANGLE, Mesh
from ..notebook import MAX_LINES, Drawing, card
from ..skin.description import Skin
from ..skin.electrodes.base import discrete_electrodes
from .fidelity import Fidelity, FidelityError, require_dtype
from .matrix.metal_sheet import Coat, assembled_coat
from .matrix.system import System, system_arrays, system_of
from .matrix.unknowns import number_unknowns
from .mixing import Mixing, padded_rows
from .scene import Scene, SceneError

COAT_EDGES = 2.0
"""Edge length of a coat's mesh over that of the sheet's.  At 0.1 ohm, potential differences in the metal contribute a
thousandth of the signal of a touch; with this ratio their error is 3 %."""


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
    | pattern: drive+, drive-, sense+, sense-             | (rows, 4)       |                   |
    | mixing: readings as sums of rows; None: each is one |                 |                   |
    | current                                             | ()              | A                 |
    | effects of the scene                                |                 |                   |
    | system: where each coefficient of the matrix is     |                 |                   |
    | solver of the linear systems                        |                 |                   |
    | coat: the second sheet, if an effect asks for one   |                 |                   |

    Example:
        print(model.readings, "readings of", model.electrodes, "electrodes,", len(model.nodes), "nodes")
        # a sheet that conducts 10 % better
        print(je.forward(model, 1.1 * model.background) / je.forward(model))
    """

    nodes: Float[Array, "nodes d"]
    chart: Float[Array, "nodes 2"]
    triangles: Int[Array, "elements 3"]
    centroids: Float[Array, "elements 2"]
    areas: Float[Array, " elements"]
    background: Float[Array, " elements"]
    contact: Float[Array, " electrodes"]
    pattern: Int[Array, "rows 4"]
    current: Float[Array, ""]
    effects: tuple[AbstractEffect, ...]
    system: System
    solver: AbstractLinearSolver
    coat: Coat | None
    mixing: Mixing | None = None

    @property
    def readings(self) -> int:
        """Number of readings in one frame."""
        return self.pattern.shape[0] if self.mixing is None else self.mixing.readings

    @property
    def electrodes(self) -> int:
        """Number of electrodes."""
        return self.contact.shape[0]

    @property
    def mean_background(self) -> Float[Array, ""]:
        """Mean of the background over the area of the sheet, S."""
        return jnp.average(self.background, weights=self.areas)

    @property
    def mesh(self) -> Mesh:
        """The mesh, as arrays of NumPy in float64: for `je.meshing.write_mesh`, or another scene."""
        nodes, chart = np.asarray(self.nodes, float), np.asarray(self.chart, float)
        return Mesh(nodes, np.asarray(self.triangles), chart)

    @property
    def dtype(self) -> np.dtype:
        """Precision of every floating-point array of the model."""
        return self.background.dtype

    def _repr_html_(self) -> str:
        if is_traced(self):
            return card("Model", [("state", "traced by JAX: its numbers are hidden")])
        chart, triangles = np.asarray(self.chart), np.asarray(self.triangles)
        edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
        drawing = Drawing(chart.min(0), chart.max(0))
        drawing.lines(*chart[edges].swapaxes(0, 1))
        nodes, elements = len(chart), len(triangles)
        rows = [
            ("mesh", f"{nodes:,} nodes, {elements:,} triangles" + ("" if len(edges) <= MAX_LINES else "; not drawn")),
            ("sheet", f"{1e4 * float(self.areas.sum()):.4g} cm^2, {'flat' if self.nodes.shape[1] == 2 else 'curved'}"),
            ("scan", f"{self.electrodes} electrodes, {self.readings} readings, {1e3 * float(self.current):.3g} mA"),
            ("effects", ", ".join(type(effect).__name__ for effect in self.effects) or "none"),
            ("precision, solver", f"{self.dtype}, {type(self.solver).__name__}"),
        ]
        return card("Model", rows, drawing.svg(f"Mesh of {elements} triangles"))


def discretise(
    scene: Scene,
    fidelity: Fidelity | None = None,
    *,
    mesh: Mesh | None = None,
    ground: int | None = None,
    min_angle: float = MIN_ANGLE,
) -> Model:
    """Build the model of ``scene`` at ``fidelity`` (default: `Fidelity.standard`).

    Args:
        mesh: use this mesh instead of making one, for a metal coat too; it must follow the electrodes.
        min_angle: smallest angle that a triangle of ``mesh`` may have, degrees. Readings are less accurate
            where triangles are flat.
        ground: the mesh node held at zero volts; readings do not depend on it.

    Raises:
        SceneError: ``scene`` is another object, such as a skin.
        FidelityError: ``fidelity`` is another object, or float64 is asked for while JAX is in 32-bit mode.
        ProtocolError: an effect on the circuit of a reading, and a protocol of matrices, whose readings have none.
        ElectrodeError, MeshError: the electrodes do not fit the sheet, each other or the mesh.
        BudgetError: the mesh or the fields would be larger than `Budget` allows.
    """
    fidelity = Fidelity.standard() if fidelity is None else fidelity
    _require_kinds(scene, fidelity)
    require_dtype(fidelity.dtype)
    skin = scene.skin
    _require_pairs(scene)
    sheet, metal = _spaces(scene, fidelity, None if mesh is None else mesh.check(min_angle))
    values = _model_arrays(skin, sheet.mesh)
    electrodes = discrete_electrodes(skin.electrodes, sheet, skin.domain, skin.sheet_resistance)
    unknowns = number_unknowns(sheet, electrodes, ground)
    require("array_bytes", fidelity.dtype.itemsize * unknowns.count * len(electrodes), "model: one field per electrode")
    arrays, pattern = system_arrays(sheet, unknowns, electrodes)
    solver = fidelity.solver or default_solver(unknowns.count)

    def put(array: np.ndarray | Array) -> Array:
        return _put(array, fidelity.dtype)

    system = system_of(arrays, solver.analyse(pattern), put)
    coat = None
    if metal is not None:
        index = unknowns.index[: len(sheet.points)]
        coat = assembled_coat(metal, sheet, pattern, index, arrays["under"][index], unknowns.electrode, solver, put)
    effects = jax.tree.map(put, scene.effects)
    mixing = skin.protocol.mixing
    mixed = None if mixing is None else Mixing(*map(put, padded_rows(mixing)))
    return Model(**jax.tree.map(put, values), effects=effects, system=system, solver=solver, coat=coat, mixing=mixed)


def require_model(model: Any) -> None:
    """Refuse an object in the place of a model, such as a skin or a scene, and a model that JAX would compute in less
    than its precision; raises `SceneError`, `FidelityError`."""
    if not isinstance(model, Model):
        kind = type(model).__name__
        raise SceneError(f"{kind} is not a model; make one, such as jaxeit.discretise(scene, jaxeit.Fidelity.draft())")
    require_dtype(model.dtype, "the model is of float64")


def require_scene(scene: Any) -> None:
    """Refuse an object in the place of a scene, such as a skin or a name; raises `SceneError`."""
    if not isinstance(scene, Scene):
        raise SceneError(f"{type(scene).__name__} is not a scene; make one, such as jaxeit.Scene(skin, effects=())")


def _require_kinds(scene: Any, fidelity: Any) -> None:
    """Refuse an object in the place of a scene or of a fidelity, such as a skin or a name."""
    require_scene(scene)
    if not isinstance(fidelity, Fidelity):
        raise FidelityError(f"{type(fidelity).__name__} is not a fidelity; make one, such as jaxeit.Fidelity.draft()")


def _require_pairs(scene: Scene) -> None:
    """Refuse an effect on the circuit of a reading where the protocol's readings have none."""
    for effect in scene.effects:
        if effect.of_pairs:
            scene.skin.protocol.rows(f"the effect {type(effect).__name__}")


def _model_arrays(skin: Skin, mesh: Mesh) -> dict[str, np.ndarray]:
    """The fields of a `Model` that are plain arrays."""
    return {
        "nodes": mesh.nodes,
        "chart": mesh.chart,
        "triangles": mesh.triangles,
        "centroids": mesh.chart_centroids,
        "areas": mesh.areas,
        "background": np.full(len(mesh.triangles), 1 / skin.sheet_resistance),
        "contact": np.array([1 / e.contact if e.contact > 0 else 0.0 for e in skin.electrodes]),
        "pattern": skin.protocol.pattern,
        "current": np.array(skin.protocol.current),
    }


def make_mesh(scene: Scene, fidelity: Fidelity) -> Mesh:
    """The mesh that `discretise` makes: graded around the electrodes, checked.

    Example:
        mesh = je.model.make_mesh(je.Scene(skin), fidelity)
        # scenes on one mesh differ by their physics alone
        ideal = je.discretise(je.Scene(skin), fidelity, mesh=mesh)
    """
    length = _edge_length(scene.skin, fidelity)
    return _mesh(scene.skin, _footprints(scene.skin, fidelity), length, fidelity.growth)


def expected_mesh_nodes(skin: Skin, fidelity: Fidelity) -> int:
    """Estimated number of nodes of `make_mesh`, computed in milliseconds from areas, edge lengths and their growth."""
    footprints = _footprints(skin, fidelity)
    return round(expected_nodes(skin.domain, footprints, _edge_length(skin, fidelity), fidelity.growth))


def _footprints(skin: Skin, fidelity: Fidelity) -> list[AbstractFootprint]:
    return [electrode.footprint(fidelity.electrode_segments) for electrode in skin.electrodes]


def _spaces(scene: Scene, fidelity: Fidelity, mesh: Mesh | None) -> tuple[Space, Space | None]:
    """The function spaces of the sheet and of its metal coat, if an effect asks for one."""
    coated = bool(chosen(scene.effects, AbstractCoatEffect))
    coarse = COAT_EDGES * _edge_length(scene.skin, fidelity)
    sheet = make_mesh(scene, fidelity) if mesh is None else mesh
    if not coated:
        return function_space(sheet, fidelity.order), None
    metal = _mesh(scene.skin, [], coarse, fidelity.growth) if mesh is None else sheet
    return function_space(sheet, fidelity.order), function_space(metal, 1)


def _edge_length(skin: Skin, fidelity: Fidelity) -> float:
    """Edge length away from electrodes, m."""
    return float(fidelity.edge_length * np.sqrt(skin.domain.area))


def _mesh(skin: Skin, footprints: Sequence[AbstractFootprint], edge_length: float, growth: float) -> Mesh:
    mesh = _flat_mesh(skin.domain, footprints, edge_length, growth)
    return mesh if skin.surface is None else mesh.lift(skin.surface).check(advice=CROWDED)


def _flat_mesh(domain: Domain, footprints: Sequence[AbstractFootprint], edge_length: float, growth: float) -> Mesh:
    """The mesh of the flat sheet. The last few are kept, because scenes and sessions of one skin share theirs."""
    try:
        content = pickle.dumps((domain, footprints, edge_length, growth))
    except (pickle.PicklingError, AttributeError, TypeError):  # a user's class inside a function cannot be pickled
        return triangulate(domain, footprints, edge_length, growth=growth)
    return _kept_mesh(content)


@lru_cache(maxsize=4)
def _kept_mesh(content: bytes) -> Mesh:
    domain, footprints, edge_length, growth = pickle.loads(content)
    return triangulate(domain, footprints, edge_length, growth=growth)


def _put(values: np.ndarray | Array | float, dtype: np.dtype) -> Array:
    """An array on the device: numbers in the model's precision, indices in 32 bits."""
    if is_traced(values):  # a parameter of an effect
        return jnp.asarray(values, dtype)
    kind = np.asarray(values).dtype
    if np.issubdtype(kind, np.floating):
        return on_device(values, dtype)
    return on_device(values, np.uint32 if np.issubdtype(kind, np.unsignedinteger) else np.int32)
