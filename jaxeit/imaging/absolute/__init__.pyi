"""Names of `jaxeit.imaging.absolute` and their modules, from which `__init__.py` imports them on first use."""

from .background import (
    UntouchedSheet as UntouchedSheet,
    fit_background as fit_background,
    fitted_sheet as fitted_sheet,
    untouched_sheet as untouched_sheet,
)
from .electrode_fit import (
    ElectrodeFit as ElectrodeFit,
    ElectrodeFitSettings as ElectrodeFitSettings,
    KnownPresses as KnownPresses,
    fit_electrodes as fit_electrodes,
)
from .images import (
    AbstractPenalty as AbstractPenalty,
    ImageFit as ImageFit,
    IsotropicVariation as IsotropicVariation,
    LogConductivity as LogConductivity,
    Quadratic as Quadratic,
    gauss_newton as gauss_newton,
    gauss_newton_fit as gauss_newton_fit,
    least_squares_image as least_squares_image,
)
from .misplacement import Misplacement as Misplacement, find_misplacement as find_misplacement
from .one_frame import AbsoluteImage as AbsoluteImage, absolute_image as absolute_image
from .reference import ReferenceFit as ReferenceFit, fit_reference as fit_reference
from .reference_unknowns import ReferenceParameters as ReferenceParameters, ReferenceSettings as ReferenceSettings
