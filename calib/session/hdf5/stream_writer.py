"""One stream of a session file while it is written: rows are checked, packed and flagged before any is stored."""

import re
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike

from ..errors import SessionError, problem
from ..facts import StreamFacts
from ..tables import STREAM_EXTRAS, Status
from ..units import UNITS, VARIABLE_UNIT
from .datasets import AttributeValue, GrowingArray, attach, make_group, make_index

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
RESERVED = {"time", "status", "channel", *STREAM_EXTRAS}
STREAM_TYPES = {"f4", "f8", "i2", "i4"}


class StreamWriter:
    """Write a stream into the group of streams of a session file."""

    def __init__(self, path: Path, streams: h5py.Group, name: str, facts: StreamFacts):
        self._path, self._where = path, f"/streams/{name}"
        dtype, variable, channels = np.dtype(facts.dtype), facts.variable, facts.channels
        for text in (name, variable):
            if not NAME.fullmatch(text) or text in RESERVED:
                raise self._problem(f"name {text!r} cannot be used", "use a new plain name")
        self._check_units(variable, facts.units)
        kind = f"{dtype.kind}{dtype.itemsize}"
        if kind not in STREAM_TYPES or channels < 1 or not np.isfinite(facts.rate_hz) or facts.rate_hz <= 0:
            what = f"{channels} channels of {kind} at {facts.rate_hz} Hz cannot be stored"
            raise self._problem(what, f"use {sorted(STREAM_TYPES)}, >= 1 channel, a rate > 0")
        self._scale, self._offset = self._packing(dtype, facts)
        attrs: dict[str, AttributeValue] = {"NX_class": "NXdata", "signal": variable}
        attrs["axes"] = ["time", "channel"]
        attrs |= {"nominal_rate_hz": float(facts.rate_hz), "clock": facts.clock, "transport": facts.transport}
        self._group = make_group(streams, name, attrs)
        self._columns = {
            "time": GrowingArray(self._group, "time", (), np.dtype("i8")),
            variable: GrowingArray(self._group, variable, (channels,), dtype),
            "status": GrowingArray(self._group, "status", (), np.dtype("u2")),
        }
        self._variable, self._channels, self._dtype = variable, channels, dtype
        self._about: dict[str, AttributeValue] = {"units": facts.units}
        self._about["long_name"] = facts.long_name or f"{name} {variable}"
        self._last: int | None = None

    def _problem(self, what: str, todo: str) -> SessionError:
        return problem(self._path, self._where, what, todo)

    def _check_units(self, variable: str, units: str) -> None:
        expected = VARIABLE_UNIT.get(variable, units)
        if units not in UNITS or UNITS[units].si != units or units != expected:
            wanted = VARIABLE_UNIT.get(variable) or (UNITS[units].si if units in UNITS else "an SI unit")
            raise self._problem(f"{variable} is given in {units!r}", f"convert it to {wanted} before writing")

    def _packing(self, dtype: np.dtype, facts: StreamFacts) -> tuple[float, float]:
        units, scale, offset = facts.units, facts.scale_factor, facts.add_offset
        if dtype.kind == "f" and (scale is not None or offset is not None):
            raise self._problem("floats are not packed", "leave scale_factor, add_offset out")
        if dtype.kind == "i" and scale is None and units != "1":
            raise self._problem(f"whole {units} are too coarse", "give scale_factor")
        scale, offset = 1.0 if scale is None else float(scale), float(offset or 0.0)
        if not np.isfinite([scale, offset]).all() or scale == 0:
            raise self._problem("scale_factor or add_offset is unusable", "give numbers")
        return scale, offset

    def append(
        self,
        time_ns: ArrayLike,
        values: ArrayLike,
        status: ArrayLike | None,
        extras: Mapping[str, ArrayLike | None],
    ) -> None:
        """Add rows, as `SessionWriter.append` states them; ``extras`` are the columns of `STREAM_EXTRAS`."""
        times = self._checked_times(time_ns)
        stored, flags = self._stored(times, values)
        if status is not None:
            flags = flags | self._integers("status", status, len(times), "u2")
        rows = self._extras(extras, len(times))
        rows |= {"time": times, self._variable: stored, "status": flags}
        for column, block in rows.items():
            self._columns[column].append(block)
        self._last = int(times[-1]) if len(times) else self._last

    def _integers(self, column: str, data: ArrayLike, rows: int, kind: str) -> np.ndarray:
        array = np.asarray(data)
        if array.shape != (rows,) or array.dtype.kind not in "iu":
            raise self._problem(f"{column} has shape {array.shape} and type {array.dtype}", f"give {rows} integers")
        limits = np.iinfo(kind)
        if array.size and (int(array.min()) < limits.min or int(array.max()) > limits.max):
            raise self._problem(f"{column} does not fit {np.dtype(kind)}", "check the numbers")
        return array.astype(kind)

    def _extras(self, extras: Mapping[str, ArrayLike | None], rows: int) -> dict[str, np.ndarray]:
        given = {k: v for k, v in extras.items() if v is not None}
        if self._last is None:
            for key in given:
                dtype = np.dtype(STREAM_EXTRAS[key])
                self._columns.setdefault(key, GrowingArray(self._group, key, (), dtype))
        expected = set(self._columns) & set(STREAM_EXTRAS)
        if set(given) != expected:
            what = f"{sorted(given)} given where {sorted(expected)} belong"
            raise self._problem(what, "give the same columns with every call")
        return {k: self._integers(k, v, rows, STREAM_EXTRAS[k]) for k, v in given.items()}

    def _checked_times(self, time_ns: ArrayLike) -> np.ndarray:
        times = np.atleast_1d(np.asarray(time_ns))
        rows = len(times) if times.ndim == 1 else 0
        times = self._integers("time_ns", times, rows, "i8")
        before = times[:1] - 1 if self._last is None else np.array([self._last])
        steps = np.diff(np.concatenate([before[: rows and None], times])) if rows else times[:0]
        if (steps <= 0).any():
            row = int(np.argmax(steps <= 0)) + self._columns["time"].rows
            raise self._problem(f"time does not increase at row {row}", "sort the rows, drop equal times")
        return times

    def _stored(self, times: np.ndarray, values: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Values as stored (n, channels), and the flags that storing them gave rise to (n,)."""
        if np.ma.isMaskedArray(values):
            what = "values of a masked array, whose mask would be lost"
            raise self._problem(what, "give values.filled(numpy.nan): NaN counts as missing")
        values = np.asarray(values, np.float64)
        if values.ndim == 1:
            values = values.reshape(len(times), -1) if len(times) else values.reshape(0, 1)
        if values.shape != (len(times), self._channels):
            todo = f"give ({len(times)}, {self._channels}): rows, channels"
            raise self._problem(f"values of shape {values.shape}", todo)
        stored, clipped = self._packed(values)
        missing = ~np.isfinite(stored) if stored.dtype.kind == "f" else ~np.isfinite(values)
        flags = np.where(missing.any(axis=1), int(Status.nonfinite), 0)
        flags = flags | np.where(clipped.any(axis=1), int(Status.saturated), 0)
        return stored, flags.astype("u2")

    def _packed(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values in the stream's type, and where they had to be clipped."""
        if self._dtype.kind == "f":
            largest = np.finfo(self._dtype).max
            stored = np.where(np.abs(values) <= largest, values, np.nan).astype(self._dtype)
            return stored, np.zeros(values.shape, bool)
        limits = np.iinfo(self._dtype)
        finite = np.isfinite(values)
        counts = np.rint((np.where(finite, values, self._offset) - self._offset) / self._scale)
        # The lowest number of the type means missing, so that no value may have it.
        clipped = (counts < limits.min + 1) | (counts > limits.max)
        counts = np.clip(counts, limits.min + 1, limits.max)
        return np.where(finite, counts, limits.min).astype(self._dtype), clipped

    def finish(self, time_attrs: Mapping[str, AttributeValue]) -> None:
        """Write the remaining rows, the attributes and the dimension scales; ``time_attrs`` are of the times."""
        time = self._columns["time"].finish(time_attrs)
        time.make_scale("time")
        channel = make_index(self._group, "channel", self._channels)
        about = self._about
        packed = self._dtype.kind == "i"
        if packed:
            about = about | {"scale_factor": self._scale, "add_offset": self._offset}
        values = self._columns[self._variable].finish(about)
        fill = np.iinfo(self._dtype).min if packed else np.nan
        values.attrs.create("_FillValue", fill, dtype=self._dtype)
        attach(values, time, channel)
        masks = np.array([int(s) for s in Status], "u2")
        flags = {"units": "1", "flag_meanings": " ".join(str(s.name) for s in Status)}
        status = self._columns["status"].finish(flags)
        status.attrs.create("flag_masks", masks, dtype="u2")
        attach(status, time)
        for key in (k for k in STREAM_EXTRAS if k in self._columns):
            attach(self._columns[key].finish({"units": "1" if key != "time_host" else "ns"}), time)
