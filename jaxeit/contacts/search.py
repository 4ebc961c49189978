"""Contacts found directly: position, width and strength of a few bumps that explain a frame.

Bumps are fitted to whitened readings (`fit`), whose response to bumps comes from a table (`bump_responses`): no mesh,
no solver and no matrix with a row per element is needed when a frame comes. The number of bumps is found by adding one
after the other.
"""

from collections.abc import Callable
from functools import partial
from math import prod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from .._compile import by_platform, sequential_on_cpu, usually, verb
from ..imaging.inputs import require_frames
from ..imaging.missing import gap_of, lost_of_frame
from ..imaging.whitening import Whitening
from .bump_responses import Responses
from .fit import ContactFit, FrameResponse, UnfinishedFit, one_row_each
from .result import ContactResult, Contacts
from .starts import Atoms, lengths_of, split

# Least strength of a contact, over that of the strongest. What is weaker is a ripple of the strongest.
MIN_RELATIVE_STRENGTH = 0.1
# A further start is given up if this many more steps, each with the fall that its last step promised, would not make it
# good enough.
OUTLOOK = 16
# Frames of a batch that are searched together where a batch is not done frame by frame; each takes some 30 MB.
SIDE_BY_SIDE = 256
# Standard deviations above its mean that chi-square may have in a fit that leaves nothing to explain.
MAX_DEVIATIONS = 4


class Frame(NamedTuple):
    """A frame as it is searched.

    | meaning                                                   | shape  |
    |-----------------------------------------------------------|--------|
    | y: numbers that bumps reach                               | (r,)   |
    | beside: square of those that no bump reaches              | ()     |
    | numbers: how many there are of both                       | ()     |
    | root: mixes responses as missing readings ask for         | (r, r) |
    """

    y: Float[Array, " r"]
    beside: Float[Array, ""]
    numbers: Float[Array, ""]
    root: Float[Array, "r r"]


class Found(NamedTuple):
    """How many contacts, their fit in padded slots, and whether the only one is oblong."""

    number: Int[Array, ""]
    fit: ContactFit
    oblong: Bool[Array, ""]


# How many fits are finished, and the best of them.
Tried = tuple[Int[Array, ""] | int, ContactFit]


class ContactFinder(eqx.Module):
    """Frames to contacts, without mesh or solver; from `prepare_contacts`.

    It holds numbers alone: no mesh and no solver. The names of the fields are those in calibration files.

    | meaning                                                                   | shape        | unit  |
    |---------------------------------------------------------------------------|--------------|-------|
    | whitening: what is used of a frame                                        |              |       |
    | compress: from weighted sums to the directions that bumps reach           | (r, k)       | ohm   |
    | rest: from weighted sums to what whitened readings have beside them       | (r', k)      | ohm   |
    | responses                                                                 |              |       |
    | atoms, starts, norms, alike: see `Atoms`                                  |              |       |
    | low, high: bounds of x, y, log width, strength                            | (4,), (4,)   |       |
    | threshold: fall of chi-square that noise alone seldom makes               | ()           |       |
    | model_error: part of the signal that a bump may fail to explain           | ()           | 1     |
    | ratio: part of what a fit leaves that it must explain more than a simpler one | ()        | 1     |
    | separation: least distance of two contacts, in mean widths                | ()           | 1     |
    | root, whole: of a frame without missing readings, see `FrameResponse`     | (r, r), ()   | 1     |
    | most: contacts looked for, K                                              |              |       |

    Example:
        # a step of a program of yours; jax.jit(finder) itself has arrays that JAX cannot hash
        strongest = jax.jit(lambda dv: finder(dv).amplitude.max())
        print(strongest(dv))  # S
        several = jax.vmap(finder)(jnp.stack([dv, 2 * dv]))  # frames along a leading axis
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

        A reading that is not finite is left out of its frame exactly, as if it had never been measured
        (`imaging.missing`).

        On a CPU a batch is done frame by frame, each of which stops as soon as it can, and so is ``jax.vmap`` of a
        finder. Other devices search `SIDE_BY_SIDE` frames at a time, and ``jax.vmap`` all of them, each of which takes
        some 30 MB.
        """
        require_frames(dv, self.readings)
        return _find(self, jnp.asarray(dv, self.compress.dtype))

    @property
    def readings(self) -> int:
        """Number of readings of a frame."""
        return self.whitening.channels.shape[0]

    def bumps(self, root: Float[Array, "r r"], whole: Bool[Array, ""]) -> FrameResponse:
        """How the numbers that a frame holds depend on contacts.

        Args:
            root, whole: of the frame, as `compressed` gives them: what mixes the responses where readings are missing,
                and whether none is.
        """
        return FrameResponse(self.responses, self.low, self.high, root, whole)

    def atom_table(self, root: Float[Array, "r r"], whole: Bool[Array, ""]) -> Atoms:
        """Bumps from which contacts are started, as a frame shows them; ``root`` and ``whole`` as for `bumps`."""
        lengths = lengths_of(self.atoms, self.norms, root, whole)
        return Atoms(self.atoms, self.starts, self.norms, self.alike, lengths)

    def frame(self, dv: Float[Array, " readings"]) -> Contacts:
        """The contacts in one frame, (readings,) V; the finder itself takes any number of frames and checks them."""
        there = jnp.isfinite(dv) & self.whitening.channels
        seen, whole = self.compressed(dv)
        bumps = self.bumps(seen.root, whole)
        search = _Search(self, bumps, self.atom_table(seen.root, whole), seen.y)
        found = jax.lax.stop_gradient(search).contacts()  # derivatives: see `FrameResponse.sensitive`
        return self._contacts(bumps, seen, found, jnp.any(there))

    def compressed(self, dv: Float[Array, " readings"]) -> tuple[Frame, Bool[Array, ""]]:
        """A frame, (readings,) V, as it is searched, and whether no reading that is used is missing (NaN)."""
        channels = self.whitening.channels
        whole = jnp.all((jnp.isfinite(dv) & channels) == channels)
        seen = usually(whole, ContactFinder._complete_frame, ContactFinder._incomplete_frame, self, dv)
        return seen, whole

    def _complete_frame(self, dv: Float[Array, " readings"]) -> Frame:
        sums = self.whitening.sums(dv)
        y, beside = self.compress @ sums, self.rest @ sums
        numbers = self.compress.shape[0] + self.rest.shape[0]
        return Frame(y, beside @ beside, jnp.asarray(numbers, y.dtype), self.root)

    def _incomplete_frame(self, dv: Float[Array, " readings"]) -> Frame:
        lost = lost_of_frame(self.whitening, dv)
        seen, every = (gap_of(matrix, lost) for matrix in (self.compress, jnp.concatenate([self.compress, self.rest])))
        return Frame(seen.y, jnp.maximum(every.y @ every.y - seen.y @ seen.y, 0), every.rank, seen.root)

    def _contacts(self, bumps: FrameResponse, seen: Frame, found: Found, readable: Bool[Array, ""]) -> Contacts:
        """What was found as it is handed out, the strongest first."""
        present = jnp.arange(self.most) < found.number
        theta, covariance = bumps.sensitive(seen.y, one_row_each(found.fit.flat), present)
        misfit = (found.fit.square + seen.beside) / jnp.maximum(seen.numbers - 4 * found.number, 1)
        named, slopes = jax.vmap(self._with_amplitude)(theta), jax.vmap(jax.jacfwd(self._with_amplitude))(theta)
        own = slopes @ covariance @ slopes.swapaxes(1, 2) * jnp.maximum(misfit, 1)
        empty = jnp.where(readable, ContactResult.ABSENT, ContactResult.UNREADABLE)
        order = jnp.argsort(jnp.where(present, -theta[:, 3], jnp.inf))

        def slots(a: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
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

    def _with_amplitude(self, theta: Float[Array, "4"]) -> Float[Array, "4"]:
        """x, y, log width and amplitude in S, of one contact."""
        factor = self.responses.background * self.responses.scale**2
        return theta.at[3].set(theta[3] * factor * jnp.exp(-2 * theta[2]))

    def _result(self, found: Found) -> Int[Array, " n"]:
        theta = one_row_each(found.fit.flat)
        bound = ((theta <= self.low) | (theta >= self.high)).any(1)
        of_round = jnp.where(bound, ContactResult.AT_BOUND, ContactResult.CONVERGED)
        of_shape = jnp.where(found.oblong, ContactResult.OBLONG, of_round)
        return jnp.where(found.fit.converged, of_shape, ContactResult.NOT_CONVERGED)


class _Search(eqx.Module):
    """The search of one frame, whose numbers are y: see `prepare_contacts` for when it stops."""

    finder: ContactFinder
    bumps: FrameResponse
    atoms: Atoms
    y: Float[Array, " r"]

    def contacts(self) -> Found:
        """Contacts one by one. Empty slots hold zeros."""
        found = Found(jnp.asarray(0), self._nothing(), jnp.asarray(False))
        going = jnp.asarray(True)
        for n in range(1, self.finder.most + 1):
            fit = found.fit
            going = going & self._explains(fit.square, jnp.zeros_like(fit.square), n)
            more = jax.lax.cond(going, self._another(n), lambda fit: fit, fit)
            distinct = self._are_distinct(one_row_each(more.flat)[:n])
            going = going & self._explains(fit.square, more.square, n) & distinct
            if n == 2:
                found, going = jax.lax.cond(
                    going,
                    lambda one, two: self._two_or_oblong(one, two),  # a bound method of arrays has no hash
                    lambda one, two: (one, jnp.asarray(False)),
                    found,
                    more,
                )
            more = Found(jnp.asarray(n), more, jnp.asarray(False))
            found = jax.tree.map(lambda new, old, taken=going: jnp.where(taken, new, old), more, found)
        return found

    def _nothing(self) -> ContactFit:
        return ContactFit(jnp.zeros(4 * self.finder.most, self.y.dtype), self.y @ self.y, jnp.asarray(False))

    def _explains(self, before: Float[Array, ""], after: Float[Array, ""], n: int) -> Bool[Array, ""]:
        """Whether the fall of the square to ``after``, with n contacts, is that of a real contact."""
        finder, missing = self.finder, jnp.zeros_like(before)
        if n > 1:
            unmodelled = finder.model_error**2 * (self.y @ self.y)
            missing = jnp.maximum(unmodelled, ((n - 1) * finder.ratio) ** 2 * after)
        return before - after > finder.threshold + missing

    def _are_distinct(self, theta: Float[Array, "n 4"]) -> Bool[Array, ""]:
        """Whether contacts lie apart, and none is but a ripple of the strongest."""
        i, j = np.triu_indices(len(theta), 1)
        distance = jnp.sum((theta[i, :2] - theta[j, :2]) ** 2, 1)
        width, strength = jnp.exp(theta[:, 2]), theta[:, 3]
        apart = jnp.all(distance > (self.finder.separation * 0.5 * (width[i] + width[j])) ** 2)
        return apart & jnp.all(strength > MIN_RELATIVE_STRENGTH * jnp.max(strength))

    def _two_or_oblong(self, one: Found, two: ContactFit) -> tuple[Found, Bool[Array, ""]]:
        """Whether two contacts explain clearly more than one oblong contact; if not, what the oblong one says."""
        line = self.bumps.fit_oblong(self.y, one_row_each(two.flat)[:2])
        better = self._explains(one.fit.square, line.square, 2)
        square = jnp.exp(2 * line.flat[2]) + jnp.sum(line.flat[4:] ** 2) / 6  # the mean second moment
        flat = one.fit.flat.at[:4].set(line.flat[:4].at[2].set(0.5 * jnp.log(square)))
        oblong = Found(one.number, ContactFit(flat, line.square, line.converged), better)
        single = jax.tree.map(lambda a, b: jnp.where(better, a, b), oblong, one)
        return single, self._explains(line.square, two.square, 2)

    def _another(self, n: int) -> Callable[[ContactFit], ContactFit]:
        """The fit of n contacts, from that of n - 1."""

        def fitted(fit: ContactFit) -> ContactFit:
            theta, y = one_row_each(fit.flat)[: n - 1], self.y
            one_more = self.atoms.one_more(self.bumps, y, theta)
            if n == 1:
                return _padded(self._single(one_more), self.finder.most)
            starts = jnp.stack([one_more, split(self.bumps, y, theta)])
            tried = jax.vmap(lambda start: self.bumps.try_out(y, start))(starts)
            # A quarter of the fall that `_explains` wants: most frames with fewer contacts end their search here.
            hope = fit.square / (1 + (0.5 * (n - 1) * self.finder.ratio) ** 2)
            return _padded(self._finished(tried, hope, n), self.finder.most)

        return fitted

    def _single(self, start: Float[Array, "1 4"]) -> ContactFit:
        """The fit of one contact; where it does not end well, the better of it and of a fit from another start."""
        y, bumps = self.y, self.bumps
        first = bumps.fit(y, start)
        allowed = self._allowed()

        def again() -> ContactFit:
            begun = bumps.unstarted(y, self.atoms.other(bumps, y))
            second = bumps.finish(y, begun, jnp.minimum(allowed, first.square), jnp.asarray(OUTLOOK))
            better = second.square < first.square
            chosen: ContactFit = jax.tree.map(lambda a, b: jnp.where(better, a, b), second, first)
            return chosen

        fit: ContactFit = jax.lax.cond(first.converged & (first.square <= allowed), lambda: first, again)
        return fit

    def _allowed(self) -> Float[Array, ""]:
        """Chi-square that a fit of all contacts may leave: noise, which seldom leaves four standard deviations above
        its mean, and model error."""
        y = self.y
        noise = len(y) + MAX_DEVIATIONS * np.sqrt(2 * len(y))
        allowed: Array = noise + self.finder.model_error**2 * (y @ y)
        return allowed

    def _finished(self, tried: UnfinishedFit, hope: Float[Array, ""], n: int) -> ContactFit:
        """The better of two fits begun, finished, or the first further one that leaves no more than noise and model
        error may. Where no fit leaves so little, something else is wrong, and it is not for more contacts to explain.

        Further fits are the other of the two and, for two contacts, the one from the best pair of atoms.
        """
        y, bumps, allowed = self.y, self.bumps, self._allowed()
        better = jnp.argmin(tried.square)
        most = 2 + (n == 2)

        def unfinished(state: Tried) -> Bool[Array, ""]:
            k, fit = state
            going: Bool[Array, ""] = (k == 0) | (k < most) & (fit.square > allowed)
            return going

        def finish_next(state: Tried) -> Tried:
            k, before = state
            begun = jax.tree.map(lambda leaf: leaf[(better + k) % 2], tried)
            if n == 2:
                begun = jax.lax.cond(k < 2, lambda: begun, lambda: bumps.unstarted(y, self.atoms.pair(bumps, y)))
            first = k == 0
            fit = bumps.finish(y, begun, jnp.where(first, hope, allowed), jnp.where(first, 0, OUTLOOK))
            taken = first | (fit.square <= allowed)
            return k + 1, jax.tree.map(lambda new, old: jnp.where(taken, new, old), fit, before)

        none_yet: Tried = (0, jax.tree.map(lambda leaf: leaf[0], tried).fit)
        return jax.lax.while_loop(unfinished, finish_next, none_yet)[1]


def _padded(fit: ContactFit, most: int) -> ContactFit:
    """In as many slots as there may be contacts, so that fits of any number are alike."""
    return fit._replace(flat=jnp.pad(fit.flat, (0, 4 * most - len(fit.flat))))


_single_frame = sequential_on_cpu(lambda finder, frame: finder.frame(frame))


@verb
def _find(finder: ContactFinder, frames: Float[Array, "... readings"]) -> Contacts:
    if frames.ndim == 1:
        one: Contacts = _single_frame(finder, frames)
        return one
    batch = frames.shape[:-1]
    each_frame = frames.reshape(prod(batch), frames.shape[-1])
    each: Callable[[Array], Contacts] = partial(_single_frame, finder)
    found: Contacts = by_platform(
        each_frame,
        cpu=lambda frames: jax.lax.map(each, frames),
        default=lambda frames: jax.lax.map(each, frames, batch_size=SIDE_BY_SIDE),
    )
    found = jax.tree.map(lambda a: a.reshape(*batch, *a.shape[1:]), found)
    return found
