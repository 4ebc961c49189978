"""How good a proposal is on scenes of skins that it was not trained on."""

from itertools import pairwise, permutations
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize_scalar

from jaxeit.contacts import LoadKind, Proposed
from jaxeit.contacts.loads.learned import loads_by_kind

from .targets import Targets

BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)  # of stated probability


def fit_temperature(logs: Float[np.ndarray, "n 5"], kind: Int[np.ndarray, " n"]) -> float:
    """The number that divides log odds so that they are most probable (Guo et al. 2017, ICML 34)."""

    def surprise(log_temperature: float) -> float:
        scaled = logs / np.exp(log_temperature)
        top = scaled.max(1)
        spare = np.log(np.exp(scaled - top[:, None]).sum(1)) + top
        return float(np.mean(spare - scaled[np.arange(len(kind)), kind]))

    found = minimize_scalar(surprise, bounds=(-2, 2), method="bounded")
    return float(np.exp(found.x))


def figures_of(proposed: Proposed, targets: Targets) -> dict[str, Any]:
    """Kinds told, errors of place, reliability of the probabilities, and frames that are called unlike the scenes."""
    right = proposed.probability.argmax(1) == targets.kind
    kinds = {}
    for kind in LoadKind:
        rows = targets.kind == kind
        if not rows.any():
            continue
        kinds[kind.name.lower()] = {"frames": int(rows.sum()), "told": _rounded(right[rows].mean())}
        if kind is not LoadKind.NONE:
            error = 1e3 * place_errors(kind, proposed.of(kind)[rows], targets.loads[rows])
            kinds[kind.name.lower()] |= {
                "place_mm_median": _rounded(np.median(error)),
                "place_mm_90": _rounded(np.percentile(error, 90)),
            }
    true = np.arange(len(LoadKind)) == targets.kind[:, None]
    return {
        "frames": len(right),
        "kinds_told": _rounded(right.mean()),
        "kinds": kinds,
        "reliability": reliability(proposed.probability, true),
        "called_outside": _rounded((proposed.distance > 1).mean()),
    }


def place_errors(
    kind: LoadKind, found: Float[np.ndarray, "n rows size"], loads: Float[np.ndarray, "n 30"]
) -> Float[np.ndarray, " n"]:
    """Mean distance of loads from true ones in the best order, m."""
    true = loads_by_kind(loads)[kind][..., :2]
    every = permutations(range(true.shape[1]))
    orders = [np.linalg.norm(found[..., :2] - true[:, list(order)], axis=2).mean(1) for order in every]
    best: np.ndarray = np.min(orders, axis=0)
    return best


def reliability(stated: np.ndarray, true: np.ndarray) -> list[dict[str, float]]:
    """How often kinds are the true ones, by the probability that was stated for them: (frames, kinds) each."""
    found = []
    for low, high in pairwise(BINS):
        here = (stated >= low) & ((stated < high) | (high == BINS[-1]))
        if here.any():
            row = {"stated": _rounded(stated[here].mean()), "true": _rounded(true[here].mean())}
            found.append(row | {"count": int(here.sum())})
    return found


def _rounded(value: Any) -> float:
    return round(float(value), 4)
