"""The cost of a scene's effects; an effect that is not listed costs nothing.

The first table has the program of one frame of a touch on the testbed (load, sheet, electrodes, voltages) and the
program of a block of 1,024 frames (histories and readout), as effects are added one by one in the order of the
stages: compile time, operations of the optimised program, floating-point operations by XLA's count, run time. The
last rows have all effects that go together, and those of each shipped scene. The second table has the shipped scenes
simulated to a session file: seconds of recording per second of work, and file size; the first run, which compiles, is
listed apart.
"""

import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import calib.runtime
import jaxeit as je
from calib.bench import load_bench, presets, simulate
from jaxeit import effects as fx

from .clock import in_turns, program, seconds
from .harness import Question, Run
from .rows import Row

ROWS = 1024
LEFT_OUT = (fx.IndentationSpreading, fx.HomogenisedIslands, fx.ContinuousCoating)  # others say the same
STAGES = ("mechanics", "material", "electrical", "pneumatics", "readout")


def set_up() -> None:
    """As a command, but for the cache of compiled programs: compile times are those of a first use."""
    calib.runtime.set_up()
    jax.config.update("jax_enable_compilation_cache", False)


def fidelity(run: Run) -> je.Fidelity:
    return je.Fidelity.draft() if run.smoke else je.Fidelity(edge_length=0.02)


# --- programs


def in_order() -> list[fx.AbstractEffect]:
    """All effects that go together, stage by stage."""
    kinds = [kind for kind in je.effects.EFFECTS.values() if kind not in LEFT_OUT]
    return [kind() for kind in sorted(kinds, key=lambda kind: STAGES.index(kind.stage))]


def programs(run: Run) -> Iterator[Row]:
    effects = in_order()
    counts = (0, len(effects)) if run.smoke else range(len(effects) + 1)
    sets = [(f"+ {type(effects[n - 1]).__name__}" if n else "none", tuple(effects[:n])) for n in counts]
    sets[-1] = (f"{sets[-1][0]}: all {len(effects)}", sets[-1][1])
    if not run.smoke:
        sets += [(f"scene {name}", load_bench(name).scene.effects) for name in presets()]
    bare = je.discretise(je.Scene(je.load_skin("testbed")), fidelity(run))
    for name, several in sets:
        laid = fx.laid(several, bare.centroids)  # as a simulation does, once for all frames
        model = eqx.tree_at(lambda m: m.effects, bare, laid, is_leaf=lambda x: x is bare.effects)
        block = jnp.ones((ROWS, 1)) * jnp.asarray(je.forward(bare))
        pads, load = jnp.ones((ROWS, 4)), jnp.ones((ROWS, 1))
        row = measured("frame", frame, model, jnp.asarray(20.0))
        yield {
            "rows": [{"effects": name} | row | measured("block", histories, several, block, pads, load, bare.pattern)],
            "edge_length": fidelity(run).edge_length,
        }


def measured(name: str, function: Any, *arguments: Any) -> Row:
    found = program(function, arguments)
    return {
        f"{name}_ms": 1e3 * float(np.median(in_turns({name: found.call}, 7)[name])),
        f"{name}_compile_s": found.compile_s,
        f"{name}_operations": (found.compiled.as_text() or "").count(" = "),
        f"{name}_mflop": 1e-6 * (found.compiled.cost_analysis() or {}).get("flops", 0.0),
    }


def frame(model: je.Model, load: jax.Array) -> jax.Array:
    """A touch in the middle of a pad."""
    spread = je.model.load_spread(model, jnp.array([0.06, 0.07]), jnp.asarray(0.02))
    return je.forward(model, je.conductivity(model, load * spread, 1.0))


def histories(effects, block, pads, load, pattern):
    """Loads, pads and readout of one block; effects that a scene does not list are not there."""
    key, still = jax.random.key(0), jnp.zeros(ROWS)
    line = fx.HistoryInputs(key, jnp.asarray(1 / 180), still, still, pattern[:0])

    def run(family, series, stream=None, line=line):
        mine = fx.chosen(effects, family, stream)
        return fx.history(mine, series, fx.history_start(mine, series[0]), line)[0]

    load = run(fx.AbstractMemoryEffect, load)
    pads = run(fx.AbstractReadoutEffect, run(fx.AbstractPneumaticEffect, pads), fx.StreamKind.PRESSURE)
    eit = run(fx.AbstractReadoutEffect, block, fx.StreamKind.EIT, line._replace(pattern=pattern))
    return eit, pads, run(fx.AbstractReadoutEffect, load, fx.StreamKind.FORCE)


# --- sessions


def sessions(run: Run) -> Iterator[Row]:
    for name in run.sizes(list(presets()), ["ideal"]):
        yield {"sessions": [simulated(name, fidelity(run))]}


def simulated(name: str, fidelity: je.Fidelity) -> Row:
    """A shipped scene to a file, twice: the first run compiles what the second finds in memory."""
    bench = load_bench(name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.h5"
        runs = {"first_s": path, "second_s": path.with_name("again.h5")}
        times = {key: seconds(partial(simulate, bench, out, fidelity=fidelity))[0] for key, out in runs.items()}
        size = path.stat().st_size
    about = {"scene": name, "recording_s": bench.duration, "frames": int(bench.duration * bench.eit_rate)}
    return about | times | {"times_real_time": bench.duration / times["second_s"], "file_mb": size / 1e6}


main = Question("scene", __doc__, {"programs": programs, "sessions": sessions}, prepare=set_up)

if __name__ == "__main__":
    main()
