"""Event-driven scans: pressure and the latest contacts select the next readings."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from .._compile import require_known
from ..fusion import pad_masks
from ..geometry.shapes import Domain
from ..imaging.priors import Noser
from ..model.bases import AbstractBasis, BasisMap, Pixels
from ..model.discretisation import Model
from ..skin.description import Skin
from ..skin.protocol import ProtocolError
from .covariance import around, region_covariance
from .selection import AbstractSelection, choose_readings


class ScanState(eqx.Module):
    """State of an `EventScan` between two frames.

    | meaning                                      | shape   |
    |----------------------------------------------|---------|
    | since: frames since the last whole scan      | ()      |
    | pressed: pads that are in contact            | (pads,) |
    """

    since: Int[Array, ""]
    pressed: Bool[Array, " pads"]


class EventScan(eqx.Module):
    """A scan directed by pressure: few readings at rest, and the readings around the contact during a contact.

    `step` is pure and has fixed shapes, so that it runs under jit and `jax.lax.scan`.

    | meaning                                                               | shape               | unit |
    |-----------------------------------------------------------------------|---------------------|------|
    | idle: readings of every frame                                         | (readings,)         |      |
    | by_pad: readings while the pad is pressed at an unknown place         | (pads, readings)    |      |
    | by_place: readings while this centre is the nearest one to a contact  | (regions, readings) |      |
    | centres of the regions                                                | (regions, 2)        | m    |
    | pad_of: whether the centre of the region lies on the pad              | (regions, pads)     |      |
    | onset, release: change of pressure at which a contact begins and ends | (pads,)             | Pa   |
    | every: frames from one whole scan to the next                         | ()                  |      |
    """

    idle: Bool[Array, " readings"]
    by_pad: Bool[Array, "pads readings"]
    by_place: Bool[Array, "regions readings"]
    centres: Float[Array, "regions 2"]
    pad_of: Bool[Array, "regions pads"]
    onset: Float[Array, " pads"]
    release: Float[Array, " pads"]
    every: Int[Array, ""]

    def start(self) -> ScanState:
        """The state before the first frame, which is a whole scan."""
        return ScanState(self.every - 1, jnp.zeros(len(self.by_pad), bool))

    def step(
        self,
        state: ScanState,
        pressure: Float[ArrayLike, " pads"],
        places: Float[ArrayLike, "contacts 2"] | None = None,
    ) -> tuple[ScanState, Bool[Array, " readings"]]:
        """The next state, and the readings to take next.

        Args:
            state: from `start` or the step before.
            pressure: change of each pad's pressure from rest, (pads,) Pa.  A pad whose pressure is not finite counts as
                pressed.
            places: contacts of the frame before, (contacts, 2) m, NaN for a contact that is not there; None: unknown.
        """
        pressure = jnp.asarray(pressure, self.onset.dtype)
        limit = jnp.where(state.pressed, self.release, self.onset)
        pressed = ~(pressure <= limit)
        known, placed = self._readings_around(places)
        unknown = jnp.any(self.by_pad & (pressed & ~placed)[:, None], 0)
        whole = state.since >= self.every - 1
        readings = whole | self.idle | (jnp.any(pressed) & known) | unknown
        return ScanState(jnp.where(whole, 0, state.since + 1), pressed), readings

    def _readings_around(
        self, places: Float[ArrayLike, "contacts 2"] | None
    ) -> tuple[Bool[Array, " readings"], Bool[Array, " pads"]]:
        """Readings around the contacts, and the pads that the contacts lie on."""
        if places is None:
            return jnp.zeros_like(self.idle), jnp.zeros(len(self.by_pad), bool)
        places = jnp.asarray(places, self.centres.dtype)
        present = jnp.isfinite(places).all(-1)
        square = jnp.sum((jnp.where(present[:, None], places, 0)[:, None] - self.centres) ** 2, -1)
        nearest = jnp.argmin(square, 1)
        known = jnp.any(self.by_place[nearest] & present[:, None], 0)
        return known, jnp.any(self.pad_of[nearest] & present[:, None], 0)


@dataclass(frozen=True, eq=False)
class EventScanSettings:
    """The settings of an event-driven scan.

    | meaning                                                                          | default       | unit     |
    |----------------------------------------------------------------------------------|---------------|----------|
    | onset: change of pressure at which a contact begins, one for all pads or (pads,) |               | Pa       |
    | release: change of pressure at which a contact ends, as onset                    | half of onset | Pa       |
    | idle: readings of a frame at rest                                                | 24            |          |
    | local: readings for a pad, or for the surroundings of a contact; at most all     | 80            |          |
    | every: frames from one whole scan to the next                                    | 50            |          |
    | radius: of the surroundings of a contact (`around`)                              | 0.03          | m        |
    | switch: cost of a change of the driven pair, as for `choose_readings`            | 0             | readings |
    | selection: rule that ranks the readings                                          | `DOptimal`    |          |

    The onset must be well above the noise of the pressure sensors. Regions have their centres on a grid with a
    pitch of at most the radius.

    Raises:
        ProtocolError: for a value out of range.
    """

    onset: Float[ArrayLike, "..."]
    release: Float[ArrayLike, "..."] | None = None
    idle: int = 24
    local: int = 80
    every: int = 50
    radius: float = 0.03
    switch: float = 0.0
    selection: AbstractSelection | None = None

    def __post_init__(self) -> None:
        if self.every < 1 or not self.radius > 0:
            raise ProtocolError(
                f"every is {self.every} and radius {self.radius}; give one frame or more, and a radius of "
                "metres above 0"
            )

    def limits(self, pads: int) -> tuple[Float[np.ndarray, " pads"], Float[np.ndarray, " pads"]]:
        """Onset and release of every pad, (pads,) Pa each.

        Raises:
            ProtocolError: if they are not finite and above zero, or a release is above its onset.
        """
        onset = np.broadcast_to(np.asarray(self.onset, float), pads)
        release = onset / 2 if self.release is None else np.broadcast_to(np.asarray(self.release, float), pads)
        if not (np.isfinite(onset).all() and (release > 0).all() and (onset >= release).all()):
            raise ProtocolError(
                f"onset is {onset} and release {release} Pa; give finite ones above 0, onset no less than release"
            )
        return onset, release


def prepare_event_scan(
    model: Model,
    skin: Skin,
    settings: EventScanSettings,
    *,
    basis: AbstractBasis | BasisMap | None = None,
    noise: Float[ArrayLike, " readings"] | None = None,
    hyperparameter: float = 0.1,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
) -> EventScan:
    """Compute the tables of an `EventScan` for a skin with pads, on the host.

    Args:
        model: the model of the whole scan.
        skin: the skin, which needs pads.
        settings: numbers of readings, limits of pressure and radius.
        basis: an image of pixels; default `Pixels`, 20 along x.
        noise, hyperparameter, sigma: as for `signal_covariance`.
        channels: readings that tell something; a dead one is in whole scans only, which show whether it is repaired.

    Raises:
        ProtocolError: if the skin has no pads, or a setting is out of range.
        InverseError: as for `signal_covariance`.

    Example:
        # Pa, readings, readings, m
        settings = je.scan.EventScanSettings(onset=100.0, idle=24, local=80, radius=0.06)
        scan = je.scan.prepare_event_scan(model, skin, settings, basis=pixels)
        state = scan.start()
        # Pa on each pad, frame by frame
        for pressure in ([0.0, 0, 0, 0], [0.0, 0, 0, 0], [0.0, 0, 400, 0]):
            state, readings = scan.step(state, jnp.array(pressure))
            print(int(readings.sum()), "readings to take next")
    """
    given = model, settings.onset, settings.release, noise, hyperparameter, sigma, channels
    require_known("prepare_event_scan", ProtocolError, *given)
    _require_pads(skin)
    onset, release = settings.limits(len(skin.pads))
    image = basis if isinstance(basis, BasisMap) else (basis or Pixels(20)).on(model)
    centres = _region_centres(skin.domain, settings.radius)
    places = jnp.stack([around(image.picture, centre, settings.radius) for centre in centres])
    covariance = region_covariance(model, Noser(), image, noise, hyperparameter, sigma, channels)
    usable = np.arange(model.readings) if channels is None else np.flatnonzero(np.asarray(channels))
    choose = partial(_region_readings, model, settings, covariance, usable)
    return EventScan(
        idle=choose(jnp.ones((1, image.size)), settings.idle)[0],
        by_pad=choose(pad_masks(skin, image).weights, settings.local),
        by_place=choose(places, settings.local),
        centres=jnp.asarray(centres, model.dtype),
        pad_of=jnp.asarray(skin.pads_at(centres).T),
        onset=jnp.asarray(onset, model.dtype),
        release=jnp.asarray(release, model.dtype),
        every=jnp.asarray(settings.every),
    )


def _require_pads(skin: Skin) -> None:
    """Refuse a skin whose scan no pressure can direct."""
    if not skin.pads:
        raise ProtocolError(
            f"the skin {skin.name!r} has no pads, and their pressure directs the scan; give a skin with pads"
        )
    skin.protocol.rows("an event-driven scan")


def _region_readings(
    model: Model,
    settings: EventScanSettings,
    covariance: Callable[[Float[Array, " basis"]], Float[Array, "readings readings"]],
    usable: Int[np.ndarray, " n"],
    regions: Float[Array, "regions basis"],
    count: int,
) -> Bool[Array, "regions readings"]:
    """Choose the usable readings that inform most on each region: ``count`` of them, or all.

    Args:
        covariance: of the readings by changes in a region.
    """
    pattern, count = model.pattern[usable], min(count, len(usable))
    covariances = (covariance(region.astype(model.dtype))[usable][:, usable] for region in regions)
    rows = [
        choose_readings(k, count, settings.selection, pattern=pattern, switch=settings.switch).rows for k in covariances
    ]
    none = jnp.zeros((len(rows), model.readings), bool)
    return none.at[jnp.arange(len(rows))[:, None], jnp.asarray(usable)[jnp.stack(rows)]].set(True)


def _region_centres(domain: Domain, pitch: float) -> Float[np.ndarray, "regions 2"]:
    """Centres of equal cells, with sides of at most ``pitch`` m, that lie on the sheet."""
    low, high = np.asarray(domain.bounds)
    cells = np.ceil((high - low) / pitch).astype(int)
    axes = [lo + (hi - lo) * (np.arange(n) + 0.5) / n for lo, hi, n in zip(low, high, cells, strict=True)]
    centres = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    return np.asarray(centres[domain.contains(centres)])
