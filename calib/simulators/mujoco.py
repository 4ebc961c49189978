"""Contacts of MuJoCo on the geoms that carry a skin; needs the extra ``mujoco``, which nothing else imports.

`ContactReader` reads the list of contacts, and needs nothing in the model but a site. `SensorReader` reads a contact
sensor, whose numbers are arrays of a fixed size: those of many environments at once, also inside of `jax.jit`.

MuJoCo's ``<tactile>`` sensor is not read: it gives depths of penetration, and a skin needs newtons.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxeit as je

from .contacts import DIAMETER, REACH, SLOTS, ContactPoints, PlacedContacts, SimulatorError, place_contacts

try:
    import mujoco as mujoco  # for other modules too, which need not say again what is missing
except ImportError:
    raise ImportError("calib.simulators.mujoco needs MuJoCo; pip install 'jaxeit[mujoco]'") from None

RIM_POINTS = 512  # on the rim of a sheet, beside its corners
# Bits of what a contact sensor reports: found (1 number), force, pos, normal, tangent (3 numbers each).
REPORTED = sum(
    1 << int(field)
    for field in (
        mujoco.mjtConDataField.mjCONDATA_FOUND,
        mujoco.mjtConDataField.mjCONDATA_FORCE,
        mujoco.mjtConDataField.mjCONDATA_POS,
        mujoco.mjtConDataField.mjCONDATA_NORMAL,
        mujoco.mjtConDataField.mjCONDATA_TANGENT,
    )
)


class ContactReader:
    """Reads the contacts of a skin from ``mjData``; call it after ``mj_step`` or ``mj_forward``.

    A site of the model says where the skin lies: the site's frame is that of `Skin.surface`. A flat sheet has its
    corner (0, 0) at the site, and z points away from the robot. A cylinder has the site on its axis, at y = 0 of the
    sheet, and the middle of the sheet in the direction of z.

    Args:
        model: that `mujoco.MjModel` compiled.
        geoms: names of the geoms that the skin covers; contacts between two of them are not read.
        site: name of the site.
        slots, diameter, reach: see `calib.simulators.place_contacts`.

    Raises:
        SimulatorError: if the model has no geom or site of that name, or no geom is named.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        skin: je.Skin,
        *,
        geoms: Sequence[str],
        site: str,
        slots: int = SLOTS,
        diameter: float = DIAMETER,
        reach: float = REACH,
    ):
        if not geoms:
            raise SimulatorError("geoms is empty; name those that the skin covers")
        self._model, self._skin = model, skin
        # One place more, which the number -1 of a contact without a geom (that of a flex) finds.
        self._carries = np.zeros(model.ngeom + 1, bool)
        self._carries[[_number(model, mujoco.mjtObj.mjOBJ_GEOM, "geom", name) for name in geoms]] = True
        self._site = _number(model, mujoco.mjtObj.mjOBJ_SITE, "site", site)
        self._slots, self._diameter, self._reach = slots, diameter, reach

    def __call__(self, data: mujoco.MjData) -> PlacedContacts:
        """The contacts on the sheet in the last step, and how many are left out.

        Raises:
            SimulatorError: for more contacts than slots, or numbers that are not finite.
        """
        return self._placed(*self._read(data), None)

    def batch(self, environments: Sequence[mujoco.MjData]) -> PlacedContacts:
        """As a call, for many environments of one model: the arrays have a leading axis."""
        points, forces = zip(*map(self._read, environments), strict=True)
        return self._placed(np.concatenate(points), np.concatenate(forces), [len(part) for part in points])

    def _placed(self, points: np.ndarray, forces: np.ndarray, counts: list[int] | None) -> PlacedContacts:
        return place_contacts(
            self._skin, points, forces, counts, slots=self._slots, diameter=self._diameter, reach=self._reach
        )

    def _read(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Points of contact (n, 3) m and forces on the skin (n, 3) N, in the frame of the site."""
        first, second = self._carries[data.contact.geom].T
        rows = np.flatnonzero(first != second)
        forces = np.array([self._force(data, row) for row in rows.tolist()]).reshape(-1, 3)
        forces = np.where(second[rows, None], forces, -forces)
        rotation = data.site_xmat[self._site].reshape(3, 3)
        return (data.contact.pos[rows] - data.site_xpos[self._site]) @ rotation, forces @ rotation

    def _force(self, data: mujoco.MjData, row: int) -> np.ndarray:
        """Force on the second geom of a contact, in the frame of the world, (3,) N."""
        wrench = np.zeros(6)
        mujoco.mj_contactForce(self._model, data, row, wrench)
        # The rows of the frame are the axes of the contact; the first is the normal, from the first geom to the second.
        force: np.ndarray = wrench[:3] @ data.contact.frame[row].reshape(3, 3)
        return force


class SensorReader(eqx.Module):
    """Reads the contacts of a skin from a contact sensor of MuJoCo, which the model needs for the geom of the skin::

        <contact name="touch" geom1="chest" num="8" data="found force pos normal tangent" reduce="maxforce"/>

    Call it with whatever has ``sensordata``, ``site_xpos`` and ``site_xmat``: `mujoco.MjData`, a `mujoco.batch.Batch`
    that has bound these three, or data of MJX inside of `jax.jit` and `jax.vmap`. The result has one row for each of
    the ``num`` contacts.

    Args:
        model: that `mujoco.MjModel` compiled.
        sensor: its name.
        site: name of the site; see `ContactReader`.
        diameter, reach: see `calib.simulators.place_contacts`.

    Raises:
        SimulatorError: if the model has no sensor or site of that name, or the sensor is another one.
    """

    rim: Float[Array, "corners 2"]
    diameter: Float[Array, ""]
    reach: Float[Array, ""]
    surface: je.geometry.AbstractSurface = eqx.field(static=True)
    site: int = eqx.field(static=True)
    first: int = eqx.field(static=True)
    slots: int = eqx.field(static=True)

    def __init__(
        self,
        model: mujoco.MjModel,
        skin: je.Skin,
        *,
        sensor: str,
        site: str,
        diameter: float = DIAMETER,
        reach: float = REACH,
    ):
        number = _number(model, mujoco.mjtObj.mjOBJ_SENSOR, "sensor", sensor)
        reported, _, self.slots = model.sensor_intprm[number].tolist()
        geom = model.sensor_objtype[number] == mujoco.mjtObj.mjOBJ_GEOM
        if model.sensor_type[number] != mujoco.mjtSensor.mjSENS_CONTACT or reported != REPORTED or not geom:
            raise SimulatorError(
                f"sensor {sensor!r} cannot be read; make it <contact geom1=... num=... "
                'data="found force pos normal tangent" reduce="maxforce"/>'
            )
        self.site, self.first = _number(model, mujoco.mjtObj.mjOBJ_SITE, "site", site), int(model.sensor_adr[number])
        domain = skin.domain
        around = np.append(domain.corners, np.linspace(0, domain.perimeter, RIM_POINTS, endpoint=False))
        self.rim, self.surface = (
            jnp.asarray(domain.boundary_point(np.unique(around))),
            skin.surface or je.geometry.Plane(),
        )
        self.diameter, self.reach = jnp.asarray(diameter, float), jnp.asarray(reach, float)

    def __call__(self, data: Any) -> PlacedContacts:
        """The contacts on the sheet in the last step, and how many are left out; the arrays have the leading axes of
        the data. Numbers that are not finite give contacts that are not finite."""
        return _sensed(self, *map(jnp.asarray, (data.sensordata, data.site_xpos, data.site_xmat)))


@je.verb
def _sensed(
    reader: SensorReader,
    sensed: Float[Array, "*environments numbers"],
    origins: Float[Array, "*environments sites 3"],
    axes: Float[Array, "..."],
) -> PlacedContacts:
    batch, slots = sensed.shape[:-1], reader.slots
    numbers = sensed[..., reader.first : reader.first + 13 * slots].reshape(*batch, slots, 13)
    found, force, place, normal, tangent = jnp.split(numbers, [1, 4, 7, 10], -1)
    rotation = axes.reshape(*batch, -1, 3, 3)[..., reader.site, :, :]
    frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)], -2)
    given = (found > 0)[..., 0]
    points = jnp.where(given[..., None], place - origins[..., None, reader.site, :], 0) @ rotation
    chart, height, out = map(jnp.asarray, reader.surface.project(points))
    acting = jnp.einsum("...k,...kx->...x", force, frame) @ rotation  # from the skin on what touches it
    load = jnp.sum(acting * out, -1)
    on_sheet = given & _inside(reader.rim, chart) & (jnp.abs(height) <= reader.reach)
    force = jnp.where(on_sheet & (load > 0), load, 0)
    force = jnp.where(jnp.isfinite(load + height), force, jnp.nan)  # a simulation that has diverged
    contacts = ContactPoints(chart, force, jnp.broadcast_to(reader.diameter.astype(force.dtype), force.shape))
    beyond = jnp.maximum(jnp.max(found[..., 0], -1) - slots, 0).astype(int)
    return PlacedContacts(contacts, jnp.sum(given & ~on_sheet, -1), jnp.sum(on_sheet & (load < 0), -1), beyond)


def _inside(rim: Float[Array, "corners 2"], places: Float[Array, "*places 2"]) -> Bool[Array, "*places"]:
    """Even-odd rule: a ray to the right of a place inside crosses the rim an odd number of times."""
    rim = rim.astype(places.dtype)
    (x0, y0), (x1, y1) = rim.T, jnp.roll(rim, -1, 0).T
    x, y = places[..., :1], places[..., 1:]
    spans = (y0 > y) != (y1 > y)
    across = x < x0 + (y - y0) * (x1 - x0) / jnp.where(y1 == y0, 1, y1 - y0)
    odd: Array = jnp.sum(spans & across, -1) % 2 == 1
    return odd


def _number(model: mujoco.MjModel, kind: mujoco.mjtObj, word: str, name: str) -> int:
    found = int(mujoco.mj_name2id(model, kind, name))
    if found < 0:
        raise SimulatorError(f"the model has no {word} {name!r}; name one in its MJCF")
    return found
