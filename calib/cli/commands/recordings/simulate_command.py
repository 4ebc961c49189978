"""`jaxeit simulate`."""

import argparse
import shlex
import time
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from ...arguments import count, prepare_outputs, prepare_results, skin_of
from ...terminal import announce_model, progress_bar, say, say_interrupted, show

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from jaxeit import Fidelity

    from ....batch.random_frames import WrittenFrames


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A scene, or a skin for a data set, and what to do with it."""
    parser.add_argument("scene", metavar="SCENE.toml", help="a scene file, or a shipped scene by its name")
    parser.add_argument("-o", "--output", metavar="SESSION.h5", help="file to write; with --random-scenes, a folder")
    text = "print what the scene simulates and what each part costs, and simulate nothing"
    parser.add_argument("--explain", action="store_true", help=text)
    text = (
        "play SESSION.h5 on local TCP ports in real time, as the skin would send it; simulate it first if it is missing"
    )
    parser.add_argument("--serve", action="store_true", help=text)
    text = "write a data set (HDF5) of Gaussian contacts of 0 to 100 %% at N x N places of a skin, which SCENE names; "
    parser.add_argument("--data-set", nargs="?", type=int, const=41, metavar="N", help=text + "default N: 41")
    _add_random_scenes(parser)
    _add_robot(parser)


def _add_random_scenes(parser: argparse.ArgumentParser) -> None:
    about = (
        "frames of random contacts on skins drawn anew, with pressures and true force maps; the same command resumes"
    )
    group = parser.add_argument_group("frames for training", about)
    text = "number of frames to write into the folder given by -o; the presses of the scene are not used"
    group.add_argument("--random-scenes", type=count, metavar="FRAMES", help=text)
    group.add_argument("--seed", type=int, metavar="N", help="seed of the random scenes; default: that of the scene")
    text = "accuracy of the finite-element model (default: standard); one of draft, standard, reference"
    action = group.add_argument("--fidelity", metavar="NAME", help=text)
    action.suggestions = ("draft", "standard", "reference")  # type: ignore[attr-defined]
    group.add_argument("--pixels", type=count, metavar="N", help="pixels of the force map along x; default: 40")
    text = "format of the shards: hdf5 (default), or parquet for pandas, Polars, DuckDB, datasets; needs jaxeit[tables]"
    group.add_argument("--format", choices=("hdf5", "parquet"), help=text)
    many = group.add_mutually_exclusive_group()
    many.add_argument(
        "--jobs", type=count, metavar="N", help="number of processes; the files do not depend on it; default: 1"
    )
    text = "as --jobs, on the workers of a Dask scheduler, which must see the same folder"
    many.add_argument("--scheduler", metavar="ADDRESS", help=text)


def _add_robot(parser: argparse.ArgumentParser) -> None:
    about = "what a skin on a robot reads while MuJoCo simulates the robot, left to itself; needs jaxeit[mujoco]"
    group = parser.add_argument_group("a simulated robot", about)
    text = "the robot; the scene gives skin, effects and rates, and its presses are not used"
    group.add_argument("--mujoco", metavar="MODEL.xml", help=text)
    group.add_argument("--geom", nargs="+", metavar="NAME", help="geoms of the robot that the skin covers")
    text = "site of the robot at which the skin lies, with the axes of its surface"
    group.add_argument("--site", metavar="NAME", help=text)
    group.add_argument("--seconds", type=float, metavar="S", help="duration, in the robot's time; default: 10")


def run(args: argparse.Namespace) -> int:
    """Simulate, explain, or serve a scene."""
    if bool(args.output) == args.explain:
        raise ValueError("give either -o SESSION.h5 to simulate, also with --serve, or --explain")
    _refuse_lone_options(args)
    from ....runtime import set_up, set_up_batches

    (set_up_batches if args.data_set else set_up)()
    from ....bench import SIMULATION, load_bench, measure_costs, render_costs, simulate

    if args.data_set:
        return _simulate_data_set(args)
    if args.random_scenes:
        return _simulate_random_scenes(args)
    if args.mujoco:
        return _simulate_robot(args)
    bench = load_bench(args.scene)
    if args.explain:
        show(render_costs(bench, measure_costs(bench)))
        return 0
    prepare_outputs(args, "output")
    if args.serve and Path(args.output).exists():
        return _serve(args.output)
    announce_model(bench.scene.skin, SIMULATION)
    try:
        simulate(bench, args.output, progress=progress_bar("blocks"))
    except KeyboardInterrupt as interrupt:
        return say_interrupted(interrupt, f"the same command goes on from {args.output}.part")
    show(f"{args.output}: {len(bench.sites)} presses, {bench.duration:.0f} s, SIMULATED{_saturation(args.output)}")
    return _serve(args.output) if args.serve else 0


def _saturation(path: str) -> str:
    """Which streams the scene drives beyond the range of their converters, in words."""
    import numpy as np

    from ....session import Status, open_session

    with open_session(path) as session:
        flags = {name: stream.status() for name, stream in session.streams.items()}
    shares = {n: 100 * np.mean(found & Status.saturated > 0) for n, found in flags.items() if found is not None}
    parts = [f"{share:{'.0f' if share > 1 else '.2g'}} % of {name}" for name, share in shares.items() if share]
    return f"; beyond the range of their converters: {', '.join(parts)}" if parts else ""


def _serve(path: str) -> int:
    """Play a session as a simulated device until interrupted."""
    import threading

    from ....record.device import SimulatedDevice, recording_packets
    from ....session import open_session

    with open_session(path) as session:
        names = [name for name in ("eit", "pressure", "force") if name in session.streams]
        skin = _name_skin(session.skin_name, session.skin_toml, Path(path))
    with SimulatedDevice([recording_packets(path, [name], rounds=10**6) for name in names]) as device:
        urls = {name: (f"--{name}", url) for name, url in zip(names, device.urls, strict=True)}
        record = shlex.join(["jaxeit", "record", "--skin", skin, *chain(*urls.values()), "-o", "recorded.h5"])
        shown = chain(*(urls[name] for name in ("eit", "pressure") if name in urls))
        live = shlex.join(["jaxeit", "live", "--calibration", "calibration.h5", *shown])
        with suppress(KeyboardInterrupt):
            show(f"serving {path}, SIMULATED; in another terminal: {record}")
            show(f"or, with a calibration: {live}")
            threading.Event().wait()
    return 0


def _name_skin(name: str, text: str, session: Path) -> str:
    """The argument of `record --skin`: a shipped skin by its name, or else a TOML file written beside the session."""
    import jaxeit as je

    if name in je.skin.shipped_skins() and je.load_skin(name).toml == text:
        return name
    path = session.with_suffix(".skin.toml")
    path.write_text(text, encoding="utf-8")
    return str(path)


def _simulate_data_set(args: argparse.Namespace) -> int:
    from ....bench import write_data_set

    if args.explain or args.serve:
        raise ValueError("--explain and --serve are for scenes; leave them out")
    prepare_results(args, "output")
    skin, progress = skin_of(str(args.scene)), progress_bar("contacts")
    places, steps = write_data_set(skin, args.output, columns=args.data_set, rows=args.data_set, progress=progress)
    show(f"{args.output}: {places} places, {steps} amplitudes, SIMULATED")
    return 0


_OPTIONS_OF = {
    "--random-scenes FRAMES": ("seed", "fidelity", "pixels", "format", "jobs", "scheduler"),
    "--mujoco MODEL.xml": ("geom", "site", "seconds", "fidelity"),
}
_OTHERS = ("data_set", "random_scenes", "mujoco", "explain", "serve")


def _refuse_lone_options(args: argparse.Namespace) -> None:
    """What makes one thing does not go with what makes another, nor its options without it."""
    wanted = [_flag(name) for name in _OTHERS if getattr(args, name)]
    if len(wanted) > 1 and {"--random-scenes", "--mujoco"} & {*wanted}:
        raise ValueError(f"{' and '.join(wanted)} make different things; give one of them")
    allowed = {name for main, names in _OPTIONS_OF.items() if main.split()[0] in wanted for name in names}
    for main, names in _OPTIONS_OF.items():
        given = [_flag(name) for name in names if name not in allowed and getattr(args, name) is not None]
        if given:
            raise ValueError(f"{', '.join(given)}: an option of {main}; give it too, or leave this out")
    if args.mujoco and not (args.geom and args.site):
        raise ValueError("--mujoco: give --geom NAME, which the skin covers, and --site NAME, where the skin lies")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _fidelity_of(args: argparse.Namespace) -> "Fidelity | None":
    """What --fidelity asks for; None: the default of what is made."""
    from ....calibration.recipes.text import fidelity_choice

    return None if args.fidelity is None else fidelity_choice(args.fidelity, True)


def _simulate_robot(args: argparse.Namespace) -> int:
    from ....bench import load_bench
    from ....simulators.rollout import load_robot, record_rollout

    prepare_outputs(args, "output")
    bench, seconds = load_bench(args.scene), 10.0 if args.seconds is None else args.seconds
    record_rollout(
        args.output,
        bench,
        load_robot(args.mujoco),
        seconds,
        geoms=args.geom,
        site=args.site,
        fidelity=_fidelity_of(args),
        progress=progress_bar("frames"),
    )
    show(f"{args.output}: {seconds:g} s of {args.mujoco}, SIMULATED")
    return 0


def _simulate_random_scenes(args: argparse.Namespace) -> int:
    """Write frames for training; an interruption leaves whole shards, from which the same command goes on."""
    import jaxeit as je

    from ....batch.cluster import dask_executor
    from ....batch.random_frames import write_training_frames
    from ....bench import FrameSet, load_bench

    start, bench = time.monotonic(), load_bench(args.scene)
    bench = bench if args.seed is None else replace(bench, seed=args.seed)
    pixels = None if args.pixels is None else je.Pixels(args.pixels)
    given = {"fidelity": _fidelity_of(args), "pixels": pixels, "file_format": args.format}
    frame_set = FrameSet(bench, args.random_scenes, **{name: one for name, one in given.items() if one is not None})
    with ExitStack() as stack:
        executor = stack.enter_context(dask_executor(args.scheduler)) if args.scheduler else None
        begin, tell = stack.enter_context(_frame_bar())
        try:
            written = write_training_frames(
                frame_set,
                args.output,
                executor=executor,
                jobs=args.jobs or 1,
                begin=begin,
                tell=tell,
                finishing=_say_finishing,
            )
        except KeyboardInterrupt as interrupt:
            return say_interrupted(interrupt, f"the same command goes on from the shards in {args.output}")
    show(f"{args.output}: {_frames_text(written, time.monotonic() - start)}, SIMULATED")
    return 0


def _say_finishing(running: int) -> None:
    say(f"finishing {running} {'shard' if running == 1 else 'shards'}; Ctrl-C again to stop now")


@contextmanager
def _frame_bar() -> "Iterator[tuple[Callable[[int, int], None], Callable[[int], object]]]":
    """A progress bar: its begin takes the number of frames to write, and of their bytes; its update frames written."""
    from tqdm import tqdm

    with tqdm(desc="frames", unit="", unit_scale=True, disable=None, leave=False) as bar:

        def begin(frames: int, nbytes: int) -> None:
            bar.reset(frames)
            if frames:
                say(f"{frames:,} frames to write, at most {nbytes / 1e6:,.1f} MB")

        yield begin, bar.update


def _frames_text(written: "WrittenFrames", seconds: float) -> str:
    rate = written.made / seconds
    made = f"{written.made:,} of them now at {rate:,.0f} frames/s" if written.made else "all of them there before"
    return f"{written.frames:,} frames, {written.nbytes / 1e6:,.1f} MB, {made}"
