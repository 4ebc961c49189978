"""The calibration of a skin: the numbers that turn its frames and pressures into newtons, and their file."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

import jaxeit as je
from jaxeit.messages.kinds import require_unmasked
from jaxeit.notebook import card
from jaxeit.tracking import ContactLaw, LearnedLayer

from ..fitting.cross_validation.selection import Candidate
from ..fitting.curves import FittedCurve
from ..fitting.fields import FittedField, Places
from ..fitting.intervals import NoiseLaw
from ..fitting.pad_gains import PadGains
from ..fitting.pads import PadModel
from ..presses.crosstalk import Crosstalk
from ..presses.table import Processing
from ..session import SessionError, read_archive, write_archive
from .archives.provenance import recorded_processing, recorded_recipe
from .archives.storage import fields_from_archive, to_archive
from .evaluation import Evaluation
from .hysteresis_loops import Loops
from .localisation.electrode_places import PlacedElectrodes
from .localisation.locators import AbstractLocator, locate
from .press_examples import PressExamples
from .recalibration.changes import Recalibration
from .recipes.recipe import Recipe

FORMAT = "skin-calibration"


@dataclass(frozen=True, eq=False)
class Calibration:
    """Everything needed to turn frames and pressures into force maps, with its provenance.

    | meaning                                                                  |
    |--------------------------------------------------------------------------|
    | skin: the hardware                                                       |
    | recon: frames to images, by a matrix or by an iterative method           |
    | masks: which pad carries which pixel                                     |
    | curves: the fitted pressure-force curve of each pad, with covariance     |
    | evaluation: results on the fitted presses, forces held out by location   |
    | provenance: sessions, their hashes, versions, recipe, date               |
    | simulated: whether any of the sessions was simulated                     |
    | notes: remarks for the reader of the results                             |
    | field: gain as a function of the place pressed; None: no such correction |
    | crosstalk: between the pads                                              |
    | noise: deviation of means over parts of presses about the model of the   |
    |   pads                                                                   |
    | hold_noise: deviation of means over the holds of presses about it        |
    | locator: estimates the place of a contact from a frame; None: no field   |
    | baseline: the paper's curves, one slope per pad, for comparison          |
    | image_gain: force over the integral of the image, N / (S m^2), likewise  |
    | loops: one complete press of each pad, loading and unloading             |
    | examples: a few presses as they were read                                |
    | probes: presses all over the sheet, likewise                             |
    | tried: candidate curves and fields, with their held-out errors           |
    | rest: gage pressure of the pads without contact, (pads,) Pa              |
    | recalibration: how pads have moved since; None: never recalibrated       |
    | layer: gain of the contact layer, by which contacts are followed and     |
    |   loads are fitted; None: not learned (`learn_layer`)                    |
    | contact_law: by which readings tell a contact's force where no pad does; |
    |   None: not learned (`learn_layer`)                                      |
    | sensor: deviation of single readings of the pads at rest, (pads,) Pa;    |
    |   None: not known                                                        |
    | electrodes: how far they sit from where the skin's file said; None:      |
    |   taken from the file                                                    |

    Example:
        force, error, valid = mine.pad_forces(dp[strongest : strongest + 1])  # N, N: without images
        print(force, error, valid, mine.skin.name, mine.simulated)
        places = mine.locate(dv[strongest : strongest + 1])  # None without a correction by location
        mine.save("copy.h5")
    """

    skin: je.Skin
    recon: je.Reconstructor | je.imaging.IterativeReconstructor
    masks: je.fusion.PadMasks
    curves: FittedCurve
    evaluation: Evaluation
    provenance: dict[str, str]
    simulated: bool
    notes: tuple[str, ...] = ()
    field: FittedField | None = None
    crosstalk: Crosstalk | None = None
    noise: NoiseLaw | None = None
    hold_noise: NoiseLaw | None = None
    locator: AbstractLocator | None = None
    baseline: FittedCurve | None = None
    image_gain: float = float("nan")
    loops: Loops | None = None
    tried: tuple[Candidate, ...] = ()
    examples: PressExamples | None = None
    probes: PressExamples | None = None
    rest: np.ndarray | None = None
    recalibration: Recalibration | None = None
    layer: LearnedLayer | None = None
    contact_law: ContactLaw | None = None
    electrodes: PlacedElectrodes | None = None
    sensor: np.ndarray | None = None

    @cached_property
    def pads(self) -> PadModel:
        """The model of the pads: curves, field, crosstalk, noise and gains."""
        mixed = self.crosstalk is not None and self.crosstalk.present
        matrix = jnp.asarray(self.crosstalk.matrix, self.dtype) if self.crosstalk is not None and mixed else None
        sensor = None if self.sensor is None else jnp.asarray(self.sensor, self.dtype)
        return PadModel(self.curves, self.field, matrix, self.noise, self.hold_noise, self.gains, sensor)

    @property
    def gains(self) -> PadGains | None:
        """Gains by which pads have moved since the calibration; None: never recalibrated."""
        return None if self.recalibration is None else self.recalibration.gains

    @property
    def recipe(self) -> Recipe | None:
        """The recipe of this calibration; None for a file of an early version, which kept no recipe.

        Raises:
            ValueError: if the recipe names a class that is not installed.
        """
        return recorded_recipe(self.provenance)

    @property
    def processing(self) -> Processing:
        """How the sessions were cut into presses and corrected; process sessions to evaluate or map alike."""
        return recorded_processing(self.provenance)

    def own_pressures(self, pressures: ArrayLike) -> np.ndarray:
        """The pads' own pressures (n, pads) Pa, without crosstalk, from readings of the pads (n, pads) Pa.

        Raises:
            ValueError: if the readings are not those of so many pads.
        """
        return np.asarray(self.pads.own(jnp.asarray(self.pad_rows(pressures), self.dtype)))

    def pad_rows(self, pressures: ArrayLike, name: str = "pressures") -> np.ndarray:
        """Readings of the pads as rows (n, pads) Pa; those of one time may be (pads,).

        Raises:
            ValueError: if the readings are not those of so many pads, or not real numbers.
        """
        rows, pads = real_rows(pressures, name), len(self.skin.pads)
        if rows.shape[1:] != (pads,):
            raise ValueError(f"{name} {rows.shape} do not fit this calibration: give (n, {pads}) Pa")
        return rows

    def pad_forces(
        self, pressures: ArrayLike, places: Places | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force on each pad, its standard error (N) and validity from readings of the pads (n, pads) Pa.

        A correction by location uses `places` (from `locate`). Without them the gain is 1, and the standard error
        includes the uncertainty of the gain. The standard error is that of one reading: of the model, and of the noise
        about it. It leaves out what no press of the calibration showed, such as another tip or a drift since. A force
        is not valid outside the calibrated range of pressure or after a failed fit.

        Raises:
            ValueError: if the readings are not those of so many pads.
        """
        return self.pads.pad_forces(self.pad_rows(pressures), places)

    def locate(self, frames: ArrayLike, image: Array | None = None, *, single: bool = False) -> Places | None:
        """Places of the contacts in difference frames (n, readings) V; None without a correction by location.

        Args:
            image: images (n, pixels) S of the frames, if they are known; otherwise they are computed.
            single: whether each frame holds exactly one contact, as presses on a bench do.
        """
        if self.locator is None:
            return None
        return locate(self.locator.single() if single else self.locator, frames, self.recon, self.masks, image)

    @property
    def dtype(self) -> np.dtype:
        """Precision of the fitted curves."""
        return self.curves.parameters.dtype

    def __repr__(self) -> str:
        found = self.evaluation
        error = f"{found.held_out}, RMSE {self._force_error}"
        return f"Calibration({self.skin.name!r}, {len(found.force)} presses, {found.recipe!r}, {error})"

    @property
    def _force_error(self) -> str:
        error = self.evaluation.total_force - self.evaluation.force
        return f"{np.sqrt(np.nanmean(error**2)):.3g} N"

    def _repr_html_(self) -> str:
        found = self.evaluation
        places = found.estimated.get("fitted", found.estimated.get("half"))
        sessions = [line.split("  ")[-1] for line in self.provenance.get("sessions", "").splitlines()]
        rows = [
            ("sessions", ", ".join(sessions)),
            ("presses", f"{len(found.force)}" + (", simulated" if self.simulated else "")),
            ("curve, location", found.recipe),
            (f"error of force, {found.held_out}", f"{self._force_error}, RMSE"),
        ]
        if places is not None:
            distance = np.linalg.norm(places - found.position, axis=1)
            rows.append(("error of place, mean", f"{1e3 * np.nanmean(distance):.3g} mm"))
        if self.recalibration is not None:
            rows.append(("recalibrated", "yes"))
        if self.layer is not None:
            rows.append(("gain of the contact layer", f"learned from {self.layer.contacts} contacts"))
        if self.contact_law is not None:
            rows.append(("force without pads", self.contact_law.render()))
        rows += [("note", note) for note in self.notes]
        drawing = self.skin.drawing
        drawing.crosses(found.position)
        return card(
            f"Calibration of {self.skin.name}", rows, drawing.svg(f"Sheet and {len(found.force)} places pressed")
        )

    def save(self, path: str | Path) -> None:
        """Write the calibration, whole or not at all, as HDF5 in the format skin-calibration.

        The file is sealed: `load_calibration` refuses one whose numbers were changed.

        Raises:
            OSError: if the file cannot be written.
        """
        write_archive(path, FORMAT, *to_archive(self))


def real_rows(values: ArrayLike, name: str) -> np.ndarray:
    """Rows of real numbers, of which one may stand by itself; ValueError for complex, masked and no numbers."""
    require_unmasked({name: values}, ValueError)
    rows = np.atleast_2d(values)
    if rows.dtype.kind not in "iufb":
        part = f"; of complex {name} give the real part" if rows.dtype.kind == "c" else ""
        raise ValueError(f"{name} hold {rows.dtype}: give real numbers{part}")
    return rows


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration that `Calibration.save` wrote.

    Raises:
        SessionError: if the file is damaged or of another kind.
    """
    archive = read_archive(path, FORMAT)
    try:
        return Calibration(**fields_from_archive(archive))
    except (KeyError, IndexError) as error:
        raise SessionError(
            f"{Path(path).name}: {error.args[0]}: missing from the calibration; calibrate again"
        ) from None
    except je.imaging.StorageError as error:
        raise SessionError(f"{Path(path).name}: image/{error}; calibrate again") from None
    except (je.registry.RegistryError, je.toml.TomlError) as error:  # a class or a text that cannot be used
        raise SessionError(f"{Path(path).name}: {' '.join(str(error).split())}") from None
    except (ValueError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        why = " ".join(str(error).split())[:200]
        raise SessionError(f"{Path(path).name}: its numbers do not fit each other ({why}); calibrate again") from None
