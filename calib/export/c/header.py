"""A calibration as one C99 header without allocation: one frame to image, force map and pad forces in float32.

The functions are those of `frame.h` and, for a correction by location, of `location.h` beside this file; the tables are
written here.
"""

import re
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

import jaxeit as je
from jaxeit.messages.kinds import listed

from ...calibration import Calibration, LogCalibration
from ...calibration.argument_checks import require_calibration
from ...session import replacing
from ..errors import ExportError
from .fields import LocationInC
from .image_places import consequences, with_image_places
from .numbers import Numbers, numbers_of

TEMPLATE, LOCATION = (Path(__file__).with_name(name) for name in ("frame.h", "location.h"))
MAX_MISSING = 16  # as in the template
_PREFIX = re.compile(r"[a-z][a-z0-9_]{0,30}")
_TYPES: dict[str, tuple[DTypeLike, int]] = {
    "float": (np.float32, 4),
    "double": (np.float64, 8),
    "uint16_t": (np.uint16, 2),
    "uint32_t": (np.uint32, 4),
}


@dataclass(frozen=True)
class HeaderSizes:
    """Memory and computation that a header needs.

    | meaning                                                                     | unit  |
    |-----------------------------------------------------------------------------|-------|
    | flash: tables, without the code                                             | bytes |
    | predict: of these the table for missing readings, if `MAX_MISSING` is not 0 | bytes |
    | rest, tare, result: the structures of these names                           | bytes |
    | stack: about, with `MAX_MISSING` missing readings                           | bytes |
    | operations: multiply-adds of a frame with all its readings                  |       |
    """

    flash: int
    predict: int
    rest: int
    tare: int
    result: int
    stack: int
    operations: int

    @property
    def ram(self) -> int:
        """Bytes of one rest frame and one result; the tare is needed only while the skin is at rest."""
        return self.rest + self.result

    def __str__(self) -> str:
        return (
            f"{self.flash:,} bytes of flash for tables, {self.ram:,} bytes of RAM ({self.tare:,} more for a tare), "
            f"about {self.stack:,} bytes of stack, {self.operations:,} multiply-adds a frame"
        )


def export_c(
    calibration: Calibration | LogCalibration,
    path: str | Path,
    *,
    prefix: str = "skin",
    without_location: bool = False,
    place: je.metrics.AbstractEstimator | None = None,
    tell: Callable[[str], object] = lambda line: None,
) -> HeaderSizes:
    """Write a calibration as a C99 header, whole or not at all; returns what the header takes.

    The header does for one frame what `calib.force_map` does, without standard errors and fitted contacts. The same
    calibration gives the same bytes.

    Args:
        calibration: of a skin, with a linear method of reconstruction and a curve without memory.
        path: of the header.
        prefix: of its names: a lower-case letter, then lower-case letters, digits and underscores.
        without_location: leave out a correction by location: its gain is then 1.
        place: estimator by which the header finds the place of a contact in the image, such as `jaxeit.LevelCentroid`;
            default: that of the calibration, which must then be an `ImageCentroid`.
        tell: called with each line on what another place than that of the calibration changes.

    Raises:
        ExportError: if a part of the calibration cannot be exported; the message says which and what to do.
        SessionError: for a path or another object in the place of the calibration.
        OSError: if the file cannot be written.
    """
    if isinstance(calibration, LogCalibration):
        raise ExportError("a log has no EIT and therefore no image; export the calibration of a skin")
    require_calibration(calibration, "export_c")
    _require_choices(prefix, without_location, place)
    chosen = calibration if place is None else with_image_places(calibration, place)
    numbers = numbers_of(chosen, without_location=without_location)
    remarks = [] if place is None else consequences(calibration, chosen)
    tables, flash = _tables(numbers)
    sizes = _sizes(numbers, flash)
    parts = {
        "SIZES": _about(calibration, numbers, sizes, remarks),
        "TABLES": tables,
        "EXACT": _exact(numbers),
        "CURVE": _indented(numbers.curve.body),
        **_location_parts(numbers.location),
    }
    with replacing(Path(path)) as temporary:
        temporary.write_text(_renamed(_filled(TEMPLATE, parts), prefix), encoding="ascii", newline="\n")
    for remark in remarks:
        tell(remark)
    return sizes


def _require_choices(prefix: str, without_location: bool, place: je.metrics.AbstractEstimator | None) -> None:
    if not _PREFIX.fullmatch(prefix):
        raise ExportError(
            f"prefix {prefix!r}: give a lower-case letter, then lower-case letters, digits and underscores, 31 at most"
        )
    if place is not None and without_location:
        raise ExportError("place: is of no use without the correction by location; give one of the two")


def _renamed(text: str, prefix: str) -> str:
    """The header with another prefix of its names."""
    text = re.sub(r"\bskin_", f"{prefix}_", text)
    return re.sub(r"\bSKIN_", f"{prefix.upper()}_", text)


def _filled(template: Path, parts: dict[str, str]) -> str:
    """The template with its marks replaced; a line that holds nothing but the mark of an empty part is left out."""
    text = template.read_text(encoding="ascii")
    text = re.sub(r"(?m)^/\*@(\w+)@\*/\n", lambda found: f"{parts[found[1]]}\n" if parts[found[1]] else "", text)
    return re.sub(r"/\*@(\w+)@\*/", lambda found: parts[found[1]], text)


def _location_parts(location: LocationInC | None) -> dict[str, str]:
    """What the template holds for a correction by location; all empty without one."""
    if location is None:
        return dict.fromkeys(("PLACE", "LOCATION", "LOCATE", "GAIN"), "")
    inside = {"WEIGHT": location.weight, "FIELD": _indented(location.field.body)}
    return {
        "PLACE": "    float place[2];              /* of the contact by the image, x and y in m; NaN: not known */",
        "LOCATION": _filled(LOCATION, inside).rstrip("\n") + "\n",
        "LOCATE": "    skin_locate(out);",
        "GAIN": " * skin_gain(i, out->place)",
    }


def _indented(lines: Sequence[str]) -> str:
    return "\n".join(f"    {line}" for line in lines)


def _sizes(numbers: Numbers, flash: int) -> HeaderSizes:
    (pixels, pairs), readings, pads = numbers.factor.shape, len(numbers.weight), len(numbers.unmix)
    result, location = 8 * pixels + 4 * pads + 2 * pads, numbers.location
    return HeaderSizes(
        flash=flash,
        predict=_TYPES[_exact(numbers)][1] * len(numbers.predict),
        rest=4 * (readings + pads),
        tare=12 * (readings + pads),
        result=-(-result // 4) * 4 + 4 + (8 if location else 0),
        stack=(4 + _TYPES[_exact(numbers)][1]) * pairs
        + 4 * pads
        + 2 * MAX_MISSING
        + 4 * MAX_MISSING * (MAX_MISSING + 1)
        + 8 * MAX_MISSING,
        operations=5 * readings
        + pixels * pairs
        + pads**2
        + 5 * len(numbers.mask_area)
        + (location.operations if location else 0),
    )


def _tables(numbers: Numbers) -> tuple[str, int]:
    """The tables in C, and their bytes."""
    tables = (
        ("uint16_t", "pairs", "[SKIN_READINGS][4]", "pair sums that a reading is made of", numbers.pairs),
        ("skin_exact", "weight", "[SKIN_READINGS]", "of a reading, 1/V^2; 0: not used", numbers.weight),
        ("float", "factor", "[SKIN_PIXELS][SKIN_PAIRS]", "image per weighted sum, S V", numbers.factor),
        ("skin_exact", "predict", "[SKIN_PAIRS * (SKIN_PAIRS + 1) / 2]", "predicts pair sums, V^2", numbers.predict),
        ("float", "unmix", "[SKIN_PADS][SKIN_PADS]", "own pressure of a pad per pressure read", numbers.unmix),
        ("float", "curves", f"[SKIN_PADS][{numbers.curve.coefficients.shape[1]}]", f"CURVE: {numbers.curve.formula}",
         numbers.curve.coefficients),
        ("float", "range", "[SKIN_PADS][2]", "calibrated pressures, Pa", numbers.range),
        ("uint32_t", "mask_start", "[SKIN_PADS + 1]", "first entry of a pad in the next two", numbers.mask_start),
        ("uint16_t", "mask_pixel", f"[{len(numbers.mask_pixel)}]", "pixel", numbers.mask_pixel),
        ("float", "mask_area", f"[{len(numbers.mask_area)}]", "area of the pad in the pixel, m^2", numbers.mask_area),
        *_location_tables(numbers.location),
    )  # fmt: skip
    texts, flash = [], 0
    for kind, name, shape, meaning, values in tables:
        dtype, size = _TYPES[_exact(numbers) if kind == "skin_exact" else kind]
        flash += size * values.size
        text = f"/* {meaning} */\nstatic const {kind} skin_{name}{shape} = {_initialiser(name, values, dtype)};"
        texts.append(f"#if SKIN_MAX_MISSING > 0\n{text}\n#endif" if name == "predict" else text)
    return "\n\n".join(texts), flash


def _location_tables(location: LocationInC | None) -> tuple[tuple[str, str, str, str, np.ndarray], ...]:
    if location is None:
        return ()
    field, sides = location.field, location.side
    count = field.coefficients.shape[1]
    return (
        ("float", "pixel", "[SKIN_PIXELS][3]", "centre of the pixel, m, and its area, m^2", location.pixel),
        ("float", "side", "[SKIN_PADS][SKIN_SIDES][4]", "ends of the sides of the pads, m", sides),
        ("float", "reach", "[SKIN_PADS][4]", "box in which the field is known, m", location.reach),
        ("float", "box", "[SKIN_PADS][4]", "lowest corner plus the highest, and their difference, m", location.box),
        ("float", "rim", "[SKIN_RIM][4]", "ends of the sides of the rim of the sheet, m", location.rim),
        ("float", "field", f"[SKIN_PADS][{count}]", f"LOCATION: {field.formula}", field.coefficients),
    )


def _exact(numbers: Numbers) -> str:
    """Type of the numbers from which missing readings are predicted."""
    return "double" if numbers.exact else "float"


def _initialiser(name: str, values: np.ndarray, dtype: DTypeLike) -> str:
    with np.errstate(over="ignore"):
        stored = values.astype(dtype)
    if not np.isfinite(stored).all():
        raise ExportError(f"{name}: some numbers are not finite in C; calibrate again, and read its report")
    return _braced(stored)


def _braced(stored: np.ndarray) -> str:
    if stored.ndim == 1:
        return "{\n" + _lines(stored) + "\n}"
    if stored.ndim == 2:
        return "{\n" + ",\n".join("{" + _lines(row).lstrip() + "}" for row in stored) + "\n}"
    return "{\n" + ",\n".join(map(_braced, stored)) + "\n}"


def _lines(row: np.ndarray) -> str:
    """Numbers that read back as the same bits, ten a line."""
    digits = {np.dtype(np.float32): (".8e", "f"), np.dtype(np.float64): (".16e", "")}
    form, end = digits.get(row.dtype, ("d", ""))
    words = [f"{value:{form}}{end}" for value in row.tolist()]
    return ",\n".join(", ".join(words[i : i + 10]) for i in range(0, len(words), 10))


def _about(calibration: Calibration, numbers: Numbers, sizes: HeaderSizes, remarks: Sequence[str]) -> str:
    """The comment of the header, and its sizes as macros."""
    (pixels, pairs), readings, pads = numbers.factor.shape, len(numbers.weight), len(numbers.unmix)
    rows, columns = calibration.recon.shape
    names = listed(pad.name for pad in calibration.skin.pads)
    sessions = calibration.provenance.get("sessions", "").splitlines()
    lines = [
        f"One frame of the skin {calibration.skin.name!r} to image, force map and pad forces, in float32.",
        "Written by `jaxeit export c`; write the header anew instead of editing it.",
        "",
        *(["The sessions of the calibration were simulated."] if calibration.simulated else []),
        *(f"session {line}" for line in sessions),
        f"pads: {names}",
        f"readings {readings}, pairs of electrodes {pairs}, image {columns} x {rows} pixels",
        f"curve: {numbers.curve.formula}",
        *_about_location(calibration, numbers.location, remarks),
        "",
        f"flash  {sizes.flash:,} bytes of tables, and the code; of these {sizes.predict:,} for missing readings",
        f"RAM    skin_rest {sizes.rest:,}, skin_result {sizes.result:,} bytes; while the skin is at rest "
        f"skin_tare {sizes.tare:,} bytes",
        f"stack  about {sizes.stack:,} bytes with SKIN_MAX_MISSING {MAX_MISSING}",
        f"work   {sizes.operations:,} multiply-adds a frame; {4 * pairs:,} more in double for each missing reading",
    ]
    macros = {"READINGS": readings, "PADS": pads, "ROWS": rows, "COLUMNS": columns, "PIXELS": pixels, "PAIRS": pairs}
    if numbers.location is not None:
        macros |= {"SIDES": numbers.location.side.shape[1], "RIM": len(numbers.location.rim)}
    comment = "\n".join(f"   {_plain(line)}".rstrip() for line in lines).lstrip()
    return f"/* {comment} */\n" + "\n".join(f"#define SKIN_{name} {value}" for name, value in macros.items())


def _about_location(calibration: Calibration, location: LocationInC | None, remarks: Sequence[str]) -> list[str]:
    if calibration.field is None:
        return []
    if location is None:
        return ["The correction by location is left out: its gain is 1."]
    lines = [
        f"location: {location.field.formula}",
        f"at the place of the image by the estimator {location.estimator!r}",
        *remarks,
    ]
    return [part for line in lines for part in textwrap.wrap(line, 110)]


def _plain(text: str) -> str:
    """Text that can stand in a C comment."""
    ascii_text = "".join(c if " " <= c <= "~" and c != "\\" else "?" for c in text)
    return re.sub(r"\?\?+", "?", ascii_text.replace("*/", "* /").replace("/*", "/ *"))
