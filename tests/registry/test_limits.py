"""Settings outside the values that have a meaning, from Python and from text."""

import dataclasses
import math
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import calib
import jaxeit as je
from jaxeit.imaging import HYPERPARAMETERS, METHODS, PRIORS
from jaxeit.model.bases import BASES
from jaxeit.registry import AbstractChoice, SettingError, limited, settings_of
from jaxeit.scan import CRITERIA

REGISTRIES = [
    *(PRIORS, METHODS, HYPERPARAMETERS, BASES, CRITERIA, je.linalg.SOLVERS),
    *(calib.fitting.CURVES, calib.fitting.FIELDS, calib.fitting.LOSSES, calib.presses.CORRECTIONS),
]
NUMBERS = ("a number", "a whole number from 0")
CASES = [
    (registry, name, setting)
    for registry in REGISTRIES
    for name, kind in registry.shipped.items()
    for setting in settings_of(kind, registry.parts).values()
    if any(form.meaning.strip("[], .") in NUMBERS for form in setting.forms)
]


def limits_of(registry, name, setting):
    (field,) = [f for f in dataclasses.fields(registry.shipped[name]) if f.name == setting.name]
    return field.metadata["limits"]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case[0].kind}-{case[1]}-{case[2].name}")
def test_every_number_that_text_can_give_has_limits(case):
    registry, name, setting = case
    limits = limits_of(*case)
    wrong = limits.least - (0 if limits.open else 1)
    given = int(wrong) if limits.whole else float(wrong)
    listed = setting.forms[0].meaning.startswith("[")
    said = f"{setting.name} is {given:g}; give {limits}"
    with pytest.raises(ValueError, match=said):
        registry.shipped[name](**{setting.name: jnp.full(3, given) if listed else given})
    if given >= 0:  # text gives no negative counts
        with pytest.raises(ValueError, match=said):
            registry.make(f"{name}:{setting.name}={[given] * 3 if listed else given}")


SETTINGS = {
    je.LevelCentroid: SettingError,
    je.imaging.ElectrodeFitSettings: SettingError,
    calib.presses.DetectionLimits: SettingError,
    calib.presses.WindowLengths: SettingError,
    calib.calibration.FittedContact: SettingError,
    je.contacts.ContactSettings: je.imaging.InverseError,
    je.contacts.LoadSettings: je.imaging.InverseError,
    je.tracking.TrackerSettings: je.imaging.InverseError,
    je.imaging.ReferenceSettings: je.imaging.InverseError,
    je.imaging.LevelSet: je.imaging.InverseError,
    je.imaging.ChangeErrors: je.imaging.InverseError,
    je.imaging.RegionSettings: je.imaging.InverseError,
}
"""Classes of settings, and the error that each raises."""
OTHERS = {"outside", "loads", "fidelity", "dtype", "law", "forces", "prior", "learn"}
"""Settings that are no number, or may be below zero."""


@pytest.mark.parametrize(
    ("kind", "name"),
    [(kind, f.name) for kind in SETTINGS for f in dataclasses.fields(kind) if f.name not in OTHERS],
    ids=str,
)
def test_every_number_of_these_settings_has_limits(kind, name):
    usual = getattr(kind(), name)
    counts = type(usual) is int or name == "columns"
    for wrong in (-1,) if counts else (-1.0, math.nan):
        value = (wrong, wrong) if isinstance(usual, tuple) else wrong
        with pytest.raises(SETTINGS[kind], match=f"{kind.__name__}: {name} is {wrong:g}( m| s| N| V)?; give "):
            kind(**{name: value})
    if issubclass(kind, eqx.Module):
        return  # tests check its annotations before its limits
    for wrong in ("0.01", *((2.5, True) if counts else ())):
        with pytest.raises(SETTINGS[kind], match=f"{kind.__name__}: {name} is {wrong!r}( m| s| N| V)?; give "):
            kind(**{name: wrong})
    if not isinstance(usual, tuple):
        with pytest.raises(SETTINGS[kind], match=rf"{kind.__name__}: {name} has shape \(2,\); give one number"):
            kind(**{name: jnp.full(2, 1 if usual is None else usual)})


@pytest.mark.parametrize(
    ("kind", "given", "said"),
    [
        (je.contacts.ContactSettings, {"widths": (0.01,)}, r"widths has shape \(1,\); give .* m, 2 numbers"),
        (je.contacts.ContactSettings, {"widths": (5.0, 30.0)}, "widths is 5 m; give more than 0 to 1 m"),
        (je.contacts.ContactSettings, {"false_alarm": 0.5}, "false_alarm is 0.5; give more than 0 to less than 0.5"),
        (je.contacts.LoadSettings, {"width": 12.0}, "width is 12 m; give more than 0 to 1 m"),
        (je.contacts.LoadSettings, {"prior": (0.5, 0.5)}, r"prior has shape \(2,\)"),
        (je.contacts.LoadSettings, {"law": "hill"}, "'hill' is not a law of pressure"),
        (je.tracking.TrackerSettings, {"dtype": "foo"}, "dtype is 'foo'; give 'float32' or 'float64'"),
        (je.tracking.TrackerSettings, {"learn": 1}, "learn is 1; give True or False"),
        (je.tracking.TrackerSettings, {"loads": 3}, "int is not what is known of loads"),
        (je.tracking.TrackerSettings, {"fidelity": "draft"}, "'draft' is not a fidelity"),
        (je.imaging.ReferenceSettings, {"shift": 2.0}, "shift is 2 m; give 0 to 1 m"),
        (je.imaging.LevelSet, {"widths": ()}, "widths is empty"),
    ],
)
def test_settings_of_other_sizes_and_kinds_are_refused(kind, given, said):
    with pytest.raises(je.imaging.InverseError, match=f"{kind.__name__}: {said}"):
        kind(**given)


def test_no_number_that_is_not_finite_and_no_fraction_of_a_count():
    for value in (math.nan, math.inf, -1.0, 0.0):
        with pytest.raises(SettingError, match=r"GaussianSmooth: length is .*; give more than 0"):
            je.GaussianSmooth(value)
    for make in (je.GaussianSmooth, je.Greit):
        with pytest.raises(SettingError, match=r": (length|width) is 20; give more than 0 to 1"):
            make(20.0)
    with pytest.raises(je.model.BasisError, match="Bumps: width is 12; give more than 0 to 1"):
        je.Bumps(width=12.0)
    with pytest.raises(je.model.BasisError, match=r"Pixels: columns is 40\.5; give 1 to 2000, a whole number"):
        je.Pixels(40.5)
    with pytest.raises(SettingError, match="Noser: exponent is 50; give 0 to 1"):
        je.Noser(50.0)


class Firmness(AbstractChoice):
    """A choice outside of the packages, where annotations are not checked."""

    share: float = limited(0.5, above=0.0, most=1.0, unit="m")


@pytest.mark.parametrize("value", ["20", {}, 1j, b"1", je.Noser, ("a", 1.0)])
def test_what_is_no_number_is_refused(value):
    said = value[0] if isinstance(value, tuple) else value
    with pytest.raises(SettingError, match=re.escape(f"Firmness: share is {said!r}; give more than 0 to 1 m")):
        Firmness(value)
    with pytest.raises(je.model.BasisError, match="Pixels: columns is '20'; give 1 to 2000, a whole number"):
        je.Pixels("20")


def test_a_word_names_the_setting_once():
    with pytest.raises(ValueError, match=r"^prior 'noser:exponent=50': Noser: exponent is 50; give 0 to 1$"):
        PRIORS.make("noser:exponent=50")


def test_hidden_values_are_not_looked_at():
    """Under grad no limit can be checked, and none is."""
    assert jax.grad(lambda width: 2 * calib.fitting.Huber(width).width)(-1.0) == 2


def test_a_name_is_no_noise():
    with pytest.raises(je.imaging.InverseError, match=r"'measured' is not a noise; give an object, such as"):
        je.Imaging(noise="measured")


@pytest.mark.parametrize("weight", ["gcv", None, [0.1], True, je.imaging.LCurve])
def test_what_is_no_hyperparameter_is_refused(weight):
    with pytest.raises(je.imaging.InverseError, match=r"give a number, such as 0\.1, or a way to choose one"):
        je.Imaging(hyperparameter=weight)


def test_only_what_may_be_empty_is():
    assert calib.fitting.logs.SmoothChannels((2,), ()).lags == ()  # no creep
    with pytest.raises(SettingError, match="GaussianProcess: lengths is empty; give more than 0"):
        calib.fitting.GaussianProcess(lengths=())
