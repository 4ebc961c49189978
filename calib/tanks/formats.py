"""Open the file of a tank by its format, or by its name and content."""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxeit as je
from jaxeit.files import open_regular
from jaxeit.geometry import Domain
from jaxeit.skin import AbstractElectrode

from .instruments import instrument_tank, is_instrument
from .matlab import eidors_tank, is_ktc, ktc_tank, read_matlab
from .recording import Tank, TankError, tank_of
from .texts import pyeidors_tank, sciospec_tank

Rim = Sequence[AbstractElectrode]


def load_tank(
    path: str | Path, domain: Domain | None = None, rim: Rim | None = None, *, skin: je.Skin | None = None
) -> Tank:
    """A tank and its frames, from any file that this room reads.

    Args:
        path: .mat (EIDORS or the Kuopio challenge), .csv (PyEIDORS), .eit (Sciospec, CareFusion, Draeger), .get
            (GOE-MF II, Draeger), .npz, or a folder of .eit files of Sciospec.
        domain: shape of the tank, where the file has none (all but .mat), such as ``je.Disc(0.03)``.
        rim: its electrodes; default: `je.skin.rim_electrodes`, electrode 0 at +x, counter-clockwise.
        skin: shape, electrodes and scan of the tank, for an .npz of ``frames`` alone; in place of ``domain`` and
            ``rim``.

    Raises:
        TankError, OSError: naming the file and what is wrong with it.
    """
    path = Path(path)
    if not path.exists():
        raise TankError(f"{path}: does not exist; check the name and the folder")
    if skin is not None:
        return _frames_of(skin, path)
    if path.is_dir():
        return load_sciospec(sorted(path.glob("*.eit")), domain, rim)
    kind = path.suffix.lower()
    if kind == ".mat":
        variables = read_matlab(path)
        return ktc_tank(path, variables) if is_ktc(variables) else eidors_tank(path, variables)
    if kind == ".eit" and not is_instrument(path):
        return load_sciospec([path], domain, rim)
    readers = {".csv": load_pyeidors, ".npz": load_npz, ".get": load_instrument, ".eit": load_instrument}
    if kind not in readers:
        raise TankError(f"{path.name}: is no file of a tank by its name; give .mat, .csv, .eit, .get or .npz")
    return readers[kind](path, domain, rim)


def load_eidors(path: str | Path, protocol: je.Protocol | None = None) -> Tank:
    """A MATLAB file with a forward model of EIDORS (``fmdl``, ``img`` or ``imdl``) and frames (``vh``, ``vi``).

    The model is taken with its mesh, electrodes (points, or complete ones along the outer rim), contact impedances and
    stimulation. Every variable that is an array or a data structure of as many readings is a frame.

    Args:
        path: of the file.
        protocol: in place of the stimulation of the file, which may have none.

    Raises:
        TankError: for a volume, or electrodes inside the mesh.
    """
    path = Path(path)
    return eidors_tank(path, read_matlab(path), protocol)


def load_ktc(path: str | Path) -> Tank:
    """A frame of the Kuopio Tomography Challenge 2023, after the ``ref.mat`` beside it; currents of each drive its own.

    Raises:
        TankError: for a file without Inj, Mpat and Uel.
    """
    path = Path(path)
    return ktc_tank(path, read_matlab(path))


def load_pyeidors(path: str | Path, domain: Domain | None = None, rim: Rim | None = None) -> Tank:
    """A CSV table of PyEIDORS: one row a reading, real and imaginary part of each frame, adjacent rotating order.

    Arguments as for `load_tank`.
    """
    return pyeidors_tank(Path(path), domain, rim)


def load_sciospec(paths: Sequence[str | Path], domain: Domain | None = None, rim: Rim | None = None) -> Tank:
    """Text files of Sciospec's software, a frame each; readings are of neighbouring channels that do not drive.

    Arguments as for `load_tank`.
    """
    return sciospec_tank([Path(path) for path in paths], domain, rim)


def load_instrument(path: str | Path, domain: Domain | None = None, rim: Rim | None = None) -> Tank:
    """A binary file of an instrument for the chest: .get of GOE-MF II or Draeger, .eit of CareFusion or Draeger.

    16 electrodes, adjacent readings. No format is documented: the unit of readings is not known, so that the level of
    the conductivity has no meaning. Arguments as for `load_tank`.

    Raises:
        TankError: for a file that was cut short, of an unknown version, or without frames.
    """
    path = Path(path)
    if path.suffix.lower() != ".get" and not is_instrument(path):
        raise TankError(f"{path.name}: does not begin like a file of CareFusion or Draeger")
    return instrument_tank(path, domain, rim)


def load_npz(path: str | Path, domain: Domain | None = None, rim: Rim | None = None) -> Tank:
    """NumPy arrays: ``frames`` (frames, readings) V, with ``pattern`` (readings, 4) and ``amplitude`` A, or with
    ``current`` (electrodes, drives) A and ``measurement`` (electrodes, senses) as for `Protocol.from_matrices`.

    Arguments as for `load_tank`.
    """
    path = Path(path)
    arrays = _npz(path)
    if "frames" not in arrays or not (
        {"pattern", "amplitude"} <= set(arrays) or {"current", "measurement"} <= set(arrays)
    ):
        raise TankError(
            f"{path.name}: holds {sorted(arrays)}; frames, and pattern and amplitude or current and measurement"
        )
    if "pattern" in arrays:
        protocol = je.Protocol(arrays["pattern"], float(arrays["amplitude"]))
        electrodes = int(protocol.pattern.max()) + 1 if rim is None else len(rim)
    else:
        protocol = je.Protocol.from_matrices(arrays["current"], arrays["measurement"])
        electrodes = len(arrays["current"])
    return _tank(tank_of(path.stem, protocol, electrodes, domain, rim), arrays["frames"])


def _frames_of(skin: je.Skin, path: Path) -> Tank:
    """The frames of an .npz that holds nothing else, as readings of this skin."""
    arrays = _npz(path) if path.suffix.lower() == ".npz" else {}
    if set(arrays) != {"frames"}:
        raise TankError(
            f"{path.name}: a file of frames that a skin's TOML describes is an .npz with frames (frames, readings) V "
            "and nothing else; other files have a scan of their own: leave the skin out"
        )
    return _tank(skin, arrays["frames"])


def _tank(skin: je.Skin, frames: np.ndarray) -> Tank:
    frames = np.atleast_2d(frames)
    quadrature = frames.imag if np.iscomplexobj(frames) else None
    names = tuple(f"frame {k}" for k in range(len(frames)))
    return Tank(skin, frames.real.astype(float), names, quadrature)


def _npz(path: Path) -> dict[str, Any]:
    try:
        with open_regular(path) as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (ValueError, zipfile.BadZipFile, EOFError, KeyError) as error:
        raise TankError(f"{path.name}: cannot be read as a NumPy archive: {error}") from None
