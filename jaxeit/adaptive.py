"""Fewer readings a frame: which of a scan's readings tell the most, and when to take which.

A frame costs time for each of its readings, and for each change of the pair that is driven.  How much readings S tell
of an image with prior covariance G is, in units of their noise,

    log det(1 + K_SS) = log det(G^-1 + J_S^T J_S) - log det(G^-1),        K = J G J^T,

so K, readings by readings, is all that a choice needs (`signal_covariance`).  Readings are taken one by one, the one
next that tells the most beside those taken; what these already say leaves K.  As log det is submodular, the readings so
chosen tell at least 1 - 1/e of what the best as many would (Nemhauser, Wolsey and Fisher 1978).
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from .basis import AbstractBasis, BasisMap, Picture, Pixels
from .discretise import Model
from .domain import Domain, Polygon
from .fusion import pad_masks
from .jacobian import jacobian
from .methods import Problem
from .priors import AbstractPrior, Noser
from .protocol import Protocol, ProtocolError
from .skin import Skin
from .verbs import verb
from .whitening import InverseError, noise_weight

_RANK = 1e-11  # of the largest signal: what is left below is rounding


class AbstractSelection(eqx.Module):
    """What makes a reading the next one; one class, one export and one row in the tests make a new one."""

    @abstractmethod
    def gain(self, left: Float[Array, " readings"]) -> Float[Array, " readings"]:
        """What each reading is worth, given the signal that those taken have left it; zero or more."""

    @abstractmethod
    def pivot(self, left: Float[Array, ""]) -> Float[Array, ""]:
        """By what the outer product of a taken reading's column is divided before it leaves the signal."""


class DOptimal(AbstractSelection):
    """Greedy on ``log det(1 + K_SS)``: the readings after which the image is known best, noise and prior weighed."""

    def gain(self, left):
        return jnp.log1p(jnp.maximum(left, 0))

    def pivot(self, left):
        return 1 + left


class Volume(AbstractSelection):
    """Greedy on ``det K_SS``, the volume that the rows of sensitivity span (arXiv 2111.01397): it knows no noise.

    It can name no more readings than the rank of K.
    """

    def gain(self, left):
        return jnp.maximum(left, 0)

    def pivot(self, left):
        return left


class Sensitive(AbstractSelection):
    """The largest of ``sum_e J_me^2`` (times the prior's variance), each reading for itself: many say the same."""

    def gain(self, left):
        return jnp.maximum(left, 0)

    def pivot(self, left):
        return jnp.full_like(left, jnp.inf)


class Chosen(eqx.Module):
    """Readings in the order in which they were taken.

    | meaning                                                     | shape    |
    |-------------------------------------------------------------|----------|
    | rows of the scan's pattern                                  | (count,) |
    | gain of each, as its `AbstractSelection` counts; `DOptimal`: nats | (count,) |
    """

    rows: Int[Array, " count"]
    gain: Float[Array, " count"]


def signal_covariance(
    model: Model,
    prior: AbstractPrior | None = None,
    basis: AbstractBasis | BasisMap | None = None,
    noise: Float[ArrayLike, " readings"] | None = None,
    hyperparameter: float = 0.1,
    *,
    sigma: Float[Array, " elements"] | None = None,
    region: Float[ArrayLike, "... basis"] | None = None,
) -> Float[Array, "... readings readings"]:
    """K: covariance of what the prior expects of the readings, in units of their noise.

    Args:
        prior, hyperparameter: as for `prepare`; default `Noser` and 0.1.
        basis: default `Pixels`, 40 along x.  Under jit pass a `BasisMap`.
        noise: standard deviation of each reading, (readings,) V; default: the same for all.
        sigma: conductivity to linearise at, (elements,) S; default: the untouched sheet.
        region: where changes are expected, (basis,) 0 to 1: the prior's variances are multiplied with it
            (`around`, or weights of `pad_masks`); the strength stays that of the whole sheet.  Leading axes are
            several regions.

    Raises:
        InverseError: if the noise is not one positive number a reading.
    """
    image = basis if isinstance(basis, BasisMap) else (basis or Pixels()).on(model)
    flat = jnp.ones(image.size, model.dtype) if region is None else jnp.asarray(region, model.dtype)
    return _covariances(model, prior or Noser(), image, noise, hyperparameter, sigma)(flat)


def _covariances(
    model: Model, prior: AbstractPrior, image: BasisMap, noise, hyperparameter: float, sigma
) -> Callable[[Array], Array]:
    """K of any region: the Jacobian is computed once."""
    readings = model.pattern.shape[0]
    std = jnp.ones(readings) if noise is None else jnp.asarray(_positive(noise, readings))
    strength = jnp.asarray(hyperparameter, model.dtype)
    return partial(_signal, jacobian(model, sigma, image), std.astype(model.dtype), prior, strength, image)


def _positive(noise, readings: int) -> np.ndarray:
    if np.ndim(noise) != 1:
        raise InverseError(f"noise has shape {np.shape(noise)}; give one standard deviation a reading, ({readings},) V")
    return noise_weight(noise, readings, np.ones(readings, bool)) ** -0.5


@verb
def _signal(j, std, prior: AbstractPrior, hyperparameter, image: BasisMap, region):
    j = j / std[:, None]
    problem = Problem(j, jnp.asarray(len(j), j.dtype), hyperparameter, prior, image.picture)
    precision = problem.precision()
    strength = problem.strength(precision.solve(j.T))

    def within(region):
        part = j * jnp.sqrt(region)
        return part @ precision.solve(part.T) / strength

    several = jax.lax.map(within, region.reshape(-1, image.size))
    return several.reshape(*region.shape[:-1], *several.shape[1:])


def choose_readings(
    signal: Float[Array, "readings readings"],
    count: int,
    selection: AbstractSelection | None = None,
    *,
    pattern: Int[ArrayLike, "readings 4"] | None = None,
    switch: float = 0.0,
) -> Chosen:
    """The ``count`` readings that tell the most, one by one.

    Args:
        signal: K, from `signal_covariance`.
        selection: default `DOptimal`.
        pattern: of the scan; needed with ``switch``.
        switch: what a change of the driven pair costs, in readings (settling time over reading time).  The next
            reading is then the one of most gain over its cost, and a drive once paid for is free.

    Raises:
        ProtocolError: if there are not so many readings, or (for `Volume`) not so many that differ.
    """
    readings, selection = signal.shape[0], selection or DOptimal()
    if not 0 < count <= readings:
        raise ProtocolError(f"{count} readings are asked for; this scan has {readings}: give 1 to {readings}")
    if switch and pattern is None:
        raise ProtocolError("switch is given without the pattern, which says what is driven; give pattern=")
    drive = np.zeros(readings, int) if pattern is None else drives(pattern)
    chosen = _chosen(selection, signal, jnp.asarray(drive), jnp.asarray(switch, signal.dtype), count)
    if isinstance(selection, Volume) and float(chosen.gain[-1]) <= _RANK * float(jnp.max(chosen.gain)):
        raise ProtocolError(f"the readings span a space of less than {count} dimensions; ask for fewer, or by DOptimal")
    return chosen


def drives(pattern: Int[ArrayLike, "readings 4"]) -> Int[np.ndarray, " readings"]:
    """Number of the driven pair of each row."""
    return np.unique(np.asarray(pattern)[:, :2], axis=0, return_inverse=True)[1].ravel()


@eqx.filter_jit
def _chosen(selection: AbstractSelection, signal, drive, switch, count: int) -> Chosen:
    """What is left of K is ``K - F^T F``, with a row of F for each reading taken: a Cholesky factor with pivots."""
    m, zero = len(signal), jnp.zeros((), signal.dtype)
    start = (
        jnp.diagonal(signal),
        jnp.zeros((count, m), signal.dtype),
        jnp.zeros(m, bool),
        jnp.zeros(count, int),
        jnp.zeros(count, signal.dtype),
    )

    def take(k, state):
        left, factor, taken, rows, gains = state
        gain = selection.gain(left)
        driven = jnp.zeros(m, bool).at[drive].max(taken)[drive]
        row = jnp.argmax(jnp.where(taken, -1, gain / (1 + jnp.where(driven, zero, switch))))
        pivot = selection.pivot(left[row])
        line = (signal[row] - factor[:, row] @ factor) * jnp.where(pivot > 0, pivot, jnp.inf) ** -0.5
        factor = factor.at[k].set(line)
        return left - line**2, factor, taken.at[row].set(True), rows.at[k].set(row), gains.at[k].set(gain[row])

    *_, rows, gains = jax.lax.fori_loop(0, count, take, start)
    return Chosen(rows, gains)


def shortened(protocol: Protocol, rows: Int[ArrayLike, " count"] | Bool[ArrayLike, " readings"]) -> Protocol:
    """The scan of these rows only (numbers, or flags for each), in the scan's order: no drive is taken up twice.

    Raises:
        ProtocolError: if no row is left.
    """
    rows = np.asarray(rows)
    rows = np.flatnonzero(rows) if rows.dtype == bool else np.unique(rows)
    return replace(protocol, pattern=protocol.pattern[rows])


def scan_time(protocol: Protocol, switch: float = 0.0) -> float:
    """Seconds a frame takes, scans following each other: its readings, and ``switch`` more for each change of drive."""
    drive = drives(protocol.pattern)
    changes = int(np.sum(drive != np.roll(drive, 1)))
    return (protocol.readings + switch * changes) * protocol.reading_time


def in_frame(
    values: Float[ArrayLike, "... count"], rows: Int[ArrayLike, " count"], readings: int
) -> Float[Array, "... readings"]:
    """Readings of a shortened scan at their places in a frame of the whole one, NaN elsewhere.

    Reconstructors and contact finders leave NaN out exactly, so one of either serves all scans.

    Args:
        values: V, in the order of the shortened scan.
        rows: numbers, rising.
    """
    values = jnp.asarray(values)
    frame = jnp.full((*values.shape[:-1], readings), jnp.nan, values.dtype)
    return frame.at[..., jnp.asarray(rows)].set(values)


def around(picture: Picture | BasisMap, place: Float[ArrayLike, "2"], radius: float) -> Float[Array, " basis"]:
    """A region for `signal_covariance`: ``exp(-d^2 / (2 radius^2))`` of the distance from a place, m."""
    square = jnp.sum((picture.centres - jnp.asarray(place, picture.centres.dtype)) ** 2, -1)
    return jnp.exp(-0.5 * square / radius**2)


# --- the event-driven scan -------------------------------------------------------------------------------------------


class ScanState(eqx.Module):
    """What an `EventScan` remembers from one frame to the next.

    | meaning                                     | shape   |
    |---------------------------------------------|---------|
    | since: frames since the whole scan was read | ()      |
    | pressed: pads that are in contact           | (pads,) |
    """

    since: Int[Array, ""]
    pressed: Bool[Array, " pads"]


class EventScan(eqx.Module):
    """Pressure says what to read next: few readings at rest, those around the contact while there is one.

    `step` is pure, and of fixed shapes: it runs under jit and `jax.lax.scan`.

    | meaning                                                            | shape               | unit |
    |--------------------------------------------------------------------|---------------------|------|
    | idle: read in every frame                                          | (readings,)         |      |
    | by_pad: read while the pad is pressed and nobody knows where       | (pads, readings)    |      |
    | by_place: read while a contact is nearest to this centre           | (regions, readings) |      |
    | centres                                                            | (regions, 2)        | m    |
    | pad_of: whether the region lies on the pad                         | (regions, pads)     |      |
    | onset, release: change of pressure at which a contact begins, ends | (pads,)             | Pa   |
    | every: frames from one whole scan to the next                      | ()                  |      |
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
        """Before the first frame, which is a whole scan."""
        return ScanState(self.every - 1, jnp.zeros(len(self.by_pad), bool))

    def step(
        self,
        state: ScanState,
        pressure: Float[ArrayLike, " pads"],
        places: Float[ArrayLike, "contacts 2"] | None = None,
    ) -> tuple[ScanState, Bool[Array, " readings"]]:
        """The next state, and which readings to take next.

        Args:
            pressure: change of each pad's from rest, Pa.  A pad whose pressure is not finite counts as pressed.
            places: contacts of the frame before, m, NaN where there is none; None: not known.
        """
        pressure = jnp.asarray(pressure, self.onset.dtype)
        limit = jnp.where(state.pressed, self.release, self.onset)
        pressed = ~(pressure <= limit)
        known, placed = self._around(places)
        unknown = jnp.any(self.by_pad & (pressed & ~placed)[:, None], 0)
        whole = state.since >= self.every - 1
        readings = whole | self.idle | (jnp.any(pressed) & known) | unknown
        return ScanState(jnp.where(whole, 0, state.since + 1), pressed), readings

    def _around(self, places) -> tuple[Bool[Array, " readings"], Bool[Array, " pads"]]:
        """Readings around the contacts, and the pads that these lie on."""
        if places is None:
            return jnp.zeros_like(self.idle), jnp.zeros(len(self.by_pad), bool)
        places = jnp.asarray(places, self.centres.dtype)
        there = jnp.isfinite(places).all(-1)
        square = jnp.sum((jnp.where(there[:, None], places, 0)[:, None] - self.centres) ** 2, -1)
        nearest = jnp.argmin(square, 1)
        known = jnp.any(self.by_place[nearest] & there[:, None], 0)
        return known, jnp.any(self.pad_of[nearest] & there[:, None], 0)


def prepare_event_scan(
    model: Model,
    skin: Skin,
    *,
    onset: Float[ArrayLike, "..."],
    release: Float[ArrayLike, "..."] | None = None,
    idle: int = 24,
    local: int = 80,
    every: int = 50,
    radius: float = 0.03,
    switch: float = 0.0,
    selection: AbstractSelection | None = None,
    basis: AbstractBasis | BasisMap | None = None,
    noise: Float[ArrayLike, " readings"] | None = None,
    hyperparameter: float = 0.1,
    sigma: Float[Array, " elements"] | None = None,
) -> EventScan:
    """The tables of an `EventScan` for a skin with pads, on the host.

    Args:
        onset: change of pressure at which a contact begins, (pads,) or one for all, Pa: well above the sensor's noise.
        release: at which it ends; default: half of onset.
        idle: readings of a frame at rest.
        local: readings for a pad, or for the surroundings of a contact.
        every: frames from one whole scan to the next.
        radius: of the surroundings (`around`), whose centres lie on a grid of this pitch or less, m.
        selection, switch: as for `choose_readings`.
        basis: an image of pixels; default `Pixels`, 20 along x.
        noise, hyperparameter, sigma: as for `signal_covariance`.

    Raises:
        ProtocolError: if the skin has no pads, or a value is out of range.
    """
    if not skin.pads:
        raise ProtocolError(f"the skin {skin.name!r} has no pads, whose pressure would say when to read what")
    if every < 1 or not radius > 0:
        raise ProtocolError(f"every is {every} and radius {radius}; give one frame or more, and metres above 0")
    begins, ends = _limits(onset, release, len(skin.pads))
    image = basis if isinstance(basis, BasisMap) else (basis or Pixels(20)).on(model)
    centres = _grid(skin.domain, radius)
    kinds = {
        "idle": (jnp.ones((1, image.size)), idle),
        "by_pad": (pad_masks(skin, image).weights, local),
        "by_place": (jnp.stack([around(image.picture, centre, radius) for centre in centres]), local),
    }
    expected, found = _covariances(model, Noser(), image, noise, hyperparameter, sigma), {}
    for name, (regions, count) in kinds.items():
        covariances = (expected(region.astype(model.dtype)) for region in regions)
        rows = [choose_readings(k, count, selection, pattern=model.pattern, switch=switch).rows for k in covariances]
        none = jnp.zeros((len(rows), model.pattern.shape[0]), bool)
        found[name] = none.at[jnp.arange(len(rows))[:, None], jnp.stack(rows)].set(True)
    return EventScan(
        idle=found["idle"][0],
        by_pad=found["by_pad"],
        by_place=found["by_place"],
        centres=jnp.asarray(centres, model.dtype),
        pad_of=jnp.asarray(np.stack([Polygon(pad.outline).contains(centres) for pad in skin.pads], 1)),
        onset=jnp.asarray(begins, model.dtype),
        release=jnp.asarray(ends, model.dtype),
        every=jnp.asarray(every),
    )


def _limits(onset, release, pads: int) -> tuple[np.ndarray, np.ndarray]:
    """Of every pad, Pa."""
    begins = np.broadcast_to(np.asarray(onset, float), pads)
    ends = begins / 2 if release is None else np.broadcast_to(np.asarray(release, float), pads)
    if not (np.isfinite(begins).all() and (ends > 0).all() and (begins >= ends).all()):
        raise ProtocolError(f"onset is {begins} and release {ends} Pa; give finite ones, onset no less than release")
    return begins, ends


def _grid(domain: Domain, pitch: float) -> Float[np.ndarray, "regions 2"]:
    """Centres of equal cells of ``pitch`` or less that lie on the sheet."""
    low, high = np.asarray(domain.bounds)
    cells = np.ceil((high - low) / pitch).astype(int)
    axes = [lo + (hi - lo) * (np.arange(n) + 0.5) / n for lo, hi, n in zip(low, high, cells, strict=True)]
    centres = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    return centres[domain.contains(centres)]
