"""Fields of gain over the place pressed: geometry, closed forms, recovery, honesty, and the fit beside the curves."""

import re
from dataclasses import fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg
from scipy.interpolate import BSpline
from scipy.special import gamma, kv

import jaxeit as je
from calib import cli
from calib.fitting.cross_validation.held_out import Folds, folds_by_place
from calib.fitting.cross_validation.selection import choose
from calib.fitting.curves import CURVES, Linear
from calib.fitting.fields import (
    FIELDS,
    Constant,
    GaussianProcess,
    PadEdge,
    PadEdgeSize,
    PadEdgeSpline,
    Places,
    RadialBasis,
    fit_field,
    geometry_of,
    log_gain,
    single_places,
)
from calib.fitting.fields.base import restore_field
from calib.fitting.fields.evidence import PRIOR_RATIOS
from calib.fitting.fields.fitted import pad_features
from calib.fitting.fields.unpressed_walls import unpressed_note
from calib.fitting.losses import SoftL1
from calib.fitting.pads import LocatedPresses, fit_pads
from calib.fitting.results import FitResult
from calib.presses.pooled import PressData, PressSeries, block_means

from ..helpers import require_identical, spread_stacks

features_of = eqx.filter_jit(pad_features)
REACH = jnp.array([[0.01, 0.01], [0.19, 0.19]])


@pytest.fixture(scope="module")
def geometry(skin):
    return geometry_of(skin)


def grid(side=12):
    x = np.linspace(0.01, 0.19, side)
    return np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)


def jittered(count, seed):
    """Places away from the outlines of the pads, so that their owners are plain."""
    return np.random.default_rng(seed).uniform(0.012, 0.188, (count, 2))


def owner(place):
    return (place[:, 0] > 0.1) + 2 * (place[:, 1] > 0.1)


def dip(skin, place):
    """Log-gain that undoes a dip of 40 % over 10 mm, with the mean over each pad's places taken off."""
    distance = np.stack([je.Polygon(pad.outline).boundary_distance(place) for pad in skin.pads], 1)
    own = np.take_along_axis(distance, owner(place)[:, None], 1)[:, 0]
    gain = -np.log(1 - 0.4 * np.exp(-own / 0.01))
    return gain - np.array([gain[owner(place) == p].mean() for p in range(4)])[owner(place)]


# --- geometry --------------------------------------------------------------------------------------------------------


def walls(skin, place):
    """Distances of places to the four sides of their pad, and to the two nearest sides of the rim, nearest first."""
    x, y = place.T
    sides = np.sort([x % 0.1, 0.1 - x % 0.1, y % 0.1, 0.1 - y % 0.1], 0)
    rim = np.sort([x, 0.2 - x, y, 0.2 - y], 0)[:2]
    np.testing.assert_allclose(rim[0], skin.domain.boundary_distance(place), atol=1e-12)
    return sides, rim


def test_edge_features_are_distances_to_sides_and_rim(skin, geometry):
    place, field = grid(7), PadEdge()
    inside = np.eye(4, dtype=bool)[owner(place)]
    features = np.asarray(features_of(field, geometry, single_places(place, 4)))[inside]
    sides, rim = (near(distance, field) for distance in walls(skin, place))
    expected = np.concatenate([sides.sum(0), rim[0], (rim[0] * rim[1])[:, :-1]], 1)
    np.testing.assert_allclose(features, expected, rtol=1e-9, atol=1e-12)
    few = np.asarray(features_of(replace(field, corners=False), geometry, single_places(place, 4)))[inside]
    require_identical(few, features[:, : 2 * field.bumps])


@pytest.mark.parametrize("field", [PadEdgeSpline(), PadEdgeSpline(bumps=7, length=0.7, modes=7)])
def test_a_spline_of_distance_is_a_process_over_octaves_that_falls_off(skin, geometry, field):
    """Covariances of the field at all pairs of places, against those of Matern's kernel at the knots."""
    place = grid(7)
    inside = np.eye(4, dtype=bool)[owner(place)]
    features = np.asarray(features_of(field, geometry, single_places(place, 4)))[inside]
    sides, rim = (near(distance, field, 2, 1) for distance in walls(skin, place))
    u = (np.arange(field.bumps) - 1) / 2
    kernel = matern(np.abs(u[:, None] - u) / field.length) * 0.5 ** (u[:, None] + u)
    values, vectors = np.linalg.eigh(kernel / np.trace(kernel) * field.bumps)
    kernel, kept = ((vectors[:, -k:] * values[-k:]) @ vectors[:, -k:].T for k in (field.bumps, field.modes))
    expected = sum(part @ kernel @ part.T for part in (sides.sum(0), rim[0]))
    expected += sum((a @ kept @ a.T) * (b @ kept @ b.T) for a, b in (rim, sides[:2]))
    np.testing.assert_allclose(features @ features.T, expected, rtol=1e-9, atol=1e-9)
    few = np.asarray(features_of(replace(field, corners=False), geometry, single_places(place, 4)))[inside]
    require_identical(few, features[:, : 2 * field.bumps])


def matern(distance, smoothness=2.5):
    """Matern's correlation at distances over the length, by Bessel's function (Rasmussen and Williams 2006, 4.14)."""
    z = np.sqrt(2 * smoothness) * np.where(distance > 0, distance, 1)
    found = 2 ** (1 - smoothness) / gamma(smoothness) * z**smoothness * kv(smoothness, z)
    return np.where(distance > 0, found, 1.0)


def near(distance, field, steps=1, first=0):
    """Cubic B-splines by SciPy, (..., bumps), at steps of octaves of distance."""
    bump = BSpline.basis_element(np.arange(-2.0, 3), extrapolate=False)
    place = steps * np.log2(1 + distance / float(field.width)) + first
    return np.nan_to_num(bump(place[..., None] - np.arange(field.bumps)))


def test_a_place_beside_a_pad_counts_as_its_nearest_edge(geometry):
    places = single_places(np.array([[0.13, 0.05], [0.1, 0.05]]), 4)
    features = features_of(RadialBasis(shared=True), geometry, places)
    np.testing.assert_allclose(features[0, 0], features[1, 0])


def test_pads_with_fewer_corners_and_round_sheets(skin):
    triangle = je.Pad("t", np.array([[0.02, 0.02], [0.08, 0.02], [0.05, 0.08]]))
    square = je.Pad("s", np.array([[-0.06, -0.06], [-0.01, -0.06], [-0.01, -0.01], [-0.06, -0.01]]))
    round_sheet = je.Disc(0.1)
    odd = je.Skin("odd", round_sheet, 1.0, skin.electrodes, skin.protocol, (square, triangle))
    point = np.array([[0.05, 0.04]])
    field = PadEdge(0.01, bumps=1)
    features = np.asarray(features_of(field, geometry_of(odd), single_places(point, 2)))[0, 1]
    sides = np.roll(triangle.outline, -1, 0) - triangle.outline
    normal = np.stack([-sides[:, 1], sides[:, 0]], 1) / np.linalg.norm(sides, axis=1)[:, None]
    assert features[0] == pytest.approx(near(((point - triangle.outline) * normal).sum(1), field).sum(), rel=1e-9)
    assert features[1] == pytest.approx(near(round_sheet.boundary_distance(point), field)[0, 0], rel=2e-2)


@pytest.mark.parametrize("name", FIELDS)
def test_every_field_has_its_features_priors_and_settings(name, geometry):
    field = FIELDS.make(name)

    @jax.jit
    def both(x):
        at = lambda x: pad_features(field, geometry, single_places(x[None], 4, 0.01))[0]  # noqa: E731
        return at(x), jax.jacfwd(at)(x)

    features, slope = both(jnp.array([0.0, 0.05]))
    assert features.shape == (4, field.size(4))
    assert np.isfinite(features).all()
    assert np.isfinite(slope).all()
    assert (field.shapes() >= 0).all()
    assert FIELDS.name_of(field) == name
    settings = {f.name: np.asarray(getattr(field, f.name)) for f in fields(field)}
    assert eqx.tree_equal(restore_field(type(field), settings), field)


def test_settings_that_a_field_has_no_more_are_read_where_they_change_nothing():
    same = {"steps": np.asarray(1), "order": np.asarray(0)}
    assert eqx.tree_equal(restore_field(PadEdge, same | {"corners": np.asarray(True)}), PadEdge())
    for kind, settings in ((PadEdge, same | {"order": np.asarray(1)}), (PadEdgeSpline, same)):
        with pytest.raises(TypeError, match="unexpected keyword"):
            restore_field(kind, settings)


def test_the_command_line_knows_every_field_and_curve(capsys):
    with pytest.raises(SystemExit):
        cli.main(["calibrate", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "one of none, " + ", ".join(FIELDS) + ", auto --locator" in said
    assert "one of " + ", ".join(CURVES) + ", auto, memoryless --location" in said


# --- the fit ---------------------------------------------------------------------------------------------------------

fit = eqx.filter_jit(fit_field)


def press_rows(place, log_ratio):
    share = np.eye(4)[owner(place)]
    return jnp.asarray(log_ratio), jnp.asarray(share), jnp.ones(len(place)), REACH


@pytest.fixture(scope="module")
def fitted(skin, geometry):
    place = grid()
    rng = np.random.default_rng(0)
    log_ratio = dip(skin, place) + rng.normal(0, 0.02, len(place)) + np.array([0.3, -0.2, 0.0, 1.0])[owner(place)]
    return place, log_ratio, fit(PadEdge(), geometry, single_places(place, 4), *press_rows(place, log_ratio))


def test_a_known_field_is_found_whatever_the_levels_of_the_pads(skin, fitted):
    place, _, found = fitted
    assert found.result == FitResult.SUCCESS
    gain = log_gain(found, single_places(place, 4))
    own = np.asarray(gain.mean)[np.arange(len(place)), owner(place)]
    assert np.sqrt(np.mean((own - dip(skin, place)) ** 2)) < 0.04 < 0.5 * dip(skin, place).std() + 0.005
    np.testing.assert_allclose([own[owner(place) == p].mean() for p in range(4)], 0, atol=1e-12)
    assert 0.02 < float(found.noise) < 0.5 * float(found.spread)  # corners are not quite sums of their sides


def test_a_spline_of_distance_follows_a_dip_more_closely(skin, geometry):
    """Between the places of the presses, by three sets of 100."""
    new, errors = jittered(200, 9), []
    for seed in (21, 22, 23):
        place = jittered(100, seed)
        log_ratio = dip(skin, place) + np.random.default_rng(seed).normal(0, 0.01, len(place))
        rows = press_rows(place, log_ratio)
        fits = [fit(field, geometry, single_places(place, 4), *rows) for field in (PadEdge(), PadEdgeSpline())]
        found = np.array([np.asarray(log_gain(one, single_places(new, 4)).mean) for one in fits])
        left = found[:, np.arange(len(new)), owner(new)] - dip(skin, new)
        left -= [[left[k][owner(new) == pad].mean() for pad in owner(new)] for k in range(2)]  # levels are the curves'
        errors.append(np.sqrt((left**2).mean(1)))
    edge, spline = np.mean(errors, 0)
    assert spline < 0.9 * edge


def test_coefficients_are_those_of_every_prior_weighed_by_its_evidence(geometry):
    """Against generalised least squares in the space of presses, one prior after the other."""
    place = jittered(60, 2)
    log_ratio = np.random.default_rng(0).normal(0, 0.1, 60)
    field = PadEdge(0.02, bumps=1)
    found = fit(field, geometry, single_places(place, 4), *press_rows(place, log_ratio))
    phi = np.asarray(features_of(field, geometry, single_places(place, 4)))
    share = np.eye(4)[owner(place)]
    z = np.einsum("np,npk->nk", share, phi - np.asarray(found.centre))
    null = linalg.null_space(share.T).T  # contrasts free of the pads' levels: restricted likelihood
    y, z = null @ log_ratio, null @ z
    logs, means, covariances, variances = [], [], [], []
    for ratio in PRIOR_RATIOS:
        k = np.eye(56) + ratio * z @ z.T
        variance = y @ np.linalg.solve(k, y) / 56
        logs.append(-0.5 * (np.linalg.slogdet(k)[1] + 56 * np.log(variance)))
        means.append(ratio * z.T @ np.linalg.solve(k, y))
        covariances.append(variance * (ratio * np.eye(z.shape[1]) - ratio**2 * z.T @ np.linalg.solve(k, z)))
        variances.append(variance)
    weight = np.exp(np.array(logs) - max(logs)) / np.exp(np.array(logs) - max(logs)).sum()
    mean = weight @ np.array(means)
    about = np.array(means) - mean
    covariance = np.einsum("r,rij->ij", weight, np.array(covariances) + about[:, :, None] * about[:, None])
    np.testing.assert_allclose(found.coefficients, mean, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-6)
    np.testing.assert_allclose(float(found.noise) ** 2, weight @ np.array(variances), rtol=1e-6)


def test_a_known_dependence_on_the_size_of_the_contact_is_found(skin, geometry):
    """Gain falls with the square root of the estimated width, beside the dip at the edges."""
    place, rng = grid(), np.random.default_rng(2)
    width = np.exp(rng.uniform(np.log(0.006), np.log(0.03), len(place)))
    y = dip(skin, place) - 0.5 * np.log(width / 0.01) + rng.normal(0, 0.02, len(place))
    places = single_places(place, 4, width, 1.0)
    found = fit(PadEdgeSize(), geometry, places, *press_rows(place, y))
    assert found.result == FitResult.SUCCESS
    error = float(np.sqrt(found.covariance[-1, -1]))
    assert 0 < error < 0.02
    assert abs(float(found.coefficients[-1]) + 0.5) < 4 * error
    blind = fit(PadEdgeSize(), geometry, single_places(place, 4), *press_rows(place, y))
    assert 3 * float(found.noise) < float(blind.noise)
    assert blind.coefficients[-1] == 0  # no width was known
    both = single_places(np.repeat([[0.05, 0.05]], 2, 0), 4, np.array([np.nan, np.exp(np.log(width).mean())]), 1.0)
    mean = np.asarray(log_gain(found, both).mean)[:, 0]
    assert mean[0] == pytest.approx(mean[1], abs=0.1)  # of a width that is not known, the gain of the mean one


def test_no_field_is_found_where_there_is_none(geometry):
    place = grid()
    noise = np.random.default_rng(1).normal(0, 0.05, len(place))
    found = fit(PadEdge(), geometry, single_places(place, 4), *press_rows(place, noise))
    gain = log_gain(found, single_places(place, 4))
    own = np.asarray(gain.mean)[np.arange(len(place)), owner(place)]
    assert np.abs(own).max() < 0.04
    assert float(found.evidence) < 3


def test_an_outlier_of_any_size_hardly_moves_the_field(fitted, geometry):
    place, log_ratio, found = fitted
    wild = log_ratio.copy()
    wild[20] += 5.0
    again = fit(PadEdge(), geometry, single_places(place, 4), *press_rows(place, wild))
    mine, theirs = (np.asarray(log_gain(f, single_places(place, 4)).mean) for f in (found, again))
    assert np.abs(mine - theirs)[np.arange(len(place)), owner(place)].max() < 0.04


def test_unknown_places_and_presses_have_no_gain_and_say_how_uncertain_that_is(fitted, geometry):
    place, log_ratio, found = fitted
    nowhere = single_places(np.full((2, 2), np.nan), 4)
    gain = log_gain(found, nowhere)
    assert (np.asarray(gain.mean) == 0).all()
    np.testing.assert_allclose(gain.variance, found.spread**2 - found.noise**2)
    holes = place.copy()
    holes[:30] = np.nan
    log_ratio = np.r_[np.full(30, np.nan), log_ratio[30:]]
    some = fit(PadEdge(), geometry, single_places(holes, 4), *press_rows(place, log_ratio))
    assert some.result == FitResult.SUCCESS
    assert float(some.n) == len(place) - 30
    none = fit(PadEdge(), geometry, single_places(holes * np.nan, 4), *press_rows(place, log_ratio))
    assert none.result == FitResult.TOO_FEW
    assert (np.asarray(log_gain(none, single_places(place, 4)).mean) == 0).all()


def test_beyond_what_was_pressed_the_field_stays_level_and_grows_uncertain(fitted):
    _, _, found = fitted
    places = single_places(np.array([[-0.1, 0.05], [0.0, 0.05], [0.01, 0.05]]), 4)
    mean, variance = log_gain(found, places)
    np.testing.assert_allclose(mean[0], mean[2])
    np.testing.assert_allclose(mean[1], mean[2])
    np.testing.assert_allclose(variance[0], variance[1])
    assert variance[1, 0] > 4 * variance[2, 0]


@pytest.mark.parametrize("corners", [True, False])
def test_presses_that_leave_out_the_borders_bound_what_is_said_of_them(skin, geometry, corners):
    """Presses nearest to a border spill over to the next pad, and differ by what no field says: that is no reason to
    give the next pad's edge any gain that explains it. The standard error tells how far from the truth that leaves."""
    x = np.r_[np.linspace(0.01, 0.087, 6), np.linspace(0.113, 0.19, 6)]
    place = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)
    share = np.eye(4)[owner(place)]
    for axis, other in enumerate((1, 2)):  # a pad's neighbour along x, along y
        inner = np.flatnonzero(np.abs(place[:, axis] - 0.1) < 0.02)
        share[inner, owner(place)[inner] ^ other] += 0.14
    share /= share.sum(1, keepdims=True)
    true = dip(skin, place)
    y = true - 0.2 * (share.max(1) < 1) + np.random.default_rng(4).normal(0, 0.01, len(place))
    rows = jnp.asarray(y), jnp.asarray(share), jnp.ones(144), REACH
    found = fit(PadEdge(corners=corners), geometry, single_places(place, 4), *rows)
    border, pressed = single_places([[0.1, 0.05], [0.0999, 0.05]], 4), single_places(place, 4)
    mean, variance = (np.asarray(part)[:, 0] for part in log_gain(found, border))
    of_presses = np.asarray(log_gain(found, pressed).mean)[np.arange(144), owner(place)]
    assert found.result == FitResult.SUCCESS
    assert of_presses.min() < mean[0] < of_presses.max()
    dipped = -np.log(0.6) - (-np.log(1 - 0.4 * np.exp(-0.05 / 0.01)) - true.min())
    assert abs(mean[0] - dipped) < 3 * np.sqrt(variance[0])
    free = eqx.tree_at(lambda f: f.reach, found, jnp.array([[[0.0, 0.0], [0.2, 0.2]]] * 4))
    if not corners:  # so that the bound matters here
        assert abs(log_gain(free, border).mean[0, 0]) > 1  # what the coefficients alone would say


@pytest.mark.slow
@pytest.mark.parametrize(("place", "told"), [(grid(12), "10 to 25 mm"), (jittered(64, 5), ""), (grid(2), "")])
def test_distances_to_walls_without_presses_are_told(skin, geometry, place, told):
    share, places = np.eye(4)[owner(place)], single_places(place, 4)
    note = unpressed_note(fit(PadEdge(), geometry, places, *press_rows(place, dip(skin, place))), places, share)
    assert re.search(told, note) if told else not note
    other = fit(RadialBasis(), geometry, places, *press_rows(place, dip(skin, place)))
    assert not unpressed_note(other, places, share)
    spline = fit(PadEdgeSpline(), geometry, places, *press_rows(place, dip(skin, place)))
    assert unpressed_note(spline, places, share) == note.replace("calibrate with --location edge-spline, or ", "")
    assert not unpressed_note(None, places, share)


def test_two_contacts_on_one_pad_share_its_gain_by_their_weights(fitted):
    _, _, found = fitted
    a, b = np.array([0.015, 0.05]), np.array([0.06, 0.05])
    alone = np.asarray(log_gain(found, single_places(np.stack([a, b]), 4)).mean)[:, 0]
    weight = jnp.asarray([[[0.25, 0, 0, 0], [0.75, 0, 0, 0]]])
    both = Places(jnp.asarray([[a, b]]), weight, jnp.full((1, 2), 0.01), jnp.ones((1, 2)))
    mean = np.asarray(log_gain(found, both).mean)[0]
    assert mean[0] == pytest.approx(0.25 * alone[0] + 0.75 * alone[1])
    assert (mean[1:] == 0).all()


@pytest.mark.parametrize("field", [PadEdge(), GaussianProcess()], ids=lambda f: type(f).__name__)
def test_many_fits_mapped_wait_for_no_thread(geometry, field):
    """See `jaxeit.linalg.lapack`."""
    place = jittered(64, 2)
    ratio, *rows = press_rows(place, np.zeros(len(place)))

    def one(ratio):
        return fit_field(field, geometry, single_places(place, 4), ratio, *rows).coefficients

    many = jax.ShapeDtypeStruct((100_000, *ratio.shape), jnp.float64)
    assert not spread_stacks(jax.jit(jax.vmap(one)).lower(many).as_text())


@pytest.mark.parametrize("bumps", [1, 5, 12, 20])
def test_principal_functions_are_the_same_on_every_machine(monkeypatch, bumps):
    """LAPACK leaves the signs of eigenvectors open; coefficients in files are those of functions of one sign."""
    field, eigh = PadEdgeSpline(bumps=bumps), np.linalg.eigh
    expected = field.principal()
    for seed in range(3):
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], bumps)
        monkeypatch.setattr(np.linalg, "eigh", lambda a, signs=signs: (eigh(a)[0], eigh(a)[1] * signs))
        np.testing.assert_array_equal(field.principal(), expected)
    # Rounding does not decide: no coefficient of the other sign is nearly as large.
    assert (expected.max(0) > (1 + 1e-4) * -expected.min(0)).all()


@pytest.mark.parametrize("field", [PadEdge(), PadEdgeSpline()], ids=lambda f: f.name)
def test_pulls_and_intervals_over_many_simulated_fits(skin, geometry, field):
    """1,000 sessions in one compiled call: pulls of mean 0 and deviation 1, and 90 % intervals that cover 90 %."""
    trials, place = 1000, jittered(64, 2)
    truth = np.random.default_rng(3).normal(0, 0.3, (trials, field.size(4)))
    features = np.asarray(features_of(field, geometry, single_places(place, 4)))
    own = np.arange(len(place)), owner(place)
    new = jittered(8, 4)
    at = np.asarray(features_of(field, geometry, single_places(new, 4)))[np.arange(8), owner(new)]
    noise = np.random.default_rng(5).normal(0, 0.03, (trials, len(place)))
    rows = press_rows(place, truth @ features[own].T + noise)

    def one(log_ratio):
        found = fit_field(field, geometry, single_places(place, 4), log_ratio, *rows[1:])
        mean, variance = found.log_gain(single_places(new, 4))
        return mean[np.arange(8), owner(new)], variance[np.arange(8), owner(new)], found.centre, found.result

    mean, variance, centre, result = eqx.filter_jit(jax.vmap(one))(rows[0])
    assert (np.asarray(result) == 0).all()
    true = truth @ (at - np.asarray(centre[0])[owner(new)]).T
    pull = (np.asarray(mean) - true) / np.sqrt(variance)
    np.testing.assert_allclose(pull.mean(0), 0, atol=4 / np.sqrt(trials))
    np.testing.assert_allclose(pull.std(0), 1, atol=4 / np.sqrt(2 * trials) + 0.03)
    cover = np.mean(np.abs(pull) < 1.645)
    assert 0.88 < cover < 0.92


# --- curves and field together ---------------------------------------------------------------------------------------


def session_data(skin, *, depth=True, noise=0.02, seed=0, side=8):
    """Presses of ramps to 20 N on pads of 0.01 N/Pa whose gain dips at their edges."""
    place = grid(side)
    rng = np.random.default_rng(seed)
    gain = np.exp(dip(skin, place)) if depth else np.ones(len(place))
    load = np.tile(np.linspace(2, 20, 10), (len(place), 1))
    own = np.eye(4)[owner(place)]
    scatter = np.exp(rng.normal(0, noise, len(place)))
    hold = own * (20 / 0.01 / gain * scatter)[:, None]
    pressure = (own[:, None] * (load / 0.01 / gain[:, None] * scatter[:, None])[..., None]).reshape(-1, 4)
    press = np.repeat(np.arange(len(place)), 10)
    return place, PressData(
        sample_pressure=pressure.T,
        sample_force=load.ravel(),
        sample_press=press,
        mask=own[press].T > 0,
        pressure=hold,
        force=np.full(len(place), 20.0),
        place=np.arange(len(place)),
        reach=np.asarray(REACH),
    )


@pytest.mark.slow
def test_curve_and_field_are_found_together_and_held_out_by_place(skin, geometry):
    place, data = session_data(skin)
    places = single_places(place, 4)
    presses = LocatedPresses(data, geometry, places)
    hybrid = fit_pads(Linear(), PadEdge(), presses, SoftL1())
    slope = np.asarray(hybrid.curves.parameters)[:, 0]
    np.testing.assert_allclose(slope, 0.01, rtol=0.02)
    force, error, valid = hybrid.pad_forces(data.pressure, places)
    assert valid[data.pressure > 0].all()
    blind, blind_error, _ = hybrid.pad_forces(data.pressure)
    rms = [np.sqrt(np.mean((f.sum(1) - 20) ** 2)) for f in (force, blind)]
    assert rms[0] < 0.8 < 1.2 < rms[1]
    loaded = np.arange(len(place)), owner(place)
    assert (error[loaded] < blind_error[loaded]).all()
    fold = folds_by_place(data.place, 4)
    held = Folds(presses, SoftL1(), fold).hold_out(Linear(), PadEdge()).hold.force
    assert np.std(held.sum(1)) / np.mean(held.sum(1)) < 0.05
    lied = replace(data, force=np.where(fold == 0, 99.0, data.force))
    again = Folds(presses._replace(data=lied), SoftL1(), fold).hold_out(Linear(), PadEdge()).hold.force
    np.testing.assert_array_equal(again[fold == 0], held[fold == 0])


@pytest.mark.parametrize("name", ["affine", "hysteresis"])
def test_a_pad_at_rest_bears_nothing_whatever_the_offset_of_its_curve(name, skin, geometry):
    """The offsets of all four pads counted, and were taken from the force of each: 24 N of error at 20 N."""
    _, data = session_data(skin, depth=False)
    presses = LocatedPresses(data, geometry)
    model = fit_pads(CURVES.make(name), None, presses, SoftL1())
    np.testing.assert_allclose(np.asarray(model.curves.parameters)[:, 0], 0.01, rtol=0.03)
    force, error, _ = model.pad_forces(data.pressure)
    np.testing.assert_allclose(force.sum(1), 20, rtol=0.1)
    assert (force[data.pressure == 0] == 0).all()
    assert np.isfinite(error).all()


@pytest.mark.slow
def test_the_simplest_within_one_standard_error_is_chosen_and_says_why(skin, geometry):
    for depth, name in ((True, "edge"), (False, "none")):
        place, data = session_data(skin, depth=depth)
        fold = folds_by_place(data.place, 4)
        presses = LocatedPresses(data, geometry, single_places(place, 4))
        found = choose([Linear()], [PadEdge(), None, Constant()], Folds(presses, SoftL1(), fold))
        assert found.why.startswith(f"{name}, the simplest within one standard error")
        assert (FIELDS.name_of(found.field) if found.field else "none") == name
        assert isinstance(found.curve, Linear)


def test_thinned_presses_keep_their_means_and_order():
    press = np.repeat([0, 1, 2], [10, 3, 1])
    force = np.arange(14.0)
    rows, pressure, load = block_means(PressSeries(press, np.stack([force, 2 * force], 1), force), 5)
    assert rows.tolist() == [0] * 5 + [1] * 3 + [2]
    np.testing.assert_allclose(load, [0.5, 2.5, 4.5, 6.5, 8.5, 10, 11, 12, 13])
    np.testing.assert_allclose(pressure[:, 1], 2 * load)


def test_no_press_is_thinned_to_none():
    """As of a pad that no press rests on alone."""
    none = block_means(PressSeries(np.zeros(0, int), np.zeros((0, 2)), np.zeros(0)), 5)
    assert [part.shape for part in none] == [(0,), (0, 2), (0,)]
