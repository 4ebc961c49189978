"""Whether a session is to be told that electrodes sit elsewhere than its model has them, by the untouched frame.

`jaxeit.imaging.find_misplacement` compares two beliefs in less than a second, where `check_electrodes` fits each place.
Every command that uses EIT asks it: nothing else that is said of places can be right where the electrodes are not.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

import jaxeit as je
from jaxeit.imaging import InverseError, Misplacement, find_misplacement
from jaxeit.model import MotionError

from ..session import Session
from ..session.mixing import same_scan
from .electrodes import DEVICE_PATH, OTHER_CAUSE
from .report import CheckReport, Finding, Severity

# The mesh of a calibration, whose programs are compiled for its coat already.
PLACEMENT_FIDELITY = je.Fidelity.standard()
# Of the evidence, and of the size in m. On honest skins of two simulators, at 30 to 80 dB, with coats of deviations up
# to 0.6, they reach 110 and 0.17 mm, and never both; skins whose bolts are 0.5 mm aside begin at 110 and 0.43 mm.
MIN_EVIDENCE, MIN_SIZE = 50.0, 3e-4
MAX_ERROR = 1e-2  # of a reading, relative; beyond it neither coat nor places explain the frame
MOST_NAMED = 3  # electrodes
NOTE = "places of the electrodes: "
SIGNIFICANT = 4.0  # standard errors of a shift, from which an electrode is named

REMEDY = (
    "calibrate with --fit-electrodes, which finds where they sit, or measure their places and correct the skin's file; "
    "`jaxeit check --electrodes` names those that are off"
)


def placement_finding(
    skin: je.Skin,
    untouched: Float[np.ndarray, " readings"],
    used: Bool[np.ndarray, " readings"],
    model: je.Model | None = None,
) -> Finding | None:
    """What is to be said of the places of the electrodes; None: nothing, or they cannot be told.

    Args:
        untouched: mean frame without contact, V.
        used: which of its readings are used.
        model: of the skin at `PLACEMENT_FIDELITY`, where there is one already.
    """
    try:
        model = je.discretise(je.Scene(skin), PLACEMENT_FIDELITY) if model is None else model
        found = find_misplacement(model, np.where(used, untouched, np.nan))
    except (InverseError, MotionError):
        return None
    if float(found.error) > MAX_ERROR:
        what = (
            "neither a coat nor places of the electrodes explain the untouched frame: of a reading "
            f"{100 * float(found.error):.0f} % are left; places of contacts and forces of the image may be wrong"
        )
        return Finding(Severity.WARNING, DEVICE_PATH, what, OTHER_CAUSE)
    if float(found.evidence) < MIN_EVIDENCE or float(found.size) < MIN_SIZE:
        return None
    return Finding(Severity.WARNING, DEVICE_PATH, _what(found), REMEDY)


def placement_note(
    skin: je.Skin,
    untouched: Float[np.ndarray, " readings"],
    used: Bool[np.ndarray, " readings"],
    model: je.Model | None = None,
) -> str:
    """`placement_finding` in one line; empty for nothing."""
    found = placement_finding(skin, untouched, used, model)
    return "" if found is None else f"{NOTE}{found.what}: {found.remedy}"


def noted(notes: Iterable[str]) -> str:
    """What `placement_note` said, among the notes of a calibration; empty for nothing."""
    return next((note for note in notes if note.startswith(NOTE)), "")


def with_placement(report: CheckReport, session: Session, skin: je.Skin | None = None) -> CheckReport:
    """The report of a session with what is to be said of the places of the electrodes, unless it names an error.

    Args:
        skin: that was recorded; default: the one described in the file.
    """
    channels = report.channels
    if channels is None or not report.ok or not (skin or session.skin_toml.strip()):
        return report
    skin = skin or je.skin.parse_skin(session.skin_toml, f"{session.name}: skin_toml")
    if not same_scan(channels, skin.protocol):
        return report
    found = placement_finding(skin, channels.mean, ~channels.bad)
    return report if found is None else replace(report, findings=(*report.findings, found))


def _what(found: Misplacement) -> str:
    size = 1e3 * float(found.size)
    about = "3 mm or more" if size > 3 else f"about {size:.1g} mm"
    times = float(found.unshifted / found.error)
    return (
        f"they seem to sit {about} from where the skin's file says (in x and in y, root mean square){_named(found)}; "
        f"with the places of the file, a coat leaves {times:.1f} times as large errors of the untouched frame. Places "
        "of single contacts may err by about as much as the electrodes, and those of loads by more"
    )


def _named(found: Misplacement) -> str:
    """The electrodes that stand out."""
    shift, error = np.asarray(found.shift), np.asarray(found.standard_error)
    far = np.linalg.norm(shift / error, axis=1)
    named = [k for k in np.argsort(-far)[:MOST_NAMED] if far[k] > SIGNIFICANT]
    words = ", ".join(f"no. {k} (x {1e3 * shift[k, 0]:+.1f}, y {1e3 * shift[k, 1]:+.1f} mm)" for k in named)
    return f", most surely {words}" if words else ""
