"""Contacts of a simulator: from points and forces in space to loads at places of the flat sheet."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

import jaxeit as je

SLOTS = 16  # rows for contacts: arrays of one size need one compiled program
DIAMETER = 0.02  # m, of the tip of a simulated bench
REACH = 0.01  # m

Numbers = np.ndarray | Array


class SimulatorError(ValueError):
    """A scene, or contacts of a simulator, from which no readings can be computed.

    Example:
        print([family.__name__ for family in simulators.NOT_IN_A_STEP], "have no part in a step")
        try:
            simulators.prepare_skin(je.Scene(scene.skin), rate=50.0)
        except simulators.SimulatorError as error:
            print(error)
    """


class ContactPoints(NamedTuple):
    """Contacts on a sheet, one a row; rows without force are empty. Batches of environments have a leading axis.

    | meaning                                                        | shape                 | unit |
    |----------------------------------------------------------------|-----------------------|------|
    | position in the sheet's flat coordinates                       | (..., contacts, 2)    | m    |
    | force that presses into the sheet; 0 or less: an empty row     | (..., contacts)       | N    |
    | diameter of what presses, for effects that spread by it        | (..., contacts)       | m    |

    Example:
        # m, N, m
        contacts = simulators.ContactPoints(np.array([[0.06, 0.13]]), np.array([5.0]), np.array([0.02]))
        state, readings = step(state, contacts)
    """

    position: Float[Numbers, "*environments contacts 2"]
    force: Float[Numbers, "*environments contacts"]
    diameter: Float[Numbers, "*environments contacts"]


class PlacedContacts(NamedTuple):
    """The contacts on a sheet, and the numbers of those that are left out; see `place_contacts`.

    | meaning                                                                   | shape |
    |---------------------------------------------------------------------------|-------|
    | contacts on the sheet                                                     |       |
    | off_sheet: beside the sheet                                               | (...) |
    | pulling: their force points away from the sheet                           | (...) |
    | unreported: a sensor of the simulator has fewer slots than there were     | (...) |
    """

    contacts: ContactPoints
    off_sheet: Int[Numbers, "*environments"]
    pulling: Int[Numbers, "*environments"]
    unreported: Int[Numbers, "*environments"]


def place_contacts(
    skin: je.Skin,
    points: Float[np.ndarray, "n 3"],
    forces: Float[np.ndarray, "n 3"],
    counts: Sequence[int] | None = None,
    *,
    slots: int = SLOTS,
    diameter: float = DIAMETER,
    reach: float = REACH,
) -> PlacedContacts:
    """Contacts in space as loads on the flat sheet.

    The load is the part of a force that is normal to the sheet at the contact. A contact beyond the rim of the sheet,
    or farther than ``reach`` from its surface, is off the sheet; a force that points away from the sheet pulls. Both
    are left out and counted. A contact without force is left out, too.

    A simulator of rigid bodies knows points of contact, not areas. The width of the load on the sheet is that of the
    scene, such as `jaxeit.effects.LoadSpreading`, whose width includes the tip; ``diameter`` counts for effects that
    depend on the tip, such as `jaxeit.effects.IndentationSpreading`. No formula of Hertz is applied: a skin is a sheet
    on hollow pads and no elastic half-space.

    Args:
        skin: its domain, and its surface, which is in the plane z = 0 if it has none.
        points: of contact, in the skin's frame, (n, 3) m; the frame is that of `Skin.surface`.
        forces: that act on the skin, in the same frame, (n, 3) N.
        counts: of a batch of environments, the number of contacts of each, one environment after the other.
        slots: rows of the result.
        diameter: of what presses, m.
        reach: largest distance of a contact from the surface, m. Contacts lie inside of bodies that overlap.

    Raises:
        SimulatorError: for more contacts than slots, or numbers that are not finite.
    """
    points, forces = np.asarray(points, float), np.asarray(forces, float)
    if not (np.isfinite(points).all() and np.isfinite(forces).all()):
        raise SimulatorError("a contact has a place or a force that is not finite; the simulation has diverged")
    chart, height, normal = map(np.asarray, (skin.surface or je.geometry.Plane()).project(points))
    load = -np.sum(forces * normal, 1)
    on_sheet = skin.domain.contains(chart) & (np.abs(height) <= reach)
    sizes = np.array([len(points)] if counts is None else counts, int)
    environment = np.repeat(np.arange(len(sizes)), sizes)
    kept = on_sheet & (load > 0)
    filled = _filled(chart[kept], load[kept], environment[kept], (len(sizes), slots), diameter)
    off_sheet, pulling = (
        np.bincount(environment[which], minlength=len(sizes)) for which in (~on_sheet, on_sheet & (load < 0))
    )
    placed = PlacedContacts(filled, off_sheet, pulling, np.zeros_like(pulling))
    return placed if counts is not None else jax.tree.map(lambda part: np.asarray(part[0]), placed)


def _filled(
    chart: np.ndarray, load: np.ndarray, environment: np.ndarray, shape: tuple[int, int], diameter: float
) -> ContactPoints:
    """Rows of contacts, sorted by environment, as arrays with (environments, slots) rows."""
    pressing = np.bincount(environment, minlength=shape[0])
    if (pressing > shape[1]).any():
        most = pressing.max()
        raise SimulatorError(f"{most} contacts press the skin, and there are {shape[1]} slots; give slots={most}")
    slot = np.arange(len(load)) - (np.cumsum(pressing) - pressing)[environment]
    position, force = np.zeros((*shape, 2)), np.zeros(shape)
    position[environment, slot], force[environment, slot] = chart, load
    return ContactPoints(position, force, np.full(shape, float(diameter)))
