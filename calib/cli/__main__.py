"""``python -m calib.cli``, which is the ``jaxeit`` command."""

import sys

from . import main

sys.exit(main())
