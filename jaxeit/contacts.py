"""Contacts found directly: position, width and strength of a few bumps that explain a frame.

Levenberg-Marquardt on whitened readings (`descent`), whose response to bumps comes from a table (`responses`): no mesh,
no solver and no matrix with a row per element is left when a frame comes.
"""

from collections.abc import Callable
from enum import IntEnum
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from .basis import Elements
from .descent import STEPS, TRIAL, Fit, begun, descend, resume, ridge, scale_of
from .discretise import Model
from .gaps import gap_of
from .jacobian import pair_jacobian
from .lapack import cho_factor, cho_solve
from .responses import Nodes, Responses, nodes_of, reached, responses_of, tabulate
from .verbs import one_by_one, verb
from .whitening import InverseError, Whitened, Whitening, require_frames, whitened_readings

_LONGEST = 0.04  # half length of an oblong contact, m
_RIPPLE = 0.1  # of the strongest contact's strength: what is less is none
_APART = 0.05  # of an atom's square that another does not explain: less are no pair to start from
_AHEAD = 16  # falls as its last step promised, without which a further start is given up
_FEW = 64  # atoms that explain most alone: one of them is in the pair that explains most
_TRIALS = 512  # noise frames that set the threshold

Number = float | Array


class ContactResult(IntEnum):
    """What became of a slot of `Contacts`."""

    CONVERGED = 0
    AT_BOUND = 1  # the width or the position ended on its bound: its covariance is a guess
    OBLONG = 2  # longer than wide: the centre is good, the width a mean over directions, the covariance a guess
    NOT_CONVERGED = 3  # do not trust it
    ABSENT = 4  # nothing more than noise and model error was left to explain
    UNREADABLE = 5  # no reading of the frame is finite


class Contacts(eqx.Module):
    """What `ContactFinder` finds in a frame; the strongest first, absent slots hold zeros.

    | meaning                                                             | shape          | unit  |
    |---------------------------------------------------------------------|----------------|-------|
    | present: whether there is a contact in the slot                     | (..., K)       |       |
    | position in the sheet's flat coordinates                            | (..., K, 2)    | m     |
    | width: standard deviation of the bump                               | (..., K)       | m     |
    | amplitude: largest change, as on a sheet of mean conductivity       | (..., K)       | S     |
    | covariance of x, y, log width, amplitude; times misfit if above one | (..., K, 4, 4) | mixed |
    | misfit: chi-square of the frame over its degrees of freedom         | (...)          |       |
    | result: a `ContactResult`                                           | (..., K)       |       |
    """

    present: Bool[Array, "... K"]
    position: Float[Array, "... K 2"]
    width: Float[Array, "... K"]
    amplitude: Float[Array, "... K"]
    covariance: Float[Array, "... K 4 4"]
    misfit: Float[Array, "..."]
    result: Int[Array, "... K"]

    @property
    def strength(self) -> Float[Array, "... K"]:
        """Integral of the bump over the plane, ``2 pi a s^2``, S m^2: what grows with the force."""
        return 2 * jnp.pi * self.amplitude * self.width**2


def strongest(contacts: Contacts) -> Float[Array, "... 2"]:
    """Position of the strongest contact, (..., 2) m; NaN where there is none (as other estimators of `metrics`)."""
    return jnp.where(contacts.present[..., :1], contacts.position[..., 0, :], jnp.nan)


class Frame(NamedTuple):
    """A frame as it is searched: numbers, square of those no bump reaches, count of both, how responses are seen."""

    y: Float[Array, " r"]
    beside: Float[Array, ""]
    numbers: Float[Array, ""]
    root: Float[Array, "r r"]


class Found(NamedTuple):
    """How many contacts, their fit in padded slots, and whether the only one is oblong."""

    number: Int[Array, ""]
    fit: Fit
    oblong: Bool[Array, ""]


def _round(flat):
    """Contacts that are bumps."""
    return flat.reshape(-1, 4)


_ALONG = np.array([-0.75, -0.25, 0.25, 0.75])


def _oblong(flat):
    """One contact along a line of half length (flat[4], flat[5]): four bumps that share its strength."""
    centre = flat[:2] + jnp.asarray(_ALONG, flat.dtype)[:, None] * flat[4:]
    rest = jnp.broadcast_to(flat[2:4] * jnp.array([1, 1 / len(_ALONG)], flat.dtype), (len(_ALONG), 2))
    return jnp.concatenate([centre, rest], 1)


class ContactFinder(eqx.Module):
    """Frames to contacts, without mesh or solver; from `prepare_contacts`.

    | meaning                                                                   | shape        | unit  |
    |---------------------------------------------------------------------------|--------------|-------|
    | whitening: what is used of a frame                                        |              |       |
    | compress: from pair sums to the directions that bumps reach               | (r, k)       |       |
    | rest: what whitened readings have beside them                             | (r', k)      |       |
    | responses                                                                 |              |       |
    | atoms: unit responses of the greedy start, and their x, y, log width      | (b, r), (b, 3) |     |
    | alike: products of the atoms                                              | (b, b)       | 1     |
    | low, high: bounds of x, y, log width, strength                            | (4,), (4,)   |       |
    | threshold: fall of chi-square that noise alone seldom makes               | ()           |       |
    | model_error: part of the signal that a bump may fail to explain           | ()           | 1     |
    | ratio: part of what a fit leaves that it must explain more than a simpler one | ()        | 1     |
    | separation: least distance of two contacts, in mean widths                | ()           | 1     |
    | root, whole: how responses are seen (`gaps`), and whether as they are     | (r, r), ()   | 1     |
    """

    whitening: Whitening
    compress: Float[Array, "r k"]
    rest: Float[Array, "q k"]
    responses: Responses
    atoms: Float[Array, "b r"]
    starts: Float[Array, "b 3"]
    norms: Float[Array, " b"]
    alike: Float[Array, "b b"]
    low: Float[Array, "4"]
    high: Float[Array, "4"]
    threshold: Float[Array, ""]
    model_error: Float[Array, ""]
    ratio: Float[Array, ""]
    separation: Float[Array, ""]
    root: Float[Array, "r r"]
    whole: Bool[Array, ""]
    most: int = eqx.field(static=True)

    def __call__(self, dv: Float[ArrayLike, "... readings"]) -> Contacts:
        """The contacts in a difference of frames, V; any leading axes are batches.

        A reading that is not finite is left out of its frame exactly, as if it had never been measured (`gaps`).

        A batch is done frame by frame, each of which stops as soon as it can. So does ``jax.vmap`` of a finder on a
        processor; elsewhere it does them side by side.
        """
        frames = jnp.asarray(dv, self.compress.dtype)
        require_frames(frames, self.readings)
        return _find(self, frames)

    @property
    def readings(self) -> int:
        """Number of readings of a frame."""
        return self.whitening.channels.shape[0]

    def frame(self, dv: Float[Array, " readings"]) -> Contacts:
        """The contacts in one frame."""
        there = jnp.isfinite(dv) & self.whitening.channels
        whole = jnp.all(there == self.whitening.channels)
        seen = jax.lax.cond(whole, lambda dv: self._as_it_is(dv), lambda dv: self._with_gaps(dv), dv)
        finder = eqx.tree_at(lambda f: (f.root, f.whole), self, (seen.root, whole))
        fixed, still = jax.lax.stop_gradient((seen.y, finder))  # see `_sensitive`
        return finder._contacts(seen, still.search(fixed), jnp.any(there))

    def _as_it_is(self, dv) -> "Frame":
        sums = self.whitening.sums(dv)
        y, beside = self.compress @ sums, self.rest @ sums
        numbers = self.compress.shape[0] + self.rest.shape[0]
        return Frame(y, beside @ beside, jnp.asarray(numbers, y.dtype), self.root)

    def _with_gaps(self, dv) -> "Frame":
        lost = self.whitening.lost(dv)
        seen, every = (gap_of(matrix, lost) for matrix in (self.compress, jnp.concatenate([self.compress, self.rest])))
        return Frame(seen.y, jnp.maximum(every.y @ every.y - seen.y @ seen.y, 0), every.rank, seen.root)

    def response(self, theta: Float[Array, "n 4"]) -> tuple[Float[Array, " r"], Float[Array, "r n 4"]]:
        """What n contacts do to the numbers that the frame holds, and its slopes."""
        value, slopes = self.responses.contacts(theta)

        def mixed(value, slopes):
            return self.root @ value, jnp.tensordot(self.root, slopes, 1)

        return jax.lax.cond(self.whole, lambda *a: a, mixed, value, slopes)

    def search(self, y: Float[Array, " r"]) -> Found:
        """Contacts one by one; see `prepare_contacts` for when to stop.  Empty slots hold zeros."""
        found = Found(jnp.asarray(0), self._none(y), jnp.asarray(False))
        going = jnp.asarray(True)
        for n in range(1, self.most + 1):
            fit = found.fit
            going = going & self._explains(y, fit.square, jnp.zeros_like(fit.square), n)
            more = jax.lax.cond(going, self._another(y, n), lambda fit: fit, fit)
            going = going & self._explains(y, fit.square, more.square, n) & self._distinct(_round(more.flat)[:n])
            if n == 2:
                found, going = jax.lax.cond(
                    going, self._two_or_oblong(y), lambda found, _: (found, jnp.asarray(False)), found, more
                )
            more = Found(jnp.asarray(n), more, jnp.asarray(False))
            found = jax.tree.map(lambda new, old, taken=going: jnp.where(taken, new, old), more, found)
        return found

    def _explains(self, y, before, after, n: int):
        """Whether the fall of the square to ``after``, with n contacts, is that of a real contact."""
        missing = jnp.maximum(self.model_error**2 * (y @ y), ((n - 1) * self.ratio) ** 2 * after) if n > 1 else 0
        return before - after > self.threshold + missing

    def _distinct(self, theta):
        """Whether contacts lie apart, and none is but a ripple of the strongest."""
        i, j = np.triu_indices(len(theta), 1)
        distance = jnp.sum((theta[i, :2] - theta[j, :2]) ** 2, 1)
        width, strength = jnp.exp(theta[:, 2]), theta[:, 3]
        apart = jnp.all(distance > (self.separation * 0.5 * (width[i] + width[j])) ** 2)
        return apart & jnp.all(strength > _RIPPLE * jnp.max(strength))

    def _two_or_oblong(self, y):
        """Whether two contacts explain clearly more than one oblong contact; if not, what that one says of one."""

        def told(one: Found, two: Fit):
            line = self.oblong(y, _round(two.flat)[:2])
            better = self._explains(y, one.fit.square, line.square, 2)
            square = jnp.exp(2 * line.flat[2]) + jnp.sum(line.flat[4:] ** 2) / 6  # the mean second moment
            flat = one.fit.flat.at[:4].set(line.flat[:4].at[2].set(0.5 * jnp.log(square)))
            oblong = Found(one.number, one.fit._replace(flat=flat, square=line.square, done=line.done), better)
            single = jax.tree.map(lambda a, b: jnp.where(better, a, b), oblong, one)
            return single, self._explains(y, line.square, two.square, 2)

        return told

    def _none(self, y) -> Fit:
        m, zero = 4 * self.most, jnp.zeros((), y.dtype)
        flat = jnp.zeros(m, y.dtype)
        return Fit(flat, y @ y, jnp.zeros((m, m), y.dtype), flat, zero, zero, jnp.asarray(0), jnp.asarray(False))

    def _another(self, y, n: int):
        """The fit of n contacts, from that of n - 1."""

        def fitted(fit: Fit) -> Fit:
            theta = _round(fit.flat)[: n - 1]
            if n == 1:
                return _padded(self.fit(y, self.added(y, theta)), self.most)
            starts = jnp.stack([self.added(y, theta), self._split(y, theta)])
            tried = jax.vmap(lambda start: self.fit(y, start, steps=TRIAL))(starts)
            # A quarter of the fall that `_explains` wants: most frames with fewer contacts end their search here.
            hope = fit.square / (1 + (0.5 * (n - 1) * self.ratio) ** 2)
            return _padded(self._finished(y, tried, hope, n), self.most)

        return fitted

    def _finished(self, y, tried: Fit, hope, n: int) -> Fit:
        """The better of two fits begun, finished, or the first further one that leaves no more than noise and model
        error may: where none does, something else is wrong, and it is not for more contacts to explain.

        That is the other, and for two contacts the one from the best pair of atoms. Noise leaves a chi-square, and
        seldom four of its standard deviations more than its mean.
        """
        better = jnp.argmin(tried.square)
        allowed = len(y) + 4 * np.sqrt(2 * len(y)) + self.model_error**2 * (y @ y)
        most = 2 + (n == 2)

        def going(state):
            k, fit = state
            return (k == 0) | (k < most) & (fit.square > allowed)

        def again(state):
            k, before = state
            fit = jax.tree.map(lambda leaf: leaf[(better + k) % 2], tried)
            if n == 2:
                fit = jax.lax.cond(k < 2, lambda: fit, lambda: self._begun(y, self._pair(y)))
            first = k == 0
            aim, steps = jnp.where(first, hope, allowed), jnp.where(first, STEPS, STEPS + TRIAL)
            fit = self._resumed(y, fit, aim, steps, jnp.where(first, 0, _AHEAD))
            taken = first | (fit.square <= allowed)
            return k + 1, jax.tree.map(lambda new, old: jnp.where(taken, new, old), fit, before)

        begin = jax.tree.map(lambda leaf: leaf[0], tried)
        return jax.lax.while_loop(going, again, (0, begin))[1]

    def added(self, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> Float[Array, "m 4"]:
        """One contact more: the atom that explains most of what is left."""
        gain = self.atoms @ self._seen(y - self.response(theta)[0] if len(theta) else y)
        best = jnp.argmax(gain)
        strength = jnp.maximum(gain[best], 0) / self.norms[best]
        return jnp.concatenate([theta, jnp.append(self.starts[best], strength)[None]])

    def _seen(self, response):
        return jax.lax.cond(self.whole, lambda r: r, lambda r: self.root @ r, response)

    def _pair(self, y):
        """Two contacts: the atoms that explain most together.

        Two of one strength may look most like one between them, from which neither is found.
        """
        gain = self.atoms @ self._seen(y)

        def explained(alike, one):
            """By an atom of gain ``one`` together with each of all, where both have a strength above zero."""
            first, second, rest = one - alike * gain, gain - alike * one, 1 - alike**2
            fine = (rest > _APART) & (first > 0) & (second > 0)
            return jnp.where(fine, one * first + gain * second, 0) / jnp.maximum(rest, _APART)

        few = jax.lax.top_k(gain, min(_FEW, len(gain)))[1]
        j = jnp.argmax(jnp.max(jax.vmap(explained)(self.alike[few], gain[few]), 0))
        pair = jnp.stack([jnp.argmax(explained(self.alike[j], gain[j])), j])
        alike = self.alike[pair[0], j]
        strength = (gain[pair] - alike * gain[pair[::-1]]) / jnp.maximum(1 - alike**2, _APART) / self.norms[pair]
        return jnp.concatenate([self.starts[pair], jnp.maximum(strength, 0)[:, None]], 1)

    def _split(self, y, theta):
        """One contact more: the strongest in two, along the best of four directions."""
        first = jnp.argmax(theta[:, 3])
        angle = jnp.arange(4, dtype=y.dtype) * (jnp.pi / 4)
        shift = jnp.exp(theta[first, 2]) * jnp.stack([jnp.cos(angle), jnp.sin(angle)], 1)

        def halves(along):
            half = theta[first] * jnp.array([1, 1, 1, 0.5], y.dtype) + jnp.array([0, 0, np.log(0.75), 0], y.dtype)
            step = jnp.append(along, jnp.zeros(2, y.dtype))
            split = jnp.concatenate([theta.at[first].set(half + step), (half - step)[None]])
            return jnp.clip(split, self.low, self.high)

        tried = jax.vmap(halves)(shift)
        squares = jax.vmap(lambda t: jnp.sum((y - self.response(t)[0]) ** 2))(tried)
        return tried[jnp.argmin(squares)]

    def fit(self, y: Float[Array, " r"], theta: Float[Array, "n 4"], steps: int = STEPS) -> Fit:
        """The best n contacts near these."""
        return self._resumed(y, self._begun(y, theta), steps=steps)

    def _begun(self, y, theta) -> Fit:
        return begun(self._linear(_round), y, theta.ravel())

    def _resumed(self, y, fit: Fit, hope: Number = np.inf, steps: Number = STEPS, ahead: Number = 0) -> Fit:
        low, high = (jnp.tile(bound, len(fit.flat) // 4) for bound in (self.low, self.high))
        return resume(self._linear(_round), y, fit, low, high, hope, steps, ahead)

    def oblong(self, y: Float[Array, " r"], pair: Float[Array, "2 4"]) -> Fit:
        """The best oblong contact in the place of two."""
        share = pair[:, 3] / jnp.maximum(pair[:, 3].sum(), jnp.finfo(y.dtype).tiny)
        half = jnp.sqrt(3 * share[0] * share[1]) * (pair[1, :2] - pair[0, :2])  # the same second moment
        low, high = (
            jnp.append(bound, jnp.full(2, sign * _LONGEST)) for bound, sign in ((self.low, -1), (self.high, 1))
        )
        start = jnp.concatenate([share @ pair[:, :3], pair[:, 3].sum()[None], half])
        return descend(self._linear(_oblong), y, jnp.clip(start, low, high).astype(y.dtype), low, high)

    def _linear(self, shape):
        """Readings and their slopes, from the parameters of a shape."""

        def linear(flat):
            theta = shape(flat)
            value, slopes = self.response(theta)
            return value, slopes.reshape(len(value), -1) @ jax.jacfwd(shape)(flat).reshape(theta.size, -1)

        return linear

    def _contacts(self, seen: Frame, found: Found, readable) -> Contacts:
        """What was found as it is handed out, the strongest first."""
        present = jnp.arange(self.most) < found.number
        theta, covariance = self._sensitive(seen.y, _round(found.fit.flat), present)
        misfit = (found.fit.square + seen.beside) / jnp.maximum(seen.numbers - 4 * found.number, 1)
        named, slopes = jax.vmap(self._named)(theta), jax.vmap(jax.jacfwd(self._named))(theta)
        own = slopes @ covariance @ slopes.swapaxes(1, 2) * jnp.maximum(misfit, 1)
        empty = jnp.where(readable, ContactResult.ABSENT, ContactResult.UNREADABLE)
        order = jnp.argsort(jnp.where(present, -theta[:, 3], jnp.inf))

        def slots(a):
            return jnp.where(present.reshape(-1, *[1] * (a.ndim - 1)), a[order], 0)

        return Contacts(
            present=present,
            position=slots(named[:, :2]),
            width=slots(jnp.exp(named[:, 2])),
            amplitude=slots(named[:, 3]),
            covariance=slots(own),
            misfit=misfit,
            result=jnp.where(present, self._result(found)[order], empty),
        )

    def _named(self, theta):
        """x, y, log width and amplitude in S, of one contact."""
        factor = self.responses.background * self.responses.scale**2
        return theta.at[3].set(theta[3] * factor * jnp.exp(-2 * theta[2]))

    def _sensitive(self, y, theta, present):
        """Contacts that know how they hang on y, and their covariances.

        A Gauss-Newton step from where the search ended has next to no value, but the right derivative.
        """
        value, slopes = self.response(theta)
        j = jnp.where(present[:, None], slopes, 0).reshape(len(y), -1)
        scale = scale_of(jnp.sum(j**2, 0))
        used = jnp.repeat(present, 4)
        normal = (j.T @ j) * scale[:, None] * scale + jnp.diag(jnp.where(used, ridge(y), 1))
        factor = cho_factor(normal)
        step = (scale * cho_solve(factor, scale * (j.T @ (y - value)))).reshape(theta.shape)
        covariance = scale[:, None] * cho_solve(factor, jnp.diag(scale))
        slot = np.arange(self.most)
        own = covariance.reshape(self.most, 4, self.most, 4)[slot, :, slot]
        return theta + (step - jax.lax.stop_gradient(step)), own

    def _result(self, found: Found):
        theta = _round(found.fit.flat)
        bound = ((theta <= self.low) | (theta >= self.high)).any(1)
        round_ = jnp.where(bound, ContactResult.AT_BOUND, ContactResult.CONVERGED)
        shape = jnp.where(found.oblong, ContactResult.OBLONG, round_)
        return jnp.where(found.fit.done, shape, ContactResult.NOT_CONVERGED)


_alone = one_by_one(lambda finder, frame: finder.frame(frame))


@verb
def _find(finder: ContactFinder, frames: Float[Array, "... readings"]) -> Contacts:
    if frames.ndim == 1:
        return _alone(finder, frames)
    found = jax.lax.map(lambda frame: _alone(finder, frame), frames.reshape(-1, frames.shape[-1]))
    return jax.tree.map(lambda a: a.reshape(*frames.shape[:-1], *a.shape[1:]), found)


def _padded(fit: Fit, most: int) -> Fit:
    """In as many slots as there may be contacts, so that fits of any number are alike."""
    more = 4 * most - len(fit.flat)
    flat, downhill = jnp.pad(fit.flat, (0, more)), jnp.pad(fit.downhill, (0, more))
    return fit._replace(flat=flat, downhill=downhill, normal=jnp.pad(fit.normal, (0, more)))


def prepare_contacts(
    model: Model,
    *,
    noise: Float[ArrayLike, "..."],
    most: int = 3,
    widths: tuple[float, float] = (0.005, 0.03),
    columns: int = 41,
    false_alarm: float = 0.01,
    model_error: float = 0.015,
    ratio: float = 0.8,
    separation: float = 1.2,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
) -> ContactFinder:
    """Everything that does not depend on the frame, done once.

    Contacts are added one by one, each number fitted anew by Levenberg-Marquardt from two starts (the bump that
    explains most of what is left; the strongest contact in two halves), two where both end badly from a third (the two
    bumps that explain most together), for as long as

    - chi-square falls by more than noise alone makes it fall in a part ``false_alarm`` of blank frames.  The largest
      fall over all places and widths follows ``P(fall > z^2) = 1 - exp(-N (z^2 - 1) exp(-z^2 / 2))``, the Euler
      characteristic of a Gaussian field in three dimensions (Adler 1981), with N from simulated noise;
    - and, from the second on, by more than ``(model_error |y|)^2`` and than ``ratio^2`` times what is left (for the
      third ``(2 ratio)^2``, and so on): no real contact is exactly a Gaussian on a sheet exactly known, and what that
      costs must not become a contact;
    - and two explain as much more than one oblong contact, a row of four bumps, does (an edge is not two contacts);
    - and all contacts are further apart than ``separation`` times their mean width, and none is below a tenth of the
      strongest.

    Args:
        noise: standard deviation of each reading, (readings,) V, or their covariance, (readings, readings) V^2.
        most: contacts looked for, K.
        widths: smallest and largest standard deviation of a contact, m.
        columns: nodes of the table along x, from rim to rim; a pitch above the smallest width loses accuracy there.
        false_alarm: as above.
        model_error: as above.
        ratio: as above.
        separation: as above.
        sigma: conductivity to linearise at, (elements,) S, best from `fit_background`, without which the error of place
            is more than twice as large on an uneven coat; default: the untouched sheet.
        channels: readings to use; a dead one is left out, never taken for zero.

    Raises:
        InverseError: if a value is out of range or no channel is left.
    """
    _check(most, widths, columns, false_alarm, model_error, ratio, separation)
    found = whitened_readings(model, noise, channels)
    nodes = nodes_of(model, widths, columns)
    slopes, background = _slopes(model, found, sigma)
    seen, beside = reached(tabulate(model, slopes, nodes.fewer(3)))
    values = tabulate(model, seen.T @ slopes, nodes)
    put = partial(jnp.asarray, dtype=model.dtype)
    finder = ContactFinder(
        whitening=found.whitening,
        compress=put(seen.T @ found.compress),
        rest=put(beside.T @ found.compress),
        responses=responses_of(values, nodes, background, model.dtype),
        **{name: put(array) for name, array in _atoms(model, values, nodes).items()},
        **{name: put(bound) for name, bound in bounds_of(nodes.axes[1], nodes.axes[0], widths).items()},
        threshold=put(0),
        model_error=put(model_error),
        ratio=put(ratio),
        separation=put(separation),
        root=put(np.eye(seen.shape[1])),
        whole=jnp.asarray(True),
        most=most,
    )
    return eqx.tree_at(lambda f: f.threshold, finder, put(_threshold(finder, false_alarm)))


def _slopes(model: Model, found: Whitened, sigma) -> tuple[np.ndarray, float]:
    """Whitened readings per relative change of the elements' conductivity, and its mean, S."""
    slopes = pair_jacobian(model, sigma, Elements().on(model), jnp.asarray(found.electrodes))
    at = np.asarray(model.background if sigma is None else sigma, float)
    return found.factor @ (np.asarray(slopes, float) * at), mean_of(model, at)


def mean_of(model: Model, sigma: np.ndarray) -> float:
    """The mean conductivity of the sheet, S."""
    return float(np.average(sigma, weights=np.asarray(model.areas, float)))


def bounds_of(x, y, widths) -> dict[str, list[float]]:
    """Of x, y, log width and strength."""
    low, high = ([np.min(x), np.min(y), np.log(widths[0]), 0], [np.max(x), np.max(y), np.log(widths[1]), np.inf])
    return {"low": low, "high": high}


def _check(most, widths, columns, false_alarm, model_error, ratio, separation):
    for name, value, fine, wanted in (
        ("most", most, most >= 1, "one or more"),
        ("widths", widths, 0 < widths[0] < widths[1] < np.inf, "smallest and largest, m"),
        ("columns", columns, 5 <= columns <= 500, "5 to 500"),
        ("false_alarm", false_alarm, 0 < false_alarm < 0.5, "above 0 and below 0.5"),
        ("model_error", model_error, 0 <= model_error < 1, "0 or more, below 1"),
        ("ratio", ratio, 0 <= ratio < np.inf, "0 or more"),
        ("separation", separation, 0 <= separation < np.inf, "0 or more"),
    ):
        if not fine:
            raise InverseError(f"{name} is {value}; give {wanted}")


def _atoms(model: Model, values: np.ndarray, nodes: Nodes) -> dict[str, np.ndarray]:
    """Unit responses of narrow, middling and wide bumps on the sheet, their norms, and x, y, log width of each."""
    y, x, log_width = nodes.axes
    chosen = []
    for part in (0.35, 0.6, 0.85):
        level = round(part * (len(log_width) - 1))
        stride = max(1, round(1.3 * np.exp(log_width[level]) / (x[1] - x[0])))
        i, j = np.meshgrid(np.arange(stride // 2, len(y), stride), np.arange(stride // 2, len(x), stride))
        chosen.append(np.stack([i.ravel(), j.ravel(), np.full(i.size, level)], 1))
    i, j, level = np.concatenate(chosen).T
    responses, starts = values[i, j, level], np.stack([x[j], y[i], log_width[level]], 1)
    norms = np.linalg.norm(responses, axis=1)
    kept = (norms > 1e-3 * norms.max()) & _on_sheet(model, starts[:, :2])
    atoms = responses[kept] / norms[kept, None]
    return {"atoms": atoms, "norms": norms[kept], "starts": starts[kept], "alike": atoms @ atoms.T}


def _on_sheet(model: Model, places: np.ndarray) -> np.ndarray:
    """Whether each place lies in a triangle."""
    corners = np.asarray(model.chart, float)[np.asarray(model.triangles)]
    inside = np.zeros(len(places), bool)
    slack = 1e-9 * np.ptp(corners)
    a, b = corners[:, [1, 2, 0]] - corners, corners
    for k, place in enumerate(places):
        side = a[..., 0] * (place[1] - b[..., 1]) - a[..., 1] * (place[0] - b[..., 0])
        inside[k] = (side >= -slack * np.ptp(corners)).all(1).any()
    return inside


def _threshold(finder: ContactFinder, false_alarm: float) -> float:
    """The fall of chi-square that noise alone exceeds in a part ``false_alarm`` of frames; see `prepare_contacts`."""
    noise = jnp.asarray(np.random.default_rng(0).standard_normal((_TRIALS, finder.compress.shape[0])))
    falls = np.sort(np.asarray(_falls(finder, noise.astype(finder.compress.dtype)), float))
    tenth = max(falls[int(0.9 * _TRIALS)], 3.0)
    number = -np.log(0.9) / _field(tenth)
    return _root(lambda z: number * _field(z) + np.log1p(-false_alarm), 2.5, 400)


def _root(falling: Callable[[float], float], low: float, high: float) -> float:
    """Where a function above zero at ``low`` and below at ``high`` vanishes (scipy.optimize takes 0.1 s to import)."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if falling(middle) > 0 else (low, middle)
    return low


def _field(square: float) -> float:
    return (square - 1) * np.exp(-0.5 * square)


@verb
def _falls(finder: ContactFinder, y: Float[Array, "n r"]) -> Float[Array, " n"]:
    start = jnp.zeros((0, 4), y.dtype)
    return jax.lax.map(lambda one: one @ one - finder.fit(one, finder.added(one, start)).square, y)
