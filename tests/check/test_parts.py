"""Parts of a recording in which something is otherwise."""

import numpy as np
import pytest

from calib.check.parts import stepped_part


@pytest.mark.parametrize(("before", "after", "expected"), [(0.0, 5.0, 1e9), (5.0, -1e300, -1e9), (2.0, 2.0, 0.0)])
def test_a_step_between_levels_without_scatter_has_a_finite_clearness(before, after, expected):
    """A load cell that was unplugged reads one value, which divided by no scatter overflowed."""
    row, clearness = stepped_part(np.repeat([before, after], 4))
    assert clearness == expected
    assert row == 4 or expected == 0.0
