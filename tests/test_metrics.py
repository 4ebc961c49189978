"""Figures of merit against discs and ellipses worked out by hand, and slow direct sums."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.io import loadmat
from scipy.signal import fftconvolve

import jaxeit as je
from jaxeit.metrics import (
    ESTIMATORS,
    GreitFigures,
    MetricError,
    greit_figures,
    image_correlation,
    inward_bias,
    ktc_score,
    localisation_error,
    otsu_thresholds,
    structural_similarity,
)

from .helpers import REAL_DATA

TRUTHS = sorted((REAL_DATA / "ktc2023" / "groundtruth_training").glob("true*.mat"))
NAMES = [*ESTIMATORS, *ESTIMATORS.words]
FIELDS = ("amplitude", "position_error", "resolution", "shape_deformation", "ringing")


class Grid(NamedTuple):
    """As much of a reconstruction as the metrics look at."""

    centres: np.ndarray
    areas: np.ndarray
    shape: tuple = ()


def grid(x, y):
    """Pixels between the lines at x and at y."""
    middle, size = [(e[1:] + e[:-1]) / 2 for e in (x, y)], [np.diff(e) for e in (x, y)]
    centres = np.stack([a.ravel() for a in np.meshgrid(*middle)], 1)
    return Grid(centres, np.outer(size[1], size[0]).ravel())


def even(n=240, side=0.2):
    return grid(np.linspace(0, side, n + 1), np.linspace(0, side, n + 1))


def graded():
    """Pixels of very different areas, sixteen to one; the smallest in the middle."""
    t = np.linspace(0, 1, 241)
    line = 0.2 * (t + 0.6 * np.sin(2 * np.pi * t) / (2 * np.pi))
    return grid(line, line)


def values(figures):
    return np.array([getattr(figures, name) for name in FIELDS])


def from_middle(g, place):
    return np.linalg.norm(g.centres - np.asarray(place), axis=1)


CENTRE = (0.1, 0.1)


# --- GREIT -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [even, graded])
def test_a_disc_with_a_negative_ring(make):
    """Value 2 within 20 mm of (0.13, 0.1), -0.5 from 20 to 30 mm; the contact was 45 mm off the centre."""
    g = make()
    r = from_middle(g, (0.13, 0.1))
    image = np.where(r < 0.02, 2.0, np.where(r < 0.03, -0.5, 0.0))
    found = greit_figures(image, g, (0.1, 0.145), CENTRE)
    disc, ring = np.pi * 0.02**2, np.pi * (0.03**2 - 0.02**2)
    expected = [2 * disc - 0.5 * ring, 0.045 - 0.03, np.sqrt(disc / 0.04), 0.0, 0.25 * ring / disc]
    scale = [expected[0], 0.02, 1, 1, 1]
    np.testing.assert_allclose(values(found) / scale, np.divide(expected, scale), atol=5e-3)


@pytest.mark.parametrize("make", [even, graded])
@pytest.mark.parametrize("ratio", [1.5, 2.0, 4.0])
def test_shape_deformation_of_an_ellipse(make, ratio):
    """The share of an ellipse outside its equal-area circle: (2/pi)(atan sqrt(a/b) - atan sqrt(b/a))."""
    g = make()
    a, b = 0.03 * np.sqrt(ratio), 0.03 / np.sqrt(ratio)
    inside = (((g.centres - 0.1) / (a, b)) ** 2).sum(1) < 1
    found = greit_figures(inside.astype(float), g, CENTRE, CENTRE)
    exact = 2 / np.pi * (np.arctan(np.sqrt(ratio)) - np.arctan(np.sqrt(1 / ratio)))
    assert abs(float(found.shape_deformation) - exact) < 5e-3
    assert abs(float(found.position_error)) < 1e-4


def test_a_quarter_of_the_largest_value_is_what_lights_up():
    g = even(100)
    r = from_middle(g, CENTRE)
    cone = np.maximum(1 - r / 0.08, 0)  # a quarter at 60 mm
    found = greit_figures(cone, g, CENTRE, CENTRE)
    assert abs(float(found.resolution) - np.sqrt(np.pi * 0.06**2 / 0.04)) < 3e-3
    np.testing.assert_array_equal(values(greit_figures(1e-6 * cone, g, CENTRE, CENTRE))[1:], values(found)[1:])


def slow_figures(image, g, target, centre):
    on = [k for k in range(len(image)) if g.areas[k] > 0]
    q = [k for k in on if image[k] >= 0.25 * max(image[k] for k in on)]
    area = sum(g.areas[k] for k in q)
    x, y = (sum(g.areas[k] * g.centres[k][i] for k in q) / area for i in (0, 1))
    off = [k for k in q if np.hypot(g.centres[k][0] - x, g.centres[k][1] - y) >= np.sqrt(area / np.pi)]
    return [
        sum(g.areas[k] * image[k] for k in on),
        np.hypot(*np.subtract(target, centre)) - np.hypot(x - centre[0], y - centre[1]),
        np.sqrt(area / sum(g.areas)),
        sum(g.areas[k] for k in off) / area,
        -sum(g.areas[k] * image[k] for k in on if image[k] < 0) / sum(g.areas[k] * image[k] for k in q),
    ]


@pytest.fixture(scope="module")
def patchy():
    """A round sheet on a square picture: some pixels hold none of it, some a part."""
    g = even(16)
    share = np.clip((0.1 - from_middle(g, CENTRE)) / 0.0125 + 0.5, 0, 1)
    assert (share == 0).any()
    assert ((share > 0) & (share < 1)).any()
    return Grid(g.centres, g.areas * share)


@pytest.fixture(scope="module")
def batch(patchy):
    image = np.random.default_rng(0).normal(size=(2, 3, len(patchy.areas)))
    return image + 4 * np.exp(-0.5 * (from_middle(patchy, (0.12, 0.07)) / 0.03) ** 2)


def test_batches_are_direct_sums_pixel_by_pixel(patchy, batch):
    targets = np.random.default_rng(1).uniform(0.05, 0.15, (2, 3, 2))
    found = greit_figures(batch, patchy, targets, CENTRE)
    for i, j in np.ndindex(2, 3):
        expected = slow_figures(batch[i, j], patchy, targets[i, j], CENTRE)
        np.testing.assert_allclose([getattr(found, name)[i, j] for name in FIELDS], expected, rtol=1e-9, atol=1e-12)


def test_pixels_off_the_sheet_may_hold_anything(patchy, batch):
    broken = np.where(patchy.areas > 0, batch, np.nan)
    for a, b in zip(
        values(greit_figures(broken, patchy, CENTRE, CENTRE)),
        values(greit_figures(batch, patchy, CENTRE, CENTRE)),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)
    other = batch[::-1]
    broken_too = np.where(patchy.areas > 0, other, 1e300)
    np.testing.assert_array_equal(
        image_correlation(broken, broken_too, patchy.areas), image_correlation(batch, other, patchy.areas)
    )


def test_nothing_positive_is_not_a_number_but_its_neighbours_are(patchy, batch):
    image = np.stack([batch[0, 0], np.zeros(256), -np.abs(batch[0, 1]) - 0.1])
    found = values(greit_figures(image, patchy, CENTRE, CENTRE))
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1:, 1:]).all()
    assert np.isfinite(found[:, 0]).all()


@pytest.mark.parametrize("name", NAMES)
def test_where_nothing_is_positive_there_is_no_place(patchy, name):
    images = np.stack([np.zeros(256), -np.linspace(1, 2, 256), np.arange(256) == np.argmax(patchy.areas)])
    found = ESTIMATORS.make(name)(jnp.asarray(images, float), patchy)
    assert np.isnan(found[:2]).all()
    np.testing.assert_allclose(found[2], patchy.centres[np.argmax(patchy.areas)])


def test_figures_under_jit_vmap_and_grad(patchy, batch):
    def figures(image):
        return greit_figures(image, patchy, (0.12, 0.07), CENTRE)

    plain = figures(batch[0])
    for other in (jax.jit(figures)(batch[0]), jax.vmap(figures)(batch[0])):
        np.testing.assert_allclose(values(other), values(plain), rtol=1e-12)

    def penalty(image):
        found = figures(image)
        return jnp.sum(found.amplitude + found.ringing)

    slope = jax.grad(penalty)(jnp.asarray(batch[0]))
    step = 1e-7 * np.random.default_rng(2).normal(size=batch[0].shape)
    rise = (penalty(batch[0] + step) - penalty(batch[0] - step)) / 2
    np.testing.assert_allclose(np.sum(slope * step), rise, rtol=1e-4)
    assert np.isfinite(jax.grad(lambda t: figures(t).amplitude)(jnp.zeros(256))).all()


@pytest.mark.slow
def test_figures_of_a_reconstruction(model, pixels):
    recon = je.prepare(model, basis=pixels)
    square = jnp.sum((model.centroids - jnp.array([0.07, 0.12])) ** 2, -1)
    touched = model.background * (1 + 0.3 * jnp.exp(-0.5 * square / 0.012**2))
    image = recon(je.forward(model, touched) - je.forward(model))
    found = greit_figures(image, recon, (0.07, 0.12), CENTRE)
    assert isinstance(found, GreitFigures)
    np.testing.assert_allclose(found.amplitude, je.metrics.image_sum(image, recon.areas))
    middle = je.LevelCentroid(0.25)(image, recon)
    np.testing.assert_allclose(found.position_error, inward_bias(middle, (0.07, 0.12), CENTRE), atol=1e-12)
    assert abs(float(found.position_error)) < 6e-3
    assert 0.1 < float(found.resolution) < 0.4


def test_single_precision_stays_and_holds(patchy, batch):
    single = Grid(patchy.centres.astype("float32"), patchy.areas.astype("float32"))
    found = greit_figures(batch.astype("float32"), single, (0.12, 0.07), CENTRE)
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {jnp.dtype("float32")}
    double = values(greit_figures(batch, patchy, (0.12, 0.07), CENTRE))
    np.testing.assert_allclose(values(found), double, rtol=1e-4, atol=1e-7)


def test_lengths_by_hand_and_with_a_gradient_everywhere():
    assert float(localisation_error((3.0, 4.0), (0.0, 0.0))) == 5
    assert float(inward_bias((1.0, 0.0), (0.0, 3.0), (0.0, 0.0))) == 2
    assert np.isnan(localisation_error((np.nan, 0.0), (0.0, 0.0)))
    slope = jax.grad(lambda p: localisation_error(p, jnp.ones(2)))
    np.testing.assert_allclose(slope(jnp.array([4.0, 5.0])), [0.6, 0.8])
    np.testing.assert_array_equal(slope(jnp.ones(2)), 0)


# --- correlation -----------------------------------------------------------------------------------------------------


def test_correlation_is_that_of_pixels_counted_by_area():
    """Whole-number areas: each pixel stands there as often as its area says."""
    rng = np.random.default_rng(3)
    image, truth, areas = rng.normal(size=(2, 3, 40)), rng.normal(size=(2, 3, 40)), rng.integers(0, 4, 40)
    found = image_correlation(image, truth, areas.astype(float))
    for i, j in np.ndindex(2, 3):
        counted = [np.repeat(each[i, j], areas) for each in (image, truth)]
        np.testing.assert_allclose(found[i, j], np.corrcoef(*counted)[0, 1], rtol=1e-12)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_correlation_of_likes_opposites_and_constants(dtype):
    image = np.random.default_rng(4).normal(size=50).astype(dtype)
    areas = np.linspace(0, 1, 50).astype(dtype)
    tight = 1e-5 if dtype == "float32" else 1e-12
    assert float(image_correlation(image, 7 - 3e-3 * image, areas)) == pytest.approx(-1, abs=tight)
    assert float(image_correlation(1e-30 * image, image, areas)) == pytest.approx(1, abs=tight)
    for constant in (0.0, 0.1, 1e20):
        flat = np.full(50, constant, dtype)
        flat[0] = 5  # without area
        assert float(image_correlation(flat, image, areas)) == 0
        assert np.isfinite(jax.grad(image_correlation)(jnp.asarray(flat), image, areas)).all()


# --- structural similarity -------------------------------------------------------------------------------------------


def slow_similarity(a, b, width, c1, c2):
    """Every window by itself, its weights over the pixels that there are."""
    reach, total = int(np.ceil(2 * width)), 0.0
    for i, j in np.ndindex(a.shape):
        weight, x, y = [], [], []
        for k, m in itertools.product(range(a.shape[0]), range(a.shape[1])):
            if max(abs(i - k), abs(j - m)) <= reach:
                weight.append(np.exp(-((i - k) ** 2 + (j - m) ** 2) / (2 * width**2)))
                x.append(a[k, m])
                y.append(b[k, m])
        cov = np.cov(x, y, ddof=0, aweights=weight)
        mx, my = np.average(x, weights=weight), np.average(y, weights=weight)
        total += (2 * mx * my + c1) * (2 * cov[0, 1] + c2) / ((mx**2 + my**2 + c1) * (cov[0, 0] + cov[1, 1] + c2))
    return total / a.size


@pytest.mark.parametrize("width", [0.7, 1.5, 80.0])
def test_similarity_is_the_direct_sum(width):
    rng = np.random.default_rng(5)
    a, b = rng.uniform(size=(2, 9, 12)), rng.integers(0, 2, (2, 9, 12))
    found = structural_similarity(a, b, width=width, c1=1e-2, c2=3e-2)
    expected = [slow_similarity(x, y, width, 1e-2, 3e-2) for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def challenge_score(truth, labels):
    """The challenge's score by plain two-dimensional convolutions."""
    line = np.arange(-160, 161)
    kernel = np.exp(-(line[:, None] ** 2 + line**2) / (2 * 80.0**2))

    def mean(x):
        return fftconvolve(x, kernel, "same") / fftconvolve(np.ones(x.shape), kernel, "same")

    scores = []
    for k in (1, 2):
        a, b = (truth == k).astype(float), (labels == k).astype(float)
        ma, mb = mean(a), mean(b)
        saa, sbb, sab = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
        like = (2 * ma * mb + 1e-4) * (2 * sab + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (saa + sbb + 9e-4))
        scores.append(like.mean())
    return np.mean(scores)


def phantom():
    x, y = np.meshgrid(np.linspace(-1, 1, 256), np.linspace(1, -1, 256))
    labels = np.zeros((256, 256), int)
    labels[(x - 0.3) ** 2 + (y - 0.2) ** 2 < 0.06] = 1
    labels[(np.abs(x + 0.4) < 0.15) & (np.abs(y + 0.3) < 0.25)] = 2
    return labels


def test_the_score_of_the_challenge():
    truth = phantom()
    worse = np.roll(truth, (12, -9), (0, 1))
    assert float(ktc_score(truth, truth)) == pytest.approx(1, abs=1e-12)
    assert float(ktc_score(worse, truth)) == pytest.approx(challenge_score(truth, worse), abs=1e-9)
    one, two, neither = (np.where(keep, truth, 0) for keep in (truth == 1, truth == 2, truth > 2))
    assert float(ktc_score(one, truth)) == pytest.approx(challenge_score(truth, one), abs=1e-9)
    assert float(ktc_score(neither, neither)) == pytest.approx(1, abs=1e-12)
    scores = ktc_score(np.stack([worse, one, two]), np.stack([truth] * 3))
    assert scores.shape == (3,)


def test_similarity_has_a_gradient_and_holds_in_float32():
    a, b = jnp.asarray(phantom() == 1, float), jnp.asarray(phantom() == 2, float)
    small = a[::16, ::16], b[::16, ::16]
    slope = jax.jit(jax.grad(lambda x: structural_similarity(x, small[1], width=5.0)))(small[0])
    step = 1e-6 * np.random.default_rng(6).normal(size=slope.shape)
    rise = structural_similarity(small[0] + step, small[1], width=5.0) - structural_similarity(
        small[0] - step, small[1], width=5.0
    )
    np.testing.assert_allclose(np.sum(slope * step), rise / 2, rtol=1e-5)
    assert np.isfinite(jax.grad(lambda x: structural_similarity(x, x * 0))(jnp.zeros((5, 5)))).all()
    single = structural_similarity(a.astype("float32"), b.astype("float32"))
    assert single.dtype == jnp.float32
    assert float(single) == pytest.approx(float(structural_similarity(a, b)), abs=1e-5)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: ktc_score(np.zeros((4, 4)), np.zeros((4, 5))), "one shape"),
        (lambda: structural_similarity(np.zeros(4), np.zeros(4)), "one shape"),
        (lambda: structural_similarity(np.zeros((4, 0)), np.zeros((4, 0))), "one shape"),
        (lambda: structural_similarity(np.zeros((4, 4)), np.zeros((4, 4)), width=0), "above zero"),
        (lambda: otsu_thresholds(np.arange(9.0), 1), "at least 2"),
        (lambda: otsu_thresholds(np.arange(9.0), 5, bins=4), "no more"),
        (lambda: otsu_thresholds(np.zeros(0)), "one for each"),
        (lambda: otsu_thresholds(np.arange(9.0), weights=np.ones(8)), "one for each"),
    ],
)
def test_what_cannot_be_compared_is_refused(call, words):
    with pytest.raises(MetricError, match=words):
        call()


@pytest.mark.skipif(not TRUTHS, reason="ktc2023 is not at hand; set JAXEIT_REAL_DATA to its folder")
@pytest.mark.parametrize("path", TRUTHS, ids=lambda p: p.stem)
def test_the_pictures_of_the_challenge(path):
    truth = loadmat(path)["truth"]
    assert truth.shape == (256, 256)
    assert set(np.unique(truth)) <= {0, 1, 2}
    assert float(ktc_score(truth, truth)) == pytest.approx(1, abs=1e-12)
    for other in (np.zeros_like(truth), truth.T, np.roll(truth, 20, 1)):
        assert float(ktc_score(other, truth)) == pytest.approx(challenge_score(truth, other), abs=1e-9)


# --- Otsu ------------------------------------------------------------------------------------------------------------


def slow_thresholds(values, classes, bins):
    """Variance between classes of every choice of edges, from the binned values themselves."""
    count, edges = np.histogram(values, bins)
    middle = (edges[1:] + edges[:-1]) / 2
    best = (-1.0, None)
    for cuts in itertools.combinations(range(1, bins), classes - 1):
        parts = [slice(a, b) for a, b in itertools.pairwise((0, *cuts, bins))]
        if all(count[p].sum() for p in parts):
            means = [np.average(middle[p], weights=count[p]) for p in parts]
            spread = sum(
                count[p].sum() * (m - np.average(middle, weights=count)) ** 2 for p, m in zip(parts, means, strict=True)
            )
            if spread > best[0] * (1 + 1e-12):
                best = (spread, edges[list(cuts)])
    return best[1]


@pytest.mark.parametrize(("classes", "bins"), [(2, 256), (3, 48), (4, 20)])
def test_otsu_is_the_best_of_all_edges(classes, bins):
    rng = np.random.default_rng(classes)
    values = np.concatenate([rng.normal(m, s, n) for m, s, n in ((0, 1, 900), (3, 0.5, 200), (-4, 0.3, 60))])
    found = np.asarray(otsu_thresholds(values, classes, bins=bins))
    slow = slow_thresholds(values, classes, bins)
    np.testing.assert_array_equal(
        np.searchsorted(found, values, side="right"), np.searchsorted(slow, values, side="right")
    )


def test_otsu_in_the_middle_of_the_gaps():
    values = np.array([[0.0, 0.1, 0.1, 4.0], [4.1, 10.0, 4.0, 0.05]])
    np.testing.assert_allclose(otsu_thresholds(values), [2.05, 7.05], atol=10 / 256)
    np.testing.assert_allclose(otsu_thresholds(values, 2), [2.05], atol=10 / 256)
    np.testing.assert_allclose(otsu_thresholds(np.array([0, 10, 20])), [5, 15], atol=20 / 256)


def test_otsu_counts_by_weight_and_leaves_out_what_is_not_finite():
    rng = np.random.default_rng(7)
    values, weights = rng.normal(size=300), rng.integers(0, 4, 300).astype(float)
    values[weights == 0] *= 50
    expected = otsu_thresholds(np.repeat(values, weights.astype(int)))
    np.testing.assert_allclose(otsu_thresholds(values, weights=weights), expected, rtol=1e-12)
    broken = np.where(weights == 0, np.nan, values)
    broken[np.argmin(weights)] = np.inf
    np.testing.assert_allclose(otsu_thresholds(broken, weights=weights), expected, rtol=1e-12)


def test_otsu_of_too_little():
    np.testing.assert_array_equal(otsu_thresholds(np.full(9, 0.3)), [0.3, 0.3])
    two = otsu_thresholds(np.array([0.0, 1.0, 1.0]), 3)
    assert set(np.searchsorted(two, [0.0, 1.0], side="right")) in ({0, 1}, {0, 2}, {1, 2})
    assert np.isnan(otsu_thresholds(np.full(9, np.nan))).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_otsu_under_jit_and_vmap_keeps_its_precision(dtype):
    values = np.random.default_rng(8).normal(size=(3, 200)).astype(dtype) + np.arange(200) // 70
    values = values.astype(dtype)
    found = jax.jit(jax.vmap(otsu_thresholds))(values)
    assert found.dtype == dtype
    for row, each in zip(found, values, strict=True):
        # Programs compiled apart may round apart.
        np.testing.assert_allclose(row, otsu_thresholds(each), rtol=0, atol=8 * np.finfo(dtype).eps)


@pytest.mark.parametrize("name", NAMES)
def test_an_image_of_other_pixels_is_refused(name):
    estimator = ESTIMATORS.make(name)
    grid = Grid(np.zeros((9, 2)), np.ones(9))
    said = r"image of shape \(2, 4\); give \(..., 9\), one number for each pixel of recon"
    with pytest.raises(MetricError, match=said):
        estimator(np.ones((2, 4)), grid)
    with pytest.raises(MetricError, match=r"Pixels has no pixels; give a reconstructor, or Pixels\(20\)"):
        estimator(np.ones((2, 4)), je.Pixels(2))


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda m, grid: m.Peak()(np.ones(9) * 1j, grid), "image is complex; give real numbers, such as image.real"),
        (lambda m, grid: m.LevelCentroid()("x", grid), "image is 'x'; give an array of real numbers"),
        (lambda m, grid: m.localisation_error([1j, 2], [1, 2]), "positions is complex"),
        (lambda m, grid: m.greit_figures(np.ones(5), grid, (0, 0), (0, 0)), r"image of shape \(5,\); give \(..., 9\)"),
        (lambda m, grid: m.greit_figures(np.ones(9), 3, (0, 0), (0, 0)), "int has no pixels; give a reconstructor"),
        (lambda m, grid: m.image_correlation(np.ones(9) * 1j, np.ones(9), grid.areas), "image is complex"),
        (
            lambda m, grid: m.image_correlation(np.ones(9), np.ones(5), grid.areas),
            r"truth \(5,\), areas \(9,\); give one",
        ),
        (lambda m, grid: m.structural_similarity(np.eye(4) * 1j, np.eye(4)), "image is complex"),
        (lambda m, grid: m.otsu_thresholds(np.ones(9) * 1j), "values is complex"),
        (lambda m, grid: m.coefficient_of_variation(np.ones(0), ddof=1), r"shape \(0,\) with ddof=1; give \(..., n\)"),
        (lambda m, grid: m.coefficient_of_variation(np.ones(5), ddof="x"), "ddof='x'; .* and 0 or 1 for ddof"),
    ],
)
def test_what_is_no_image_or_position_is_refused_in_one_line(call, said):
    with pytest.raises(MetricError, match=said):
        call(je.metrics, Grid(np.zeros((9, 2)), np.ones(9)))


@pytest.mark.parametrize("shapes", [((3, 2), (4, 2)), ((3,), (3,)), ((), (2,)), ((5, 3), (5, 2))])
def test_positions_that_do_not_fit_each_other_are_refused(shapes):
    with pytest.raises(MetricError, match=r"positions of shapes .*; give \(..., 2\) m, as many true as estimated ones"):
        localisation_error(*map(np.zeros, shapes))
