"""Notice streams that cannot be true while live runs: EIT at rest that is not of this skin, and pads that stay silent.

`check_session` finds the same in a recording, by its presses. Live knows no presses: it compares the rest levels with
the model of the skin, and contacts in the image with the pads below them.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from ..calibration.calibration import Calibration
from ..check.eit.untouched import UntouchedCheck
from ..check.report import Finding, Severity

SILENT_PADS = (
    "EIT shows contacts on the pads, but no pad moves: check sensors, tubes and valves, and the unit of the pressures "
    "(kPa sent as Pa?; scale=); forces are marked as not valid until a pad moves"
)
SILENT_SECONDS = 2.0  # of contacts in the image, altogether, during which no pad has moved
# A contact changes some pixel by more than this part of what presses of nearly the largest force of the calibration do,
# and by more than a multiple of the largest change from one image to the next at rest.
CONTACT_SHARE, NOISE_MULTIPLE = 0.3, 2.0
MAX_STEP = 0.5  # s that one frame stands for at most
IMAGE_BLUR = 5e-3  # m by which a contact may lie beside the peak of its image; nearer to a rim it may miss the pads


class RestFault(NamedTuple):
    """What is wrong with EIT at rest, in words, empty for nothing; and whether `apply` would refuse such frames."""

    words: str
    refused: bool


NO_FAULT = RestFault("", refused=False)

RestCheck = Callable[[Float[np.ndarray, " readings"]], RestFault]


def rest_check(calibration: Calibration) -> RestCheck | None:
    """Compares rest levels of the voltages with the model of the skin; None for a skin that has no model."""
    try:
        check = UntouchedCheck(calibration.skin)
    except ValueError:
        return None
    used = np.asarray(calibration.recon.channels)
    return lambda untouched: rest_fault(check(untouched, used))


def rest_fault(findings: Sequence[Finding]) -> RestFault:
    """Findings about a frame at rest, in one line."""
    refused = any(finding.severity is Severity.ERROR for finding in findings)
    said = "; ".join(f"{finding.what}; {finding.remedy}" for finding in findings)
    mark = "; forces are marked as not valid" if refused else ""
    return RestFault(f"EIT at rest: {said}{mark}" if said else "", refused)


class PadWatch:
    """Notices that the image shows contacts on the pads while no pad moves: a wrong unit, a closed valve, no air.

    Args:
        level: largest change in the image of a press of nearly the largest force, S.
        inside: pixels around which all is covered by pads (pixels,).
    """

    def __init__(self, level: float, inside: Bool[np.ndarray, " pixels"]):
        self._level, self._inside = CONTACT_SHARE * level, inside
        self._threshold = self._level
        self._seconds, self._last = 0.0, 0

    @classmethod
    def of(cls, calibration: Calibration) -> "PadWatch | None":
        """The watch of a calibration; None for one that kept no presses, as files of an early version."""
        recon, shown = calibration.recon, calibration.examples
        if shown is None:
            return None
        change = np.abs(np.asarray(recon(np.asarray(shown.dv, recon.dtype)))).max(1)
        covered = np.asarray(calibration.masks.weights).sum(0) > 0.99
        return cls(float(np.median(change)), inside_pads(np.asarray(recon.centres), np.asarray(recon.areas), covered))

    @property
    def silent(self) -> bool:
        """Whether no pad has moved during contacts of `SILENT_SECONDS` altogether."""
        return self._seconds > SILENT_SECONDS

    def begin(self, noise: float) -> None:
        """Begin anew; `noise` is the largest change of a pixel from one frame at rest to the next, S."""
        self._threshold = max(self._level, NOISE_MULTIPLE * noise)
        self._seconds, self._last = 0.0, 0

    def add(self, image: Float[np.ndarray, " pixels"], moved: bool, now: int) -> None:
        """Add the image of a frame that arrived at `now` ns, and whether a pad has moved in it."""
        step = float(np.clip((now - self._last) / 1e9, 0.0, MAX_STEP)) if self._last else 0.0
        self._last = now
        if moved:
            self._seconds = 0.0
            return
        size = np.abs(image)
        peak = int(size.argmax())
        if self._inside[peak] and size[peak] > self._threshold:
            self._seconds += step


def inside_pads(
    centres: Float[np.ndarray, "pixels 2"], areas: Float[np.ndarray, " pixels"], covered: Bool[np.ndarray, " pixels"]
) -> Bool[np.ndarray, " pixels"]:
    """Pixels of the sheet that lie farther than `IMAGE_BLUR` from what no pad covers."""
    beside = ~covered & (areas > 0)
    if not beside.any():
        return covered
    distance, _ = cKDTree(centres[beside]).query(centres)
    return np.asarray(covered & (distance > IMAGE_BLUR))
