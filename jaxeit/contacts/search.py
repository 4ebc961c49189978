"""Search of contacts in a frame by forward selection: position, width and strength of a few bumps.

Bumps are fitted to whitened readings (`fit`), whose response to bumps comes from a table (`bump_responses`): a frame
needs no mesh, no solver and no matrix with a row per element. Contacts are added one by one while the fall of
chi-square is significant.
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
from ..imaging.readings.missing import gap_of, missing_information
from ..imaging.readings.whitening import Whitening
from .bump_responses import Responses
from .fit import ContactFit, FitState, FrameResponse, contact_rows
from .result import ContactResult, Contacts
from .starts import Atoms, observed_lengths, split_strongest

MIN_RELATIVE_STRENGTH = 0.1
"""Least strength of a contact, over that of the strongest. A weaker one is a ripple of the strongest."""
# Horizon of extrapolation, in steps: a further fit is given up if so many more falls, each as its last step promised,
# would not make it good enough.
FALL_HORIZON = 16
# Number of frames that are searched together where a batch is not searched frame by frame; each takes some 30 MB.
BATCH_SIZE = 256
# Largest chi-square of a good fit, in standard deviations above its mean.
MAX_DEVIATIONS = 4


class WhitenedFrame(NamedTuple):
    """Whitened readings of a frame.

    | meaning                                                   | shape  |
    |-----------------------------------------------------------|--------|
    | y: in the signal subspace, which bumps reach              | (r,)   |
    | complement_square: sum of squares in its complement       | ()     |
    | dimension: of both together                               | ()     |
    | root: whitens responses if readings are missing           | (r, r) |
    """

    y: Float[Array, " r"]
    complement_square: Float[Array, ""]
    dimension: Float[Array, ""]
    root: Float[Array, "r r"]


class Selection(NamedTuple):
    """Number of contacts selected, their fit in padded slots, and whether the only one is oblong."""

    number: Int[Array, ""]
    fit: ContactFit
    oblong: Bool[Array, ""]


# State of the loop over fits of one number of contacts: number of fits finished, and the best of them.
LoopState = tuple[Int[Array, ""] | int, ContactFit]


class ContactFinder(eqx.Module):
    """Frames to contacts, without mesh or solver; from `prepare_contacts`.

    It holds arrays alone. The names of the fields are those in calibration files.

    | meaning                                                                   | shape        | unit  |
    |---------------------------------------------------------------------------|--------------|-------|
    | whitening: of the readings that are used                                  |              |       |
    | compress: from weighted sums to the signal subspace, which bumps reach    | (r, k)       | ohm   |
    | rest: from weighted sums to its complement                                | (r', k)      | ohm   |
    | responses                                                                 |              |       |
    | atoms, starts, norms: see `Atoms`; alike: its Gram matrix                 |              |       |
    | low, high: bounds of x, y, log width, strength                            | (4,), (4,)   |       |
    | threshold: least significant fall of chi-square                           | ()           |       |
    | model_error: part of the signal that a bump may fail to explain           | ()           | 1     |
    | ratio: fall of the residual over the residual, that a further contact needs | ()         | 1     |
    | separation: least distance of two contacts, in mean widths                | ()           | 1     |
    | root, whole: of a frame without missing readings, see `FrameResponse`     | (r, r), ()   | 1     |
    | most: contacts looked for, K                                              |              |       |

    Example:
        # a step of a program of yours; jax.jit(finder) itself has arrays that JAX cannot hash, which
        # equinox.filter_jit(finder) takes
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
        finder. Other devices search `BATCH_SIZE` frames at a time, and ``jax.vmap`` all of them, each of which takes
        some 30 MB.
        """
        require_frames(dv, self.readings)
        return _find(self, jnp.asarray(dv, self.compress.dtype))

    @property
    def readings(self) -> int:
        """Number of readings of a frame."""
        return self.whitening.channels.shape[0]

    def bumps(self, root: Float[Array, "r r"], whole: Bool[Array, ""]) -> FrameResponse:
        """Forward model of the signal in a frame.

        Args:
            root, whole: of the frame, as `compressed` returns them: what whitens the responses if readings are missing,
                and whether none is.
        """
        return FrameResponse(self.responses, self.low, self.high, root, whole)

    def atom_table(self, root: Float[Array, "r r"], whole: Bool[Array, ""]) -> Atoms:
        """Dictionary of the starts of fits in a frame; ``root`` and ``whole`` as for `bumps`."""
        lengths = observed_lengths(self.atoms, self.norms, root, whole)
        return Atoms(self.atoms, self.starts, self.norms, self.alike, lengths)

    def frame(self, dv: Float[Array, " readings"]) -> Contacts:
        """The contacts in one frame, (readings,) V; the finder itself takes any number of frames and checks them."""
        finite = jnp.isfinite(dv) & self.whitening.channels
        frame, whole = self.compressed(dv)
        bumps = self.bumps(frame.root, whole)
        search = _ForwardSelection(self, bumps, self.atom_table(frame.root, whole), frame.y)
        found = jax.lax.stop_gradient(search).select()  # derivatives: see `FrameResponse.linearise`
        return self._contacts(bumps, frame, found, jnp.any(finite))

    def compressed(self, dv: Float[Array, " readings"]) -> tuple[WhitenedFrame, Bool[Array, ""]]:
        """Whiten a frame, (readings,) V; and whether no reading that is used is missing (NaN)."""
        channels = self.whitening.channels
        whole = jnp.all((jnp.isfinite(dv) & channels) == channels)
        frame = usually(whole, ContactFinder._complete_frame, ContactFinder._incomplete_frame, self, dv)
        return frame, whole

    def _complete_frame(self, dv: Float[Array, " readings"]) -> WhitenedFrame:
        sums = self.whitening.sums(dv)
        y, complement = self.compress @ sums, self.rest @ sums
        dimension = self.compress.shape[0] + self.rest.shape[0]
        return WhitenedFrame(y, complement @ complement, jnp.asarray(dimension, y.dtype), self.root)

    def _incomplete_frame(self, dv: Float[Array, " readings"]) -> WhitenedFrame:
        lost = missing_information(self.whitening, dv)
        total = jnp.concatenate([self.compress, self.rest])
        signal, both = (gap_of(matrix, lost) for matrix in (self.compress, total))
        return WhitenedFrame(signal.y, jnp.maximum(both.y @ both.y - signal.y @ signal.y, 0), both.rank, signal.root)

    def _contacts(
        self, bumps: FrameResponse, frame: WhitenedFrame, found: Selection, readable: Bool[Array, ""]
    ) -> Contacts:
        """The selected contacts as results, the strongest first."""
        present = jnp.arange(self.most) < found.number
        theta, covariance = bumps.linearise(frame.y, contact_rows(found.fit.flat), present)
        misfit = (found.fit.square + frame.complement_square) / jnp.maximum(frame.dimension - 4 * found.number, 1)
        parameters, slopes = jax.vmap(self._with_amplitude)(theta), jax.vmap(jax.jacfwd(self._with_amplitude))(theta)
        covariance = slopes @ covariance @ slopes.swapaxes(1, 2) * jnp.maximum(misfit, 1)
        empty = jnp.where(readable, ContactResult.ABSENT, ContactResult.UNREADABLE)
        order = jnp.argsort(jnp.where(present, -theta[:, 3], jnp.inf))

        def slots(a: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
            return jnp.where(present.reshape(-1, *[1] * (a.ndim - 1)), a[order], 0)

        return Contacts(
            present=present,
            position=slots(parameters[:, :2]),
            width=slots(jnp.exp(parameters[:, 2])),
            amplitude=slots(parameters[:, 3]),
            covariance=slots(covariance),
            misfit=misfit,
            result=jnp.where(present, self._result(found)[order], empty),
        )

    def _with_amplitude(self, theta: Float[Array, "4"]) -> Float[Array, "4"]:
        """x, y, log width and amplitude in S, of one contact."""
        factor = self.responses.background * self.responses.scale**2
        return theta.at[3].set(theta[3] * factor * jnp.exp(-2 * theta[2]))

    def _result(self, found: Selection) -> Int[Array, " n"]:
        theta = contact_rows(found.fit.flat)
        at_bound = ((theta <= self.low) | (theta >= self.high)).any(1)
        converged = jnp.where(at_bound, ContactResult.AT_BOUND, ContactResult.CONVERGED)
        shape = jnp.where(found.oblong, ContactResult.OBLONG, converged)
        return jnp.where(found.fit.converged, shape, ContactResult.NOT_CONVERGED)


class _ForwardSelection(eqx.Module):
    """Forward selection of contacts in one frame of whitened readings y; `prepare_contacts` has its stopping rules."""

    finder: ContactFinder
    bumps: FrameResponse
    atoms: Atoms
    y: Float[Array, " r"]

    def select(self) -> Selection:
        """Add contacts one by one. Empty slots hold zeros."""
        found = Selection(jnp.asarray(0), self._null_fit(), jnp.asarray(False))
        active = jnp.asarray(True)
        for n in range(1, self.finder.most + 1):
            fit = found.fit
            active = active & self._is_significant(fit.square, jnp.zeros_like(fit.square), n)
            larger = jax.lax.cond(active, self._forward_step(n), lambda fit: fit, fit)
            distinct = self._are_distinct(contact_rows(larger.flat)[:n])
            active = active & self._is_significant(fit.square, larger.square, n) & distinct
            if n == 2:
                found, active = jax.lax.cond(
                    active,
                    lambda one, two: self._compare_with_oblong(one, two),  # a bound method of arrays has no hash
                    lambda one, two: (one, jnp.asarray(False)),
                    found,
                    larger,
                )
            candidate = Selection(jnp.asarray(n), larger, jnp.asarray(False))
            found = jax.tree.map(lambda new, old, accepted=active: jnp.where(accepted, new, old), candidate, found)
        return found

    def _null_fit(self) -> ContactFit:
        """The fit of no contact."""
        return ContactFit(jnp.zeros(4 * self.finder.most, self.y.dtype), self.y @ self.y, jnp.asarray(False))

    def _is_significant(self, before: Float[Array, ""], after: Float[Array, ""], n: int) -> Bool[Array, ""]:
        """Whether the fall of the square to ``after``, with n contacts, is above that by noise and model error."""
        finder, model_fall = self.finder, jnp.zeros_like(before)
        if n > 1:
            model_square = finder.model_error**2 * (self.y @ self.y)
            model_fall = jnp.maximum(model_square, ((n - 1) * finder.ratio) ** 2 * after)
        return before - after > finder.threshold + model_fall

    def _are_distinct(self, theta: Float[Array, "n 4"]) -> Bool[Array, ""]:
        """Whether contacts are separate, and none is a ripple of the strongest."""
        i, j = np.triu_indices(len(theta), 1)
        distance = jnp.sum((theta[i, :2] - theta[j, :2]) ** 2, 1)
        width, strength = jnp.exp(theta[:, 2]), theta[:, 3]
        separate = jnp.all(distance > (self.finder.separation * 0.5 * (width[i] + width[j])) ** 2)
        return separate & jnp.all(strength > MIN_RELATIVE_STRENGTH * jnp.max(strength))

    def _compare_with_oblong(self, one: Selection, two: ContactFit) -> tuple[Selection, Bool[Array, ""]]:
        """The better of one round and one oblong contact, and whether two contacts are significant against it."""
        line = self.bumps.fit_oblong(self.y, contact_rows(two.flat)[:2])
        is_oblong = self._is_significant(one.fit.square, line.square, 2)
        square = jnp.exp(2 * line.flat[2]) + jnp.sum(line.flat[4:] ** 2) / 6  # the mean second moment
        flat = one.fit.flat.at[:4].set(line.flat[:4].at[2].set(0.5 * jnp.log(square)))
        oblong = Selection(one.number, ContactFit(flat, line.square, line.converged), is_oblong)
        single = jax.tree.map(lambda a, b: jnp.where(is_oblong, a, b), oblong, one)
        return single, self._is_significant(line.square, two.square, 2)

    def _forward_step(self, n: int) -> Callable[[ContactFit], ContactFit]:
        """The step from a fit of n - 1 contacts to one of n."""

        def step(fit: ContactFit) -> ContactFit:
            theta, y = contact_rows(fit.flat)[: n - 1], self.y
            start = self.atoms.add_best(self.bumps, y, theta)
            if n == 1:
                return _pad(self._fit_single(start), self.finder.most)
            starts = jnp.stack([start, split_strongest(self.bumps, y, theta)])
            trials = jax.vmap(lambda start: self.bumps.trial_fit(y, start))(starts)
            # A quarter of the fall that `_is_significant` needs: most frames with fewer contacts end their search here.
            aim = fit.square / (1 + (0.5 * (n - 1) * self.finder.ratio) ** 2)
            return _pad(self._best_fit(trials, aim, n), self.finder.most)

        return step

    def _fit_single(self, start: Float[Array, "1 4"]) -> ContactFit:
        """The fit of one contact; where it is poor, the better of it and of a fit from an alternative start."""
        y, bumps = self.y, self.bumps
        first = bumps.fit(y, start)
        max_square = self._max_square()

        def restart() -> ContactFit:
            initial = bumps.init(y, self.atoms.alternative(bumps, y))
            second = bumps.finish(y, initial, jnp.minimum(max_square, first.square), jnp.asarray(FALL_HORIZON))
            better = second.square < first.square
            best: ContactFit = jax.tree.map(lambda a, b: jnp.where(better, a, b), second, first)
            return best

        fit: ContactFit = jax.lax.cond(first.converged & (first.square <= max_square), lambda: first, restart)
        return fit

    def _max_square(self) -> Float[Array, ""]:
        """Largest chi-square of a good fit: of noise, `MAX_DEVIATIONS` above its mean, and of model error."""
        y = self.y
        noise = len(y) + MAX_DEVIATIONS * np.sqrt(2 * len(y))
        largest: Array = noise + self.finder.model_error**2 * (y @ y)
        return largest

    def _best_fit(self, trials: FitState, aim: Float[Array, ""], n: int) -> ContactFit:
        """Finish the better of two trial fits, and further ones until a fit is good (`_max_square`).

        Further fits are the other trial and, for two contacts, the one from the best pair of atoms. Where none is good,
        the first one is returned: the frame has another fault, which more contacts must not explain.
        """
        y, bumps, max_square = self.y, self.bumps, self._max_square()
        better = jnp.argmin(trials.square)
        max_fits = 2 + (n == 2)

        def is_unfinished(state: LoopState) -> Bool[Array, ""]:
            k, fit = state
            unfinished: Bool[Array, ""] = (k == 0) | (k < max_fits) & (fit.square > max_square)
            return unfinished

        def finish_next(state: LoopState) -> LoopState:
            k, before = state
            iterate = jax.tree.map(lambda leaf: leaf[(better + k) % 2], trials)
            if n == 2:
                iterate = jax.lax.cond(k < 2, lambda: iterate, lambda: bumps.init(y, self.atoms.pair(bumps, y)))
            first = k == 0
            fit = bumps.finish(y, iterate, jnp.where(first, aim, max_square), jnp.where(first, 0, FALL_HORIZON))
            accepted = first | (fit.square <= max_square)
            return k + 1, jax.tree.map(lambda new, old: jnp.where(accepted, new, old), fit, before)

        initial: LoopState = (0, jax.tree.map(lambda leaf: leaf[0], trials).fit)
        return jax.lax.while_loop(is_unfinished, finish_next, initial)[1]


def _pad(fit: ContactFit, most: int) -> ContactFit:
    """Pad a fit to the slots of all contacts, so that fits of any number have one shape."""
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
        default=lambda frames: jax.lax.map(each, frames, batch_size=BATCH_SIZE),
    )
    found = jax.tree.map(lambda a: a.reshape(*batch, *a.shape[1:]), found)
    return found
