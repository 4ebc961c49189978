"""Classes by name: shipped, installed, or a user's own by import path."""

import subprocess
import sys
import textwrap
from importlib.metadata import EntryPoint
from pathlib import Path

import jax.numpy as jnp
import pytest

import jaxeit as je
from calib.calibration import LOCATORS
from calib.fitting import CURVES, FIELDS, LOSSES
from calib.presses import BASELINES, CORRECTIONS
from jaxeit.effects import EFFECTS
from jaxeit.imaging import HYPERPARAMETERS, METHODS, NOISES, PRIORS
from jaxeit.linalg import SOLVERS
from jaxeit.metrics import ESTIMATORS
from jaxeit.model import BASES
from jaxeit.registry import registry as module
from jaxeit.skin import ELECTRODES

CHOICES = [
    EFFECTS, CURVES, FIELDS, LOSSES, LOCATORS, BASELINES, CORRECTIONS, PRIORS, METHODS, HYPERPARAMETERS, NOISES, BASES,
    ESTIMATORS,
]  # fmt: skip
ALL = [*CHOICES, ELECTRODES]
MAKEABLE = [(registry, name) for registry in CHOICES for name in registry]


@pytest.mark.parametrize("registry", ALL, ids=lambda r: r.kind)
def test_every_class_is_under_one_name_and_comes_back_from_it(registry):
    assert len(registry) >= 1
    assert len(set(registry.values())) == len(registry)
    for name, kind in registry.items():
        assert registry.find(name) is kind
        assert registry.name_of(kind) == name


@pytest.mark.parametrize(("registry", "name"), MAKEABLE, ids=lambda x: x if isinstance(x, str) else x.kind)
def test_what_is_made_of_a_name_is_described_by_that_name(registry, name):
    thing = registry.make(name)
    assert type(thing) is registry[name]
    assert registry.text(thing) == name
    again = registry.read(je.toml.TomlTable(registry.settings(thing), "test.toml"))
    assert registry.settings(again) == registry.settings(thing)


@pytest.mark.parametrize(
    ("registry", "text", "again"),
    [
        (PRIORS, "gaussian-smooth:length=0.02,noser=true", None),
        (METHODS, "greit:radius=0.03", None),
        (METHODS, "sparse-bayes:steps=30", None),
        (BASES, "pixels:rows=7", None),
        (LOSSES, "huber:width=2", "huber:width=2.0"),
        (CURVES, "play:widths=[100,200]", "play:widths=[100.0,200.0]"),
        (LOCATORS, "fitted-contact:most=3,widths=[0.01,0.02]", None),
        (LOCATORS, "image-centroid:estimator=peak", None),
        (LOCATORS, "image-centroid:estimator=level-centroid:level=0.4", None),
        (LOCATORS, "image-centroid:estimator=positive", "image-centroid:estimator=positive-centroid"),
        (LOCATORS, "image-centroid:estimator=half", "image-centroid"),
        (ESTIMATORS, "half", "level-centroid:level=0.5"),
        (ESTIMATORS, "quarter", "level-centroid"),
        (EFFECTS, "Noise:std=0.5,stream=pressure", None),
        (EFFECTS, "ElectrodeFault:electrode=[1,2],resistance=5", "ElectrodeFault:electrode=[1,2],resistance=5.0"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_settings_are_given_in_a_word(registry, text, again):
    assert registry.text(registry.make(text)) == (again or text)


@pytest.mark.parametrize(
    ("registry", "text", "message"),
    [
        (PRIORS, "nosr", "^no prior 'nosr'; did you mean 'noser'[?]$"),
        (PRIORS, "zzz", '^no prior .zzz.; give one of "noser", "tikhonov", '),
        (
            EFFECTS,
            "my_effects.Wetness",
            "^no effect 'my_effects.Wetness'; write a class of your own as 'my_effects:Wetness'$",
        ),
        (METHODS, "greit:widht=1", "method 'greit:widht=1': widht: unknown key; did you mean 'width'"),
        (METHODS, "greit:width=wide", "width: is 'wide'; give a number such as 0.012 .width: standard deviation of a"),
        (METHODS, "sparse-bayes:steps=1.5", "steps: is 1.5; give a whole number from 0 such as 15"),
        (PRIORS, "gaussian-smooth:noser=1", "noser: is 1; give true or false"),
        (BASES, "pixels:columns=0", "Pixels: columns is 0; give 1 to 2000, a whole number"),
        (LOCATORS, "fitted-contact:widths=[1,2,3]", r"give \[a number, a number\] such as \[0.006,0.03\]"),
        (
            LOCATORS,
            "level-centroid:level=0.3",
            "^no locator 'level-centroid'; 'level-centroid' is known as estimator: write "
            "'image-centroid:estimator=level-centroid:level=0.3'$",
        ),
        (LOCATORS, "half", "write 'image-centroid:estimator=half'$"),
        (HYPERPARAMETERS, "l-curve:frames=1", "frames: unknown key"),
        (CURVES, "linear:bogus=3", "'linear:bogus=3': bogus: unknown key; leave it out: there are no keys$"),
        (EFFECTS, "Noise:stream=eeg", 'give one of "eit", "pressure", "force"'),
        (EFFECTS, "CoatingNonUniformity:field=1", "field: unknown key"),
        (EFFECTS, "CoatingNonUniformity:length=x", "such as 0.03 .length of correlation, 10 to 60 mm."),
    ],
)
def test_what_cannot_be_made_is_said_in_one_line(registry, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        registry.make(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["conjugate-gradient", "conjugate-gradient:max_steps=9", "dense"])
def test_solvers_that_may_hold_another_are_described(text):
    assert SOLVERS.text(SOLVERS.make(text)) == text


def test_fields_that_text_cannot_give_are_given_beside_it():
    frames = jnp.ones((2, 3))
    assert HYPERPARAMETERS.make("discrepancy:factor=1.5", frames=frames).frames is frames


OWN = """
import jaxeit as je
from calib.fitting import AbstractCurve, Linear

class Twice(je.effects.AbstractContactEffect):
    '''Twice the contact conductance.'''
    factor: float = 2.0
    def __call__(self, contact):
        return self.factor * contact

class Straight(Linear):
    pass

class AbstractThing(je.effects.AbstractContactEffect):
    pass

number = 3
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The name of a module outside the package, not imported yet."""
    name = f"users_module_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


def test_a_class_of_a_users_own_is_named_by_its_import_path(own):
    effect = EFFECTS.make(f"{own}:Twice:factor=3", allow_import=True)
    assert effect.factor == 3
    assert EFFECTS.name_of(effect) == f"{own}:Twice"
    assert EFFECTS.text(effect) == f"{own}:Twice:factor=3.0"
    assert CURVES.name_of(CURVES.find(f"{own}:Straight", allow_import=True)) == f"{own}:Straight"
    assert "Twice" not in EFFECTS  # only the room's own classes are shipped


def test_text_of_a_data_file_imports_nothing(own):
    with pytest.raises(ValueError, match=f"import {own} first, or install it with an entry point of the group 'jaxeit"):
        EFFECTS.make(f"{own}:Twice")
    assert own not in sys.modules
    scene = f'[[effects]]\ntype = "{own}:Twice"\n'
    with pytest.raises(je.toml.TomlError, match=f"^data: .*number 1: type: effect '{own}:Twice' is code"):
        je.toml.parse_toml(scene, "data", je.model.read_effects)
    assert own not in sys.modules
    __import__(own)  # what the user has imported is known
    (effect,) = je.toml.parse_toml(scene, "data", je.model.read_effects)
    assert EFFECTS.name_of(effect) == f"{own}:Twice"


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("no_such_module_here:Twice", "cannot be imported .No module named 'no_such_module_here'"),
        ("OWN:Thrice", "cannot be imported .module 'OWN' has no attribute 'Thrice'"),
        ("OWN:number", "is not a concrete class derived from AbstractEffect"),
        ("OWN:Straight", "is not a concrete class derived from AbstractEffect"),
        ("OWN:AbstractThing", "is not a concrete class derived from AbstractEffect: it lacks __call__"),
    ],
)
def test_import_paths_of_no_use_are_named(own, path, message):
    with pytest.raises(ValueError, match=message.replace("OWN", own)):
        EFFECTS.find(path.replace("OWN", own), allow_import=True)


def test_modules_that_fail_are_named(own, tmp_path):
    (tmp_path / f"{own}.py").write_text("raise RuntimeError('two\\nlines')")
    said = f"^effect '{own}:Twice' cannot be imported \\({own} raises RuntimeError: two lines\\); correct that module$"
    with pytest.raises(ValueError, match=said):
        EFFECTS.find(f"{own}:Twice", allow_import=True)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("def x(:", "raises SyntaxError: invalid syntax .*, line 1"),
        ("import no_such_module_there", "raises ModuleNotFoundError: No module named 'no_such_module_there'"),
        ("assert False", r"raises AssertionError\); correct that module"),
        ("import sys; sys.exit(3)", r"raises SystemExit: 3\); correct that module"),
        ("import math; math.no_such_name", "raises AttributeError: module 'math' has no"),
    ],
)
def test_what_a_module_raises_is_said_with_its_type(own, tmp_path, text, said):
    (tmp_path / f"{own}.py").write_text(text)
    with pytest.raises(ValueError, match=f"cannot be imported .{own} {said}"):
        EFFECTS.find(f"{own}:Twice", allow_import=True)


@pytest.mark.parametrize("path", [":Twice", "..effects:Twice", "my effects:Twice"])
def test_what_is_no_name_of_a_module_is_not_there(path):
    with pytest.raises(ValueError, match=r"cannot be imported \(No module named .*; check the path and PYTHONPATH"):
        EFFECTS.find(path, allow_import=True)


def test_installed_classes_are_known_by_their_entry_point(own, monkeypatch):
    points = {"Doubled": EntryPoint("Doubled", f"{own}:Twice", EFFECTS.group)}
    points["Broken"] = EntryPoint("Broken", f"{own}:Missing", EFFECTS.group)
    monkeypatch.setattr(module, "_entry_points", lambda group: points if group == EFFECTS.group else {})
    assert {"Doubled", "Broken"} <= set(EFFECTS.names)
    effect = EFFECTS.make("Doubled:factor=4")
    assert EFFECTS.text(effect) == "Doubled:factor=4.0"
    with pytest.raises(ValueError, match=f"effect 'Broken': {own}:Missing cannot be loaded .module"):
        EFFECTS.find("Broken")


def test_choices_in_choices(own):
    """A setting that is itself a choice is a name, a word with settings, or a table."""
    inner = module.Registry(je.linalg.AbstractLinearSolver, "solver", "test.solvers")
    outer = module.Registry(je.linalg.AbstractLinearSolver, "solver", "test.solvers", parts=(inner,))
    word = outer.read(je.toml.TomlTable({"type": "single", "solver": "nested-dissection:leaf_size=8"}, "t"))
    table = {"type": "single", "solver": {"type": "nested-dissection", "leaf_size": 8}}
    assert outer.read(je.toml.TomlTable(table, "t")) == word
    assert outer.settings(word) == table
    with pytest.raises(je.toml.TomlError, match="t: solver: no solver 'nested'; give one of "):
        outer.read(je.toml.TomlTable({"type": "single", "solver": "nested"}, "t"))
    with pytest.raises(je.toml.TomlError, match="t: solver: is 3; give a solver: its name, or a table"):
        outer.read(je.toml.TomlTable({"type": "single", "solver": 3}, "t"))


def test_registries_are_whole_whichever_module_is_imported_first():
    code = "from calib.fitting.curves import CURVES\nfrom jaxeit.effects.clocks import ClockError\nprint(len(CURVES))"
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True, cwd=Path.cwd()
    )
    assert int(done.stdout) == len(CURVES)
