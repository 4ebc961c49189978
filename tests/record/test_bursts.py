"""Frames that a device holds back: the earliest of a burst tells the time only to a period of the frames."""

import numpy as np
import pytest

from tests.campaign.devices import honest_device, in_bursts, received
from tests.campaign.telling import tell


@pytest.mark.parametrize(
    ("held", "words"), [(True, "bursts, so that times may be off by 10 ms"), (False, "0 lost; clock")]
)
def test_frames_in_bursts_are_said_to_have_uncertain_times(held, words, tmp_path):
    """The EIT of 100 Hz in bursts, or as it comes; the pressure of 200 Hz says nothing of its own 5 ms."""
    rng = np.random.default_rng(0)
    sent = {number: honest_device(number, rng) for number in (0, 1)}
    if held:
        sent[0] = in_bursts(sent[0], rng)
    received(sent, tmp_path / "s.h5.part", 0, bytes)
    said = tell("recover", tmp_path / "s.h5.part", "-o", tmp_path / "s.h5").out
    lines = [line for line in said.splitlines() if "come in bursts" in line]
    assert words in said
    assert len(lines) == held
