"""Contacts followed from frame to frame: they are born, move, press, lift and die, and keep their numbers.

An ordinary frame is one update of the belief. A frame that is not what the contacts so far lead to expect is looked
into (`looks`).
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from .._compile import require_known
from ..imaging.background import sheet_of
from ..imaging.noise import InverseError
from ..model.discretisation import Model
from ..skin.description import Skin
from .events import Events
from .filter import SIZE, Belief, ContactFilter, Pads, Update
from .looks import PATIENCE, begun, is_over, looked, meanwhile, settled
from .preparation import prepare_filter
from .programs import Programs
from .settings import TrackerSettings
from .tracks import Seen, Tracking

# A frame is expected if what is left of it is below this many of its standard deviations above its mean, and no number
# of the belief changes by much more than it may.
UNEXPECTED, SURPRISING = 4.0, 25.0
# A frame that no event explains is asked about again where it has become so much worse, or after some frames.
WORSE = 1.3
# Events that one frame may show, and those that are found before the contacts are shown again.
EVENTS, NEXT = 4, 1


class Tracker:
    """Follows contacts through the frames of a skin; made by `prepare_tracker`. ::

    now = tracker.start()
    for frame, forces in ...:
        now = tracker.step(now, frame, seconds=0.01, pad_forces=forces, pad_errors=errors)
        print(now.tracks)
    """

    def __init__(self, tracker: ContactFilter, settings: TrackerSettings, area: float):
        self.filter, self.events = tracker, Events(settings, area)
        self._settings, self._programs = settings, Programs(tracker)

    @property
    def settings(self) -> TrackerSettings:
        """What is known of contacts before they are followed."""
        return self._settings

    def start(self) -> Tracking:
        """No contact, and the gain as it is known before the first frame."""
        size = len(self.filter.places)
        dtype = self.filter.places.dtype
        return Tracking(Belief(jnp.zeros((0, SIZE), dtype), jnp.zeros(size, dtype), jnp.eye(size, dtype=dtype)))

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
                Otherwise `look` does so, piece by piece, for one event at a time.

        Raises:
            InverseError: if an array has another shape, or `seconds` is not above zero.
        """
        if not 0 < seconds < np.inf:
            raise InverseError(f"seconds is {seconds}; give the time since the last frame, above zero")
        seen = Seen(self._frame(dv), self._pads(pad_forces, pad_errors), seconds)
        moved, update = self._programs.followed(now.belief, *seen)
        after = settled(now, update)
        if now.look is not None:
            return replace(after, since=now.since + 1, look=meanwhile(now.look, seen))
        if not self._is_unexpected(now, update):
            return replace(after, since=now.since + 1)
        look = begun(replace(now, belief=moved), seen, EVENTS if whole else NEXT)
        after = replace(after, since=0, misfit=float(update.misfit), look=look)
        while whole and after.look is not None:
            after = self.look(after)
        return after

    def look(self, now: Tracking) -> Tracking:
        """A piece more of a look into an unexpected frame, if there is one: `Tracking.look`.

        A piece is at most `filter.STEPS` evaluations of what contacts show, as an ordinary frame, and mostly two.
        """
        if now.look is None:
            return now
        look = looked(now.look, self._programs, self.events)
        if not is_over(look):
            return replace(now, look=look)
        return look.after if look.happened and look.after is not None else replace(now, look=None)

    def _frame(self, dv: Float[ArrayLike, " readings"]) -> Float[np.ndarray, " readings"]:
        frame, readings = np.asarray(dv, self.filter.places.dtype), self.filter.finder.readings
        if frame.shape != (readings,):
            raise InverseError(f"dv has shape {frame.shape}; give one frame of {readings} readings")
        return frame

    def _pads(self, forces: Float[ArrayLike, " pads"] | None, errors: Float[ArrayLike, " pads"] | None) -> Pads:
        count = self.filter.sheet.pad_area.shape[1]
        if forces is None:
            return Pads(jnp.zeros(count), jnp.full(count, jnp.inf, float))  # as those that are known: no weak type
        force, error = np.asarray(forces, float), np.asarray(errors, float)
        if force.shape != (count,) or error.shape != (count,):
            raise InverseError(
                f"pad_forces and pad_errors have shapes {force.shape} and {error.shape}; give ({count},)"
            )
        known = np.isfinite(force) & np.isfinite(error)
        if not (error[known] > 0).all():
            raise InverseError("a pad has the standard error zero; give a number above zero, in newtons")
        return Pads(jnp.asarray(np.where(known, force, 0)), jnp.asarray(np.where(known, error, np.inf)))

    def _is_unexpected(self, now: Tracking, update: Update) -> bool:
        size, misfit, surprise = len(self.filter.compress), float(update.misfit), float(update.surprise)
        if surprise >= SURPRISING:
            return True
        unexpected = misfit > size + UNEXPECTED * np.sqrt(2 * size)
        return bool(unexpected and (now.since >= PATIENCE or misfit > WORSE * now.misfit))


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
        noise, untouched, sigma, channels: as for `prepare_contacts`.

    Raises:
        InverseError: as for `prepare_contacts`.
    """
    require_known("prepare_tracker", InverseError, model, noise, untouched, sigma, channels)
    settings = settings or TrackerSettings()
    sheet = sheet_of(model, untouched, sigma, channels)
    tracker = prepare_filter(model, skin, settings, noise, sheet, channels)
    return Tracker(tracker, settings, float(np.sum(np.asarray(model.areas))))
