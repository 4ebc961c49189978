"""The numbers of a calibration as its C header needs them.

The image is ``factor P^T W dv``, where P holds the current c times signs (see `jaxeit.imaging.readings.whitening`).
With the current taken out, ``t' = t / c``, ``factor' = c factor`` and ``T' = c^2 T``, the C program adds and subtracts
weighed readings.
"""

from typing import NamedTuple

import numpy as np

import jaxeit as je

from ...calibration import Calibration
from ...fitting.curves.fitted import RANGE_TOLERANCE
from ...fitting.results import FitResult
from ..errors import ExportError
from .curves import CurveInC, curve_in_c
from .fields import LocationInC, location_in_c

# Least part of a reading that the image of the others leaves open (`_open_part`): with less, single precision would
# lose more than two of its seven digits in the image of a frame without these readings.
LEAST_OPEN_PART = 1e-2


class Numbers(NamedTuple):
    """The tables of the header.

    | meaning                                                                          | shape           | unit  |
    |----------------------------------------------------------------------------------|-----------------|-------|
    | pairs: the four pair sums of each reading                                        | (readings, 4)   |       |
    | weight of each reading; 0: not used                                              | (readings,)     | 1/V^2 |
    | factor': image per weighted sum t'                                               | (pixels, k)     | S V   |
    | predict: lower triangle of T', row by row                                        | (k (k + 1) / 2,)| V^2   |
    | exact: whether weight and predict need double precision                          | ()              |       |
    | unmix: own pressures at the calibration per reading of a pad now                 | (pads, pads)    | 1     |
    | curve of the pads                                                                |                 |       |
    | range: lowest and highest pressure that count as calibrated                      | (pads, 2)       | Pa    |
    | mask_start: first entry of each pad in the next two                              | (pads + 1,)     |       |
    | mask_pixel, mask_area: pixels of each pad, and the area of their share           | (entries,)      | , m^2 |
    | location: correction by location; None: not exported                             |                 |       |
    """

    pairs: np.ndarray
    weight: np.ndarray
    factor: np.ndarray
    predict: np.ndarray
    exact: bool
    unmix: np.ndarray
    curve: CurveInC
    range: np.ndarray
    mask_start: np.ndarray
    mask_pixel: np.ndarray
    mask_area: np.ndarray
    location: LocationInC | None = None


def numbers_of(calibration: Calibration, *, without_location: bool = False) -> Numbers:
    """The tables of a calibration.

    Args:
        without_location: leave out the correction by location: its gain is then 1.

    Raises:
        ExportError: if a part of the calibration cannot be exported.
    """
    recon = _exportable(calibration.recon)
    pairs, weight = np.asarray(recon.whitening.pairs), np.asarray(recon.whitening.weight, float)
    current = float(recon.whitening.current)
    predict = current**2 * np.asarray(recon.predict, float)
    predict = (predict + predict.T) / 2
    located = calibration.field is not None and not without_location
    start, pixel, area = _masks(calibration.masks)
    return Numbers(
        pairs=pairs,
        weight=np.where(np.asarray(recon.channels), weight, 0.0),
        factor=current * np.asarray(recon.factor, float),
        predict=predict[np.tril_indices(len(predict))],
        exact=bool(_open_part(predict, pairs, weight).min() < LEAST_OPEN_PART),
        unmix=_unmix(calibration),
        curve=curve_in_c(calibration.curves),
        range=_range(calibration),
        mask_start=start,
        mask_pixel=pixel,
        mask_area=area,
        location=location_in_c(calibration) if located else None,
    )


def _exportable(recon: je.imaging.AbstractReconstructor) -> je.Reconstructor:
    """The reconstructor; raises ExportError for one that the header's functions cannot compute."""
    if not isinstance(recon, je.Reconstructor):
        raise ExportError(
            f"method {type(recon).__name__}: solves a problem for each frame, which cannot be exported; calibrate with "
            "a linear method, such as --method one-step"
        )
    if recon.whitening.weight.ndim == 2:
        raise ExportError(
            "noise: the covariance between readings needs tables of readings squared, which are not exported; "
            "calibrate with --noise equal or --noise measured"
        )
    if recon.whitening.shares is not None:
        raise ExportError(
            "protocol: readings of many electrodes, as of a trigonometric scan, and of amplifiers with a CommonMode "
            'are not exported; calibrate a skin with a scan of pairs, such as pattern = "adjacent"'
        )
    if max(recon.readings, recon.predict.shape[0], len(recon.areas)) > np.iinfo(np.uint16).max:
        raise ExportError("more than 65,535 readings, pairs of electrodes or pixels; calibrate with fewer --pixels")
    return recon


def _open_part(predict: np.ndarray, pairs: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Part of each reading that the image of the others leaves open where its reciprocal readings are missing too."""
    sign = np.array([1.0, -1.0, -1.0, 1.0])
    same = np.hstack([np.sort(pairs[:, [0, 3]]), np.sort(pairs[:, [1, 2]])])
    group = np.unique(same, axis=0, return_inverse=True)[1].ravel()
    block = predict[pairs[:, :, None], pairs[:, None, :]]
    part: np.ndarray = 1 - np.bincount(group, weight)[group] * np.einsum("i,rij,j->r", sign, block, sign)
    return part


def _unmix(calibration: Calibration) -> np.ndarray:
    """Own pressures at the calibration per pressure read now: first the gains, then the crosstalk."""
    pads = calibration.pads
    count = len(calibration.skin.pads)
    mixing = np.eye(count) if pads.crosstalk is None else np.asarray(pads.crosstalk, float)
    gain = np.ones(count) if pads.gains is None else np.exp(-np.asarray(pads.gains.log_gain, float))
    return np.linalg.solve(mixing, np.diag(gain))


def _range(calibration: Calibration) -> np.ndarray:
    """Calibrated pressures of each pad, (pads, 2) Pa; a pad whose fit failed has none."""
    low, high = np.asarray(calibration.curves.pressure_range, float).T
    margin = RANGE_TOLERANCE * (high - low)
    fitted = np.asarray(calibration.curves.result) == FitResult.SUCCESS
    return np.where(fitted[:, None], np.stack([low - margin, high + margin], 1), [1.0, -1.0])


def _masks(masks: je.fusion.PadMasks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The masks pad by pad, without the pixels beside the pad."""
    weights = np.asarray(masks.weights, float)
    pad, pixel = np.nonzero(weights)
    start = np.searchsorted(pad, np.arange(len(weights) + 1))
    return start, pixel, weights[pad, pixel] * np.asarray(masks.areas, float)[pixel]
