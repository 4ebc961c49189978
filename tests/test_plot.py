"""Pictures hold what they are given."""

import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.contacts import Contacts
from jaxeit.plot import PlotError

pyplot = pytest.importorskip("matplotlib.pyplot")


@pytest.fixture(autouse=True)
def _closed():
    pyplot.switch_backend("agg")
    yield
    pyplot.close("all")


def test_a_skin_has_its_numbers_and_stands_within_the_axes(skin):
    axes = je.plot.show_skin(skin)
    texts = [text.get_text() for text in axes.texts]
    assert [text for text in texts if text.isdecimal()] == [str(n) for n in range(25)]
    assert {pad.name for pad in skin.pads} <= {text.strip() for text in texts}
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    assert x0 < 0 < 200 < x1
    assert y0 < 0 < 200 < y1
    tank = je.Skin("", je.Disc(0.1), 1.0, je.skin.rim_electrodes(je.Disc(0.1), 8), je.Protocol(je.skin.adjacent(8)))
    again = je.plot.show_skin(tank, axes, numbers=False)
    assert again is axes
    patches = [line for line in axes.lines if len(line.get_xdata()) == 33]
    assert len(patches) == 8
    np.testing.assert_allclose(np.hypot(*patches[3].get_data()), 100)
    axes.figure.canvas.draw()


def test_an_image_is_of_the_pixels_on_the_sheet(model, pixels):
    values = np.linspace(-1, 3, pixels.size)
    (shown,) = je.plot.show_image(pixels, values).images
    drawn = shown.get_array()
    np.testing.assert_allclose(drawn.compressed(), values[np.asarray(pixels.areas) > 0])
    assert shown.get_clim() == (-3, 3)
    np.testing.assert_allclose(shown.get_extent(), 1e3 * np.array(pixels.extent))
    (positive,) = je.plot.show_image(pixels, values + 2).images
    assert positive.get_clim() == (1, 5)
    by_element = je.plot.show_image(model, model.background).collections[0]
    np.testing.assert_allclose(by_element.get_array(), model.background)
    with pytest.raises(PlotError, match=r"the image has shape \(3,\); BasisMap has 400 values"):
        je.plot.show_image(pixels, np.zeros(3))
    with pytest.raises(PlotError, match="give the model in place of it"):
        je.plot.show_image(je.Elements().on(model), np.zeros(len(model.areas)))


def test_jaxeit_does_not_import_matplotlib():
    code = "import jaxeit, sys; jaxeit.forward; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_meshes_and_sensitivities(model):
    lines = je.plot.show_mesh(model).lines
    assert sum(len(line.get_xdata()) for line in lines) > len(model.triangles)
    slopes = np.asarray(je.jacobian(model) / model.areas)
    one = je.plot.show_sensitivity(model, 7).collections[0]
    np.testing.assert_allclose(one.get_array(), slopes[7])
    all_of = je.plot.show_sensitivity(model).collections[0]
    size = np.linalg.norm(slopes, axis=0)
    assert (all_of.get_array().mask == (size == 0)).all()  # the bolts have a perfect contact
    np.testing.assert_allclose(all_of.get_array().compressed(), np.log10(size[size > 0]))
    with pytest.raises(PlotError, match="readings 0 to 549"):
        je.plot.show_sensitivity(model, 550)


@pytest.mark.parametrize("order", [1, 2])
def test_current_between_two_sides_is_the_same_everywhere(order):
    sheet, sides = je.Rectangle(0.2, 0.1), (je.BoundaryPatch(0.5, 0.6, 1e-6), je.BoundaryPatch(0.2, 0.3, 1e-6))
    skin = je.Skin("strip", sheet, 2.0, sides, je.Protocol(np.array([[0, 1, 0, 1]])))
    model = je.discretise(je.Scene(skin), je.Fidelity.draft(order=order))
    density = je.plot._current_density(model, np.array([3.0, -3.0]), 5 * model.background)
    np.testing.assert_allclose(density, np.tile([3.0 / 0.1, 0], (len(density), 1)), atol=1e-9)


def test_lines_of_current_go_around_what_does_not_conduct(model):
    (lines,) = (found for found in je.plot.show_current(model, (0, 12)).collections if len(found.get_segments()) > 9)
    ends = np.concatenate(lines.get_segments())
    assert ends.min() > -1e-6
    assert ends.max() < 200 + 1e-6
    hole = jnp.linalg.norm(model.centroids - 0.08, axis=1) < 0.02
    dark = je.plot._current_density(
        model, np.eye(25)[0] - np.eye(25)[12], jnp.where(hole, 1e-6, 1.0) * model.background
    )
    assert np.linalg.norm(dark[hole], axis=1).max() < 1e-3 * np.linalg.norm(dark[~hole], axis=1).mean()
    with pytest.raises(PlotError, match="electrodes, from 0 to 24"):
        je.plot.show_current(model, (0, 25))
    with pytest.raises(PlotError, match="25 currents, A, that sum to zero"):
        je.plot.show_current(model, np.ones(25))


def test_contacts_have_their_ellipses(monkeypatch):
    covariance = jnp.zeros((2, 4, 4)).at[0, :2, :2].set(jnp.array([[4e-6, 0.0], [0.0, 1e-6]]))
    found = Contacts(
        present=jnp.array([True, False]),
        position=jnp.array([[0.05, 0.07], [0.0, 0.0]]),
        width=jnp.array([0.01, 0.0]),
        amplitude=jnp.ones(2),
        covariance=covariance,
        misfit=jnp.ones(()),
        result=jnp.zeros(2, int),
    )
    axes = je.plot.show_contacts(found)
    circle, ellipse = axes.patches
    assert (circle.width, circle.height) == pytest.approx((20, 20))
    tall = sorted((ellipse.width, ellipse.height))
    np.testing.assert_allclose(tall, 2 * np.sqrt(-2 * np.log(0.1)) * np.array([1.0, 2.0]), rtol=1e-4)
    np.testing.assert_allclose(ellipse.center, [50, 70])
    assert [text.get_text() for text in axes.texts] == ["0"]
    monkeypatch.setattr(je.plot, "pyplot", None)
    with pytest.raises(PlotError, match=r"install jaxeit\[plot\]"):
        je.plot.show_contacts(found)
