"""`jaxeit image`."""

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ...arguments import above_zero, picture_kind, prepare_results, require_matplotlib_for, skin_of
from ...recipe_options import IMAGING, add_imaging_arguments, imaging_of
from ...terminal import show

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxeit import Imaging
    from jaxeit.imaging import ReferenceFit, ReferenceSettings

    from ....tanks import Tank

COLOURS = ("#ffffff", "#2166ac", "#b2182b")
"""Of the classes: as the reference, resistive, conductive."""

UNFINISHED = (
    "the fit of the image has not converged: its steps ended first, and the image may be wrong; check the tank's model"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A file of a tank, its geometry where the file has none, and the picture to write."""
    text = (
        "MATLAB file of EIDORS or the Kuopio challenge, CSV of PyEIDORS, .eit of Sciospec or a folder of them, .eit or "
        ".get of Draeger, CareFusion or GOE-MF II, or NPZ; with --skin also readings alone: CSV, NPY, NPZ or MAT"
    )
    parser.add_argument("tank", metavar="FILE", help=text)
    parser.add_argument("-o", "--output", required=True, metavar="PICTURE.png", help="PNG, PDF or SVG by its name")
    parser.add_argument("--frame", type=int, default=-1, metavar="N", help="frame to image, from 0; default: the last")
    parser.add_argument("--reference", type=int, default=0, metavar="N", help="frame it is compared with; default: 0")
    text = "radius in m of a round tank; needed where the file does not describe its tank (all but .mat)"
    parser.add_argument("--radius", type=above_zero, metavar="M", help=text)
    text = "shape, electrodes and scan of the tank, for a file of readings alone: a TOML file, or a shipped skin's name"
    parser.add_argument("--skin", metavar="TANK.toml", help=text)
    parser.add_argument(
        "--start", type=float, default=0.0, metavar="DEGREES", help="angle of electrode 0 from +x; default: 0"
    )
    parser.add_argument("--clockwise", action="store_true", help="electrodes follow each other clockwise")
    text = "fit conductivity and contact resistances (one, or one of each electrode) to the reference; image with them"
    parser.add_argument("--fit-contacts", choices=("one", "each"), help=text)
    text = "with --fit-contacts: also fit an offset of each channel; how large such offsets are, in V"
    parser.add_argument("--fit-offset", type=above_zero, metavar="V", help=text)
    text = "draw what conducts less and what conducts more than the reference; its prior and method are its own"
    parser.add_argument("--classes", action="store_true", help=text)
    text = "the conductivity that --frame alone shows, in S, in place of a change; its prior and method are its own"
    parser.add_argument("--absolute", action="store_true", help=text)
    text = "weigh each change by the reading of the reference, as where instruments err in proportion"
    parser.add_argument("--normalised", action="store_true", help=text)
    add_imaging_arguments(parser, "0.3", with_noise=False)


def run(args: argparse.Namespace) -> int:
    """Write the image of two frames or of one, and print what was found."""
    from ....runtime import set_up

    set_up()
    require_matplotlib_for("jaxeit image")
    prepare_results(args, "output")
    from matplotlib.figure import Figure

    import jaxeit as je

    from ....session import replacing

    kind = picture_kind(args.output)
    _require_one_kind(args)
    imaging = imaging_of(args, je.Imaging(hyperparameter=0.3))
    tank = _tank(args)
    figure = Figure(layout="constrained")  # without a window, on any machine
    axes = figure.subplots()
    if args.absolute:
        lines = _conductivity(args, tank, axes)
    else:
        lines = _classes(args, tank, axes) if args.classes else _change(args, tank, imaging, axes)
    je.plot.show_skin(tank.skin, axes)
    compared = "" if args.absolute else f" less {tank.names[args.reference]}"
    axes.set_title(f"{tank.names[args.frame]}{compared}", fontsize=9)
    with replacing(Path(args.output)) as new:
        figure.savefig(new, format=kind, dpi=150)
    count, readings = len(tank.skin.electrodes), tank.skin.protocol.readings
    show(f"{count} electrodes, {readings} readings, {_listed(tank.names)}")
    show("\n".join(lines))
    return 0


def _listed(names: tuple[str, ...]) -> str:
    """The names of frames, or the first and the last of a recording."""
    from ....session.errors import printable

    shown = [printable(name) for name in names]
    return f"{len(names)} frames: {shown[0]} to {shown[-1]}" if len(names) > 12 else f"frames: {', '.join(shown)}"


def _change(args: argparse.Namespace, tank: "Tank", imaging: "Imaging", axes: "Axes") -> list[str]:
    """Draw the difference image; what is printed of it."""
    import jaxeit as je

    from ....tanks import difference_image

    if isinstance(imaging.basis, je.model.Elements):
        raise ValueError("--basis elements: elements make no picture; give --pixels, or --basis bumps")
    choices = {name: getattr(imaging, name) for name in ("prior", "method", "basis", "hyperparameter")}
    found = difference_image(tank, args.frame, args.reference, **choices, normalised=args.normalised, fit=_fit(args))
    je.plot.show_image(found.recon, found.change, axes, label="change of conductivity over the reference's")
    low, high = float(found.change.min()), float(found.change.max())
    of_reference = f"{found.background:.3g} S if it is even; correlation with an even tank {found.correlation:.3f}"
    fitted = [] if found.fit is None else [f"fitted to the reference: {_fitted(found.fit)}"]
    of_image = f"{args.output}: change {low:.2f} to {high:.2f} of the reference's conductivity"
    used = float(found.recon.provenance["hyperparameter"])
    chosen = [] if isinstance(imaging.hyperparameter, float) else [f"hyperparameter {used:.3g}"]
    return [f"reference: {of_reference}", *fitted, *chosen, of_image]


def _require_one_kind(args: argparse.Namespace) -> None:
    """Refuse options that belong to another kind of image."""
    if args.classes and args.absolute:
        raise ValueError("--classes shows a change and --absolute one frame: give one of them")
    if not (args.classes or args.absolute):
        return
    kind = "--classes" if args.classes else "--absolute"
    if args.normalised:
        raise ValueError(f"--normalised weighs a difference image: leave out {kind}")
    given = next((name for name in IMAGING if getattr(args, name, None) is not None), None)
    if given is not None:
        raise ValueError(f"--{given}: for images of a change, and {kind} chooses its own; leave it out")


def _conductivity(args: argparse.Namespace, tank: "Tank", axes: "Axes") -> list[str]:
    """Draw the absolute image of the frame; what is printed of it."""
    import jaxeit as je

    from ....tanks import conductivity_image

    found = conductivity_image(tank, args.frame, reference=args.reference, fit=_fit(args))
    je.plot.show_image(found.shown.picture, found.shown.image, axes, label="conductivity, S")
    fitted = [] if found.fit is None else [f"fitted to the reference: {_fitted(found.fit)}"]
    low, high = float(found.shown.sigma.min()), float(found.shown.sigma.max())
    unfinished = [] if found.shown.converged else [UNFINISHED]
    return [*fitted, *unfinished, f"{args.output}: conductivity {low:.3g} to {high:.3g} S"]


def _classes(args: argparse.Namespace, tank: "Tank", axes: "Axes") -> list[str]:
    """Draw the classes of the frame; what is printed of them."""
    import numpy as np
    from matplotlib.colors import ListedColormap

    from ....tanks import segmented_frame

    found = segmented_frame(tank, args.frame, args.reference, fit=_fit(args))
    x0, x1, y0, y1 = (1e3 * end for end in found.picture.extent)  # mm
    axes.imshow(found.classes, ListedColormap(COLOURS), origin="lower", extent=(x0, x1, y0, y1), vmin=0, vmax=2)
    shares = np.bincount(found.classes.ravel(), minlength=3) / found.classes.size
    areas = 1e-2 * (x1 - x0) * (y1 - y0) * shares
    unfinished = [] if found.converged else [UNFINISHED]
    return [*unfinished, f"{args.output}: {areas[1]:.3g} cm^2 resistive (blue), {areas[2]:.3g} cm^2 conductive (red)"]


def _fit(args: argparse.Namespace) -> "ReferenceSettings | None":
    """What is to be fitted to the reference."""
    import jaxeit as je

    if args.fit_contacts is None:
        if args.fit_offset is not None:
            raise ValueError("--fit-offset belongs to the fit of the reference: add --fit-contacts one or each")
        return None
    one = {} if args.fit_contacts == "each" else {"contact_each": 0.0}
    return je.imaging.ReferenceSettings(offset=args.fit_offset or 0.0, **one)


def _fitted(fit: "ReferenceFit") -> str:
    """Conductivity and contacts in words, with standard errors in percent."""
    import numpy as np

    touching = np.asarray(fit.value.contact) > 0
    contact, error = (np.asarray(part.contact)[touching] for part in (fit.value, fit.standard_error))
    percent = 100 * np.array([fit.standard_error.level, error.min(), error.max()])
    return (
        f"{float(fit.value.level):.4g} S +- {percent[0]:.2g} %, contact resistances {contact.min():.3g} to "
        f"{contact.max():.3g} ohm m (ohm m^2 of bolts) +- {percent[1]:.2g} to {percent[2]:.2g} %"
    )


def _tank(args: argparse.Namespace) -> "Tank":
    """The tank of the file, its electrodes where the options say."""
    import jaxeit as je

    from ....tanks import load_tank

    if args.skin is not None and (args.radius is not None or args.start or args.clockwise):
        raise ValueError("--skin says where electrodes sit: leave out --radius, --start and --clockwise")
    domain = None if args.radius is None else je.Disc(args.radius)
    tank = load_tank(args.tank, domain, skin=skin_of(args.skin))
    if not (args.start or args.clockwise):
        return tank
    if args.radius is None:
        raise ValueError("--start and --clockwise place the electrodes of a round tank: give --radius")
    count = len(tank.skin.electrodes)
    start, clockwise = math.radians(args.start), args.clockwise
    rim = je.skin.rim_electrodes(tank.skin.domain, count, start=start, clockwise=clockwise)
    return replace(tank, skin=replace(tank.skin, electrodes=rim))
