"""The gain of the contact layer, learned from the contacts of a session and kept in the calibration."""

from dataclasses import replace

import numpy as np

import jaxeit as je
from jaxeit.tracking import LearnedLayer, Tracker

from ..check.acceptance import accept
from ..presses.table import Processing, resting_levels
from ..session import Session, SessionError
from .calibration import Calibration
from .fitted_sessions import is_calibrated_from
from .force_maps import USED
from .frame_blocks import FrameBlocks, Progress, estimated
from .localisation.contact_tracks import ContactTracks, NotFollowed, probe_presses, quiet_tracker
from .localisation.law_lessons import LawLessons

# Share of what was learned before that each new session forgets: skins age between sessions, and errors of the model
# that last for a session are in no covariance.
FORGOTTEN = 0.1


def learn_layer(
    calibration: Calibration,
    session: Session,
    *,
    processing: Processing | None = None,
    ignore_errors: bool = False,
    progress: Progress = iter,
) -> Calibration:
    """The calibration with what the contacts of a session tell of the contact layer: its gain, and the contacts' law.

    Contacts are followed through the session as `apply` follows them, with the forces on the pads as data. Each is also
    told by its readings alone: how that force differs from the pads' is the law (`jaxeit.tracking.ContactLaw`). What
    was learned before is the start, less `FORGOTTEN` of it. `apply` and `live` then follow contacts with the result.

    Args:
        processing: how the session is corrected; default: as the sessions of the calibration.
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
    accept([session], calibration.skin, ignore_errors=ignore_errors, where=USED)
    blocks = FrameBlocks(session, processing, levels)
    before = None if calibration.layer is None else calibration.layer.aged(FORGOTTEN)
    law = None if calibration.contact_law is None else calibration.contact_law.aged(FORGOTTEN)
    try:
        tracker = quiet_tracker(calibration, blocks)
    except NotFollowed as error:
        raise SessionError(f"{session.name}: {error}; record a second without contact") from None
    lessons = LawLessons(tracker, before, law)
    tracks = ContactTracks(tracker, smooth=False, layer=before, watch=lessons)
    for block, found in estimated(calibration, progress(blocks)):
        tracks.add(block.time, block.change, found.force, found.standard_error)
    learned = tracks.learned()
    if learned.contacts == (0 if before is None else before.contacts):
        raise SessionError(f"{session.name}: nothing touched the skin; press it in many places")
    if not _is_better(calibration, tracker, learned, before):
        what = (
            "the presses of the calibration are less probable with what was learned of the contact layer than without"
        )
        advice = "press it in more places, or leave the layer as it is (no --learn-layer)"
        if not is_calibrated_from(calibration.provenance, session):
            advice = f"calibrate again, {advice}"
        raise SessionError(f"{session.name}: {what}; {advice}")
    return replace(calibration, layer=learned, contact_law=lessons.law())


def _is_better(calibration: Calibration, tracker: Tracker, learned: LearnedLayer, before: LearnedLayer | None) -> bool:
    """Whether presses of the calibration are more probable with what was learned; true if it kept none."""
    presses = probe_presses(calibration)
    if presses is None:
        return True
    with_it, without = (je.tracking.press_evidence(tracker, *presses, layer).sum() for layer in (learned, before))
    return bool(with_it > without)


def render_layer(layer: LearnedLayer, image: je.imaging.AbstractReconstructor) -> str:
    """What is known of the contact layer, in one line; of the pixels of an image."""
    mean, deviation = layer.at(np.asarray(image.centres, float)[np.asarray(image.areas) > 0])
    known = np.median(deviation) / np.median(LearnedLayer.unknown(layer.field).at(np.asarray(image.centres, float))[1])
    return (
        f"contact layer: gain {np.exp(mean).min():.2f} to {np.exp(mean).max():.2f}, learned from {layer.contacts} "
        f"contacts; its uncertainty is {100 * known:.0f} % of that before any contact (median over the sheet)"
    )
