"""Check the skin that a session describes, and the protocol of its scan."""

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

import jaxeit as je

from ..session import Session
from ..session.mixing import same_scan
from .report import Finding, Severity, listed

RIM_POINTS = 256  # along the rim of the sheet, whose distances to the electrodes are looked at
MAX_RIM_PITCHES = 10.0  # distances between neighbouring electrodes, by which a sheet may reach beyond them
MAX_PAD_BEYOND = 0.5  # share of a pad that may lie more than one such distance outside of all electrodes
MAX_OVERLAP = 0.02  # of the smaller of two pads
MAX_PAD_OUTSIDE = 0.2  # share of a pad that may lie beyond the sheet
MIN_COVER = 0.5  # share of the sheet that pads usually cover
VOLTAGES = 1e-9, 100.0  # V: least and greatest largest reading that electronics can measure
MIN_READING = 1e-5  # of the largest reading: less than half a step of a converter of 16 bits
MAX_EMPTY = 0.25  # share of the readings that may be smaller
DIFFERS = "the recorded skin differs from"
EMPTY_REMEDY = "choose other rows for the protocol: drive and sense pairs that lie further apart and overlap"
MAX_CURRENT = 0.1  # A: EIT drives some milliamperes
PAD_POINTS = 32  # along each side of the box around a shape, at which shares are counted


def check_skin(session: Session, given: je.Skin | None, findings: list[Finding]) -> je.Skin | None:
    """The skin to check against, or None. What is wrong with it, or with the protocol, is added to ``findings``."""
    own = _own_skin(session, findings)
    if given is not None and own is not None:
        findings += _differences(own.toml, given.toml, f"the given skin {given.name!r}")
    elif own is not None and own.name in je.skin.shipped_skins():
        findings += _differences(own.toml, je.load_skin(own.name).toml, f"the shipped {own.name!r}")
    skin = own if given is None else given
    if skin is not None:
        findings += skin_findings(skin)
        findings += _protocol_findings(session, skin)
    return skin


def skin_findings(skin: je.Skin) -> Iterator[Finding]:
    """What a skin describes that can hardly be: sizes, currents, pads over one another, readings taken twice."""
    yield from _size_findings(skin)
    yield from _overlap_findings(skin)
    yield from _cover_findings(skin)
    if skin.protocol.current > MAX_CURRENT:
        what = f"the drive current is {skin.protocol.current:g} A; scans of skins drive some milliamperes"
        yield Finding(Severity.WARNING, "/device", what, "give the current of the protocol in A, such as 1e-3")
    rows, count = np.unique(np.asarray(skin.protocol.pattern), axis=0, return_counts=True)
    if (count > 1).any():
        twice = ", ".join(map(str, rows[count > 1][0].tolist()))
        what = f"{(count > 1).sum()} of {len(rows)} readings are taken more than once, as that of electrodes {twice}"
        yield Finding(Severity.WARNING, "/device", what, "name each reading once: a second one tells no new place")


def voltage_findings(readings: np.ndarray) -> Iterator[Finding]:
    """What is wrong with the sizes (readings,) V of the readings that a skin's model gives without contact."""
    remedy = "correct the sheet resistance, or the current of the protocol"
    low, high = VOLTAGES
    largest = float(np.max(readings, initial=0.0))
    if not np.isfinite(largest):
        what = "the readings of the untouched skin are beyond all numbers"
        yield Finding(Severity.WARNING, "/device", what, remedy)
    elif not low <= largest <= high:
        what = (
            f"the largest reading of the untouched skin is {largest:.3g} V; electronics measure no signal "
            f"{'above 100 V' if largest > high else 'below 1 nV'}"
        )
        yield Finding(Severity.WARNING, "/device", what, remedy)
    empty = int(np.sum(readings < MIN_READING * largest))
    if empty > MAX_EMPTY * readings.size:
        what = (
            f"{empty} of {readings.size} readings of the untouched skin hold less than {100 * MIN_READING:g} % of the "
            "voltage of the largest one: a converter reads them as zero"
        )
        yield Finding(Severity.WARNING, "/device", what, EMPTY_REMEDY)


def _own_skin(session: Session, findings: list[Finding]) -> je.Skin | None:
    if not session.skin_toml.strip():
        severity = Severity.WARNING if "eit" in session.streams else Severity.OK
        what = "describes no skin: pads, numbering and signs are not checked without one"
        findings.append(Finding(severity, "/device", what, "give the skin that was recorded (--skin FILE)"))
        return None
    try:
        return je.skin.parse_skin(session.skin_toml, "skin_toml")
    except ValueError as error:
        what = f"the skin's text cannot be used: {error}"
        findings.append(Finding(Severity.ERROR, "/device", what, "give a corrected skin (--skin FILE)"))
        return None


def _differences(text: str, other: str, name: str) -> Iterator[Finding]:
    a, b = (_flat(je.toml.parse_values(part, name)) for part in (text, other))
    keys = sorted(k for k in a.keys() | b.keys() if a.get(k) != b.get(k))
    if keys:
        what = f"{DIFFERS} {name} in: {listed(keys)}"
        yield Finding(Severity.WARNING, "/device", what, "if the change is intended, give the edited skin its own name")


def _flat(value: object, key: str = "") -> dict[str, object]:
    """Flatten a TOML document to one level of dotted keys."""
    if isinstance(value, dict):
        items = [(f"{key}.{k}" if key else k, v) for k, v in value.items()]
    elif isinstance(value, list) and any(isinstance(v, dict) for v in value):
        items = [(f"{key}[{i}]", v) for i, v in enumerate(value)]
    else:
        return {key: value}
    return {k: v for name, part in items for k, v in _flat(part, name).items()}


def electrode_pitch(skin: je.Skin) -> float:
    """Median distance of the electrodes from their nearest neighbours, m; infinite for one electrode."""
    electrodes = np.asarray(skin.electrode_positions)[:, :2]
    between = np.linalg.norm(electrodes[:, None] - electrodes, axis=-1)
    np.fill_diagonal(between, np.inf)
    return float(np.median(between.min(1)))


def beyond_electrodes(skin: je.Skin, points: np.ndarray) -> np.ndarray:
    """Which points (n, 2) m lie more than the distance between two electrodes outside of all: EIT tells no place there.

    None where all electrodes lie on a line.
    """
    try:
        hull = ConvexHull(np.asarray(skin.electrode_positions)[:, :2]).equations
    except QhullError:
        return np.zeros(len(points), bool)
    return np.asarray((points @ hull[:, :2].T + hull[:, 2]).max(1) > electrode_pitch(skin))


def _size_findings(skin: je.Skin) -> Iterator[Finding]:
    """A sheet or a pad that reaches far beyond the electrodes: their positions have a typo, or another unit."""
    electrodes = np.asarray(skin.electrode_positions)[:, :2]
    rim = _rim_points(skin.domain)
    pitch = electrode_pitch(skin)
    if not np.isfinite(pitch):
        return
    beyond = float(np.linalg.norm(rim[:, None] - electrodes, axis=-1).min(1).max())
    if beyond > MAX_RIM_PITCHES * pitch:
        what = f"the sheet reaches {beyond:.3g} m beyond its electrodes, which are {pitch:.3g} m apart"
        yield Finding(Severity.WARNING, "/device", what, "correct the size of the sheet or the positions of electrodes")
    for pad in skin.pads:
        share = float(beyond_electrodes(skin, _points_in(pad.polygon)).mean())
        if share > MAX_PAD_BEYOND:
            what = (
                f"{100 * share:.0f} % of pad {pad.name!r} lies more than {pitch:.3g} m, the distance between two "
                "electrodes, outside of all electrodes: EIT tells no place there"
            )
            yield Finding(Severity.WARNING, "/device", what, "correct the positions of the electrodes or the pad")


def _overlap_findings(skin: je.Skin) -> Iterator[Finding]:
    """Pads that lie over one another in part, which air-tight pads beside one another do not.

    They can be calibrated: where pads overlap, each has an equal share of the image.
    """
    todo = "correct the corners, unless the pads do overlap: each then has an equal share of the image there"
    for first, second in combinations(skin.pads, 2):
        if (share := je.skin.pad_overlap(first, second)) > MAX_OVERLAP:
            what = f"{100 * share:.0f} % of pad {first.name!r} or {second.name!r} lie within the other one"
            yield Finding(Severity.WARNING, "/device", what, todo)


def _cover_findings(skin: je.Skin) -> Iterator[Finding]:
    """Pads beyond the sheet, and a sheet without pads under it."""
    for pad in skin.pads:
        outside = 1 - float(np.mean(skin.domain.contains(_points_in(pad.polygon))))
        if outside > MAX_PAD_OUTSIDE:
            what = f"{100 * outside:.0f} % of pad {pad.name!r} lies beyond the sheet"
            yield Finding(Severity.WARNING, "/device", what, "correct the corners of the pad, or the size of the sheet")
    cover = float(np.mean(skin.pads_at(_points_in(skin.domain)).any(0)))
    if cover < MIN_COVER:
        what = f"pads lie under {100 * cover:.0f} % of the sheet; no pad tells the forces of contacts elsewhere"
        yield Finding(Severity.OK, "/device", what, "press on pads to calibrate: presses beside them are left out")


def _points_in(shape: je.geometry.Domain) -> np.ndarray:
    """Points of a grid over a shape, (n, 2) m; of its rim where it is too narrow for the grid."""
    low, high = map(np.array, shape.bounds)
    at = (np.arange(PAD_POINTS) + 0.5) / PAD_POINTS
    box = low + np.stack(np.meshgrid(at, at), -1).reshape(-1, 2) * (high - low)
    points = box[shape.contains(box)]
    return points if len(points) else _rim_points(shape)


def _rim_points(shape: je.geometry.Domain) -> np.ndarray:
    """Points along the rim of a shape, (`RIM_POINTS`, 2) m."""
    return shape.boundary_point(np.linspace(0, shape.perimeter, RIM_POINTS, endpoint=False))


def _protocol_findings(session: Session, skin: je.Skin) -> Iterator[Finding]:
    where, pattern, own = "/device/eit_protocol", session.pattern, skin.protocol
    if pattern is None:
        if "eit" in session.streams:
            remedy = "write the pattern of the scan: no reading has a meaning without it"
            yield Finding(Severity.ERROR, where, "no pattern was recorded", remedy)
        return
    if pattern.max() >= len(skin.electrodes):
        what = f"the pattern names electrode {pattern.max()}; the skin has 0 to {len(skin.electrodes) - 1}"
        yield Finding(Severity.ERROR, where, what, "electrodes are counted from 0")
    elif not same_scan(session, own):
        remedy = "calibrate with the skin that was recorded (--skin FILE), or correct its protocol"
        yield Finding(Severity.ERROR, where, _scan_difference(session, own), remedy)
    if session.current is not None and not np.isclose(session.current, own.current, rtol=0.01):
        what = f"the drive current is {session.current:g} A, but {own.current:g} A in the skin's file"
        yield Finding(Severity.WARNING, where, what, "correct the wrong one of the two")


def _scan_difference(session: Session, own: je.Protocol) -> str:
    if session.mixing is None and own.mixing is None:
        return _pattern_difference(np.asarray(session.pattern), own.pattern)
    if session.readings != own.readings:
        return f"the scan has {session.readings} readings, the skin's protocol {own.readings}"
    return "the currents or the voltages of the scan are not those of the skin's protocol"


def _pattern_difference(pattern: np.ndarray, own: np.ndarray) -> str:
    if pattern.shape != own.shape:
        return f"the pattern has {len(pattern)} readings, the skin's protocol {len(own)}"
    rows = np.flatnonzero((pattern != own).any(1))
    same = sorted(map(tuple, pattern.tolist())) == sorted(map(tuple, own.tolist()))
    kind = "holds the same readings in another order" if same else "is not the skin's protocol"
    first = f"row {rows[0]} is {pattern[rows[0]].tolist()}, the skin's {own[rows[0]].tolist()}"
    return f"the pattern {kind}: {len(rows)} rows differ ({first})"
