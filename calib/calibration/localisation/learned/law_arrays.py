"""What was learned of the law of contacts, as arrays of a calibration file."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxeit.tracking import ContactLaw

from ...archives.arrays import shaped

_ABOUT = {
    "mean": (
        (3,),
        "of a, b and c: log of the force by readings over the true one, and its slopes in the logs of force and width",
    ),
    "covariance": ((3, 3), "of these, in units of the variance of what the law leaves"),
    "shape": ((), "of the inverse gamma distribution of that variance"),
    "rate": ((), "of the same"),
    "plain": ((), "rate of the same without the law"),
    "evidence": ((), "log ratio of the probabilities of what readings told with the law and without"),
    "low": ((2,), "least logs of force, N, and width, m, that it was learned from"),
    "high": ((2,), "largest logs of these"),
}
_POSITIVE = ("shape", "rate", "plain")


def law_arrays(law: ContactLaw) -> dict[str, tuple[Any, str, str]]:
    """The arrays of a law of contacts."""
    arrays = {f"contact_law/{name}": (getattr(law, name), "1", meaning) for name, (_, meaning) in _ABOUT.items()}
    return arrays | {"contact_law/contacts": (law.contacts, "1", "number of contacts that it was learned from")}


def law_from(arrays: Mapping[str, np.ndarray]) -> ContactLaw | None:
    """The law of contacts, if one was learned."""
    if "contact_law/mean" not in arrays:
        return None
    found = {name: shaped(arrays, f"contact_law/{name}", shape, "f") for name, (shape, _) in _ABOUT.items()}
    for name, array in found.items():
        if not np.isfinite(array).all() or (name in _POSITIVE and array <= 0):
            raise ValueError(f"contact_law/{name} holds a number that is not finite, or zero or less")
    if found["shape"] <= 1 or (found["low"] > found["high"]).any():
        raise ValueError("contact_law/shape is one or less, or contact_law/low is above contact_law/high")
    contacts = int(shaped(arrays, "contact_law/contacts", (), "iu"))
    if contacts < 0:
        raise ValueError(f"contact_law/contacts is {contacts}; nothing is learned from less than none")
    numbers = {name: array if array.ndim else float(array) for name, array in found.items()}
    return ContactLaw(**numbers, contacts=contacts)  # type: ignore[arg-type]
