"""``python -m jaxeit``, which is the ``jaxeit`` command. The command is in `calib`, which jaxeit does not import."""

import runpy

runpy.run_module("calib.cli", run_name="__main__")
