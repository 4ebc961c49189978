"""Reconstruction: the two spaces agree, the limits hold, and bad settings are refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import lstsq

import jaxeit as je
from jaxeit.model.bases import overlap_areas

from ..helpers import equations


@pytest.fixture(scope="module")
def recon(model, pixels):
    return je.prepare(model, basis=pixels)


def _touch(model, centre, depth=0.3, width=0.012):
    square = jnp.sum((model.centroids - jnp.asarray(centre)) ** 2, -1)
    return model.background * (1 + depth * jnp.exp(-0.5 * square / width**2))


def one_step(j, r, hyperparameter=0.1):
    """The formula as it stands, in float64 NumPy."""
    strength = hyperparameter**2 * np.trace(j / r @ j.T) / len(j)
    return np.linalg.solve(j.T @ j + strength * np.diag(r), j.T)


def test_matches_stacked_least_squares(model, pixels, recon):
    """Q dv is the minimiser of |J x - dv|^2 + l^2 |Gamma x|^2, here by an orthogonal method."""
    j = np.asarray(je.jacobian(model, basis=pixels))
    r = np.asarray(je.Noser().precision(jnp.asarray(j), pixels.picture).values)
    scale = 0.1**2 * np.trace(j / r @ j.T) / len(j)
    dv = np.asarray(je.forward(model, _touch(model, (0.07, 0.12))) - je.forward(model))
    stacked = np.concatenate([j, np.diag(np.sqrt(scale * r))])
    exact = lstsq(stacked, np.concatenate([dv, np.zeros(len(r))]))[0]
    np.testing.assert_allclose(recon(dv), exact, atol=1e-9 * np.abs(exact).max())


@pytest.mark.slow
@pytest.mark.parametrize("columns", [12, 30])
def test_data_space_and_image_space_agree(model, columns):
    """12 x 12 pixels are fewer than the 300 pair sums, 30 x 30 are more; against the SVD of all readings."""
    image = je.Pixels(columns).on(model)
    j = je.jacobian(model, basis=image)
    r = je.Noser().precision(j, image.picture).values
    b = np.asarray(j / jnp.sqrt(r))
    u, s, vt = np.linalg.svd(b, full_matrices=False)
    filtered = vt.T * (s / (s**2 + 0.1**2 * (s**2).sum() / len(j))) @ u.T / np.sqrt(r)[:, None]
    found = je.prepare(model, basis=image).matrix
    np.testing.assert_allclose(found, filtered, atol=1e-8 * np.abs(filtered).max())


def test_a_touch_is_found_where_it_is(model, recon):
    centre = (0.07, 0.12)
    image = recon(je.forward(model, _touch(model, centre)) - je.forward(model))
    for estimator in (je.LevelCentroid(0.5), je.LevelCentroid(0.25)):
        assert float(je.localisation_error(estimator(image, recon), jnp.asarray(centre))) < 6e-3
    assert float(je.metrics.image_sum(image, recon.areas)) > 0


@pytest.mark.parametrize("frame", ["x", ["a"] * 550, np.full(550, "1.0"), np.ones(550, bool)])
def test_a_frame_of_texts_is_refused_in_one_line(model, frame):
    frames = [je.imaging.fit_background, je.imaging.fit_reference, je.imaging.absolute_image]
    for call in (*frames, je.imaging.find_misplacement):
        with pytest.raises(je.imaging.InverseError, match=r"^(v0|frame) is .*; give real numbers, V$"):
            call(model, frame)
    with pytest.raises(je.imaging.InverseError, match=r"^noise is 'x'; give real numbers, V$"):
        je.imaging.find_misplacement(model, je.forward(model), noise="x")


def test_complex_frames_are_refused(recon, model):
    """JAX would leave out their imaginary part with a warning."""
    frame = np.ones(550) + 1j
    calls = {
        "dv": [recon, recon.on_host()],
        "v0": [lambda v: je.fit_background(model, v)],
        "frame": [lambda v: je.imaging.fit_reference(model, v), lambda v: je.imaging.segment(model, v.real, v)],
    }
    for name, given in calls.items():
        for call in given:
            with pytest.raises(je.imaging.InverseError, match=f"{name} is complex, and a model is real"):
                call(frame)


def test_images_are_linear_and_batched(recon):
    dv = jax.random.normal(jax.random.key(0), (3, 2, recon.readings))
    np.testing.assert_allclose(recon(dv)[2, 1], recon(dv[2, 1]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(recon(2 * dv), 2 * recon(dv), rtol=1e-12)


def test_the_compiled_function_is_the_same_map(recon):
    dv = np.asarray(jax.random.normal(jax.random.key(0), (3, recon.readings)))
    apply = recon.compiled()
    np.testing.assert_allclose(apply(dv), recon(dv), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(apply(dv[0]), recon(dv[0]), rtol=1e-9, atol=1e-12)


def _same_in_numpy(recon, dv):
    """`on_host` against JAX, which mends through one padded system, or through all pair sums."""
    found, expected = recon.on_host()(dv), np.asarray(recon(dv))
    assert found.shape == expected.shape
    assert found.dtype == expected.dtype
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


def test_numpy_gives_the_same_image(recon):
    dv = np.array(jax.random.normal(jax.random.key(0), (2, 3, recon.readings)))
    dv[1, 2, 5] = np.nan
    for frames in (dv, dv[0], dv[0, 0], dv[1, 2]):
        _same_in_numpy(recon, frames)
    with pytest.raises(je.imaging.InverseError, match="must hold 550"):
        recon.on_host()(np.zeros(3))
    with pytest.raises(je.imaging.InverseError, match=r"^on_host: dtype is 'float16'; give 'float32' or 'float64'$"):
        recon.on_host("float16")


def test_a_vmap_over_whole_frames_solves_nothing(recon):
    """Readings are completed behind a condition of the whole batch, where one lacks some."""
    dv = jnp.asarray(np.random.default_rng(1).normal(size=(3, 550)))
    np.testing.assert_allclose(jax.vmap(recon)(dv), dv @ recon.matrix.T, rtol=1e-9, atol=1e-12)
    broken = dv.at[1, 5].set(jnp.nan)
    np.testing.assert_allclose(jax.vmap(recon)(broken), recon(broken), rtol=1e-9)
    always = equations(jax.make_jaxpr(jax.vmap(recon))(dv).jaxpr, branches=False)
    asked = {equation.primitive.name for equation in always}
    assert "dot_general" in asked
    assert asked.isdisjoint({"lu", "cholesky", "triangular_solve", "while", "scan"})


@pytest.fixture(scope="module")
def correlated(model, pixels):
    """The noise of neighbours goes together."""
    place = np.arange(550)
    return je.prepare(model, basis=pixels, noise=1e-6 * 0.5 ** np.abs(place - place[:, None]))


@pytest.mark.parametrize("lost", [1, 16, 17, 60, 500, 550])
def test_numpy_mends_frames_as_jax_does(recon, correlated, lost):
    rng = np.random.default_rng(lost)
    dv = rng.normal(size=550)
    dv[rng.choice(550, lost, replace=False)] = rng.choice([np.nan, np.inf], lost)
    for one in (recon, correlated):
        _same_in_numpy(one, dv)
    exact = np.asarray(recon(dv))
    rounded = recon.on_host("float32")(dv)
    assert rounded.dtype == np.float32
    np.testing.assert_allclose(rounded, exact, atol=1e-5 * np.abs(exact).max())


def test_numpy_leaves_out_what_jax_leaves_out(model, recon, correlated):
    dv = np.random.default_rng(0).normal(size=(2, 550))
    electrode = (np.asarray(model.pattern) == 7).any(1)  # some pair sums are not read at all then
    dv[:, electrode] = np.nan
    for one in (recon.without(electrode), correlated.without(electrode)):
        for frames in (dv, dv[0], np.where(np.arange(550) == int(np.argmin(electrode)), np.nan, dv[0])):
            _same_in_numpy(one, frames)


@pytest.mark.parametrize("shape", [(), (3,), (2, 549), (550, 2)])
def test_frames_of_another_protocol_are_refused(recon, shape):
    with pytest.raises(je.imaging.InverseError, match="must hold 550 readings"):
        recon(np.zeros(shape))


@pytest.mark.parametrize("shape", [(0, 550), (2, 0, 550)])
@pytest.mark.parametrize("method", [je.OneStep(), je.NonNegative()], ids=["linear", "iterative"])
def test_a_batch_of_no_frames_gives_no_images(model, shape, method):
    recon = je.prepare(model, method=method, basis=je.Pixels(6))
    for images in (recon(np.zeros(shape)), recon.on_host()(np.zeros(shape)), recon.compiled()(np.zeros(shape))):
        assert images.shape == (*shape[:-1], 36)


def test_a_dead_channel_is_left_out_and_may_hold_anything(model, pixels):
    channels = np.ones(550, bool)
    channels[[3, 77]] = False
    recon = je.prepare(model, basis=pixels, channels=channels)
    dv = np.asarray(je.forward(model, _touch(model, (0.07, 0.12))) - je.forward(model))
    broken = np.where(channels, dv, np.nan)
    np.testing.assert_array_equal(recon(broken), recon(dv))
    # the same as never having measured them
    j = np.asarray(je.jacobian(model, basis=pixels))[channels]
    fewer = one_step(j, je.Noser().precision(jnp.asarray(j), pixels.picture).values) @ dv[channels]
    np.testing.assert_allclose(recon(dv), fewer, atol=1e-9 * np.abs(fewer).max())


def test_noise_weights_only_matter_relative_to_each_other(model, pixels, recon):
    weighted = je.prepare(model, basis=pixels, noise=np.full(550, 7e-6))
    np.testing.assert_allclose(weighted.matrix, recon.matrix, atol=1e-10 * np.abs(recon.matrix).max())


@pytest.mark.slow
def test_float32_images_follow_float64(skin, model, pixels, recon):
    single = je.discretise(je.Scene(skin), je.Fidelity.draft(dtype="float32"))
    coarse = je.prepare(single, basis=je.Pixels(20))
    assert coarse.factor.dtype == jnp.float32
    dv = je.forward(model, _touch(model, (0.07, 0.12))) - je.forward(model)
    error = np.abs(np.asarray(coarse(dv)) - np.asarray(recon(dv))).max()
    assert error < 2e-3 * np.abs(np.asarray(recon(dv))).max()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hyperparameter": 0.0}, "above zero"),
        ({"hyperparameter": float("nan")}, "above zero"),
        ({"noise": np.ones(3)}, "550 readings"),
        (
            {"noise": 1e-6},
            r"noise has shape \(\); .* 550 readings: give the .* V, such as np.full\(550, 1e-6\)",
        ),
        ({"noise": np.zeros(550)}, "reading 0"),
        ({"channels": np.zeros(550, bool)}, "every channel"),
        ({"sigma": None, "channels": np.ones(2, bool)}, "550 readings"),
        ({"channels": np.arange(550)}, r"channels is int64 of shape \(550,\); give booleans, one for each of 550"),
        ({"channels": np.ones(550)}, r"channels is float64 .*, of zeros and ones channels.astype\(bool\)"),
        ({"channels": [3, 4]}, r"of indices np.isin\(np.arange\(550\), channels\)"),
        ({"channels": ["a"] * 550}, "give booleans"),
        ({"untouched": np.ones(550), "channels": np.arange(550)}, "give booleans"),
    ],
)
def test_settings_that_cannot_be_are_refused(model, pixels, settings, message):
    with pytest.raises(je.imaging.InverseError, match=message):
        je.prepare(model, basis=pixels, **settings)


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ((je.OneStep(), je.Noser()), r"OneStep is not a prior; give an object, such as prior=Noser\(\)"),
        (("noser",), r"'noser' is not a prior; give an object, such as prior=Noser\(\)"),
        ((je.TotalVariation(),), "TotalVariation changes with the image, .* OneStep takes it only once"),
        ((None, je.Noser()), "Noser is not a method; give an object, such as method="),
        ((je.Noser, None), "the class Noser is not a prior"),
        ((None, None, 20), "int is not a basis; give an object, such as basis="),
    ],
)
def test_a_choice_in_the_place_of_another_is_refused(model, choices, message):
    with pytest.raises(je.imaging.InverseError, match=message):
        je.prepare(model, *choices)


def test_ways_to_compile_a_reconstructor_that_its_docstring_names(recon, model):
    dv = je.forward(model, _touch(model, (0.07, 0.12))) - je.forward(model)
    expected = np.asarray(recon(dv))
    for compiled in (eqx.filter_jit(recon), jax.jit(lambda dv: recon(dv))):
        np.testing.assert_allclose(np.asarray(compiled(dv)), expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def test_imaging_refuses_a_method_for_a_prior():
    with pytest.raises(je.imaging.InverseError, match="OneStep is not a prior"):
        je.Imaging(prior=je.OneStep())


def test_a_conductivity_that_is_not_positive_is_refused(model, pixels):
    with pytest.raises(je.imaging.InverseError, match="positive"):
        je.prepare(model, basis=pixels, sigma=-model.background)


# --- pixels --------------------------------------------------------------------------------------


def test_overlap_areas_of_known_shapes():
    triangle = np.array([[[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]]])
    box = (np.array([[0.0, 0.0]]), np.array([[1.0, 1.0]]))
    assert overlap_areas(triangle, *box)[0] == pytest.approx(1.0)
    corner = (np.array([[1.0, 1.0]]), np.array([[3.0, 3.0]]))
    assert overlap_areas(triangle, *corner)[0] == pytest.approx(0.0)
    arrow = np.array([[[0.0, 0.0], [2.0, 0.0], [1.0, 0.5], [2.0, 2.0]]])  # not convex
    whole = (np.array([[-1.0, -1.0]]), np.array([[3.0, 3.0]]))
    assert overlap_areas(arrow, *whole)[0] == pytest.approx(1.0)


def test_pixels_keep_areas_and_constants(model, pixels):
    assert float(pixels.areas.sum()) == pytest.approx(float(model.areas.sum()), rel=1e-12)
    np.testing.assert_allclose(pixels.expand(jnp.ones(pixels.size)), 1.0, rtol=1e-12)
    # the integral of an image is the same on pixels and on elements
    image = jax.random.normal(jax.random.key(1), (pixels.size,))
    on_mesh = pixels.expand(image) @ model.areas
    assert float(on_mesh) == pytest.approx(float(image @ pixels.areas), rel=1e-10)


def test_pixels_outside_a_disc_have_no_area():
    skin = je.Skin("disc", je.Disc(0.1), 1.0, _ring(), je.Protocol(je.skin.adjacent(8)))
    image = je.Pixels(16).on(je.discretise(je.Scene(skin), je.Fidelity.draft()))
    areas = np.asarray(image.areas).reshape(image.shape)
    assert areas[0, 0] == 0
    assert areas[8, 8] == pytest.approx((0.2 / 16) ** 2, rel=2e-3)  # the mesh is a polygon


def _ring():
    angle = 2 * np.pi * np.arange(8) / 8
    return tuple(je.PointElectrode((0.08 * np.cos(a), 0.08 * np.sin(a))) for a in angle)


def test_polygons_within_their_boxes_keep_their_areas():
    triangle = np.array([[[0.2, 0.2], [0.8, 0.2], [0.2, 0.6]]])
    np.testing.assert_allclose(overlap_areas(triangle, np.zeros((1, 2)), np.ones((1, 2))), [0.12])
    assert overlap_areas(triangle[:0], np.zeros((0, 2)), np.ones((0, 2))).shape == (0,)
