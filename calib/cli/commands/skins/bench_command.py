"""`jaxeit bench`."""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ...arguments import above_zero, picture_kind, prepare_results, require_matplotlib_for
from ...recipe_options import add_imaging_arguments, imaging_of
from ...terminal import announce_model, progress_bar, show

if TYPE_CHECKING:
    from jaxeit.accuracy import Choice, Ladder
    from jaxeit.model import Scene


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to study, and what to recommend."""
    text = "a shipped skin or scene by its name, or the TOML file of your own; default: testbed"
    parser.add_argument("what", nargs="?", default="testbed", metavar="SKIN|SCENE.toml", help=text)
    text = "recommend the most accurate setting that solves within this time"
    parser.add_argument("--budget-ms", type=above_zero, metavar="MS", help=text)
    text = "recommend the fastest setting whose error of a touch is at most this, such as 2e-3"
    parser.add_argument("--error", type=above_zero, metavar="E", help=text)
    parser.add_argument("--smoke", action="store_true", help="measure a few coarse settings only, within a minute")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    parser.add_argument("-o", "--output", metavar="FIGURE.png", help="draw error against time")
    add_imaging_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print the table, the advice, or both as JSON."""
    from shutil import get_terminal_size

    import jax

    import jaxeit as je

    prepare_results(args, "output")
    if args.output:
        picture_kind(args.output)
        require_matplotlib_for("-o")
    rungs, budget = _rungs(args), 0.1 if args.smoke else 0.5
    scene = bench_scene(args.what)
    announce_model(scene.skin, je.Fidelity.draft() if args.smoke else je.Fidelity.reference())
    with jax.enable_x64(True):  # without a cache of compiled programs, because compilation is measured too
        found = je.ladder(scene, rungs, budget=budget, progress=progress_bar("rungs"))
    if args.output:
        _write_ladder_figure(found, Path(args.output))
    wishes = {"budget_ms": args.budget_ms, "error": args.error}
    wanted = any(wish is not None for wish in wishes.values())
    if not args.json:
        show(found.table(get_terminal_size((110, 24)).columns))
        if wanted:
            show("\n" + found.advice(**wishes))
        return 0
    report = found.summary()
    try:
        if wanted:
            report["recommended"] = found.recommend(**wishes).choice.label
    finally:  # print the measurements even if no setting is good enough
        print(json.dumps(report, indent=2))
    return 0


def _rungs(args: argparse.Namespace) -> tuple["Choice", ...] | None:
    """The default settings with the imaging of the options; None: the defaults of `jaxeit.ladder`."""
    import jaxeit as je

    # With measured noise, so that a hyperparameter that needs it is answered here.
    imaging = imaging_of(args, je.Imaging(noise=je.imaging.MeasuredNoise()))
    weight = imaging.hyperparameter
    compares = isinstance(weight, je.imaging.AbstractHyperparameter) and weight.needs_noise
    if compares or (args.noise is not None and imaging.noise.needs_frames):
        raise ValueError(
            "the study's readings have no noise to be measured; leave --noise out, and choose a hyperparameter that "
            "does not compare with the noise, such as a number"
        )
    imaging = replace(imaging, noise=je.imaging.EqualNoise()) if args.noise is None else imaging
    usual = je.accuracy.few_choices() if args.smoke else None
    if imaging == je.Imaging():
        return usual
    standard = je.accuracy.Choice("usual images", je.Fidelity.standard())
    rungs = usual or (*je.accuracy.fidelity_choices(), standard)
    return tuple(
        replace(rung, imaging=imaging) if rung.imaging is not None and rung is not standard else rung for rung in rungs
    )


def bench_scene(what: str) -> "Scene":
    """Load a scene by name or file; for a skin, the scene without effects."""
    import re

    import jaxeit as je

    from ....bench import load_bench, presets

    path = Path(what)
    if what in je.skin.shipped_skins():
        return je.Scene(je.load_skin(what))
    if not path.exists() and what not in presets():
        known = ", ".join((*je.skin.shipped_skins(), *presets()))
        raise ValueError(f"{what}: no such file, skin or scene; shipped are {known}")
    if not path.is_file():
        return load_bench(what).scene
    named = re.search(r"^format\s*=\s*[\"'](.*?)[\"']", je.toml.read_text(path), re.MULTILINE)
    if named and named[1] in ("jaxeit-skin", "jaxeit-scene"):
        return je.Scene(je.load_skin(path)) if named[1] == "jaxeit-skin" else load_bench(what).scene
    found = f"is {named[1]!r}" if named else "missing"
    raise ValueError(f'{what}: format: {found}; give "jaxeit-skin" or "jaxeit-scene"')


def _write_ladder_figure(found: "Ladder", path: Path) -> None:
    from ....report.figures.accuracy import ladder_figure
    from ....report.figures.parts import write_figure

    write_figure(ladder_figure([found.summary()]), path)
