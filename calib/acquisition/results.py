"""What one frame says, for people and for programs."""

import base64
import json
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Touches:
    """Contacts fitted to a frame.

    | meaning                                                              | shape     | unit |
    |----------------------------------------------------------------------|-----------|------|
    | position                                                             | (k, 2)    | m    |
    | covariance of the position                                           | (k, 2, 2) | m^2  |
    | sure: a round contact; of others the covariance is a guess           | (k,)      |      |
    | age: frames since the one they were fitted to; None: never looked for | ()       |      |
    """

    position: np.ndarray
    covariance: np.ndarray
    sure: np.ndarray
    age: int | None = None

    def plain(self) -> list[dict[str, object]]:
        """For JSON, each with the standard error of x and y."""
        return [
            {
                "position": _plain(position),
                "standard_error": _plain(np.sqrt(np.diag(covariance))),
                "covariance": [_plain(row) for row in covariance],
                "sure": bool(sure),
            }
            for position, covariance, sure in zip(self.position, self.covariance, self.sure, strict=True)
        ]


NO_TOUCHES = Touches(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, bool))


@dataclass(frozen=True, eq=False)
class Result:
    """What one frame says.

    | meaning                                                            | shape    | unit |
    |--------------------------------------------------------------------|----------|------|
    | number of the frame among those worked on                          | ()       |      |
    | host: when it arrived, on the clock that is never set              | ()       | ns   |
    | latency from arrival to this result                                | ()       | s    |
    | force on each pad and its standard_error; NaN without pressure     | (pads,)  | N    |
    | valid: pressure within the calibrated range                        | (pads,)  |      |
    | centre of the force on each pad that is touched, else NaN          | (pads, 2)| m    |
    | map: force on each pixel; it sums to the pads' forces              | (pixels,)| N    |
    | image: change of sheet conductivity that the map comes from        | (pixels,)| S    |
    | missing: readings that were not finite, and are left out           | ()       |      |
    | dropped: frames not worked on so far                               | ()       |      |
    | touches: contacts, of a calibration that fits them                 |          |      |
    | unsearched: frames so far whose contacts there was no time to fit  | ()       |      |
    """

    number: int
    host: int
    latency: float
    force: np.ndarray
    standard_error: np.ndarray
    valid: np.ndarray
    centre: np.ndarray
    map: np.ndarray
    image: np.ndarray
    missing: int
    dropped: int
    touches: Touches = NO_TOUCHES
    unsearched: int = 0

    def to_json(self, *, image: bool = False) -> str:
        """One line for other programs; ``image`` adds map and image as base64 of little-endian f4."""
        out: dict[str, object] = {
            "number": self.number,
            "host_ns": self.host,
            "latency_ms": round(1e3 * self.latency, 3),
            "force": _plain(self.force),
            "standard_error": _plain(self.standard_error),
            "valid": self.valid.tolist(),
            "centre": [_plain(row) for row in self.centre],
            "missing": self.missing,
            "dropped": self.dropped,
            "contacts": self.touches.plain(),
            "contacts_age": self.touches.age,
            "unsearched": self.unsearched,
        }
        if image:
            out |= {name: base64.b64encode(getattr(self, name).astype("<f4")).decode() for name in ("map", "image")}
        return json.dumps(out, allow_nan=False)


def _plain(values: np.ndarray) -> list[float | None]:
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in values]
