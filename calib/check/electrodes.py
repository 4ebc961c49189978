"""Check whether the electrodes sit where the skin's file says, by the frames of the untouched skin."""

from collections.abc import Iterator

import numpy as np

import jaxeit as je
from jaxeit.imaging import ElectrodeFit, fit_electrodes

from ..session.mixing import same_scan
from .eit.reading_order import OrderCheck
from .report import ChannelTable, ElectrodeRow, Finding, Severity, listed

# The errors of a mesh of first order would be taken for shifts of electrodes.
ELECTRODE_FIDELITY = je.Fidelity(order=2, edge_length=je.Fidelity.draft().edge_length)
# Of the root mean square misfit in stated errors: beyond it, the skin is another one than its file says.
LARGEST_MISFIT = 3.0
SIGNIFICANCE = 4.0  # standard errors of a shift; honest sessions reach 1.7
SMALLEST_SHIFT = 5e-4  # m; smaller shifts cost less than the coat does
MIN_SOUND = 0.5  # share of the readings that must be sound

DEVICE_PATH = "/device"
OTHER_CAUSE = "look for faulty contacts, a common mode of the amplifier, or another skin than the file describes"


def check_electrodes(
    skin: je.Skin | None, table: ChannelTable | None, order: OrderCheck | None, findings: list[Finding]
) -> tuple[ElectrodeRow, ...]:
    """How far each electrode seems to sit from its place in the skin's file; what follows is added to ``findings``.

    Empty if the recording does not allow the fit, which a finding says.
    """
    obstacle = _obstacle(skin, table, order)
    if skin is None or table is None or obstacle:
        findings.append(Finding(Severity.OK, DEVICE_PATH, f"places of the electrodes not checked: {obstacle}"))
        return ()
    try:
        fit = fit_electrodes(je.discretise(je.Scene(skin), ELECTRODE_FIDELITY), np.where(table.bad, np.nan, table.mean))
    except ValueError as error:
        findings.append(Finding(Severity.OK, DEVICE_PATH, f"places of the electrodes not checked: {error}"))
        return ()
    if not float(fit.misfit) < LARGEST_MISFIT:
        what = (
            "no places of the electrodes explain the untouched frame: what is left of it is "
            f"{float(fit.misfit):.2g} times the errors of a model"
        )
        findings.append(Finding(Severity.WARNING, DEVICE_PATH, what, OTHER_CAUSE))
        return ()
    if not fit.converged:
        what = (
            "the fit of the places of electrodes has not converged: shifts may err by more than their standard errors"
        )
        findings.append(Finding(Severity.OK, DEVICE_PATH, what))
    rows = _rows(fit)
    findings += _findings(rows)
    return rows


def _obstacle(skin: je.Skin | None, table: ChannelTable | None, order: OrderCheck | None) -> str:
    """Why places cannot be fitted; empty if they can."""
    if table is None:
        return "there are no EIT voltages with a pattern"
    if skin is None:
        return "the session describes no skin (--skin FILE)"
    if not same_scan(table, skin.protocol) or (order is not None and order.claimed):
        return "the order of the readings is not that of the skin"
    sound = np.isfinite(table.mean) & ~table.bad
    if sound.mean() < MIN_SOUND:
        return f"only {sound.sum()} of {len(sound)} readings are sound"
    return ""


def _rows(fit: ElectrodeFit) -> tuple[ElectrodeRow, ...]:
    shift, covariance = np.asarray(fit.shift, float), np.asarray(fit.covariance, float)
    out = []
    for number, one in enumerate(shift):
        own = covariance[2 * number : 2 * number + 2, 2 * number : 2 * number + 2]
        far = float(np.linalg.norm(one))
        along = one / far if far else np.array([1.0, 0.0])
        significance = float(np.sqrt(max(one @ np.linalg.solve(own, one), 0.0)))
        elsewhere = significance > SIGNIFICANCE and far > SMALLEST_SHIFT
        error = float(np.sqrt(along @ own @ along))
        out.append(ElectrodeRow(number, float(one[0]), float(one[1]), error, significance, elsewhere))
    return tuple(out)


def _findings(rows: tuple[ElectrodeRow, ...]) -> Iterator[Finding]:
    errors = 1e3 * np.array([row.error for row in rows])
    elsewhere = sorted((row for row in rows if row.elsewhere), key=lambda row: -np.hypot(row.x, row.y))
    if not elsewhere:
        what = (
            "no electrode seems to sit elsewhere than the skin's file says; the untouched frame tells their places to "
            f"{errors.min():.1g} to {errors.max():.1g} mm (standard errors; 1 mm is what was believed before)"
        )
        yield Finding(Severity.OK, DEVICE_PATH, what)
        return
    said = listed(
        f"no. {row.electrode} by {1e3 * np.hypot(row.x, row.y):.1f} +- {1e3 * row.error:.1f} mm "
        f"(x {1e3 * row.x:+.1f}, y {1e3 * row.y:+.1f})"
        for row in elsewhere
    )
    what = f"{len(elsewhere)} of {len(rows)} electrodes seem to sit elsewhere than the skin's file says: {said}"
    remedy = (
        "measure where they sit and correct their positions in the skin's file, or calibrate with --fit-electrodes, "
        "which tells places better by the presses"
    )
    yield Finding(Severity.WARNING, DEVICE_PATH, what, remedy)
