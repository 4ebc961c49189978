"""`jaxeit design`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..arguments import above_zero, count, prepare_outputs, require_matplotlib_for, skin_of
from ..terminal import announce_model, progress_bar

if TYPE_CHECKING:
    import jaxeit as je
    from jaxeit.scan import PlaceSensitivity, ScanDesign


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The skin, the time of a frame, and what is wanted of it."""
    from jaxeit.scan import CRITERIA, DesignSettings

    usual = DesignSettings()
    parser.add_argument("skin", metavar="SKIN", help="a shipped skin by its name, or the TOML file of your own")
    parser.add_argument("-o", "--output", required=True, metavar="BETTER.toml", help="the skin with the designed scan")
    time = parser.add_mutually_exclusive_group()
    text = "time of a frame in readings; default: that of the skin's scan"
    time.add_argument("--readings", type=count, metavar="N", help=text)
    time.add_argument("--rate", type=above_zero, metavar="HZ", help="frames per second")
    text = "time that a change of the driven pair takes, in readings; default: 0"
    parser.add_argument("--switch", type=above_zero, default=0.0, metavar="READINGS", help=text)
    text = f"{', '.join(CRITERIA)}; place-error:power=8 looks at the worst places; default: place-error"
    parser.add_argument("--criterion", default="place-error", metavar="NAME", help=text)
    text = "also count the cases in which any one electrode is dead; takes minutes"
    parser.add_argument("--electrode-dead", action="store_true", help=text)
    text = f"standard deviation of a contact, m; default: {usual.width}"
    parser.add_argument("--width", type=above_zero, default=usual.width, metavar="M", help=text)
    text = "standard deviation of a reading, V; default: 60 dB below the rms of the scan"
    parser.add_argument("--noise", type=above_zero, metavar="V", help=text)
    text = "further noise of a reading, as part of its voltage, such as 1e-3; default: 0"
    parser.add_argument("--relative-noise", type=above_zero, default=0.0, metavar="PART", help=text)
    parser.add_argument("--picture", metavar="MAP.png", help="draw the expected error over the sheet, before and after")


def run(args: argparse.Namespace) -> int:
    """Write the skin with the designed scan, and print what is expected of it."""
    from time import perf_counter

    import jaxeit as je

    from ...runtime import set_up
    from ...session import replacing

    set_up()
    prepare_outputs(args.output, args.picture)
    if args.picture:
        require_matplotlib_for("--picture")
    began, skin, criterion = (
        perf_counter(),
        skin_of(args.skin),
        je.scan.CRITERIA.make(args.criterion, allow_import=True),
    )
    readings = _readings(args, skin)
    settings = je.scan.DesignSettings(width=args.width, noise=args.noise, relative=args.relative_noise)
    fidelity = je.Fidelity.draft()
    announce_model(skin, fidelity)
    sensitivity = je.scan.place_sensitivity(je.discretise(je.Scene(skin), fidelity), settings)
    found = je.scan.design_scan(
        sensitivity,
        readings,
        criterion,
        switch=args.switch,
        any_dead=args.electrode_dead,
        progress=progress_bar("design"),
    )
    better = je.skin.with_rows(skin, found.pattern)
    with replacing(Path(args.output)) as new:
        new.write_text(better.toml, encoding="utf-8")
    print("\n".join(_report(skin, better, sensitivity, found, args.switch)))
    print(f"{args.output}: written after {perf_counter() - began:.0f} s")
    if args.picture:
        _write_picture(skin, better, sensitivity, Path(args.picture))
    return 0


def _readings(args: argparse.Namespace, skin: "je.Skin") -> int:
    """Time of a frame over the time of a reading."""
    import jaxeit as je

    protocol = skin.protocol
    if args.readings is not None:
        return int(args.readings)
    if protocol.reading_time == 0:
        if args.rate is not None:
            raise ValueError(f"--rate: the readings of {skin.name} take no time; give reading_time, or --readings")
        return protocol.readings
    time = je.scan.scan_time(protocol, args.switch) if args.rate is None else 1 / args.rate
    found = int(time / protocol.reading_time * (1 + 1e-9))
    if found < 1:
        raise ValueError(f"--rate {args.rate:g}: a reading alone takes {protocol.reading_time:g} s; give a lower rate")
    return found


def _report(
    before: "je.Skin", after: "je.Skin", sensitivity: "PlaceSensitivity", found: "ScanDesign", switch: float
) -> list[str]:
    columns = [_figures(skin, sensitivity, switch) for skin in (before, after)]
    sites, width = len(sensitivity.sites), 1e3 * float(sensitivity.width)
    heads = ("", "before", "after")
    rows = [heads, *((name, columns[0][name], columns[1][name]) for name in columns[0])]
    return [
        f"{before.name}: {len(before.electrodes)} electrodes, contacts of {width:.3g} mm at {sites} places, "
        f"noise {1e6 * float(sensitivity.noise):.3g} uV, model error {100 * float(sensitivity.model_error):.3g} %",
        *(f"{name:<44}{one:>16}{two:>16}" for name, one, two in rows),
        f"by the criterion {1e3 * found.error:.4g} mm; no scan of {len(found.pattern)} readings has less than "
        f"{1e3 * found.bound:.4g} mm",
    ]


def _figures(skin: "je.Skin", sensitivity: "PlaceSensitivity", switch: float) -> dict[str, str]:
    """What is expected of a scan, in words."""
    import numpy as np

    import jaxeit as je

    pattern = skin.protocol.pattern
    error = 1e3 * np.asarray(sensitivity.errors(pattern))
    electrode, dead = sensitivity.worst_dead(pattern)
    time = je.scan.scan_time(skin.protocol, switch)
    return {
        "readings": f"{len(pattern):,}",
        "driven pairs": f"{len(np.unique(pattern[:, :2], axis=0))}",
        "frames per second": f"{1 / time:,.0f}" if time else "no time given",
        "error of place, mean, mm": f"{np.mean(error):.3g}",
        "error of place, rms, mm": f"{np.sqrt(np.mean(error**2)):.3g}",
        "error of place, median, mm": f"{np.median(error):.3g}",
        "error of place, worst place, mm": f"{error.max():.3g}",
        "rms with the worst electrode dead, mm": f"{1e3 * dead:.3g} (no. {electrode})",
    }


def _write_picture(before: "je.Skin", after: "je.Skin", sensitivity: "PlaceSensitivity", path: Path) -> None:
    import numpy as np

    from ...report.design_figure import design_figure
    from ...report.figures import write_figure

    errors = {
        f"{name}: {skin.protocol.readings} readings": np.asarray(sensitivity.errors(skin.protocol.pattern))
        for name, skin in (("before", before), ("after", after))
    }
    write_figure(design_figure(before, np.asarray(sensitivity.sites), errors), path)
