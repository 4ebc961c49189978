"""What contacts whose force the pads tell say of the law by which readings tell it."""

import numpy as np

from jaxeit.tracking import ContactLaw, LearnedLayer, Track, Tracker, Tracking

# Distance, m, within which a contact by its readings alone is the one that the pads tell of.
NEAR = 0.02


def updated_law(
    law: ContactLaw, tracker: Tracker, told: Track, change: np.ndarray, layer: LearnedLayer | None
) -> ContactLaw:
    """The law after a contact that the pads tell of, which is looked at once more by its readings alone.

    A frame by itself: an error of the model counts once.

    Args:
        told: the contact by readings and pads.
        change: of the frame, (readings,) V.
        layer: gain of the contact layer as it was known before this contact; a later gain would know the force already.
    """
    alone = tracker.press(change, layer=layer).tracks
    if not alone or np.linalg.norm(alone[0].position - told.position) >= NEAR:
        return law
    return law.told(alone[0], told.force)


class ContactLawLearner:
    """Compares contacts that are followed with the pads to what their readings alone tell; `watch` of `ContactTracks`.

    Of each contact that is alone, the frame of its largest force is asked (`updated_law`).

    Args:
        layer: with which the contacts are followed from the first frame on.
        law: as it was learned before.
    """

    def __init__(self, tracker: Tracker, layer: LearnedLayer | None, law: ContactLaw | None):
        self._tracker, self._layer = tracker, layer
        self._law = ContactLaw.unknown() if law is None else law
        self._quiet: Tracking | None = None
        self._strongest: tuple[Track, np.ndarray] | None = None

    def __call__(self, now: Tracking, change: np.ndarray, errors: np.ndarray) -> None:
        """Take what is known after a frame with the change (readings,) V and errors of the pads (pads,) N."""
        tracks = now.tracks
        if not tracks:
            self._learn()
            self._quiet = now
        if len(tracks) != 1 or not self._tracker.told_by_pads(tracks, errors)[0]:
            return
        if self._strongest is not None and self._strongest[0].number != tracks[0].number:
            self._learn()
        if self._strongest is None or tracks[0].force > self._strongest[0].force:
            self._strongest = tracks[0], np.array(change)

    def law(self) -> ContactLaw:
        """The law after all contacts so far."""
        self._learn()
        return self._law

    def _learn(self) -> None:
        if self._strongest is None:
            return
        layer = self._layer if self._quiet is None else self._tracker.learned(self._quiet)
        self._law = updated_law(self._law, self._tracker, *self._strongest, layer)
        self._strongest = None
