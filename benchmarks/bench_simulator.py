"""Steps per second of a skin on a simulated robot, for 1, 64 and 1,024 environments.

The first table has the ladder of fidelities, with the two effects that a step needs (a load spreads, pressure makes the
sheet conduct); the error is that of the change of the readings against the finest fidelity, as a share of its norm.
Frames are solved, or computed from slopes (`calib.simulators.Polarised`).
The second table has the draft with the effects of two scenes, and with one of each kind that a step may have: what a
scene does not list is not computed. Compile times are apart. The third has the steps of MuJoCo itself for a ball on a
board, and how long the contacts of all environments take to read, where MuJoCo is installed.

Every environment has three contacts at random places, in eight slots.
"""

from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib import simulators
from calib.bench import load_bench
from jaxeit import effects as fx

from .clock import in_turns, program, seconds
from .harness import Question, Run, with_one_blas_thread
from .rows import Row

RATE = 100.0  # Hz
SLOTS, PRESSING = 8, 3
NEEDED = (fx.LoadSpreading(), fx.ContactPiezoresistance())
LEFT_OUT = (fx.IndentationSpreading, fx.HomogenisedIslands, fx.ContinuousCoating, *simulators.NOT_IN_A_STEP)
SINGLE, SOLVED, POLARISED = np.float32, simulators.Solved(), simulators.Polarised()
LADDER: dict[str, tuple[je.Fidelity, simulators.AbstractFrames]] = {
    "draft, float32, polarised": (je.Fidelity.draft(dtype=SINGLE), POLARISED),
    "standard, float32, polarised": (je.Fidelity.standard(dtype=SINGLE), POLARISED),
    "standard, polarised": (je.Fidelity.standard(), POLARISED),
    "draft, float32": (je.Fidelity.draft(dtype=SINGLE), SOLVED),
    "draft": (je.Fidelity.draft(), SOLVED),
    "standard": (je.Fidelity.standard(), SOLVED),
    "edge length 0.02": (je.Fidelity(edge_length=0.02), SOLVED),
}
FINEST = je.Fidelity(edge_length=0.012)
BOARD = """<mujoco><worldbody><geom name="board" type="box" size=".1 .1 .02"/><site name="sheet" pos="-.1 -.1 .02"/>
<body pos="0 0 .05"><freejoint/><geom type="sphere" size=".03" mass="1"/></body></worldbody></mujoco>"""


def environments(run: Run) -> Any:
    return run.sizes((1, 64, 1024), (1, 3))


def contacts(count: int) -> simulators.ContactPoints:
    """Random contacts on the testbed, away from its rim; one environment has no leading axis."""
    rng = np.random.default_rng(0)
    force = np.where(np.arange(SLOTS) < PRESSING, rng.uniform(2, 15, (count, SLOTS)), 0)
    found = simulators.ContactPoints(rng.uniform(0.03, 0.17, (count, SLOTS, 2)), force, np.full(force.shape, 0.02))
    return found if count > 1 else simulators.ContactPoints(*(part[0] for part in found))


def timed(skin: simulators.SimulatedSkin, count: int) -> Row:
    """Time of a step, and the time to compile it."""
    state, touched = skin.start(environments=count if count > 1 else None), jax.tree.map(jnp.asarray, contacts(count))
    found = program(simulators.step, (skin, state, touched))
    ms = 1e3 * float(np.median(in_turns({"step": found.call}, 15, budget=5.0)["step"]))
    return {"environments": count, "step_ms": ms, "steps_per_s": 1e3 * count / ms, "compile_s": found.compile_s}


def change(skin: simulators.SimulatedSkin) -> np.ndarray:
    """Of the readings by the contacts of one environment, V."""
    return np.asarray(simulators.step(skin, skin.start(), contacts(1))[1].frame - skin.resting, float)


def ladder(run: Run) -> Iterator[Row]:
    scene = je.Scene(je.load_skin("testbed"), NEEDED)
    exact = change(simulators.prepare_skin(scene, RATE, LADDER["standard"][0] if run.smoke else FINEST))
    for name in run.sizes(list(LADDER), ["draft, float32, polarised", "draft"]):
        skin = simulators.prepare_skin(scene, RATE, *LADDER[name])
        error = float(np.linalg.norm(change(skin) - exact) / np.linalg.norm(exact))
        for count in environments(run):
            yield {"ladder": [{"fidelity": name, "error": error} | timed(skin, count)]}


def scenes() -> dict[str, tuple[fx.AbstractEffect, ...]]:
    """Effects by name."""
    every = tuple(kind() for kind in fx.EFFECTS.values() if not issubclass(kind, LEFT_OUT))
    named = {name: load_bench(name).scene.effects for name in ("paper_bench", "hot_day")}
    whole = {"the two needed": NEEDED, **named, "one of each kind": every}
    return {f"{name}: {len(several)}": several for name, several in whole.items()}


def effects(run: Run) -> Iterator[Row]:
    bare = je.Scene(je.load_skin("testbed"))
    for name, several in scenes().items():
        skin = simulators.prepare_skin(replace(bare, effects=several), RATE, *LADDER["draft"])
        for count in environments(run):
            yield {"effects": [{"effects": name} | timed(skin, count)]}


def contact_lists(run: Run) -> Iterator[Row]:
    if find_spec("mujoco") is None:
        return
    import mujoco  # noqa: PLC0415  an optional extra

    from calib.simulators.mujoco import ContactReader  # noqa: PLC0415

    model = mujoco.MjModel.from_xml_string(BOARD)
    reader = ContactReader(model, je.load_skin("testbed"), geoms=["board"], site="sheet", slots=SLOTS)
    for count in environments(run):
        datas = [mujoco.MjData(model) for _ in range(count)]
        stepped = seconds(lambda datas=datas: [mujoco.mj_step(model, data, 100) for data in datas])[0] / 100
        read = min(seconds(reader.batch, datas)[0] for _ in range(9))
        yield {"mujoco": [{"environments": count, "mj_step_ms": 1e3 * stepped, "reading_ms": 1e3 * read}]}


main = Question("simulator", __doc__, {"ladder": ladder, "effects": effects, "mujoco": contact_lists})

if __name__ == "__main__":
    with_one_blas_thread()
    main()
