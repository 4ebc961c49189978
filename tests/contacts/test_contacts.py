"""Contacts: found where they are, with honest error bars, and not where there are none."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom

import jaxeit as je
from jaxeit.contacts import ContactResult, ContactSettings, prepare_contacts, refine_contacts, search, strongest
from jaxeit.contacts.bump_responses import quadrature_points, table_nodes, tabulate
from jaxeit.imaging.inputs import InverseError

from ..helpers import spread_stacks

STD = 1e-5  # V: a signal-to-noise ratio of 60 dB
FRAMES = 300


@pytest.fixture(scope="module")
def finder(model):
    return prepare_contacts(model, ContactSettings(most=2, false_alarm=0.05), noise=np.full(550, STD))


@pytest.fixture(scope="module")
def other(skin):
    """Another mesh to simulate with."""
    return je.discretise(je.Scene(skin), je.Fidelity(edge_length=0.04))


def _find(finder, *frames):
    """Contacts of each frame, by the one program of `FRAMES` frames that all tests share."""
    padded = np.zeros((FRAMES, 550))
    padded[: len(frames)] = frames
    found = finder(padded)
    return [jax.tree.map(lambda a, i=i: a[i], found) for i in range(len(frames))]


def _bump(model, centre, width):
    square = jnp.sum((model.centroids - jnp.asarray(centre)) ** 2, -1)
    return jnp.exp(-0.5 * square / width**2)


def _touched(model, relative):
    return np.asarray(je.forward(model, model.background * (1 + relative)) - je.forward(model))


def _noise(*shape, seed=0):
    return STD * np.random.default_rng(seed).standard_normal((*shape, 550))


def _means(model, centre, width, splits=16):
    """Means of a bump over the elements, by many points: independent of the rule in the code."""
    corners = np.asarray(model.chart)[np.asarray(model.triangles)]
    i, j = np.array([(i, j) for i in range(splits) for j in range(splits - i)]).T
    first, second = (i + 1 / 3) / splits, (j + 1 / 3) / splits
    turned = i + j < splits - 1
    first, second = np.append(first, (i[turned] + 2 / 3) / splits), np.append(second, (j[turned] + 2 / 3) / splits)
    points = np.einsum("qk,ekd->eqd", np.stack([1 - first - second, first, second], 1), corners)
    return np.exp(-0.5 * np.sum((points - centre) ** 2, -1) / width**2).mean(1)


@pytest.fixture(scope="module")
def linear(model):
    jacobian = np.asarray(je.jacobian(model)) * float(model.background[0])
    return lambda centre, width: jacobian @ _means(model, np.asarray(centre), width)


@pytest.mark.parametrize(("centre", "width"), [((0.073, 0.118), 0.012), ((0.1, 0.1), 0.007), ((0.012, 0.19), 0.025)])
def test_the_table_is_the_linear_response(finder, linear, centre, width):
    responses = finder.responses
    place = jnp.array([*centre, np.log(width)])
    bump = eqx.filter_jit(responses.bump)
    value, slopes = bump(place)
    direct = finder.compress @ finder.whitening.sums(jnp.asarray(linear(centre, width)))
    direct = direct * (responses.scale / width) ** 2
    assert jnp.linalg.norm(value - direct) < 1e-2 * jnp.linalg.norm(direct)
    step = 1e-6 * jnp.eye(3)
    change = [(bump(place + h)[0] - bump(place - h)[0]) / 2e-6 for h in step]
    np.testing.assert_allclose(slopes, jnp.stack(change), atol=1e-6 * np.abs(slopes).max())


def test_slopes_of_several_contacts_are_derivatives(finder):
    theta = jnp.array([[0.05, 0.07, -4.4, 0.3], [0.07, 0.08, -4.6, 0.5]])
    found = eqx.filter_jit(finder.responses.contacts)(theta)[1]
    exact = jax.jit(jax.jacfwd(lambda t: finder.responses.contacts(t)[0]))(theta)
    np.testing.assert_allclose(found, exact, atol=1e-9 * float(jnp.abs(exact).max()))


@pytest.mark.slow
def test_a_faint_gaussian_is_recovered(finder, linear, model):
    """Faint: to first order.  What is left is the table's interpolation."""
    (found,) = _find(finder, 1e-2 * linear((0.083, 0.127), 0.012))
    np.testing.assert_array_equal(found.present, [True, False])
    np.testing.assert_allclose(found.position[0], (0.083, 0.127), atol=5e-5)
    np.testing.assert_allclose(found.width[0], 0.012, rtol=0.01)
    np.testing.assert_allclose(found.amplitude[0], 1e-2 * model.background[0], rtol=0.02)
    np.testing.assert_allclose(found.strength[0], 2 * np.pi * found.amplitude[0] * found.width[0] ** 2)
    assert found.result[0] == ContactResult.CONVERGED
    assert found.result[1] == ContactResult.ABSENT


@pytest.mark.parametrize("height", [0.3, 1.0])
def test_a_touch_on_another_mesh(finder, other, model, height):
    """Far from linear: the linear response alone would miss a third of the highest."""
    dv = _touched(other, height * _bump(other, (0.064, 0.131), 0.012)) + _noise()
    (found,) = _find(finder, dv)
    np.testing.assert_array_equal(found.present, [True, False])
    assert float(jnp.linalg.norm(found.position[0] - jnp.array([0.064, 0.131]))) < 8e-4
    np.testing.assert_allclose(found.width[0], 0.012, rtol=0.1)
    np.testing.assert_allclose(found.strength[0], 2 * np.pi * height * model.background[0] * 0.012**2, rtol=0.1)


def test_two_touches_the_stronger_first(finder, other):
    places = jnp.array([[0.07, 0.12], [0.11, 0.12]])
    shallow, deep = (_bump(other, p, 0.01) for p in places)
    (found,) = _find(finder, _touched(other, 0.2 * shallow + 0.5 * deep) + _noise())
    np.testing.assert_array_equal(found.present, [True, True])
    np.testing.assert_allclose(found.position, places[::-1], atol=1.5e-3)
    np.testing.assert_array_equal(strongest(found), found.position[0])


def test_an_edge_is_one_oblong_contact(finder, other):
    row = sum(_bump(other, (0.1 + x, 0.085), 0.006) for x in np.linspace(-0.02, 0.02, 21)) / 8
    (found,) = _find(finder, _touched(other, 0.5 * row) + _noise())
    np.testing.assert_array_equal(found.present, [True, False])
    assert found.result[0] == ContactResult.OBLONG
    np.testing.assert_allclose(found.position[0], (0.1, 0.085), atol=3e-3)


def test_noise_raises_as_many_false_alarms_as_said(finder):
    alarms = int(finder(_noise(FRAMES, seed=3)).present[:, 0].sum())
    assert binom.ppf(1e-3, FRAMES, 0.03) <= alarms <= binom.ppf(0.999, FRAMES, 0.08)


def test_error_bars_are_honest(finder, linear, model):
    """Pulls of x, y, log width and amplitude over noisy frames of a faint contact."""
    height = 5e-3
    clean = height * linear((0.083, 0.127), 0.012)
    size = float(jnp.linalg.norm(finder.compress @ finder.whitening.sums(jnp.asarray(clean))))
    frames = clean + _noise(FRAMES, seed=5) * min(1.0, size / 50)
    louder = min(1.0, size / 50)  # a fainter contact would be lost, not pulled
    found = finder(frames)
    assert found.present[:, 0].all()
    values = jnp.concatenate([found.position[:, 0], jnp.log(found.width[:, :1]), found.amplitude[:, :1]], 1)
    true = jnp.array([0.083, 0.127, np.log(0.012), height * model.background[0]])
    std = louder * jnp.sqrt(jnp.diagonal(found.covariance[:, 0], axis1=1, axis2=2))
    pulls = np.asarray((values - true) / std)
    assert (np.abs(pulls.mean(0)) < 0.35).all()
    assert ((pulls.std(0) > 0.85) & (pulls.std(0) < 1.15)).all()


@pytest.fixture(scope="module")
def single(model):
    """One that looks for a single contact, and without dead channels: small, and compiled quickly."""
    channels = np.ones(550, bool)
    channels[3:60:3] = False
    return prepare_contacts(model, ContactSettings(most=1, columns=31), noise=np.full(550, STD), channels=channels)


def test_many_frames_mapped_wait_for_no_thread(single):
    """See `jaxeit.linalg.lapack`: without that this program stood still for ever in most runs on two cores."""
    frames = jax.ShapeDtypeStruct((1000, 550), single.compress.dtype)
    assert not spread_stacks(jax.jit(jax.vmap(single)).lower(frames).as_text())


@pytest.mark.slow
def test_other_devices_search_so_many_frames_side_by_side(single, linear, monkeypatch):
    frames = np.stack([0.02 * linear((0.05 + 0.02 * k, 0.08), 0.01) for k in range(5)]) + _noise(5)
    alone = single(frames)
    monkeypatch.setattr(search, "BATCH_SIZE", 2)
    monkeypatch.setattr(search, "by_platform", lambda *args, cpu, default: default(*args))
    together = single(frames[None])  # of another shape, for which nothing is compiled yet
    assert together.position.shape == (1, 5, 1, 2)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[0], rtol=1e-6, atol=1e-9), alone, together)


@pytest.mark.slow
def test_batches_transformations_and_single_frames_agree(single, linear):
    frames = np.stack([0.02 * linear((0.05, 0.08), 0.01), _noise(), 0.02 * linear((0.15, 0.1), 0.02)]) + _noise(3)
    batch = single(frames[:, None])
    assert batch.position.shape == (3, 1, 1, 2)
    alone = jax.tree.map(lambda *of: jnp.stack(of)[:, None], *(single(frame) for frame in frames))
    mapped = eqx.filter_jit(lambda f, d: jax.vmap(f)(d))(single, frames[:, None])
    for many in (alone, mapped):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-9), batch, many)


def test_a_frame_that_cannot_be_read_says_so_and_harms_no_other(finder, linear):
    good = 0.02 * linear((0.05, 0.08), 0.01)
    found, beside, alone = *_find(finder, np.full(550, np.nan), good), _find(finder, good)[0]
    assert not found.present.any()
    assert (np.asarray(found.result) == ContactResult.UNREADABLE).all()
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(found))
    assert np.isnan(strongest(found)).all()
    np.testing.assert_array_equal(beside.position, alone.position)


def test_missing_readings_are_left_out_exactly(finder, single, linear, model):
    """As by a finder that never had them, which a zero in their place is not."""
    dv = 0.1 * linear((0.05, 0.03), 0.012) + _noise()
    gone = ~np.asarray(single.whitening.channels)
    mended, zeroed = _find(finder, np.where(gone, np.nan, dv), np.where(gone, 0, dv))
    never = single(dv)
    assert float(jnp.linalg.norm(zeroed.position[0] - never.position[0])) > 2e-4
    np.testing.assert_allclose(mended.position[0], never.position[0], atol=2e-6)
    np.testing.assert_allclose(mended.amplitude[0], never.amplitude[0], rtol=2e-3)
    np.testing.assert_allclose(mended.covariance[0], never.covariance[0], rtol=2e-2, atol=1e-12)
    np.testing.assert_allclose(mended.misfit, never.misfit, rtol=2e-2)


def test_a_dead_channel_is_left_out(single, linear):
    dv = 0.02 * linear((0.05, 0.08), 0.01)
    found = single(np.where(single.whitening.channels, dv, np.nan))
    np.testing.assert_array_equal(found.position, single(dv).position)
    np.testing.assert_allclose(found.position[0], (0.05, 0.08), atol=2e-4)


def _numbers(contacts):
    """x, y, width and amplitude of the first."""
    return jnp.concatenate([contacts.position[0], contacts.width[:1], contacts.amplitude[:1]])


def test_gradients_are_those_of_the_fit(single, other):
    dv = _touched(other, 0.4 * _bump(other, (0.064, 0.131), 0.012))
    slope = jax.jit(jax.grad(lambda d, what: jnp.sum(what * _numbers(single(d)))))
    gradient = slope(jnp.asarray(dv), jnp.array([1.0, 0, 0, 0]))
    assert bool(jnp.isfinite(gradient).all())
    step = 1e-6 * np.sign(gradient)
    change = (single(dv + step).position[0, 0] - single(dv - step).position[0, 0]) / 2
    np.testing.assert_allclose(gradient @ step, change, rtol=0.05)
    np.testing.assert_array_equal(slope(jnp.zeros(550), jnp.ones(4)), 0)


@pytest.mark.slow
def test_refined_through_the_forward_map(finder, model):
    """Simulated with the same mesh and rule, the full fit must be exact where the quick one is not."""
    centre, width, height = np.array([0.064, 0.131]), 0.012, 0.9
    sigma = model.background * (1 + height * _means(model, centre, width))
    dv = np.asarray(je.forward(model, sigma) - je.forward(model))
    (quick,) = _find(finder, dv)
    found = refine_contacts(model, dv, quick, noise=np.full(550, STD))
    assert abs(quick.amplitude[0] / model.background[0] - height) > 2e-2
    np.testing.assert_allclose(found.amplitude[0] / model.background[0], height, rtol=2e-3)
    np.testing.assert_allclose(found.position[0], centre, atol=1e-5)
    assert found.misfit < 0.1
    assert found.result[0] == ContactResult.CONVERGED


@pytest.mark.slow
def test_an_untouched_frame_refines_as_the_sheet_that_is_fitted_to_it(finder, model):
    coat = model.background * (1 + 0.3 * _means(model, np.array([0.1, 0.1]), 0.05))
    untouched = je.forward(model, coat)
    dv = np.asarray(je.forward(model, coat * (1 + 0.5 * _means(model, np.array([0.064, 0.131]), 0.012))) - untouched)
    (quick,) = _find(finder, dv)
    noise = np.full(550, STD)
    by_frame = refine_contacts(model, dv, quick, noise=noise, untouched=untouched)
    by_sheet = refine_contacts(model, dv, quick, noise=noise, sigma=je.fit_background(model, untouched))
    np.testing.assert_allclose(by_frame.position, by_sheet.position, atol=1e-9)
    even = refine_contacts(model, dv, quick, noise=noise)
    away = [np.linalg.norm(np.asarray(found.position[0]) - [0.064, 0.131]) for found in (by_frame, even)]
    assert away[0] < 0.5 * away[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"most": 0}, "most is 0"),
        ({"widths": (0.01, 0.01)}, "widths"),
        ({"columns": 3}, "columns"),
        ({"false_alarm": 0.0}, "false_alarm"),
        ({"model_error": 1.0}, "model_error"),
        ({"ratio": -1.0}, "ratio"),
        ({"separation": np.inf}, "separation"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(InverseError, match=message):
        ContactSettings(**settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"noise": np.zeros(550)}, "noise of reading 0"),
        ({"channels": np.zeros(550, bool)}, "nothing to reconstruct"),
    ],
)
def test_bad_noise_and_channels_are_refused(model, settings, message):
    with pytest.raises(InverseError, match=message):
        prepare_contacts(model, **{"noise": np.full(550, STD), **settings})


PREPARED = {
    "contacts": prepare_contacts,
    "loads": je.contacts.prepare_loads,
    "tracker": lambda model, **given: je.tracking.prepare_tracker(model, je.load_skin("testbed"), **given),
}


@pytest.mark.parametrize("prepare", PREPARED.values(), ids=PREPARED)
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"noise": np.ones(550)}, "the noise hides every contact: .*; give the standard deviation of each reading"),
        ({"sigma": lambda model: model.background * np.nan}, "sigma of element 0 is nan S; give the conductivity"),
        ({"sigma": lambda model: -model.background}, "sigma of element 0 is -0.00666667 S; give the conductivity"),
        ({"sigma": lambda model: model.background.at[7].set(0)}, "sigma of element 7 is 0 S"),
    ],
)
def test_noise_and_sheets_that_cannot_be_are_refused(prepare, given, message, model):
    given = {name: value(model) if callable(value) else value for name, value in given.items()}
    with pytest.raises(InverseError, match=message):
        prepare(model, **{"noise": np.full(550, STD)} | given)


@pytest.mark.parametrize("prepare", PREPARED.values(), ids=PREPARED)
@pytest.mark.parametrize("wrong", [je.load_skin("testbed"), 3, "fine", 0])
def test_settings_of_another_kind_are_refused(prepare, wrong, model):
    with pytest.raises(InverseError, match=r"is not settings of [a-z ]+; give \w+Settings\(\.\.\.\)"):
        prepare(model, settings=wrong, noise=np.full(550, STD))


@pytest.mark.parametrize("batch", [(0,), (2, 0)])
def test_a_batch_of_no_frames_holds_no_contacts(finder, batch):
    found = finder(np.zeros((*batch, 550)))
    assert found.present.shape == (*batch, 2)
    assert found.covariance.shape == (*batch, 2, 4, 4)


def test_ways_to_compile_a_finder_that_the_docstrings_name(finder):
    dv = STD * np.random.default_rng(2).normal(size=550) * 30
    expected = finder(dv)
    for compiled in (eqx.filter_jit(finder), jax.jit(lambda dv: finder(dv))):
        for found, known in zip(jax.tree.leaves(compiled(dv)), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(np.asarray(found, float), np.asarray(known, float), rtol=1e-6, atol=1e-9)


def test_frames_of_another_length_are_refused(finder):
    with pytest.raises(InverseError, match="550 readings"):
        finder(np.zeros(549))


def test_masked_frames_are_refused(finder):
    with pytest.raises(InverseError, match="dv is a masked array"):
        finder(np.ma.masked_equal(np.zeros(550), 0))


def test_complex_frames_are_refused(finder, model):
    """JAX would leave out their imaginary part with a warning."""
    frame = 1j * np.ones(finder.readings)
    none = finder(np.zeros(finder.readings))
    for call in (finder, lambda dv: je.contacts.refine_contacts(model, dv, none, noise=1e-6)):
        with pytest.raises(je.imaging.InverseError, match="dv is complex, and a model is real"):
            call(frame)


@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.slow)])
def test_where_one_start_ends_badly_the_other_is_finished(finder, linear, every):
    """Of pairs near a corner a fifth end in a wrong minimum, up to 18 times the noise, if only one start goes on."""
    near = [((0.03, y), 0.0145) for y in (0.027, 0.029, 0.031, 0.033)]
    far = [((x, 0.03), w) for x in (0.064, 0.067, 0.07, 0.073, 0.076, 0.079) for w in (0.012, 0.0145)]
    each = {bump: linear(*bump) for bump in near + far}
    ratios = (0.35, 0.5, 0.7, 0.85, 1.0)
    frames = np.array([0.3 * (each[a] + ratio * each[b]) for a in near for b in far for ratio in ratios])[::every]
    misfit = np.array([found.misfit for found in _find(finder, *frames + _noise(len(frames)))])
    assert np.quantile(misfit, 0.98) < 2.5


@pytest.mark.parametrize("centre", [(0.0161, 0.0275), (0.1919, 0.1838)])
def test_a_contact_beside_an_electrode_is_no_narrower_one_elsewhere(finder, other, centre):
    """From the best start the fit ends 18 and 33 mm away, in the narrowest contact: 11 and 5 times the noise."""
    (found,) = _find(finder, _touched(other, 0.4 * _bump(other, centre, 0.014)))
    np.testing.assert_allclose(found.position[0], centre, atol=1.5e-3)
    assert found.misfit < 1


def test_a_contact_over_a_dead_electrode_is_found_there(finder, other, skin):
    """Responses count by what is left of them, without which the best start lies where most is left of one."""
    centre = np.array((0.176, 0.023))
    dead = np.argmin(np.linalg.norm(skin.electrode_positions - centre, axis=1))
    dv = np.where((skin.protocol.pattern == dead).any(1), np.nan, _touched(other, 0.4 * _bump(other, centre, 0.012)))
    np.testing.assert_allclose(_find(finder, dv)[0].position[0], centre, atol=2e-3)


def test_a_table_of_responses_is_the_sum_over_all_elements(model):
    """Elements that a bump does not reach are left out of its row."""
    nodes = table_nodes(model, (0.005, 0.03), 17)
    slopes = np.random.default_rng(0).normal(size=(3, len(model.triangles)))
    found = tabulate(model, slopes, nodes)
    for i, j, level in [(0, 0, 0), (7, 3, 1), (8, 16, 4), (16, 9, len(nodes.axes[2]) - 1)]:
        centre, width = np.array([nodes.axes[1][j], nodes.axes[0][i]]), np.exp(nodes.axes[2][level])
        points, weights = quadrature_points(model, width)
        height = np.exp(-0.5 * ((points - centre) ** 2).sum(-1) / width**2) @ weights
        expected = (nodes.scale / width) ** 2 * slopes @ height
        np.testing.assert_allclose(found[i, j, level], expected, rtol=0, atol=1e-7 * np.abs(found[..., level, :]).max())
