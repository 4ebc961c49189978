"""The few functions that JAX and NumPy do not share, so that one formula serves both."""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.typing import ArrayLike
from jaxtyping import Array

from ..messages.kinds import require_unmasked, stated
from . import lapack


class ArrayLibrary(NamedTuple):
    """JAX or NumPy; see `JAX` and `NUMPY`.

    | meaning                                                                                |
    |----------------------------------------------------------------------------------------|
    | namespace: `jax.numpy` or `numpy`                                                      |
    | solve(a, b): x with a x = b                                                            |
    | cholesky(a): L with L L^T = a, not finite (JAX) or an error (NumPy) if a has no factor  |
    | solve_lower(a, b, trans=0): x with a x = b, or a^T x = b where ``trans`` is 1           |
    | add_at(array, place, values): the array with values added at these places              |
    """

    namespace: ModuleType
    solve: Callable[..., Any]
    cholesky: Callable[..., Any]
    solve_lower: Callable[..., Any]
    add_at: Callable[..., Any]


def _jax_solve_lower(lower: Array, b: ArrayLike, trans: int = 0) -> Array:
    return lapack.solve_triangular(lower, b, trans=trans, lower=True)


def _numpy_solve_lower(lower: np.ndarray, b: np.ndarray, trans: int = 0) -> np.ndarray:
    found: np.ndarray = scipy.linalg.solve_triangular(lower, b, trans=trans, lower=True, check_finite=False)
    return found


def _numpy_add_at(array: np.ndarray, place: Any, values: np.ndarray) -> np.ndarray:
    found = array.copy()
    np.add.at(found, place, values)
    return found


JAX = ArrayLibrary(
    namespace=jnp,
    solve=lapack.solve,
    cholesky=lambda a: lapack.cholesky(a, lower=True),
    solve_lower=_jax_solve_lower,
    add_at=lambda array, place, values: array.at[place].add(values),
)
NUMPY = ArrayLibrary(
    namespace=np,
    solve=np.linalg.solve,
    cholesky=np.linalg.cholesky,
    solve_lower=_numpy_solve_lower,
    add_at=_numpy_add_at,
)


def real_array(name: str, values: Any, error: type[Exception]) -> Array:
    """Values as an array of JAX, also where jit, grad or vmap hides them.

    Raises:
        error: unless they are real numbers, none of them masked; ``name`` names them.
    """
    require_unmasked({name: values}, error)
    try:
        found = jnp.asarray(values)
    except (TypeError, ValueError):
        raise error(f"{name} is {stated(values)}; give an array of real numbers") from None
    if found.dtype.kind == "c":
        raise error(f"{name} is complex; give real numbers, such as {name}.real")
    return found
