"""A new class is one file and one line: a copy of the packages is given one of each family, and knows it everywhere."""

import ast
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

FORMATS = "calib/session/importers/formats"
ADDITIONS = {
    "effect": ("jaxeit/effects/wetness.py", "jaxeit/effects/__init__.py", "Wetness"),
    "prior": ("jaxeit/imaging/flat.py", "jaxeit/imaging/__init__.pyi", "Flat"),
    "method": ("jaxeit/imaging/methods/adjoint.py", "jaxeit/imaging/methods/__init__.py", "Adjoint"),
    "curve": ("calib/fitting/curves/root.py", "calib/fitting/curves/__init__.py", "Root"),
    "field": ("calib/fitting/fields/slope.py", "calib/fitting/fields/__init__.py", "Slope"),
    "electrode": ("jaxeit/skin/electrodes/crosses.py", "jaxeit/skin/__init__.py", "CrossPatch"),
    "format": (f"{FORMATS}/rows.py", f"{FORMATS}/__init__.py", "RowsImporter"),
}
"""The file of the new class, the file that is given one line, and the class."""

SOURCES = {
    "effect": '''"""Water in the sheet."""

from jaxtyping import Array, Float

from .base import AbstractSheetEffect, parameter
from .quantities import Sheet


class Wetness(AbstractSheetEffect):
    """The whole sheet conducts better by a factor."""

    factor: Float[Array, ""] = parameter(2.0)

    def __call__(self, sheet: Sheet) -> Sheet:
        return sheet._replace(sigma=self.factor * sheet.sigma)
''',
    "prior": '''"""R = I."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..model.bases import Picture
from .priors import AbstractPrecision, AbstractPrior, Diagonal


class Flat(AbstractPrior):
    """R = scale I."""

    scale: float = 1.0

    def precision(
        self, jacobian: Float[Array, "k basis"], picture: Picture, at: Float[Array, " basis"] | None = None
    ) -> AbstractPrecision:
        return Diagonal(jnp.full(jacobian.shape[1], self.scale, jacobian.dtype))
''',
    "method": '''"""x = J^T y."""

from .base import AbstractLinearMethod, Problem


class Adjoint(AbstractLinearMethod):
    """x = J^T y."""

    def image(self, problem: Problem, y):
        return problem.jacobian.T @ y
''',
    "curve": '''"""A root."""

import jax.numpy as jnp

from .elementary import Linear


class Root(Linear):
    """F = a sqrt(P)."""

    def __call__(self, params, pressure):
        return params[0] * jnp.sqrt(jnp.maximum(pressure, 1e-12))

    def inverse(self, params, force):
        return (force / params[0]) ** 2
''',
    "field": '''"""A gain that changes along x."""

import equinox as eqx
import numpy as np

from .base import AbstractField


class Slope(AbstractField):
    """The gain changes along x."""

    shared: bool = eqx.field(static=True, default=True)

    def basis(self, geometry, place):
        return place[..., :1]

    def shapes(self):
        return np.ones((1, 1))
''',
    "electrode": '''"""Cross-shaped electrodes."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...geometry.shapes import Polygon
from ...meshing.outlines import PolygonFootprint
from .base import AbstractAreaElectrode, ElectrodeDrawing
from .places import read_area_contact, read_positions_inside


@dataclass(frozen=True)
class CrossPatch(AbstractAreaElectrode):
    """A cross of two bars, twice as long as wide."""

    name: ClassVar[str] = "cross"

    position: tuple[float, float]
    size: float
    contact: float = 1e-6

    @property
    def shape(self) -> Polygon:
        arm = np.array([[2, -1], [2, 1], [1, 1], [1, 2]]) * self.size / 4
        turns = [np.linalg.matrix_power([[0, -1], [1, 0]], k) for k in range(4)]
        return Polygon(np.concatenate([arm[:3] @ turn.T for turn in turns]) + self.position)

    def footprint(self, segments: int) -> PolygonFootprint:
        return PolygonFootprint(self.shape, segments)

    def elements(self, space) -> np.ndarray:
        return np.flatnonzero(self.shape.contains(space.mesh.chart_centroids))

    def centre(self, domain) -> np.ndarray:
        return np.asarray(self.position, float)

    def drawing(self, domain) -> ElectrodeDrawing:
        return ElectrodeDrawing((self.shape.corner_points,))

    @classmethod
    def read(cls, table, domain) -> tuple["CrossPatch", ...]:
        positions, size = read_positions_inside(table, domain), table.positive("size", "length of a bar in m")
        contact = read_area_contact(table)
        return tuple(cls(position, size, contact) for position in positions)
''',
    "format": '''"""Text files with a row for each variable."""

from typing import ClassVar

import numpy as np

from ..arrays import AbstractArrayImporter, ArrayShape


class RowsImporter(AbstractArrayImporter):
    """A line for each variable: its name, a colon, its values."""

    name: ClassVar[str] = "rows"
    summary: ClassVar[str] = "text with a row for each variable"
    isolated: ClassVar[bool] = False

    @classmethod
    def outline(cls, path):
        return {name: ArrayShape(len(values), 1) for name, values in cls._rows(path).items()}

    @classmethod
    def arrays(cls, path, names):
        return [cls._rows(path)[name][:, None] for name in names]

    @staticmethod
    def _rows(path):
        rows = (line.split(":") for line in path.read_text().splitlines())
        return {name: np.array(values.split(), float) for name, values in rows}
''',
}

QUESTIONS = '''
import contextlib
import io
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np

import calib
import jaxeit as je
from calib.cli import main
from calib.fitting import CURVES, FIELDS
from calib.live.views.page_scene import electrode_outlines
from calib.report.figures.parts import bare_figure, draw_electrodes
from calib.session.importers import importers


def said(*words):
    """What a command prints."""
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        main(list(words))
    return text.getvalue()


registries = {
    "effect": je.effects.EFFECTS,
    "prior": je.imaging.PRIORS,
    "method": je.imaging.METHODS,
    "curve": CURVES,
    "field": FIELDS,
    "electrode": je.skin.ELECTRODES,
    "format": importers(),
}
out = {"names": {kind: list(registry) for kind, registry in registries.items()}, "home": calib.__file__}
out["help"] = said("calibrate", "--help").split() + said("import", "--help").split()

recipe = """curve = "root"
location = "slope"
[imaging]
prior = {type = "flat", scale = 3.0}
method = "adjoint"
"""
recipe = calib.Recipe.from_toml(recipe)
again = calib.Recipe.from_toml(recipe.to_toml())
parts = again.imaging.prior, again.imaging.method, again.curve, again.location
out["recipe"] = [type(part).__name__ for part in parts] + [again.imaging.prior.scale]

effects = """[[effects]]
type = "Wetness"
factor = 3
"""
(wetness,) = je.toml.parse_toml(effects, "scene", je.model.read_effects)
out["scene"] = [type(wetness).__name__, float(wetness.factor)]

text = je.load_skin("testbed").toml
crosses = """[electrodes]
kind = "cross"
size = 0.01
contact = 1e-6
grid = {columns = 5, rows = 5, pitch = 0.04, origin = [0.02, 0.02]}

"""
skin = je.skin.parse_skin(text[: text.index("[electrodes]")] + crosses + text[text.index("[protocol]") :])
axes = bare_figure(4, 4).subplots()
draw_electrodes(axes, skin)
out["skin"] = [type(electrode).__name__ for electrode in skin.electrodes]
out["drawn"] = [len(axes.collections[0].get_paths()), len(axes.lines), len(electrode_outlines(skin))]
out["shown"] = len(je.plot.show_skin(skin).lines)
space = je.meshing.elements.function_space(
    je.meshing.generation.triangulate(skin.domain, [skin.electrodes[0].footprint(8)], 0.02), 1
)
out["area"] = float(space.mesh.areas[skin.electrodes[0].elements(space)].sum())

Path("log.txt").write_text("t: 0 1 2 3\\nf: 1 2 3 5\\n")
out["imported"] = main(["import", "rows", "log.txt", "--time", "t:s", "--stream", "force=f:N", "-o", "log.h5"])
with calib.open_session("log.h5") as session:
    out["force"] = np.ravel(session.streams["force"].read()).tolist()
print(json.dumps(out))
'''


def give_line(path: Path, line: str) -> None:
    """Write one line after the last import of a module or a stub."""
    text = path.read_text()
    imports = [node for node in ast.parse(text).body if isinstance(node, ast.ImportFrom)]
    lines = text.splitlines(keepends=True)
    lines.insert(imports[-1].end_lineno, line + "\n")
    path.write_text("".join(lines))


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """What a copy of the packages says of itself, given a file and a line for each family."""
    copy = tmp_path_factory.mktemp("copy")
    for package in ("jaxeit", "calib"):
        shutil.copytree(ROOT / package, copy / package, ignore=shutil.ignore_patterns("__pycache__"))
    for kind, (new, room, name) in ADDITIONS.items():
        (copy / new).write_text(SOURCES[kind])
        module = ".".join(Path(new).relative_to(Path(room).parent).with_suffix("").parts)
        give_line(copy / room, f"from .{module} import {name} as {name}")
    (copy / "questions.py").write_text(QUESTIONS)
    done = subprocess.run([sys.executable, "questions.py"], cwd=copy, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    answers = json.loads(done.stdout.splitlines()[-1])
    assert Path(answers["home"]).is_relative_to(copy)
    return answers


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("effect", "Wetness"),
        ("prior", "flat"),
        ("method", "adjoint"),
        ("curve", "root"),
        ("field", "slope"),
        ("electrode", "cross"),
        ("format", "rows"),
    ],
)
def test_it_is_in_its_registry(known, kind, name):
    assert name in known["names"][kind]


def test_the_command_line_lists_it(known):
    words = {word.strip(",);") for word in known["help"]}
    assert {"flat", "adjoint", "root", "slope", "rows"} <= words


def test_files_describe_it(known):
    assert known["recipe"] == ["Flat", "Adjoint", "Root", "Slope", 3.0]
    assert known["scene"] == ["Wetness", 3.0]
    assert known["skin"] == ["CrossPatch"] * 25


def test_an_electrode_is_meshed_and_drawn(known):
    assert known["area"] == pytest.approx(0.75 * 0.01**2)
    assert known["drawn"] == [25, 0, 25]  # outlines of the report, no marks, outlines of the live page
    assert known["shown"] == 1 + 25  # the rim of the sheet, and each electrode


def test_a_recording_is_imported(known):
    assert (known["imported"], known["force"]) == (0, [1, 2, 3, 5])
