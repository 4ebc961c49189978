"""Effects: each against something independent, and the law of absence for all."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import skew

import jaxeit as je
from jaxeit.effects import AbstractLoadEffect, AbstractPadEffect, AbstractSheetEffect, Sheet

from .helpers import square_model

SMALL = [(0.06, 0.06), (0.14, 0.10), (0.10, 0.14), (0.06, 0.12)]
EVERY = [kind() for kind in je.EFFECTS.values()]
IDS = list(je.EFFECTS)
NEEDS = {je.ContactGain: (je.ContactPiezoresistance(),)}  # what acts on the effect's result


@pytest.fixture(scope="module")
def bare():
    return square_model(SMALL, [[0, 1, 2, 3]], 10)


def _with(model, *effects):
    return eqx.tree_at(lambda m: m.effects, model, effects, is_leaf=lambda x: x is model.effects)


def _everything(model, key):
    """One frame of a touch through every stage that reads effects."""
    spread = je.load_spread(model, jnp.array([0.1, 0.1]), jnp.asarray(0.02))
    voltage = je.forward(model, je.conductivity(model, 20 * spread))
    distance = jnp.full((1, spread.size), 0.02)
    pads = je.fold(model.effects, AbstractPadEffect, jnp.ones_like(distance), distance)
    series = je.fold(model.effects, je.AbstractReadoutEffect, voltage[None], key, jnp.asarray(0.01))
    return series, pads, spread


def _program(model):
    return eqx.filter_jit(_everything).lower(model, jax.random.key(0)).compile().compiled.as_text()


@pytest.fixture(scope="module")
def bare_program(bare):
    return _program(bare)


@pytest.mark.parametrize("effect", EVERY, ids=IDS)
def test_an_effect_is_in_the_program_if_and_only_if_it_is_listed(bare, bare_program, effect):
    name, others = type(effect).__name__, NEEDS.get(type(effect), ())
    assert f"/{name}/" not in bare_program
    assert f"/{name}/" in _program(_with(bare, effect, *others))


def test_no_effects_leave_no_trace(bare):
    """The program of an empty tuple is that of the bare formulas."""

    def by_hand(model):
        return je.forward(model, model.background)

    with_stages = jax.make_jaxpr(lambda s: je.forward(bare, je.conductivity(bare)))(bare.background)
    plain = jax.make_jaxpr(lambda s: by_hand(bare))(bare.background)
    assert _operations(with_stages.jaxpr) == _operations(plain.jaxpr)


def _operations(jaxpr):
    """All primitives in order, those of called programs included."""
    out = []
    for equation in jaxpr.eqns:
        inner = [v for v in equation.params.values() if hasattr(v, "jaxpr") or hasattr(v, "eqns")]
        if equation.primitive.name not in ("pjit", "jit"):
            out.append(equation.primitive.name)
        for value in inner:
            out += _operations(getattr(value, "jaxpr", value))
    return out


@pytest.mark.parametrize("effect", EVERY, ids=IDS)
def test_a_new_parameter_retraces_nothing(bare, effect):
    traces = []

    @eqx.filter_jit
    def run(model, key):
        traces.append(1)
        return _everything(model, key)

    key = jax.random.key(0)
    run(_with(bare, effect), key)
    changed = jax.tree.map(lambda leaf: leaf + 1 if eqx.is_array(leaf) else leaf, effect)
    run(_with(bare, changed), key)
    assert len(traces) == 1


def test_every_effect_documents_its_parameters():
    for kind in je.EFFECTS.values():
        assert "| meaning" in kind.__doc__
        assert kind.__mro__[1] in (
            AbstractLoadEffect, AbstractSheetEffect, AbstractPadEffect, je.AbstractReadoutEffect
        )  # fmt: skip


@pytest.mark.parametrize(("effects", "error"), [((), 0.1), ((je.LoadSpreading(width=0.02),), 2e-3)])
def test_the_load_arrives_whole(model, effects, error):
    """Up to the mesh: an even tip is cut by elements of its own size, a wide Gaussian is resolved."""
    spread = je.load_spread(_with(model, *effects), jnp.array([0.1, 0.1]), jnp.asarray(0.04))
    assert float(spread @ model.areas) == pytest.approx(1.0, rel=error)


def test_load_beyond_the_rim_is_lost(model):
    at_corner = je.load_spread(_with(model, je.LoadSpreading(width=0.02)), jnp.zeros(2), jnp.asarray(0.02))
    assert float(at_corner @ model.areas) == pytest.approx(0.25, rel=0.01)


def test_coating_is_log_normal_and_the_same_on_every_mesh():
    effect = je.CoatingNonUniformity(std=0.2, length=0.01, seed=3)
    x = np.linspace(0, 1, 200)
    places = jnp.asarray(np.stack(np.meshgrid(x, x), -1).reshape(-1, 2))
    ones = jnp.ones(len(places))
    log = np.log(np.asarray(effect(Sheet(ones, 0 * ones, places)).sigma))
    assert log.mean() == pytest.approx(0, abs=0.02)
    assert log.std() == pytest.approx(0.2, rel=0.1)
    assert abs(skew(log)) < 0.3
    subset = effect(Sheet(ones[:7], 0 * ones[:7], places[:7])).sigma
    np.testing.assert_allclose(np.log(subset), log[:7], rtol=1e-9)
    correlation = np.mean(log.reshape(200, 200)[:, 2:] * log.reshape(200, 200)[:, :-2]) / log.var()
    assert correlation == pytest.approx(np.exp(-0.5 * (2 / 199 / 0.01) ** 2), abs=0.1)


def test_piezoresistance_follows_hill_and_keeps_its_slope_finite():
    effect = je.ContactPiezoresistance(amplitude=1.0, half_pressure=20e3, exponent=0.7)
    pressure = jnp.array([0.0, 20e3, 1e12])
    sheet = Sheet(jnp.ones(3), pressure, jnp.zeros((3, 2)))
    np.testing.assert_allclose(effect(sheet).sigma, [1.0, 1.5, 2.0], atol=1e-5)
    slope = jax.grad(lambda p: effect(sheet._replace(pressure=p)).sigma.sum())(pressure)
    assert np.isfinite(np.asarray(slope)).all()


def test_contact_gain_acts_before_the_law_whatever_the_order(bare):
    first = _with(bare, je.ContactGain(seed=1), je.ContactPiezoresistance())
    second = _with(bare, je.ContactPiezoresistance(), je.ContactGain(seed=1))
    pressure = jnp.full_like(bare.background, 1e4)
    np.testing.assert_array_equal(je.conductivity(first, pressure), je.conductivity(second, pressure))
    assert float(jnp.std(je.conductivity(first, pressure))) > 0


def test_pads_share_a_load_by_area(skin, model):
    response = je.pad_response(skin, model)
    even = response @ jnp.full(response.shape[1], 100.0)
    np.testing.assert_allclose(even, 100.0, rtol=1e-2)  # a pressure everywhere is felt as it is
    dipped = je.pad_response(skin, _with(model, je.PadEdgeDip()))
    assert (np.asarray(dipped) <= np.asarray(response)).all()
    middle = je.load_spread(_with(model, je.LoadSpreading(width=0.004)), jnp.array([0.05, 0.05]), jnp.asarray(0.02))
    assert float((dipped @ middle)[0] / (response @ middle)[0]) > 0.99


def test_readout_effects():
    key, interval = jax.random.key(0), jnp.asarray(0.01)
    flat = jnp.ones((20000, 2))
    noisy = np.asarray(je.Noise(std=0.1)(flat, key, interval))
    assert noisy.std(0) == pytest.approx(0.1, rel=0.03)
    walk = np.asarray(je.BaselineDrift(rate=0.01)(jnp.ones((1, 4000)), key, jnp.asarray(4.0)))
    assert (walk - 1).std() == pytest.approx(0.02, rel=0.05)
    counts = np.asarray(je.Quantisation(step=0.5, lowest=0, highest=1)(jnp.array([[-3.0, 0.3, 9.0]]), key, interval))
    np.testing.assert_array_equal(counts, [[0, 0.5, 1]])


def test_scenes_refuse_what_is_not_an_effect(skin):
    with pytest.raises(ValueError, match="not an effect"):
        je.Scene(skin, effects=("noise",))
    with pytest.raises(ValueError, match="tuple"):
        je.Scene(skin, effects=je.LoadSpreading())


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"type": "LoadSpreding"}, "did you mean 'LoadSpreading'"),
        ({"type": "LoadSpreading", "widht": 1.0}, "widht: unknown key; did you mean 'width'"),
        ({"type": "Noise", "stream": "eeg"}, 'give one of "eit"'),
        ({"width": 1.0}, "type: missing"),
    ],
)
def test_effects_in_a_scene_file(table, message):
    with pytest.raises(je.TomlError, match=message):
        je.read_effects(je.TomlTable({"effects": [table]}, "scene.toml"))
