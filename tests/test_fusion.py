"""Fusion: the map sums to the pads' forces, whatever the image."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je

from .helpers import require_identical, stand_in


@pytest.fixture(scope="module")
def masks(skin, pixels):
    return je.pad_masks(skin, pixels)


def _bump(pixels, centre, width=0.012):
    square = jnp.sum((pixels.centres - jnp.asarray(centre)) ** 2, -1)
    return jnp.exp(-0.5 * square / width**2)


def _per_pad(fmap, masks):
    """Sums over pads that do not overlap."""
    return np.asarray(masks.weights) @ np.asarray(fmap.force)


def test_sums_to_the_pad_forces(pixels, masks):
    image = _bump(pixels, (0.05, 0.05)) + 0.3 * jax.random.normal(jax.random.key(0), (pixels.size,))
    forces = jnp.array([12.0, 0.5, 3.0, 7.0])
    fmap = je.fuse(image, masks, forces)
    np.testing.assert_allclose(_per_pad(fmap, masks), forces, rtol=1e-12)
    assert float(fmap.force.sum()) == pytest.approx(22.5, rel=1e-12)
    assert (np.asarray(fmap.force) >= 0).all()


def test_the_formula_of_the_paper_where_the_image_is_positive(pixels, masks):
    image = _bump(pixels, (0.05, 0.05), width=0.05)
    fmap = je.fuse(image, masks, jnp.array([10.0, 4.0, 3.0, 2.0]))
    assert np.asarray(fmap.valid).all()
    mine = np.asarray(masks.weights[0] * image * masks.areas)
    inside = np.asarray(masks.weights[0]) == 1
    np.testing.assert_allclose(np.asarray(fmap.force)[inside], (10 * mine / mine.sum())[inside], rtol=1e-12)


def test_noise_is_spread_evenly_and_flagged(pixels, masks):
    """The printed equation 4 would divide by a sum near zero here."""
    noise = jax.random.normal(jax.random.key(3), (pixels.size,))
    noise = noise - noise.mean()
    fmap = je.fuse(noise, masks, jnp.full(4, 5.0))
    assert not np.asarray(fmap.valid).any()
    pressure = np.asarray(fmap.pressure)
    np.testing.assert_allclose(pressure, 5.0 / 0.01, rtol=1e-3)
    printed = np.asarray(masks.weights[0] * noise)
    assert np.abs(5.0 * printed / printed.sum()).sum() > 3 * 5.0  # what the gate prevents


def test_a_dead_image_or_pad_leaves_the_other_pads_alone(pixels, masks):
    image = _bump(pixels, (0.05, 0.05)) + _bump(pixels, (0.15, 0.15))
    forces = jnp.array([10.0, 1.0, 1.0, 8.0])
    healthy = je.fuse(image, masks, forces)
    pad0 = np.asarray(masks.weights[0]) > 0

    silent = je.fuse(image, masks, forces.at[0].set(jnp.nan))
    assert np.isnan(np.asarray(silent.force)[pad0]).all()
    np.testing.assert_array_equal(np.asarray(silent.force)[~pad0], np.asarray(healthy.force)[~pad0])

    broken = je.fuse(image.at[int(np.flatnonzero(pad0)[5])].set(jnp.nan), masks, forces)
    assert not bool(broken.valid[0])
    assert np.isfinite(np.asarray(broken.force)).all()
    np.testing.assert_array_equal(np.asarray(broken.force)[~pad0], np.asarray(healthy.force)[~pad0])


@pytest.mark.parametrize("force", [0.0, -3.0])
def test_no_force_or_suction_is_not_a_contact(pixels, masks, force):
    fmap = je.fuse(_bump(pixels, (0.05, 0.05)), masks, jnp.array([force, 0.0, 0.0, 0.0]))
    assert not bool(fmap.valid[0])
    assert float(fmap.force.sum()) == pytest.approx(force, abs=1e-12)


def test_overlapping_pads_share(skin, pixels):
    wide = [replace(skin.pads[0], outline=np.array([[0, 0], [0.12, 0], [0.12, 0.2], [0, 0.2]]))]
    wide += [replace(skin.pads[1], outline=np.array([[0.08, 0], [0.2, 0], [0.2, 0.2], [0.08, 0.2]]))]
    masks = je.pad_masks(replace(skin, pads=tuple(wide)), pixels)
    np.testing.assert_allclose(np.asarray(masks.weights).sum(0), 1.0, rtol=1e-9)
    fmap = je.fuse(_bump(pixels, (0.1, 0.1)), masks, jnp.array([6.0, 4.0]))
    assert float(fmap.force.sum()) == pytest.approx(10.0, rel=1e-12)


def test_another_force_or_gate_compiles_nothing_anew(pixels, masks, compilations):
    image = jnp.asarray(np.random.default_rng(5).normal(size=len(pixels.centres)))
    je.fuse(image, masks, [0.0, 0.0, 11.0, 0.0], gate=0.55)
    compilations.clear()
    for force in (12.0, 13.0):
        found = je.fuse(image, masks, [0.0, 0.0, force, 0.0], gate=0.6 + force / 1e3)
        np.testing.assert_allclose(np.asarray(found.force).sum(), force)
    assert not compilations


def test_batches_and_gradients(pixels, masks):
    image = jnp.stack([_bump(pixels, (0.05, 0.05)), -_bump(pixels, (0.05, 0.15))])
    forces = jnp.array([[1.0, 2.0, 3.0, 4.0], [4.0, 3.0, 2.0, 1.0]])
    fmap = je.fuse(image, masks, forces)
    np.testing.assert_allclose(fmap.force[1], je.fuse(image[1], masks, forces[1]).force, rtol=1e-12)
    slope = jax.grad(lambda x: (je.fuse(x, masks, forces[0]).force ** 2).sum())(jnp.zeros(pixels.size))
    assert np.isfinite(np.asarray(slope)).all()
    assert np.asarray(fmap).shape == (2, pixels.size)


def test_shapes_that_do_not_fit_are_refused(skin, model, pixels, masks):
    with pytest.raises(je.fusion.FusionError, match="400 pixels and 4 pads"):
        je.fuse(jnp.zeros(10), masks, jnp.zeros(4))
    away = replace(skin.pads[0], outline=np.array([[1.0, 1.0], [1.1, 1.0], [1.1, 1.1]]))
    with pytest.raises(je.skin.SkinError, match=r"pad 'lower left': reaches .* beyond the sheet"):
        replace(skin, pads=(away,))
    with pytest.raises(je.fusion.FusionError, match="lower left"):
        je.pad_masks(stand_in(je.Skin, domain=skin.domain, pads=(away,)), pixels)
    with pytest.raises(je.fusion.FusionError, match=r"basis=Pixels"):
        je.pad_masks(skin, je.Elements().on(model))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            {"pad_forces": np.array([1 + 1j, 2, 3, 4])},
            "pad_forces is complex; give real numbers, such as pad_forces.real",
        ),
        ({"pad_forces": "abcd"}, "pad_forces is 'abcd'; give an array of real numbers"),
        ({"pad_errors": np.full(4, 1j)}, "pad_errors is complex"),
        ({"pad_errors": np.ones(3)}, r"pad_errors has shape \(3,\); give a standard error, N, of each of 4 pads"),
        ({"image": np.full(400, 1j)}, "image is complex"),
        (
            {"image": np.zeros((3, 400)), "pad_forces": np.zeros((2, 4))},
            r"^image \(3, 400\), pad_forces \(2, 4\): give pad forces for as many images, or for one$",
        ),
        (
            {"masks": np.ones((4, 400))},
            r"fuse: ndarray is not masks of pads; give those of jaxeit.pad_masks\(skin, recon",
        ),
        ({"contacts": "two"}, "fuse: 'two' is not shares of contacts; give shares of jaxeit.fusion.contact_shares"),
    ],
)
def test_what_is_no_image_force_or_mask_is_refused(pixels, masks, wrong, message):
    given = {"image": jnp.zeros(pixels.size), "masks": masks, "pad_forces": jnp.zeros(4)} | wrong
    with pytest.raises(je.fusion.FusionError, match=message):
        je.fuse(**given)


def test_masks_are_of_a_skin_and_an_image(skin, model, pixels):
    with pytest.raises(je.fusion.FusionError, match=r"pad_masks: Model is not a skin; give one, such as"):
        je.pad_masks(model, pixels)
    with pytest.raises(
        je.fusion.FusionError, match=r"pad_masks: Skin is not an image; give a reconstructor, or a basis"
    ):
        je.pad_masks(skin, skin)


def test_the_image_of_another_sheet_is_refused(skin, pixels):
    wide = replace(skin, name="wide", domain=je.Rectangle(0.3, 0.2), pads=())
    said = r"the image spans \(0, 0\) to \(0.2, 0.2\) m, but the sheet of 'wide' \(0, 0\) to \(0.3, 0.2\) m; give an"
    with pytest.raises(je.fusion.FusionError, match=said):
        je.pad_masks(wide, pixels)
    assert je.pad_masks(replace(skin, domain=je.Rectangle(0.201, 0.2)), pixels).shape == pixels.shape


@pytest.mark.parametrize("gate", [-3.0, 1.5, np.nan, "high", [0.6, 0.6]])
def test_a_gate_is_a_number_from_0_to_1(pixels, masks, gate):
    with pytest.raises(je.fusion.FusionError, match=r"gate is .*; give the smallest concentration of a valid image"):
        je.fuse(jnp.zeros(pixels.size), masks, jnp.zeros(4), gate=gate)


# --- several contacts on one pad -----------------------------------------------------------------

PLACES = jnp.array([[0.03, 0.05], [0.075, 0.05]])  # both on pad 0
WIDTHS = jnp.array([0.009, 0.012])


def _shares(pixels, masks, amplitudes, places=PLACES):
    return je.fusion.contact_shares(places, WIDTHS, jnp.asarray(amplitudes), pixels.centres, masks)


def test_contacts_share_a_pad_by_the_integrals_of_their_bumps_inside_it(pixels, masks):
    shares = _shares(pixels, masks, [2.0, 1.0])
    integral = np.array([2.0, 1.0]) * np.asarray(WIDTHS) ** 2
    np.testing.assert_allclose(shares.share[:, 0], integral / integral.sum(), rtol=0.02)  # the pad's edge cuts a little
    np.testing.assert_allclose(np.asarray(shares.share).sum(0), 1, rtol=1e-12)
    np.testing.assert_allclose(np.asarray(shares.part).sum(0), 1, rtol=1e-12)
    beside = _shares(pixels, masks, [2.0, 1.0], PLACES.at[1].set(jnp.array([0.15, 0.05])))
    np.testing.assert_allclose(np.asarray(beside.share)[:, :2], np.eye(2), atol=1e-12)  # each on a pad of its own
    alone = _shares(pixels, masks, [2.0, 0.0], PLACES.at[1].set(jnp.nan))
    np.testing.assert_array_equal(alone.share[1], 0)
    assert not np.asarray(_shares(pixels, masks, [0.0, 0.0]).share).any()


def test_each_contact_has_its_share_of_the_map_whatever_the_image_shows_of_it(pixels, masks):
    """The image shows both alike; the fit knows that the first is twice as strong."""
    image = _bump(pixels, PLACES[0]) + _bump(pixels, PLACES[1])
    shares, forces = _shares(pixels, masks, [3.0, 1.0]), jnp.array([12.0, 3.0, 0.0, 0.0])
    fmap = je.fuse(image, masks, forces, contacts=shares)
    np.testing.assert_allclose(_per_pad(fmap, masks), forces, rtol=1e-12)
    on_pad = np.asarray(masks.weights[0]) * np.asarray(fmap.force)
    np.testing.assert_allclose(np.asarray(shares.part) @ on_pad, 12 * np.asarray(shares.share[:, 0]), rtol=0.05)
    plain = je.fuse(image, masks, forces)
    assert float(shares.part[0] @ (masks.weights[0] * plain.force)) == pytest.approx(6, abs=0.2)  # what the image says
    slope = jax.grad(lambda a: je.fuse(image, masks, forces, contacts=_shares(pixels, masks, a)).force[150])
    assert np.isfinite(np.asarray(slope(jnp.array([3.0, 1.0])))).all()


@pytest.mark.parametrize("amplitudes", [[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]])
def test_one_contact_or_none_leaves_the_map_as_the_image_has_it(pixels, masks, amplitudes):
    image, forces = _bump(pixels, PLACES[0], 0.03), jnp.array([12.0, 3.0, -1.0, jnp.nan])
    found = je.fuse(image, masks, forces, contacts=_shares(pixels, masks, amplitudes))
    require_identical(found.force, je.fuse(image, masks, forces).force)


def test_errors_of_the_pads_become_those_of_their_pixels(pixels, masks):
    image, forces, errors = _bump(pixels, (0.05, 0.05)), jnp.array([12.0, 0.0, 3.0, 7.0]), jnp.array([1.2, 0.5, 0.3, 0])
    found = je.fuse(image, masks, forces, pad_errors=errors)
    np.testing.assert_allclose(_per_pad(replace(found, force=found.standard_error), masks), errors, rtol=1e-12)
    mine = np.asarray(masks.weights[0]) > 0
    np.testing.assert_allclose(np.asarray(found.standard_error)[mine], 0.1 * np.asarray(found.force)[mine], rtol=1e-12)
    assert je.fuse(image, masks, forces).standard_error is None
