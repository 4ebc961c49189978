"""`jaxeit export`."""

import argparse
from collections.abc import Callable

from ...arguments import of_option, prepare_results
from ...terminal import progress_bar, say, show


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to write, from which file, and where to."""
    kinds = parser.add_subparsers(title="formats", required=True, metavar="FORMAT", dest="format")
    for name, (text, add, export) in _FORMATS.items():
        kind = kinds.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        add(kind)
        kind.set_defaults(export=export)


def _add_header(header: argparse.ArgumentParser) -> None:
    header.add_argument("calibration", metavar="CALIBRATION.h5")
    header.add_argument("-o", "--output", required=True, metavar="SKIN.h")
    text = "prefix of the names in the header, in lower case (default: %(default)s)"
    header.add_argument("--prefix", default="skin", help=text)
    text = "leave out a correction by location: its gain is then 1"
    header.add_argument("--without-location", action="store_true", help=text)
    text = (
        "place of the contact by this estimator of the image, in place of the fits of the calibration; such as half or "
        "level-centroid:level=0.4"
    )
    header.add_argument("--place", metavar="ESTIMATOR", help=text)


def _add_bag(bag: argparse.ArgumentParser) -> None:
    bag.add_argument("source", metavar="FORCEMAP.h5", help="a force map of jaxeit apply, or a session")
    text = "a folder of rosbag2, or one file if the name ends in .mcap"
    bag.add_argument("-o", "--output", required=True, metavar="BAG", help=text)
    bag.add_argument("--prefix", default="/skin", help="first part of the topics (default: %(default)s)")
    text = "frame of coordinates in which the skin lies (default: %(default)s)"
    bag.add_argument("--frame-id", default="skin", metavar="FRAME", help=text)


def _add_forces(forces: argparse.ArgumentParser) -> None:
    forces.add_argument("source", metavar="FORCEMAP.h5", help="a force map of jaxeit apply, or the forces of a log")
    text = "contacts are written to a second table beside it, FORCES-contacts.csv; other files are not replaced"
    forces.add_argument("-o", "--output", required=True, metavar="FORCES.csv", help=text)


def _add_dataset(dataset: argparse.ArgumentParser) -> None:
    dataset.add_argument("sources", nargs="+", metavar="FORCEMAP.h5", help="force maps of jaxeit apply")
    dataset.add_argument("-o", "--output", required=True, metavar="DATASET", help="a new folder")
    text = "what was done, in words (default: %(default)s)"
    dataset.add_argument("--task", default="touch the skin", help=text)
    text = "frames a second (default: the lowest rate of the force maps, rounded)"
    dataset.add_argument("--fps", type=int, help=text)
    text = "force on a pixel that is white in an image (default: the largest one, rounded up)"
    dataset.add_argument("--full-scale", type=float, metavar="N", help=text)


def _add_table(table: argparse.ArgumentParser) -> None:
    table.add_argument("source", metavar="FRAMES", help="the folder of the frames")
    table.add_argument("-o", "--output", required=True, metavar="FOLDER", help="an empty or a new folder")


def run(args: argparse.Namespace) -> int:
    """Write the file, and print what it holds."""
    from ....runtime import set_up

    set_up()
    show(f"{args.output}: {args.export(args)}")
    return 0


def _write_header(args: argparse.Namespace) -> object:
    import jaxeit as je

    from ....calibration import load_calibration
    from ....export import export_c

    prepare_results(args, "output")
    place = None if args.place is None else of_option("place", args.place, je.metrics.ESTIMATORS.make)
    calibration = load_calibration(args.calibration)
    options = {"prefix": args.prefix, "without_location": args.without_location}
    return export_c(calibration, args.output, **options, place=place, tell=say)


def _write_forces(args: argparse.Namespace) -> object:
    from ....export import export_csv

    prepare_results(args, "output")
    return export_csv(args.source, args.output, progress=progress_bar("blocks"))


def _write_bag(args: argparse.Namespace) -> object:
    from ....export import export_mcap

    progress = progress_bar("blocks")
    return export_mcap(args.source, args.output, prefix=args.prefix, frame_id=args.frame_id, progress=progress)


def _write_dataset(args: argparse.Namespace) -> object:
    from ....export import export_lerobot

    options = {"task": args.task, "fps": args.fps, "full_scale": args.full_scale}
    return export_lerobot(args.sources, args.output, **options, progress=progress_bar("episodes"))


def _write_table(args: argparse.Namespace) -> object:
    from ....batch.parquet_frames import export_training_frames

    return export_training_frames(args.source, args.output, progress=progress_bar("shards"))


# Format -> what it is, the arguments of its writer, and the writer.
_FORMATS: dict[str, tuple[str, Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], object]]] = {
    "c": (
        "one C99 header without allocation: a frame to image, force map and pad forces in float32",
        _add_header,
        _write_header,
    ),
    "csv": (
        "forces of jaxeit apply as a table, a row a frame, and contacts as a second table, for spreadsheets and pandas",
        _add_forces,
        _write_forces,
    ),
    "mcap": (
        "a force map or a session as a bag of ROS 2 (MCAP) for ros2 bag play and Foxglove, with jaxeit[tables]",
        _add_bag,
        _write_bag,
    ),
    "lerobot": (
        "force maps as a LeRobot dataset of version 3.0, each force map an episode, with jaxeit[tables]",
        _add_dataset,
        _write_dataset,
    ),
    "parquet": (
        "frames of jaxeit simulate --random-scenes as Parquet, a file for each shard, with jaxeit[tables]",
        _add_table,
        _write_table,
    ),
}
