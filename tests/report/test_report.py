"""The report page and its figures, from a small calibration made by hand."""

import importlib.util
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from calib.calibration.calibration import Calibration
from calib.calibration.evaluation import Evaluation
from calib.calibration.hysteresis_loops import Loops
from calib.calibration.press_examples import PressExamples
from calib.fitting.cross_validation.held_out import LeaveOutErrors
from calib.fitting.cross_validation.selection import Candidate
from calib.fitting.curves import FittedCurve, Linear
from calib.fitting.fields import FittedField, PadEdge, geometry_of, log_gain, single_places
from calib.report import pictures
from calib.report.document import write_report
from calib.report.figures import parts
from calib.report.figures.force_series import ForceSeries, force_series_figure
from calib.report.figures.pads import curves_figure, gain_figure, loops_figure
from calib.report.figures.parts import ReportError, png
from calib.report.figures.presses import localisation_figure, sensitivity_figure
from calib.report.figures.skin.contact_layer import layer_maps
from calib.report.figures.skin.curved_sheet import curved_figure
from jaxeit.contacts.loads.settings import LoadSettings
from jaxeit.tracking import ContactLaw, GainField, LearnedLayer
from tests.helpers import skin_of

HOSTILE = "\u65e5 $x^$ <script>alert(1)</script> & 'pad' \"\x00"  # the start is what fits into a figure
SLOPE = 0.01  # N/Pa
PM = "\u00a0±\u00a0"


def evaluation_on(places, levels=(5.0, 20.0), held_out_by="location"):
    """Presses on a grid of places a side, each at every force level, each on the pad under it."""
    x, y, force = np.meshgrid(*2 * [np.linspace(0.02, 0.18, places)], levels, indexing="ij")
    position, force = np.stack([x.ravel(), y.ravel()], 1), force.ravel()
    gain = 1 + np.random.default_rng(0).normal(0, 0.1, len(force))
    pad = (position[:, 0] > 0.1) + 2 * (position[:, 1] > 0.1)
    pad_force = np.eye(4)[pad] * (force * gain)[:, None]
    return Evaluation(
        position=position,
        estimated={"peak": position + 0.004, "quarter": position + np.array([0.003, 0.0])},
        force=force,
        pressure=pad_force / SLOPE,
        pad_force=pad_force,
        image_sum=1e-4 * force * gain**2,
        centre=np.array([0.1, 0.1]),
        held_out_by=held_out_by,
        others={"eit": force * gain**2, "hybrid": pad_force.sum(1)},
        recipe="linear",
    )


def fitted_curves(pads):
    def each(value, dtype=float):
        return jnp.asarray([value] * pads, dtype)

    return FittedCurve(
        curve=Linear(),
        parameters=each([SLOPE]),
        covariance=each([[1e-8]]),
        pressure_range=each([0.0, 2000.0]),
        scale=each(0.5),
        residual_rms=each(0.75),
        n=each(80, int),
        n_missing=each(0, int),
        n_groups=each(9, int),
        rank=each(1, int),
        result=each(0, int),
    )


@pytest.fixture(scope="module")
def calibration(skin):
    numbers = {
        "factor": np.zeros((4, 6)),
        "variance": np.full(4, np.inf),
        "predict": np.zeros((6, 6)),
        "pairs": np.tile([0, 1, 2, 3], (3, 1)),
        "current": np.array(1.0),
        "weight": np.ones(3),
        "channels": np.ones(3, bool),
        "centres": np.array([[0.05, 0.05], [0.15, 0.05], [0.05, 0.15], [0.15, 0.15]]),
        "areas": np.full(4, 0.01),
        "edges": np.array([[0, 1], [2, 3]]),
        "edge_length": np.full(2, 0.1),
    }
    recon = je.imaging.from_numbers(numbers, (2, 2), (0.0, 0.2, 0.0, 0.2))
    return Calibration(
        skin=skin,
        recon=recon,
        masks=je.fusion.PadMasks(jnp.eye(4), recon.areas),
        curves=fitted_curves(4),
        evaluation=evaluation_on(4),
        provenance={"created_utc": "2026-01-01T00:00:00+00:00", "curve": "linear", "sessions": "0123abcd  grid.h5"},
        simulated=False,
        notes=("grid.h5: 1 of 33 presses set aside",),
    )


@pytest.fixture(scope="module")
def located(calibration):
    """The same with a correction by location, which halves the errors of force, and a reason for it."""
    found, field = calibration.evaluation, PadEdge()
    better = found.force + (found.total_force - found.force) / 2
    evaluation = replace(
        found,
        estimated=found.estimated | {"fitted": found.position + 0.001},
        pad_force=np.where(found.pad_force > 0, better[:, None], 0),
        others=found.others | {"true_place": found.force + (found.total_force - found.force) / 4},
        recipe="linear, edge",
    )
    size = len(field.shapes()[0])
    fitted = FittedField(
        field=field,
        geometry=geometry_of(calibration.skin),
        coefficients=jnp.linspace(0.1, 0.3, size),
        covariance=1e-4 * jnp.eye(size),
        reach=jnp.tile(jnp.array([[0.02, 0.02], [0.18, 0.18]]), (4, 1, 1)),
        centre=jnp.full((4, size), 0.2),
        noise=jnp.array(0.04),
        spread=jnp.array(0.125),
        evidence=jnp.array(90.0),
        effective=jnp.array(5.0),
        n=jnp.array(16.0),
        result=jnp.array(0),
        error_scale=jnp.array(1.0),
    )
    provenance = calibration.provenance | {"location": "edge", "choice": "edge, the simplest; none 3.02, edge 0.91"}
    return replace(calibration, evaluation=evaluation, field=fitted, provenance=provenance)


@pytest.fixture(scope="module")
def written(calibration, tmp_path_factory):
    return write_report(calibration, tmp_path_factory.mktemp("report") / "r.html")


@pytest.fixture
def no_pictures(monkeypatch):
    """Figures that cost nothing, for tests of the page alone."""
    for name in ("localisation", "sensitivity", "curves", "gain", "loops"):
        monkeypatch.setattr(pictures, f"{name}_figure", lambda *_, **__: None)
    for name in ("localisation", "sensitivity", "curve", "gain", "loop"):
        monkeypatch.setattr(pictures, f"{name}_panels", lambda *_, **__: [])
    monkeypatch.setattr(pictures, "png", lambda _: b"picture")


def page_of(calibration, folder, **options):
    return write_report(calibration, folder / "page.html", **options)[0].read_text(encoding="utf-8")


class Reader(HTMLParser):
    """Tags with their attributes, the texts of table cells, and whether every tag is closed in order."""

    VOID = ("meta", "img")

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.cells = [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.cells[-1] += data


def test_page_and_figures_are_written_beside_each_other(written):
    assert [p.name for p in written] == ["r.html", "r_localisation.png", "r_sensitivity.png", "r_curves.png"]
    assert all(p.read_bytes().startswith(b"\x89PNG\r\n") for p in written[1:])
    assert sorted(p.name for p in written[0].parent.iterdir()) == sorted(p.name for p in written)


def test_page_needs_nothing_but_itself(written):
    text = written[0].read_text(encoding="utf-8")
    reader = Reader(text)
    assert reader.open == []
    loads = [a[k] for _, a in reader.tags for k in ("src", "href", "srcset", "data", "action") if k in a]
    assert loads
    assert all(load.startswith(("data:image/png;base64,", "#")) for load in loads)
    assert not re.search(r"https?://|url\((?!#)|@import|<script|<link|<iframe", text)
    assert len(text) < 1_000_000


def test_page_is_readable_without_seeing_it(written):
    tags = Reader(written[0].read_text(encoding="utf-8")).tags
    drawn = [a for tag, a in tags if tag == "svg"]
    assert len(drawn) == 1 + 2 + 7
    assert all(a["role"] == "img" and len(a["aria-label"]) > 10 for a in drawn)
    assert all(len(a["aria-label"]) > 40 for _, a in tags if a.get("role") == "group")
    assert "".join(tag for tag, _ in tags if re.fullmatch("h[1-6]", tag)).replace("h2", "") == "h1"
    assert {a.get("scope") for tag, a in tags if tag == "th"} == {"row", "col", "rowgroup"}
    assert ("html", {"lang": "en"}) in tags


def test_numbers_are_those_of_the_evaluation(calibration, written):
    cells = Reader(written[0].read_text(encoding="utf-8")).cells
    s = calibration.evaluation.summary()
    row = cells.index("quarter")
    inward = f"{1e3 * s['localisation_quarter_inward_bias']:.1f}".replace("-", "−")
    assert cells[row + 1 : row + 5] == [f"3.0{PM}0.00", "3.0", "3.0", inward]
    assert cells[cells.index("hybrid") : cells.index("hybrid") + 6] == row_of("hybrid", s, "hybrid", "force_hybrid")
    last = len(cells) - cells[::-1].index("hybrid")  # the paper's
    assert cells[last : last + 5] == ["0.14", "—", "—", "—", "—"]
    row = len(cells) - 1 - cells[::-1].index("0 lower left")
    assert cells[row + 1 : row + 7] == [f"0.01{PM}0.0001", "0 to 2000", "80", "9", "0.75", "fitted"]


def test_residuals_by_pad_come_first(calibration, written):
    cells, found = Reader(written[0].read_text(encoding="utf-8")).cells, calibration.evaluation
    mine = found.pressure.argmax(1) == 0
    error = (found.total_force - found.force)[mine]
    sizes = error.mean(), np.sqrt(np.mean(error**2)), np.median(np.abs(error)), np.abs(error).max()
    row = cells.index("0 lower left")
    assert row < cells.index("EIT only")
    assert cells[row + 1 : row + 6] == [str(mine.sum()), *(f"{size:.2f}".replace("-", "−") for size in sizes)]


def row_of(label, s, spread, errors):
    """One method's row of the table of results, from the summary."""
    keys = {"rmse": 2, "rmse_percent_full_scale": 1, "mean_absolute": 2, "worst": 2}
    cv = f"{s[f'cv_{spread}_ddof1']:.3f}{PM}{s[f'cv_{spread}_se']:.3f}"
    return [label, cv, *(f"{s[f'{errors}_{key}']:.{digits}f}" for key, digits in keys.items())]


def test_every_method_has_its_row(located, no_pictures, tmp_path):
    cells, s = Reader(page_of(located, tmp_path)).cells, located.evaluation.summary()
    first = cells.index("this calibration: 32 presses, held out by location") + 1
    assert cells[first : first + 24] == [
        *row_of("EIT only", s, "eit", "force_eit"),
        *row_of("hybrid", s, "hybrid", "force_hybrid"),
        *row_of("calibrated (linear, edge)", s, "calibrated", "force"),
        *row_of("true place", s, "true_place", "force_true_place"),
    ]


def test_a_calibration_of_before_has_the_rows_it_can_have(calibration, no_pictures, tmp_path):
    old = replace(calibration, evaluation=replace(calibration.evaluation, others={}, recipe=""))
    cells = Reader(page_of(old, tmp_path)).cells
    row = cells.index("EIT only")
    assert cells[row + 2 : row + 7] == ["—", "—", "—", "—", "calibrated"]


def test_what_is_left_out_at_a_time_is_told(calibration, no_pictures, tmp_path):
    splits = (
        LeaveOutErrors("pad", 4, 144, 0.7, 0.55, 0.85, 0.84),
        LeaveOutErrors("indenter", 1, note="one indenter <only>"),
    )
    found = replace(calibration, evaluation=replace(calibration.evaluation, splits=splits))
    page = page_of(found, tmp_path)
    assert "0.70 (0.55 to 0.85)" in page
    assert "one indenter &lt;only&gt;" in page
    assert "Beyond what was pressed" not in page_of(calibration, tmp_path)


def test_forces_over_time_are_drawn_beside_the_truth():
    time = np.linspace(0, 6, 50)
    true = np.stack([np.sin(time), np.cos(time)], 1)
    one = ForceSeries("two $contacts$", ("1", "2"), time, true, true + 0.1, {"press 1": 1.0})
    figure = force_series_figure([one, one], simulated=True)
    assert png(figure).startswith(b"\x89PNG")
    above, _, below, _ = figure.axes
    np.testing.assert_allclose(below.lines[0].get_ydata(), 0.1)
    assert above.get_ylabel() == "force, N"


def test_the_choice_and_its_reason_are_told(calibration, located, no_pictures, tmp_path):
    assert (
        "none 3.02, edge 0.91" in page_of(located, tmp_path).split("<h2>Choice of the model</h2>")[1].split("</p>")[0]
    )
    assert "Choice of the model" not in page_of(calibration, tmp_path)


def test_all_candidates_are_told_with_their_errors(located, no_pictures, tmp_path):
    tried = (
        Candidate("location", "none", 0, 3.02, 2.9, 3.1, False),
        Candidate("location", "edge", 6, 0.91, 0.85, 0.99, True),
        Candidate("curve", "linear", 1, None, None, None, False),
    )
    page = page_of(replace(located, tried=tried), tmp_path).split("<h2>Choice of the model</h2>")[1].split("<h2>")[0]
    cells = re.findall(r"<t[dh][^>]*>([^<]*)</t[dh]>", page)
    rows = {cells[i]: cells[i + 1 : i + 5] for i in range(len(cells)) if cells[i] in ("none", "edge", "linear")}
    assert rows["none"] == ["0", "3.02", "2.90 to 3.10", ""]
    assert rows["edge"] == ["6", "0.91", "0.85 to 0.99", "chosen"]
    assert rows["linear"] == ["1", "not determined", "—", ""]


def looped(calibration, lag=0.5, back=True):
    """A press to 20 N on every pad but the last, whose force is ahead of the law on the way in and behind on the way
    back; or held for ever."""
    force = np.r_[np.linspace(0, 20, 21), np.linspace(20, 0, 21)][: 42 if back else 21]
    ahead = lag * np.where(np.arange(len(force)) < 21, 1, -1) * (force > 0) * (force < 20)
    pressure = np.tile((force - ahead) / SLOPE, (4, 1))
    pressure[3] = np.nan
    return replace(calibration, loops=Loops(pressure, np.tile(force, (4, 1)), np.array([1, 1, 1.5, np.nan])))


def test_loading_and_unloading_are_drawn_with_the_law_at_that_place(calibration):
    known = looped(calibration)
    assert known.loops.width(0) == pytest.approx(1.0, abs=0.1)
    assert np.isnan(known.loops.width(3))
    first, _, third, last = loops_figure(known).axes
    loading, unloading, law = first.lines
    np.testing.assert_allclose(loading.get_xdata().max(), 2)  # kPa
    assert (unloading.get_ydata()[0], unloading.get_ydata()[-1]) == (20, 0)
    np.testing.assert_allclose(law.get_ydata(), 1e3 * SLOPE * law.get_xdata())
    np.testing.assert_allclose(third.lines[2].get_ydata(), 1.5 * law.get_ydata())
    assert "loading − unloading 0.93 N" in first.get_title()
    assert not last.lines
    assert "no press of its own" in last.get_title()


def test_hysteresis_has_its_picture_where_presses_were_released(calibration, no_pictures, tmp_path):
    page, *files = write_report(looped(calibration), tmp_path / "page.html")
    assert "page_loops.png" in [p.name for p in files]
    assert "mean of loading over unloading: 0.93 N, 0.93 N, 0.93 N, —" in page.read_text(encoding="utf-8")
    for none in (calibration, looped(calibration, back=False)):
        assert "Hysteresis" not in page_of(none, tmp_path)
        with pytest.raises(ReportError, match="no loading and unloading"):
            loops_figure(none)


def test_a_correction_by_location_is_drawn_and_told(located, no_pictures, tmp_path):
    page, *files = write_report(located, tmp_path / "page.html")
    assert [p.name for p in files][-1] == "page_gain.png"
    text = page.read_text(encoding="utf-8")
    assert len(re.findall("<div class=.panels ", text)) == len(files) == 4
    assert "by 12.5 % about the curves alone and by 4.0 % about curves and gain" in text
    assert "fitted: place that the correction by location goes by" in text


def test_simulated_is_said_only_of_simulated(calibration, no_pictures, tmp_path):
    assert "SIMULATED" not in page_of(calibration, tmp_path)
    page = page_of(replace(calibration, simulated=True), tmp_path)
    assert page.count("SIMULATED") == 2  # banner and title of the window
    assert "not validation" in page


@pytest.mark.parametrize("simulated", [False, True])
def test_simulated_is_said_in_every_picture(calibration, located, skin, simulated):
    made = [
        localisation_figure(calibration.evaluation, skin, simulated=simulated),
        sensitivity_figure(calibration.evaluation, skin, simulated=simulated),
        curves_figure(replace(calibration, simulated=simulated)),
        gain_figure(replace(located, simulated=simulated)),
    ]
    assert [f.get_suptitle() for f in made] == ["SIMULATED" if simulated else ""] * 4


def hostile_calibration(calibration):
    pads = tuple(je.Pad(HOSTILE + str(n), pad.outline) for n, pad in enumerate(calibration.skin.pads))
    skin = replace(calibration.skin, name=HOSTILE, pads=pads)
    found = replace(calibration.evaluation, held_out_by=HOSTILE, recipe=HOSTILE)
    provenance = {HOSTILE: HOSTILE, "curve": HOSTILE, "choice": HOSTILE}
    return replace(calibration, skin=skin, evaluation=found, provenance=provenance, notes=(HOSTILE,))


def test_names_from_files_are_escaped(calibration, no_pictures, tmp_path):
    text = page_of(
        hostile_calibration(calibration),
        tmp_path,
        evaluations={HOSTILE: replace(evaluation_on(3), notes=(HOSTILE,))},
    )
    tags = Reader(text).tags
    assert "<script" not in text
    assert "script" not in {tag for tag, _ in tags}
    assert text.count("&lt;script&gt;") >= 12


def test_names_from_files_can_be_drawn(calibration):
    found = curves_figure(hostile_calibration(calibration), {HOSTILE: evaluation_on(3)})
    assert png(found)[:4] == b"\x89PNG"  # warnings are errors: no mathematics, no missing letter


def test_other_sessions_have_their_own_rows(calibration, no_pictures, tmp_path):
    page = page_of(calibration, tmp_path, evaluations={"next day.h5": evaluation_on(2, held_out_by="session")})
    cells = Reader(page).cells
    row = cells.index("next day.h5: 8 presses, held out by session")
    assert cells[row + 1 : row + 20 : 6] == [
        "EIT only",
        "hybrid",
        "calibrated (linear)",
        "the paper: 225 presses on hardware",
    ]


def test_errors_at_one_force_are_said_to_be_of_that_force(calibration, no_pictures, tmp_path):
    one = replace(calibration, evaluation=evaluation_on(3, levels=(20.0,)))
    assert "All presses were held at about 20 N" in page_of(one, tmp_path)
    assert "All presses were held" not in page_of(calibration, tmp_path)


def test_same_input_same_bytes(calibration, written, tmp_path):
    again = write_report(calibration, tmp_path / "r.html")
    assert [p.read_bytes() for p in again] == [p.read_bytes() for p in written]


def test_failure_leaves_the_old_files_and_nothing_else(calibration, no_pictures, tmp_path, monkeypatch):
    page = tmp_path / "page.html"
    page.write_text("old")

    written = type(page).write_bytes

    def full(path, data):
        if path.parent != tmp_path:  # the cache of compiled programs
            return written(path, data)
        with open(path, "wb") as file:
            file.write(data[: len(data) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(page), "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        write_report(calibration, page)
    assert page.read_text() == "old"
    assert list(tmp_path.iterdir()) == [page]


def test_missing_folder_is_named(calibration, no_pictures, tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        write_report(calibration, tmp_path / "nowhere" / "page.html")


def test_without_matplotlib_the_error_says_what_to_install(calibration, skin, tmp_path, monkeypatch):
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.collections", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    spec = importlib.util.spec_from_file_location("calib.report.figures._parts_alone", parts.__file__)
    alone = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(alone)
    with pytest.raises(alone.ReportError, match=r"jaxeit\[report\]"):
        alone.require_matplotlib()
    monkeypatch.setattr(parts, "Figure", None)
    for draw in (localisation_figure, sensitivity_figure):
        with pytest.raises(ReportError, match=r"jaxeit\[report\]"):
            draw(calibration.evaluation, skin)
    with pytest.raises(ReportError, match=r"jaxeit\[report\]"):
        write_report(calibration, tmp_path / "page.html")
    assert list(tmp_path.iterdir()) == []


def test_electrodes_are_drawn_to_scale_where_they_give_outlines():
    """A ring by both of its circles, a polygon by its corners, and a bolt, which is small, as a mark."""
    ring, bolt = je.skin.RingPatch((0.05, 0.05), 0.004, 0.008), je.AreaPatch((0.1, 0.1), 0.003)
    pad = je.PolygonPatch(je.Polygon([(0.1, 0.02), (0.12, 0.02), (0.11, 0.03)]))
    axes = parts.bare_figure(4, 4).subplots()
    parts.draw_electrodes(axes, skin_of(je.Rectangle(0.2, 0.2), (ring, bolt, pad), [[0, 1, 0, 1]]))
    sizes = [np.ptp(path.vertices, axis=0).max() for path in axes.collections[0].get_paths()]
    assert sizes == pytest.approx([16, 8, 20], rel=2e-3)  # mm
    (marks,) = axes.lines
    np.testing.assert_allclose(marks.get_xydata(), [[100, 100]])


def test_unknown_estimator_is_refused_by_name(calibration, skin):
    with pytest.raises(ReportError, match=r"'half'.*peak, quarter"):
        localisation_figure(calibration.evaluation, skin, "half")


def test_localisation_title_states_error_and_estimator(calibration, skin):
    quarter = calibration.evaluation.estimated["quarter"].copy()
    quarter[0] = np.nan
    found = replace(calibration.evaluation, estimated={"quarter": quarter})
    title = localisation_figure(found, skin).axes[0].get_title()
    assert "3.0 mm (32 presses, 1 not found)" in title
    assert "estimator quarter" in title


def test_estimators_have_a_panel_each(located, skin):
    titles = [axes.get_title() for axes in localisation_figure(located.evaluation, skin, "quarter", "fitted").axes]
    assert ["estimator quarter" in titles[0], "1.4 mm" in titles[1], "correction by location" in titles[1]] == [
        True
    ] * 3


def test_the_calibrated_force_has_a_third_map_where_it_is_not_the_papers(calibration, located, skin):
    assert len(sensitivity_figure(calibration.evaluation, skin).axes) == 3  # two and the scale
    *_, third, _ = sensitivity_figure(located.evaluation, skin).axes
    s, expected = located.evaluation.summary(), located.evaluation.sensitivity("calibrated")
    assert f"Calibrated: estimated / true force\nCV {s['cv_calibrated_ddof1']:.3f}" in third.get_title()
    assert third.collections[0].get_array().ravel()[0] == pytest.approx(expected[:2].mean() / expected.mean())


@pytest.mark.slow
def test_a_layer_that_was_learned_has_two_maps(located, written, tmp_path):
    """They are the field's own mean and deviation, and nothing is drawn off the sheet."""
    corners = np.array([[0.0, 0.0], [0.2, 0.2]])
    field = GainField.on_sheet(corners, np.random.default_rng(0).uniform(0, 0.2, (99, 2)), LoadSettings(), 0.3)
    count = len(field.places)
    layer = LearnedLayer.normal(field, np.linspace(-1, 1, count), np.eye(count), contacts=12)
    known = replace(located, layer=layer, contact_law=ContactLaw.unknown()._replace(contacts=12))
    page, *files = write_report(known, tmp_path / "r.html")
    assert "as told by 12 contacts" in page.read_text()
    assert "as the model tells it; 12 contacts do not speak for another law." in page.read_text()
    assert tmp_path / "r_layer.png" in files
    assert not any("layer" in path.name for path in written)
    gain, spread = layer_maps(layer, known.recon)
    centres, there = np.asarray(known.recon.centres), np.asarray(known.recon.areas) > 0
    modes = field.modes_at(centres)
    np.testing.assert_allclose(gain.ravel()[there], np.exp(modes @ layer.mean)[there])
    np.testing.assert_allclose(spread.ravel()[there], 100 * np.linalg.norm(modes, axis=1)[there])
    assert np.isnan(gain.ravel()[~there]).all()


@pytest.mark.slow
def test_a_curved_sheet_is_drawn_in_space_and_a_flat_one_is_not(located, written, tmp_path):
    """As a cylinder: places, cells and maps lie on it."""
    curved = replace(located.skin, surface=je.geometry.Cylinder(0.3, 0.1))
    examples = PressExamples(
        np.ones((2, 3)), np.full((2, 4), 500.0), np.array([[0.05, 0.05], [0.15, 0.05]]), np.ones(2)
    )
    page, *files = write_report(replace(located, skin=curved, examples=examples), tmp_path / "r.html")
    assert "On the curved sheet" in page.read_text()
    assert tmp_path / "r_curved.png" in files
    assert not any("curved" in path.name for path in written)
    figure = curved_figure(replace(located, skin=curved, examples=examples), "fitted")
    views = [axes for axes in figure.axes if axes.name == "3d"]
    assert len(views) == 4
    assert all(len(axes.collections) == 1 for axes in views[1:])
    assert views[0].get_xlim3d() == pytest.approx((-300 * np.sin(1 / 3), 300 * np.sin(1 / 3)))
    assert views[0].get_zlim3d() == pytest.approx((300 * np.cos(1 / 3), 300), rel=1e-3)


def test_both_sensitivity_maps_have_one_scale_about_their_mean(calibration, skin):
    found = calibration.evaluation
    eit, hybrid, _ = sensitivity_figure(found, skin).axes
    maps = [axes.collections[0] for axes in (eit, hybrid)]
    assert maps[0].get_clim() == maps[1].get_clim()
    assert sum(maps[0].get_clim()) == pytest.approx(2)
    assert [np.mean(m.get_array()) for m in maps] == pytest.approx([1, 1])
    first = found.sensitivity_hybrid[:2].mean() / found.sensitivity_hybrid.mean()
    assert maps[1].get_array().ravel()[0] == pytest.approx(first)
    right_of_it = found.sensitivity_eit[8:10].mean()  # x runs slowest in the presses, fastest in the picture
    assert maps[0].get_array().ravel()[1] == pytest.approx(right_of_it)


def test_places_that_form_no_grid_are_marks(calibration, skin):
    found = calibration.evaluation
    part = {k: getattr(found, k)[:5] for k in ("position", "force", "pressure", "pad_force", "image_sum")}
    part |= {name: {k: v[:5] for k, v in getattr(found, name).items()} for name in ("estimated", "others")}
    axes = sensitivity_figure(replace(found, **part), skin).axes[0]
    assert len(axes.collections[0].get_offsets()) == 3  # five presses at two levels: three places


def test_gain_and_its_error_are_those_of_the_field(located):
    gain, error, *_ = gain_figure(located).axes
    cells = [axes.collections[1] for axes in (gain, error)]  # of the second pad, 0.1 m wide, 48 cells
    place = np.array([[0.1 + 30.5 * 0.1 / 48, 10.5 * 0.1 / 48]])
    mean, variance = (part[0, 1] for part in log_gain(located.field, single_places(place, 4)))
    centre = np.asarray(cells[0].get_coordinates())[10:12, 30:32].mean((0, 1))
    assert centre == pytest.approx(1e3 * place[0])
    assert cells[0].get_array()[10, 30] == pytest.approx(np.exp(mean))
    assert cells[1].get_array()[10, 30] == pytest.approx(100 * np.sqrt(variance))
    assert np.asarray(error.lines[-1].get_xydata()) == pytest.approx(1e3 * located.evaluation.estimated["fitted"])


def test_a_pad_is_coloured_within_its_outline_alone(located):
    whole = located.skin.pads[0].outline
    cut = replace(located.skin, pads=(je.Pad("cut", whole[:3]), *located.skin.pads[1:]))
    cells = gain_figure(replace(located, skin=cut)).axes[0].collections[0]
    path, _ = cells.get_clip_path().get_transformed_path_and_affine()
    assert len(path.vertices) == 4  # three sides, closed


def test_no_field_no_picture_of_it(calibration):
    with pytest.raises(ReportError, match="--location"):
        gain_figure(calibration)


def test_one_press_is_enough_for_a_page(calibration, tmp_path):
    found = calibration.evaluation
    part = {k: getattr(found, k)[:1] for k in ("position", "force", "pressure", "pad_force", "image_sum")}
    part |= {name: {k: v[:1] for k, v in getattr(found, name).items()} for name in ("estimated", "others")}
    text = page_of(replace(calibration, evaluation=replace(found, **part)), tmp_path)
    cells = Reader(text).cells
    assert cells[cells.index("hybrid") + 1] == "—"


def test_force_errors_are_drawn_in_the_order_of_the_presses(calibration):
    other = evaluation_on(2)
    panel = next(a for a in curves_figure(calibration, {"next": other}).subfigs[1].axes if "time" in a.get_title())
    for line, found in zip(panel.lines[1:], (calibration.evaluation, other), strict=True):
        assert line.get_xdata().tolist() == list(range(len(found.force)))
        assert line.get_ydata() == pytest.approx(found.total_force - found.force)


def test_curve_and_band_are_those_of_the_fit(calibration):
    axes = curves_figure(calibration).subfigs[0].axes[0]
    pressure, force = axes.lines[-1].get_data()
    assert force == pytest.approx(1e3 * SLOPE * pressure)
    band = axes.collections[0].get_paths()[0].vertices
    top = band[np.isclose(band[:, 0], 2.0)][:, 1].max()
    assert top == pytest.approx(2000 * (SLOPE + 1.96e-4))
    assert len(axes.lines[0].get_xdata()) == 8  # two places a side, two levels


def test_a_notebook_shows_errors_and_places_of_a_calibration(located):
    named = replace(located, skin=replace(located.skin, name="<b>skin"), notes=("grid.h5: <i>1</i> & more",))
    tree = ElementTree.fromstring(named._repr_html_())
    rows = {row[0].text: row[1].text for row in tree.iter("tr")}
    found = named.evaluation
    error = np.sqrt(np.mean((found.total_force - found.force) ** 2))
    assert rows["error of force, held out by location"] == f"{error:.3g} N, RMSE"
    assert rows["error of place, mean"] == "1.41 mm"  # 1 mm along x and along y
    assert rows["sessions"] == "grid.h5"
    assert rows["note"] == "grid.h5: <i>1</i> & more"
    assert tree.find(".//strong").text == "Calibration of <b>skin"
    (crosses,) = tree.iter("{http://www.w3.org/2000/svg}path")
    assert crosses.attrib["d"].count("M") == len(found.force)
