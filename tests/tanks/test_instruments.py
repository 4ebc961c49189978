"""Files of instruments for the chest, as `instrument_files` writes them."""

import struct

import numpy as np
import pytest

import jaxeit as je
from calib.cli import main
from calib.tanks import TankError, load_instrument, load_tank

from . import instrument_files as files
from .rods import RADIUS, sees_the_rod

KINDS = {
    "goe.get": (files.goe_get, 0.9 * 5.12e-3, 0.0),
    "half.get": (files.goe_half_get, 0.9 * 5.12e-3, 0.0),
    "old.get": (files.draeger_get, 5e-3, 97656.3),
    "v51.eit": (files.draeger_eit, 5e-3, 101_501.0),
    "v32.EIT": (files.older_draeger_eit, 5e-3, 101_501.0),
    "xml.eit": (files.carefusion_eit, 5e-3, 0.0),
}


@pytest.mark.parametrize("name", KINDS)
def test_frames_of_instruments(bench, tmp_path, name):
    """Instruments read above zero what the model reads below."""
    write, current, frequency = KINDS[name]
    (tmp_path / name).write_bytes(write(-bench.frames))
    tank = load_tank(tmp_path / name, bench.skin.domain, bench.skin.electrodes)
    np.testing.assert_allclose(tank.frames, bench.frames, rtol=1e-6, atol=1e-7 * np.abs(bench.frames).max())
    assert tank.names == ("frame 0", "frame 1")
    assert tank.skin.protocol.current == pytest.approx(current)
    assert tank.skin.protocol.frequency == pytest.approx(frequency)
    np.testing.assert_array_equal(tank.skin.protocol.pattern, bench.skin.protocol.pattern)
    sees_the_rod(tank)
    with pytest.raises(TankError, match="does not tell the shape of the tank"):
        load_tank(tmp_path / name)


def test_a_picture_of_a_get_file(bench, tmp_path, capsys):
    """A recording of many frames, of which two are named."""
    pytest.importorskip("matplotlib")
    still, rod = -bench.frames
    (tmp_path / "run.get").write_bytes(files.goe_get([still] * 20 + [rod] + [still] * 9))
    words = ["image", str(tmp_path / "run.get"), "-o", str(tmp_path / "picture.png"), "--frame", "20", "--radius"]
    assert main([*words, str(RADIUS), "--reference", "3"]) == 0
    said = capsys.readouterr().out
    assert "30 frames: frame 0 to frame 29" in said
    assert "correlation with an even tank 1.000" in said
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")


GOE, EIT = files.goe_get([np.ones(208)]), files.draeger_eit([np.ones(208)] * 2)
XML = files.carefusion_eit([np.ones(208)])
REFUSED = {
    "empty .get": ("a.get", b"", "has no frame of 1024 bytes; it is empty or was cut short"),
    "cut .get": ("a.get", GOE + GOE[:100], "has 100 bytes more than 1 frames of 1024; .* keep its first 1024 bytes"),
    "no .get": ("a.get", b"text" * 256, "currents of its first frame are .* A; is no .get of a GOE-MF II"),
    "text alone": ("a.get", files.OLD_TEXT, "has no end, two empty lines"),
    "no frames behind the text": ("a.get", files.OLD_TEXT + b"\r\n\r\n\r\n", "has no frame of 1024 bytes"),
    "cut .eit": ("a.eit", EIT[:-7], "has 5488 bytes more than 1 frames of 5495; if it was cut short"),
    "no frame": ("a.eit", EIT[:2000], "has no frame of 5495 bytes"),
    "another version": ("a.eit", struct.pack("<I", 31) + EIT[4:], "is of version 31 .*; version 32 or 51 can be read"),
    "a text longer than the file": ("a.eit", EIT[:4] + b"\xff" * 4 + EIT[8:], "has no frame of 5495 bytes"),
    "cut record": ("a.eit", XML[:-4], r"the record at byte \d+ has no end; it was cut short"),
    "XML alone": ("a.eit", XML[:60], "does not tell where the records begin, or was cut short"),
    "Swisstom": ("a.eit", b"\4\0\0\0" + bytes(3000), "is a file of a Swisstom instrument"),
    "neither": ("a.eit", b"", "does not begin like a text file of Sciospec's software"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_whole_file_of_an_instrument_is_refused(tmp_path, case):
    name, content, message = REFUSED[case]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(TankError, match=rf"{name}: .*{message}"):
        load_tank(tmp_path / name, je.Disc(RADIUS))


def test_a_loader_that_is_named_reads_its_formats_only(tmp_path):
    (tmp_path / "a.eit").write_text("18\n")
    with pytest.raises(TankError, match=r"a\.eit: does not begin like a file of CareFusion or Draeger"):
        load_instrument(tmp_path / "a.eit", je.Disc(RADIUS))


def test_readings_that_are_no_numbers_are_left_out(bench, tmp_path):
    """An image is made without them; of a negative length no record is read."""
    spoilt = -bench.frames.copy()
    spoilt[1, 5] = np.inf
    (tmp_path / "a.get").write_bytes(files.goe_get(spoilt))
    tank = load_tank(tmp_path / "a.get", bench.skin.domain, bench.skin.electrodes)
    assert np.flatnonzero(np.isnan(tank.frames).ravel()).tolist() == [208 + 5]
    raw = files.carefusion_eit(-bench.frames)
    (tmp_path / "a.eit").write_bytes(raw + struct.pack("<6i", 8, 0, 0, 4, -300, 0))
    with pytest.raises(TankError, match="has no end"):
        load_tank(tmp_path / "a.eit", bench.skin.domain)
