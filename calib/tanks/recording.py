"""What every file of a tank becomes: a skin without pads, a mesh if the file has one, and frames in volts."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

import jaxeit as je
from jaxeit.geometry import Domain
from jaxeit.skin import AbstractElectrode

MOST_ACROSS = 10.0
"""Extent of a tank, m, beyond which lengths were given in another unit."""


class TankError(ValueError):
    """A file that is no recording of a tank, or frames that its model cannot explain.

    Example:
        try:
            calib.tanks.load_tank("tank.xyz", disc)
        except calib.tanks.TankError as error:
            print(error)
    """


@contextmanager
def named_errors(where: str) -> Iterator[None]:
    """Errors of what a file describes, such as currents that do not sum to zero, as a TankError that says where."""
    try:
        yield
    except TankError:
        raise
    except ValueError as error:
        raise TankError(f"{where}: {error}") from error


@dataclass(frozen=True, eq=False)
class Tank:
    """A tank and what was measured on it.

    | meaning                                                       | shape              | unit |
    |---------------------------------------------------------------|--------------------|------|
    | skin: shape, electrodes, protocol; 1 ohm per square unless the file says otherwise |  | |
    | frames, the reference first where the file tells              | (frames, readings) | V    |
    | names of the frames                                           | (frames,)          |      |
    | quadrature: imaginary part of the frames, where there is one  | (frames, readings) | V    |
    | mesh of the file, where there is one                          |                    |      |
    """

    skin: je.Skin
    frames: np.ndarray
    names: tuple[str, ...]
    quadrature: np.ndarray | None = None
    mesh: je.meshing.Mesh | None = None

    def __post_init__(self) -> None:
        readings = self.skin.protocol.readings
        if self.frames.ndim != 2 or self.frames.shape[1] != readings:
            turned = self.frames.ndim == 2 and len(self.frames) == readings
            raise TankError(
                f"{self.skin.name}: frames have shape {self.frames.shape}; the protocol has {readings} readings: "
                + ("transpose them, so that each row is a frame" if turned else f"give (frames, {readings})")
            )
        if len(self.frames) != len(self.names):
            raise TankError(
                f"{self.skin.name}: {len(self.frames)} frames have {len(self.names)} names; give one to each"
            )

    def model(self, fidelity: je.Fidelity | None = None, min_angle: float = 1.0) -> je.Model:
        """The tank with even content, on the mesh of the file if it has one; default fidelity: `Fidelity.draft`.

        Args:
            min_angle: smallest angle that the file's mesh may have, degrees.
        """
        fidelity = je.Fidelity.draft() if fidelity is None else fidelity
        return je.discretise(je.Scene(self.skin), fidelity, mesh=self.mesh, min_angle=min_angle)


def tank_of(
    name: str,
    protocol: je.Protocol,
    electrodes: int,
    domain: Domain | None,
    rim: Sequence[AbstractElectrode] | None,
) -> je.Skin:
    """The skin of a file that does not describe its tank: electrodes around the rim unless the caller has placed them.

    Raises:
        TankError: if the caller gives no shape, one in another unit than metres, or another number of electrodes.
    """
    if domain is None:
        raise TankError(
            f"{name}: the file does not tell the shape of the tank; give domain=, such as je.Disc(0.1), or --radius"
        )
    across = domain.perimeter / np.pi
    if across > MOST_ACROSS:
        raise TankError(
            f"{name}: the tank would be {across:.3g} m across, and no tank is more than {MOST_ACROSS:g} m; give "
            f"metres, such as --radius {5e-4 * across:.3g} for {across / 2:.3g} mm"
        )
    rim = je.skin.rim_electrodes(domain, electrodes) if rim is None else rim
    if len(rim) != electrodes:
        raise TankError(f"{name}: is of {electrodes} electrodes, and rim= has {len(rim)}")
    return je.Skin(name, domain, 1.0, tuple(rim), protocol)
