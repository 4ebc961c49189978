"""What fewer readings a frame cost in accuracy, and bring in frames per second.

python -m benchmarks.bench_protocol [--smoke | --draw-only]

Single presses of 8 N, by a 20 mm tip at places all over the testbed, its coat even, simulated on another mesh than they
are found on; noise of a reading 60 dB below the readings' rms.  Each way to choose readings is asked for more and more
of the 550 of a scan; the others are NaN, which image and fit leave out exactly, so one reconstructor and one finder
serve all.  "Around the pad" and "around the place" choose among readings for a known pad, and for a place known to
10 mm, as an event-driven scan does.  A frame's time is that of its readings; "with switching" each change of the driven
pair takes ten readings more, and "D-optimal, drives dear" chooses with that cost in mind.  "Lost": frames in which the
fit finds no contact.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import jaxeit as je
from calib.figures import plain_numbers, write_figure

from . import _common as c

PICTURE = c.ROOT / "docs" / "measurement-cost.png"
COUNTS = (10, 20, 40, 80, 160, 275, 550)
INDEPENDENT = 160  # the most that volume is asked for: more readings span no more, but for rounding
SWITCH = 10.0  # readings that a change of drive takes, in the second column
LOAD, TIP = 8.0, 0.02  # N, m
MARGIN, PRESSES, DRAWS = 0.015, 60, 3
KNOWN = 0.01  # m, how well an event-driven scan knows the place before
WAYS = {
    "D-optimal": "C0",
    "D-optimal, drives dear": "C1",
    "most sensitive": "C2",
    "largest volume": "C3",
    "around the pad": "C4",
    "around the place": "C5",
    "at random": "#8a8a8a",
}
ESTIMATOR = je.LevelCentroid(0.5)

Row = dict[str, Any]
Choose = Callable[[int, int], np.ndarray]  # from count and press to rows of the pattern


@dataclass(frozen=True, eq=False)
class Presses:
    """What is to be found.

    | meaning                            | shape               | unit |
    |------------------------------------|---------------------|------|
    | sites                              | (presses, 2)        | m    |
    | frames, less untouched, with noise | (presses, readings) | V    |
    | noise of a reading                 | ()                  | V    |
    """

    sites: np.ndarray
    frames: np.ndarray
    noise: float


def simulated(skin: je.Skin, presses: int, edge_length: float) -> Presses:
    effects = (je.LoadSpreading(0.012), je.ContactPiezoresistance(1.0, 20e3, 1.0))
    model = je.discretise(je.Scene(skin, effects), je.Fidelity.standard(edge_length=edge_length))
    rng = np.random.default_rng(0)
    (x0, y0), (x1, y1) = skin.domain.bounds
    sites = rng.uniform([x0 + MARGIN, y0 + MARGIN], [x1 - MARGIN, y1 - MARGIN], (presses, 2))

    def frame(place):
        return je.forward(model, je.conductivity(model, LOAD * je.load_spread(model, place, TIP)))

    jit: Any = eqx.filter_jit
    touched = jit(lambda sites: jax.lax.map(frame, sites), compiler_options=je.compiler_options())(jnp.asarray(sites))
    v0 = np.asarray(je.forward(model))
    noise = 1e-3 * float(np.sqrt(np.mean(v0**2)))
    return Presses(sites, np.asarray(touched) - v0 + noise * rng.normal(size=touched.shape), noise)


class Ways:
    """Ways to choose readings, by name."""

    def __init__(self, skin: je.Skin, model: je.Model, sites: np.ndarray) -> None:
        self.pattern, self.sites, image = skin.protocol.pattern, sites, je.Pixels(20).on(model)
        signal = je.signal_covariance(model, basis=image)
        near = sites + KNOWN / np.sqrt(2) * np.random.default_rng(1).normal(size=sites.shape)
        masks = je.pad_masks(skin, image).weights
        pixel = np.linalg.norm(np.asarray(image.centres) - near[:, None], axis=-1).argmin(1)
        by_pad = self._orders(je.signal_covariance(model, basis=image, region=masks))
        pad = np.asarray(masks)[:, pixel].argmax(0)
        by_place = [self._around(model, image, place) for place in near]
        orders = {
            "D-optimal": self._order(signal),
            "D-optimal, drives dear": self._order(signal, None, SWITCH),
            "most sensitive": self._order(signal, je.Sensitive()),
        }
        self.choose: dict[str, Choose] = {
            name: (lambda count, _, order=order: order[:count]) for name, order in orders.items()
        }
        volume = np.asarray(je.choose_readings(signal, INDEPENDENT, je.Volume()).rows)
        self.choose["largest volume"] = lambda count, _: volume[:count]
        self.choose["around the pad"] = lambda count, press: by_pad[pad[press]][:count]
        self.choose["around the place"] = lambda count, press: by_place[press][:count]

    def _order(self, signal: jax.Array, selection: Any = None, switch: float = 0.0) -> np.ndarray:
        chosen = je.choose_readings(signal, len(signal), selection, pattern=self.pattern, switch=switch)
        return np.asarray(chosen.rows)

    def _orders(self, signals: jax.Array) -> list[np.ndarray]:
        return [self._order(signal) for signal in signals]

    def _around(self, model: je.Model, image: je.BasisMap, place: np.ndarray) -> np.ndarray:
        return self._order(je.signal_covariance(model, basis=image, region=je.around(image.picture, place, 0.03)))

    def at_random(self, seed: int) -> Choose:
        order = np.random.default_rng(seed).permutation(len(self.pattern))
        return lambda count, _: order[:count]


@dataclass(frozen=True, eq=False)
class Finders:
    """What finds contacts: a fit and an image, on the model's mesh."""

    skin: je.Skin
    fit: je.ContactFinder
    image: je.Reconstructor

    def row(self, name: str, count: int, choose: Choose, presses: Presses) -> Row:
        rows = [np.sort(choose(count, k)) for k in range(len(presses.sites))]
        frames = np.full(presses.frames.shape, np.nan)
        for frame, seen, kept in zip(frames, presses.frames, rows, strict=True):
            frame[kept] = seen[kept]
        fitted = np.asarray(je.localisation_error(je.strongest(self.fit(frames)), presses.sites))
        pictured = np.asarray(je.localisation_error(ESTIMATOR(self.image(frames), self.image), presses.sites))
        taken = [je.shortened(self.skin.protocol, some) for some in rows]
        seconds = [np.mean([je.scan_time(one, switch) for one in taken]) for switch in (0.0, SWITCH)]
        return {
            "way": name,
            "readings": count,
            "fit_mm": _mm(fitted, np.nanmean),
            "fit_p95_mm": _mm(fitted, lambda e: np.nanquantile(e, 0.95)),
            "lost": float(np.mean(np.isnan(fitted))),
            "image_mm": _mm(pictured, np.nanmean),
            "frames_per_s": float(1 / seconds[0]),
            "frames_per_s_with_switching": float(1 / seconds[1]),
        }


def _mm(errors: np.ndarray, of: Callable) -> float | None:
    return 1e3 * float(of(errors)) if np.isfinite(errors).any() else None


def measured(finders: Finders, ways: Ways, presses: Presses, counts: Sequence[int], draws: int) -> Iterator[Row]:
    for count in counts:
        for name, choose in ways.choose.items():
            if len(choose(count, 0)) == count:
                yield finders.row(name, count, choose, presses)
        several = [finders.row("at random", count, ways.at_random(k), presses) for k in range(draws)]
        yield _mean(several)


def _mean(rows: Sequence[Row]) -> Row:
    """The mean over draws, and the standard deviation of the errors."""
    out: Row = {}
    for name, first in rows[0].items():
        values = [row[name] for row in rows if row[name] is not None]
        number = isinstance(first, float) or first is None
        out[name] = (float(np.mean(values)) if values else None) if number else first
        if name.endswith("_mm") and len(values) > 1:
            out[f"{name}_sd"] = float(np.std(values, ddof=1))
    return out


# --- the event-driven scan


def events(skin: je.Skin, model: je.Model, finder: je.ContactFinder, presses: Presses, idle: int, local: int) -> Row:
    """Each press felt by its pad, then followed: a frame at rest, one for the pad, the next around what that found."""
    scan = je.prepare_event_scan(model, skin, onset=500.0, idle=idle, local=local, every=50)
    pads = len(skin.pads)
    image = je.Pixels(20).on(model)
    nearest = np.linalg.norm(np.asarray(image.centres) - presses.sites[:, None], axis=-1).argmin(1)
    pad = np.asarray(je.pad_masks(skin, image).weights)[:, nearest].argmax(0)
    step = eqx.filter_jit(lambda state, pressure, places: scan.step(state, pressure, places))
    found: dict[str, list] = {"rest": [], "first": [], "next": []}
    errors: dict[str, list[float]] = {"first": [], "next": []}
    for site, seen, pressed in zip(presses.sites, presses.frames, pad, strict=True):
        pressure, nowhere = np.zeros(pads), np.full((finder.most, 2), np.nan)
        state, _ = step(scan.start(), pressure, nowhere)  # the whole scan
        state, mask = step(state, pressure, nowhere)
        found["rest"].append(mask)
        pressure[pressed], places = 5e3, nowhere
        for name in ("first", "next"):
            state, mask = step(state, pressure, places)
            contacts = finder(jnp.where(mask, seen, jnp.nan))
            places = jnp.where(contacts.present[:, None], contacts.position, jnp.nan)
            found[name].append(mask)
            errors[name].append(float(je.localisation_error(je.strongest(contacts), site)))
    out: Row = {"idle": idle, "local": local}
    for name, masks in found.items():
        times = [[je.scan_time(je.shortened(skin.protocol, m), s) for m in masks] for s in (0.0, SWITCH)]
        out[name] = {"readings": float(np.mean([int(m.sum()) for m in masks]))}
        out[name] |= {"frames_per_s": float(1 / np.mean(times[0]))}
        out[name] |= {"frames_per_s_with_switching": float(1 / np.mean(times[1]))}
        if name in errors:
            apart = np.array(errors[name])
            out[name] |= {"fit_mm": _mm(apart, np.nanmean), "lost": float(np.isnan(apart).mean())}
    return out


# --- what is said of it


def table(rows: Sequence[Row]) -> str:
    lines = [
        "| readings | chosen | fit, mm | p95 | lost | image, mm | frames/s | and with switching |",
        "|---" * 8 + "|",
    ]
    lines += [
        f"| {r['readings']} | {r['way']} | {_cell(r, 'fit_mm')} | {_cell(r, 'fit_p95_mm')} | {100 * r['lost']:.0f} % "
        f"| {_cell(r, 'image_mm')} | {r['frames_per_s']:,.0f} | {r['frames_per_s_with_switching']:,.0f} |"
        for r in rows
    ]
    return "\n".join(lines)


def _cell(r: Row, name: str) -> str:
    if r[name] is None:
        return ""
    return f"{r[name]:.2f}" + (f" ± {r[f'{name}_sd']:.2f}" if f"{name}_sd" in r else "")


def event_table(row: Row) -> str:
    lines = ["| event-driven scan | readings | fit, mm | lost | frames/s | and with switching |", "|---" * 6 + "|"]
    labels = {"rest": "at rest", "first": "first frame of a contact", "next": "the frames after"}
    for name, label in labels.items():
        r = row[name]
        apart = "" if r.get("fit_mm") is None else f"{r['fit_mm']:.2f}"
        lost = f"{100 * r['lost']:.0f} %" if "lost" in r else ""
        rates = f"{r['frames_per_s']:,.0f} | {r['frames_per_s_with_switching']:,.0f}"
        lines.append(f"| {label} | {r['readings']:.0f} | {apart} | {lost} | {rates} |")
    return "\n".join(lines)


def picture(rows: Sequence[Row]) -> Figure:
    """Error against readings, by the fit and by the image, and against frames per second."""
    figure = Figure(figsize=(12, 4.3), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    panels = (
        ("readings", "fit_mm", "readings of a frame", "contacts fitted"),
        ("readings", "image_mm", "readings of a frame", "image, centroid of the half maximum"),
        ("frames_per_s_with_switching", "fit_mm", "frames per second, switching paid", "contacts fitted"),
    )
    for axes, (x, y, label, title) in zip(figure.subplots(1, 3), panels, strict=True):
        for way, colour in WAYS.items():
            mine = sorted((r for r in rows if r["way"] == way and r[y] is not None), key=lambda r: r[x])
            line = ":" if way == "at random" else "-"
            axes.plot([r[x] for r in mine], [r[y] for r in mine], line, marker="o", color=colour, label=way)
        axes.set(xscale="log", yscale="log", xlabel=label, ylabel="mean error of place, mm")
        axes.set_title(title, fontsize=10)
        axes.grid(True, which="both", color="#e4e4e4", linewidth=0.7)
        plain_numbers(axes)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8.5)
    return figure


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="few presses and readings, nothing written")
    parser.add_argument("--draw-only", action="store_true", help="draw the stored results again")
    args = parser.parse_args(argv)
    c.set_up()
    if args.draw_only:
        write_figure(picture(c.stored("protocol_cost")["rows"]), PICTURE)
        return {}
    skin = je.load_skin("testbed")
    model = je.discretise(je.Scene(skin), je.Fidelity.draft())
    presses = simulated(skin, 4 if args.smoke else PRESSES, 0.06 if args.smoke else 0.026)
    noise, columns = np.full(skin.protocol.readings, presses.noise), 21 if args.smoke else 41
    fit = je.prepare_contacts(model, noise=noise, most=2, columns=columns)
    finders = Finders(skin, fit, je.prepare(model, noise=noise))
    ways = Ways(skin, model, presses.sites)
    data: dict[str, Any] = {"circumstances": c.circumstances(), "presses": len(presses.sites)}
    counts, draws = ((40,), 1) if args.smoke else (COUNTS, DRAWS)
    data["rows"] = list(measured(finders, ways, presses, counts, draws))
    data["events"] = events(skin, model, finders.fit, presses, 24, 80)
    print(table(data["rows"]), event_table(data["events"]), sep="\n\n", flush=True)
    if not args.smoke:
        c.write("protocol_cost", c.closed(data))
        write_figure(picture(data["rows"]), PICTURE)
    return data


if __name__ == "__main__":
    main(sys.argv[1:])
