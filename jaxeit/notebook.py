"""Objects in a notebook: a small picture beside a table, as one piece of HTML without scripts.

Texts of users, such as the name of a skin, are escaped. Colours follow the page, so that dark notebooks can be read.
"""

import base64
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape

import numpy as np

WIDTH = 240
"""Width of a picture in CSS pixels."""
MAX_LINES = 6000
"""Lines that a picture has at most: more are a megabyte in the notebook, and grey to the eye."""
TINT = (13, 148, 136)
"""Colour of images, RGB: legible on white and on black."""


def card(title: str, rows: Iterable[tuple[str, object]], picture: str = "") -> str:
    """A heading, and a table of names and values beside a picture (`Drawing.svg`). Texts are escaped."""
    cells = "".join(
        f'<tr><th style="text-align:left;font-weight:normal;opacity:.7">{escape(name)}</th>'
        f'<td style="text-align:left">{escape(str(value))}</td></tr>'
        for name, value in rows
    )
    return (
        f'<div style="display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start">{picture}'
        f"<div><strong>{escape(title)}</strong><table>{cells}</table></div></div>"
    )


@dataclass
class Drawing:
    """A picture in metres, y upwards: what is added to it is drawn in that order.

    | meaning                                        | unit |
    |------------------------------------------------|------|
    | low, high: corners of what is shown, (2,) each | m    |
    """

    low: np.ndarray
    high: np.ndarray
    parts: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        margin = 0.02 * float(np.max(np.subtract(self.high, self.low)))
        self.low, self.high = np.asarray(self.low, float) - margin, np.asarray(self.high, float) + margin

    @property
    def scale(self) -> float:
        """CSS pixels per metre."""
        return WIDTH / float(self.high[0] - self.low[0])

    def _at(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 2) m in CSS pixels from the upper left corner."""
        flat = np.asarray(points, float)
        return np.stack([flat[..., 0] - self.low[0], self.high[1] - flat[..., 1]], -1) * self.scale

    def polygon(self, corners: np.ndarray, *, fill: float = 0.0) -> None:
        """A closed outline (corners, 2) m, whose inside is covered to a share ``fill``."""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in self._at(corners))
        self.parts.append(
            f'<polygon points="{path}" fill="currentColor" fill-opacity="{fill:g}" stroke="currentColor"/>'
        )

    def lines(self, starts: np.ndarray, ends: np.ndarray) -> None:
        """Thin lines from points to points, (lines, 2) m each; none if they are too many to be told apart."""
        if len(starts) <= MAX_LINES:
            pairs = zip(self._at(starts), self._at(ends), strict=True)
            path = "".join(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" for a, b in pairs)
            self.parts.append(f'<path d="{path}" stroke="currentColor" stroke-width=".3" fill="none"/>')

    def dots(self, places: np.ndarray, labels: Iterable[str] = ()) -> None:
        """A dot at each place (n, 2) m, with a text that a pointer shows."""
        names = [*labels] or [""] * len(places)
        for (x, y), name in zip(self._at(places), names, strict=True):
            title = f"<title>{escape(name)}</title>" if name else ""
            self.parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="currentColor">{title}</circle>')

    def crosses(self, places: np.ndarray) -> None:
        """A small cross at each place (n, 2) m that is finite."""
        known = self._at(places)[np.isfinite(places).all(1)]
        path = "".join(f"M{x - 2:.1f} {y - 2:.1f}l4 4m-4 0l4-4" for x, y in known)
        self.parts.append(f'<path d="{path}" stroke="rgb{TINT}" fill="none"/>')

    def image(self, values: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
        """An image (rows, columns) between two corners, (2,) m each, row 0 lowest: opaque where it is largest."""
        (x, bottom), (right, y) = self._at(low), self._at(high)
        data = base64.b64encode(png(values[::-1])).decode()
        self.parts.append(
            f'<image x="{x:.1f}" y="{y:.1f}" width="{right - x:.1f}" height="{bottom - y:.1f}" '
            f'preserveAspectRatio="none" style="image-rendering:pixelated" href="data:image/png;base64,{data}"/>'
        )

    def svg(self, label: str) -> str:
        """The picture; ``label`` says what it shows to those who do not see it."""
        height = float(self.high[1] - self.low[1]) * self.scale
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="{escape(label)}" width="{WIDTH}" '
            f'height="{height:.0f}" viewBox="0 0 {WIDTH} {height:.1f}">{"".join(self.parts)}</svg>'
        )


def picture(values: np.ndarray, label: str) -> str:
    """An image (rows, columns) alone, row 0 lowest."""
    rows, columns = values.shape
    low, high = np.zeros(2), np.array([columns, rows], float)
    drawing = Drawing(low, high)
    drawing.image(values, low, high)
    drawing.polygon(np.array([low, [columns, 0], high, [0, rows]]))
    return drawing.svg(label)


def png(values: np.ndarray) -> bytes:
    """A PNG file of an image (rows, columns), the first row on top: opaque where the image is largest.

    Values at zero and below, and those that are not finite, are transparent.
    """
    known = np.where(np.isfinite(values), values, 0.0)
    top = float(known.max(initial=0.0))
    pixels = np.empty((*known.shape, 4), np.uint8)
    pixels[..., :3] = TINT
    pixels[..., 3] = np.rint(255 * np.clip(known / top, 0, 1)) if top > 0 else 0
    return png_of(pixels)


def png_of(pixels: np.ndarray) -> bytes:
    """A PNG file of pixels (rows, columns, 3 or 4) uint8, colour and perhaps opacity, the first row on top."""
    rows, columns, channels = pixels.shape
    raw = b"".join(b"\0" + row.tobytes() for row in pixels)  # each row begins with the number of its filter, none
    header = struct.pack(">IIBBBBB", columns, rows, 8, {3: 2, 4: 6}[channels], 0, 0, 0)  # 8 bits a channel
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(raw)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
