"""Digests of choices, by which a later run knows whether a result was made with the same ones."""

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import jax
import numpy as np


def describe(value: Any) -> str:
    """Describe an object completely, arrays bit by bit: equal texts mean equal objects, on every run."""
    if isinstance(value, Mapping):
        return describe(sorted(value.items()))
    if isinstance(value, (list, tuple)):
        return f"[{','.join(map(describe, value))}]"
    if isinstance(value, (np.ndarray, jax.Array)):
        array = np.asarray(value)
        return f"{array.dtype}{array.shape}{array.tobytes().hex()}"
    if is_dataclass(value) and not isinstance(value, type):
        parts = (f"{f.name}={describe(getattr(value, f.name))}" for f in fields(value))
        return f"{type(value).__qualname__}({','.join(parts)})"
    return repr(value)


def digest(*texts: str) -> str:
    """SHA-256 of some texts, as hexadecimal digits."""
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()
