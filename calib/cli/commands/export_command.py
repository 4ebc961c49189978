"""`jaxeit export`."""

import argparse

from ..arguments import prepare_outputs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to write, the calibration, and the file to write."""
    kinds = parser.add_subparsers(title="formats", required=True, metavar="FORMAT", dest="format")
    text = "one C99 header without allocation: a frame to image, force map and pad forces in float32"
    header = kinds.add_parser("c", help=text, description=text[0].upper() + text[1:] + ".")
    header.add_argument("calibration", metavar="CALIBRATION.h5")
    header.add_argument("-o", "--output", required=True, metavar="SKIN.h")
    text = "prefix of the names in the header, in lower case (default: %(default)s)"
    header.add_argument("--prefix", default="skin", help=text)
    text = "leave out a correction by location, which a header cannot hold: its gain is then 1"
    header.add_argument("--without-location", action="store_true", help=text)


def run(args: argparse.Namespace) -> int:
    """Write the header, and print what it takes."""
    from ...runtime import set_up

    set_up()
    from ...calibration import load_calibration
    from ...export import export_c

    prepare_outputs(args.output)
    calibration = load_calibration(args.calibration)
    sizes = export_c(calibration, args.output, prefix=args.prefix, without_location=args.without_location)
    print(f"{args.output}: {sizes}")
    return 0
