"""Objects as a notebook shows them: well formed, escaped, and drawn where they are."""

import io
import re
from base64 import b64decode
from dataclasses import replace
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import image as pictures

import jaxeit as je
from jaxeit.notebook import MAX_LINES, WIDTH, Drawing, card, png

from .helpers import square_model

SVG = "{http://www.w3.org/2000/svg}"


def shown(thing):
    """The HTML of an object as a tree, which shows that every tag is closed and every text escaped."""
    return ElementTree.fromstring(thing._repr_html_())


def table(tree):
    return {row[0].text: row[1].text for row in tree.iter("tr")}


@pytest.fixture(scope="module")
def small():
    return square_model([(0.06, 0.06), (0.14, 0.1), (0.1, 0.14), (0.06, 0.12)], [[0, 1, 2, 3], [2, 3, 0, 1]], 10)


@pytest.fixture(scope="module")
def recon(small):
    return je.prepare(small, basis=je.Pixels(5))


def opacity(tree):
    """Opacity of the pixels of the picture in a tree, row 0 lowest."""
    (found,) = tree.iter(f"{SVG}image")
    data = b64decode(found.attrib["href"].removeprefix("data:image/png;base64,"))
    return pictures.imread(io.BytesIO(data), format="png")[::-1, :, 3]


def test_a_skin_is_drawn_where_it_is(skin):
    tree = shown(skin)
    assert table(tree)["sheet"] == "200 x 200 mm, 150 ohm per square"
    assert table(tree)["readings"] == "550 in 5.5 ms"
    circles = list(tree.iter(f"{SVG}circle"))
    assert len(circles) == 25
    assert circles[0][0].text == "electrode 0"
    first = [float(circles[0].attrib[name]) for name in ("cx", "cy")]
    margin, scale = 0.02 * 0.2, WIDTH / (1.04 * 0.2)
    x, y = skin.electrode_positions[0]
    np.testing.assert_allclose(first, [(x + margin) * scale, (0.2 - y + margin) * scale], atol=0.1)
    assert len(list(tree.iter(f"{SVG}polygon"))) == 1 + len(skin.pads)


@pytest.mark.parametrize("domain", [je.Disc(0.1), je.Polygon([(0, 0), (0.3, 0), (0.1, 0.2)])], ids=["disc", "triangle"])
def test_sheets_of_any_shape_lie_in_their_picture(domain):
    electrodes = tuple(je.BoundaryPatch(0.05 * k, 0.05 * k + 0.01) for k in range(4))
    protocol = je.Protocol(je.skin.adjacent(4), 1e-3)
    tree = shown(je.Skin("tank", domain, 1.0, electrodes, protocol))
    (svg,), (rim,) = tree.iter(f"{SVG}svg"), tree.iter(f"{SVG}polygon")
    corners = np.array([pair.split(",") for pair in rim.attrib["points"].split()], float)
    assert (corners > 0).all()
    assert (corners < [WIDTH, float(svg.attrib["viewBox"].split()[3])]).all()
    assert table(tree)["pads"] == "none"


def test_texts_of_users_are_escaped(skin):
    name = '<script>alert("1")</script> & co'
    pads = (replace(skin.pads[0], name="</td><b>"), *skin.pads[1:])
    html = replace(skin, name=name, pads=pads)._repr_html_()
    assert "<script" not in html
    assert "<b>" not in html
    tree = ElementTree.fromstring(html)
    assert tree.find(".//strong").text == f"Skin {name}"
    assert table(tree)["pads"].startswith("</td><b>, ")
    assert ElementTree.fromstring(card("t", [], Drawing(np.zeros(2), np.ones(2)).svg('"<&'))) is not None


def test_a_model_shows_its_mesh(small):
    tree = shown(small)
    assert table(tree)["mesh"] == f"{len(small.nodes)} nodes, {len(small.triangles)} triangles"
    assert table(tree)["precision, solver"] == "float64, Dense"
    (path,) = tree.iter(f"{SVG}path")
    nodes, elements = len(small.nodes), len(small.triangles)
    assert path.attrib["d"].count("M") == nodes + elements - 1  # Euler's formula for a sheet without holes


def test_more_lines_than_can_be_told_apart_are_not_drawn():
    drawing = Drawing(np.zeros(2), np.ones(2))
    drawing.lines(np.zeros((MAX_LINES + 1, 2)), np.ones((MAX_LINES + 1, 2)))
    assert drawing.parts == []


def test_a_reconstructor_shows_the_noise_of_its_pixels(recon, small):
    noise = np.linalg.norm(recon.matrix, axis=1).reshape(5, 5)
    tree = shown(recon)
    np.testing.assert_allclose(opacity(tree), noise / noise.max(), atol=1 / 255)
    assert table(tree)["image"] == "5 x 5, 25 on the sheet"
    assert table(tree)["prior"] == "Noser()"
    less = table(shown(recon.without(jnp.array([True, False]))))
    assert less["readings"] == "2, of which 1 are used"
    other = je.prepare(small, method=je.NonNegative(), basis=je.Pixels(5))
    assert "svg" not in other._repr_html_()
    assert table(shown(other))["method"] == "NonNegative()"


def test_a_force_map_shows_the_frame_of_the_largest_force(recon):
    half = jnp.where(recon.centres[:, 0] < 0.1, 1.0, 0.0)
    masks = je.fusion.PadMasks(jnp.stack([half, 1 - half]), recon.areas, recon.shape)
    images = jnp.zeros((3, 25)).at[:, 7].set(1.0)  # the second row from below, third column: on the right pad
    fused = je.fuse(images, masks, jnp.array([[0.0, 1.0], [0.0, 5.0], [0.0, 2.0]]))
    tree = shown(fused)
    assert table(tree)["frames"] == "3; shown: 1, of the largest force"
    assert table(tree)["force"] == "5 N"
    assert table(tree)["pads whose image gives the shape"] == "1 of 2"
    np.testing.assert_array_equal(np.argwhere(opacity(tree)), [[1, 2]])
    alone = je.fuse(images[0], je.fusion.PadMasks(masks.weights, masks.areas), jnp.array([0.0, jnp.nan]))
    assert "svg" not in alone._repr_html_()
    assert table(shown(alone))["force"] == "0 N"


def test_traced_objects_say_so(small, recon):
    said = []
    jax.jit(lambda model, recon: [said.append(table(shown(one))["state"]) for one in (model, recon)] and None)(
        small, recon
    )
    assert said == ["traced by JAX: its numbers are hidden"] * 2


def test_a_picture_of_nothing_is_transparent():
    for values in (np.zeros((2, 3)), np.full((2, 3), np.nan), -np.ones((2, 3))):
        assert not pictures.imread(io.BytesIO(png(values)), format="png")[..., 3].any()


def test_masks_of_pads_know_the_shape_of_the_image(skin, model):
    basis = je.Pixels(8).on(model)
    assert je.pad_masks(skin, basis).shape == (8, 8)
    assert re.match(r"\(8, 8\)", str(je.fuse(jnp.ones(64), je.pad_masks(skin, basis), jnp.ones(4)).shape))
