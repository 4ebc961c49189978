import pytest

import jaxeit as je
from calib.calibration.localisation.load_windows import LOAD_FIDELITY
from jaxeit.contacts import prepare_loads

from .touches import TOUCHES, frames_of


@pytest.fixture(scope="session")
def ready():
    """The fitter, the finder, and the frames of `TOUCHES`."""
    model = je.discretise(je.Scene(je.load_skin("testbed")), LOAD_FIDELITY)
    frames, noise, blank = frames_of([touch for _, touch in TOUCHES.values()])
    finder = je.prepare_contacts(model, noise=noise, untouched=blank)
    return prepare_loads(model, noise=noise, untouched=blank), finder, frames, noise
