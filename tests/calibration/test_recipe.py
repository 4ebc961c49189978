"""Recipes: from Python, from TOML and from the command line, and what a calibration remembers of them."""

import argparse
from dataclasses import replace
from operator import attrgetter

import jax.numpy as jnp
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.calibration.recipes.recipe import RecipeError
from calib.cli.recipe_options import add_recipe_arguments, recipe_of
from calib.fitting import CURVES, FIELDS, LOSSES
from calib.session import SessionError
from jaxeit.toml import TomlError

from .quick_bench import QUICK

RECIPES = {
    "default": calib.Recipe(),
    "several": calib.Recipe(curve=[calib.Linear(), calib.PowerLaw(900.0)], location=[None, calib.PadEdge()]),
    "images": calib.Recipe(
        imaging=je.Imaging(
            basis=je.Pixels(30, rows=20),
            method=je.Reweighted(steps=4),
            prior=je.TotalVariation(beta=0.02),
            hyperparameter=je.NoiseFigure(0.7),
            noise=je.imaging.CorrelatedNoise(),
        ),
        fidelity=je.Fidelity.draft(
            dtype=np.float32, solver=je.linalg.ConjugateGradient(je.linalg.Single(je.linalg.NestedDissection(8)))
        ),
    ),
    "presses": calib.Recipe(
        locator=calib.calibration.ImageCentroid(je.LevelCentroid(0.25)),
        loss=calib.fitting.Huber(2.0),
        folds=3,
        processing=calib.presses.Processing(
            corrections=(calib.presses.LowPass(3.0, causal=True),), baseline=calib.presses.PreOnly()
        ),
    ),
}


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
def test_a_recipe_is_made_again_from_its_text(recipe):
    text = recipe.to_toml()
    again = calib.Recipe.from_toml(text)
    assert again.to_toml() == text
    assert again.imaging == recipe.imaging
    assert again.fidelity == recipe.fidelity
    assert again.processing == recipe.processing
    assert [type(c) for c in again.curves] == [type(c) for c in recipe.curves]
    assert len(again.locations) == len(recipe.locations)


def test_recipes_that_differ_have_texts_that_differ():
    texts = [recipe.to_toml() for recipe in RECIPES.values()]
    changes = [
        {"folds": 4},
        {"curve": calib.PowerLaw()},
        {"imaging": je.Imaging(hyperparameter=0.2)},
        {"imaging": je.Imaging(noise=je.imaging.MeasuredNoise())},
        {"fidelity": je.Fidelity.draft()},
        {"even_sheet": True},
    ]
    texts += [replace(calib.Recipe(), **change).to_toml() for change in changes]
    assert len(set(texts)) == len(texts)


def test_a_file_gives_some_choices_and_the_rest_stays(tmp_path):
    path = tmp_path / "recipe.toml"
    path.write_text(
        'curve = "auto"\nlocation = ["none", {type = "edge", width = 0.01}]\nfidelity = {level = "draft", order = 2}\n'
        '[imaging]\nprior = {type = "gaussian-smooth", length = 0.01}\nhyperparameter = "noise-figure:0.4"\n'
        '[processing]\ncorrections = ["low-pass:cutoff=20"]\n[processing.windows]\nhold = 0.8\n'
    )
    recipe = calib.Recipe.load(path)
    without_memory = ["linear", "power", "polynomial", "spline"]
    with_memory = ["play", "hysteresis", "hysteresis-spline"]
    assert [CURVES.name_of(c) for c in recipe.curves] == without_memory + with_memory
    memoryless = calib.Recipe.from_toml('curve = "memoryless"')
    assert [CURVES.name_of(c) for c in memoryless.curves] == without_memory
    assert recipe.locations[0] is None
    assert recipe.locations[1].width == 0.01
    assert (recipe.fidelity.edge_length, recipe.fidelity.order) == (0.06, 2)
    assert recipe.imaging == je.Imaging(prior=je.GaussianSmooth(0.01), hyperparameter=je.NoiseFigure(0.4))
    assert recipe.processing.corrections == (calib.presses.LowPass(20.0),)
    assert recipe.processing.windows.hold == 0.8
    assert recipe.processing.baseline == calib.presses.TwoSided()
    assert LOSSES.name_of(recipe.loss) == "soft-l1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('curve = "powr"', "r.toml: curve: no curve 'powr'; did you mean 'power'"),
        ('curv = "power"', "r.toml: curv: unknown key; did you mean 'curve'"),
        ("curve = []", "recipe: curve is empty; give one or more"),
        ("even_sheet = 1", "r.toml: even_sheet: is 1; give true or false"),
        ("curve = 3", "r.toml: curve: is 3; give a curve, or a list of them"),
        ('[imaging]\nprior = "nosr"', r"r.toml: \[imaging\]: prior: no prior 'nosr'; did you mean 'noser'"),
        ('[imaging]\nprior = {type = "noser", exponent = "x"}', "exponent: is 'x'; give a number"),
        ("[imaging]\nhyperparameter = -1", "hyperparameter: is -1; give a number, or a way to choose one: gcv"),
        ('[imaging]\nprior = "total-variation"', "changes with the image, and the method OneStep takes it only once"),
        ('[imaging]\nbasis = "elements"', "choose the basis Pixels or Bumps"),
        ('fidelity = "fine"', "r.toml: fidelity: .*level: is 'fine'; give one of \"draft\""),
        ("fidelity = {order = 3}", "order is 3; give one of"),
        ("folds = 0", "r.toml: folds: is 0; give a whole number"),
        (
            '[processing]\ncorrections = ["high-pass"]',
            "no correction 'high-pass'; give .*low-pass",
        ),
        ("[processing.windows]\nhold = -1", "hold: is -1; give seconds"),
        ('[processing]\nbaseline = "x"', "no baseline 'x'; give one of .two-sided., .pre-only."),
        ('location = "no_such_module:Field"', "cannot import; import no_such_module first"),
    ],
)
def test_a_wrong_recipe_is_one_clear_line(text, message):
    with pytest.raises(ValueError, match=message) as caught:
        calib.Recipe.from_toml(text, "r.toml")
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("r.toml")
    assert isinstance(caught.value, TomlError)


def test_a_way_to_choose_with_frames_of_its_own_is_refused():
    with pytest.raises(RecipeError, match=r"LCurve has frames of its own; give LCurve\(\)"):
        calib.Recipe(imaging=je.Imaging(hyperparameter=je.imaging.LCurve(jnp.ones((1, 550)))))


def options(*words):
    parser = argparse.ArgumentParser()
    add_recipe_arguments(parser)
    return recipe_of(parser.parse_args(words))


class Doubled(calib.presses.AbstractCorrection):
    """A correction that a user wrote."""

    def apply(self, time, values, name):
        return 2 * values


def test_a_low_pass_on_the_command_line_leaves_other_corrections():
    doubled = f"{__name__}:Doubled"
    own, soft = options("--correction", doubled), options("--correction", "low-pass:order=4")
    assert [type(one).__name__ for one in own.processing.corrections] == ["Doubled"]
    both = options("--correction", doubled, "--correction", "low-pass:order=4", "--low-pass", "9").processing
    assert isinstance(both.corrections[0], Doubled)
    assert both.corrections[1:] == (replace(soft.processing.corrections[0], cutoff=9.0),)
    added = options("--correction", doubled, "--low-pass", "9").processing.corrections
    assert added[0] == calib.presses.LowPass(9.0)
    assert isinstance(added[1], Doubled)


def test_corrections_of_a_file_are_switched_off_or_replaced(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text('[processing]\ncorrections = ["low-pass:cutoff=20,order=3"]\n')
    file = ("--recipe", str(path))
    assert options(*file, "--correction", "none").processing.corrections == ()
    assert options(*file, "--correction", "default").processing.corrections is None
    assert options(*file, "--low-pass", "9").processing.corrections == (calib.presses.LowPass(9.0, order=3),)
    with pytest.raises(ValueError, match="--correction none stands alone"):
        options("--correction", "low-pass", "--correction", "none")
    with pytest.raises(ValueError, match="--correction: no correction 'high-pass'"):
        options("--correction", "high-pass")


@pytest.mark.parametrize("name", ["even-sheet", "fit-electrodes", "learn-layer"])
def test_an_option_switches_off_what_the_file_switches_on(tmp_path, name):
    path = tmp_path / "r.toml"
    path.write_text(f"{name.replace('-', '_')} = true\n")
    file = ("--recipe", str(path))
    asked = attrgetter(name.replace("-", "_"))
    assert asked(options(*file))
    assert not asked(options(*file, f"--no-{name}"))


@pytest.mark.parametrize("name", [*CURVES, *(f"{f} --location" for f in FIELDS)])
def test_every_name_is_an_option(name):
    choice, _, location = name.partition(" ")
    recipe = options("--location", choice) if location else options("--curve", choice)
    made = recipe.location if location else recipe.curve
    assert (FIELDS if location else CURVES).name_of(made) == choice


def test_options_come_before_the_file_and_the_file_before_the_defaults(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text('loss = "huber"\nfolds = 7\n[imaging]\nprior = "laplace"\nbasis = "bumps"\n')
    recipe = options("--recipe", str(path), "--prior", "tikhonov", "--low-pass", "9", "--hyperparameter", "l-curve")
    assert recipe.imaging == je.Imaging(je.Bumps(), prior=je.Tikhonov(), hyperparameter=je.imaging.LCurve())
    assert LOSSES.name_of(recipe.loss) == "huber"
    assert recipe.folds == 7
    assert recipe.processing.corrections == (calib.presses.LowPass(9.0),)
    plain = options("--pixels", "20", "--noise", "measured", "--baseline", "pre-only", "--fidelity", "draft:order=2")
    assert plain.imaging == je.Imaging(je.Pixels(20), noise=je.imaging.MeasuredNoise())
    assert plain.processing.baseline == calib.presses.PreOnly()
    assert plain.fidelity == je.Fidelity.draft(order=2)
    assert not plain.even_sheet
    assert options("--even-sheet").even_sheet
    assert options("--fit-electrodes").fit_electrodes
    assert not plain.fit_electrodes
    path.write_text("even_sheet = true\n")
    assert options("--recipe", str(path)).even_sheet


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--curve", "powr"], "--curve: no curve 'powr'; did you mean 'power'"),
        (["--location", "egde"], "--location: no field 'egde'; did you mean 'edge'"),
        (["--prior", "gaussian-smooth:lenght=1"], "--prior: .*lenght: unknown key; did you mean 'length'"),
        (["--hyperparameter", "-0.1"], "--hyperparameter -0.1: the hyperparameter is -0.1; give a number above zero"),
        (["--hyperparameter", "curve"], "--hyperparameter: no hyperparameter 'curve'"),
        (["--noise", "white"], "--noise: no noise 'white'; give one of .equal., .measured., .correlated."),
        (["--fidelity", "best"], "--fidelity: .*level: is 'best'; give one of \"draft\""),
        (["--prior", "total-variation"], "--prior total-variation: .* choose the method Reweighted"),
        (["--locator", "image-centroid"], "--locator image-centroid: nothing asks for the place; give --location"),
        (["--basis", "elements"], "choose the basis Pixels or Bumps"),
        (["--method", "no_such_module:Method"], "--method: .*cannot be imported .*check the path and PYTHONPATH"),
        (["--recipe", "nowhere.toml"], "nowhere.toml: cannot be read"),
    ],
)
def test_a_wrong_option_is_one_clear_line(words, message):
    with pytest.raises(ValueError, match=message) as caught:
        options(*words)
    assert "\n" not in str(caught.value)


ITERATIVE = {
    "non-negative": je.Imaging(je.Pixels(14), je.NonNegative()),
    "sparse Bayes": je.Imaging(je.Pixels(14), je.SparseBayes(steps=3)),
    "total variation": je.Imaging(je.Pixels(14), je.Reweighted(steps=3), je.TotalVariation()),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ITERATIVE)
def test_a_calibration_with_an_iterative_method_is_kept_in_the_file(name, grid, folder):
    imaging = ITERATIVE[name]
    with calib.open_session(grid) as session:
        made = calib.calibrate([session], recipe=replace(QUICK, imaging=imaging))
    assert isinstance(made.recon, je.imaging.IterativeReconstructor)
    assert made.evaluation.summary()["localisation_half_mean"] < 0.015
    made.save(folder / "iterative.h5")
    loaded = calib.load_calibration(folder / "iterative.h5")
    assert loaded.recon.method == imaging.method
    assert loaded.recon.problem.prior == imaging.prior
    dv = np.random.default_rng(0).normal(size=(2, 550)) * 1e-4
    dv[1, 7] = np.nan
    pressures = np.array([[500.0, 0, 0, 100.0], [0, 900.0, 0, 0]])
    first, second = (calib.force_map(c, dv, pressures) for c in (made, loaded))
    np.testing.assert_array_equal(first.map.force, second.map.force)
    np.testing.assert_allclose(np.asarray(loaded.recon.on_host()(dv)), np.asarray(loaded.recon(dv)))
    with calib.open_session(grid) as session:
        assert calib.evaluate(loaded, session).summary()["force_rmse"] < 0.5
    with pytest.raises(je.imaging.StorageError, match="has no matrix to save; prepare with a linear method"):
        je.save_reconstructor(loaded.recon, folder / "iterative.npz")


@pytest.mark.slow
@pytest.mark.parametrize("noise", [je.imaging.MeasuredNoise(), je.imaging.CorrelatedNoise()], ids=["std", "cov"])
def test_noise_is_measured_before_the_presses(noise, grid, folder):
    """Of 1 uV, white, and steps of 1 uV."""
    imaging = je.Imaging(
        je.Pixels(14), noise=noise, hyperparameter=je.imaging.Discrepancy(factor=100.0)
    )  # of a draft model
    recipe = replace(QUICK, imaging=imaging)
    with calib.open_session(grid) as session:
        made = calib.calibrate([session], recipe=recipe)
    weight = np.asarray(made.recon.whitening.weight)
    deviation = (weight if weight.ndim == 1 else np.diagonal(weight)) ** -0.5
    np.testing.assert_allclose(np.median(deviation), np.hypot(1e-6, 1e-6 / np.sqrt(12)), rtol=0.1)
    assert np.isfinite(made.recon.variance).all()
    assert 1e-3 < float(made.provenance["hyperparameter"]) < 10
    made.save(folder / "noise.h5")
    loaded = calib.load_calibration(folder / "noise.h5")
    np.testing.assert_array_equal(loaded.recon.whitening.weight, weight)
    assert loaded.recipe.imaging == recipe.imaging


def test_what_was_cut_one_way_is_evaluated_that_way(grid, folder):
    processing = calib.presses.Processing(corrections=(calib.presses.LowPass(2.0),), baseline=calib.presses.PreOnly())
    with calib.open_session(grid) as session:
        made = calib.calibrate([session], recipe=replace(QUICK, processing=processing))
        made.save(folder / "processing.h5")
        loaded = calib.load_calibration(folder / "processing.h5")
        assert loaded.processing == processing
        own, other = calib.evaluate(loaded, session), calib.evaluate(loaded, session, calib.presses.Processing())
    assert own.summary() != other.summary()
    old = replace(loaded, provenance={k: v for k, v in loaded.provenance.items() if k != "recipe"})
    assert old.processing == calib.presses.Processing()
    assert old.recipe is None


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ({"curve": "power"}, r"curve: 'power' is not a curve; give an object, such as calib.PowerLaw\(\) \(names are"),
        ({"curve": calib.PowerLaw}, "curve: the class PowerLaw is not a curve"),
        ({"curve": [calib.Linear(), "power"]}, "curve: 'power' is not a curve"),
        ({"curve": None}, "curve: NoneType is not a curve"),
        ({"location": "edge-spline"}, "location: 'edge-spline' is not a field"),
        ({"locator": "fitted"}, "locator: 'fitted' is not a choice of locator"),
        ({"loss": "huber"}, "loss: 'huber' is not a loss"),
        ({"processing": 20.0}, "processing: float is not a processing"),
        ({"imaging": je.Pixels(20)}, r"imaging: Pixels is not an imaging; give an object, such as je.Imaging\("),
        ({"fidelity": "draft"}, r"fidelity: 'draft' is not a fidelity; give an object, such as je.Fidelity.draft\(\)"),
        ({"folds": 2.5}, "folds is 2.5; give a whole number above zero"),
        ({"folds": "5"}, "folds is '5'; give a whole number above zero"),
        ({"folds": True}, "folds is True; give a whole number above zero"),
        ({"even_sheet": "no"}, "even_sheet is 'no'; give True or False"),
    ],
)
def test_what_stands_in_the_place_of_a_choice_is_refused(choices, said):
    with pytest.raises(RecipeError, match=f"recipe: {said}"):
        calib.Recipe(**choices)


def test_a_recipe_in_the_place_of_the_skin_is_told(grid):
    with calib.open_session(grid) as session:
        with pytest.raises(SessionError, match=r"calibrate: .*Recipe.* is not a skin; give one, such as skin="):
            calib.calibrate([session], calib.Recipe())
        with pytest.raises(RecipeError, match=r"calibrate: 'r\.toml' is not a recipe; give one, such as calib\.Recipe"):
            calib.calibrate([session], recipe="r.toml")
        with pytest.raises(SessionError, match="check_session: 'testbed' is not a skin"):
            calib.check_session(session, "testbed")
