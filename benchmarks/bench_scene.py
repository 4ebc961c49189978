"""What a scene's effects cost: nothing where they are not listed.

python -m benchmarks.bench_scene [--smoke] [--sessions-only] [--presets NAME ...]

Two tables.  First the program of one frame of a touch on the testbed (load, sheet, electrodes, voltages) and that of a
block of 1,024 frames (histories and readout) as effects are added one by one, in the order of the stages: compile time,
operations of the optimised program, its floating-point operations by XLA's count, time to run.  The last rows have all
effects that go together, and those of each shipped scene.  Second, the shipped scenes simulated to a session file:
seconds of recording per second of work, solves, file size; the first run compiles and is told apart.
"""

import argparse
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib.bench import load_bench, presets, simulate
from calib.runtime import set_up
from jaxeit import effects as fx

from . import _common as c

ROWS = 1024
LEFT_OUT = (je.IndentationSpreading, je.HomogenisedIslands, je.ContinuousCoating)  # others say the same


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="coarse, one scene; writes nothing")
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--programs-only", action="store_true", help="the first table; the second stays as it was")
    only.add_argument("--sessions-only", action="store_true", help="the second table; the first stays as it was")
    parser.add_argument("--presets", nargs="*", default=list(presets()), metavar="NAME")
    args = parser.parse_args(argv)
    set_up()
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are those of a first use
    fidelity = je.Fidelity.draft() if args.smoke else je.Fidelity(edge_length=0.02)
    names = ["ideal"] if args.smoke else args.presets
    before = c.circumstances()
    rows = [] if args.sessions_only else programs(fidelity, smoke=args.smoke)
    print(_table(rows))
    sessions = [] if args.programs_only else [simulated(name, fidelity) for name in names]
    print(_table(sessions))
    new = {name: table for name, table in (("rows", rows), ("sessions", sessions)) if table}
    old = c.stored("scene") if args.programs_only or args.sessions_only else {}
    data = c.closed(old | new | {"edge_length": fidelity.edge_length, "circumstances": before})
    if not args.smoke:
        print(c.write("scene", data))
    return data


def _table(rows: list[dict[str, Any]]) -> str:
    """Markdown, a line per row."""
    if not rows:
        return ""
    lines = ["| " + " | ".join(rows[0]) + " |", "|---" * len(rows[0]) + "|"]
    cells = ([f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows)
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in cells)])


# --- programs ------------------------------------------------------------------------------------


def in_order() -> list[fx.AbstractEffect]:
    """All effects that go together, stage by stage."""
    stages = ("mechanics", "material", "electrical", "pneumatics", "readout")
    kinds = [kind for kind in je.EFFECTS.values() if kind not in LEFT_OUT]
    return [kind() for kind in sorted(kinds, key=lambda kind: stages.index(kind.stage))]


def programs(fidelity: je.Fidelity, *, smoke: bool) -> list[dict[str, Any]]:
    effects = in_order()
    counts = (0, len(effects)) if smoke else range(len(effects) + 1)
    sets = [(f"+ {type(effects[n - 1]).__name__}" if n else "none", tuple(effects[:n])) for n in counts]
    sets[-1] = (f"{sets[-1][0]}: all {len(effects)}", sets[-1][1])
    if not smoke:
        sets += [(f"scene {name}", load_bench(name).scene.effects) for name in presets()]
    skin = je.load_skin("testbed")
    bare = je.discretise(je.Scene(skin), fidelity)
    return [{"effects": name} | _programs(bare, effects) for name, effects in sets]


def _programs(bare: je.Model, effects: tuple[fx.AbstractEffect, ...]) -> dict[str, Any]:
    laid = fx.laid(effects, bare.centroids)  # as a simulation does, once for all frames
    model = eqx.tree_at(lambda m: m.effects, bare, laid, is_leaf=lambda x: x is bare.effects)
    block = jnp.ones((ROWS, 1)) * jnp.asarray(je.forward(bare))
    pads, load = jnp.ones((ROWS, 4)), jnp.ones((ROWS, 1))
    one = _measured("frame", frame, model, jnp.asarray(20.0))
    many = _measured("block", histories, effects, block, pads, load, bare.pattern)
    return one | many


def frame(model: je.Model, load: jax.Array) -> jax.Array:
    """A touch in the middle of a pad."""
    spread = je.load_spread(model, jnp.array([0.06, 0.07]), jnp.asarray(0.02))
    return je.forward(model, je.conductivity(model, load * spread, 1.0))


def histories(effects, block, pads, load, pattern):
    """Loads, pads and readout of one block; effects that a scene does not list are not there."""
    key, still = jax.random.key(0), jnp.zeros(ROWS)
    line = fx.Line(key, jnp.asarray(1 / 180), still, still, pattern[:0])

    def run(family, series, stream=None, line=line):
        mine = fx.chosen(effects, family, stream)
        return fx.history(mine, series, fx.history_start(mine, series[0]), line)[0]

    load = run(fx.AbstractMemoryEffect, load)
    pads = run(fx.AbstractReadoutEffect, run(fx.AbstractPneumaticEffect, pads), fx.Stream.PRESSURE)
    eit = run(fx.AbstractReadoutEffect, block, fx.Stream.EIT, line._replace(pattern=pattern))
    return eit, pads, run(fx.AbstractReadoutEffect, load, fx.Stream.FORCE)


def _measured(name: str, function: Any, *arguments: Any, repeats: int = 7) -> dict[str, Any]:
    leaves, rest = eqx.partition(arguments, eqx.is_array)
    program = jax.jit(lambda leaves: function(*eqx.combine(leaves, rest)), compiler_options=je.compiler_options())
    start = time.perf_counter()
    compiled = program.lower(leaves).compile()
    taken = time.perf_counter() - start
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(leaves))
        times.append(time.perf_counter() - start)
    return {
        f"{name}_ms": 1e3 * float(np.median(times)),
        f"{name}_compile_s": taken,
        f"{name}_operations": compiled.as_text().count(" = "),
        f"{name}_mflop": 1e-6 * (compiled.cost_analysis() or {}).get("flops", 0.0),
    }


# --- sessions ------------------------------------------------------------------------------------


def simulated(name: str, fidelity: je.Fidelity) -> dict[str, Any]:
    """A shipped scene to a file, twice: the first run compiles what the second finds in memory."""
    bench, seconds = load_bench(name), []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(2):
            path = Path(folder) / f"{number}.h5"
            start = time.perf_counter()
            simulate(bench, path, fidelity=fidelity, progress=_plain)
            seconds.append(time.perf_counter() - start)
        size = path.stat().st_size
    return {
        "scene": name,
        "recording_s": bench.duration,
        "frames": int(bench.duration * bench.eit_rate),
        "first_s": seconds[0],
        "second_s": seconds[1],
        "times_real_time": bench.duration / seconds[1],
        "file_mb": size / 1e6,
    }


def _plain(work: Iterable) -> Iterable:
    return work


if __name__ == "__main__":
    main()
