"""Accuracy against time: settings to compare, the study, and its recommendation.

Example:
    import jax

    import jaxeit as je
    from jaxeit import accuracy

    jax.config.update("jax_enable_x64", True)

    scene = je.Scene(je.load_skin("testbed"))
    rungs = [
        accuracy.Choice("draft", je.Fidelity.draft(), imaging=None),
        accuracy.Choice("draft, float32", je.Fidelity.draft(dtype="float32"), imaging=None),
    ]
    touch = accuracy.Touch("finger", position=(0.06, 0.13), width=0.008)  # m
    # coarse and fine
    reference = (je.Fidelity.draft(edge_length=0.05), je.Fidelity.draft(edge_length=0.04))
    table = je.ladder(scene, rungs, touches=[touch], reference=reference, budget=0.01)
    print(table.table(width=80))
    front = accuracy.undominated(table.fidelities(), lambda r: (r.difference_error, r.forward.median))
    print("no other is both faster and more accurate:", [rung.choice.label for rung in front])
    best = table.recommend(error=0.5)
    print(f"{best.choice.label}: error {best.difference_error:.1%}, {1e3 * best.forward.median:.1f} ms")
"""

from .recommendation import Ladder, Rung, undominated
from .settings import (
    Choice,
    LadderError,
    Touch,
    few_choices,
    fidelity_choices,
    image_choices,
)
from .study import ladder

__all__ = [
    "Choice",
    "Ladder",
    "LadderError",
    "Rung",
    "Touch",
    "few_choices",
    "fidelity_choices",
    "image_choices",
    "ladder",
    "undominated",
]
