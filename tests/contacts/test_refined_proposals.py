"""Fits that begin where the shipped networks propose, against a search, on a fresh skin of the second simulator."""

import numpy as np
import pytest

from benchmarks.bench_proposal import SHIPPED, counted, noisy_frames


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_a_refined_proposal_is_no_worse_than_a_search(name):
    """It is less surprised by the true kinds, and loads of the kind that it tells explain the frames as well."""
    surprises, misfits = [], []
    for touch, frame, ready in noisy_frames(name, 7320, 2, 1, presses=0):
        both = searched, refined = ready.searched(frame), ready.refined(frame)
        surprises.append([-np.log(max(float(found.probability[counted(touch)]), 1e-6)) for found in both])
        misfits.append([float(found.of(refined.kind).misfit) for found in both])
    searched, refined = np.mean(surprises, axis=0)
    assert refined < max(searched, 0.5)
    assert refined < 1.2  # that of saying that all kinds but none are equally probable is 1.4
    searched, refined = np.transpose(misfits)
    # Beyond twice of what is believed, the better of both counts.
    assert (refined < np.maximum(1.05 * searched, 2.1)).all()
