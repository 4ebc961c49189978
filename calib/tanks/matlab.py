"""MATLAB files: models and frames of EIDORS, and frames of the Kuopio Tomography Challenge.

The fields are those that EIDORS documents for a forward model: ``nodes``, ``elems``, ``electrode(i).nodes`` and
``.z_contact``, ``stimulation(k).stim_pattern`` (electrodes, A) and ``.meas_pattern`` (readings, electrodes).
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

import jaxeit as je
from jaxeit.geometry import Polygon

from ..session import SessionError
from ..session.importers.mat_trees import read_mat_tree
from .recording import Tank, TankError, named_errors

REFERENCES = ("vh", "v_h", "homg", "ref", "reference", "Uelref")
"""Names under which a frame is the reference, and comes first."""

KTC_RADIUS, KTC_CONTACT = 0.115, 1e-4  # m; ohm m at 1 S: no contact impedance is published


def read_matlab(path: Path) -> dict[str, Any]:
    """The variables of a MATLAB file; see `calib.session.importers.read_mat_tree`."""
    try:
        return read_mat_tree(path)
    except SessionError as error:
        raise TankError(str(error)) from None


# --- EIDORS


def eidors_tank(path: Path, variables: Mapping[str, Any], protocol: je.Protocol | None = None) -> Tank:
    """A forward model of EIDORS, on its own mesh, and every variable that holds a frame of it."""
    with named_errors(path.name):
        return _eidors_tank(path, variables, protocol)


def _eidors_tank(path: Path, variables: Mapping[str, Any], protocol: je.Protocol | None) -> Tank:
    model = next(forward_models(variables), None)
    if model is None:
        raise TankError(
            f"{path.name}: no variable has a forward model (nodes, elems); save fwd_model, img or imdl, or describe "
            "the tank: skin=, or --skin TANK.toml"
        )
    where = f"{path.name}: fwd_model"
    mesh, number = _mesh(where, model)
    rim = _Rim(mesh)
    electrodes = tuple(
        rim.electrode(f"{where}.electrode({k + 1})", one, number)
        for k, one in enumerate(_each(where, model, "electrode"))
    )
    protocol = stimulation_protocol(where, model, len(electrodes)) if protocol is None else protocol
    skin = je.Skin(path.stem, rim.domain, 1.0, electrodes, protocol)
    columns = {name: found for name, value in variables.items() if (found := columns_of(value)) is not None}
    return named_frames(skin, {name: found for name, found in columns.items() if len(found) == protocol.readings}, mesh)


def named_frames(skin: je.Skin, variables: Mapping[str, np.ndarray], mesh: je.meshing.Mesh | None = None) -> Tank:
    """A tank with the frames of variables (readings, frames), by name and number, those that are references first."""
    frames = {
        name if columns.shape[1] == 1 else f"{name}({k + 1})": column
        for name, columns in variables.items()
        for k, column in enumerate(columns.T)
    }
    names = tuple(sorted(frames, key=lambda name: not _is_reference(name.split("(")[0])))
    values = np.array([frames[name] for name in names]).reshape(len(names), skin.protocol.readings)
    parts = np.ascontiguousarray(values.real), values.imag if np.iscomplexobj(values) else None
    return Tank(skin, parts[0].astype(float), names, parts[1], mesh)


def _is_reference(name: str) -> bool:
    return name in REFERENCES or name.lower().endswith("ref")


def stimulation_protocol(where: str, model: SimpleNamespace, electrodes: int) -> je.Protocol:
    """The protocol of ``stimulation``; its currents are in A unless it says mA."""
    stimulation = _each(where, model, "stimulation")
    current = [
        (1e-3 if getattr(s, "stimulation", "Amp") == "mA" else 1.0)
        * _pattern(f"{where}.stimulation({k + 1})", s, "stim_pattern")
        for k, s in enumerate(stimulation)
    ]
    measured = [_pattern(f"{where}.stimulation({k + 1})", s, "meas_pattern") for k, s in enumerate(stimulation)]
    sizes = {len(column.ravel()) for column in current} | {matrix.shape[1] for matrix in measured}
    if sizes != {electrodes}:
        raise TankError(f"{where}.stimulation: patterns are for {sorted(sizes)} electrodes, not {electrodes}")
    columns = np.stack([column.ravel() for column in current], 1)
    with named_errors(f"{where}.stimulation"):
        return je.Protocol.from_matrices(columns, [matrix.T for matrix in measured])


def forward_models(variables: Mapping[str, Any]) -> Iterator[SimpleNamespace]:
    """What has nodes and elements, in images and inverse models too."""
    for value in variables.values():
        yield from _forward_models(value)


def _forward_models(value: Any) -> Iterator[SimpleNamespace]:
    for one in value if isinstance(value, list) else [value]:
        if isinstance(one, SimpleNamespace):
            if hasattr(one, "nodes") and hasattr(one, "elems"):
                yield one
            elif hasattr(one, "fwd_model"):
                yield from _forward_models(one.fwd_model)


def _each(where: str, model: SimpleNamespace, name: str) -> list[SimpleNamespace]:
    value = getattr(model, name, [])
    found = [one for one in (value if isinstance(value, list) else [value]) if isinstance(one, SimpleNamespace)]
    if not found:
        hint = "; give protocol= to load_eidors" if name == "stimulation" else ""
        raise TankError(f"{where}.{name}: missing; a tank needs its electrodes and its stimulation{hint}")
    return found


def _pattern(where: str, struct: SimpleNamespace, name: str) -> np.ndarray:
    value: Any = getattr(struct, name, None)
    if not (
        isinstance(value, np.ndarray) or sp.issparse(value)
    ):  # a word stands for a pattern that EIDORS makes when it solves
        raise TankError(f"{where}.{name}: is {value!r}; give a matrix, as mk_stim_patterns does")
    return np.atleast_2d(value.toarray() if sp.issparse(value) else value)


def _mesh(where: str, model: SimpleNamespace) -> tuple[je.meshing.Mesh, np.ndarray]:
    """The mesh, and the number in it of each node of the file, -1 for one without triangles."""
    nodes, elems = model.nodes, model.elems
    if not all(_is_finite(part) for part in (nodes, elems)):
        raise TankError(f"{where}: nodes and elems are no arrays of finite numbers")
    elems = np.atleast_2d(elems)
    if elems.shape[1] != 3 or nodes.ndim != 2:
        raise TankError(f"{where}: elements have {elems.shape[1]} nodes; a sheet is a plane mesh of triangles")
    try:
        return je.meshing.flat_mesh(nodes.astype(float), elems.astype(int) - 1)
    except je.meshing.MeshError as error:
        raise TankError(f"{where}: {error}; nodes of the file are counted from 1") from None


def _is_finite(part: Any) -> bool:
    numbers = isinstance(part, np.ndarray) and part.dtype.kind in "iuf" and part.size > 0
    return numbers and bool((np.abs(part) < np.iinfo(np.int32).max).all())


class _Rim:
    """The outer boundary of a mesh as a polygon, one corner a node."""

    def __init__(self, mesh: je.meshing.Mesh) -> None:
        self._nodes = mesh.nodes
        after = {int(a): int(b) for a, b in mesh.boundary_edges}
        loops = []
        while after:
            loop = [next(iter(after))]
            while (following := after.pop(loop[-1], None)) is not None and following != loop[0]:
                loop.append(following)
            loops.append(loop)
        self._loop = max(loops, key=lambda loop: float(np.ptp(mesh.nodes[loop], axis=0).prod()))
        self.domain = Polygon(mesh.nodes[self._loop])
        sides = np.linalg.norm(np.diff(mesh.nodes[[*self._loop, self._loop[0]]], axis=0), axis=1)
        self._along = np.concatenate([[0.0], np.cumsum(sides)])

    def electrode(
        self, where: str, struct: SimpleNamespace, number: np.ndarray
    ) -> je.BoundaryPatch | je.PointElectrode:
        """One node: a point; neighbours along the rim: the complete electrode model, z_contact in ohm m."""
        named = _numbers(struct, "nodes").astype(int) - 1
        nodes = number[named[(named >= 0) & (named < len(number))]]
        if not len(nodes) or len(nodes) < len(named) or (nodes < 0).any():
            raise TankError(f"{where}: names nodes that are none of the mesh")
        if len(nodes) == 1:
            x, y = self._nodes[nodes[0]]
            return je.PointElectrode((float(x), float(y)))
        on = np.isin(self._loop, nodes)
        sides = np.flatnonzero(on & np.roll(on, -1))
        first = sides[~np.isin((sides - 1) % len(on), sides)]
        if on.sum() != len(set(nodes.tolist())) or len(first) != 1 or len(sides) != on.sum() - 1:
            raise TankError(f"{where}: its nodes are no single stretch of the outer rim, on which electrodes lie here")
        start, perimeter = self._along[first[0]], self._along[-1]
        stop = self._along[(first[0] + len(sides)) % len(on)]
        contact = float(np.append(_numbers(struct, "z_contact"), 0.01)[0])  # the default of EIDORS
        return je.BoundaryPatch(float(start), float(stop if stop > start else stop + perimeter), contact)


def _numbers(struct: SimpleNamespace, name: str) -> np.ndarray:
    """The real numbers of a field, or none."""
    value = getattr(struct, name, None)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiuc":
        return np.zeros(0)
    return np.asarray(value.real.ravel(), float)


def columns_of(value: Any) -> np.ndarray | None:
    """A variable that can hold frames, one a column: an array of one or two axes, or a data structure with one."""
    value = getattr(value, "meas", value)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiuc" or value.ndim not in (1, 2):
        return None
    return value[:, None] if value.ndim == 1 else value


# --- the Kuopio Tomography Challenge 2023


class _KtcFrame(NamedTuple):
    current: np.ndarray
    measurement: np.ndarray
    readings: np.ndarray


def is_ktc(variables: Mapping[str, Any]) -> bool:
    """Whether these are the variables of a frame of the challenge."""
    return "Mpat" in variables and bool({"Uel", "Uelref"} & set(variables)) and "elfaces" not in variables


def _ktc_frame(path: Path, variables: Mapping[str, Any]) -> _KtcFrame:
    current = variables.get("Inj", variables.get("Injref"))
    readings, measured = variables.get("Uel", variables.get("Uelref")), variables.get("Mpat")
    if not all(isinstance(part, np.ndarray) and part.dtype.kind in "fiu" for part in (current, readings, measured)):
        raise TankError(f"{path.name}: has no numbers Inj, Mpat and Uel, as frames of the Kuopio challenge have")
    return _KtcFrame(1e-3 * np.asarray(current), np.asarray(measured, float), np.ravel(np.asarray(readings, float)))


def ktc_tank(path: Path, variables: Mapping[str, Any]) -> Tank:
    """A frame of the challenge, after the ``ref.mat`` beside it where there is one; currents of the file are in mA."""
    frame = _ktc_frame(path, variables)
    frames, names = [frame.readings], [path.stem]
    water = path.with_name("ref.mat")
    if "Uelref" not in variables and water.is_file():
        reference = _ktc_frame(water, read_matlab(water))
        if len(reference.readings) != len(frame.readings):
            raise TankError(f"{water.name}: has {len(reference.readings)} readings, {path.name} {len(frame.readings)}")
        frames, names = [reference.readings, *frames], ["ref", *names]
    count = len(frame.current)
    disc = je.Disc(KTC_RADIUS)
    rim = je.skin.rim_electrodes(disc, count, contact=KTC_CONTACT, start=np.pi / 2)
    with named_errors(path.name):
        protocol = je.Protocol.from_matrices(frame.current, frame.measurement)
    return Tank(je.Skin(path.stem, disc, 1.0, rim, protocol), np.array(frames), tuple(names))
