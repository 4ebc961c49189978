"""The picture of docs/tanks.md: the two frames of one file of PyEIDORS in EIDORS, in pyEIT and in jaxeit.

The programs are those of the page, run as they stand.

python -m benchmarks.tank_pictures TABLE.csv     # needs Octave with EIDORS, and pyEIT
"""

import os
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.io import loadmat

import calib
import jaxeit as je
from calib.report.figures.parts import write_figure
from calib.runtime import set_up

from .figures import panels
from .harness import ROOT
from .peers import eidors, pyeit

PAGE, PICTURE = ROOT / "docs" / "tanks.md", ROOT / "docs" / "tank-programs.png"
TABLE = "tank_55uA_1000Hz.csv"
RADIUS = 0.03  # m, that of the tank; discs of the other programs have 1
LIMIT = 1.0  # change at which the colours end
SAVED = "picture.mat"
SHOWN = (1, 5, 9, 13)  # electrodes with a number
END = f"""
fmdl = imdl.fwd_model; at = [fmdl.electrode.nodes]; change = change.elem_data;
nodes = fmdl.nodes; elems = fmdl.elems; save('-v7', '{SAVED}', 'nodes', 'elems', 'at', 'change')
"""


class Image(NamedTuple):
    """A change for each triangle of a disc of radius 1, with the nodes of the electrodes."""

    nodes: np.ndarray
    triangles: np.ndarray
    electrodes: np.ndarray
    change: np.ndarray


def program(language: str, title: str = "") -> str:
    """The first program of the page in a language, or with a name."""
    head = f'{language} title="{title}"' if title else language
    found = re.search(rf"^```{head}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    if found is None:
        raise SystemExit(f"{PAGE} has no block {head}")
    return found[1]


def by_eidors(folder: Path) -> Image:
    done = eidors.run_program(folder, program("matlab") + END)
    if not (folder / SAVED).exists():
        raise SystemExit(f"Octave ended without an image: {done.stderr[-500:]}")
    saved = loadmat(folder / SAVED)
    elems, at = (saved[name].astype(int) - 1 for name in ("elems", "at"))
    return Image(saved["nodes"], elems, at.ravel(), saved["change"].ravel())


def by_pyeit() -> Image:
    names: dict[str, Any] = {}
    exec(compile(program("python", "tank_with_pyeit.py"), PAGE.name, "exec"), names)
    mesh = names["mesh_obj"]
    return Image(mesh.node[:, :2], mesh.element, mesh.el_pos, np.real(names["change"]))


def by_jaxeit() -> Image:
    """The image of the page's program for the triangles of its own mesh, whose electrodes have a width."""
    tank = calib.tanks.load_tank(TABLE, je.Disc(RADIUS))
    found = calib.tanks.difference_image(tank, basis=je.Elements())
    model = tank.model(je.Fidelity.draft())
    places = jnp.asarray(tank.skin.electrode_positions)[:, None]
    nearest = jnp.argmin(jnp.linalg.norm(model.nodes - places, axis=-1), axis=1)
    return Image(*map(np.asarray, (model.nodes / RADIUS, model.triangles, nearest, found.change)))


def draw(axes: Any, name: str, image: Image) -> Any:
    """Turned and mirrored so that electrode 1 is at the right and the others follow counter-clockwise."""
    first, second = image.nodes[image.electrodes[:2]]
    turned = np.stack([image.nodes @ first, image.nodes @ (second - (second @ first) * first)], 1)
    turned /= np.linalg.norm(turned[image.electrodes[0]]), abs(turned[image.electrodes, 1]).max()
    colours = axes.tripcolor(*turned.T, image.triangles, image.change, cmap="RdBu_r", vmin=-LIMIT, vmax=LIMIT)
    for number in SHOWN:
        axes.text(*(1.13 * turned[image.electrodes[number - 1]]), str(number), ha="center", va="center", fontsize=9)
    axes.set(aspect="equal", title=name, xlim=(-1.25, 1.25), ylim=(-1.25, 1.25))
    axes.axis("off")
    return colours


def picture(images: dict[str, Image]) -> Figure:
    figure, axes = panels(8, 2.9, 1, len(images))
    drawn = [draw(place, *named) for place, named in zip(axes, images.items(), strict=True)]
    figure.colorbar(drawn[-1], ax=axes, label="change over the reference", shrink=0.8, extend="both")
    return figure


def main() -> None:
    why = eidors.missing() or pyeit.missing()
    if len(sys.argv) != 2 or why:
        raise SystemExit(why or "give a table of PyEIDORS with 16 electrodes")
    set_up()
    with tempfile.TemporaryDirectory() as name:
        shutil.copy(sys.argv[1], Path(name, TABLE))
        os.chdir(name)
        images = {"EIDORS": by_eidors(Path(name)), "pyEIT": by_pyeit(), "jaxeit": by_jaxeit()}
        write_figure(picture(images), PICTURE)
        os.chdir(ROOT)


if __name__ == "__main__":
    main()
