"""How time and memory grow: with nodes, electrodes, readings, pixels, frames of a batch, and pads.

One size varies at a time, on the square of the other benchmarks.  The exponent is the slope of a line through the
logarithms; beside it what the theory expects for large sizes.  Memory is what XLA states for the compiled program:
arguments, results and temporaries.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from jaxeit.linalg import NestedDissection

from .clock import in_turns, program, spread
from .harness import Question, Run
from .problems import SIDE, square
from .rows import Row

PIXELS, BASE_CELLS, BASE_GRID = 30, 60, 5
REPEATS, BUDGET = 15, 1.0  # calls of each that are timed, and s for a slow one

Work = tuple[Callable, tuple, int]  # a function, its arguments, and how many there are of what varies


class Series(NamedTuple):
    """One size that varies: its name, sizes, the exponents of time and memory in theory, and the work at a size."""

    name: str
    of: str
    sizes: tuple[int, ...]
    time: str
    memory: str
    make: Callable[[int], Work]


def skin(grid: int = BASE_GRID, readings: int | None = None, pads: tuple[je.Pad, ...] = ()) -> je.Skin:
    """The square with grid x grid point electrodes, adjacent drives and senses along a snake."""
    line = (np.arange(grid) + 0.5) * SIDE / grid
    points = np.stack(np.meshgrid(line, line), -1)
    points[1::2] = points[1::2, ::-1]
    return square(points.reshape(-1, 2), je.skin.adjacent(grid**2)[:readings], pads)


def model(cells: int = BASE_CELLS, grid: int = BASE_GRID, readings: int | None = None) -> je.Model:
    """On a regular mesh that has the electrodes among its nodes."""
    mesh = je.meshing.structured(je.Rectangle(SIDE, SIDE), cells, cells)
    return je.discretise(je.Scene(skin(grid, readings)), je.Fidelity(solver=NestedDissection()), mesh=mesh)


def solve(function: Callable, of: str, size: int) -> Work:
    """`forward`, or `jacobian` onto pixels, with so many cells a side or electrodes a side of their grid."""
    found = model(**{of: size})
    image = (je.Pixels(PIXELS).on(found),) if function is je.jacobian else ()
    return function, (found, found.background, *image), len(found.nodes) if of == "cells" else size**2


def images(recon: je.Reconstructor, count: int, *shape: int) -> Work:
    frames = jnp.asarray(np.random.default_rng(0).normal(size=(*shape, recon.readings)))
    return lambda recon, frames: recon(frames), (recon, frames), count


def reconstructor(pixels: int = PIXELS, readings: int | None = None) -> je.Reconstructor:
    return je.prepare(model(readings=readings), basis=je.Pixels(pixels))


def forward_by_batch(found: je.Model, count: int) -> Work:
    sigma = found.background * (1 + 0.1 * jnp.arange(float(count))[:, None] / count)
    return lambda model, s: jax.lax.map(lambda one: je.forward(model, one), s, batch_size=8), (found, sigma), count


def fuse_by_pads(recon: je.Reconstructor, side: int) -> Work:
    """side x side equal pads."""
    ends = SIDE / side
    corners = [(i * ends, j * ends) for j in range(side) for i in range(side)]
    outline = np.array([[0, 0], [ends, 0], [ends, ends], [0, ends]])
    pads = tuple(je.Pad(str(k), np.asarray(low) + outline) for k, low in enumerate(corners))
    image = jnp.asarray(np.random.default_rng(0).uniform(size=(64, recon.size)))
    return je.fuse, (image, je.pad_masks(skin(pads=pads), recon), jnp.ones((64, side**2))), side**2


def series() -> tuple[Series, ...]:
    """Those that share a reconstructor or a model make it once."""
    recon, draft = reconstructor(), model(30)
    factor, cells, grids = "1 to 1.5: fronts, then their factorisation", (30, 60, 120, 240), (3, 5, 6, 10)
    forward, jacobian = (partial(solve, function) for function in (je.forward, je.jacobian))
    return (
        Series("forward", "nodes", cells, factor, "1, and a logarithm", partial(forward, "cells")),
        Series("Jacobian", "nodes", cells, factor, "1, and a logarithm", partial(jacobian, "cells")),
        Series("forward", "electrodes", grids, "0 to 1: substitution", "0 to 1", partial(forward, "grid")),
        Series("Jacobian", "electrodes", grids, "2: pairs of fields", "2: readings", partial(jacobian, "grid")),
        Series("64 images", "readings", (100, 200, 400, 550), "0 to 1: pair sums", "1",
               lambda n: images(reconstructor(readings=n), n, 64)),
        Series("64 images", "pixels", (10, 20, 40, 80), "1", "1", lambda n: images(reconstructor(n), n**2, 64)),
        Series("images", "frames", (1, 16, 256, 4096), "1", "1", lambda n: images(recon, n, n)),
        Series("forward", "batch", (1, 8, 64), "1", "1", partial(forward_by_batch, draft)),
        Series("64 force maps", "pads", (2, 4, 8, 16), "1", "1", partial(fuse_by_pads, recon)),
    )  # fmt: skip


def measured(one: Series, sizes: Sequence[int], repeats: int) -> list[Row]:
    """Compiled one by one, then timed in turn."""
    made = {size: one.make(size) for size in sizes}
    programs = {size: program(function, arguments) for size, (function, arguments, _) in made.items()}
    for found in programs.values():
        found.call()
    times = in_turns({size: found.call for size, found in programs.items()}, repeats, BUDGET)
    return [
        {"series": one.name, "of": one.of, "size": made[size][2], **spread(times[size])}
        | {"compile_s": round(programs[size].compile_s, 2), "megabytes": megabytes(programs[size].compiled)}
        for size in sizes
    ]


def megabytes(compiled: Any) -> float:
    sizes = compiled.memory_analysis()
    return (sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes) / 1e6


def fits(one: Series, rows: Sequence[Row]) -> Row:
    """Exponents beside the theory's."""
    sizes, out = [row["size"] for row in rows], {"series": one.name, "of": one.of}
    for name, key, theory in (("time", "median_ms", one.time), ("memory", "megabytes", one.memory)):
        slope = np.polyfit(np.log(sizes), np.log([row[key] for row in rows]), 1)[0]
        out[name] = {"exponent": round(float(slope), 2), "theory": theory}
    return out | {"sizes": sizes}


def measure(run: Run) -> Iterator[Row]:
    every = series()
    for one in (every[0], every[6], every[8]) if run.smoke else every:
        sizes, repeats = (one.sizes[:2], 3) if run.smoke else (one.sizes, REPEATS)
        rows = measured(one, sizes, repeats)
        print(f"{one.name} by {one.of}", flush=True)
        yield {"rows": rows, "fits": [fits(one, rows)]}


main = Question("growth", __doc__, {"rows": measure})

if __name__ == "__main__":
    main()
