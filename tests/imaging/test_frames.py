"""What is said of frames and errors that no fit through the full forward map can use: which argument it is."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.imaging import InverseError

from ..helpers import square_model

POINTS = [(0.05, 0.05), (0.15, 0.05), (0.15, 0.15), (0.05, 0.15), (0.1, 0.1), (0.1, 0.0)]


@pytest.fixture(scope="module")
def small():
    return square_model(POINTS, je.skin.adjacent(6), 4)


FRAMES = {
    "fit_background": ("v0", lambda model, frame: je.fit_background(model, frame, columns=4)),
    "fit_reference": ("frame", je.imaging.fit_reference),
    "fit_electrodes": ("v0", je.imaging.fit_electrodes),
    "find_misplacement": ("v0", je.imaging.find_misplacement),
    "absolute_image": ("frame", lambda model, frame: je.imaging.absolute_image(model, frame, je.Pixels(4))),
    "segment, reference": ("reference", lambda model, frame: je.imaging.segment(model, frame, je.forward(model))),
    "segment, frame": ("frame", lambda model, frame: je.imaging.segment(model, je.forward(model), frame)),
    "prepare": ("untouched", lambda model, frame: je.prepare(model, untouched=frame)),
    "prepare_contacts": (
        "untouched",
        lambda model, frame: je.prepare_contacts(model, noise=np.ones(model.readings), untouched=frame),
    ),
}
"""Which argument of each function is a frame."""


@pytest.mark.parametrize("call", FRAMES)
def test_a_wrong_frame_is_named_as_the_caller_gave_it(small, call):
    name, use = FRAMES[call]
    with pytest.raises(InverseError, match=rf"^{name} has shape \(3,\); give the {small.readings} readings"):
        use(small, jnp.ones(3))
    with pytest.raises(InverseError, match=f"^{name} has no reading that is finite"):
        use(small, jnp.full(small.readings, jnp.nan))
    if not call.startswith("segment"):
        with pytest.raises(InverseError, match=f"^{name} has the opposite sign"):
            use(small, -je.forward(small))


def test_errors_of_a_reference_are_named_and_above_zero(small):
    frame = je.forward(small)
    with pytest.raises(InverseError, match=r"^std has shape \(3,\); give the standard error of each of"):
        je.imaging.fit_reference(small, frame, std=np.ones(3))
    with pytest.raises(InverseError, match=r"^std of reading 2 is 0 V; give a standard error above zero"):
        je.imaging.fit_reference(small, frame, std=np.where(np.arange(small.readings) == 2, 0.0, 1e-3))
    with pytest.raises(InverseError, match=r"^std is complex"):
        je.imaging.fit_reference(small, frame, std=np.ones(small.readings) * 1j)
