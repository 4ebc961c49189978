"""Rates of convergence, which a wrong assembly would spoil even where single values look right."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

import jaxeit as je
from jaxeit.meshing.elements import function_space

from ..helpers import disc_model

# Degree-5 quadrature on the triangle (Strang and Fix): barycentric points and weights.
_A, _B = (6 + np.sqrt(15)) / 21, (6 - np.sqrt(15)) / 21
_POINTS = np.array(
    [[1 / 3] * 3]
    + [np.roll([1 - 2 * _A, _A, _A], k) for k in range(3)]
    + [np.roll([1 - 2 * _B, _B, _B], k) for k in range(3)]
)
_WEIGHTS = np.array([9 / 40] + 3 * [(155 + np.sqrt(15)) / 1200] + 3 * [(155 - np.sqrt(15)) / 1200])


def _shape(order):
    """Values of the basis functions at the quadrature points, and barycentric slopes of them."""
    l0, l1, l2 = _POINTS.T
    if order == 1:
        return _POINTS, np.broadcast_to(np.eye(3), (len(_POINTS), 3, 3))
    zero = 0 * l0
    values = [l0 * (2 * l0 - 1), l1 * (2 * l1 - 1), l2 * (2 * l2 - 1), 4 * l0 * l1, 4 * l1 * l2, 4 * l0 * l2]
    slopes = [
        [4 * l0 - 1, zero, zero], [zero, 4 * l1 - 1, zero], [zero, zero, 4 * l2 - 1],
        [4 * l1, 4 * l0, zero], [zero, 4 * l2, 4 * l1], [4 * l2, zero, 4 * l0],
    ]  # fmt: skip
    return np.array(values).T, np.moveaxis(np.array(slopes), -1, 0)


def _u(x, y, k):
    return np.cos(k * x) * np.cos(k * y)


def _gradient(x, y, k):
    return np.stack([-k * np.sin(k * x) * np.cos(k * y), -k * np.cos(k * x) * np.sin(k * y)], -1)


def _sigma(x, y, k, uneven):
    return 1 + uneven * np.sin(k * x) * np.sin(k * y)


def _source(x, y, k, uneven):
    """f = -div(sigma grad u)."""
    sigma = _sigma(x, y, k, uneven)
    slope = uneven * k * np.stack([np.cos(k * x) * np.sin(k * y), np.sin(k * x) * np.cos(k * y)], -1)
    return 2 * k**2 * sigma * _u(x, y, k) - np.sum(slope * _gradient(x, y, k), -1)


def _errors(cells, order, uneven):
    """L2 and H1 errors on the square of side 0.2 with sigma as the mean over each element."""
    k = np.pi / 0.2
    space = function_space(je.meshing.structured(je.Rectangle(0.2, 0.2), cells, cells), order)
    corners = space.mesh.nodes[space.mesh.triangles]
    areas = space.mesh.areas
    x, y = np.moveaxis(np.einsum("qc,ecd->eqd", _POINTS, corners), -1, 0)
    weight = areas[:, None] * _WEIGHTS
    sigma = (weight * _sigma(x, y, k, uneven)).sum(1) / areas
    values, slopes = _shape(order)
    local = sigma[:, None, None] * space.stiffness
    dofs, n = space.dofs, len(space.points)
    rows, cols = np.repeat(dofs, dofs.shape[1], 1).ravel(), np.tile(dofs, (1, dofs.shape[1])).ravel()
    matrix = sp.csr_matrix((local.ravel(), (rows, cols)), shape=(n, n))
    load = np.zeros(n)
    np.add.at(load, dofs, np.einsum("eq,qi->ei", weight * _source(x, y, k, uneven), values))
    load -= load.mean()
    found = np.zeros(n)
    found[1:] = spsolve(matrix[1:, 1:].tocsc(), load[1:])
    at = np.einsum("ei,qi->eq", found[dofs], values)
    at -= (weight * (at - _u(x, y, k))).sum() / areas.sum()
    edges = np.roll(corners, -1, 1) - np.roll(corners, -2, 1)  # opposite each corner
    barycentric = np.stack([edges[..., 1], -edges[..., 0]], -1) / (2 * areas[:, None, None])
    slope = np.einsum("ei,qic,ecd->eqd", found[dofs], slopes, barycentric)
    l2 = np.sqrt((weight * (at - _u(x, y, k)) ** 2).sum())
    h1 = np.sqrt((weight[..., None] * (slope - _gradient(x, y, k)) ** 2).sum())
    return l2, h1


@pytest.mark.parametrize(
    ("order", "uneven", "l2_rate", "h1_rate"),
    [(1, 0.5, 2, 1), (1, 0.0, 2, 1), (2, 0.0, 3, 2), (2, 0.5, 2, 1)],
)
def test_manufactured_solution(order, uneven, l2_rate, h1_rate):
    """u = cos kx cos ky, sigma = 1 + uneven sin kx sin ky.  Linear elements gain orders 2 and 1;
    quadratic ones 3 and 2 on an even sheet, but where sigma varies it is constant by element, which
    holds them back to 2 and 1 (with far smaller errors)."""
    (l2, h1), (l2_fine, h1_fine) = _errors(16, order, uneven), _errors(32, order, uneven)
    assert np.log2(l2 / l2_fine) > l2_rate - 0.1
    assert np.log2(h1 / h1_fine) > h1_rate - 0.1


@pytest.mark.slow
def test_the_jacobian_predicts_a_small_change():
    """The remainder after the linear term falls with the square of the change."""
    model = disc_model(0.1, 0.12, pattern=je.skin.adjacent(16))
    bump = jnp.exp(-jnp.sum((model.centroids - jnp.array([0.3, 0.2])) ** 2, 1) / 0.1)
    j, v0 = je.jacobian(model), je.forward(model)
    rest = [
        float(
            jnp.abs(je.forward(model, model.background * (1 + t * bump)) - v0 - j @ (t * model.background * bump)).max()
        )
        for t in (0.02, 0.01)
    ]
    assert np.log2(rest[0] / rest[1]) == pytest.approx(2.0, abs=0.05)
