"""The live page: its structure, and what it shows and how it is used in a headless browser, where one is installed."""

import base64
import http.client
import json
from dataclasses import replace
from html.parser import HTMLParser

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from calib.calibration.calibration import Calibration
from calib.calibration.evaluation import Evaluation
from calib.calibration.localisation.ellipses import INSIDE_90, confidence_ellipse
from calib.calibration.logs.calibration import LogCalibration
from calib.calibration.press_examples import PressExamples
from calib.live.loop import LiveControl
from calib.live.results import FrameResult, KindEstimate, LogResult, TouchEstimates
from calib.live.views.page import Page, whole_page
from calib.live.views.page_scene import electrode_outlines, full_scales, layer_maps, page_scene, rounded_up
from jaxeit.contacts import LoadSettings
from jaxeit.tracking import GainField, LearnedLayer
from tests.browser import Browser, browser_path
from tests.helpers import skin_of, stand_in

WIDTH, HEIGHT = 0.3, 0.2  # m
ROWS, COLUMNS = 4, 6
SIDE = 0.05  # m, of a pixel
FORCES = np.array([3.0, -0.02])
S = 1_000_000_000
SCREENS = [(1280, False), (1280, True), (400, False), (400, True)]
needs_browser = pytest.mark.skipif(browser_path() is None, reason="needs Chromium")


@pytest.fixture(scope="module")
def oblong():
    """A skin of 300 by 200 mm with two pads and an electrode in each corner and in the middle."""
    places = [(0.02, 0.02), (0.28, 0.02), (0.28, 0.18), (0.02, 0.18), (0.15, 0.1)]
    pads = [
        je.Pad(name, np.array([[x, 0.0], [x + 0.15, 0.0], [x + 0.15, HEIGHT], [x, HEIGHT]]))
        for name, x in (("left", 0.0), ('<b>"right"', 0.15))
    ]
    electrodes = tuple(je.PointElectrode(place) for place in places)
    protocol = je.Protocol(np.array([[0, 1, 2, 3], [1, 2, 3, 4], [0, 2, 1, 4]]), 1e-3)
    return je.Skin("oblong", je.Rectangle(WIDTH, HEIGHT), 100.0, electrodes, protocol, tuple(pads))


@pytest.fixture(scope="module")
def calibration(oblong):
    """What the page needs of one."""
    x, y = np.meshgrid((np.arange(COLUMNS) + 0.5) * SIDE, (np.arange(ROWS) + 0.5) * SIDE)
    pixels = ROWS * COLUMNS
    recon = stand_in(
        je.Reconstructor,
        shape=(ROWS, COLUMNS),
        centres=np.stack([x.ravel(), y.ravel()], 1),
        areas=np.full(pixels, SIDE**2),
    )
    found = stand_in(Evaluation, force=np.array([2.0, 12.0]), estimated={})
    return stand_in(Calibration, skin=oblong, recon=recon, simulated=True, examples=None, evaluation=found)


def result(number, position=(0.1, 0.05), *, covariance=None, level=0.0, force=FORCES, tracked=True, host=None):
    """A frame's result with one contact and a map of ``level`` N on every pixel."""
    covariance = np.diag([9e-6, 4e-6]) if covariance is None else covariance
    touches = TouchEstimates(np.array([position]), covariance[None], np.array([True]), 0)
    if tracked:
        about = np.array([7]), np.array([force[0]]), np.array([0.2]), np.zeros((1, 2))
        touches = TouchEstimates(np.array([position]), covariance[None], np.array([True]), 0, *about)
    return FrameResult(
        number=number,
        host=number * S // 5 if host is None else host,
        latency=1.2e-3,
        force=np.asarray(force, float),
        standard_error=np.array([0.1, 0.1]),
        half_width=np.array([0.2, 0.2]),
        valid=np.array([True, False]),
        centre=np.array([[0.1, 0.05], [np.nan, np.nan]]),
        map=np.full(ROWS * COLUMNS, level),
        image=np.full(ROWS * COLUMNS, 1e-3),
        missing=0,
        dropped=0,
        touches=touches,
    )


def some_layer(calibration, contacts=5, level=0.0):
    """A layer whose mean log gain has another level, and whose level is known exactly."""
    low, high = map(np.asarray, calibration.skin.domain.bounds)
    loads = LoadSettings(gain=0.4, gain_length=0.05)
    field = GainField.on_sheet(np.stack([low, high]), calibration.recon.centres, loads, level=0.3)
    mean, covariance = np.zeros(len(field.places)), np.eye(len(field.places))
    mean[0], covariance[0, 0] = level / field.level, 0.0
    return LearnedLayer.normal(field, mean, covariance, contacts)


# --- without a browser ---------------------------------------------------------------------------


class Tags(HTMLParser):
    """Tags in order with their attributes and the tags around them."""

    VOID = ("meta", "input")

    def __init__(self, text):
        super().__init__()
        self.found, self.open = [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs), tuple(self.open)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_one_file_that_a_screen_reader_understands():
    text = whole_page().decode()
    tags = Tags(text)
    assert tags.open == []
    assert ("html", {"lang": "en"}, ()) in tags.found
    assert [tag for tag, *_ in tags.found if tag in ("h1", "h2", "h3")] == ["h1", "h2", "h2", "h2"]
    assert all(attrs.get("scope") in ("col", "row") for tag, attrs, _ in tags.found if tag == "th")
    assert [tag for tag, *_ in tags.found].count("caption") == [tag for tag, *_ in tags.found].count("table") == 2
    assert all("label" in around for tag, _, around in tags.found if tag in ("input", "select"))
    pictures = [attrs for tag, attrs, _ in tags.found if tag in ("canvas", "svg")]
    assert all(("aria-label" in p and p["role"] == "img") or p.get("aria-hidden") == "true" for p in pictures)
    assert any(attrs.get("aria-live") == "polite" for _, attrs, _ in tags.found)
    assert not any(k in attrs for _, attrs, _ in tags.found for k in ("src", "href"))
    assert not any(mark in text for mark in ("/* page.css */", "/* page.js */", "/* history.js */"))


def test_the_scene_has_the_proportions_of_the_skin(calibration):
    scene = json.loads(json.dumps(page_scene(calibration)))
    (x0, y0), (x1, y1) = scene["bounds"]
    assert ((x1 - x0), (y1 - y0)) == pytest.approx((WIDTH, HEIGHT))
    assert scene["outlines"][1][1] == pytest.approx([0.3, 0.0])
    assert scene["electrodes"][4] == pytest.approx([0.15, 0.1])
    assert np.ptp(scene["rim"], axis=0) == pytest.approx([WIDTH, HEIGHT])
    assert scene["full_pressure"] == 4000.0  # 12 N on a tenth of a pad of 150 by 200 mm


def test_the_page_draws_the_outlines_that_electrodes_give():
    ring, pad = je.skin.RingPatch((0.05, 0.05), 0.004, 0.008), je.PolygonPatch(je.Polygon([(0, 0), (0.1, 0), (0, 0.1)]))
    bolt = je.AreaPatch((0.1, 0.1), 0.003)  # a mark
    outlines = electrode_outlines(skin_of(je.Rectangle(0.2, 0.2), (ring, pad, bolt), [[0, 1, 0, 1]]))
    assert [np.ptp(outline, axis=0).max() for outline in outlines] == pytest.approx([0.016, 0.008, 0.1], rel=2e-3)


def test_full_colours_are_those_of_presses_of_the_calibration(skin, monkeypatch):
    """The largest force per area of the examples' maps, scaled to the load cell, and change of images, rounded up."""
    recon = stand_in(je.Reconstructor, areas=np.array([1e-4, 2e-4, 0.0]), dtype=np.dtype(float))
    monkeypatch.setattr(type(recon), "__call__", lambda self, dv: 1e-3 * np.asarray(dv), raising=False)
    shown = PressExamples(np.array([[1.0, -2.3, 0.5]]), np.zeros((1, 4)), np.zeros((1, 2)), np.array([7.2]))
    monkeypatch.setattr(
        "calib.live.views.page_scene.force_map",
        lambda *_: stand_in(object, map=stand_in(object, force=jnp.array([[1.0, 2.6, 99.0]]))),
    )
    monkeypatch.setattr("calib.live.views.page_scene.replace", lambda found, **_: found)
    calibration = stand_in(Calibration, skin=skin, recon=recon, examples=shown)
    assert full_scales(calibration) == (30e3, pytest.approx(3e-3))  # 2.6 of 3.6 N, twice, on 2 cm2: 26 kPa


@pytest.mark.parametrize(("value", "up"), [(1.0, 1.0), (1.01, 1.5), (9.9e-4, 1e-3), (8.0, 8.0), (13.3e3, 15e3), (0, 1)])
def test_full_colours_are_round_numbers(value, up):
    assert rounded_up(value) == pytest.approx(up)


def test_ellipses_hold_nine_contacts_in_ten():
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    points = np.random.default_rng(0).multivariate_normal([1, 2], covariance, 20_000) - [1, 2]
    inside = np.einsum("ni,ij,nj->n", points, np.linalg.inv(covariance), points) < INSIDE_90**2
    assert inside.mean() == pytest.approx(0.9, abs=0.01)
    rim = confidence_ellipse(np.array([1.0, 2.0]), covariance) - [1, 2]
    assert np.einsum("ni,ij,nj->n", rim, np.linalg.inv(covariance), rim) == pytest.approx(INSIDE_90**2)


def numbers(text):
    return np.frombuffer(base64.b64decode(text), "<f4")


def test_maps_of_a_layer_have_scales_that_do_not_depend_on_what_was_learned(calibration):
    layer, centres = some_layer(calibration, level=0.25), calibration.recon.centres
    told = json.loads(json.dumps(layer_maps(layer, centres)))
    mean, deviation = layer.at(centres)
    np.testing.assert_allclose(numbers(told["mean"]), mean, rtol=1e-6)
    np.testing.assert_allclose(numbers(told["deviation"]), deviation, rtol=1e-6)
    assert mean == pytest.approx(0.25)
    assert told["contacts"] == 5
    assert (told["full_mean"], told["full_deviation"]) == (1.0, 0.5)  # twice 0.5, and 0.5: before any contact
    other = layer_maps(some_layer(calibration, level=-0.7), centres)
    assert (other["full_mean"], other["full_deviation"]) == (1.0, 0.5)


def messages(page, count):
    """The first messages to a new viewer."""
    link = http.client.HTTPConnection(*page.server_address[:2], timeout=5)
    link.request("GET", "/results")
    lines = iter(link.getresponse().readline, b"")
    told = (json.loads(line[6:]) for line in lines if line.startswith(b"data: "))
    for _ in range(count):
        yield next(told)
    link.close()


def test_a_viewer_is_told_the_layer_once_and_again_when_contacts_have_taught_it(page, calibration, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "calib.live.views.page.layer_maps", lambda layer, _: drawn.append(layer) or {"contacts": layer.contacts}
    )
    monkeypatch.setattr("calib.live.views.page.KEEP_ALIVE_INTERVAL", 0.1)
    told = messages(page, 8)
    page.control.layer = some_layer(calibration, contacts=0)  # nothing was learned
    assert next(told)["layer"] is None
    page.control.layer = first = some_layer(calibration)
    news = [next(told)["layer"] for _ in range(3)]
    assert [one for one in news if one] == [{"contacts": 5}]
    assert next(messages(page, 1))["layer"] == {"contacts": 5}  # another viewer, for whom nothing is computed anew
    assert drawn == [first]
    page.control.layer = some_layer(calibration, contacts=6)
    assert {"contacts": 6} in [next(told)["layer"] for _ in range(3)]
    assert [one.contacts for one in drawn] == [5, 6]


# --- in a browser --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser():
    with Browser(browser_path()) as found:
        yield found


@pytest.fixture
def page(calibration):
    with Page(calibration, LiveControl(state="running")) as found:
        yield found


@needs_browser
def test_before_the_first_result_the_page_says_what_is_waited_for(browser, calibration):
    control = LiveControl()
    with Page(calibration, control) as waiting, browser.open(waiting.url, 1280) as tab:
        tab.wait_for("$('state').textContent.startsWith('compiling the programs of this calibration')")
        control.state = "waiting for the first frame of eit and pressure"
        tab.wait_for(f"$('state').textContent === '{control.state}'")


@pytest.fixture
def tab(browser, page):
    with browser.open(page.url, 1280) as found:
        shown(found, page, result(1))
        yield found
        assert found.errors() == []


def shown(tab, page, frame):
    """Show a result, and wait until the page has received it."""
    page.show_result(frame)
    tab.wait_for(f"stored === {frame.host / 1e9} || (last && last.number === {frame.number})")


def pixel(tab, row, column, of="map"):
    """Red, green and blue of a pixel of a map, the lowest row first."""
    at = f"{column}, {ROWS - 1 - row}, 1, 1"
    return np.array(tab.value(f"Array.from($('{of}').getContext('2d').getImageData({at}).data)")[:3])


def box(tab, of):
    return np.array(tab.box(of))


@needs_browser
@pytest.mark.parametrize(("width", "dark"), SCREENS)
def test_nothing_is_cut_off_in_light_and_dark_and_on_a_telephone(browser, page, calibration, width, dark):
    page.control.layer = some_layer(calibration, contacts=1234)
    with browser.open(page.url, width, dark=dark) as tab:
        for number in range(1, 4):
            shown(tab, page, result(number, level=0.1, covariance=0.1**number * np.eye(2)))  # the first m wide
            tab.value("drawHistories()")
            assert tab.overflow() <= 0
        assert tab.overflow() <= 0
        assert tab.errors() == []
        assert tab.value("getComputedStyle(document.body).backgroundColor") == (
            "rgb(20, 24, 29)" if dark else "rgb(255, 255, 255)"
        )
        columns = tab.value("getComputedStyle(document.querySelector('main')).gridTemplateColumns.split(' ').length")
        assert columns == (3 if width == 1280 else 1)


@needs_browser
def test_the_sheet_is_drawn_to_scale_and_the_map_under_it(tab):
    view = np.array(list(map(float, tab.value("$('marks').getAttribute('viewBox')").split())))
    margin = -view[0]
    assert view[2:] - 2 * margin == pytest.approx([1e3 * WIDTH, 1e3 * HEIGHT], abs=0.01)
    marks, canvas = box(tab, "$('marks')"), box(tab, "$('map')")
    scale = marks[2] / view[2]  # CSS pixels per mm
    assert marks[3] / view[3] == pytest.approx(scale, rel=5e-3)
    assert canvas[2:] / scale == pytest.approx([300, 200], rel=0.01)
    assert (canvas[:2] - marks[:2]) / scale == pytest.approx([margin, margin], abs=1)
    rim = box(tab, "document.querySelector('.rim')")
    assert rim[:2] == pytest.approx(canvas[:2], abs=2)
    assert rim[2:] == pytest.approx(canvas[2:], abs=3)
    assert tab.value("[...document.querySelectorAll('.number')].map(t => t.textContent)") == list("01234")
    assert tab.value("[...document.querySelectorAll('.pad title')].map(t => t.textContent)") == ["left", '<b>"right"']


@needs_browser
def test_ellipses_have_the_axes_of_the_covariance(tab):
    rng = np.random.default_rng(0)
    for _ in range(20):
        root = rng.normal(size=(2, 2)) * 1e-3
        covariance = root @ root.T
        found = tab.value(f"ellipseOf({covariance.tolist()})")
        variance, axes = np.linalg.eigh(covariance)
        assert found["longer"] == pytest.approx(INSIDE_90 * np.sqrt(variance[1]), rel=1e-6)
        assert found["shorter"] == pytest.approx(INSIDE_90 * np.sqrt(variance[0]), rel=1e-4)
        along = np.array([np.cos(found["angle"]), np.sin(found["angle"])])
        assert abs(along @ axes[:, 1]) == pytest.approx(1, abs=1e-9)


@needs_browser
def test_the_ellipse_goes_where_the_contact_goes(tab, page):
    """Its box on the screen is that of the ellipse of 90 %, y upwards."""
    turned = np.array([[9e-5, 6e-5], [6e-5, 8e-5]])
    for number, place in enumerate([(0.1, 0.05), (0.22, 0.15)], 2):
        shown(tab, page, result(number, place, covariance=turned))
        drawn, marks = box(tab, "document.querySelector('ellipse')"), box(tab, "$('marks')")
        scale = marks[2] / (1e3 * (WIDTH + 2 * 0.05 * WIDTH))
        points = confidence_ellipse(np.array(place), turned) * 1e3 * scale
        size = np.ptp(points, axis=0)
        middle = [marks[0] + scale * (15 + 1e3 * place[0]), marks[1] + scale * (15 + 1e3 * (HEIGHT - place[1]))]
        assert drawn[:2] + drawn[2:] / 2 == pytest.approx(middle, abs=1)
        assert drawn[2] >= size[0] - 1
        assert drawn[3] >= size[1] - 1
        angle = float(tab.value("document.querySelector('ellipse').getAttribute('transform')").split("(")[1].split()[0])
        assert angle == pytest.approx(-np.degrees(0.5 * np.arctan2(2 * 6e-5, 1e-5)))
        assert tab.value("document.querySelector('text.value').textContent") == "7: 3.0 N"


@needs_browser
def test_an_ellipse_larger_than_the_sheet_covers_nothing_else(tab, page):
    shown(tab, page, result(2, covariance=np.eye(2)))  # 1 m
    at = "(b => document.elementFromPoint(b.x + b.width / 2, b.y + b.height / 2).tagName)"
    assert tab.value(f"{at}($('marks').getBoundingClientRect())") in ("ellipse", "path", "svg")
    for other in ("$('bar')", "$('pads')", "$('pause')"):
        assert tab.value(f"{at}({other}.getBoundingClientRect())") != "ellipse"


@needs_browser
def test_noise_does_not_fill_the_scale(tab, page):
    """The colours of a map depend on its values alone, not on what else the frame or the frames before showed."""
    full = 4000.0 * SIDE**2  # N on a pixel
    shown(tab, page, result(2, level=0.0))
    low = pixel(tab, 0, 0)
    shown(tab, page, result(3, level=0.02 * full))
    assert np.abs(pixel(tab, 1, 2) - low).max() <= 6
    shown(tab, page, result(4, level=full))
    high = pixel(tab, 0, 0)
    assert np.abs(high - low).max() > 150
    shown(tab, page, result(5, level=full / 2))
    assert pixel(tab, 3, 5) == pytest.approx((low + high) / 2, abs=2)
    assert tab.value("$('full').textContent") == "4 kPa and more"
    tab.value("$('range').value = '0.1', $('range').onchange()")
    assert tab.value("$('full').textContent") == "0.4 kPa and more"
    assert pixel(tab, 3, 5) == pytest.approx(high)


@needs_browser
def test_the_space_bar_pauses_what_is_shown_but_not_a_control_that_has_the_focus(tab, page):
    tab.press(" ", "Space", " ")
    assert tab.value("paused && $('pause').getAttribute('aria-pressed')") == "true"
    page.show_result(result(2, (0.2, 0.1)))
    tab.wait_for(f"stored === {result(2).host / 1e9}")  # received, and kept for the history
    assert tab.value("last.number") == 1
    assert float(tab.value("document.querySelector('ellipse').getAttribute('cx')")) == pytest.approx(100)
    tab.press(" ", "Space", " ")
    shown(tab, page, result(3, (0.2, 0.1)))
    assert float(tab.value("document.querySelector('ellipse').getAttribute('cx')")) == pytest.approx(200)
    tab.value("$('smooth').focus()")
    tab.press(" ", "Space", " ")
    assert tab.value("[paused, $('smooth').checked]") == [False, True]


@needs_browser
def test_every_control_is_reached_by_the_tabulator_and_shows_its_focus(tab, page):
    reached = []
    for _ in range(6):
        tab.press("Tab")
        reached.append(tab.value("document.activeElement.id"))
        assert tab.value("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    assert reached == ["pause", "tare", "which", "range", "smooth", "say"]
    tab.value("$('tare').focus()")
    tab.press("Enter", text="\r")
    assert page.control.tare.wait(5)


@needs_browser
def test_a_screen_reader_is_told_contacts_forces_and_histories(tab, page):
    shown(tab, page, result(2, force=np.array([3.0, 5.0])))
    tab.value("drawHistories(), say()")
    said = tab.value("$('said').textContent")
    assert said == '1 contact; 7: 3 N at 100, 50 mm; left 3 N; <b>"right" 5 N; total 8 N'
    found = tab.accessible()
    images = [part["name"] for part in found if part["role"] in ("image", "img")]
    assert any(name.startswith("sheet with 2 pads and 5 electrodes; 1 contact") for name in images)
    assert any(name.startswith("force on the pads, N, last minute: left 3, largest 3") for name in images)
    assert "colour scale from 0 to 4 kPa" in images
    assert {"main", "heading", "status", "table", "rowheader", "columnheader"} <= {part["role"] for part in found}
    shown(tab, page, result(3, force=np.zeros(2), tracked=False))
    tab.value("$('say').checked = false, say()")
    assert tab.value("$('said').textContent") == said


@needs_browser
def test_what_touches_the_skin_is_told_with_probabilities(tab, page):
    kinds = KindEstimate(np.array([0.0, 0.15, 0.8, 0.04, 0.01]), False)
    shown(tab, page, replace(result(2), kinds=kinds))
    assert tab.value("$('kinds').textContent") == "what touches the skin: two contacts 80 %, one contact 15 %"
    shown(tab, page, replace(result(3), kinds=KindEstimate(kinds.probability, True)))
    assert "unlike" in tab.value("$('kinds').textContent")
    shown(tab, page, result(4))
    assert tab.value("$('kinds').hidden")


@needs_browser
def test_the_contact_layer_is_drawn_as_two_maps_when_contacts_have_taught_it(tab, page, calibration):
    """Its mean is in the middle of the colours at zero, and at their end at the value that is written there."""
    assert tab.value("$('layer').hidden")
    colours = []
    for contacts, level in enumerate((-1.0, 0.0, 1.0), 1):
        page.control.layer = some_layer(calibration, contacts, level)
        tab.wait_for(f"layer && layer.drawn && layer.contacts === {contacts}", seconds=5)
        colours.append(pixel(tab, 2, 3, "layer-mean"))
    low, middle, high = colours
    assert np.abs(high - low).max() > 150
    assert middle == pytest.approx((low + high) / 2, abs=2)
    assert low == pytest.approx(tab.value("ink.low"))
    share = page.control.layer.at(calibration.recon.centres)[1].reshape(ROWS, COLUMNS) / 0.5
    for row, column in ((0, 0), (2, 3)):
        expected = low + share[row, column] * (high - low)
        assert pixel(tab, row, column, "layer-deviation") == pytest.approx(expected, abs=2)
    assert tab.value("$('layer-title').textContent") == "log gain of the contact layer, learned from 3 contacts"
    ends = tab.value("[...document.querySelectorAll('#layer .bar span')].map(span => span.textContent)")
    assert ends == ["≤ −1", "0", "≥ 1", "0", "≥ 0.5"]
    images = [part["name"] for part in tab.accessible() if part["role"] in ("image", "img")]
    assert "mean of the log gain of the contact layer, 1.00 to 1.00" in images
    shape = box(tab, "$('layer-mean')")[2:]
    assert shape[0] / shape[1] == pytest.approx(WIDTH / HEIGHT, rel=0.03)


@needs_browser
def test_a_page_that_is_paused_draws_the_layer_later(tab, page, calibration):
    tab.press(" ", "Space", " ")
    page.control.layer = some_layer(calibration)
    tab.wait_for("layer !== null")
    assert tab.value("$('layer').hidden")
    tab.press(" ", "Space", " ")
    tab.wait_for("!$('layer').hidden")
    drawn = tab.value("$('layer-mean').toDataURL()")
    tab.value("document.documentElement.style.setProperty('--low', '0 0 0'), refresh()")  # as dark colours would
    assert tab.value("$('layer-mean').toDataURL()") != drawn


@needs_browser
def test_histories_hold_a_minute_at_ten_points_a_second(tab, page):
    for second in range(0, 70, 7):
        shown(tab, page, result(10 + second, host=second * S, force=np.array([second, 0.0])))
    kept = tab.value("lines.pads.left.map(point => point[1])")
    assert kept == [float(second) for second in range(7, 70, 7)]
    assert tab.value("Object.keys(lines.contacts)") == ["contact 7"]
    tab.value("drawHistories()")
    names = tab.value("[...document.querySelectorAll('#pads-history span')].map(span => span.textContent)")
    assert names == ["left", '<b>"right"']
    drawn = tab.value("$('pads-history').querySelector('canvas').toDataURL().length")
    tab.value("lines.pads.left = [], drawHistories()")
    assert tab.value("$('pads-history').querySelector('canvas').toDataURL().length") != drawn


@needs_browser
@pytest.mark.parametrize(("width", "dark"), SCREENS)
def test_a_sensor_without_eit_has_its_force_over_time(browser, width, dark):
    sensor = stand_in(LogCalibration, stream="fsr", simulated=False)
    with Page(sensor, LiveControl(state="running")) as page, browser.open(page.url, width, dark=dark) as tab:
        for number in range(1, 4):
            force = np.array([0.5 * number])
            shown(
                tab,
                page,
                LogResult(number, number * S // 5, 1e-3, force, 0.1 * force, force - 0.2, force + 0.2, force > 0, 0, 0),
            )
        tab.value("drawHistories()")
        assert tab.overflow() <= 0
        assert tab.errors() == []
        assert tab.value("$('sheet').hidden && !$('alone').hidden")
        assert tab.value("$('curve').getAttribute('aria-label')").endswith("last minute: fsr 1.5, largest 1.5")
        assert tab.value("$('pads').textContent") == "fsr1.50± 0.20"
