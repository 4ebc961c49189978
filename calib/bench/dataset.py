"""The paper's data set: voltages of Gaussian contacts on a grid of places, at a range of amplitudes."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxeit as je

from ..session import ArchiveWriter
from .bench import BenchError
from .simulation import Progress

FORMAT = "skin-dataset"
CONTACTS_PER_DEVICE = 64  # contacts that are sent to a device in one piece of progress
# Contacts that are solved together. From `jaxeit.linalg.multifrontal.batches.MIN_BATCH` on, a solve takes a quarter
# to a half of the time, but the program takes twice as long to compile, which pays only for many contacts.
FEW_TOGETHER, MANY_TOGETHER, MANY = 8, 32, 1000


def grid(skin: je.Skin, columns: int = 41, rows: int = 41) -> Float[np.ndarray, "places 2"]:
    """Places (m) on the sheet on a regular grid over its bounding box; 5 mm apart on the testbed."""
    (x0, y0), (x1, y1) = skin.domain.bounds
    places = np.stack(np.meshgrid(np.linspace(x0, x1, columns), np.linspace(y0, y1, rows)), -1).reshape(-1, 2)
    inward = places + 1e-9 * (np.array([[x0 + x1, y0 + y1]]) / 2 - places)
    return np.asarray(places[skin.domain.contains(inward)])


def simulate_contacts(
    model: je.Model,
    places: Float[np.ndarray, "places 2"],
    amplitudes: Float[np.ndarray, " amplitudes"],
    *,
    width: float = 0.012,
    progress: Progress = iter,
) -> Float[np.ndarray, "places amplitudes readings"]:
    """Voltages (V) for ``sigma = sigma0 (1 + amplitude exp(-|r - place|^2 / (2 width^2)))``, sigma0 that of the scene.

    The contacts are solved in batches, which are shared out over all devices of JAX (`jaxeit.bind_many`).

    Args:
        places: centres of the contacts, m.
        amplitudes: largest relative change of the conductivity.
        width: of the Gaussian, m.
        progress: wraps the iteration over pieces of the data set.

    Example:
        model = je.discretise(je.Scene(bench.scene.skin), je.Fidelity.draft())
        places = calib.bench.grid(bench.scene.skin, columns=4, rows=4)  # m
        print("simulated sessions have", calib.bench.SIMULATION)  # calib.simulate's own fidelity
        frames = calib.bench.simulate_contacts(model, places, np.array([0.0, 0.5]), width=0.012)  # V
        print(frames.shape, "places, amplitudes, readings")
    """
    at, size = np.repeat(np.arange(len(places)), len(amplitudes)), np.tile(amplitudes, len(places))
    contacts = np.column_stack([places[at], size]).astype(model.dtype)
    together, spread = MANY_TOGETHER if len(at) >= MANY else FEW_TOGETHER, jnp.asarray(width, model.dtype)
    solve = je.bind_many(_frame, model, je.conductivity(model), spread, together=together)
    piece = min(CONTACTS_PER_DEVICE * jax.local_device_count(), len(at))
    out = np.empty((len(at), model.readings), model.dtype)
    for start in progress(range(0, len(at), piece)):
        rows = np.minimum(np.arange(start, start + piece), len(at) - 1)
        out[start : start + piece] = np.asarray(solve(contacts[rows]))[: len(at) - start]
    return out.reshape(len(places), len(amplitudes), -1)


def _frame(
    model: je.Model, sigma: Array, width: Float[Array, ""], contact: Float[Array, "3"]
) -> Float[Array, " readings"]:
    square = jnp.sum((model.centroids - contact[:2]) ** 2, -1)
    return je.forward(model, sigma * (1 + contact[2] * jnp.exp(-0.5 * square / width**2)))


def write_data_set(
    skin: je.Skin,
    path: str | Path,
    *,
    columns: int = 41,
    rows: int = 41,
    steps: int = 11,
    width: float = 0.012,
    fidelity: je.Fidelity | None = None,
    progress: Progress = iter,
) -> tuple[int, int]:
    """Simulate `simulate_contacts` on `grid` with amplitudes from 0 to 1 on the ideal sensor, and write it as HDF5.

    Returns:
        Number of places, and number of amplitudes.

    Raises:
        BenchError: for less than one column or row, or less than two steps.

    Example:
        draft = je.Fidelity.draft()
        places, steps = calib.bench.write_data_set(
            bench.scene.skin, "contacts.h5", columns=4, rows=4, steps=2, fidelity=draft
        )
    """
    if columns < 1 or rows < 1 or steps < 2:
        raise BenchError(f"{columns} x {rows} places in {steps} steps make no data set; give one place and two steps")
    model = je.discretise(je.Scene(skin), je.Fidelity(edge_length=0.02) if fidelity is None else fidelity)
    places, amplitudes = grid(skin, columns, rows), np.linspace(0, 1, steps)
    voltages = simulate_contacts(model, places, amplitudes, width=width, progress=progress)
    attrs: dict[str, str | bool | float] = {
        "skin": skin.name,
        "skin_toml": skin.toml,
        "simulated": True,
        "width_m": width,
    }
    with ArchiveWriter(path, FORMAT, attrs) as writer:
        writer.add("places", places, "m", "centres of the contacts")
        writer.add("amplitudes", amplitudes, "1", "largest relative change of the conductivity")
        writer.add("voltages", voltages, "V", "readings of the protocol, by place and amplitude")
    return len(places), len(amplitudes)
