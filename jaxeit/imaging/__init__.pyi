"""Names of `jaxeit.imaging` and their modules, from which `__init__.py` imports them on first use."""

from .absolute import (
    AbsoluteImage as AbsoluteImage,
    AbstractPenalty as AbstractPenalty,
    ElectrodeFit as ElectrodeFit,
    ElectrodeFitSettings as ElectrodeFitSettings,
    ImageFit as ImageFit,
    IsotropicVariation as IsotropicVariation,
    KnownPresses as KnownPresses,
    LogConductivity as LogConductivity,
    Misplacement as Misplacement,
    Quadratic as Quadratic,
    ReferenceFit as ReferenceFit,
    ReferenceParameters as ReferenceParameters,
    ReferenceSettings as ReferenceSettings,
    absolute_image as absolute_image,
    find_misplacement as find_misplacement,
    fit_background as fit_background,
    fit_electrodes as fit_electrodes,
    fit_reference as fit_reference,
    gauss_newton as gauss_newton,
    gauss_newton_fit as gauss_newton_fit,
    least_squares_image as least_squares_image,
)
from .hyperparameters import (
    HYPERPARAMETERS as HYPERPARAMETERS,
    AbstractFrameChoice as AbstractFrameChoice,
    AbstractHyperparameter as AbstractHyperparameter,
    Discrepancy as Discrepancy,
    GeneralisedCrossValidation as GeneralisedCrossValidation,
    HyperparameterError as HyperparameterError,
    LCurve as LCurve,
    NoiseFigure as NoiseFigure,
    PriorDeviation as PriorDeviation,
)
from .inputs import ConvergenceError as ConvergenceError, InverseError as InverseError
from .level_set import LevelSet as LevelSet
from .methods import (
    METHODS as METHODS,
    AbstractIterativeMethod as AbstractIterativeMethod,
    AbstractLinearMethod as AbstractLinearMethod,
    AbstractMethod as AbstractMethod,
    BackProjection as BackProjection,
    Greit as Greit,
    NonNegative as NonNegative,
    OneStep as OneStep,
    Problem as Problem,
    Reweighted as Reweighted,
    SparseBayes as SparseBayes,
    TruncatedSvd as TruncatedSvd,
)
from .preparation import prepare as prepare
from .priors import (
    PRIORS as PRIORS,
    AbstractPrecision as AbstractPrecision,
    AbstractPrior as AbstractPrior,
    Covariance as Covariance,
    Diagonal as Diagonal,
    GaussianSmooth as GaussianSmooth,
    Laplace as Laplace,
    Noser as Noser,
    Precision as Precision,
    Tikhonov as Tikhonov,
    TotalVariation as TotalVariation,
)
from .readings.measured_noise import (
    NOISES as NOISES,
    AbstractNoise as AbstractNoise,
    CorrelatedNoise as CorrelatedNoise,
    EqualNoise as EqualNoise,
    MeasuredNoise as MeasuredNoise,
)
from .readings.noise import noise_covariance as noise_covariance
from .reconstruction import (
    AbstractReconstructor as AbstractReconstructor,
    IterativeReconstructor as IterativeReconstructor,
    Provenance as Provenance,
    Reconstructor as Reconstructor,
)
from .segmentation import (
    ChangeErrors as ChangeErrors,
    RegionSettings as RegionSettings,
    Segmentation as Segmentation,
    half_height_classes as half_height_classes,
    on_grid as on_grid,
    segment as segment,
)
from .settings import Imaging as Imaging
from .storage import (
    NUMBERS as NUMBERS,
    StorageError as StorageError,
    from_numbers as from_numbers,
    load_reconstructor as load_reconstructor,
    save_reconstructor as save_reconstructor,
    to_numbers as to_numbers,
)
