"""Applying a calibration to a session: the force map of every frame, in a file."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

import jaxeit as je
from jaxeit.messages.kinds import listed

from ...check.acceptance import accept
from ...check.placement import placement_note
from ...presses.table import Processing, resting_levels
from ...session import ArchiveWriter, Session
from ...session.argument_checks import require_session
from ..argument_checks import require_calibration, require_no_eit_choices
from ..calibration import Calibration
from ..localisation.contact_tracks import TRACK_ARRAYS, ContactTracks, NotFollowed, quiet_tracker
from ..localisation.load_windows import SeenLoads, WindowedFrames, fit_windows
from ..localisation.proposals import ProposalChoice, chosen_proposal
from ..logs.calibration import LogCalibration
from ..logs.procedure import apply_log
from ..recalibration.agreement import agreement_of_use
from .force_maps import USED_PARTS, ForceEstimate
from .frame_blocks import FrameBlock, FrameBlocks, Progress, estimated
from .places_in_space import normals_in_space, pad_centres, points_in_space

FORCE_MAP_FORMAT = "skin-forcemap"
TRACKS = "tracks/"  # group of the arrays of contacts that were followed
LOADS = "loads/"  # group of the arrays of loads in windows

_Coordinate = tuple[np.ndarray, str, str, tuple[str, ...]]  # values, unit, meaning, names of the axes


def apply(
    calibration: Calibration | LogCalibration,
    session: Session,
    path: str | Path,
    *,
    processing: Processing | None = None,
    ignore_errors: bool = False,
    progress: Progress = iter,
    loads: float | None = None,
    proposal: ProposalChoice = je.contacts.shipped_proposal,
    load_settings: je.contacts.LoadSettings | None = None,
    track: bool | je.tracking.TrackerSettings = False,
    tell: Callable[[str], object] = lambda line: None,
) -> Path:
    """Write the force map of every EIT frame of a session; memory does not grow with its length.

    By the calibration of a log, write its forces over time, as `calib.calibration.apply_log` does, which returns them.

    The file, format skin-forcemap, appears only when complete. Where the pads disagree with the image, intervals are
    wider by as much. What lies outside of what was calibrated is told, and stands in the file's attribute "outside";
    warnings of `check_session` about the skin, frames and pressures in "warnings".

    Args:
        processing: how the session is corrected; default: as the sessions of the calibration.
        ignore_errors: apply also to a session in whose skin, frames or pressures `check_session` finds an error; the
            file then names the errors.
        loads: also tell what touches the skin, none, one, two, an edge or more, in windows of so many s; None: do not.
        proposal: of loads, trained for this skin by ``jaxeit train``, where their fits begin; default: the one that is
            shipped for the skin, and a search where there is none; None: a search.
        load_settings: what is known of loads before a frame; default: the usual. With others, fits begin by a search
            unless a proposal is given, since the shipped ones were trained on the usual loads.
        track: also follow contacts from frame to frame, each with a number, smoothed over time; by the usual settings
            or by these.
        tell: called with a line about loads, about contacts, about each warning and each thing outside of what was
            calibrated.

    Raises:
        SessionError: if the session was recorded on another skin, lacks a stream, or holds no frame.
        InverseError: if the proposal was trained for another skin.
        RecordingError: if `check_session` finds an error in its skin, frames or pressures.
    """
    require_session(session, "apply")
    if isinstance(calibration, LogCalibration):
        require_no_eit_choices("apply", processing=processing, loads=loads, load_settings=load_settings, track=track)
        apply_log(calibration, session, path, ignore_errors=ignore_errors, tell=tell)
        return Path(path)
    require_calibration(calibration, "apply")
    processing = processing or calibration.processing
    proposed = None if loads is None else chosen_proposal(proposal, calibration.skin, tell, load_settings)
    levels = resting_levels(session, calibration.skin, processing)
    found = accept([session], calibration.skin, ignore_errors=ignore_errors, where=USED_PARTS)
    blocks = FrameBlocks(session, processing, levels)
    calibration, outside = _agreement(calibration, session, blocks)
    attrs = _attributes(calibration, session) | {
        "ignored_errors": "\n".join(found.ignored),
        "warnings": "\n".join(found.warnings),
        "outside": "\n".join(outside),
    }
    if loads is not None and load_settings is not None:
        attrs["load_settings"] = load_settings.changed()
    for line in (*found.warnings, *outside):
        tell(f"note: {line}")
    coordinates, kinds = _coordinates(calibration), _rows(calibration, session.epoch)
    with ArchiveWriter(path, FORCE_MAP_FORMAT, {name: value for name, value in attrs.items() if value != ""}) as writer:
        _begin_rows(writer, *coordinates, kinds)
        also: list[_Loads | _Tracks] = []
        if loads is not None:
            fit = partial(fit_windows, calibration, progress=progress, proposal=proposed, settings=load_settings)
            also += [_Loads(calibration, writer, loads, fit)]
        usual = track if isinstance(track, je.tracking.TrackerSettings) else None
        also += [_Tracks(calibration, writer, blocks, usual, tell)] if track else []
        for block, estimate in estimated(calibration, progress(blocks)):
            _append(writer, _of_block(block.time, estimate, calibration.pads.multiple), kinds)
            for one in also:
                one.add(block, estimate)
        for one in also:
            tell(one.end())
    return Path(path)


def _agreement(calibration: Calibration, session: Session, blocks: FrameBlocks) -> tuple[Calibration, tuple[str, ...]]:
    """The calibration, with wider intervals where pads and image disagree; and what lies outside of it, in words."""
    calibration, outside = agreement_of_use(calibration, session)
    doubt = placement_note(calibration.skin, blocks.untouched(), np.asarray(calibration.recon.channels))
    return calibration, (*outside, doubt) if doubt else outside


def _begin_rows(
    writer: ArchiveWriter,
    sizes: Mapping[str, int],
    coordinates: Mapping[str, _Coordinate],
    kinds: Mapping[str, tuple[tuple[str, ...], str, str, str]],
) -> None:
    """Write all coordinates but time, and begin the arrays with a row for each frame."""
    for name, about in coordinates.items():
        writer.add(name, *about)
    for name, (dims, units, meaning, dtype) in kinds.items():
        writer.add_rows(name, tuple(sizes[dim] for dim in dims), units, meaning, dtype, ("time", *dims))


def _attributes(calibration: Calibration, session: Session) -> dict[str, str | int]:
    """What a force map file says of its origin."""
    recon = calibration.recon
    return {
        "skin": calibration.skin.name,
        "session": session.name,
        "session_sha256": session.hash,
        "simulated": int(session.simulated or calibration.simulated),
        "time_epoch_utc": session.epoch,
        "image_rows": recon.shape[0],
        "image_columns": recon.shape[1],
        "calibration_created_utc": calibration.provenance["created_utc"],
        "coordinates": "x y",
    }


def _coordinates(calibration: Calibration) -> tuple[dict[str, int], dict[str, _Coordinate]]:
    """Lengths of all axes but time, with their coordinates, and where the pixels lie."""
    pads, centres, areas = calibration.skin.pads, *map(np.asarray, (calibration.recon.centres, calibration.recon.areas))
    contacts = 0 if calibration.locator is None else calibration.locator.contacts
    about = {
        "pixel": (len(centres), "number of the pixel, row by row"),
        "pad": (len(pads), "number of the pad: " + listed(f"{i} {pad.name}" for i, pad in enumerate(pads))),
        "axis": (2, "0: x, 1: y"),
        "space": (3, "0: x, 1: y, 2: z"),
        "contact": (contacts, "number of the contact in its frame"),
    }
    sizes = {name: size for name, (size, _) in about.items()}
    numbers = {n: (np.arange(size, dtype="i4"), "1", text, (n,)) for n, (size, text) in about.items() if size}
    pixels = {
        "centres": (centres, "m", "centres of the pixels", ("pixel", "axis")),
        "x": (centres[:, 0], "m", "centres of the pixels along x", ("pixel",)),
        "y": (centres[:, 1], "m", "centres of the pixels along y", ("pixel",)),
        "areas": (areas, "m2", "areas of the pixels", ("pixel",)),
    }
    return sizes, numbers | pixels | _places(calibration.skin, centres, areas > 0)


def _places(skin: je.Skin, centres: np.ndarray, covered: np.ndarray) -> dict[str, _Coordinate]:
    """Where the skin lies in space, for programs that do not know its surface."""
    surface, pads = skin.surface, pad_centres(skin)
    places = points_in_space(surface, centres, covered)
    meaning = "centres of the pixels in space; NaN: off the sheet"
    out: dict[str, _Coordinate] = {"points": (places, "m", meaning, ("pixel", "space"))}
    if not len(pads):
        return out
    meaning, normals = "normals of the sheet there, away from its inside", normals_in_space(surface, pads)
    return out | {
        "pad_names": (np.array([pad.name for pad in skin.pads]), "1", "names of the pads", ("pad",)),
        "pad_points": (points_in_space(surface, pads), "m", "centres of the pads in space", ("pad", "space")),
        "pad_normals": (normals, "1", meaning, ("pad", "space")),
    }


def _append(writer: ArchiveWriter, rows: Mapping[str, np.ndarray], names: Iterable[str], group: str = "") -> None:
    for name in names:
        writer.append(group + name, rows[name])


class _Loads:
    """Loads in windows of so many seconds, beside the force maps."""

    def __init__(
        self,
        calibration: Calibration,
        writer: ArchiveWriter,
        seconds: float,
        fit: Callable[[WindowedFrames], SeenLoads],
    ):
        self._calibration, self._writer, self._fit = calibration, writer, fit
        self._windows = WindowedFrames(seconds, calibration.recon.readings)

    def add(self, block: FrameBlock, found: ForceEstimate) -> None:
        loaded = block.loaded(self._calibration)
        self._windows.add(block.time, block.frames, block.change, loaded, found.force.sum(1), found.force)

    def end(self) -> str:
        """Write the loads; returns what they are in one line."""
        self._windows.close()
        seen = self._fit(self._windows)
        for name, about in seen.arrays.items():
            self._writer.add(LOADS + name, *about)
        return seen.render()


class _Tracks:
    """Contacts followed from frame to frame, beside the force maps. The untouched frames are read first."""

    def __init__(
        self,
        calibration: Calibration,
        writer: ArchiveWriter,
        blocks: FrameBlocks,
        settings: je.tracking.TrackerSettings | None,
        tell: Callable[[str], object],
    ):
        self._writer, self._why = writer, ""
        self._tracks: ContactTracks | None = None
        try:
            tracker = quiet_tracker(calibration, blocks, settings, tell)
            self._tracks = ContactTracks(tracker, layer=calibration.layer, law=calibration.contact_law)
        except NotFollowed as error:
            self._why = f"contacts: none followed: {error}"
            return
        depth = np.asarray(tracker.field.depth)
        writer.add(TRACKS + "depth", depth, "m", "of the sheet, by which loads were taken to spread; 0: Gaussian loads")
        for name, about in TRACK_ARRAYS.items():
            writer.add_rows(TRACKS + name, *about)

    def add(self, block: FrameBlock, found: ForceEstimate) -> None:
        if self._tracks is not None:
            rows = self._tracks.add(block.time, block.change, found.force, found.standard_error)
            _append(self._writer, rows, TRACK_ARRAYS, TRACKS)

    def end(self) -> str:
        """Write the rows that are left; returns how many contacts there were in one line."""
        if self._tracks is None:
            return self._why
        _append(self._writer, self._tracks.end(), TRACK_ARRAYS, TRACKS)
        return self._tracks.render()


def _rows(calibration: Calibration, epoch: str) -> dict[str, tuple[tuple[str, ...], str, str, str]]:
    """Arrays of a force map file with one row per frame: axes of a row, unit, meaning and type."""
    pixels, pads = ("pixel",), ("pad",)
    rows: dict[str, tuple[tuple[str, ...], str, str, str]] = {
        "time": ((), f"nanoseconds since {epoch}", "time of the frame", "i8"),
        "force": (pixels, "N", "force on each pixel", "f4"),
        "force_se": (pixels, "N", "standard error of a pixel's force, for the shape as it is", "f4"),
        "pad_force": (pads, "N", "force on each pad", "f8"),
        "pad_force_se": (pads, "N", "standard error of a pad's force", "f8"),
        "pad_force_half": (pads, "N", "half the interval that 90 % of readings of a pad's force fall into", "f8"),
        "total_force": ((), "N", "sum of the forces on the pads", "f8"),
        "total_force_half": ((), "N", "half the 90 % interval of a reading of the sum", "f8"),
        "pad_valid": (pads, "1", "pressure in the calibrated range", "u1"),
        "shape_valid": (pads, "1", "1: shape from the image; 0: even", "u1"),
    }
    if calibration.locator is None:
        return rows
    return rows | {
        "contact_position": (("contact", "axis"), "m", "of each contact found; NaN: none", "f8"),
        "contact_force": (("contact",), "N", "its shares of the forces on pads that it lies on", "f8"),
    }


def _of_block(time: np.ndarray, found: ForceEstimate, multiple: float) -> dict[str, np.ndarray]:
    """Rows under the names of `_rows`; half the 90 % interval is a multiple of the standard error."""
    parts = {
        "time": time,
        "force": found.map.force,
        "force_se": found.map.standard_error,
        "pad_force": found.force,
        "pad_force_se": found.standard_error,
        "pad_force_half": multiple * found.standard_error,
        "total_force": found.force.sum(1),
        "total_force_half": multiple * found.total_error,
        "pad_valid": found.valid,
        "shape_valid": found.map.valid,
        "contact_position": found.position,
        "contact_force": found.contact_force,
    }
    return {name: np.asarray(part) for name, part in parts.items()}
