"""Fits of loads whose shape is not that of the model, of frames with little noise."""

import numpy as np
import pytest

from benchmarks.bench_loads import TIP_SPREAD, prepared, seen, shaped, simulated
from benchmarks.problems import fit_model


@pytest.mark.slow
@pytest.mark.parametrize("seed", [700, 710])
def test_rings_are_found_where_they_are(seed):
    """At 80 dB, on a known sheet, where a ring looks like a narrow bump of a load that saturates the layer."""
    model = fit_model()
    given = list(shaped(np.random.default_rng(seed), "ring", 8))
    found = simulated(seed, given, spread=TIP_SPREAD)
    for one in seen(prepared(model, found, seed, 80, True), given):
        place = np.asarray(one.loads.one.position)
        assert np.linalg.norm(place - one.touch.truth) < 4e-3
