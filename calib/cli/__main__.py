"""``python -m calib.cli``, which is the ``jaxeit`` command."""

import os
import sys
from contextlib import suppress

from . import main


def run() -> None:
    """Run the command of this process, and end the process with its exit status.

    A command that fails or is interrupted leaves computations behind. Python waits for them when it ends, for seconds,
    and takes down what they use, which ended some processes by a segmentation fault: so the process ends without that.
    """
    status = main()
    if status == 0:
        sys.exit()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # a full disk, or nobody reads: `main` has said so
            stream.flush()
    os._exit(status)


if __name__ == "__main__":
    run()
