"""Open the file of a tank by its format, or by its name and content."""

from collections.abc import Sequence
from pathlib import Path

import jaxeit as je
from jaxeit.geometry import Domain
from jaxeit.skin import AbstractElectrode

from .archives import archive_tank, read_archive
from .described import described_tank
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
        skin: shape, electrodes and scan of the tank, for readings alone: an .npz or .npy of arrays (frames, readings),
            a table .csv with a frame in each row or column, and a .mat without a model, whose arrays of as many rows
            as the scan has readings are the frames; in place of ``domain`` and ``rim``.

    Raises:
        TankError, OSError: naming the file and what is wrong with it.
    """
    path = Path(path)
    if not path.exists():
        raise TankError(f"{path}: does not exist; check the name and the folder")
    if skin is not None:
        if not isinstance(skin, je.Skin):
            raise TankError(f'{type(skin).__name__} is not a skin; make one, such as jaxeit.load_skin("tank.toml")')
        return described_tank(path, skin)
    if path.is_dir():
        if not (frames := sorted(path.glob("*.eit"))):
            raise TankError(f"{path}: is a folder without .eit files; give a file, or a folder of Sciospec's files")
        return load_sciospec(frames, domain, rim)
    kind = path.suffix.lower()
    if kind == ".mat":
        variables = read_matlab(path)
        return ktc_tank(path, variables) if is_ktc(variables) else eidors_tank(path, variables)
    if kind == ".eit" and not is_instrument(path):
        return load_sciospec([path], domain, rim)
    readers = {".csv": load_pyeidors, ".npz": load_npz, ".get": load_instrument, ".eit": load_instrument}
    if kind not in readers:
        sessions = "jaxeit apply makes maps of a session"
        raise TankError(f"{path.name}: is no file of a tank; give .mat, .csv, .eit, .get or .npz; {sessions}")
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

    Example:
        tank = calib.tanks.load_eidors("model.mat")  # imdl, vh and vi, as saved by EIDORS
        print(tank.names, tank.frames.shape, tank.mesh is not None)
    """
    path = Path(path)
    return eidors_tank(path, read_matlab(path), protocol)


def load_ktc(path: str | Path) -> Tank:
    """A frame of the Kuopio Tomography Challenge 2023, after the ``ref.mat`` beside it; currents of each drive its own.

    Raises:
        TankError: for a file without Inj, Mpat and Uel.

    Example:
        tank = calib.tanks.load_ktc("data1.mat")  # ref.mat lies beside it
        print(tank.names, tank.skin.protocol.readings)
    """
    path = Path(path)
    return ktc_tank(path, read_matlab(path))


def load_pyeidors(path: str | Path, domain: Domain | None = None, rim: Rim | None = None) -> Tank:
    """A CSV table of PyEIDORS: one row a reading, real and imaginary part of each frame, adjacent rotating order.

    Arguments as for `load_tank`.

    Example:
        tank = calib.tanks.load_pyeidors("table.csv", je.Disc(0.03))
        print(tank.frames.shape, tank.quadrature.shape)
    """
    return pyeidors_tank(Path(path), domain, rim)


def load_sciospec(paths: Sequence[str | Path], domain: Domain | None = None, rim: Rim | None = None) -> Tank:
    """Text files of Sciospec's software, a frame each; readings are of neighbouring channels that do not drive.

    Arguments as for `load_tank`.

    Example:
        from pathlib import Path

        tank = calib.tanks.load_sciospec(sorted(Path("sciospec").glob("*.eit")), je.Disc(0.03))
        print(tank.names, tank.skin.protocol.frequency)  # Hz
    """
    return sciospec_tank([Path(path) for path in paths], domain, rim)


def load_instrument(path: str | Path, domain: Domain | None = None, rim: Rim | None = None) -> Tank:
    """A binary file of an instrument for the chest: .get of GOE-MF II or Draeger, .eit of CareFusion or Draeger.

    16 electrodes, adjacent readings. No format is documented: the unit of readings is not known, so that the level of
    the conductivity has no meaning. Arguments as for `load_tank`.

    Raises:
        TankError: for a file that was cut short, of an unknown version, or without frames.

    Example:
        tank = calib.tanks.load_instrument("chest.get", je.Disc(0.15))
        print(tank.frames.shape)
    """
    path = Path(path)
    if path.suffix.lower() != ".get" and not is_instrument(path):
        raise TankError(f"{path.name}: does not begin like a file of CareFusion or Draeger")
    return instrument_tank(path, domain, rim)


def load_npz(path: str | Path, domain: Domain | None = None, rim: Rim | None = None) -> Tank:
    """NumPy arrays: ``frames`` (frames, readings) V, with ``pattern`` (readings, 4) and ``amplitude`` A, or with
    ``current`` (electrodes, drives) A and ``measurement`` (electrodes, senses) as for `Protocol.from_matrices`.

    Arguments as for `load_tank`.

    Example:
        tank = calib.tanks.load_npz("tank.npz", disc)
        print(tank.names, tank.frames.shape, tank.skin.protocol.readings)
    """
    path = Path(path)
    arrays = read_archive(path)
    if "frames" not in arrays or not (
        {"pattern", "amplitude"} <= set(arrays) or {"current", "measurement"} <= set(arrays)
    ):
        raise TankError(
            f"{path.name}: holds {sorted(arrays)}; save frames with pattern and amplitude, or with current and "
            "measurement; frames alone need a skin's TOML, as --skin TANK.toml"
        )
    try:
        if "pattern" in arrays:
            protocol = je.Protocol(arrays["pattern"], float(arrays["amplitude"]))
            electrodes = int(protocol.pattern.max()) + 1 if rim is None else len(rim)
        else:
            protocol = je.Protocol.from_matrices(arrays["current"], arrays["measurement"])
            electrodes = len(arrays["current"])
    except (ValueError, TypeError) as error:
        names = "pattern and amplitude" if "pattern" in arrays else "current and measurement"
        raise TankError(f"{path.name}: {names}: {error}") from None
    return archive_tank(tank_of(path.stem, protocol, electrodes, domain, rim), arrays["frames"])
