"""The denominator of the paper's equation 4, where it is nearly nothing; and pads that fail."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxeit as je

FORCES = np.array([12.0, 0.5, 3.0, 7.0])


@pytest.fixture(scope="module")
def masks(skin, pixels):
    return je.pad_masks(skin, pixels)


def equation_4(image, masks, forces):
    """As printed, with what is meant: ``f(r) = sum_i F_i M_i x(r) / sum_r' M_i x(r')``."""
    image, weights = np.asarray(image, float), np.asarray(masks.weights, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (weights * image / (weights @ image)[:, None] * np.asarray(forces)[:, None]).sum(0)


def _bump(pixels, centre, height=1.0, width=0.012):
    square = ((np.asarray(pixels.centres) - centre) ** 2).sum(1)
    return height * np.exp(-0.5 * square / width**2)


def _sums(fmap, masks):
    """Over pads that do not overlap."""
    return np.asarray(masks.weights, float) @ np.asarray(fmap.force, float)


def _inflation(force, masks, forces):
    """Largest sum of magnitudes over a pad, in units of its force: one is right."""
    return float(np.max(np.asarray(masks.weights) @ np.abs(force) / np.abs(forces)))


@pytest.mark.parametrize("height", [0.0, 1e-300, 1e-12, 0.003, 0.01, 0.1, 1.0, 1e200])
def test_light_touches_are_not_blown_up(hard, pixels, masks, height):
    """Over noise of one hundredth; over many frames equation 4 gives forces a thousand times the pad's."""
    rng = np.random.default_rng(0)
    noise = 1e-2 * rng.normal(size=(200, pixels.size)) * (1e-6 < height < 1)
    images = noise + _bump(pixels, (0.05, 0.05), height)
    fmap = je.fuse(jnp.asarray(images), masks, jnp.asarray(FORCES))
    force = np.asarray(fmap.force)
    assert np.isfinite(force).all()
    assert (force >= 0).all()
    assert np.isfinite(fmap.concentration).all()
    error = np.abs(force @ np.asarray(masks.weights).T / FORCES - 1).max()
    assert error < 1e-12
    printed = [_inflation(equation_4(image, masks, FORCES), masks, FORCES) for image in images]
    worst = np.max(np.where(np.isfinite(printed), printed, np.inf))
    if noise.any() and height < 0.1:
        assert worst > 50
    said = "an even spread over the pad, flagged not valid. Errors of the pads' sums, naive: of magnitudes"
    hard(
        "fusion at a light touch",
        "0 to 1e200 of full scale over noise of 1e-2",
        float64=error,
        naive=worst - 1,
        beyond=said,
    )


def test_float32_sums_too_and_forgets_no_light_touch(hard, pixels, masks):
    small = jax.tree.map(lambda a: a.astype(jnp.float32), masks)
    worst = 0.0
    for height in (1e-12, 1e-6, 1.0, 1e12):
        image = jnp.asarray(_bump(pixels, (0.05, 0.05), height, 0.03), jnp.float32)
        fmap, slope = je.fuse(image, small, jnp.asarray(FORCES, jnp.float32)), _slope(image, small, FORCES)
        worst = max(worst, np.abs(_sums(fmap, small) / FORCES - 1).max())
        assert np.isfinite(slope).all()
        assert bool(fmap.valid[0])
    assert worst < 1e-5
    hard("fusion at a light touch", "float32 1e-12 to 1e12", float32=worst, beyond="the same")


def _slope(image, masks, forces):
    forces = jnp.asarray(forces, image.dtype)
    return np.asarray(jax.grad(lambda x: jnp.sum(je.fuse(x, masks, forces).force ** 2))(image))


@pytest.mark.parametrize("force", [0.0, -0.0, 1e-300, -1e-12, -3.0, 1e12])
def test_any_force_is_what_the_map_sums_to(hard, pixels, masks, force):
    forces = np.where(np.arange(4) == 1, force, FORCES)
    fmap = je.fuse(jnp.asarray(_bump(pixels, (0.15, 0.05))), masks, jnp.asarray(forces))
    np.testing.assert_allclose(_sums(fmap, masks), forces, rtol=1e-12, atol=1e-13)
    assert bool(fmap.valid[1]) == (force > 0)
    error = np.abs(_sums(fmap, masks)[1] - force) / max(abs(force), 1)
    hard("pad force", "-3 N, 0, 1e-300 to 1e12 N", float64=error, beyond="no contact: an even spread, not valid")


BAD = [np.nan, np.inf, -np.inf]


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("pad", range(4))
def test_a_sensor_saturated_or_dead_is_its_own_affair(hard, pixels, masks, pad, bad):
    """Fault 10: NaN where nothing is known, with a flag; what other pads say, and how it hangs on the image, stays."""
    image = jnp.asarray(_bump(pixels, (0.1, 0.1), width=0.04))
    there = np.asarray(masks.weights[pad]) > 0
    forces = np.where(np.arange(4) == pad, bad, FORCES)
    healthy, broken = (je.fuse(image, masks, jnp.asarray(f)) for f in (FORCES, forces))
    assert np.isnan(np.asarray(broken.force)[there]).all()
    assert not bool(broken.valid[pad])
    np.testing.assert_array_equal(np.asarray(broken.force)[~there], np.asarray(healthy.force)[~there])
    others = jax.grad(lambda x: jnp.sum(jnp.where(there, 0, je.fuse(x, masks, jnp.asarray(forces)).force) ** 2))(image)
    assert np.isfinite(others).all()
    assert np.abs(others).max() > 0
    assert not np.isfinite(equation_4(image, masks, forces)).any()
    said = "NaN on that pad's pixels, not valid; other pads: the same bits"
    hard("pad sensor dead or saturated", "NaN, Inf", float64=0, naive=np.inf, beyond=said)


@pytest.mark.parametrize("dead", [0.01, 1.0])
def test_a_pad_without_image_spreads_evenly(hard, pixels, masks, dead):
    """Part of the image over one pad, or all of it, is not a number."""
    rng = np.random.default_rng(1)
    there = np.asarray(masks.weights[2]) > 0
    image = _bump(pixels, (0.1, 0.1), width=0.04)
    gone = there & (rng.random(pixels.size) < dead)
    gone[np.flatnonzero(there)[0]] = True
    healthy, broken = (
        je.fuse(jnp.asarray(x), masks, jnp.asarray(FORCES)) for x in (image, np.where(gone, np.nan, image))
    )
    np.testing.assert_allclose(_sums(broken, masks), FORCES, rtol=1e-12)
    np.testing.assert_array_equal(np.asarray(broken.valid), np.arange(4) != 2)
    np.testing.assert_array_equal(np.asarray(broken.force)[~there], np.asarray(healthy.force)[~there])
    pressure = np.asarray(broken.pressure)[there]
    np.testing.assert_allclose(pressure, pressure[0], rtol=1e-9)
    hard("pad without image", "1 % and all of its pixels NaN", float64=0, beyond="an even spread, not valid")


def test_an_image_without_a_pad_carries_nothing(skin, pixels):
    """One pad of four is there: what the image shows elsewhere has no force, and harms none."""
    masks = je.pad_masks(replace(skin, pads=skin.pads[:1]), pixels)
    there = np.asarray(masks.weights[0]) > 0
    image = np.where(there, _bump(pixels, (0.05, 0.05)), 1e9 * _bump(pixels, (0.15, 0.15)))
    image[np.flatnonzero(~there)[-1]] = np.nan
    fmap = je.fuse(jnp.asarray(image), masks, jnp.array([5.0]))
    assert not np.asarray(fmap.force)[~there].any()
    assert float(fmap.force.sum()) == pytest.approx(5.0, rel=1e-12)
    assert bool(fmap.valid[0])


def test_a_mask_of_nothing_divides_nothing(pixels, masks):
    """A pad that a mask of one's own leaves without a pixel: its force is nowhere, forward and backward."""
    empty = replace(masks, weights=masks.weights.at[3].set(0))
    image = jnp.asarray(_bump(pixels, (0.1, 0.1), width=0.04))
    fmap = je.fuse(image, empty, jnp.asarray(FORCES))
    np.testing.assert_allclose(_sums(fmap, empty), [*FORCES[:3], 0], rtol=1e-12)
    assert np.isfinite(_slope(image, empty, FORCES)).all()
    part = np.asarray(empty.weights) * np.asarray(image)
    with np.errstate(invalid="ignore"):
        assert not np.isfinite(part / part.sum(1, keepdims=True)).all()


def test_a_pixel_that_misses_the_sheet_has_no_pressure_and_no_slope():
    def pressure(force):
        none = jnp.zeros(1)
        return je.fusion.ForceMap(force, none > 0, none, none, areas=jnp.array([2.0, 0.0])).pressure

    np.testing.assert_array_equal(pressure(jnp.array([1.0, 0.0])), [0.5, 0])
    np.testing.assert_array_equal(jax.jacobian(pressure)(jnp.array([1.0, 0.0])), [[0.5, 0], [0, 0]])


@pytest.mark.parametrize("place", [(0.1, 0.05), (0.1, 0.1), (0.0999999, 0.1), (0.0, 0.1), (0.2, 0.2)])
def test_a_contact_on_an_edge_is_shared_as_the_pads_say(hard, pixels, masks, place):
    """On the border of two pads, of four, at the rim: each pad has its own force of it, whatever the image's shares."""
    fmap = je.fuse(jnp.asarray(_bump(pixels, place)), masks, jnp.asarray(FORCES))
    error = np.abs(_sums(fmap, masks) / FORCES - 1).max()
    assert error < 1e-12
    assert np.isfinite(_slope(jnp.asarray(_bump(pixels, place)), masks, FORCES)).all()
    hard("contact on a pad's edge", "two pads, four, the rim", float64=error, beyond="each pad's own force")


def test_overlapping_pads_share_and_only_the_overlap_dies_with_one(hard, skin, pixels):
    outlines = [[0, 0], [0.12, 0], [0.12, 0.2], [0, 0.2]], [[0.08, 0], [0.2, 0], [0.2, 0.2], [0.08, 0.2]]
    pads = tuple(replace(pad, outline=np.array(o)) for pad, o in zip(skin.pads, outlines, strict=False))
    masks = je.pad_masks(replace(skin, pads=pads), pixels)
    image = jnp.asarray(_bump(pixels, (0.1, 0.1)))
    whole = je.fuse(image, masks, jnp.array([6.0, 4.0]))
    error = abs(float(whole.force.sum()) / 10 - 1)
    assert error < 1e-12
    broken = np.asarray(je.fuse(image, masks, jnp.array([np.nan, 4.0])).force)
    first = np.asarray(masks.weights[0]) > 0
    assert np.isnan(broken[first]).all()
    np.testing.assert_array_equal(broken[~first], np.asarray(whole.force)[~first])
    twice = replace(masks, weights=jnp.concatenate([masks.weights, masks.weights]) / 2)  # the same two, once more
    same = je.fuse(image, twice, jnp.array([3.0, 2.0, 3.0, 2.0]))
    np.testing.assert_allclose(same.force, whole.force, rtol=1e-12, atol=1e-15)
    said = "each pad gets half of a shared pixel; NaN only on the pixels of the dead pad"
    hard("overlapping pads", "a fifth of the sheet; pads twice", float64=error, beyond=said)


def test_any_image_and_any_forces_sum(pixels, masks):
    @settings(max_examples=40, derandomize=True, database=None, deadline=None)
    @given(
        st.integers(0, 2**31),
        st.integers(-100, 100),
        st.floats(0, 1),
        st.lists(st.floats(-1e6, 1e6), min_size=4, max_size=4),
    )
    def holds(seed, scale, dead, forces):
        rng = np.random.default_rng(seed)
        image = 10.0**scale * (rng.normal(size=pixels.size) + rng.choice([-3, 0, 3]))
        image[rng.random(pixels.size) < dead] = rng.choice(BAD)
        fmap = je.fuse(jnp.asarray(image), masks, jnp.asarray(forces))
        np.testing.assert_allclose(_sums(fmap, masks), forces, rtol=1e-12, atol=1e-12)
        assert np.isfinite(fmap.force).all()

    holds()
