"""Mechanics and material: each effect against a closed form, a limit or a brute-force model."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import dblquad
from scipy.optimize import curve_fit

import jaxeit as je
from jaxeit import effects as fx

from ..oracles.cell import covered, effective_conductivity

RADIUS = 10e-3
PRESSURES = np.array([0.0, 10e3, 64e3, 200e3])


@jax.jit
def _pressed(effect, x):
    """Pressure over the mean pressure of the tip, at places along x."""
    places = jnp.stack([x, jnp.zeros_like(x)], 1)
    touch = fx.Indenter(jnp.zeros(2, x.dtype), jnp.asarray(2 * RADIUS, x.dtype))
    return effect(jnp.zeros_like(x), touch, places) * jnp.pi * RADIUS**2


def _sheet(pressure=PRESSURES, size=1e-3, temperature=0.0, sigma=1 / 150):
    even = partial(jnp.full, len(pressure), dtype=pressure.dtype)
    places, warmer = jnp.zeros((len(pressure), 2), pressure.dtype), jnp.asarray(temperature, pressure.dtype)
    return fx.Sheet(even(sigma), pressure, places, even(size), warmer)


@jax.jit
def _after(effects, sheet):
    return fx.fold(effects, fx.AbstractSheetEffect, sheet)


def _ratio(effects, sheet):
    return np.asarray(_after(effects, sheet).sigma) / np.asarray(sheet.sigma)


def _line(interval):
    none = jnp.zeros(0)
    return fx.HistoryInputs(jax.random.key(0), jnp.asarray(interval), none, none, jnp.zeros((0, 4), int))


@partial(jax.jit, static_argnames="blocks")
def _felt(effect, load, interval=0.01, blocks=1):
    """The load of one contact after the effect, in blocks; at rest there is none."""
    state, out = effect.start(jnp.zeros(1, load.dtype)), []
    for part in jnp.split(load[:, None], blocks):
        part, state = effect(part, state, _line(interval))
        out.append(part)
    return jnp.concatenate(out)[:, 0]


def _wandering(samples=400):
    """A load that rises and falls in its own way, with contact lost in between."""
    walk = np.cumsum(np.random.default_rng(0).normal(size=samples)) + 5 * np.sin(np.arange(samples) / 15)
    return jnp.asarray(np.maximum(walk, 0.0))


def test_stage_errors_have_the_sizes_given_and_none_at_zero():
    follow = jax.jit(lambda effect: effect(plan, jax.random.key(1)))
    plan = fx.Path(jnp.full((4000, 2), 0.1), jnp.zeros(4000), jnp.ones(4000))
    went = follow(je.effects.StageError(position=1e-3, jitter=5e-3, ripple=0.1))
    errors = [*(np.asarray(went.places).T - 0.1), np.asarray(went.delay), np.log(went.pace)]
    np.testing.assert_allclose(np.std(errors, 1), [1e-3, 1e-3, 5e-3, 0.1], rtol=0.05)
    np.testing.assert_allclose(np.corrcoef(errors), np.eye(4), atol=0.06)
    still = follow(je.effects.StageError(position=0.0, jitter=0.0, ripple=0.0))
    assert all(np.array_equal(a, b) for a, b in zip(plan, still, strict=True))


def _boussinesq(r, z):
    """The point solution integrated over the tip; pressure over that of the tip."""

    def point(t, s):
        square = r**2 + s**2 - 2 * r * s * np.cos(t) + z**2
        return 3 * z**3 / (2 * np.pi * square**2.5) * s

    return dblquad(point, 0, RADIUS, 0, 2 * np.pi)[0]


@pytest.mark.parametrize(("depth", "error"), [(2e-3, 5e-6), (10e-3, 1e-10)])
def test_indentation_is_boussinesq_on_and_off_the_axis(depth, error):
    x = np.array([0.0, 4e-3, 10e-3, 13e-3, 30e-3])
    pressed = _pressed(je.effects.IndentationSpreading(depth=depth), jnp.asarray(x))
    np.testing.assert_allclose(pressed, [_boussinesq(r, depth) for r in x], atol=error)
    assert float(pressed[0]) == pytest.approx(1 - (1 + (RADIUS / depth) ** 2) ** -1.5, abs=1e-12)


def test_indentation_carries_its_load_and_is_the_even_tip_at_no_depth():
    r = np.linspace(0, 5.0, 200001)  # the tail beyond holds (z / r)^3
    pressed = np.asarray(_pressed(je.effects.IndentationSpreading(), jnp.asarray(r)))
    assert np.trapezoid(2 * r * pressed, r) / RADIUS**2 == pytest.approx(1, abs=1e-5)
    even = _pressed(je.effects.IndentationSpreading(depth=0.0), jnp.array([0.0, 4e-3, 8e-3, 12e-3, 30e-3]))
    np.testing.assert_allclose(even, [1, 1, 1, 0, 0], atol=1e-5)


@pytest.mark.parametrize(("depth", "width"), [(2e-3, 7.15e-3), (5e-3, 7.36e-3), (10e-3, 8.46e-3), (15e-3, 10.21e-3)])
def test_widths_of_gaussians_fitted_to_indentation(depth, width):
    r = np.linspace(0, 60e-3, 601)
    pressed = np.asarray(_pressed(je.effects.IndentationSpreading(depth=depth), jnp.asarray(r)))
    fitted, _ = curve_fit(lambda r, a, s: a * np.exp(-0.5 * (r / s) ** 2), r, pressed, (0.5, 9e-3))
    assert fitted[1] == pytest.approx(width, abs=2e-5)


def test_indentation_has_slopes_everywhere():
    @jax.jit
    def at(centre):
        touch = fx.Indenter(centre, jnp.asarray(2 * RADIUS))
        return je.effects.IndentationSpreading()(jnp.zeros(2), touch, jnp.array([[0.0, 0.0], [5e-3, 0.0]]))

    slope = np.asarray(jax.jit(jax.jacobian(at))(np.zeros(2)))
    step = np.asarray(at(np.array([1e-6, 0.0])) - at(np.array([-1e-6, 0.0]))) / 2e-6
    np.testing.assert_allclose(slope[:, 0], step, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(slope[:, 1], 0, atol=1e-9)


@pytest.mark.parametrize("pressure", [10e3, 64e3, 200e3])
@pytest.mark.parametrize("fraction", [0.2, 1 / 3])
def test_islands_are_those_of_a_resolved_lattice(fraction, pressure):
    radius, sigma = 2e-3, 1 / 150
    width = radius * np.sqrt(np.pi / fraction) / 2
    disc = covered(width, 100, lambda x, y: x**2 + y**2 < radius**2)
    resolved = effective_conductivity(width, np.full_like(disc, sigma), disc * pressure / 64e3 / 1.6e-5) / sigma
    homogenised = _ratio([je.effects.HomogenisedIslands(fraction=fraction)], _sheet(np.array([pressure])))
    assert homogenised[0] == pytest.approx(resolved, abs=4e-3)  # of which a quarter is the lattice's own mesh


def test_islands_of_the_paper_end_at_twice_and_begin_at_nothing():
    rises = _ratio([je.effects.HomogenisedIslands()], _sheet(np.array([0.0, 10e3, 64e3, 200e3, 1e15]))) - 1
    np.testing.assert_allclose(rises, [0, 0.286, 0.610, 0.757, 1], atol=6e-4)
    assert rises[0] == 0
    assert np.all(_ratio([je.effects.HomogenisedIslands(fraction=0.0)], _sheet()) == 1)


def test_islands_follow_the_bessel_ratio_through_the_change_of_formula():
    """Slopes agree with differences where the continued fraction gives way to Bessel functions, and start at zero."""
    effect = je.effects.HomogenisedIslands()
    turn = float(64e3 * 1.6e-5 / 150 / 4e-6)  # k = 1

    @jax.jit
    @jax.vmap
    @jax.value_and_grad
    def rise(p):
        return effect(_sheet(p[None])).sigma[0] * 150

    values, slopes = rise(turn * (1 + np.array([-1e-3, -1e-9, 1e-9, 1e-3])))
    assert abs(values[1] - values[2]) < 1e-8
    assert float(slopes[1]) == pytest.approx(float(slopes[2]), rel=1e-7)
    assert float(slopes[1]) == pytest.approx(float(values[3] - values[0]) / (0.002 * turn), rel=1e-5)


def test_islands_come_after_the_coating_whatever_the_order():
    effects = [je.effects.CoatingNonUniformity(seed=2), je.effects.HomogenisedIslands()]
    sheet = _sheet()._replace(centroids=np.linspace(0, 0.1, 8).reshape(4, 2))
    np.testing.assert_array_equal(_ratio(effects, sheet), _ratio(effects[::-1], sheet))


@pytest.mark.parametrize("pressure", [3e3, 20e3, 200e3])
def test_coarse_elements_see_the_lattice_of_protrusions(pressure):
    """The law on elements larger than the pitch is that of a resolved cell, not that of the mean pressure."""
    grid, law = je.effects.ProtrusionGrid(), je.effects.ContactPiezoresistance()
    square = covered(3e-3, 48, lambda x, y: (x < 1.75e-3) & (y < 1.75e-3))
    local = pressure * (6 / 3.5) ** 2 / 20e3
    resolved = effective_conductivity(3e-3, 1 + square * local / (1 + local), np.zeros_like(square))
    coarse = _ratio([law, grid], _sheet(np.array([pressure]), size=60e-3))[0]
    assert coarse == pytest.approx(resolved, abs=2e-3)
    assert abs(_ratio([law], _sheet(np.array([pressure])))[0] - resolved) > 0.03


def test_protrusions_keep_the_load_on_any_mesh():
    """Squares of 0.5 mm and of 7 mm: the load and the share of the sheet that bears it are those of the lattice."""
    for cells in (84, 6):
        size = 0.042 / cells
        x = (np.arange(cells) + 0.5) * size
        places = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)
        sheet = _sheet(np.full(len(places), 1e3), size)._replace(centroids=places)
        pressed = _after([je.effects.ProtrusionGrid()], sheet)
        assert np.mean(pressed.share * pressed.pressure) == pytest.approx(1e3, rel=1e-9)
        assert np.mean(pressed.share) == pytest.approx((3.5 / 6) ** 2, rel=1e-9)
    fine = _after(
        [je.effects.ProtrusionGrid()], _sheet(np.ones(2))._replace(centroids=np.array([[3e-3, 9e-3], [6e-3, 3e-3]]))
    )
    np.testing.assert_allclose(fine.share, [1, 0], atol=1e-12)  # the middle of a cell, and its edge


def test_protrusions_that_touch_are_the_whole_sheet():
    effects = [je.effects.ContactPiezoresistance(), je.effects.ProtrusionGrid(side=6e-3)]
    np.testing.assert_allclose(_ratio(effects, _sheet()), _ratio(effects[:1], _sheet()), rtol=1e-12)


def test_a_warm_sheet_resists_more():
    warm = _ratio([je.effects.SheetTemperature(coefficient=2e-3)], _sheet(temperature=10.0))
    np.testing.assert_allclose(warm, 1 / 1.02, rtol=1e-12)
    assert np.all(_ratio([je.effects.SheetTemperature(coefficient=0.0)], _sheet(temperature=10.0)) == 1)
    assert np.all(_ratio([je.effects.SheetTemperature()], _sheet()) == 1)


def test_creep_after_a_step_is_logarithmic():
    load = jnp.zeros(3001).at[1:].set(20.0)
    felt = np.asarray(_felt(je.effects.Creep(rate=0.05, onset=0.1), load))[1:]
    np.testing.assert_allclose(felt, 20 * (1 + 0.05 * np.log10(1 + np.arange(3000) * 0.01 / 0.1)), rtol=1e-12)


def test_age_of_a_contact_by_brute_force():
    """Each newton remembers when it came; what is lifted is taken from all alike."""
    load = np.asarray(_wandering(200))
    born, sizes, ages = [], np.zeros(0), []
    for now, (before, after) in enumerate(zip([0.0, *load], load, strict=False)):
        if after > before:
            born, sizes = [*born, now], np.append(sizes, after - before)
        else:
            sizes = sizes * (after / before if before > 0 else 0.0)
        ages.append(np.sum(sizes * (now - np.array(born))) / after if after > 0 else 0.0)
    onset = 0.03
    felt = _felt(je.effects.Creep(rate=0.1, onset=onset), jnp.asarray(load))
    np.testing.assert_allclose(felt, load * (1 + 0.1 * np.log10(1 + 0.01 * np.array(ages) / onset)), rtol=1e-9)


def test_creep_of_a_ramp_does_not_depend_on_the_rate_of_samples():
    """The mean age under a ramp is half its duration."""
    for samples in (100, 1000):
        load = jnp.arange(1.0, samples + 1) * 20.0 / samples
        last = float(_felt(je.effects.Creep(), load, 1 / samples)[-1])
        assert last == pytest.approx(20 * (1 + 0.05 * np.log10(1 + 0.5 / 0.1)), rel=1e-3)


def _plays(log_load, loop, reach, plays=8):
    """The Prandtl-Ishlinskii model in its textbook form, on logarithms, each play by its own definition."""
    radii = np.log(reach) * np.arange(1, plays + 1) / plays / 2
    weights = np.full(plays, np.log1p(loop) / (2 * radii.sum()))
    out, play = np.empty_like(log_load), np.full(plays, -np.inf)
    for k, u in enumerate(log_load):
        play = np.maximum(u - radii, np.minimum(u + radii, play))
        out[k] = (1 - weights.sum()) * u + weights @ (play + radii)
    return out, radii, weights


def _inverse(series, radii, weights):
    """The closed-form inverse of w0 u + sum of w_i play_i[u] (Krejci and Kuhnen 2001), itself such a sum."""
    first = 1 - weights.sum()
    below = first + np.concatenate([[0], np.cumsum(weights)])
    r = np.array([first * radii[i] + weights[:i] @ (radii[i] - radii[:i]) for i in range(len(radii))])
    w = -weights / (below[1:] * below[:-1])
    out, play = np.empty_like(series), np.full(len(radii), -np.inf)
    for k, y in enumerate(series):
        play = np.maximum(y - r, np.minimum(y + r, play))
        out[k] = y / first + w @ play
    return out


def test_hysteresis_is_the_textbook_sum_and_its_inverse_undoes_it():
    load = np.asarray(_wandering()) + 0.1
    felt = np.log(np.asarray(_felt(je.effects.Hysteresis(loop=0.2, reach=3.0), jnp.asarray(load))))
    brute, radii, weights = _plays(np.log(load), 0.2, 3.0)
    np.testing.assert_allclose(felt, brute, atol=1e-12)
    undone = _inverse(felt - weights @ radii, radii, weights)
    np.testing.assert_allclose(undone, np.log(load), atol=1e-12)
    assert np.max(np.abs(felt - np.log(load))) > 0.1  # there was something to undo


def test_hysteresis_opens_the_loop_given_and_closes_it_at_no_load():
    up = jnp.linspace(0, 20, 201)
    felt = np.asarray(_felt(je.effects.Hysteresis(loop=0.1, reach=4.0), jnp.concatenate([up, up[::-1], up])))
    rising, falling, again = np.split(felt, 3)
    np.testing.assert_array_equal(rising, up)
    assert falling[-1] == 0
    np.testing.assert_allclose(falling[-51:-1] / up[50:0:-1], 1.1, rtol=1e-12)  # below a quarter of the peak
    assert np.all(falling[:-1] >= up[:0:-1])
    np.testing.assert_allclose(again, up, rtol=1e-12)  # contact was lost: the next is as the first


def test_hysteresis_knows_no_rate():
    slow, fast = jnp.repeat(_wandering(), 5), _wandering()
    effect = je.effects.Hysteresis()
    np.testing.assert_allclose(_felt(effect, slow, 1.0)[::5], _felt(effect, fast, 0.01), rtol=1e-12)


@pytest.mark.parametrize(
    "effect", [je.effects.Creep(), je.effects.Hysteresis(), je.effects.Hysteresis(loop=0.24, reach=50.0)]
)
def test_memories_leave_nothing_at_no_load_and_are_the_same_in_blocks(effect):
    load = _wandering()
    whole = np.asarray(_felt(effect, load))
    np.testing.assert_allclose(whole, _felt(effect, load, blocks=8), rtol=1e-13)
    none = np.asarray(load) == 0
    assert none.sum() > 20
    assert np.all(whole[none] == 0)
    assert np.all(whole >= np.asarray(load))


@pytest.mark.parametrize("effect", [je.effects.Creep(rate=0.0), je.effects.Hysteresis(loop=0.0)])
def test_memories_of_nothing_change_nothing(effect):
    np.testing.assert_array_equal(_felt(effect, _wandering()), _wandering())


@pytest.mark.parametrize("effect", [je.effects.Creep(), je.effects.Hysteresis()])
def test_memories_have_slopes_and_batches(effect):
    load = _wandering(100).at[40:50].set(0.0).at[60:70].set(3.0)  # lost, and held: the kinks
    slopes = jax.jit(jax.grad(lambda effect, load: _felt(effect, load).sum(), argnums=(0, 1)))(effect, load)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(slopes))
    batch = jax.vmap(lambda s: _felt(effect, s * load))(jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(batch[1], _felt(effect, 2 * load), rtol=1e-13)


@pytest.mark.parametrize(
    "effect", [je.effects.HomogenisedIslands(), je.effects.ProtrusionGrid(), je.effects.SheetTemperature()]
)
def test_sheets_have_slopes_where_nothing_presses(effect):
    def total(effect, pressure):
        sheet = effect(_sheet(pressure, temperature=1.0))
        return jnp.sum(sheet.sigma) + jnp.sum(sheet.pressure) + (0 if sheet.share is None else jnp.sum(sheet.share))

    slopes = jax.jit(jax.grad(total, argnums=(0, 1)))(effect, PRESSURES)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(slopes))


def test_single_precision_stays_single():
    single = jnp.float32
    for effect in (je.effects.Creep(), je.effects.Hysteresis()):
        assert _felt(effect, _wandering(20).astype(single)).dtype == single
    laws = [je.effects.HomogenisedIslands(), je.effects.ProtrusionGrid(), je.effects.SheetTemperature()]
    sheet = _after(laws, _sheet(PRESSURES.astype(single)))
    assert sheet.sigma.dtype == sheet.share.dtype == sheet.pressure.dtype == single
    exact = _after(laws, _sheet())
    np.testing.assert_allclose(sheet.sigma, exact.sigma, rtol=1e-6)
    assert _pressed(je.effects.IndentationSpreading(), jnp.zeros(1, single)).dtype == single
