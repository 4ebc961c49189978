"""Regions of an image, against prominences found by flooding at every level."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, label

import jaxeit as je
from jaxeit.contacts.regions import RegionError, find_regions

EIGHT = np.ones((3, 3))


class Picture(NamedTuple):
    """As much of a reconstruction as the regions look at."""

    centres: np.ndarray
    areas: np.ndarray
    shape: tuple


def picture(rows=40, columns=50, pixel=0.004):
    y, x = np.mgrid[:rows, :columns]
    centres = pixel * (np.stack([x.ravel(), y.ravel()], 1) + 0.5)
    return Picture(centres, np.full(rows * columns, pixel**2), (rows, columns))


def bump(p, place, width=0.012):
    return np.exp(-0.5 * ((p.centres - place) ** 2).sum(1) / width**2)


def test_two_contacts_have_their_places_sums_and_peaks():
    p = picture()
    a, b = (0.05, 0.05), (0.15, 0.11)
    found = find_regions(bump(p, a) + 0.8 * bump(p, b), p, level=0.05)
    np.testing.assert_allclose(found.centres, [a, b], atol=2e-4)
    inside = 2 * np.pi * 0.012**2  # of a Gaussian; cut at a share t of its peak it keeps 1 - t
    np.testing.assert_allclose(found.sums, inside * np.array([1 - 0.05, 0.8 * (1 - 0.05 / 0.8)]), rtol=2e-2)
    np.testing.assert_allclose(found.peaks, [1, 0.8], rtol=2e-2)
    assert len(found) == 2


@pytest.mark.parametrize(("least", "count"), [(0.05, 2), (0.4, 1)])
def test_touching_contacts_part_at_their_pass_if_it_is_deep_enough(least, count):
    p = picture()
    image = bump(p, (0.08, 0.08)) + bump(p, (0.116, 0.08))  # 3 widths apart: the pass is at 0.65
    found = find_regions(image, p, level=0.3, least=least)
    assert len(found) == count
    if count == 2:
        assert {found.labels.reshape(p.shape)[20, c] for c in (20, 28)} == {0, 1}
        left = found.labels[(p.centres[:, 0] < 0.098 - 0.004) & (image > 0.3 * image.max())]
        assert len(set(left)) == 1
        np.testing.assert_allclose(found.sums[0], found.sums[1], rtol=0.1)
    np.testing.assert_allclose(found.sums.sum(), (image * p.areas)[found.labels >= 0].sum())


def prominent(image, level, least):
    """Summits that stand out: components of ever lower level sets, until one holds a higher pixel."""
    top, out = image.max(), []
    for place in np.ndindex(image.shape):
        peak = image[place]
        if peak < level * top:
            continue
        base = level * top
        for height in np.sort(image[(image >= base) & (image <= peak)])[::-1]:
            marks = label(image >= height, EIGHT)[0]
            if image[marks == marks[place]].max() > peak:
                base = height
                break
        if peak - base > least * top:
            out.append((peak, int(np.ravel_multi_index(place, image.shape))))
    return [place for _, place in sorted(out, reverse=True)]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("level", "least"), [(0.5, 0.1), (0.2, 0.05), (0.3, 0.0)])
def test_summits_are_those_of_flooding(seed, level, least):
    p = picture(14, 18)
    image = gaussian_filter(np.random.default_rng(seed).normal(size=p.shape), 1.2)
    found = find_regions(image.ravel(), p, level=level, least=least)
    expected = prominent(image, level, least)
    np.testing.assert_allclose(found.peaks, image.ravel()[expected])
    assert [int(found.labels[place]) for place in expected] == list(range(len(expected)))
    for k in range(len(found)):
        mine = found.labels.reshape(p.shape) == k
        assert label(mine, EIGHT)[1] == 1
        assert image[mine].min() >= level * image.max()
        weight = image[mine] * p.areas[mine.ravel()]
        np.testing.assert_allclose(found.sums[k], weight.sum())
        np.testing.assert_allclose(found.centres[k], weight @ p.centres[mine.ravel()] / weight.sum())


@pytest.mark.parametrize("step", [1, -1])
def test_a_ripple_joins_the_summit_across_its_higher_pass(step):
    row = np.array([0, 10, 4.6, 5, 4.9, 6, 0])[::step]
    found = find_regions(row, picture(1, 7), level=0.3, least=0.05)
    np.testing.assert_array_equal(found.labels[::step], [-1, 0, 0, 1, 1, 1, -1])


def test_flat_ground_is_one_region():
    p = picture(12, 15)
    image = np.zeros(p.shape)
    image[2:9, 3:6] = image[6:9, 3:12] = image[2:9, 11:13] = 2.0
    assert len(find_regions(image.ravel(), p, least=0)) == 1
    image[5:7, 8] = 1.99
    assert len(find_regions(image.ravel(), p)) == 1


def test_corners_touch_and_edges_do_not_wrap():
    p = picture(6, 7)
    image = np.zeros(p.shape)
    image[1, 1] = image[2, 2] = image[3, 6] = image[4, 0] = 1.0
    found = find_regions(image.ravel(), p)
    assert sorted(np.bincount(found.labels[found.labels >= 0])) == [1, 1, 2]


def test_off_the_sheet_there_is_nothing():
    p = picture(20, 20)
    image = bump(p, (0.02, 0.02))
    part = Picture(p.centres, np.where(p.centres[:, 0] < 0.05, p.areas, 0), p.shape)
    broken = np.where(part.areas > 0, image, np.nan)
    found = find_regions(broken, part)
    assert len(found) == 1
    np.testing.assert_allclose(found.centres, [(0.02, 0.02)], atol=1e-3)


def test_order_of_pixels_and_units_do_not_matter():
    p = picture(20, 30)
    image = gaussian_filter(np.random.default_rng(9).normal(size=p.shape), 1.5)
    found, small = find_regions(image.ravel(), p, level=0.2), find_regions(1e-9 * image.ravel(), p, level=0.2)
    np.testing.assert_array_equal(found.labels, small.labels)
    mirrored = find_regions(image[:, ::-1].ravel(), p, level=0.2)
    np.testing.assert_array_equal(mirrored.labels.reshape(p.shape)[:, ::-1].ravel(), found.labels)
    np.testing.assert_allclose(mirrored.sums, found.sums)


@pytest.mark.parametrize("image", [np.zeros(2000), -np.ones(2000)])
def test_nothing_positive_has_no_regions(image):
    found = find_regions(image, picture())
    assert len(found) == 0
    assert (found.labels == -1).all()
    assert found.centres.shape == (0, 2)


def test_a_reconstruction_of_two_touches(model, pixels):
    recon = je.prepare(model, basis=pixels)
    places = np.array([(0.06, 0.06), (0.14, 0.13)])
    square = ((np.asarray(model.centroids)[None] - places[:, None]) ** 2).sum(-1)
    touched = model.background * (1 + 0.3 * np.exp(-0.5 * square / 0.012**2).sum(0))
    image = recon(je.forward(model, touched) - je.forward(model))
    found = find_regions(image, recon)
    assert len(found) == 2
    order = np.argsort(found.centres[:, 0])
    np.testing.assert_allclose(found.centres[order], places, atol=6e-3)
    np.testing.assert_array_equal(find_regions(image, pixels).labels, found.labels)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"level": 0.0}, "level is 0"),
        ({"level": 1.0}, "level is 1"),
        ({"least": -0.1}, "least is -0.1"),
        ({"least": 0.5}, "less than 1 - level"),
        ({"level": np.nan}, "level is nan"),
        ({"image": np.ones((2, 2000))}, "one image"),
        ({"image": np.where(np.arange(2000) == 7, np.nan, 1.0)}, "pixel 7"),
        ({"recon": picture()._replace(shape=(2000,))}, "Pixels"),
    ],
)
def test_bad_input_is_refused(change, words):
    with pytest.raises(RegionError, match=words):
        find_regions(**({"image": np.ones(2000), "recon": picture()} | change))
