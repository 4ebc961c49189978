"""What the skin of a robot reads while MuJoCo simulates the robot, as a session file."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

import jaxeit as je

from ..bench import Bench
from ..bench.simulation import Progress, simulated_facts
from ..session import SessionWriter, StreamFacts
from .contacts import ContactPoints, SimulatorError, place_contacts
from .mujoco import ContactReader, mujoco
from .skin import prepare_skin, step

SHORTEST_REST = 0.5  # s without contact that a session begins with, from which its zero is told


def load_robot(path: str | Path) -> mujoco.MjModel:
    """A robot from an XML file of MuJoCo (MJCF or URDF).

    Raises:
        SimulatorError: if MuJoCo cannot compile the file.
    """
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise SimulatorError(f"{path}: MuJoCo cannot read the model: {' '.join(str(error).split())}") from error


def record_rollout(
    path: str | Path,
    bench: Bench,
    robot: mujoco.MjModel,
    seconds: float,
    *,
    geoms: Sequence[str],
    site: str,
    fidelity: je.Fidelity | None = None,
    progress: Progress = iter,
) -> Path:
    """Simulate a robot that is left to itself, and write what its skin reads as a session.

    The robot starts from its first keyframe, or from the pose of the model if there is none, and the controls stay as
    they are there. The session begins with the untouched skin, `Bench.blank` long, at least half a second. Frames and
    pressures come at `Bench.eit_rate`, to the nearest whole number of time steps of the model. Its truth has the load
    on the sheet, (frames,) N, and how many contacts were left out in each frame.

    Args:
        path: of the session; it appears only when complete.
        bench: scene, rates and seed; its presses are not used.
        robot: from `load_robot`.
        seconds: of the robot's time.
        geoms, site: as for `ContactReader`.
        fidelity: of the skin; default: `jaxeit.Fidelity.standard()`.
        progress: wraps the iteration over frames, such as `tqdm.tqdm`.

    Raises:
        SimulatorError: for a scene that no step can have, a name that the model lacks, a time below one frame, or a
            simulation that diverges.
    """
    steps = max(1, round(1 / (bench.eit_rate * robot.opt.timestep)))
    interval = steps * robot.opt.timestep
    if not interval <= seconds < np.inf:
        raise SimulatorError(f"{seconds:g} s are no recording; give a time of {interval:g} s, one frame, or more")
    reader = ContactReader(robot, bench.scene.skin, geoms=geoms, site=site)
    skin = prepare_skin(bench.scene, 1 / interval, fidelity)
    now, state = je.bind(step, skin), skin.start(bench.seed)
    rest, frames = round(max(bench.blank, SHORTEST_REST) / interval), round(seconds / interval)
    loads, left_out = np.zeros(rest + frames), np.zeros(rest + frames, int)
    facts = simulated_facts(bench, "what the skin of a simulated robot reads")
    with SessionWriter(path, facts) as writer:
        for name, about in _streams(bench.scene.skin, 1 / interval).items():
            writer.add_stream(name, about)
        touched = _ContactFrames(robot, bench.scene.skin, reader, rest, frames, steps)
        for number, (contacts, missing) in enumerate(progress(touched)):
            state, readings = now(state, contacts)
            time = [round(number * interval * 1e9)]
            writer.append("eit", time, np.asarray(readings.frame)[None])
            writer.append("pressure", time, np.asarray(readings.pressure)[None])
            loads[number], left_out[number] = float(readings.load), missing
        writer.set_truth({"load": (loads, "N"), "contacts_left_out": (left_out, "1")})
    return Path(path)


class _ContactFrames:
    """Contacts frame by frame, first none; with a length, so that progress can be displayed."""

    def __init__(self, robot: mujoco.MjModel, skin: je.Skin, reader: ContactReader, rest: int, frames: int, steps: int):
        self._robot, self._skin, self._reader = robot, skin, reader
        self._rest, self._frames, self._steps = rest, frames, steps

    def __len__(self) -> int:
        return self._rest + self._frames

    def __iter__(self) -> Iterator[tuple[ContactPoints, int]]:
        nothing = np.zeros((0, 3))
        untouched = place_contacts(self._skin, nothing, nothing).contacts
        for _ in range(self._rest):
            yield untouched, 0
        data = mujoco.MjData(self._robot)
        if self._robot.nkey:
            mujoco.mj_resetDataKeyframe(self._robot, data, 0)
        for _ in range(self._frames):
            mujoco.mj_step(self._robot, data, self._steps)
            placed = self._reader(data)
            yield placed.contacts, int(placed.off_sheet) + int(placed.pulling)


def _streams(skin: je.Skin, rate: float) -> dict[str, StreamFacts]:
    eit = StreamFacts("voltage", units="V", channels=skin.protocol.readings, rate_hz=rate, transport="simulated")
    pressure = StreamFacts("pressure", units="Pa", channels=len(skin.pads), rate_hz=rate, transport="simulated")
    return {"eit": eit, "pressure": pressure}
