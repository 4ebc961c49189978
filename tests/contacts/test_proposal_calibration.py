"""Probabilities that the shipped networks state against what is true, on skins of the second simulator.

Seeds are those of no benchmark; the second simulator shares no code with the one that trained the networks.
"""

import numpy as np
import pytest

from benchmarks.bench_loads import reliability
from benchmarks.bench_proposal import SHIPPED, counted, recorded, touched
from jaxeit.contacts import LoadKind, load_proposal

SEEDS = (7310, 7311, 7312)


def calibration_error(rows):
    """Mean distance of stated probabilities from shares of true kinds, over the counts of `reliability`."""
    away = [abs(row["stated"] - row["true"]) for row in rows]
    return float(np.average(away, weights=[row["count"] for row in rows]))


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_what_is_stated_comes_true_as_often(name):
    proposal, stated, kinds = load_proposal(name), [], []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        given = touched(name, rng, 16, 3)
        found = recorded(name, seed, given)
        stated.append(proposal(found.change + found.noise * rng.normal(size=found.change.shape)).probability)
        kinds += [counted(touch) for touch in given]
    stated, kinds = np.concatenate(stated), np.array(kinds)
    assert calibration_error(reliability(stated, np.arange(len(LoadKind)) == kinds[:, None])) < 0.05
    # The most probable kinds of frames are as often true as they are probable, within what chance does to so many.
    top, right = stated.max(1), stated.argmax(1) == kinds
    assert abs(top.mean() - right.mean()) < 3 * np.sqrt(np.sum(top * (1 - top))) / len(top)
    sure = top > 0.8
    assert sure.sum() > 30
    assert right[sure].mean() > top[sure].mean() - 3 * np.sqrt(np.sum((top * (1 - top))[sure])) / sure.sum()
