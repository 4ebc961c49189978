"""Masked arrays: a mask would be lost, and what it hides would count as measured. Every door says what to give."""

import numpy as np
import pytest

import jaxeit as je
from jaxeit.imaging import InverseError

READING = 7  # that is masked
VALUE = 1e3  # which stands under the mask


def masked(shape=550, at=READING, value=1.0):
    hidden = np.zeros(shape, bool)
    hidden[..., at] = True
    return np.ma.masked_array(np.where(hidden, VALUE, value), hidden)


@pytest.fixture(scope="module")
def recon(model, pixels):
    return je.prepare(model, basis=pixels)


DOORS = {
    "dv": [
        lambda model, recon, v: recon(v),
        lambda model, recon, v: recon.on_host()(v),
        lambda model, recon, v: je.contacts.refine_contacts(model, v, None, noise=1e-6),
    ],
    "v0": [lambda model, recon, v: je.fit_background(model, v)],
    "untouched": [lambda model, recon, v: je.prepare(model, untouched=v)],
    "noise": [lambda model, recon, v: je.prepare(model, noise=v)],
    "frame": [lambda model, recon, v: je.imaging.fit_reference(model, v)],
    "frames": [
        lambda model, recon, v: je.prepare(model, hyperparameter=je.imaging.LCurve(v[None])),
        lambda model, recon, v: je.Imaging(hyperparameter=je.imaging.LCurve()).prepare(model, frames=v[None]),
    ],
    "quiet": [
        lambda model, recon, v: je.Imaging(noise=je.imaging.MeasuredNoise()).prepare(model, quiet=np.ma.array([v] * 9))
    ],
}


@pytest.mark.parametrize(("name", "call"), [(name, call) for name, calls in DOORS.items() for call in calls])
def test_masked_readings_are_refused(model, recon, name, call):
    with pytest.raises(InverseError, match=rf"^{name} is a masked array, .* give {name}.filled\(numpy.nan\)$"):
        call(model, recon, masked())


def test_masked_flags_are_refused(model):
    with pytest.raises(InverseError, match=r"^channels is a masked array, .* give channels.filled\(False\)$"):
        je.prepare(model, channels=np.ma.masked_array(np.ones(550, bool), np.arange(550) == READING))


def test_masked_images_conductivities_and_forces_are_refused(skin, model, pixels):
    masks, image, forces = je.pad_masks(skin, pixels), np.zeros(pixels.size), np.ones(4)
    for given in ({"image": masked(pixels.size)}, {"pad_forces": masked(4, 1)}, {"pad_errors": masked(4, 1)}):
        arguments = {"image": image, "masks": masks, "pad_forces": forces} | given
        with pytest.raises(je.fusion.FusionError, match=f"^{next(iter(given))} is a masked array"):
            je.fuse(**arguments)
    with pytest.raises(ValueError, match=r"^sigma is a masked array"):
        je.forward(model, masked(len(model.areas)))


def test_a_filled_mask_is_a_missing_reading(recon):
    dv = np.linspace(-1, 1, 550)
    hidden = np.ma.masked_array(np.where(np.arange(550) == READING, VALUE, dv), np.arange(550) == READING)
    wanted = recon(np.where(np.arange(550) == READING, np.nan, dv))
    np.testing.assert_array_equal(recon(hidden.filled(np.nan)), wanted)
    assert np.isfinite(wanted).all()
