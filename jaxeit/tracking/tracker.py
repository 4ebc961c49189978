"""Contacts followed from frame to frame: they are born, move, press, lift and die, and keep their numbers.

An ordinary frame is one update of the belief. A frame that is not what the contacts so far lead to expect is looked
into (`unexpected_frames`).
"""

from dataclasses import replace
from functools import cached_property, partial

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from .._compile import require_known
from ..imaging.absolute.background import UntouchedSheet, fitted_sheet
from ..imaging.inputs import InverseError, require_real
from ..imaging.untouched import untouched_frame
from ..messages.kinds import require_kind, require_unmasked
from ..model.discretisation import Model, require_model
from ..skin.description import Skin
from .belief.consider import ConsiderErrors
from .belief.contact_filter import MIN_PAD_SHARE, ContactFilter
from .belief.layer import GainField, LearnedLayer
from .belief.programs import Programs
from .belief.state import CONTACT_SIZE, LOAD_SIZE, Belief, Pads, Update
from .events import EventHypotheses
from .preparation import prepare_filter
from .settings import TrackerSettings
from .tracks import Backlog, Look, Observation, Track, Tracking
from .unexpected_frames import (
    advance_look,
    apply_update,
    begin_look,
    begin_recount,
    catch_up,
    extend_patience,
    has_converged,
    is_finite,
    is_overdue,
    needs_recount,
    queue_frame,
    remove_contacts,
)

# A frame is expected if its misfit is below this many of its standard deviations above its mean, and if the correction
# of the belief is below this squared Mahalanobis length.
MAX_MISFIT_SCORE, MAX_CORRECTION_SQUARE = 4.0, 25.0
# Largest mode of the gain, in prior standard deviations: beyond it, what contacts told of the gain was wrong.
MAX_GAIN = 4.0
# A frame that no event explains is looked into again after `Tracking.patience`, or if the misfit grows by this factor.
MISFIT_GROWTH = 1.3
# Largest misfit over the squared signal of contacts, with which contacts that moved while frames waited are kept.
MAX_MISFIT_SHARE = 0.01
# Time, s, after which a layer that forgets is aged, while nothing touches the skin: ageing takes as long as a frame.
AGEING_INTERVAL = 60.0
# Middles of nine equal parts of an edge, over its half length.
LINE_FRACTIONS = (np.arange(9) - 4) / 4.5


class Tracker:
    """Follows contacts through the frames of a skin; made by `prepare_tracker`.

    Example:
        now = tracker.start()
        for frame in frames:  # without the forces on the pads
            now = tracker.step(now, frame, seconds=0.01)
        print(len(now.tracks), now.misfit)
    """

    def __init__(
        self, tracker: ContactFilter, presses: ContactFilter, settings: TrackerSettings, area: float, field: GainField
    ):
        """`presses`: the filter of single presses, which reaches farther; `area`: of the skin, m^2."""
        self.filter, self.press_filter, self.events = tracker, presses, EventHypotheses(settings, area)
        self.area, self.field = area, field
        self._settings, self.programs = settings, Programs(tracker)

    @cached_property
    def press_programs(self) -> Programs:
        """The programs of single presses."""
        return Programs(self.press_filter)

    @property
    def settings(self) -> TrackerSettings:
        """What is known of contacts before they are followed."""
        return self._settings

    def start(self, layer: LearnedLayer | None = None) -> Tracking:
        """No contact, and the gain of the contact layer as it is known before the first frame.

        Args:
            layer: what was learned of the gain before, by `learned`; default: nothing.

        Raises:
            InverseError: if it was learned on another sheet or under other settings.
        """
        layer = LearnedLayer.unknown(self.field) if layer is None else layer
        self.field.require_same(layer.field)
        layer = replace(layer, field=self.field)  # what errors of sheet and mesh look like is known of this tracker
        return Tracking(self._initial_belief(layer), layer)

    def _initial_belief(self, layer: LearnedLayer) -> Belief:
        """The belief without contacts; its gain is that under the next press."""
        put, covariance = partial(jnp.asarray, dtype=self.filter.places.dtype), layer.before_press
        level = np.array([layer.mean[0], covariance[0, 0]])
        return Belief(put(np.zeros((0, CONTACT_SIZE))), put(layer.mean), put(covariance), put(level))

    def learned(self, now: Tracking) -> LearnedLayer:
        """What contacts have told of the gain of the contact layer up to now, to `start` with another time.

        It is the layer of the start if contacts are not to teach it (`TrackerSettings.learn`).
        """
        if not self._settings.learn or now.begun == now.taught:
            return now.layer
        found = now.layer.told(now.belief.gain, now.belief.covariance, now.begun - now.taught)
        return found if (np.abs(found.mean) <= MAX_GAIN).all() else found.restarted()

    def _learn_after_lift(self, now: Tracking) -> Tracking:
        """Learn the gain of the layer once all contacts have lifted: the next press has an effect of its own.

        A layer that is not to learn stays, and what this press bent of the gain is dropped.
        """
        if now.numbers or now.backlog is not None or now.begun == now.taught:
            return now
        layer = self.learned(now)
        return replace(now, belief=self._initial_belief(layer), layer=layer, taught=now.begun)

    def _aged(self, now: Tracking, seconds: float) -> Tracking:
        """So many seconds later, with the layer aged if nothing touches the skin: a contact begins with its gain."""
        if not self._settings.forgetting:
            return now
        unaged = now.unaged + seconds
        if unaged < AGEING_INTERVAL or now.numbers or now.backlog is not None:
            return replace(now, unaged=unaged)
        layer = now.layer.after_use(unaged, self._settings.forgetting)
        return replace(now, belief=self._initial_belief(layer), layer=layer, unaged=0.0)

    def told_by_pads(
        self, tracks: tuple[Track, ...], pad_errors: Float[ArrayLike, " pads"] | None = None
    ) -> Bool[np.ndarray, " n"]:
        """Of which contacts pads tell the force, (n,): pads whose force is known bear `MIN_PAD_SHARE` of it or more.

        The same rule is part of each step of the filter (`informative_pads`); here it is computed in NumPy, as tracks
        are any number and JAX would compile a program for each.

        Args:
            pad_errors: as for `step`; not finite for a pad that tells no force.
        """
        if pad_errors is None or not tracks:
            return np.zeros(len(tracks), bool)
        sheet, known = self.filter.sheet, np.isfinite(np.asarray(pad_errors, float))
        area, pixels = np.asarray(sheet.pad_area)[:, known].sum(1), np.asarray(sheet.pixels)
        rows = np.array([one.position + np.multiply.outer(LINE_FRACTIONS, one.half) for one in tracks])
        width = np.array([one.width for one in tracks])[:, None]
        width = np.maximum(width, np.sqrt(self.area / len(pixels)))  # narrower loads would fall between pixels
        square = ((rows[:, :, None] - pixels) ** 2).sum(-1)
        load = np.exp(-0.5 * square / width[..., None] ** 2).mean(1) / (2 * np.pi * width**2)
        return np.asarray(load @ area >= MIN_PAD_SHARE)

    def step(
        self,
        now: Tracking,
        dv: Float[ArrayLike, " readings"],
        seconds: float,
        pad_forces: Float[ArrayLike, " pads"] | None = None,
        pad_errors: Float[ArrayLike, " pads"] | None = None,
        *,
        whole: bool = True,
    ) -> Tracking:
        """The contacts after a difference frame (readings,) V; readings that are not finite are left out.

        Args:
            seconds: since the last frame.
            pad_forces: on the pads, (pads,) N; default, or NaN: not known.
            pad_errors: their standard errors, (pads,) N.
            whole: an unexpected frame is looked into at once, which may take as long as a hundred ordinary frames.
                Otherwise `look` does so, piece by piece; the contacts are those without an event until then. If `look`
                is not called often enough, contacts are given up after some seconds and begin anew.

        Raises:
            InverseError: if an array has another shape, or `seconds` is not above zero.
        """
        if not 0 < seconds < np.inf:
            raise InverseError(f"seconds is {seconds}; give the time since the last frame, above zero")
        observation = Observation(self.frame(dv), self.pads(pad_forces, pad_errors), seconds)
        now = self._aged(now, seconds)
        return self._completed(now, self._step(now, observation, whole), observation.pads)

    def press(
        self,
        dv: Float[ArrayLike, " readings"],
        pad_forces: Float[ArrayLike, " pads"] | None = None,
        pad_errors: Float[ArrayLike, " pads"] | None = None,
        *,
        layer: LearnedLayer | None = None,
    ) -> Tracking:
        """What a frame tells in which one round contact presses and nothing else, as the mean over the hold of a press.

        No other event is compared, so that this takes a tenth of the time of a `step` in which a contact begins. There
        is no contact if the update is not finite.

        Args:
            dv, pad_forces, pad_errors: as for `step`.
            layer: as for `start`.

        Raises:
            InverseError: if an array has another shape.

        Example:
            held = tracker.press(frames[0])  # V, a press on the bench
            print(held.tracks, tracker.learned(held).contacts)
        """
        now, pads = self.start(layer), self.pads(pad_forces, pad_errors)
        update = self.press_update(now.belief, self.frame(dv), pads)
        if not is_finite(update):
            return now
        found = replace(now, belief=update.belief, misfit=float(update.misfit), begun=1)
        found = bound_gain(replace(found, numbers=(1,), edges=(False,), faint=(0,)))
        return self._with_consider_errors(found, pads)

    def press_update(self, before: Belief, frame: Float[np.ndarray, " readings"], pads: Pads) -> Update:
        """The belief after a frame in which one contact presses, from a belief without contacts.

        Where the noise is far below the signal, a fit that begins between the wrong bolts may end off the sheet. So
        other places are tried until the contact explains the frame, and the most probable contact counts.
        """
        found: list[Update] = []
        for place in self.programs.matched_positions(self.programs.innovation(before, frame, pads)):
            found.append(self.press_programs.single_frame_update(self.events.with_contact(before, place), frame, pads))
            if has_converged(found[-1]) and not self.is_misfit(found[-1]):
                break
        return max(found, key=lambda update: np.nan_to_num(float(update.evidence), nan=-np.inf))

    def _step(self, now: Tracking, observation: Observation, whole: bool) -> Tracking:
        if now.backlog is not None and is_overdue(now.backlog):
            now = self._abandon_backlog(now, observation)
        elif now.backlog is not None:
            now, observation = catch_up(now, now.backlog, observation)
        if now.backlog is not None:
            predicted, update = self.programs.predict_and_update(now.belief, *observation)
            # An unexplained innovation would bend the contacts: until it is explained they are only predicted.
            after = replace(now, belief=predicted) if self.is_misfit(update) else apply_update(now, update)
            return replace(after, backlog=queue_frame(now.backlog, observation))
        after, look = self._follow(now, observation)
        if look is None:
            return after
        now = replace(look.before, backlog=Backlog(after, look))
        while whole and now.backlog is not None:
            now = self._advance_look(now, now.backlog)
        return now

    def _abandon_backlog(self, now: Tracking, observation: Observation) -> Tracking:
        """Drop the frames that wait, and contacts that have moved on meanwhile and do not explain the frame."""
        _, update = self.programs.predict_and_update(now.belief, *observation)
        signal = float(np.sum(np.square(np.asarray(update.signal_to_noise))))
        if is_finite(update) and float(update.misfit) - self.programs.size < MAX_MISFIT_SHARE * signal:
            return replace(extend_patience(now), backlog=None, since=0, misfit=float(update.misfit))
        return replace(remove_contacts(now), backlog=None)

    def look(self, now: Tracking) -> Tracking:
        """A piece more of what is left to be explained, if anything is: `Tracking.backlog`.

        A piece takes at most `frame_update.MAX_STEPS` evaluations of the measurement model, and mostly two.
        """
        backlog = now.backlog
        if backlog is None:
            return now
        last = backlog.waiting[-1] if backlog.look is None or backlog.waiting else backlog.look.observation
        return self._completed(now, self._advance_look(now, backlog), last.pads)

    def _completed(self, before: Tracking, after: Tracking, pads: Pads) -> Tracking:
        """What is known after a frame, with the gain bounded and learned, and with consider errors.

        A look ends with what was known some frames ago, and the time of the layer is that of ``before``.
        """
        after = replace(after, unaged=before.unaged)
        return self._with_consider_errors(self._learn_after_lift(bound_gain(after)), pads)

    def _with_consider_errors(self, now: Tracking, pads: Pads) -> Tracking:
        """Add errors of contacts by unknown shapes, an unknown coat and errors of the model."""
        contacts = np.asarray(now.belief.contacts)
        if not now.numbers or now.considered.is_valid_for(now.numbers, contacts):
            return now
        covariance = self.programs.consider_covariance(now.belief, pads, now.layer.unexplained)
        return replace(now, considered=ConsiderErrors(now.numbers, contacts[:, :LOAD_SIZE], covariance))

    def _advance_look(self, now: Tracking, backlog: Backlog) -> Tracking:
        before, look, waiting = backlog.before, backlog.look, backlog.waiting
        if look is not None:
            uneventful, look = look.uneventful, advance_look(look, self.programs, self.events)
            if look.uneventful is not uneventful:  # something has happened
                now = self._predict_to_now(look.uneventful, waiting)
            if look.after is not None:
                before, look = look.after, None
        else:
            (before, look), waiting = self._follow(before, waiting[0]), waiting[1:]
        return before if look is None and not waiting else replace(now, backlog=Backlog(before, look, waiting))

    def _follow(self, now: Tracking, observation: Observation) -> tuple[Tracking, Look | None]:
        """The contacts after a frame in which nothing happens, and the look into it if it is unexpected."""
        predicted, update = self.programs.predict_and_update(now.belief, *observation)
        after = apply_update(now, update)
        unexpected = self._is_unexpected(now, update)
        if not is_finite(update) or not (unexpected or needs_recount(now)):
            return replace(after, since=now.since + 1), None
        before, after = replace(now, belief=predicted), replace(after, since=0, misfit=float(update.misfit))
        if unexpected:
            return after, begin_look(before, after, observation, unconverged=not bool(update.converged))
        return after, begin_recount(before, after, observation, self.programs, self.events)

    def _predict_to_now(self, after: Tracking, waiting: tuple[Observation, ...]) -> Tracking:
        """Predict the contacts after the last event over the frames that wait."""
        seconds = sum(observation.seconds for observation in waiting)
        return replace(after, belief=self.programs.predict(after.belief, seconds)) if waiting else after

    def frame(self, dv: Float[ArrayLike, " readings"]) -> Float[np.ndarray, " readings"]:
        """A frame as the programs take it; raises InverseError if it has another shape."""
        require_real(dv=dv)
        frame, readings = np.asarray(dv, self.filter.places.dtype), self.filter.finder.readings
        if frame.shape != (readings,):
            raise InverseError(f"dv has shape {frame.shape}; give one frame of {readings} readings")
        return frame

    def pads(self, forces: Float[ArrayLike, " pads"] | None, errors: Float[ArrayLike, " pads"] | None) -> Pads:
        """Forces on pads as the programs take them; raises InverseError if an array has another shape."""
        count = self.filter.sheet.pad_area.shape[1]
        if forces is None:
            return Pads(np.zeros(count), np.full(count, np.inf))
        require_unmasked({"pad_forces": forces, "pad_errors": errors}, InverseError)
        force, error = np.asarray(forces, float), np.asarray(errors, float)
        if force.shape != (count,) or error.shape != (count,):
            raise InverseError(
                f"pad_forces and pad_errors have shapes {force.shape} and {error.shape}; give ({count},)"
            )
        known = np.isfinite(force) & np.isfinite(error)
        if not (error[known] > 0).all():
            raise InverseError("a pad has the standard error zero; give a number above zero, in newtons")
        return Pads(np.where(known, force, 0), np.where(known, error, np.inf))

    def _is_unexpected(self, now: Tracking, update: Update) -> bool:
        if float(update.correction_square) >= MAX_CORRECTION_SQUARE:
            return True
        grown = float(update.misfit) > MISFIT_GROWTH * now.misfit
        return self.is_misfit(update) and (now.since >= now.patience or grown)

    def is_misfit(self, update: Update) -> bool:
        """Whether an update leaves more of a frame than noise and the model error would."""
        size = self.programs.size
        return float(update.misfit) > size + MAX_MISFIT_SCORE * float(np.sqrt(2 * size))


def bound_gain(now: Tracking) -> Tracking:
    """Reset the gain to that before this press if a mode is beyond `MAX_GAIN`; the contacts stay."""
    gain, layer = np.asarray(now.belief.gain), now.layer
    if (np.abs(gain) <= MAX_GAIN * np.sqrt(1 + layer.press_variance)).all():
        return now
    covariance = np.array(now.belief.covariance)
    own = now.belief.contacts.size
    covariance[own:] = covariance[:, own:] = 0
    covariance[own:, own:] = layer.before_press
    return replace(now, belief=now.belief._replace(gain=jnp.asarray(layer.mean), covariance=jnp.asarray(covariance)))


def prepare_tracker(
    model: Model,
    skin: Skin,
    settings: TrackerSettings | None = None,
    *,
    noise: Float[ArrayLike, "..."],
    untouched: Float[ArrayLike, " readings"] | None = None,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
) -> Tracker:
    """Prepare to follow contacts through the frames of a skin.

    Args:
        model: of the skin; a draft suffices where the model's error is a hundredth of the signal.
        skin: whose pads tell forces.
        settings: default `TrackerSettings()`.
        noise, untouched, sigma, channels: as for `prepare_contacts`. The error of a sheet that is fitted to
            ``untouched`` is in the deviations of the learned gain; ``sigma`` counts as exact.

    Raises:
        InverseError: as for `prepare_contacts`.
    """
    settings = TrackerSettings() if settings is None else settings
    require_kind(
        settings, TrackerSettings, InverseError, "settings of a tracker", "TrackerSettings(...)", "prepare_tracker"
    )
    require_model(model)
    require_known("prepare_tracker", InverseError, model, noise, untouched, sigma, channels)
    frame = untouched_frame(model, untouched, sigma, channels)
    sheet = None if sigma is None else UntouchedSheet(sigma, np.zeros((len(sigma), 0)))
    sheet = sheet if frame is None else fitted_sheet(model, frame)
    tracker, presses, field = prepare_filter(model, skin, settings, noise, sheet, channels)
    return Tracker(tracker, presses, settings, float(np.sum(np.asarray(model.areas))), field)
