"""Results of one frame: forces, force map, image and fitted contacts of a skin; the force of a sensor without EIT."""

import base64
import json
from dataclasses import dataclass, field

import numpy as np

from jaxeit.contacts import LoadKind


@dataclass(frozen=True, eq=False)
class TouchEstimates:
    """Contacts fitted to a frame, or followed to it.

    | field       | meaning                                                              | shape     | unit |
    |-------------|----------------------------------------------------------------------|-----------|------|
    | position    | of the contact; of an edge, its middle                               | (k, 2)    | m    |
    | covariance  | of the position                                                      | (k, 2, 2) | m^2  |
    | sure        | whether the fit converged; otherwise the covariance is a guess       | (k,)      |      |
    | age         | frames since the one of the fit; None if contacts were never fitted  | ()        |      |
    | number      | of the contact, which it keeps while it is followed; None: not followed | (k,)   |      |
    | force       | of a contact that is followed                                        | (k,)      | N    |
    | force_error | standard error of the force                                          | (k,)      | N    |
    | half        | from the middle of an edge to its end; zero for other contacts       | (k, 2)    | m    |
    """

    position: np.ndarray
    covariance: np.ndarray
    sure: np.ndarray
    age: int | None = None
    number: np.ndarray | None = None
    force: np.ndarray = field(default_factory=lambda: np.zeros(0))
    force_error: np.ndarray = field(default_factory=lambda: np.zeros(0))
    half: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))

    def to_list(self) -> list[dict[str, object]]:
        """The contacts as values for JSON, each with the standard errors of x and y."""
        found: list[dict[str, object]] = [
            {
                "position": _json_numbers(position),
                "standard_error": _json_numbers(np.sqrt(np.diag(covariance))),
                "covariance": [_json_numbers(row) for row in covariance],
                "sure": bool(sure),
            }
            for position, covariance, sure in zip(self.position, self.covariance, self.sure, strict=True)
        ]
        if self.number is None:
            return found
        follow = zip(self.number, self.force, self.force_error, self.half, strict=True)
        return [
            one
            | {"number": int(number), "half": _json_numbers(half)}
            | dict(zip(("force", "force_error"), _json_numbers(np.array([force, error])), strict=True))
            for one, (number, force, error, half) in zip(found, follow, strict=True)
        ]


NO_TOUCHES = TouchEstimates(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, bool))


@dataclass(frozen=True, eq=False)
class KindEstimate:
    """What touches the skin in a frame, by a network that was trained for the skin.

    | field       | meaning                                                       | shape |
    |-------------|---------------------------------------------------------------|-------|
    | probability | of each kind, in the order of `jaxeit.contacts.LoadKind`      | (5,)  |
    | unlike      | whether the frame is unlike what the network was trained on   | ()    |
    """

    probability: np.ndarray
    unlike: bool

    def to_dict(self) -> dict[str, object]:
        """The probabilities by the names of the kinds, as values for JSON."""
        names = (kind.name.lower() for kind in LoadKind)
        return {**dict(zip(names, _json_numbers(self.probability), strict=True)), "unlike": self.unlike}


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Result of one frame.

    | field          | meaning                                                                | shape     | unit |
    |----------------|------------------------------------------------------------------------|-----------|------|
    | number         | of the frame among the processed ones                                  | ()        |      |
    | host           | time of arrival on the monotonic clock                                 | ()        | ns   |
    | latency        | from arrival to this result                                            | ()        | s    |
    | force          | on each pad; NaN without pressure                                      | (pads,)   | N    |
    | standard_error | of the force                                                           | (pads,)   | N    |
    | half_width     | half the interval that 90 % of readings of the force fall into         | (pads,)   | N    |
    | valid          | whether the pressure is within the calibrated range, and the streams   | (pads,)   |      |
    |                | can be those of this calibration                                       |           |      |
    | centre         | mean position of the force on each pressed pad; NaN on the others      | (pads, 2) | m    |
    | map            | force on each pixel; its sum is that of the pad forces                 | (pixels,) | N    |
    | image          | change of sheet conductivity from which the map is made                | (pixels,) | S    |
    | missing        | number of readings that were not finite and were left out              | ()        |      |
    | dropped        | number of frames that were not processed so far                        | ()        |      |
    | touches        | contacts, if the calibration fits contacts or they are followed        |           |      |
    | unsearched     | number of frames so far for which there was no time to fit contacts    | ()        |      |
    | kinds          | what touches the skin; None: nothing does, or no network tells it      |           |      |
    | faults         | what cannot be true in the streams, in words                           |           |      |
    """

    number: int
    host: int
    latency: float
    force: np.ndarray
    standard_error: np.ndarray
    half_width: np.ndarray
    valid: np.ndarray
    centre: np.ndarray
    map: np.ndarray
    image: np.ndarray
    missing: int
    dropped: int
    touches: TouchEstimates = NO_TOUCHES
    unsearched: int = 0
    kinds: KindEstimate | None = None
    faults: tuple[str, ...] = ()

    def to_json(self, *, image: bool = False, shape: tuple[int, ...] = ()) -> str:
        """The result as one line of JSON; ``image`` adds map and image as base64 of little-endian f4.

        ``shape`` adds the rows and columns of both.
        """
        out: dict[str, object] = {
            "number": self.number,
            "host_ns": self.host,
            "latency_ms": round(1e3 * self.latency, 3),
            "force": _json_numbers(self.force),
            "standard_error": _json_numbers(self.standard_error),
            "half_width": _json_numbers(self.half_width),
            "valid": self.valid.tolist(),
            "centre": [_json_numbers(row) for row in self.centre],
            "missing": self.missing,
            "dropped": self.dropped,
            "contacts": self.touches.to_list(),
            "contacts_age": self.touches.age,
            "unsearched": self.unsearched,
            "kinds": None if self.kinds is None else self.kinds.to_dict(),
            "faults": list(self.faults),
        }
        if image:
            out |= {name: base64.b64encode(getattr(self, name).astype("<f4")).decode() for name in ("map", "image")}
        out |= {"shape": list(shape)} if shape else {}
        return json.dumps(out, allow_nan=False)


@dataclass(frozen=True, eq=False)
class LogResult:
    """Result of one reading of a sensor whose calibration is that of a log.

    | field          | meaning                                                           | shape | unit |
    |----------------|-------------------------------------------------------------------|-------|------|
    | number         | of the reading among the processed ones                           | ()    |      |
    | host           | time of arrival on the monotonic clock                            | ()    | ns   |
    | latency        | from arrival to this result                                       | ()    | s    |
    | force          | NaN where a channel is missing                                    | (1,)  | N    |
    | standard_error | of the force                                                      | (1,)  | N    |
    | low, high      | ends of the interval that 90 % of new readings of a force fall in | (1,)  | N    |
    | valid          | whether channels and place are within the calibrated ranges       | (1,)  |      |
    | missing        | number of channels that were not finite                           | ()    |      |
    | dropped        | number of readings that were not processed so far                 | ()    |      |
    """

    number: int
    host: int
    latency: float
    force: np.ndarray
    standard_error: np.ndarray
    low: np.ndarray
    high: np.ndarray
    valid: np.ndarray
    missing: int
    dropped: int

    def to_json(self, *, image: bool = False, shape: tuple[int, ...] = ()) -> str:
        """The result as one line of JSON; there is no ``image``."""
        del image, shape
        out: dict[str, object] = {
            "number": self.number,
            "host_ns": self.host,
            "latency_ms": round(1e3 * self.latency, 3),
            "valid": self.valid.tolist(),
            "missing": self.missing,
            "dropped": self.dropped,
        }
        out |= {name: _json_numbers(getattr(self, name)) for name in ("force", "standard_error", "low", "high")}
        return json.dumps(out, allow_nan=False)


Result = FrameResult | LogResult


def _json_numbers(values: np.ndarray) -> list[float | None]:
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in values]
