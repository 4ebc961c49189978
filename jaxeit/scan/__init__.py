"""Which readings to take: design of scans, choice of readings and event-driven scans.

Example:
    import jax
    import jax.numpy as jnp

    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    skin = je.load_skin("testbed")
    model = je.discretise(je.Scene(skin), je.Fidelity.draft())
    pixels = je.Pixels(10).on(model)

    # what readings share, in units of their noise
    signal = je.scan.signal_covariance(model, basis=pixels)
    for rule in (je.scan.DOptimal(), je.scan.Sensitive(), je.scan.Volume()):
        chosen = je.scan.choose_readings(signal, 80, rule)
        pairs = set(je.scan.drives(skin.protocol.pattern[chosen.rows]))
        print(f"{type(rule).__name__}: {len(pairs)} driven pairs")
    rows = jnp.sort(je.scan.choose_readings(signal, 80).rows)
    short = je.scan.shortened(skin.protocol, rows)
    for scan in (skin.protocol, short):
        print(f"{scan.readings} readings: {1 / je.scan.scan_time(scan):.0f} frames/s")

    recon = je.prepare(model, basis=pixels)  # of the whole scan; it leaves out what is missing
    image = recon(je.scan.in_frame(je.forward(model)[rows], rows, skin.protocol.readings))
"""

from .contact_information import DesignSettings, PlaceSensitivity, place_sensitivity
from .covariance import around, signal_covariance
from .criteria import CRITERIA, AbstractCriterion, PlaceError, PlaceVolume
from .design import ScanDesign, design_scan
from .event_driven import EventScan, EventScanSettings, ScanState, prepare_event_scan
from .placement import Placement, PlacementLimits, move_electrodes
from .selection import (
    AbstractSelection,
    Chosen,
    DOptimal,
    Sensitive,
    Volume,
    choose_readings,
    drives,
    in_frame,
    scan_time,
    shortened,
)

__all__ = [
    "CRITERIA",
    "AbstractCriterion",
    "AbstractSelection",
    "Chosen",
    "DOptimal",
    "DesignSettings",
    "EventScan",
    "EventScanSettings",
    "PlaceError",
    "PlaceSensitivity",
    "PlaceVolume",
    "Placement",
    "PlacementLimits",
    "ScanDesign",
    "ScanState",
    "Sensitive",
    "Volume",
    "around",
    "choose_readings",
    "design_scan",
    "drives",
    "in_frame",
    "move_electrodes",
    "place_sensitivity",
    "prepare_event_scan",
    "scan_time",
    "shortened",
    "signal_covariance",
]
