"""Files of tanks, written as other programs write them."""

from dataclasses import replace

import numpy as np
from scipy.io import savemat

import jaxeit as je
from calib.tanks import difference_image, load_tank

from ..helpers import skin_of
from .rods import COUNT, CURRENT, RADIUS

RING = np.eye(COUNT) - np.roll(np.eye(COUNT), 1, 0)


def write_csv(path, frames):
    """Real and imaginary part by turns, of the polarity of PyEIDORS."""
    np.savetxt(path, np.stack([-frames[0], 0.1 * frames[0], -frames[1], 0.1 * frames[1]], 1), delimiter=",")
    return path


def change_on_mesh(path, mesh, electrodes, hyperparameter):
    """Change between the two frames of a file by NOSER, for each triangle of a mesh of a disc of radius 1."""
    tank = load_tank(path, je.Disc(1.0), rim=electrodes)
    basis = je.Elements()
    weight = float(hyperparameter)
    found = difference_image(replace(tank, mesh=mesh), prior=je.Noser(), basis=basis, hyperparameter=weight)
    return found.change


def struct(name, values):
    """A structure array of MATLAB."""
    out = np.empty((1, len(values)), dtype=[(key, object) for key in values[0]])
    for number, value in enumerate(values):
        out[0, number] = tuple(value[key] for key in values[0])
    return {name: out}


def forward_model(bench, change=None):
    """A model as EIDORS has it: counted from 1, some triangles clockwise, a node without triangles."""
    model = bench.model
    nodes = np.concatenate([[[9.0, 9.0]], np.asarray(model.nodes)])
    elems = np.asarray(model.triangles) + 2
    elems[::3] = elems[::3][:, ::-1]
    electrodes = []
    for number, electrode in enumerate(bench.skin.electrodes):
        ends = je.Disc(RADIUS).boundary_coordinate(nodes[1:])
        on = np.abs(np.linalg.norm(nodes[1:], axis=1) - RADIUS) < 1e-9
        along = (ends - electrode.start + 1e-9) % bench.skin.domain.perimeter
        under = np.flatnonzero(on & (along < electrode.stop - electrode.start + 2e-9))
        electrodes.append({"nodes": under[:: -1 if number % 2 else 1] + 2.0, "z_contact": 2e-3})
    stimulation = [
        {
            "stimulation": "Amp",
            "stim_pattern": CURRENT * RING[:, [d]],
            "meas_pattern": RING[:, [(d + k) % COUNT for k in range(2, COUNT - 1)]].T,
        }
        for d in range(COUNT)
    ]
    fields = {"nodes": nodes, "elems": elems.astype(float), "gnd_node": 1.0, "type": "fwd_model"}
    found = fields | struct("electrode", electrodes) | struct("stimulation", stimulation)
    return found | (change or {})


def write_mat(path, bench, **change):
    """The later frame comes first in the file."""
    frames = {"vi": {"meas": bench.frames[1]}, "vh": {"meas": bench.frames[0], "type": "data"}, "note": "none"}
    savemat(path, frames | {"imdl": {"fwd_model": forward_model(bench, change), "name": "mine"}})
    return path


def write_sciospec(folder, bench):
    """Potentials above an unknown ground; two frequencies."""
    mean = je.Protocol.from_matrices(CURRENT * RING, np.eye(COUNT) - 1 / COUNT)
    skin = skin_of(bench.skin.domain, bench.skin.electrodes, mean.pattern)
    model = je.discretise(je.Scene(je.Skin("", skin.domain, 1.0, skin.electrodes, mean)), je.Fidelity(edge_length=0.06))
    potential = np.asarray(je.forward(model)).reshape(COUNT, COUNT) + 2e-5
    head = ["18", "2", "setup", "2024-01-01", "1000", "2000", "0", "2", f"{CURRENT:.6E}"] + ["1"] * 7
    lines = [*head, "MeasurementChannels: 1,2", "MeasurementChannelsIndependentFromInjectionPattern: 1,2"]
    for drive in range(COUNT):
        rows = np.stack([potential[drive], 0.2 * potential[drive]], 1).ravel()
        twice = ["\t".join(f"{value:.9E}" for value in factor * rows) for factor in (1, 7)]
        lines += [f"{drive + 1} {(drive + 1) % COUNT + 1}", *twice]
    for name in ("setup_00001.eit", "setup_00002.eit"):
        (folder / name).write_text("\n".join(lines) + "\n")


def write_ktc(folder, fidelity=None):
    """Each drive has its own current, in mA; the reference lies beside the frame. Returns the readings."""
    disc = je.Disc(0.115)
    rim = je.skin.rim_electrodes(disc, COUNT, contact=1e-4, start=np.pi / 2)
    current = RING[:, ::2] * np.linspace(1.4, 1.6, 8)
    protocol = je.Protocol.from_matrices(1e-3 * current, RING[:, :15])
    tank = je.Skin("", disc, 1.0, rim, protocol)
    readings = np.asarray(je.forward(je.discretise(je.Scene(tank), fidelity or je.Fidelity.draft())))
    savemat(folder / "ref.mat", {"Injref": current, "Mpat": RING[:, :15], "Uelref": readings[:, None]})
    savemat(folder / "data1.mat", {"Inj": current, "Mpat": RING[:, :15], "Uel": 1.1 * readings[:, None]})
    return readings
