"""Names of `jaxeit.least_squares` and their modules, from which `__init__.py` imports them on first use."""

from . import non_negative as non_negative
from .adjoint import ImplicitStep as ImplicitStep
from .levenberg_marquardt import LeastSquaresState as LeastSquaresState, LevenbergMarquardt as LevenbergMarquardt
from .non_negative import (
    DenseProblem as DenseProblem,
    DiagonalProblem as DiagonalProblem,
    DualNewton as DualNewton,
    InteriorPoint as InteriorPoint,
)
from .searches import (
    BoundedDescent as BoundedDescent,
    Cholesky as Cholesky,
    DampingSearch as DampingSearch,
    normal_equations as normal_equations,
    quadratic as quadratic,
)
