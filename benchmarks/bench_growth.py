"""How time and memory grow: with nodes, electrodes, readings, pixels, frames of a batch, and pads.

python -m benchmarks.bench_growth [--smoke]

One size varies at a time, on the square of the other benchmarks.  The exponents are the slopes of a line through the
logarithms, over all sizes and from the last but one to the last; beside them what the theory expects for large sizes.
Memory is what XLA states for the compiled program: arguments, results and temporaries.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from jaxeit.solvers import NestedDissection

from . import _common as c

PIXELS, BASE_CELLS, BASE_GRID = 30, 60, 5
REPEATS, BUDGET = 15, 1.0  # calls of each that are timed, and s for a slow one

Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Series:
    """One size that varies.

    ``make(size)`` gives a function, its arguments (pytrees), and how many of ``of`` there are.
    """

    name: str
    of: str
    sizes: tuple[int, ...]
    time: str
    memory: str
    make: Callable[[int], tuple[Callable, tuple, int]] = field(repr=False)


def skin(grid: int = BASE_GRID, readings: int | None = None, pads: tuple[je.Pad, ...] = ()) -> je.Skin:
    """The square with grid x grid point electrodes, adjacent drives and senses along a snake."""
    line = (np.arange(grid) + 0.5) * c.SIDE / grid
    points = np.stack(np.meshgrid(line, line), -1)
    points[1::2] = points[1::2, ::-1]
    electrodes = tuple(je.PointElectrode(tuple(point)) for point in points.reshape(-1, 2).tolist())
    protocol = je.Protocol(je.adjacent(grid**2)[:readings], 1.0)
    return je.Skin("growth", je.Rectangle(c.SIDE, c.SIDE), 1.0, electrodes, protocol, pads)


def model(cells: int = BASE_CELLS, grid: int = BASE_GRID, readings: int | None = None) -> je.Model:
    """On a regular mesh that has the electrodes among its nodes."""
    scene, square = je.Scene(skin(grid, readings)), je.Rectangle(c.SIDE, c.SIDE)
    return je.discretise(scene, je.Fidelity(solver=NestedDissection()), mesh=je.structured(square, cells, cells))


def forward_by_nodes(cells: int):
    found = model(cells)
    return je.forward, (found, found.background), len(found.nodes)


def jacobian_by_nodes(cells: int):
    found = model(cells)
    return je.jacobian, (found, found.background, je.Pixels(PIXELS).on(found)), len(found.nodes)


def forward_by_electrodes(grid: int):
    found = model(grid=grid)
    return je.forward, (found, found.background), grid**2


def jacobian_by_electrodes(grid: int):
    found = model(grid=grid)
    return je.jacobian, (found, found.background, je.Pixels(PIXELS).on(found)), grid**2


def reconstructor(pixels: int = PIXELS, readings: int | None = None) -> je.Reconstructor:
    return je.prepare(model(readings=readings), basis=je.Pixels(pixels))


def _frames(recon: je.Reconstructor, *count: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(0).normal(size=(*count, recon.readings)))


def _apply(recon, frames):
    return recon(frames)


def image_by_readings(readings: int):
    recon = reconstructor(readings=readings)
    return _apply, (recon, _frames(recon, 64)), readings


def image_by_pixels(pixels: int):
    recon = reconstructor(pixels)
    return _apply, (recon, _frames(recon, 64)), pixels**2


def image_by_batch(recon: je.Reconstructor, count: int):
    return _apply, (recon, _frames(recon, count)), count


def forward_by_batch(found: je.Model, count: int):
    sigma = found.background * (1 + 0.1 * jnp.arange(count)[:, None] / count)
    return lambda model, s: jax.lax.map(lambda one: je.forward(model, one), s, batch_size=8), (found, sigma), count


def fuse_by_pads(recon: je.Reconstructor, side: int):
    """side x side equal pads."""
    ends = c.SIDE / side
    corners = [(i * ends, j * ends) for j in range(side) for i in range(side)]
    square = np.array([[0, 0], [ends, 0], [ends, ends], [0, ends]])
    pads = tuple(je.Pad(str(k), np.asarray(low) + square) for k, low in enumerate(corners))
    image = jnp.asarray(np.random.default_rng(0).uniform(size=(64, recon.size)))
    return je.fuse, (image, je.pad_masks(skin(pads=pads), recon), jnp.ones((64, side**2))), side**2


def series() -> tuple[Series, ...]:
    """Those that share a reconstructor or a model make it once."""
    recon, draft = reconstructor(), model(30)
    batch, pads = partial(image_by_batch, recon), partial(fuse_by_pads, recon)
    factor, cells = "1 to 1.5: fronts, then their factorisation", (30, 60, 120, 240)
    return (
        Series("forward", "nodes", cells, factor, "1, and a logarithm", forward_by_nodes),
        Series("Jacobian", "nodes", cells, factor, "1, and a logarithm", jacobian_by_nodes),
        Series("forward", "electrodes", (3, 5, 6, 10), "0 to 1: substitution", "0 to 1", forward_by_electrodes),
        Series("Jacobian", "electrodes", (3, 5, 6, 10), "2: pairs of fields", "2: readings", jacobian_by_electrodes),
        Series("64 images", "readings", (100, 200, 400, 550), "0 to 1: pair sums", "1", image_by_readings),
        Series("64 images", "pixels", (10, 20, 40, 80), "1", "1", image_by_pixels),
        Series("images", "frames", (1, 16, 256, 4096), "1", "1", batch),
        Series("forward", "batch", (1, 8, 64), "1", "1", partial(forward_by_batch, draft)),
        Series("64 force maps", "pads", (2, 4, 8, 16), "1", "1", pads),
    )


def measured(one: Series, sizes: Sequence[int], repeats: int) -> list[Row]:
    """Compiled one by one, then timed in turn."""
    made = {size: one.make(size) for size in sizes}
    programs = {size: compiled(function, arguments) for size, (function, arguments, _) in made.items()}
    times: dict[int, list[float]] = {size: [] for size in sizes}
    for run, _, _ in programs.values():
        run()
    for _ in range(repeats):
        for size, (run, _, _) in programs.items():
            if sum(times[size]) < BUDGET:
                times[size].append(c.seconds(run)[0])
    return [
        {
            "series": one.name,
            "of": one.of,
            "size": made[size][2],
            **c.spread(times[size]),
            "compile_s": round(programs[size][1], 2),
            "megabytes": programs[size][2],
        }
        for size in sizes
    ]


def compiled(function: Callable, arguments: tuple) -> tuple[Callable[[], Any], float, float]:
    """A call, the seconds that it took to compile, and the megabytes that it takes."""
    arrays, rest = eqx.partition(arguments, eqx.is_array)
    program = jax.jit(lambda arrays: function(*eqx.combine(arrays, rest)), compiler_options=je.compiler_options())
    spent, done = c.seconds(lambda: program.lower(arrays).compile())
    sizes = done.memory_analysis()
    total = sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    return lambda: jax.block_until_ready(done(arrays)), spent, total / 1e6


def fits(one: Series, rows: Sequence[Row]) -> Row:
    """Exponents over all sizes and at the end, beside the theory's."""
    size = np.log([row["size"] for row in rows])
    out: Row = {"series": one.name, "of": one.of, "sizes": [row["size"] for row in rows]}
    for name, key, theory in (("time", "median_ms", one.time), ("memory", "megabytes", one.memory)):
        value = np.log([row[key] for row in rows])
        overall, last = np.polyfit(size, value, 1)[0], (value[-1] - value[-2]) / (size[-1] - size[-2])
        out[name] = {"exponent": round(float(overall), 2), "at_the_end": round(float(last), 2), "theory": theory}
    return out


def table(rows: Sequence[Row], found: Sequence[Row]) -> str:
    lines = ["| | sizes | ms | MB | exponent of time (at the end), theory | of memory |", "|---" * 6 + "|"]
    for fit in found:
        mine = [r for r in rows if (r["series"], r["of"]) == (fit["series"], fit["of"])]
        cells = [", ".join(f"{r[key]:,.3g}" for r in mine) for key in ("median_ms", "megabytes")]
        sizes = ", ".join(f"{size:,}" for size in fit["sizes"])
        lines.append(f"| {fit['series']} by {fit['of']} | {sizes} | {' | '.join([*cells, *_exponents(fit)])} |")
    return "\n".join(lines)


def _exponents(fit: Mapping[str, Any]) -> Iterator[str]:
    for name in ("time", "memory"):
        yield f"{fit[name]['exponent']} ({fit[name]['at_the_end']}); {fit[name]['theory']}"


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="two sizes of three series, nothing written")
    args = parser.parse_args(argv)
    c.set_up()
    data: dict[str, Any] = {"circumstances": c.circumstances(), "rows": [], "fits": []}
    every = series()
    for one in (every[0], every[6], every[8]) if args.smoke else every:
        rows = measured(one, one.sizes[:2] if args.smoke else one.sizes, 3 if args.smoke else REPEATS)
        data["rows"] += rows
        data["fits"].append(fits(one, rows))
        print(f"{one.name} by {one.of}: {data['fits'][-1]['time']}", flush=True)
        if not args.smoke:
            c.write("growth", c.closed(data))
    print(table(data["rows"], data["fits"]), flush=True)
    return data


if __name__ == "__main__":
    main(sys.argv[1:])
