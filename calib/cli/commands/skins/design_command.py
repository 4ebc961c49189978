"""`jaxeit design`."""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ...arguments import (
    above_zero,
    at_least_zero,
    count,
    of_option,
    part,
    picture_kind,
    prepare_results,
    require_matplotlib_for,
    skin_of,
)
from ...terminal import announce_model, progress_bar, show

if TYPE_CHECKING:
    import numpy as np

    import jaxeit as je
    from jaxeit.scan import AbstractCriterion, DesignSettings, PlacementLimits, PlaceSensitivity, ScanDesign

MIN_WIDTH = 0.1  # of the longest edge of the mesh: narrower contacts fall between the points of integration


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The skin, the time of a frame, and what is wanted of it."""
    from jaxeit.scan import CRITERIA, DesignSettings

    usual = DesignSettings()
    parser.add_argument("skin", metavar="SKIN", help="a shipped skin by its name, or the TOML file of your own")
    parser.add_argument("-o", "--output", required=True, metavar="BETTER.toml", help="the skin with the designed scan")
    time = parser.add_mutually_exclusive_group()
    text = "duration of a frame, as a number of readings; default: that of the skin's scan"
    time.add_argument("--readings", type=count, metavar="N", help=text)
    time.add_argument("--rate", type=above_zero, metavar="HZ", help="frames per second")
    text = "time that a change of the driven pair takes, in readings; default: 0"
    parser.add_argument("--switch", type=at_least_zero, default=0.0, metavar="READINGS", help=text)
    text = "readings of one drive that are taken at once, in the time of one; default: as the skin's file says, or 1"
    parser.add_argument("--sense-channels", type=count, metavar="N", help=text)
    text = f"{', '.join(CRITERIA)}; place-error:power=8 looks at the worst places; default: place-error"
    parser.add_argument("--criterion", default="place-error", metavar="NAME", help=text)
    text = "also count the cases in which any one electrode is dead; takes minutes"
    parser.add_argument("--electrode-dead", action="store_true", help=text)
    text = f"standard deviation of a contact, m; default: {usual.width}"
    parser.add_argument("--width", type=above_zero, default=usual.width, metavar="M", help=text)
    text = f"places along x for which the scan is designed; fewer are quicker and say less; default: {usual.columns}"
    parser.add_argument("--columns", type=int, default=usual.columns, metavar="N", help=text)
    text = "standard deviation of a reading, V; default: 60 dB below the rms of the scan"
    parser.add_argument("--noise", type=above_zero, metavar="V", help=text)
    text = "further noise of a reading, as part of its voltage, such as 1e-3; default: 0"
    parser.add_argument("--relative-noise", type=part, default=0.0, metavar="PART", help=text)
    _add_placement_arguments(parser)
    parser.add_argument("--picture", metavar="MAP.png", help="draw the expected error over the sheet, before and after")


def _add_placement_arguments(parser: argparse.ArgumentParser) -> None:
    """What `_limits` reads."""
    from jaxeit.scan import PlacementLimits

    moving = parser.add_argument_group("places of the electrodes")
    text = "also move the electrodes to where the scan places contacts best; takes minutes"
    moving.add_argument("--move", action="store_true", help=text)
    text = f"smallest distance between the centres of two electrodes, m; default: {PlacementLimits().distance}"
    moving.add_argument("--distance", type=above_zero, metavar="M", help=text)
    text = "smallest distance from the rim, m; default: that of the electrode nearest to it"
    moving.add_argument("--margin", type=above_zero, metavar="M", help=text)
    text = "no electrode in this circle, m; may be given more than once"
    moving.add_argument("--keep-out", type=_circle, action="append", default=[], metavar="X,Y,RADIUS", help=text)
    text = "largest distance of an electrode from its present place, m; default: any distance"
    moving.add_argument("--farthest", type=above_zero, metavar="M", help=text)
    text = "give up mirror symmetries that the electrodes have"
    moving.add_argument("--asymmetric", action="store_true", help=text)


def run(args: argparse.Namespace) -> int:
    """Write the skin with the designed scan, and print what is expected of it."""
    from time import perf_counter

    import jaxeit as je

    from ....runtime import set_up
    from ....session import replacing

    set_up()
    prepare_results(args, "output", "picture")
    if args.picture:
        picture_kind(args.picture)
        require_matplotlib_for("--picture")
    began, skin = perf_counter(), _asked_skin(args)
    criterion = of_option("criterion", args.criterion, je.scan.CRITERIA.make)
    limits, readings = _limits(args), _readings(args, skin)
    announce_model(skin, je.Fidelity.draft())
    made = _designed(args, skin, criterion, limits, readings)
    with replacing(Path(args.output)) as new:
        new.write_text(made.skins[1].toml, encoding="utf-8")
        if args.picture:
            _write_picture(made, Path(args.picture))  # first, so that an interruption leaves both files or none
    show("\n".join(_report(made, args.switch)))
    show(f"{args.output}: written after {perf_counter() - began:.0f} s")
    return 0


def _asked_skin(args: argparse.Namespace) -> "je.Skin":
    """The skin with as many readings at once as were asked for; its scan must be one of rows."""
    skin = skin_of(str(args.skin))
    skin.protocol.rows("jaxeit design")
    if args.sense_channels is None:
        return skin
    return replace(skin, protocol=replace(skin.protocol, sense_channels=args.sense_channels))


class _DesignedSkin(NamedTuple):
    """The skin and what is expected of it, before and after; and the scan."""

    skins: tuple["je.Skin", "je.Skin"]
    sensitivities: tuple["PlaceSensitivity", "PlaceSensitivity"]
    scan: "ScanDesign"


def _designed(
    args: argparse.Namespace,
    skin: "je.Skin",
    criterion: "AbstractCriterion",
    limits: "PlacementLimits | None",
    readings: int,
) -> _DesignedSkin:
    """The design of the scan; where electrodes may move, that of the scan after they have."""
    import jaxeit as je

    settings = je.scan.DesignSettings(
        width=args.width, columns=args.columns, noise=args.noise, relative=args.relative_noise
    )
    scan = partial(
        je.scan.design_scan,
        readings=readings,
        criterion=criterion,
        switch=args.switch,
        sense_channels=skin.protocol.sense_channels,
        any_dead=args.electrode_dead,
        progress=progress_bar("design"),
    )
    before = after = _sensitivity(skin, settings)
    found, better = scan(before), skin
    if limits is not None:
        # The noise of a reading is that of the hardware, wherever the electrodes sit.
        settings, bar = replace(settings, noise=float(before.noise)), progress_bar("move")
        better = je.scan.move_electrodes(skin, criterion, limits, settings, pattern=found.pattern, progress=bar).skin
        after = _sensitivity(better, settings)
        found = scan(after)
    _require_some_accuracy(after, found.pattern, better)
    better = je.skin.with_rows(better, found.pattern, skin.protocol.sense_channels)
    return _DesignedSkin((skin, better), (before, after), found)


def _sensitivity(skin: "je.Skin", settings: "DesignSettings") -> "PlaceSensitivity":
    """What each reading tells of contacts; ValueError for contacts or a noise that cannot be."""
    import numpy as np

    import jaxeit as je

    model, width = je.discretise(je.Scene(skin), je.Fidelity.draft()), settings.width
    corners = np.asarray(model.chart)[np.asarray(model.triangles)]
    least = MIN_WIDTH * float(np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max())
    if width < least:
        raise ValueError(f"--width {width:g}: too narrow for the model's mesh; give at least {least:.2g} m")
    if width > (most := float(np.ptp(corners.reshape(-1, 2), axis=0).min())):
        raise ValueError(f"--width {width:g}: wider than the sheet, which measures {most:.3g} m; give it in m")
    found = je.scan.place_sensitivity(model, settings)
    if (noise := float(found.noise)) > (most := float(np.abs(found.voltages(skin.protocol.pattern)).max())):
        raise ValueError(f"--noise {noise:g}: more than the largest reading, {most:.3g} V; give it in V")
    return found


def _require_some_accuracy(sensitivity: "PlaceSensitivity", pattern: "np.ndarray", skin: "je.Skin") -> None:
    """Refuse a scan that does not tell where on the sheet a contact lies."""
    import numpy as np

    error = float(np.mean(np.asarray(sensitivity.errors(pattern))))
    if error > (most := float(np.ptp(skin.domain.bounds, axis=0).max())):
        what = f"would have a mean error of place of {1e3 * error:.3g} mm, more than the sheet's {1e3 * most:.3g} mm"
        raise ValueError(f"a scan of {len(pattern)} readings {what}; give a lower --noise, or more --readings")


def _circle(text: str) -> tuple[float, float, float]:
    """X,Y,RADIUS in m."""
    numbers = text.split(",")
    try:
        x, y, radius = map(float, numbers)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: give X,Y,RADIUS in m, such as 0.1,0.1,0.02") from None
    return x, y, radius


def _limits(args: argparse.Namespace) -> "PlacementLimits | None":
    """What the hardware asks of the places of electrodes; None: they stay."""
    from jaxeit.scan import PlacementLimits

    given = {name: getattr(args, name) for name in ("distance", "margin", "farthest") if getattr(args, name)}
    if not args.move:
        others = [f"--{name}" for name in given] + ["--keep-out"] * bool(args.keep_out)
        if others or args.asymmetric:
            raise ValueError(f"{(others or ['--asymmetric'])[0]} is about electrodes that move; add --move")
        return None
    return PlacementLimits(**given, keep_out=tuple(args.keep_out), symmetric=not args.asymmetric)


def _readings(args: argparse.Namespace, skin: "je.Skin") -> int:
    """Time of a frame over the time of a reading."""
    import jaxeit as je

    protocol = skin.protocol
    if args.readings is not None:
        return int(args.readings)
    if protocol.reading_time == 0:
        if args.rate is not None:
            raise ValueError(f"--rate: the readings of {skin.name} take no time; give reading_time, or --readings")
        return protocol.frame_slots
    time = je.scan.scan_time(protocol, args.switch) if args.rate is None else 1 / args.rate
    found = int(time / protocol.reading_time * (1 + 1e-9))
    if found < 1:
        raise ValueError(f"--rate {args.rate:g}: a reading alone takes {protocol.reading_time:g} s; give a lower rate")
    if found > (most := len(je.skin.all_pairs(len(skin.electrodes)))):
        option, todo = (f"--switch {args.switch:g}", "less") if args.rate is None else (f"--rate {args.rate:g}", "more")
        what = f"a frame then has the time of {found:.6g} readings, and there are {most:,}"
        raise ValueError(f"{option}: {what}; give {todo}, or --readings")
    return found


def _report(made: _DesignedSkin, switch: float) -> list[str]:
    import numpy as np

    (before, after), found = made.skins, made.scan
    columns = [_figures(*pair, switch) for pair in zip(made.skins, made.sensitivities, strict=True)]
    sensitivity = made.sensitivities[0]
    sites, width = len(sensitivity.sites), 1e3 * float(sensitivity.width)
    heads = ("", "before", "after")
    rows = [heads, *((name, columns[0][name], columns[1][name]) for name in columns[0])]
    far = 1e3 * np.linalg.norm(after.electrode_positions - before.electrode_positions, axis=1)
    moved = [f"electrodes moved by {far.mean():.3g} mm on average, no. {far.argmax()} by {far.max():.3g} mm"]
    return [
        f"{before.name}: {len(before.electrodes)} electrodes, contacts of {width:.3g} mm at {sites} places, "
        f"noise {1e6 * float(sensitivity.noise):.3g} uV, model error {100 * float(sensitivity.model_error):.3g} %",
        *(f"{name:<44}{one:>16}{two:>16}" for name, one, two in rows),
        *(moved if far.any() else []),
        f"by the criterion {1e3 * found.error:.4g} mm; no scan of {len(found.pattern)} readings"
        f"{' by these electrodes' if far.any() else ''} has less than {1e3 * found.bound:.4g} mm",
    ]


def _figures(skin: "je.Skin", sensitivity: "PlaceSensitivity", switch: float) -> dict[str, str]:
    """What is expected of a scan, in words."""
    import numpy as np

    import jaxeit as je

    pattern = skin.protocol.pattern
    error = 1e3 * np.asarray(sensitivity.errors(pattern))
    electrode, dead = sensitivity.worst_dead(pattern)
    time = je.scan.scan_time(skin.protocol, switch)
    channels = skin.protocol.sense_channels
    at_once = {f"times of reading, {channels} at once": f"{skin.protocol.frame_slots:,}"} if channels > 1 else {}
    return {
        "readings": f"{len(pattern):,}",
        **at_once,
        "driven pairs": f"{len(np.unique(pattern[:, :2], axis=0))}",
        "frames per second": f"{1 / time:,.0f}" if time else "no time given",
        "error of place, mean, mm": f"{np.mean(error):.3g}",
        "error of place, rms, mm": f"{np.sqrt(np.mean(error**2)):.3g}",
        "error of place, median, mm": f"{np.median(error):.3g}",
        "error of place, worst place, mm": f"{error.max():.3g}",
        "rms with the worst electrode dead, mm": f"{1e3 * dead:.3g} (no. {electrode})",
    }


def _write_picture(made: _DesignedSkin, path: Path) -> None:
    import numpy as np

    from ....report.figures.parts import write_figure
    from ....report.figures.skin.designs import ExpectedErrors, design_figure

    maps = {
        f"{name}: {skin.protocol.readings} readings": ExpectedErrors(
            skin, np.asarray(sensitivity.sites), np.asarray(sensitivity.errors(skin.protocol.pattern))
        )
        for name, skin, sensitivity in zip(("before", "after"), made.skins, made.sensitivities, strict=True)
    }
    write_figure(design_figure(maps), path)
