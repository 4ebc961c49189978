"""`jaxeit recover`."""

import argparse
import os
import shlex

from ...arguments import prepare_outputs
from ...terminal import byte_bar, file_size, show


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The journal that a crash left, and the session file to write."""
    parser.add_argument("journal", metavar="SESSION.h5.part")
    parser.add_argument("-o", "--output", metavar="SESSION.h5", help="default: the name without .part")


def run(args: argparse.Namespace) -> int:
    """Write the session, and print what it holds."""
    from ....record.journal.conversion import convert_journal

    output = args.output = args.output or args.journal.removesuffix(".part")
    if output == args.journal:
        raise ValueError(f"{args.journal}: does not end in .part; say with -o how the session is to be called")
    if os.path.exists(output):
        raise ValueError(f"{output}: exists already; give another name with -o, or remove it")
    prepare_outputs(args, "output")
    with byte_bar(2 * file_size(args.journal), "recovering") as progress:
        summary = convert_journal(args.journal, output, recovered=True, progress=progress)
    show(summary.render())
    show(f"look at it ({shlex.join(['jaxeit', 'check', output])}); {args.journal} may then be deleted")
    return 0
