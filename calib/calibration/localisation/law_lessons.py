"""What contacts whose force the pads tell say of the law by which readings tell it."""

from typing import NamedTuple

import numpy as np

from jaxeit.tracking import ContactLaw, LearnedLayer, Tracker, Tracking

# Distance, m, within which a contact by its readings alone is the one that the pads tell of.
NEAR = 0.02


class _Strongest(NamedTuple):
    """Number and place (m) of a contact, its force (N) by pads, and the change of the frame (readings,) V."""

    number: int
    place: np.ndarray
    force: float
    change: np.ndarray


class LawLessons:
    """Compares contacts that are followed with the pads to what their readings alone tell; `watch` of `ContactTracks`.

    Of each contact that is alone, the frame of its largest force is looked at once more without the pads, with the gain
    of the contact layer as it was known before this contact: a later gain would know the force already.

    Args:
        layer: with which the contacts are followed from the first frame on.
        law: as it was learned before.
    """

    def __init__(self, tracker: Tracker, layer: LearnedLayer | None, law: ContactLaw | None):
        self._tracker, self._layer = tracker, layer
        self._law = ContactLaw.unknown() if law is None else law
        self._quiet: Tracking | None = None
        self._strongest: _Strongest | None = None

    def __call__(self, now: Tracking, change: np.ndarray, errors: np.ndarray) -> None:
        """Take what is known after a frame with the change (readings,) V and errors of the pads (pads,) N."""
        tracks = now.tracks
        if not tracks:
            self._learn()
            self._quiet = now
        if len(tracks) != 1 or not self._tracker.told_by_pads(tracks, errors)[0]:
            return
        one, best = tracks[0], self._strongest
        if best is not None and best.number != one.number:
            self._learn()
            best = None
        if best is None or one.force > best.force:
            self._strongest = _Strongest(one.number, np.array(one.position), one.force, np.array(change))

    def law(self) -> ContactLaw:
        """The law after all contacts so far."""
        self._learn()
        return self._law

    def _learn(self) -> None:
        best, self._strongest = self._strongest, None
        if best is None:
            return
        layer = self._layer if self._quiet is None else self._tracker.learned(self._quiet)
        # A frame by itself: an error of the model counts once.
        alone = self._tracker.step(self._tracker.start(layer), best.change, self._tracker.settings.persistence).tracks
        if len(alone) == 1 and np.linalg.norm(alone[0].position - best.place) < NEAR:
            self._law = self._law.told(alone[0], best.force)
