"""`jaxeit train`."""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from ...arguments import count, prepare_results, skin_of
from ...terminal import say_interrupted, show


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The skin, the file, and how much is drawn."""
    parser.add_argument("skin", metavar="SKIN", help="a shipped skin by its name, or the TOML file of your own")
    parser.add_argument("-o", "--output", required=True, metavar="PROPOSAL.npz")
    parser.add_argument("--frames", type=count, metavar="N", help="random scenes; default: 307,200")
    parser.add_argument("--epochs", type=count, metavar="N", help="passes over the scenes; default: 30")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="seed of scenes and weights; default: 0")
    text = "accuracy of the finite-element model (default: draft:dtype=float32); one of draft, standard, reference"
    action = parser.add_argument("--fidelity", metavar="NAME", help=text)
    action.suggestions = ("draft", "standard", "reference")  # type: ignore[attr-defined]
    text = "number of processes that simulate; the file does not depend on it; default: 1"
    parser.add_argument("--jobs", type=count, default=1, metavar="J", help=text)


def run(args: argparse.Namespace) -> int:
    """Train a proposal of contacts; an interruption leaves what is done, from which the same command goes on."""
    from ....runtime import set_up
    from ...arguments import require_optax

    require_optax()
    set_up()
    from ....calibration.recipes.text import fidelity_choice
    from ....learning.procedure import train_proposal

    prepare_results(args, "output")
    skin, began = skin_of(args.skin), time.monotonic()
    given = {name: value for name in ("frames", "epochs") if (value := getattr(args, name)) is not None}
    if args.fidelity is not None:
        given["fidelity"] = fidelity_choice(args.fidelity, True)
    with _bars() as progress:
        try:
            found = train_proposal(skin, args.output, seed=args.seed, jobs=args.jobs, progress=progress, **given)
        except KeyboardInterrupt as interrupt:
            return say_interrupted(interrupt, f"the same command goes on from {args.output}.parts")
    told = found.about["held_out"]
    show(f"of {told['frames']:,} frames of {told['skins']} skins held out, {told['kinds_told']:.0%} are told rightly:")
    for name, row in told["kinds"].items():
        place = f", place within {row['place_mm_median']:.1f} mm (median)" if "place_mm_median" in row else ""
        show(f"  {name}: {row['told']:.0%} of {row['frames']:,}{place}")
    show(f"{args.output}: written after {time.monotonic() - began:.0f} s, trained on SIMULATED skins")
    return 0


@contextmanager
def _bars() -> Iterator[Callable[[str, int, int], None]]:
    """Progress bars of stages, one after the other; no bar if standard error is no terminal."""
    from tqdm import tqdm

    bars: dict[str, Any] = {}
    with ExitStack() as stack:

        def progress(stage: str, done: int, of: int) -> None:
            if stage not in bars:
                bars[stage] = stack.enter_context(tqdm(total=of, desc=stage, disable=None, leave=False))
            bars[stage].update(done - bars[stage].n)

        yield progress
