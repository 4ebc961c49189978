"""Effects: each against something independent, and the law of absence for all."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import skew

import jaxeit as je
from jaxeit import effects as fx

from ..helpers import compiled, equations, sheet_of, square_model
from ..histories import after

SMALL = [(0.06, 0.06), (0.14, 0.10), (0.10, 0.14), (0.06, 0.12)]
EVERY = [kind() for kind in je.effects.EFFECTS.values()]
IDS = list(je.effects.EFFECTS)
FAMILIES = [thing for name, thing in vars(fx).items() if name.startswith("Abstract") and hasattr(thing, "stage")]
_LAW = (je.effects.ContactPiezoresistance(),)
NEEDS = {je.effects.ContactGain: _LAW, je.effects.ProtrusionGrid: _LAW}  # what acts on the effect's result


@pytest.fixture(scope="module")
def bare():
    return square_model(SMALL, [[0, 1, 2, 3]], 10)


def _with(model, *effects):
    return eqx.tree_at(lambda m: m.effects, model, effects, is_leaf=lambda x: x is model.effects)


def _scene(*effects):
    """The bare sheet with these effects, with room for what they need."""
    return square_model(SMALL, [[0, 1, 2, 3]], 10, effects=effects)


def _with_needs(effect):
    return _scene(effect, *NEEDS.get(type(effect), ()))


def _everything(model, key):
    """One frame of a touch through every stage that reads effects."""
    path = fx.fold(
        model.effects, fx.AbstractStageEffect, fx.Path(jnp.full((1, 2), 0.1), jnp.zeros(1), jnp.ones(1)), key
    )
    spread = je.model.load_spread(model, path.places[0], jnp.asarray(0.02))
    load = _history(model, fx.AbstractMemoryEffect, jnp.array([[0.0], [20.0]]), key)
    voltage = je.forward(model, je.conductivity(model, load[1] * spread, 1.0))
    distance = jnp.full((1, spread.size), 0.02)
    response = fx.fold(model.effects, fx.AbstractPadEffect, jnp.ones_like(distance), distance)
    pads = _history(model, fx.AbstractPneumaticEffect, jnp.outer(load[:, 0], response @ spread), key)
    when = fx.fold(model.effects, fx.AbstractScanEffect, voltage, jnp.abs(voltage))
    frames = jnp.stack([voltage, voltage])
    streams = [(fx.StreamKind.EIT, frames), (fx.StreamKind.PRESSURE, pads), (fx.StreamKind.FORCE, load)]
    recorded = [_history(model, fx.AbstractReadoutEffect, series, key, stream) for stream, series in streams]
    packets = fx.Packets(jnp.arange(2.0), jnp.arange(2.0), jnp.zeros(2, bool))
    return recorded, when, path, fx.fold(model.effects, fx.AbstractClockEffect, packets, key)


def _history(model, family, series, key, stream=None):
    mine = fx.chosen(model.effects, family, stream)
    pattern = model.pattern if stream is fx.StreamKind.EIT else model.pattern[:0]
    line = fx.HistoryInputs(key, jnp.asarray(0.01), jnp.ones(len(series)), jnp.zeros(len(series)), pattern)
    return fx.history(mine, series, fx.history_start(mine, series[0]), line)[0]


def _program():
    """`_everything`, to be compiled, and a list with an entry for each time that it is traced."""
    traces = []

    def run(model, key):
        traces.append(1)
        return _everything(model, key)

    return compiled(run), traces


def _text(run, model):
    return run.lower(model, jax.random.key(0)).compile().compiled.as_text()


@pytest.fixture(scope="module")
def bare_text(bare):
    return _text(_program()[0], bare)


@pytest.fixture(scope="module")
def programs():
    """One for each effect, which the two tests of it share: what is compiled for its text is then called."""
    return {name: _program() for name in IDS}


@pytest.mark.parametrize("effect", EVERY, ids=IDS)
def test_an_effect_is_in_the_program_if_and_only_if_it_is_listed(bare_text, programs, effect):
    name = type(effect).__name__
    assert f"/{name}/" not in bare_text
    assert f"/{name}/" in _text(programs[name][0], _with_needs(effect))


def test_no_effects_leave_no_trace(bare):
    """The program of an empty tuple is that of the bare formulas."""

    def by_hand(model):
        return je.forward(model, model.background)

    with_stages = jax.make_jaxpr(lambda s: je.forward(bare, je.conductivity(bare)))(bare.background)
    plain = jax.make_jaxpr(lambda s: by_hand(bare))(bare.background)
    assert _operations(with_stages.jaxpr) == _operations(plain.jaxpr)


def _operations(jaxpr):
    """All primitives in order, those of called programs included."""
    names = (equation.primitive.name for equation in equations(jaxpr))
    return [name for name in names if name not in ("pjit", "jit")]


@pytest.mark.parametrize("effect", EVERY, ids=IDS)
def test_a_new_parameter_retraces_nothing(programs, effect):
    run, traces = programs[type(effect).__name__]
    key = jax.random.key(0)
    run(_with_needs(effect), key)
    changed = jax.tree.map(lambda leaf: leaf + 1 if eqx.is_array(leaf) else leaf, effect)
    run(_with_needs(changed), key)
    assert len(traces) == 1


def test_every_effect_documents_its_parameters_and_is_public():
    for name, kind in je.effects.EFFECTS.items():
        assert "| meaning" in kind.__doc__
        assert kind.__mro__[1] in FAMILIES
        assert getattr(je.effects, name) is kind


def test_the_cost_of_absent_effects_is_none(bare):
    """By the compiler's own count, what a scene with one effect costs does not depend on the others' existence: the
    bare program costs what the formulas cost."""
    costs = [eqx.filter_jit(f).lower(bare).compile().compiled.cost_analysis()["flops"] for f in (_touched, _by_hand)]
    assert costs[0] == costs[1] > 0


def _touched(model):
    return je.forward(model, je.conductivity(model, model.background))


def _by_hand(model):
    return je.forward(model, model.background)


@pytest.mark.parametrize(("effects", "error"), [((), 0.1), ((je.effects.LoadSpreading(width=0.02),), 2e-3)])
def test_the_load_arrives_whole(model, effects, error):
    """Up to the mesh: an even tip is cut by elements of its own size, a wide Gaussian is resolved."""
    spread = je.model.load_spread(_with(model, *effects), jnp.array([0.1, 0.1]), jnp.asarray(0.04))
    assert float(spread @ model.areas) == pytest.approx(1.0, rel=error)


def test_load_beyond_the_rim_is_lost(model):
    at_corner = je.model.load_spread(
        _with(model, je.effects.LoadSpreading(width=0.02)), jnp.zeros(2), jnp.asarray(0.02)
    )
    assert float(at_corner @ model.areas) == pytest.approx(0.25, rel=0.01)


def test_coating_is_log_normal_and_the_same_on_every_mesh():
    effect = je.effects.CoatingNonUniformity(std=0.2, length=0.01, seed=3)
    x = np.linspace(0, 1, 200)
    places = jnp.asarray(np.stack(np.meshgrid(x, x), -1).reshape(-1, 2))
    ones = jnp.ones(len(places))
    log = np.log(np.asarray(effect(sheet_of(ones, places)).sigma))
    assert log.mean() == pytest.approx(0, abs=0.02)
    assert log.std() == pytest.approx(0.2, rel=0.1)
    assert abs(skew(log)) < 0.3
    subset = effect(sheet_of(ones[:7], places[:7])).sigma
    np.testing.assert_allclose(np.log(subset), log[:7], rtol=1e-9)
    correlation = np.mean(log.reshape(200, 200)[:, 2:] * log.reshape(200, 200)[:, :-2]) / log.var()
    assert correlation == pytest.approx(np.exp(-0.5 * (2 / 199 / 0.01) ** 2), abs=0.1)


def test_effects_laid_on_a_mesh_are_the_same_effects(bare):
    pressure = jnp.linspace(0, 5e4, len(bare.background))
    effects = (je.effects.CoatingNonUniformity(seed=2), je.effects.ContactGain(), je.effects.ContactPiezoresistance())
    laid = fx.laid(effects, bare.centroids)
    found = [je.conductivity(_with(bare, *these), pressure) for these in (effects, laid)]
    np.testing.assert_allclose(*found, rtol=1e-12)
    assert "cos" in str(jax.make_jaxpr(lambda p: je.conductivity(_with(bare, *effects), p))(pressure))
    assert "cos" not in str(jax.make_jaxpr(lambda p: je.conductivity(_with(bare, *laid), p))(pressure))


def test_piezoresistance_follows_hill_and_keeps_its_slope_finite():
    effect = je.effects.ContactPiezoresistance(amplitude=1.0, half_pressure=20e3, exponent=0.7)
    pressure = jnp.array([0.0, 20e3, 1e12])
    sheet = sheet_of(jnp.ones(3), jnp.zeros((3, 2)), pressure)
    np.testing.assert_allclose(effect(sheet).sigma, [1.0, 1.5, 2.0], atol=1e-5)
    slope = jax.grad(lambda p: effect(sheet._replace(pressure=p)).sigma.sum())(pressure)
    assert np.isfinite(np.asarray(slope)).all()


def test_contact_gain_acts_before_the_law_whatever_the_order(bare):
    first = _with(bare, je.effects.ContactGain(seed=1), je.effects.ContactPiezoresistance())
    second = _with(bare, je.effects.ContactPiezoresistance(), je.effects.ContactGain(seed=1))
    pressure = jnp.full_like(bare.background, 1e4)
    np.testing.assert_array_equal(je.conductivity(first, pressure), je.conductivity(second, pressure))
    assert float(jnp.std(je.conductivity(first, pressure))) > 0


def test_pads_share_a_load_by_area(skin, model):
    response = je.pad_response(skin, model)
    even = response @ jnp.full(response.shape[1], 100.0)
    np.testing.assert_allclose(even, 100.0, rtol=1e-2)  # a pressure everywhere is felt as it is
    dipped = je.pad_response(skin, _with(model, je.effects.PadEdgeDip()))
    assert (np.asarray(dipped) <= np.asarray(response)).all()
    middle = je.model.load_spread(
        _with(model, je.effects.LoadSpreading(width=0.004)), jnp.array([0.05, 0.05]), jnp.asarray(0.02)
    )
    assert float((dipped @ middle)[0] / (response @ middle)[0]) > 0.99


def test_readout_effects():
    noisy = after(je.effects.Noise(std=0.1), np.ones((20000, 2)))
    assert noisy.std(0) == pytest.approx(0.1, rel=0.03)
    walk = after(je.effects.BaselineDrift(rate=0.01), np.full((8, 4000), 2.0), interval=4.0, cuts=(4,))
    assert (walk[0] - 2).std() == pytest.approx(0.04, rel=0.05)
    assert (walk[-1] - 2).std() == pytest.approx(0.04 * 8**0.5, rel=0.05)  # the walk goes on over the blocks
    counts = after(je.effects.Quantisation(step=0.5, lowest=0, highest=1), np.array([[-3.0, 0.3, 9.0]]))
    np.testing.assert_array_equal(counts, [[0, 0.5, 1]])


def test_chance_of_one_effect_does_not_depend_on_the_others():
    key, noise, drift = jax.random.key(3), je.effects.Noise(), je.effects.BaselineDrift()
    alone, first, second = fx.keys([noise], key), fx.keys([drift, noise], key), fx.keys([noise, noise], key)
    assert alone[0] == first[1] == second[0]
    assert second[0] != second[1]


SIGNED = {"skew", "coefficient", "gain", "nonlinearity", "lowest", "highest"}
"""Parameters that may be below zero; the offset of a clock may be too, that of sensors is a scatter."""


@pytest.mark.parametrize("effect", EVERY, ids=IDS)
def test_an_effect_refuses_a_negative_scatter_length_or_time(effect):
    kind = type(effect)
    for field in dataclasses.fields(effect):
        value = getattr(effect, field.name)
        if not isinstance(value, jax.Array):
            continue
        if field.name in SIGNED or (kind is fx.ClockError and field.name == "offset"):
            kind(**{field.name: -1e-3 * jnp.ones_like(value)})
            continue
        for wrong in (-jnp.ones_like(value), np.full(value.shape, np.nan)):
            if value.dtype.kind == "f" or not np.isnan(wrong).any():
                with pytest.raises(
                    je.effects.EffectError,
                    match=f"{kind.__name__}: {field.name} is (-1|nan)( m| s|); give (at least|more than|[01] to) ",
                ):
                    kind(**{field.name: wrong})


# Well formed, but the law has no value there or turns what it acts on into infinite numbers or none.
ABSURD = {
    "CoatingNonUniformity": {"std": 99.0},
    "ContactGain": {"length": 0.0},
    "ContactPiezoresistance": {"half_pressure": 0.0},
    "HomogenisedIslands": {"fraction": 99.0},
    "ContinuousCoating": {"resistance": 0.0},
    "ProtrusionGrid": {"side": 7e-3},
    "SheetTemperature": {"coefficient": -1.0},
    "Hysteresis": {"reach": 1.0},
    "Creep": {"onset": 0.0},
    "LoadSpreading": {"width": 0.0},
    "PadEdgeDip": {"width": 0.0},
    "PadCrosstalk": {"fraction": 2.0},
    "GasLaw": {"pressure": 0.0},
    "GasRelaxation": {"gas_share": 1.5},
    "TpuRelaxation": {"shares": [0.1, 0.2]},
    "ElectrodeFault": {"electrode": []},
    "Noise": {"std": np.inf},
    "Quantisation": {"lowest": 1.0, "highest": 1.0},
    "AdcRanges": {"gains": []},
    "DropOut": {"probability": 1.5},
    "ClockError": {"skew": -1.0},
}


@pytest.mark.parametrize("name", ABSURD)
def test_an_effect_refuses_what_cannot_be(name):
    given = {key: np.asarray(value) for key, value in ABSURD[name].items()}
    with pytest.raises(je.effects.EffectError, match=f"{name}: {next(iter(given))} is .*; give "):
        je.effects.EFFECTS[name](**given)


@pytest.mark.parametrize("name", ["offset", "latency", "jitter", "batch"])
def test_a_clock_that_errs_by_more_than_nanoseconds_hold_is_refused(name):
    with pytest.raises(je.effects.EffectError, match=rf"ClockError: {name} is 1e\+12 s; give "):
        fx.ClockError(**{name: 1e12})


def test_maxwell_elements_that_carry_nothing_are_refused():
    with pytest.raises(je.effects.EffectError, match="as many shares as times, with a sum below 1"):
        je.effects.TpuRelaxation(shares=jnp.array([0.5, 0.3, 0.2]))


def test_a_scene_file_refuses_a_negative_scatter():
    table = je.toml.TomlTable({"effects": [{"type": "Noise", "std": -1.0}]}, "scene.toml")
    with pytest.raises(ValueError, match="Noise: std is -1; give at least 0"):
        je.model.read_effects(table)


def test_hidden_values_are_not_examined():
    slope = jax.grad(lambda std: 2 * je.effects.Noise(std=std).std)
    assert slope(-1.0) == 2.0


def test_an_object_in_the_place_of_another_is_named(skin):
    with pytest.raises(je.model.SceneError, match=r"'testbed' is not a skin; make one, such as jaxeit.load_skin"):
        je.Scene("testbed")
    with pytest.raises(je.model.SceneError, match=r"Skin is not a scene; make one, such as jaxeit.Scene\(skin"):
        je.discretise(skin)
    with pytest.raises(je.model.FidelityError, match=r"str is not a fidelity; make one, such as jaxeit.Fidelity.draft"):
        je.discretise(je.Scene(skin), "draft")
    for wrong in (
        je.forward,
        je.jacobian,
        je.prepare,
        je.model.electrode_motion,
        lambda scene: je.imaging.fit_reference(scene, []),
        lambda scene: je.imaging.segment(scene, [], []),
        lambda scene: je.prepare_contacts(scene, noise=1.0),
        lambda scene: je.contacts.prepare_loads(scene, noise=1.0),
        lambda scene: je.tracking.prepare_tracker(scene, skin, noise=1.0),
    ):
        with pytest.raises(je.model.SceneError, match=r"Scene is not a model; make one, such as jaxeit.discretise\("):
            wrong(je.Scene(skin))


def test_scenes_refuse_what_is_not_an_effect(skin):
    with pytest.raises(ValueError, match="not an effect"):
        je.Scene(skin, effects=("noise",))
    with pytest.raises(ValueError, match="tuple"):
        je.Scene(skin, effects=je.effects.LoadSpreading())
    with pytest.raises(ValueError, match="LoadSpreading and IndentationSpreading both say how a load spreads"):
        je.Scene(skin, effects=(je.effects.LoadSpreading(), je.effects.IndentationSpreading()))
    with pytest.raises(ValueError, match="ElectrodeFault: no electrode 25; the skin has 0 to 24"):
        je.Scene(skin, effects=(je.effects.ElectrodeFault(electrode=25),))


class Labelled(je.effects.AbstractSheetEffect):
    label: str

    def __call__(self, sheet):
        return sheet


def test_a_field_that_jax_cannot_compute_with_is_named(skin):
    with pytest.raises(je.model.SceneError, match=r"Labelled: label is 'dry', and not a number; write the field as"):
        je.Scene(skin, effects=(Labelled("dry"),))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"type": "LoadSpreding"}, "did you mean 'LoadSpreading'"),
        ({"type": "LoadSpreading", "widht": 1.0}, "widht: unknown key; did you mean 'width'"),
        ({"type": "Noise", "stream": "eeg"}, 'give one of "eit"'),
        ({"type": "Noise"}, "std: Noise has no usual value of it; set it in the unit of its stream"),
        ({"type": "PinkNoise", "stream": "force"}, "amplitude: PinkNoise has no usual value"),
        ({"type": "Quantisation"}, "step: Quantisation has no usual value"),
        ({"width": 1.0}, "type: missing"),
        ({"type": "AdcRanges", "gains": 2.0}, "gains: is 2.0; give "),
        ({"type": "LoadSpreading", "width": 8.0}, "width is 8 m; give more than 0 to 1 m"),
        ({"type": "ElectrodeFault", "electrode": 1.5}, "electrode: is 1.5; give a whole number"),
    ],
)
def test_effects_in_a_scene_file(table, message):
    with pytest.raises(je.toml.TomlError, match=message):
        je.model.read_effects(je.toml.TomlTable({"effects": [table]}, "scene.toml"))


def test_effects_of_many_numbers_in_a_scene_file():
    table = {"type": "TpuRelaxation", "shares": [0.2], "times": [3.0]}
    (effect,) = je.model.read_effects(je.toml.TomlTable({"effects": [table]}, "scene.toml"))
    assert effect.shares.shape == effect.times.shape == (1,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda sheet: sheet.sigma, "Wrong returns an array; return the Sheet that it is given, changed by _replace"),
        (lambda sheet: None, "Wrong returns NoneType; return the Sheet"),
        (
            lambda sheet: sheet._replace(sigma=sheet.sigma[:3]),
            r"Wrong returns Sheet.sigma of shape \(3,\); it must stay",
        ),
        (
            lambda sheet: sheet._replace(sigma=sheet.sigma.astype(jnp.float32)),
            "Wrong returns Sheet.sigma in float32; it must stay float64",
        ),
    ],
)
def test_an_effect_returns_what_it_is_given(model, change, message):
    class Wrong(fx.AbstractSheetEffect):
        def __call__(self, sheet):
            return change(sheet)

    wrong = dataclasses.replace(model, effects=(Wrong(),))
    with pytest.raises(fx.EffectError, match=message):
        je.conductivity(wrong, jnp.ones_like(model.background))
