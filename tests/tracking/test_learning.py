"""What presses teach of the contact layer, against the same presses with nothing taught, skin by skin."""

import numpy as np
import pytest

from benchmarks.bench_learning import GAUSSIAN, HALF_SPACE, Session, Skin
from benchmarks.problems import fit_model

SEEDS, STAGES, TESTS, PROBES = range(9500, 9506), (0, 10, 30, 120), 20, 12
# Presses from which the mean error must be smaller than with nothing taught. Fewer presses are near few of the 20 that
# are asked, and the mean of their paired differences may be above zero by chance, in standard errors.
CERTAIN, CHANCE = 30, 2.0


@pytest.fixture(scope="module")
def draft():
    return fit_model()


def errors_after(model, seed, shape):
    """Errors (presses,) of the same presses by a layer after each stage: of the place, mm, and of the force by the
    readings alone, relative, by the gain and by the law of contacts as well."""
    skin = Skin(seed)
    teaching, given = skin.pressed(shape, max(STAGES)), skin.pressed(shape, TESTS)
    session = Session(model, skin, teaching, seed, PROBES)
    shown = [session.shown(given, number) for number in range(TESTS)]
    found = {}
    for stage, layer, law in session.taught(teaching, STAGES):
        rows = [session.judged(given, number, one, layer, law) for number, one in enumerate(shown)]
        found[stage] = {name: np.array([row[name] for row in rows]) for name in ("mm", "force", "law force")}
    return found


@pytest.mark.slow
@pytest.mark.parametrize("shape", [GAUSSIAN, HALF_SPACE])
@pytest.mark.parametrize("seed", SEEDS)
def test_learning_makes_contacts_worse_on_no_skin(draft, seed, shape):
    """Places and forces of 20 presses of tips of 5 to 30 mm, the same ones before and after.

    On an elastic half-space the first presses tell how loads spread.
    """
    before, *after = errors_after(draft, seed, shape).values()
    for stage, errors in zip(STAGES[1:], after, strict=True):
        for name, error in errors.items():
            worse = error - before[name]
            allowed = CHANCE * worse.std(ddof=1) / np.sqrt(TESTS) if stage < CERTAIN else 0.0
            assert worse.mean() <= allowed, f"{name} after {stage}: {worse.mean()} with {before[name].mean()} before"
