"""Least squares in fixed shapes, as solvers of optimistix, whose loop is the only one.

`LevenbergMarquardt` within bounds for curves, contacts and absolute images; `DualNewton` and `InteriorPoint` for
quadratic problems of hundreds of parameters that are nowhere negative.

Example:
    import jax
    import jax.numpy as jnp
    import optimistix as optx

    from jaxeit import least_squares as ls

    jax.config.update("jax_enable_x64", True)

    pressure = jnp.linspace(0.0, 5.0, 40)  # kPa
    force = 1.6 * pressure**1.1  # N


    def residual(x, force):  # of a power law, N
        return x[0] * pressure ** x[1] - force


    fit = optx.least_squares(
        residual,
        ls.LevenbergMarquardt(rtol=1e-8, atol=1e-8, search=ls.DampingSearch(first=1e-2)),
        jnp.ones(2),
        args=force,
        options={"lower": jnp.array([0.0, 0.5]), "upper": jnp.array([9.0, 2.0])},
        adjoint=ls.ImplicitStep(),
    )
    print(fit.value, fit.state.square)  # exponent and factor; what is left, N^2
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
