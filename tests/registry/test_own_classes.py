"""Classes of a user's own, each one class in a file outside the package, work wherever the shipped ones do."""

import re
import sys
import tomllib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import calib
import jaxeit as je
from calib import calibration
from calib.calibration.localisation.locators import CentroidLocator, locator_from_numbers, locator_numbers
from calib.fitting import CURVES, FIELDS
from jaxeit.linalg import Dense

OWN = '''
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib.fitting import AbstractField, Linear


class Wet(je.effects.AbstractSheetEffect):
    """The whole sheet conducts better by a factor.

    | meaning                  | default | range  | unit |
    |--------------------------|---------|--------|------|
    | factor of conductivity   | 2       | 1 to 5 |      |
    """

    factor: float = 2.0

    def __call__(self, sheet):
        return sheet._replace(sigma=self.factor * sheet.sigma)


class Root(Linear):
    """F = a sqrt(P)."""

    def __call__(self, params, pressure):
        return params[0] * jnp.sqrt(jnp.maximum(pressure, 1e-12))

    def inverse(self, params, force):
        return (force / params[0]) ** 2

    def free(self, params, scale):
        return jnp.log(params * jnp.sqrt(scale.pressure) / scale.force)

    def bound(self, free, scale):
        return jnp.exp(free) * scale.force / jnp.sqrt(scale.pressure)

    def initial(self, pressure, force, valid, scale):
        return (scale.force / jnp.sqrt(scale.pressure))[None]


class Slope(AbstractField):
    """The gain changes along x."""

    shared: bool = eqx.field(static=True, default=True)

    def basis(self, geometry, place):
        return place[..., :1]

    def shapes(self):
        return np.ones((1, 1))


class Flat(je.AbstractPrior):
    """R = I."""

    def precision(self, jacobian, picture, at=None):
        return je.imaging.Diagonal(jnp.ones(jacobian.shape[1], jacobian.dtype))


class Adjoint(je.imaging.AbstractLinearMethod):
    """x = J^T y."""

    def image(self, problem, y):
        return problem.jacobian.T @ y


class Middle(je.metrics.AbstractEstimator):
    """The centroid of all pixels, weighted by a power of their values."""

    power: float = 1.0

    def __call__(self, image, recon):
        weight = jnp.maximum(image, 0) ** self.power * recon.areas
        return weight @ recon.centres / weight.sum(-1, keepdims=True)


class BigPoint(je.PointElectrode):
    """A point by another name."""

    name: ClassVar[str] = "big-point"
'''

SCENE = """format = "jaxeit-scene"
version = 1
title = "a scene with an effect of one's own"
skin = "testbed"
seed = 1

[[effects]]
type = "OWN:Wet"
factor = 3

[bench]
sites = [[0.1, 0.1]]
forces = [5.0]
blank = 1.0
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The name of a module outside the package, not imported yet."""
    name = "own_" + "".join(c if c.isalnum() else "_" for c in tmp_path.name)
    (tmp_path / f"{name}.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


def test_an_effect_in_a_scene_file(own, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE.replace("OWN", own))
    scene = calib.load_bench(path).scene
    assert [type(effect).__name__ for effect in scene.effects] == ["Wet"]
    fidelity = je.Fidelity.draft(solver=Dense())
    wet, dry = (je.discretise(s, fidelity) for s in (scene, je.Scene(scene.skin)))
    np.testing.assert_allclose(je.conductivity(wet), 3 * je.conductivity(dry), rtol=1e-6)
    path.write_text(SCENE.replace("OWN:Wet", f"{own}:Wett"))
    with pytest.raises(ValueError, match=rf"number 1: type: effect '{own}:Wett' cannot be imported .*has no attribute"):
        calib.load_bench(path)
    path.write_text(SCENE.replace("OWN", own).replace("factor", "factr"))
    with pytest.raises(ValueError, match="factr: unknown key; did you mean 'factor'"):
        calib.load_bench(path)


def test_the_effect_of_the_documentation(tmp_path, monkeypatch):
    """What docs/own-classes.md shows works as it stands."""
    text = (Path(__file__).parents[2] / "docs" / "own-classes.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    table, entry = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    (tmp_path / "my_effects.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    (effect,) = je.toml.parse_toml(table, "scene", je.model.read_effects, allow_import=True)
    sys.modules.pop("my_effects")
    assert je.effects.EFFECTS.text(effect) == "my_effects:Wetness:factor=1.5"
    assert tomllib.loads(entry)["project"]["entry-points"] == {
        je.effects.EFFECTS.group: {"Wetness": "my_effects:Wetness"}
    }


def test_a_curve_in_a_recipe_and_in_a_fit(own):
    text = (
        f'curve = "{own}:Root"\nlocation = "{own}:Slope"\n[imaging]\nprior = "{own}:Flat"\nmethod = "{own}:Adjoint"\n'
    )
    recipe = calib.Recipe.from_toml(text, allow_import=True)
    assert [type(x).__name__ for x in (recipe.curve, recipe.location)] == ["Root", "Slope"]
    assert [type(x).__name__ for x in (recipe.imaging.prior, recipe.imaging.method)] == ["Flat", "Adjoint"]
    assert CURVES.name_of(recipe.curve) == f"{own}:Root"
    pressure = np.linspace(10, 4000, 60)
    fit = calib.fitting.fit_curve(recipe.curve, pressure, 0.3 * np.sqrt(pressure))
    assert float(fit.parameters[0]) == pytest.approx(0.3, rel=1e-6)
    assert calib.Recipe.from_toml(recipe.to_toml()) == recipe  # the module is imported by now
    del sys.modules[own]
    with pytest.raises(ValueError, match=rf"recipe: curve: curve '{own}:Root' is code outside jaxeit"):
        calib.Recipe.from_toml(text)


def test_a_prior_and_a_method(own, model):
    prior = je.imaging.PRIORS.make(f"{own}:Flat", allow_import=True)
    method = je.imaging.METHODS.make(f"{own}:Adjoint", allow_import=True)
    basis = je.Pixels(8).on(model)
    recon = je.prepare(model, prior, method, basis)
    assert bool(jnp.isfinite(recon(jnp.full(len(model.pattern), 1e-3))).all())


class Stated(je.AbstractPrior):
    """R = diag(values)."""

    values: tuple[float, ...]

    def precision(self, jacobian, picture, at=None):
        return je.imaging.Diagonal(
            jnp.asarray(self.values) * jnp.ones(jacobian.shape[1] if len(self.values) == 1 else 1)
        )


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((np.nan,), "the precision of the prior Stated must be positive"),
        ((-1.0,), "the precision of the prior Stated must be positive"),
        ((1.0,) * 7, r"Stated.precision returns Diagonal of 7 values; the image has \d+"),
    ],
)
def test_a_prior_that_cannot_be_is_named(model, values, message):
    with pytest.raises(je.imaging.InverseError, match=message):
        je.prepare(model, Stated(values), basis=je.Pixels(8).on(model))


def test_an_electrode_in_a_skin_file(own, tmp_path):
    text = je.load_skin("testbed").toml
    start, stop = text.index("[electrodes]"), text.index("[protocol]")
    places = "positions = [[0.05, 0.05], [0.15, 0.05], [0.15, 0.15], [0.05, 0.15]]"
    text = f'{text[:start]}[electrodes]\nkind = "{own}:BigPoint"\n{places}\n\n{text[stop:]}'
    (tmp_path / "skin.toml").write_text(text)
    with pytest.raises(je.toml.TomlError, match=f"kind: electrode '{own}:BigPoint' is code outside jaxeit"):
        je.skin.parse_skin(text)
    skin = je.load_skin(tmp_path / "skin.toml")
    assert {type(electrode).__name__ for electrode in skin.electrodes} == {"BigPoint"}


def test_an_estimator_in_a_recipe_and_in_a_calibration(own):
    word = f"image-centroid:estimator={own}:Middle:power=2.0"
    recipe = calib.Recipe.from_toml(f'location = "edge"\nlocator = "{word}"\n', allow_import=True)
    assert calibration.LOCATORS.text(recipe.locator) == word
    assert calib.Recipe.from_toml(recipe.to_toml()) == recipe
    numbers = locator_numbers(CentroidLocator(recipe.locator.estimator))
    assert locator_from_numbers(numbers, "float64").estimator == recipe.locator.estimator
    del sys.modules[own]
    with pytest.raises(ValueError, match=f"estimator '{own}:Middle' is code outside jaxeit"):
        locator_from_numbers(numbers, "float64")


@pytest.mark.parametrize(("word", "level"), [("half", 0.5), ("quarter", 0.25)])
def test_the_estimators_of_earlier_files_are_found(word, level):
    """Recipes and calibrations were written with these words."""
    recipe = calib.Recipe.from_toml(f'locator = {{type = "image-centroid", estimator = "{word}"}}')
    assert recipe.locator.estimator == je.LevelCentroid(level)
    assert locator_from_numbers({"estimator": np.array([word])}, "float64").estimator == je.LevelCentroid(level)


def test_a_field(own):
    field = FIELDS.make(f"{own}:Slope", allow_import=True)
    assert FIELDS.text(field) == f"{own}:Slope"
    assert field.size(4) == 1


def test_the_page_lists_every_kind_with_its_entry_point_group():
    page = (Path(__file__).parents[2] / "docs" / "own-classes.md").read_text()
    ours = [module for name, module in sys.modules.items() if name.partition(".")[0] in ("jaxeit", "calib")]
    things = [thing for module in ours for thing in list(vars(module).values())]
    groups = {thing.group for thing in things if isinstance(thing, je.registry.Registry)}
    listed = re.findall(r"\| `(\w+\.\w+)` \|$", page, re.MULTILINE)
    assert sorted(listed) == sorted({*groups, "calib.importers"})
    assert groups >= {"jaxeit.effects", "jaxeit.electrodes", "jaxeit.estimators", "jaxeit.criteria", "calib.losses"}


class Halved(calib.presses.AbstractCorrection):
    """A plain class without arguments."""

    def apply(self, time, values, name):
        return values / 2


class Scaled(Halved):
    """A plain class whose argument no file would keep."""

    def __init__(self, factor=3.0):
        self.factor = factor


def test_a_plain_class_is_a_choice_unless_it_takes_arguments():
    corrections = calib.presses.CORRECTIONS
    path = f"{__name__}:Halved"
    assert corrections.text(corrections.make(path)) == path
    with pytest.raises(ValueError, match=r"Scaled takes arguments and has no fields, .* write it as a dataclass"):
        corrections.make(f"{__name__}:Scaled")
    with pytest.raises(ValueError, match="write it as a dataclass"):
        corrections.settings(Scaled(2.0))
