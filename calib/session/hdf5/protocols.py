"""The EIT protocol of a session file: the pattern, its numbers, and readings as sums of rows of the pattern."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.sparse as sp

from ..errors import problem
from ..facts import SessionFacts
from ..mixing import checked_mixing, count_readings, terms_of_mixing
from .datasets import attach, make_array, make_group, make_index


def checked_protocol(path: Path, facts: SessionFacts) -> dict[str, Any]:
    """The protocol's arrays and numbers, checked; empty without a pattern."""
    if facts.pattern is None:
        if any(value is not None for value in (facts.current, facts.frequency, facts.offset, facts.mixing)):
            raise problem(path, "eit_protocol", "has no pattern", "give pattern as well")
        return {}
    array = np.asarray(facts.pattern)
    if array.ndim != 2 or array.shape[1] != 4 or array.dtype.kind not in "iu" or not len(array):
        raise problem(path, "pattern", f"has shape {array.shape}", "give (M, 4) integers")
    if array.min() < 0 or array.max() > np.iinfo("i2").max:
        raise problem(path, "pattern", "names impossible electrodes", "count electrodes from 0")
    found: dict[str, Any] = {"pattern": array.astype("i2")}
    for name, value, least in (("current", facts.current, np.nextafter(0, 1)), ("frequency", facts.frequency, 0.0)):
        if value is not None:
            found[name] = float(value)
            if not least <= found[name] < np.inf:
                raise problem(path, name, f"is {value}", "give a current above zero, a frequency of zero or more")
    if facts.mixing is not None:
        try:
            found["mixing"] = checked_mixing(facts.mixing, len(array))
        except ValueError as error:
            raise problem(path, "mixing", str(error), "give that of jaxeit.Protocol") from None
    if facts.offset is not None:
        found["offset"] = np.asarray(facts.offset, np.float64)
        if (
            found["offset"].shape != (count_readings(array, found.get("mixing")),)
            or not np.isfinite(found["offset"]).all()
        ):
            raise problem(path, "offset", "does not fit the pattern", "give one time per reading")
    return found


def write_protocol(device: h5py.Group, protocol: dict[str, Any]) -> None:
    """Write a protocol that `checked_protocol` gave into the group of the device."""
    numbers = {k: v for k, v in protocol.items() if isinstance(v, float)}
    group = make_group(device, "eit_protocol", {"NX_class": "NXcollection", **numbers})
    pattern = protocol["pattern"]
    mixing = protocol.get("mixing")
    rows = make_index(group, "measurement" if mixing is None else "row", len(pattern))
    readings = rows if mixing is None else make_index(group, "measurement", mixing.shape[0])
    terminals = make_index(group, "terminal", 4)
    meaning = "electrodes (zero-based): drive+, drive-, sense+, sense-"
    attrs = {"units": "1", "long_name": meaning}
    attach(make_array(group, "pattern" if mixing is None else "row_pattern", pattern, attrs), rows, terminals)
    if "offset" in protocol:
        attrs = {"units": "s", "long_name": "when in the scan each reading is taken"}
        attach(make_array(group, "offset", protocol["offset"], attrs), readings)
    if mixing is not None:
        _write_mixing(group, mixing)


def _write_mixing(group: h5py.Group, mixing: sp.csr_array) -> None:
    """The terms of which readings are sums: reading, row of the pattern, and share of that row."""
    term = make_index(group, "term", mixing.nnz)
    reading, row, share = terms_of_mixing(mixing)
    columns = {
        "term_reading": (reading.astype("i4"), "reading that the term belongs to"),
        "term_row": (row.astype("i4"), "row of the pattern"),
        "term_share": (share.astype("f8"), "share of that row in the reading"),
    }
    for name, (values, meaning) in columns.items():
        attach(make_array(group, name, values, {"units": "1", "long_name": meaning}), term)
