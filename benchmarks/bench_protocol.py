"""Accuracy and frame rate against the number of readings in a frame.

Single presses of 8 N by a 20 mm tip at places all over the testbed, which has an even coating, simulated on another
mesh than the one they are found on; the noise of a reading is 60 dB below the rms of the readings. Each way to choose
readings is asked for more and more of the 550 readings of a scan; the others are NaN, which image and fit leave out
exactly, so that one reconstructor and one finder serve for all. "Around the pad" and "around the place" choose among
readings for a known pad, and for a place known to 10 mm, as an event-driven scan does. A frame's time is that of its
readings; "with switching" each change of the driven pair takes ten readings more, and "D-optimal, cost per drive"
chooses with that cost in mind. "Lost": frames in which the fit finds no contact.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxeit as je

from .figures import curves, logarithmic, panels
from .harness import Question, Run
from .problems import pressed
from .rows import Row, averaged

COUNTS = (10, 20, 40, 80, 160, 275, 550)
INDEPENDENT = 160  # the most that volume is asked for: more readings span no more, but for rounding
SWITCH = 10.0  # readings that a change of drive takes, in the second column
LOAD = 8.0  # N
MARGIN, PRESSES, DRAWS = 0.015, 60, 3
KNOWN = 0.01  # m, how well an event-driven scan knows the place before
WAYS = {
    "D-optimal": "C0",
    "D-optimal, cost per drive": "C1",
    "most sensitive": "C2",
    "largest volume": "C3",
    "around the pad": "C4",
    "around the place": "C5",
    "at random": "#8a8a8a",
}
ESTIMATOR = je.LevelCentroid(0.5)

Orders = list[np.ndarray]  # of each press: rows of the pattern, the best first


class Bench:
    """Presses, what finds them, and ways to choose readings, on the model's mesh.

    | meaning                            | shape               | unit |
    |------------------------------------|---------------------|------|
    | sites                              | (presses, 2)        | m    |
    | frames, less untouched, with noise | (presses, readings) | V    |
    | masks: weights of pixels by pad    | (pads, pixels)      |      |
    """

    def __init__(self, smoke: bool) -> None:
        self.skin = je.load_skin("testbed")
        rng, presses = np.random.default_rng(0), 4 if smoke else PRESSES
        low, high = self.skin.domain.bounds
        self.sites = rng.uniform(np.add(low, MARGIN), np.subtract(high, MARGIN), (presses, 2))
        found = pressed((), self.sites[:, None], np.full((presses, 1), LOAD), 0.06 if smoke else 0.026)
        self.frames = found.change + found.noise * rng.normal(size=found.change.shape)
        self.model = je.discretise(je.Scene(self.skin), je.Fidelity.draft())
        std = np.full(self.skin.protocol.readings, found.noise)
        settings = je.contacts.ContactSettings(most=2, columns=21 if smoke else 41)
        self.fit = je.prepare_contacts(self.model, settings, noise=std)
        self.image = je.prepare(self.model, noise=std)
        self.basis = je.Pixels(20).on(self.model)
        self.masks = je.pad_masks(self.skin, self.basis).weights

    def pads_at(self, places: np.ndarray) -> np.ndarray:
        """The pad of the pixel that is nearest to each place."""
        pixel = np.linalg.norm(np.asarray(self.basis.centres) - places[:, None], axis=-1).argmin(1)
        return np.asarray(self.masks)[:, pixel].argmax(0)

    def order(
        self, region: Any = None, selection: Any = None, most: int | None = None, switch: float = 0.0
    ) -> np.ndarray:
        """Readings, the best first, by the covariance that contacts anywhere, or in a region, give them."""
        signal = je.scan.signal_covariance(self.model, basis=self.basis, region=region)
        pattern = self.skin.protocol.pattern
        return np.asarray(
            je.scan.choose_readings(signal, most or len(signal), selection, pattern=pattern, switch=switch).rows
        )

    def ways(self) -> dict[str, Orders]:
        """Ways to choose readings, by name."""
        near = self.sites + KNOWN / np.sqrt(2) * np.random.default_rng(1).normal(size=self.sites.shape)
        by_pad = [self.order(mask) for mask in self.masks]
        for_all = {
            "D-optimal": self.order(),
            "D-optimal, cost per drive": self.order(switch=SWITCH),
            "most sensitive": self.order(selection=je.scan.Sensitive()),
            "largest volume": self.order(selection=je.scan.Volume(), most=INDEPENDENT),
        }
        return {name: [order] * len(near) for name, order in for_all.items()} | {
            "around the pad": [by_pad[pad] for pad in self.pads_at(near)],
            "around the place": [self.order(je.scan.around(self.basis.picture, place, 0.03)) for place in near],
        }

    def at_random(self, seed: int) -> Orders:
        return [np.random.default_rng(seed).permutation(self.skin.protocol.readings)] * len(self.sites)

    def row(self, name: str, count: int, orders: Orders) -> Row:
        rows = [np.sort(order[:count]) for order in orders]
        readings = self.skin.protocol.readings
        frames = jnp.stack(
            [je.scan.in_frame(frame[kept], kept, readings) for frame, kept in zip(self.frames, rows, strict=True)]
        )
        fitted = np.asarray(je.localisation_error(je.contacts.strongest(self.fit(frames)), self.sites))
        pictured = np.asarray(je.localisation_error(ESTIMATOR(self.image(frames), self.image), self.sites))
        out: Row = {"way": name, "readings": count, "fit_mm": _mm(fitted), "lost": float(np.mean(np.isnan(fitted)))}
        return out | {"image_mm": _mm(pictured), **self.rates(rows)}

    def rates(self, rows: Sequence[Any]) -> dict[str, float]:
        """Frames per second of scans that take these readings each, without and with the time to switch."""
        taken = [je.scan.shortened(self.skin.protocol, some) for some in rows]
        rates = [1 / np.mean([je.scan.scan_time(one, switch) for one in taken]) for switch in (0.0, SWITCH)]
        return {"frames_per_s": float(rates[0]), "frames_per_s_with_switching": float(rates[1])}


def _mm(errors: np.ndarray) -> float | None:
    return 1e3 * float(np.nanmean(errors)) if np.isfinite(errors).any() else None


def measure(run: Run) -> Iterator[Row]:
    """A row for each way and number of readings, then the event-driven scan."""
    bench = Bench(run.smoke)
    ways = bench.ways()
    yield {"presses": len(bench.sites), "rows": []}
    for count in run.sizes(COUNTS, (40,)):
        rows = [bench.row(name, count, way) for name, way in ways.items() if len(way[0]) >= count]
        drawn = [bench.row("at random", count, bench.at_random(k)) for k in range(1 if run.smoke else DRAWS)]
        yield {"rows": [*rows, averaged(drawn, sd_of="_mm")]}
    yield {"events": events(bench, 24, 80)}


def events(bench: Bench, idle: int, local: int) -> Row:
    """Readings and errors by frame: at rest, for the pad that is pressed, then around the contact found."""
    settings = je.scan.EventScanSettings(onset=500.0, idle=idle, local=local)
    scan = je.scan.prepare_event_scan(bench.model, bench.skin, settings)
    step = eqx.filter_jit(lambda state, pressure, places: scan.step(state, pressure, places))
    masks: dict[str, list] = {"rest": [], "first": [], "next": []}
    errors: dict[str, list[float]] = {"first": [], "next": []}
    for site, seen, pad in zip(bench.sites, bench.frames, bench.pads_at(bench.sites), strict=True):
        pressure, places = np.zeros(len(bench.skin.pads)), jnp.full((bench.fit.most, 2), jnp.nan)
        state, _ = step(scan.start(), pressure, places)  # the whole scan
        state, mask = step(state, pressure, places)
        masks["rest"].append(mask)
        pressure[pad] = 5e3
        for name, apart in errors.items():
            state, mask = step(state, pressure, places)
            contacts = bench.fit(jnp.where(mask, seen, jnp.nan))
            places = jnp.where(contacts.present[:, None], contacts.position, jnp.nan)
            masks[name].append(mask)
            apart.append(float(je.localisation_error(je.contacts.strongest(contacts), site)))
    out: Row = {"idle": idle, "local": local}
    for name, mine in masks.items():
        out[name] = {"readings": float(np.mean([int(m.sum()) for m in mine]))} | bench.rates(mine)
    for name, apart in errors.items():
        out[name] |= {"fit_mm": _mm(np.array(apart)), "lost": float(np.isnan(apart).mean())}
    return out


PANELS = (
    ("readings", "fit_mm", "readings of a frame", "contacts fitted"),
    ("readings", "image_mm", "readings of a frame", "image, centroid of the half maximum"),
    ("frames_per_s_with_switching", "fit_mm", "frames per second, switching paid", "contacts fitted"),
)


def picture(data: Row) -> Figure:
    """Error against readings, by the fit and by the image, and against frames per second."""
    figure, axes = panels(12, 4.3, 1, 3)
    for panel, (x, y, label, title) in zip(axes, PANELS, strict=True):
        rows = sorted(data["rows"], key=lambda row: (list(WAYS).index(row["way"]), row[x]))
        curves(panel, rows, x, y, ("way",), _look)
        logarithmic(panel, title, xlabel=label, ylabel="mean error of place, mm")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8.5)
    return figure


def _look(way: str) -> Row:
    return {"linestyle": ":" if way == "at random" else "-", "color": WAYS[way], "label": way}


main = Question("protocol_cost", __doc__, {"rows": measure}, picture=picture, file="measurement-cost.png")

if __name__ == "__main__":
    main()
