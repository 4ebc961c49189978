"""Pictures of the report of a calibration: panels on the page, and the paper's figures as PNG files beside it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

from ..calibration.calibration import Calibration
from ..calibration.evaluation import Evaluation
from .captions import (
    about_curved,
    about_curves,
    about_gain,
    about_localisation,
    about_loops,
    about_maps,
    about_sensitivity,
)
from .figures.maps import ExampleMaps, maps_figure
from .figures.pads import curves_figure, gain_figure, has_loops, loops_figure
from .figures.panels import FigurePanel
from .figures.parts import png
from .figures.press_panels import (
    curve_panels,
    gain_panels,
    localisation_panels,
    loop_panels,
    map_panels,
    sensitivity_panels,
)
from .figures.presses import localisation_figure, sensitivity_figure
from .figures.skin.contact_layer import about_layer, layer_figure, layer_panels
from .figures.skin.curved_sheet import curved_figure, curved_panels
from .figures.skin.electrodes import about_electrodes, electrodes_figure, electrodes_panels
from .html_parts import html_table

# The image's estimator nearest to the paper's figure, and the one that the correction by location goes by.
SHOWN_ESTIMATORS = ("quarter", "fitted")
FEW = 2  # panels, which are larger
CONTACT_COLUMNS = (
    "shown",
    "true place, mm",
    "contact, mm",
    "half axes of the ellipse of 90 %, mm",
    "load cell, N",
    "force map, N",
)


@dataclass(frozen=True)
class PictureSection:
    """A section of the page, and its PNG file.

    | field  | meaning                                                                |
    |--------|------------------------------------------------------------------------|
    | name   | of the file, and class of the section                                  |
    | title  | heading of the section                                                 |
    | data   | the figure as a PNG file                                               |
    | alt    | what is shown, for those who do not see it                             |
    | caption | what to look for                                                       |
    | panels | what the page shows                                                    |
    | rows   | of a table of the contacts below                                       |
    """

    name: str
    title: str
    data: bytes
    alt: str
    caption: str
    panels: Sequence[FigurePanel]
    rows: Sequence[Sequence[str]] = field(default=())

    def html(self) -> str:
        """The section of the page."""
        parts = "".join(panel.html() for panel in self.panels)
        kind = f"{self.name} few" if len(self.panels) <= FEW else self.name
        shown = f"<div class='panels {kind}' role='group' aria-label=\"{escape(self.alt)}\">{parts}</div>"
        table = html_table(CONTACT_COLUMNS, {"": self.rows}) if self.rows else ""
        caption = f"<figcaption>{escape(self.caption)}</figcaption>"
        return f"<h2>{escape(self.title)}</h2><figure>{shown}{caption}</figure>{table}"


def calibration_pictures(calibration: Calibration, evaluations: Mapping[str, Evaluation]) -> list[PictureSection]:
    """All pictures of a calibration, in the order of the page.

    Raises:
        ReportError: matplotlib is not installed.
    """
    pictures = [*_examples(calibration), *_places(calibration)]
    curves = png(curves_figure(calibration, evaluations))
    about = about_curves(calibration, evaluations)
    panels = curve_panels(calibration, evaluations)
    pictures.append(PictureSection("curves", "Curves and force errors", curves, *about, panels))
    if has_loops(calibration):
        loops, about = png(loops_figure(calibration)), about_loops(calibration)
        pictures.append(PictureSection("loops", "Hysteresis", loops, *about, loop_panels(calibration)))
    if calibration.field is not None:
        gain, about = png(gain_figure(calibration)), about_gain(calibration.field)
        pictures.append(PictureSection("gain", "Gain by location", gain, *about, gain_panels(calibration)))
    if calibration.layer is not None:
        maps, about = png(layer_figure(calibration)), about_layer(calibration.layer, calibration.contact_law)
        pictures.append(PictureSection("layer", "Contact layer", maps, *about, layer_panels(calibration)))
    if calibration.electrodes is not None:
        shifts, about = png(electrodes_figure(calibration)), about_electrodes(calibration)
        pictures.append(PictureSection("electrodes", "Electrodes", shifts, *about, electrodes_panels(calibration)))
    return pictures


def _estimators(calibration: Calibration) -> list[str]:
    known = calibration.evaluation.estimated
    return [name for name in SHOWN_ESTIMATORS if name in known] or list(known)[:1]


def _examples(calibration: Calibration) -> list[PictureSection]:
    """Maps of some presses, and those on a curved sheet in space."""
    if calibration.examples is None:
        return []
    maps = ExampleMaps(calibration)
    about = about_maps(calibration.examples, maps.contacts.estimator, maps.larger)
    title = "Images, force maps and contacts of some presses"
    pictures = [PictureSection("maps", title, png(maps_figure(maps)), *about, map_panels(maps), maps.rows())]
    if calibration.skin.surface is not None:
        estimator = _estimators(calibration)[-1]
        curved = png(curved_figure(calibration, estimator))
        panels = curved_panels(calibration, estimator)
        pictures.append(PictureSection("curved", "On the curved sheet", curved, *about_curved(estimator), panels))
    return pictures


def _places(calibration: Calibration) -> list[PictureSection]:
    """Places and sensitivity."""
    found, skin, simulated = calibration.evaluation, calibration.skin, calibration.simulated
    estimators = _estimators(calibration)
    places = png(localisation_figure(found, skin, *estimators, simulated=simulated))
    panels = localisation_panels(found, skin, *estimators, simulated=simulated)
    sensitivity = png(sensitivity_figure(found, skin, simulated=simulated))
    maps = sensitivity_panels(found, skin, simulated=simulated)
    return [
        PictureSection("localisation", "Localisation", places, *about_localisation(found, estimators), panels),
        PictureSection("sensitivity", "Sensitivity over the sheet", sensitivity, *about_sensitivity(found), maps),
    ]
