"""Names of `jaxeit` and their modules, from which `__init__.py` imports them on first use."""

from . import (
    accuracy as accuracy,
    contacts as contacts,
    effects as effects,
    fusion as fusion,
    geometry as geometry,
    imaging as imaging,
    least_squares as least_squares,
    linalg as linalg,
    meshing as meshing,
    metrics as metrics,
    model as model,
    plot as plot,
    registry as registry,
    scan as scan,
    skin as skin,
    toml as toml,
    tracking as tracking,
)
from ._compile import (
    bind as bind,
    compiler_options as compiler_options,
    limit_blas_threads as limit_blas_threads,
    reuse_memory as reuse_memory,
    verb as verb,
)
from .accuracy import ladder as ladder
from .batches import bind_many as bind_many
from .budget import Budget as Budget, BudgetError as BudgetError
from .contacts import (
    prepare_contacts as prepare_contacts,
)
from .fusion import fuse as fuse, pad_masks as pad_masks
from .geometry import Cylinder as Cylinder, Disc as Disc, Polygon as Polygon, Rectangle as Rectangle, Sphere as Sphere
from .imaging import (
    AbstractPrior as AbstractPrior,
    GaussianSmooth as GaussianSmooth,
    Greit as Greit,
    Imaging as Imaging,
    Laplace as Laplace,
    NoiseFigure as NoiseFigure,
    NonNegative as NonNegative,
    Noser as Noser,
    OneStep as OneStep,
    Reconstructor as Reconstructor,
    Reweighted as Reweighted,
    SparseBayes as SparseBayes,
    Tikhonov as Tikhonov,
    TotalVariation as TotalVariation,
    TruncatedSvd as TruncatedSvd,
    fit_background as fit_background,
    gauss_newton as gauss_newton,
    load_reconstructor as load_reconstructor,
    prepare as prepare,
    save_reconstructor as save_reconstructor,
)
from .metrics import LevelCentroid as LevelCentroid, localisation_error as localisation_error
from .model import (
    Bumps as Bumps,
    Elements as Elements,
    Fidelity as Fidelity,
    Model as Model,
    Pixels as Pixels,
    Scene as Scene,
    conductivity as conductivity,
    discretise as discretise,
    forward as forward,
    jacobian as jacobian,
    pad_response as pad_response,
)
from .program_cache import cache_programs as cache_programs
from .skin import (
    AreaPatch as AreaPatch,
    BoundaryPatch as BoundaryPatch,
    Pad as Pad,
    PointElectrode as PointElectrode,
    PolygonPatch as PolygonPatch,
    Protocol as Protocol,
    Skin as Skin,
    load_skin as load_skin,
)

__version__: str
