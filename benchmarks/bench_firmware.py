"""A frame in C by the header of `jaxeit export c`, beside NumPy: the image, also without a reading, and all of it.

C is compiled by `cc -O2`, so that the header itself counts and no option of one processor. NumPy is the reconstructor
on the host in float32; for the whole frame its image goes through the compiled program of the live engine. Both are
seconds of the processor, in which other programs do not count.
"""

import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

import calib
import jaxeit as je
from calib.calibration.application.force_maps import force_model
from calib.live.frame_programs import FramePrograms

from .bench_live import made_up
from .harness import Question, Run, with_one_blas_thread
from .rows import Row

PROGRAM = """
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "skin.h"

static skin_rest rest;
static skin_result result;
static float frame[SKIN_READINGS], pads[SKIN_PADS];

int main(int argc, char **argv)
{
    const long calls = argc > 1 ? atol(argv[1]) : 1;
    float seen = 0.0f;
    for (int part = 0; part < 3; part++) {
        clock_t start;
        for (int i = 0; i < SKIN_READINGS; i++)
            frame[i] = 1e-6f * (float)(i % 7);
        for (int i = 0; i < SKIN_PADS; i++)
            pads[i] = 1000.0f;
        if (part == 1)
            frame[SKIN_READINGS / 2] = NAN;
        start = clock();
        for (long n = 0; n < calls; n++) {
            frame[0] = 1e-6f * (float)(n % 5);
            if (part < 2)
                skin_imaged(&rest, frame, &result);
            else
                skin_frame(&rest, frame, pads, &result);
            seen += result.image[n % SKIN_PIXELS];
        }
        printf("%.9g\\n", (double)(clock() - start) / CLOCKS_PER_SEC / (double)calls);
    }
    fprintf(stderr, "%g\\n", (double)seen);
    return 0;
}
"""
PARTS = ("image", "image, one reading is missing", "image, pad forces and force map")
ROUNDS = 7


def times(run: Run) -> Iterator[Row]:
    """Seconds of a frame in C and in NumPy, in turns."""
    if shutil.which("cc") is None:
        raise SystemExit("there is no C compiler: install one whose program is cc")
    calls = 20 if run.smoke else 1000
    for pixels in run.sizes((20, 40), (10,)):
        calibration = calibration_of(pixels)
        with tempfile.TemporaryDirectory() as folder:
            sizes = calib.export_c(calibration, Path(folder) / "skin.h")
            rows = list(measured(calibration, Path(folder), calls))
        what = {"pixels": pixels, "readings": calibration.recon.readings}
        yield {"rows": [what | row for row in rows], "sizes": [what | vars(sizes) | {"ram": sizes.ram}]}


def calibration_of(pixels: int) -> calib.Calibration:
    """The calibration of `bench_live`, with so many pixels a side."""
    found = made_up()
    recon = je.prepare(je.discretise(je.Scene(found.skin), je.Fidelity.draft()), basis=je.Pixels(pixels))
    return calib.Calibration(
        found.skin, recon, je.pad_masks(found.skin, recon), found.curves, found.evaluation, {}, simulated=True
    )


def measured(calibration: calib.Calibration, folder: Path, calls: int) -> Iterator[Row]:
    """A row for each part of a frame: medians over rounds, microseconds. The header is in the folder."""
    readings, pads = calibration.recon.readings, len(calibration.skin.pads)
    programs, image = FramePrograms(force_model(calibration)), calibration.recon.on_host("float32")
    frame = (1e-6 * (np.arange(readings) % 7)).astype("f4")
    lost = np.where(np.arange(readings) == readings // 2, np.nan, frame).astype("f4")
    pressure, before = np.full(pads, 1000.0), np.zeros((1, pads))
    numpy_parts = (
        lambda: image(frame),
        lambda: image(lost),
        lambda: jax.block_until_ready(programs.map(frame, pressure, programs.nowhere, before)),
    )
    (folder / "main.c").write_text(PROGRAM, encoding="ascii")
    subprocess.run(["cc", "-std=c99", "-O2", "main.c", "-o", "main", "-lm"], cwd=folder, check=True)
    rounds = []
    for _ in range(ROUNDS):
        out = subprocess.run([folder / "main", str(calls)], capture_output=True, text=True, check=True).stdout
        in_numpy = [repeated(part, calls) / calls for part in numpy_parts]
        rounds.append([[float(line) for line in out.split()], in_numpy])
    medians = 1e6 * np.median(rounds, 0)
    for part, c, numpy in zip(PARTS, *medians.tolist(), strict=True):
        yield {"part": part, "c_us": round(c, 2), "numpy_us": round(numpy, 2)}


def repeated(call: Callable[[], Any], times: int) -> float:
    """Seconds of the processor."""
    start = time.process_time()
    for _ in range(times):
        call()
    return time.process_time() - start


main = Question("firmware", __doc__, {"times": times})

if __name__ == "__main__":
    with_one_blas_thread()
    main()
