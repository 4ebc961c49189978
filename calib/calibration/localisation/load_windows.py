"""Loads over time: what touches the skin in short windows of a session, by `jaxeit.contacts.prepare_loads`.

Frames are averaged over windows during which a pad is loaded. The untouched sheet is that of the session's own frames
without contact, and the noise is theirs, so that the fit knows the coat as it is on that day. How much force there is,
the pads tell; the fit divides it.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

import jaxeit as je
from jaxeit.contacts import LoadKind, Loads, LoadSettings, Proposal
from jaxeit.contacts.loads import MAX_LOADS
from jaxeit.registry import SettingError

from ...presses.streams import finite_mean
from ..calibration import Calibration
from .learned.loads import learned_loads
from .press_images import fit_untouched_sheet
from .quiet_frames import QuietFrames

# The mesh moves a load by 0.05 mm, a tenth of what the gain of the contact layer does; a draft moves it by 0.15 mm.
LOAD_FIDELITY = je.Fidelity(edge_length=0.05, electrode_segments=10, growth=1.5)
# Chi-square over the number of readings of a fit, and part of the windows beyond it from which it is worth a line. On
# honest skins of another simulator the median reaches 2; where bolts are 2 mm aside it begins at 25.
SURPRISING, MIN_SURPRISING = 6.0, 0.5
LEARNED = "learned"  # array with a line about what was learned of loads
MAX_WINDOW_FRAMES = 4096  # of a window, so that memory stays bounded


class Window(NamedTuple):
    """Means over a window: begin and end (ns), change of the frames (readings,) V, force on all pads and on each, N;
    and the number of frames."""

    begin: int
    end: int
    frame: Float[np.ndarray, " readings"]
    force: float
    frames: int
    pads: Float[np.ndarray, " pads"]


class WindowedFrames:
    """Collects windows of touched frames, and the frames without contact, block by block.

    Raises:
        SettingError: for windows whose duration is no finite number above zero.
    """

    def __init__(self, seconds: float, readings: int):
        if not isinstance(seconds, int | float | np.number) or not 0 < seconds < math.inf:
            raise SettingError(f"loads: windows of {seconds!r} s; give a duration in s, a finite number above zero")
        self._length = round(1e9 * seconds)
        self.windows: list[Window] = []
        self._open: list[tuple[int, np.ndarray, float, np.ndarray]] = []
        self.quiet = QuietFrames(readings)

    def add(
        self,
        time: np.ndarray,
        frames: np.ndarray,
        change: np.ndarray,
        loaded: np.ndarray,
        force: np.ndarray,
        pads: np.ndarray | None = None,
    ) -> None:
        """Frames (n, readings) V, their change, which are touched (n,), and the force on all pads (n,) and each, N."""
        pads = force[:, None] if pads is None else pads
        self.quiet.add(frames, change, loaded)
        for row in range(len(time)):
            if not loaded[row] or (self._open and time[row] - self._open[0][0] >= self._length):
                self.close()
            if loaded[row] and len(self._open) < MAX_WINDOW_FRAMES:
                self._open.append((int(time[row]), change[row], float(force[row]), pads[row]))

    def close(self) -> None:
        """End the window that is open, if it is at least half as long as asked for."""
        if self._open and self._open[-1][0] - self._open[0][0] >= self._length / 2 - 1:
            time, change, force, pads = zip(*self._open, strict=True)
            means = finite_mean(np.stack(change)), float(np.mean(force))
            self.windows.append(Window(time[0], time[-1], *means, len(time), np.mean(pads, 0)))
        self._open = []


@dataclass(frozen=True)
class SeenLoads:
    """Loads of all windows, as arrays of a file; and why there are none."""

    arrays: dict[str, tuple[Any, str, str]]
    kinds: tuple[LoadKind, ...]
    stated: tuple[float, ...]  # probability of each of these kinds
    why_none: str = ""
    outside: int = 0  # windows that are unlike the scenes of the proposal
    left: str = ""  # what their fits leave, if that is more than is believed
    learned: str = ""  # what presses of the calibration told of loads, in words

    def render(self) -> str:
        """What touched the skin, in one line."""
        if self.why_none:
            return f"loads: none fitted: {self.why_none}"
        seen = ", ".join(self._told(kind) for kind in LoadKind if kind in self.kinds)
        unlike = f"; {self.outside} are unlike what the proposal was trained on" if self.outside else ""
        left, learned = f"; {self.left}" if self.left else "", f"; learned: {self.learned}" if self.learned else ""
        return f"loads of {len(self.kinds)} windows: {seen}{unlike}{left}{learned}"

    def _told(self, kind: LoadKind) -> str:
        """How many windows are of a kind, and its mean probability there."""
        stated = [probability for one, probability in zip(self.kinds, self.stated, strict=True) if one is kind]
        return f"{len(stated)} {kind.name.lower()} ({np.mean(stated):.0%} probable)"


def fit_windows(
    calibration: Calibration,
    seen: WindowedFrames,
    progress: Any = iter,
    proposal: Proposal | None = None,
    settings: LoadSettings | None = None,
) -> SeenLoads:
    """Fit loads to each window, from what a finder sees or from a proposal.

    Args:
        settings: as for `prepare_loads`; None: what the presses of the calibration tell (`learned_loads`).
    """
    noise = seen.quiet.noise
    if noise is None or not seen.windows:
        why = "no frames without contact tell the noise" if noise is None else "nothing touches the skin for that long"
        return SeenLoads({}, (), (), why)
    sound = np.isfinite([window.frame for window in seen.windows]).all(0)
    channels = np.asarray(calibration.recon.channels) & (noise > 0) & sound
    model = je.discretise(je.Scene(calibration.skin), LOAD_FIDELITY)
    sheet, _ = fit_untouched_sheet(model, seen.quiet.untouched, channels)
    of_means = np.where(channels, noise, 1.0) / np.sqrt(np.median([window.frames for window in seen.windows]))
    known = {"noise": of_means, "sigma": sheet, "channels": channels}
    told = ""
    if settings is None:
        settings, told = learned_loads(calibration, model, known)
    fitter = je.contacts.prepare_loads(model, settings, gain=calibration.layer, **known)
    finder = je.prepare_contacts(model, **known)
    found = [_found(fitter, finder, proposal, window, channels) for window in progress(seen.windows)]
    loads, distance = zip(*found, strict=True)
    outside = int(np.sum(np.array(distance) > 1))
    kinds, stated = zip(*((one.kind, float(np.max(one.probability))) for one in loads), strict=True)
    arrays = _arrays(seen.windows, found)
    if told:
        arrays[LEARNED] = (np.array([told]), "1", "what presses of the calibration told the fits")
    return SeenLoads(arrays, kinds, stated, outside=outside, left=left_by_fits(arrays["misfit"][0]), learned=told)


def left_by_fits(misfit: np.ndarray) -> str:
    """Words for fits of windows whose readings are not those of the skin's model; empty for few or none of them.

    Args:
        misfit: chi-square over the number of readings of each window, (windows,); NaN: nothing touches the skin.
    """
    known = misfit[np.isfinite(misfit)]
    far = known > SURPRISING
    if not far.any() or far.mean() < MIN_SURPRISING:
        return ""
    return (
        f"in {far.mean():.0%} of them fits leave {np.sqrt(np.median(known[far])):.1f} times their errors: the readings "
        "are not those of this skin's model, and places and kinds may be wrong"
    )


# Loads of a window, and how far it is from the scenes of a proposal; NaN: there is none.
Found = tuple[Loads, float]


def _found(
    fitter: je.contacts.LoadFitter,
    finder: je.contacts.ContactFinder,
    proposal: Proposal | None,
    window: Window,
    channels: np.ndarray,
) -> Found:
    frame = np.where(channels, window.frame, 0.0)
    contacts = finder(frame)
    if proposal is None:
        return fitter(frame, contacts), np.nan
    proposed = proposal(np.where(channels, window.frame, np.nan), window.pads)
    return fitter.refine(frame, proposed, contacts), float(proposed.distance)


def _arrays(windows: list[Window], found: list[Found]) -> dict[str, tuple[Any, str, str]]:
    rows = [dict(_row(window, *one)) for window, one in zip(windows, found, strict=True)]
    columns = {name: np.stack([row[name] for row in rows]) for name in LOAD_ARRAYS}
    return {name: (columns[name], *about) for name, about in LOAD_ARRAYS.items()}


LOAD_ARRAYS = {
    "time": ("ns", "begin and end of each window, since time_epoch_utc"),
    "probability": ("1", "of none, one, two, an edge and more"),
    "misfit": ("1", "chi-square over the number of readings of the most probable kind; about 1 or less; NaN: none"),
    "distance": ("1", "from the scenes of the proposal; above 1: unlike them; NaN: no proposal"),
    "position": ("m", "of each load of the most probable kind; of an edge, its middle; NaN: none"),
    "position_covariance": ("m2", "of each position"),
    "ends": ("m", "both ends of an edge; NaN: no edge"),
    "ends_covariance": ("m2", "of x and y of the first end and of the second"),
    "width": ("m", "standard deviation of each load, across an edge"),
    "force": ("N", "of each load: its share, by the fit, of what the pads tell"),
}


EMPTY = {
    "position": (MAX_LOADS, 2),
    "position_covariance": (MAX_LOADS, 2, 2),
    "ends": (2, 2),
    "ends_covariance": (4, 4),
    "width": (MAX_LOADS,),
    "force": (MAX_LOADS,),
}


def _row(window: Window, found: Loads, distance: float) -> Iterator[tuple[str, np.ndarray]]:
    yield "time", np.array([window.begin, window.end])
    yield "probability", np.asarray(found.probability)
    yield "misfit", np.array(np.nan if found.best is None else found.best.misfit, float)
    yield "distance", np.array(distance)
    out = {name: np.full(shape, np.nan) for name, shape in EMPTY.items()}
    best = found.best
    if best is not None:
        count = len(best.force)
        out["position"][:count], out["width"][:count] = best.position, best.width
        out["force"][:count] = window.force * np.asarray(best.force / best.force.sum())
        out["position_covariance"][:count] = best.position_covariance
    if best is not None and found.kind is LoadKind.EDGE:
        out["ends"][:], out["ends_covariance"][:] = best.ends, best.ends_covariance
    yield from out.items()
