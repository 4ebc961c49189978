"""Panels of the report: proportions, ellipses and colours; the page in a headless browser, where one is installed."""

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

import jaxeit as je
from calib.calibration.localisation.ellipses import INSIDE_90, placement_covariance
from calib.calibration.press_examples import PressExamples
from calib.report.document import write_report
from calib.report.example_contacts import ELLIPSE_MAGNIFICATION, ExampleContacts, example_contacts, half_axes
from calib.report.figures.maps import ExampleMaps, draw_contact
from calib.report.figures.panels import TALLEST, chart_axes, inline_svg, sheet_axes
from calib.report.html_parts import PAGE, STYLE, html_table
from tests.browser import Browser, browser_path
from tests.report.test_report import calibration, located  # noqa: F401  fixtures

SCREENS = [(1280, False), (1280, True), (400, False), (400, True)]
needs_browser = pytest.mark.skipif(browser_path() is None, reason="needs Chromium")


@pytest.fixture(scope="module")
def shown(located):  # noqa: F811
    """With two presses to show, on images that have a middle."""
    examples = PressExamples(
        np.eye(2, 3), np.full((2, 4), 500.0), np.array([[0.05, 0.05], [0.15, 0.05]]), np.array([9.0, 10.0])
    )
    numbers = je.imaging.to_numbers(located.recon) | {"factor": np.arange(24.0).reshape(4, 6) % 7 - 2}
    recon = je.imaging.from_numbers(numbers, located.recon.shape, located.recon.extent)
    return replace(located, examples=examples, simulated=True, recon=recon)


def bare_skin(width, height):
    pads = (je.Pad("one", np.array([[0, 0], [width, 0], [width, height], [0, height]], float)),)
    electrodes = tuple(je.PointElectrode((x, y)) for x in (0.01, width / 2) for y in (0.01, height / 2))
    return je.Skin(
        "bare", je.Rectangle(width, height), 100.0, electrodes, je.Protocol(np.array([[0, 1, 2, 3]]), 1.0), pads
    )


# --- without a browser ---------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height"), [(0.3, 0.1), (0.2, 0.2), (0.1, 0.15)])
@pytest.mark.parametrize("bar", [False, True])
def test_a_sheet_keeps_its_proportions(width, height, bar):
    """A millimetre is as long across as up, in the vector graphics; the rim is where its millimetres are."""
    figure, *_ = sheet_axes(bare_skin(width, height), bar=bar)
    root = ElementTree.fromstring(inline_svg(figure, "p", "a sheet"))
    _, _, across, up = map(float, root.attrib["viewBox"].split())
    assert (across, up) == pytest.approx(figure.get_size_inches() * 72, rel=1e-4)
    (line,) = (part.attrib["d"] for part in root.iter("path") if "#8a8a8a" in part.attrib.get("style", ""))
    rim = np.array(re.findall(r"[ML] ([\d.]+) ([\d.]+)", line), float)
    drawn = np.ptp(rim, axis=0)
    assert drawn[1] / drawn[0] == pytest.approx(height / width, rel=1e-3)
    assert drawn[0] < across


def test_a_tall_sheet_is_drawn_narrower_not_taller():
    figure, axes, _ = sheet_axes(bare_skin(0.05, 0.5))
    box = axes.get_window_extent()
    assert box.height / figure.dpi <= 3.5 * TALLEST
    low, high = (np.array(axes.transData.transform(at)) for at in ((0, 0), (50, 500)))
    assert (high - low)[1] / (high - low)[0] == pytest.approx(10, rel=1e-6)


@pytest.mark.parametrize("largest", [1.5, 150.0])
def test_labels_lie_inside_of_their_panel(largest):
    """Ticks below zero are the widest; the letters of the axis stand left of them."""
    figure, axes = chart_axes(simulated=True)
    axes.plot([0, 20], [-0.8 * largest, largest])
    axes.set(xlabel="true force, N", ylabel="estimated − true, N")
    box = figure.get_tightbbox()
    assert min(box.x0, box.y0) >= 0
    assert (box.x1, box.y1) <= tuple(figure.get_size_inches())


def test_ellipses_are_those_of_the_covariance():
    """Against the singular values of a root of the covariance, which no eigenvectors enter."""
    root = np.random.default_rng(0).normal(size=(2, 2)) * 1e-3
    covariance = root @ root.T
    axes_of = INSIDE_90 * np.linalg.svd(root, compute_uv=False)
    assert half_axes(covariance) == pytest.approx(axes_of)
    _, axes = chart_axes()
    draw_contact(axes, np.array([0.05, 0.02]), covariance, ELLIPSE_MAGNIFICATION)
    points = axes.lines[-1].get_xydata() - [50, 20]
    lengths = np.linalg.norm(points, axis=1)
    assert [lengths.max(), lengths.min()] == pytest.approx(1e3 * ELLIPSE_MAGNIFICATION * axes_of, rel=0.01)
    assert np.einsum("ni,ij,nj->n", points, np.linalg.inv(covariance * 1e6), points) == pytest.approx(
        (ELLIPSE_MAGNIFICATION * INSIDE_90) ** 2
    )
    draw_contact(axes, np.array([np.nan, 0.02]), covariance, ELLIPSE_MAGNIFICATION)
    assert len(axes.lines) == 2


@pytest.mark.parametrize(("error", "larger"), [(1e-3, ELLIPSE_MAGNIFICATION), (5e-3, 1)])
def test_ellipses_that_would_hardly_be_seen_are_drawn_larger(skin, error, larger):
    """On a sheet of 200 mm; what was not found does not count."""
    position, covariance = np.array([[0.1, 0.1], [np.nan, np.nan]]), np.stack([error**2 * np.eye(2), np.eye(2)])
    assert ExampleContacts("fitted", position, covariance).magnification(skin) == larger


def test_contacts_of_a_calibration_without_a_locator_are_centroids_of_images(calibration):  # noqa: F811
    shown = PressExamples(np.zeros((2, 3)), np.zeros((2, 4)), np.zeros((2, 2)), np.ones(2))
    image = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    found = example_contacts(replace(calibration, examples=shown), image)
    assert found.estimator == "quarter"
    assert found.position[0] == pytest.approx([0.05, 0.05])
    assert np.isnan(found.position[1]).all()
    error = calibration.evaluation.estimated["quarter"] - calibration.evaluation.position
    expected = sum(np.outer(one, one) for one in error) / len(error)
    assert found.covariance[0] == pytest.approx(expected)
    assert placement_covariance(calibration, "no such") == pytest.approx(0)


def test_the_table_of_contacts_has_the_numbers_of_the_maps(shown):
    maps = ExampleMaps(shown)
    first = maps.rows()[0]
    assert first[:2] == ("press 1", "50.0, 50.0")
    assert first[4] == "9.00"
    assert first[5] == f"{maps.force[0].sum():.2f}"


def test_pictures_have_names_of_their_own_and_colours_of_the_page():
    figures = [chart_axes(simulated=True) for _ in range(2)]
    for _, axes in figures:
        axes.plot([0, 1], [1, 0], "o-", color="black")
        axes.set_xlabel("force, N")
    first, second = (inline_svg(figure, name, "a <line>") for (figure, _), name in zip(figures, "ab", strict=True))
    for text in (first, second):
        assert "#000000" not in text
        assert "currentColor" in text
        assert "var(--red)" in text
        assert "http" not in text
    names = [set(re.findall(r'\bid="([^"]+)"', text)) for text in (first, second)]
    assert names[0]
    assert not names[0] & names[1]
    used = set(re.findall(r'href="#([^"]+)"', first)) | set(re.findall(r"url\(#([^)]+)\)", first))
    assert used == names[0]
    assert ElementTree.fromstring(first).attrib["aria-label"] == "a <line>"


def test_cells_know_their_column():
    table = html_table(["pad", 'a "column"', "<b>"], {"": [("left", "1", "2")]})
    assert re.findall(r'data-column="([^"]*)"', table) == ["a &quot;column&quot;", "&lt;b&gt;"]
    with pytest.raises(ValueError, match="zip"):
        html_table(["pad", "force"], {"": [("left", "1", "2")]})


# --- in a browser --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser():
    with Browser(browser_path()) as found:
        yield found


@pytest.fixture(scope="module")
def page(shown, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "r.html"
    write_report(shown, path)
    return path.as_uri()


def box(tab, of):
    return np.array(tab.box(of))


@needs_browser
@pytest.mark.parametrize(("width", "dark"), SCREENS)
def test_the_report_fits_its_window_in_light_and_dark(browser, page, width, dark):
    with browser.open(page, width, dark=dark) as tab:
        assert tab.overflow() <= 0
        assert tab.errors() == []
        wider = "[...document.querySelectorAll('.wide')].filter(w => w.scrollWidth > w.clientWidth + 1).length"
        assert tab.value(wider) == 0
        text, behind = (
            np.array(re.findall(r"\d+", tab.value(f"getComputedStyle({of}).{name}")), float)[:3]
            for of, name in (("document.querySelector('.panel svg')", "fill"), ("document.body", "backgroundColor"))
        )
        assert bool(text.mean() > behind.mean()) is dark
        assert np.abs(text - behind).min() > 150


@needs_browser
@pytest.mark.parametrize("width", [1280, 400])
def test_panels_stand_side_by_side_where_there_is_room(browser, page, width):
    with browser.open(page, width) as tab:
        boxes = [box(tab, f"document.querySelectorAll('.panels.maps .panel svg')[{k}]") for k in range(4)]
        assert all(270 <= b[2] <= 480 for b in boxes)
        abreast = sum(abs(b[1] - boxes[0][1]) < 1 for b in boxes)
        assert abreast == (4 if width == 1280 else 1)
        view = list(map(float, tab.value("document.querySelector('.panel svg').getAttribute('viewBox')").split()))
        assert boxes[0][3] / boxes[0][2] == pytest.approx(view[3] / view[2], rel=1e-3)


@needs_browser
def test_tables_are_rows_of_named_values_on_a_telephone(browser, page):
    with browser.open(page, 400) as tab:
        cell = "document.querySelector('.numbers tbody tr:nth-child(2) td')"
        assert tab.value(f"getComputedStyle({cell}, '::before').content") == '"presses"'
        row, whole = (np.array(tab.box(of)) for of in (f"{cell}.parentElement", f"{cell}.closest('.wide')"))
        assert row[2] == pytest.approx(whole[2], abs=1)
        roles = {part["role"] for part in tab.accessible()}
        assert {"table", "columnheader", "rowheader"} <= roles
        tab.resize(1280, 800)
        assert tab.value(f"getComputedStyle({cell}, '::before').content") == "none"


@needs_browser
def test_a_table_of_many_columns_fits_too(browser, tmp_path):
    """As that of a curve of many parameters."""
    head = ["pad", *(f"parameter {k}, N/Pa" for k in range(14))]
    table = html_table(head, {"": [("0 lower left", *["0.012345\u00a0±\u00a00.00012"] * 14)]})
    path = tmp_path / "wide.html"
    path.write_text(PAGE.format(title="wide", style=STYLE, body=table), encoding="utf-8")
    for width in (400, 1280):
        with browser.open(path.as_uri(), width) as tab:
            assert tab.overflow() <= 0
            assert (
                tab.value("document.querySelector('.wide').scrollWidth - document.querySelector('.wide').clientWidth")
                <= 0
            )
