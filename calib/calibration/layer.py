"""The gain of the contact layer, learned from the contacts of a session and kept in the calibration."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

import jaxeit as je
from jaxeit.tracking import ContactLaw, LearnedLayer, Tracker

from ..check.acceptance import accept
from ..presses.table import PressMeasurements, Processing, measure, resting_levels
from ..session import Session, SessionError
from .application.force_maps import USED_PARTS
from .application.frame_blocks import FrameBlocks, Progress, estimated
from .calibration import Calibration
from .fitted_sessions import is_calibrated_from
from .localisation.contact_tracks import (
    ContactTracks,
    NotFollowed,
    prepare_calibrated_tracker,
    quiet_tracker,
)
from .localisation.learned.law_lessons import ContactLawLearner, updated_law
from .localisation.learned.probes import pad_errors, probe_presses

# Share of what was learned before that each new session forgets: skins age between sessions, and errors of the model
# that last for a session are in no covariance.
FORGETTING_FACTOR = 0.1

LESS_PROBABLE = (
    "the presses of the calibration are less probable with what was learned of the contact layer than without"
)


class _Learned(NamedTuple):
    """What contacts told of the contact layer, and the tracker that was told."""

    tracker: Tracker
    layer: LearnedLayer
    law: ContactLaw


def learn_layer(
    calibration: Calibration,
    session: Session,
    *,
    processing: Processing | None = None,
    ignore_errors: bool = False,
    progress: Progress = iter,
) -> Calibration:
    """The calibration with what the contacts of a session tell of the contact layer: its gain, and the contacts' law.

    Where the session tells its presses and the force of a load cell, the mean over the hold of each press is one
    contact, told by its readings and the forces on the pads. Otherwise contacts are followed through the session as
    `apply` follows them. Each is also told by its readings alone: how that force differs from the pads' is the law
    (`jaxeit.tracking.ContactLaw`). What was learned before is the start, less `FORGETTING_FACTOR` of it. `apply` and
    `live` then follow contacts with the result.

    Args:
        processing: how the session is cut and corrected; default: as the sessions of the calibration.
        ignore_errors: learn also from a session in which `check_session` finds an error.

    Raises:
        SessionError: if the session was recorded on another skin, lacks a stream, holds no contact, or no frame
            without contact, which would tell the noise; or if the presses that the calibration kept are less probable
            with what was learned.
        RecordingError: if `check_session` finds an error in its skin, frames or pressures.

    Example:
        with calib.open_session("session.h5") as session:
            # by which calib.apply(..., track=True) and live follow contacts
            wiser = calibration.learn_layer(mine, session)
        print(wiser.layer.contacts, "contacts learned from")
    """
    processing = processing or calibration.processing
    levels = resting_levels(session, calibration.skin, processing)
    accept([session], calibration.skin, ignore_errors=ignore_errors, where=USED_PARTS)
    before = None if calibration.layer is None else calibration.layer.aged(FORGETTING_FACTOR)
    law = ContactLaw.unknown() if calibration.contact_law is None else calibration.contact_law.aged(FORGETTING_FACTOR)
    try:
        if _tells_presses(session):
            learned = _from_presses(calibration, measure(session, calibration.skin, processing), before, law, progress)
        else:
            learned = _from_use(calibration, FrameBlocks(session, processing, levels), before, law, progress)
    except NotFollowed as error:
        raise SessionError(f"{session.name}: {error}; record a second without contact") from None
    if learned.layer.contacts == (0 if before is None else before.contacts):
        raise SessionError(f"{session.name}: nothing touched the skin; press it in many places")
    if not _is_better(calibration, learned, before):
        raise SessionError(f"{session.name}: {LESS_PROBABLE}; {_advice(calibration, session)}")
    return replace(calibration, layer=learned.layer, contact_law=learned.law)


def _tells_presses(session: Session) -> bool:
    return session.presses is not None and len(session.presses) > 0 and "force" in session.streams


def _from_presses(
    calibration: Calibration,
    found: PressMeasurements,
    layer: LearnedLayer | None,
    law: ContactLaw,
    progress: Progress,
) -> _Learned:
    """What presses tell one by one, each by the means over its hold."""
    force, error, _ = calibration.pad_forces(found.pressure, calibration.locate(found.dv, single=True))
    errors = pad_errors(force, error)
    tracker = prepare_calibrated_tracker(
        calibration, found.untouched, np.where(found.channels, found.noise_of_means, 0.0)
    )
    for dv, forces, own in progress(zip(found.dv, force, errors, strict=True)):
        now = tracker.press(dv, forces, own, layer=layer)
        if tracker.told_by_pads(now.tracks, own).any():
            law = updated_law(law, tracker, now.tracks[0], dv, layer)
        layer = tracker.learned(now)
    assert layer is not None  # no measurements without a press
    return _Learned(tracker, layer, law)


def _from_use(
    calibration: Calibration, blocks: FrameBlocks, layer: LearnedLayer | None, law: ContactLaw, progress: Progress
) -> _Learned:
    """What contacts tell that are followed through all frames."""
    tracker = quiet_tracker(calibration, blocks)
    lessons = ContactLawLearner(tracker, layer, law)
    tracks = ContactTracks(tracker, smooth=False, layer=layer, watch=lessons)
    for block, found in estimated(calibration, progress(blocks)):
        tracks.add(block.time, block.change, found.force, found.standard_error)
    return _Learned(tracker, tracks.learned(), lessons.law())


def _is_better(calibration: Calibration, learned: _Learned, before: LearnedLayer | None) -> bool:
    """Whether presses of the calibration are more probable with what was learned; true if it kept none."""
    presses = probe_presses(calibration)
    if presses is None:
        return True
    with_it, without = (
        je.tracking.press_evidence(learned.tracker, *presses, layer).sum() for layer in (learned.layer, before)
    )
    return bool(with_it > without)


def _advice(calibration: Calibration, session: Session) -> str:
    """What to do where presses are less probable with what was learned than without."""
    advice = "press it in more places, or leave the layer as it is (no --learn-layer)"
    return advice if is_calibrated_from(calibration.provenance, session) else f"calibrate again, {advice}"


def render_layer(layer: LearnedLayer, image: je.imaging.AbstractReconstructor) -> str:
    """What is known of the contact layer, in one line; of the pixels of an image."""
    mean, deviation = layer.at(np.asarray(image.centres, float)[np.asarray(image.areas) > 0])
    known = np.median(deviation) / np.median(LearnedLayer.unknown(layer.field).at(np.asarray(image.centres, float))[1])
    return (
        f"contact layer: gain {np.exp(mean).min():.2f} to {np.exp(mean).max():.2f}, learned from {layer.contacts} "
        f"contacts{_under_depth(layer)}; its uncertainty is {100 * known:.0f} % of that before any contact (median "
        "over the sheet)"
    )


def _under_depth(layer: LearnedLayer) -> str:
    return f", whose loads spread as at a depth of {1e3 * layer.field.depth:.1f} mm" if layer.field.depth else ""
