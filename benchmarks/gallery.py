"""The pictures of the examples: each example is run, and one small picture is drawn of what it found.

python -m benchmarks.gallery [NAME ...]
"""

import runpy
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.tri import Triangulation

from calib.report.figures.parts import write_figure

from .figures import BLUE, GREY, ORANGE, panels

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "examples"
Names = Mapping[str, Any]
MM = 1e3


def _image(axes: Any, image: Any, recon: Any, **marks: Any) -> None:
    """An image in mm, blue below zero and red above, with crosses at places (m)."""
    values = np.asarray(image).reshape(recon.shape)
    top = np.abs(values).max()
    extent = MM * np.array(recon.extent)
    drawn = axes.imshow(values, origin="lower", extent=extent, cmap="RdBu_r", vmin=-top, vmax=top)
    axes.figure.colorbar(drawn, ax=axes, label="change of conductivity, S")
    for place, colour in zip(marks.values(), ("black", ORANGE), strict=False):
        axes.plot(*(MM * np.asarray(place)), "x", color=colour, markersize=8)
    axes.set(xlabel="x, mm", ylabel="y, mm")


def _sheet(axes: Any, model: Any, sigma: Any, label: str) -> None:
    """The conductivity of each triangle, or its change."""
    mesh = Triangulation(*(MM * np.asarray(model.chart).T), np.asarray(model.triangles))
    drawn = axes.tripcolor(mesh, np.asarray(sigma), cmap="viridis")
    axes.figure.colorbar(drawn, ax=axes, label=label)
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")


def _bars(axes: Any, values: Mapping[str, float], label: str) -> None:
    """A bar for each name, its name inside."""
    axes.barh(range(len(values)), [float(v) for v in values.values()], color=BLUE, alpha=0.35)
    for row, name in enumerate(values):
        axes.text(0, row, f" {name}", va="center", fontsize=8)
    axes.set(xlabel=label, yticks=[])
    axes.invert_yaxis()


def _line(axes: Any, x: Any, y: Any, xlabel: str, ylabel: str, look: str = "-") -> None:
    axes.plot(np.asarray(x), np.asarray(y), look, color=BLUE)
    axes.set(xlabel=xlabel, ylabel=ylabel)


def where_is_the_contact(axes: Any, names: Names) -> None:
    _sheet(axes, names["model"], MM * names["touched"], "conductivity, mS")
    axes.plot(*(MM * np.asarray(names["found"][:2])), "x", color="red", markersize=9)


def two_fingers(axes: Any, names: Names) -> None:
    for distance, image in zip(names["distances"][::2], names["images"][::2], strict=True):
        axes.plot(np.linspace(2.5, 197.5, 40), image[20] / image[20].max(), label=f"{MM * distance:.0f} mm")
    axes.set(xlabel="x, mm", ylabel="image through both")
    axes.legend(fontsize=7)


def one_two_or_an_edge(axes: Any, names: Names) -> None:
    """Probabilities of each kind, a group of bars for each touch."""
    for row, stated in enumerate(names["probabilities"].values()):
        left = 0.0
        for (kind, share), colour in zip(stated.items(), ("white", BLUE, ORANGE, GREY, "lightgrey"), strict=True):
            axes.barh(row, share, left=left, color=colour, label=kind if row == 0 else None)
            left += share
    touches = list(names["probabilities"])
    axes.set(xlabel="probability", yticks=range(len(touches)), yticklabels=touches, xlim=(0, 1))
    axes.invert_yaxis()
    axes.legend(fontsize=6, ncols=5, loc="upper center", bbox_to_anchor=(0.5, 1.18))


def electrodes_that_move(axes: Any, names: Names) -> None:
    skin = names["skin"]
    skin_places, slope = MM * skin.electrode_positions, np.asarray(names["gradient"])
    axes.plot(*skin_places.T, "o", color=GREY, markersize=3)
    axes.quiver(*skin_places.T, *slope.T, color=BLUE, angles="xy")
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal", xlim=(0, 200), ylim=(0, 200))


def mesh_of_my_own(axes: Any, names: Names) -> None:
    axes.triplot(Triangulation(*(MM * names["nodes"].T), names["mesh"].triangles), color=GREY, linewidth=0.4)
    axes.plot(*(MM * np.array(names["places"]).T), "o", color=ORANGE, markersize=4)
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")


def pressure_to_force(axes: Any, names: Names) -> None:
    axes.plot(names["pressure"] / MM, names["measured"], ".", color=GREY, markersize=2)
    _line(axes, names["pressure"] / MM, names["found"].force, "pressure, kPa", "force, N")


def image_and_forces(axes: Any, names: Names) -> None:
    image = np.asarray(names["fmap"].pressure).reshape(names["recon"].shape) / MM
    drawn = axes.imshow(image, origin="lower", extent=MM * np.array(names["recon"].extent), cmap="viridis")
    axes.figure.colorbar(drawn, ax=axes, label="force per area, kPa")
    axes.set(xlabel="x, mm", ylabel="y, mm")


def mujoco_ball_on_chest(axes: Any, names: Names) -> None:
    """The force map of the last step, the way of the ball, and where contacts were found at every fourth step."""
    recon, force = names["calibration"].recon, np.asarray(names["found"].map.force[-1])
    pressure = (force / np.asarray(recon.areas)).reshape(recon.shape) / MM
    axes.imshow(pressure, origin="lower", extent=MM * np.array(recon.extent), cmap="Blues")
    axes.plot(*(MM * names["ball"].T), "-", color=GREY, linewidth=1)
    axes.plot(*(MM * names["found"].position[::4].reshape(-1, 2).T), "x", color=ORANGE, markersize=4)
    axes.set(xlabel="x, mm", ylabel="y, mm")
    axes.set_title("force map; way of the ball, and as found", fontsize=8)


def write_a_session(axes: Any, names: Names) -> None:
    axes.plot(np.arange(1000) / 100, names["pressures"], color=BLUE)
    axes.set(xlabel="time, s", ylabel="pressure, Pa")


def forces_of_a_session(axes: Any, names: Names) -> None:
    found = names["calibration"].evaluation
    axes.plot(*(MM * found.position.T), ".", color=GREY)
    axes.plot(*(MM * found.estimated["fitted"].T), "x", color=ORANGE, markersize=4)
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")


def gradient_of_a_loss(axes: Any, names: Names) -> None:
    found = names["readings"](names["guess"][:2], names["guess"][2])
    _line(axes, MM * names["measured"], MM * found, "measured, mV", "of the found touch, mV", ".")


def one_effect_at_a_time(axes: Any, names: Names) -> None:
    _bars(axes, {name.split(" + ")[-1]: MM * v for name, v in names["largest"].items()}, "largest change, mV")


def many_presses(axes: Any, names: Names) -> None:
    axes.plot(*(MM * np.asarray(names["places"][:150]).T), ".", color=GREY)
    axes.plot(*(MM * np.asarray(names["places"][150:]).T), "x", color=ORANGE)
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")


def sharpness(axes: Any, names: Names) -> None:
    _line(axes, MM * (0.2 - names["places"][:, 0]), MM * names["errors"], "distance to the rim, mm", "error, mm", "o-")


def noise_of_an_image(axes: Any, names: Names) -> None:
    axes.plot(1e6 * names["expected"], 1e6 * names["measured"], ".", color=BLUE, markersize=3)
    axes.set(xlabel="noise expected, uS", ylabel="noise measured, uS")


def train_on_random_scenes(axes: Any, names: Names) -> None:
    """Shares of the force, true, by the network and by the fused image, of two contacts: a good frame and a bad one."""
    maps = [np.asarray(names[n]).reshape(-1, 20, 20) for n in ("truth", "learned", "fused")]
    two = np.flatnonzero(names["unseen"]["contacts"] == 2)
    order = two[np.argsort(np.abs(maps[0] - maps[1])[two].sum((1, 2)))]
    rows = [
        np.hstack([one[frame] / one[frame].max() for one in maps])
        for frame in (order[-len(two) // 4], order[len(two) // 4])
    ]
    axes.imshow(np.vstack(rows), origin="lower", cmap="Blues")
    axes.hlines(19.5, -0.5, 59.5, color=GREY, linewidth=1)
    axes.vlines([19.5, 39.5], -0.5, 39.5, color=GREY, linewidth=1)
    axes.set(xticks=[9.5, 29.5, 49.5], xticklabels=["true", "network", "fused image"], yticks=[])
    axes.tick_params(length=0)
    axes.set_title("where the force is, on a skin not seen before", fontsize=8)


def end_to_end_regressor(axes: Any, names: Names) -> None:
    """The error of the force by presses of ordinary use, without pads."""
    true = names["true"]
    errors = [float(np.median(np.abs(found - true))) for found in names["after"].values()]
    _line(axes, list(names["after"]), 100 * np.array(errors), "presses of the new skin", "error of the force, %")
    axes.set(ylim=(0, None), title="readings alone, median")


DRAWN: Mapping[str, Callable[[Any, Names], None]] = {
    "bending": lambda axes, n: _bars(axes, {k: 100 * v for k, v in n["changes"].items()}, "change of the readings, %"),
    "design_a_scan": lambda axes, n: _bars(axes, n["errors"], "expected error of place, mm"),
    "electrodes_that_move": electrodes_that_move,
    "end_to_end_regressor": end_to_end_regressor,
    "forces_of_a_session": forces_of_a_session,
    "gradient_of_a_loss": gradient_of_a_loss,
    "image_and_forces": image_and_forces,
    "many_presses": many_presses,
    "mesh_of_my_own": mesh_of_my_own,
    "missing_readings": lambda axes, n: _bars(axes, n["changes"], "change of the image"),
    "mujoco_ball_on_chest": mujoco_ball_on_chest,
    "my_own_effect": lambda axes, n: _line(axes, 1e3 * n["dry"], 1e3 * n["wet"], "dry, mV", "wet, mV", "."),
    "my_own_prior": lambda axes, n: _bars(axes, n["far"], "artefact beyond 50 mm, of the peak"),
    "noise_of_an_image": noise_of_an_image,
    "one_effect_at_a_time": one_effect_at_a_time,
    "one_two_or_an_edge": one_two_or_an_edge,
    "pressure_to_force": pressure_to_force,
    "reciprocity": lambda axes, n: _bars(axes, {k: 100 * v for k, v in n["found"].items()}, "largest difference, %"),
    "sharpness": sharpness,
    "strength_of_the_prior": lambda axes, n: _bars(
        axes, {k: 100 * v[0] ** 2 for k, v in n["figures"].items()}, "area of the blob, % of the sheet"
    ),
    "tank": lambda axes, n: _image(axes, n["recon"](n["dv"]), n["recon"], true=n["middle"]),
    "train_on_random_scenes": train_on_random_scenes,
    "two_fingers": two_fingers,
    "uneven_coating": lambda axes, n: _sheet(axes, n["model"], MM * n["coating"], "conductivity, mS"),
    "where_is_the_contact": where_is_the_contact,
    "which_readings": lambda axes, n: _line(
        axes, range(1, 81), n["chosen"].gain, "readings taken", "told by the next, nats"
    ),
    "write_a_session": write_a_session,
}


def main(wanted: list[str]) -> None:
    for name in wanted or DRAWN:
        figure, (axes,) = panels(3.2, 2.4, 1, 1)
        DRAWN[name](axes, runpy.run_path(str(ROOT / "examples" / f"{name}.py")))
        write_figure(figure, FOLDER / f"{name}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
