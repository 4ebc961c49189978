"""What is said of misplaced electrodes, wherever a user would meet it, and by nothing where they sit right."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import calib.check.placement
import jaxeit as je
from calib.calibration.localisation.load_windows import left_by_fits
from calib.check.placement import NOTE, noted, placement_finding, placement_note
from calib.cli import main
from calib.session import read_archive
from jaxeit.imaging import InverseError, Misplacement

from ..oracles.bench import Bench, Faults, simulate, write

ASIDE = Misplacement(
    size=jnp.asarray(1.4e-3),
    evidence=jnp.asarray(900.0),
    shift=jnp.zeros((25, 2)).at[7].set(jnp.asarray([2e-3, -1e-3])),
    standard_error=jnp.full((25, 2), 3e-4),
    error=jnp.asarray(2e-4),
    unshifted=jnp.asarray(3e-3),
)


def _said(skin, monkeypatch, found):
    monkeypatch.setattr(calib.check.placement, "find_misplacement", found)
    return placement_finding(skin, np.ones(550), np.ones(550, bool))


def test_what_is_said_depends_on_evidence_and_size(skin, monkeypatch):
    found = _said(skin, monkeypatch, lambda *_: ASIDE)
    assert found.what.startswith("they seem to sit about 1 mm from where the skin's file says")
    assert "most surely no. 7 (x +2.0, y -1.0 mm); with the places of the file, a coat leaves 15.0 times" in found.what
    assert "--fit-electrodes" in found.remedy
    note = placement_note(skin, np.ones(550), np.ones(550, bool))
    assert noted(["another", note]) == note
    assert note.startswith(NOTE)
    for small in ({"size": jnp.asarray(2e-4)}, {"evidence": jnp.asarray(20.0)}):
        assert _said(skin, monkeypatch, lambda *_, small=small: replace(ASIDE, **small)) is None
    other = _said(skin, monkeypatch, lambda *_: replace(ASIDE, error=jnp.asarray(0.05)))
    assert "of a reading 5 % are left" in other.what
    assert "faulty contacts" in other.remedy

    def refused(*_):
        raise InverseError("no frame")

    assert _said(skin, monkeypatch, refused) is None
    assert noted(["another"]) == placement_note(skin, np.ones(550), np.ones(550, bool)) == ""


def test_fits_that_leave_more_than_is_believed_are_said():
    assert left_by_fits(np.array([np.nan, 1.0, 2.0, 50.0, 3.0])) == ""
    assert left_by_fits(np.array([np.nan])) == ""
    assert left_by_fits(np.array([25.0, 25.0, 1.0])).startswith("in 67% of them fits leave 5.0 times their errors")


@pytest.mark.slow
@pytest.mark.parametrize(("aside", "seed"), [(0.0, 8201), (1.5e-3, 8202)])
def test_every_command_says_it_or_none(tmp_path, capsys, aside, seed):
    """By sessions of another program: check, calibrate and apply."""
    bench = Bench(Faults(misplaced=aside, coating=0.15), places=16, levels=(10.0,), spacing=4e-3, skin_seed=seed)
    path, c, maps = tmp_path / "s.h5", str(tmp_path / "c.h5"), tmp_path / "maps.h5"
    write(path, simulate(bench))
    assert main(["check", str(path)]) == 0
    said = ["they seem to sit" in capsys.readouterr().out]
    options = ["--fidelity", "draft", "--pixels", "20", "--curve", "linear", "--location", "none"]
    assert main(["calibrate", str(path), "-o", c, "--json", *options]) == 0
    said.append(bool(noted(json.loads(capsys.readouterr().out)["calibration"]["notes"])))
    assert bool(noted(calib.load_calibration(c).notes)) == said[-1]
    assert main(["apply", c, str(path), "-o", str(maps)]) == 0
    said.append(f"note: {NOTE}" in capsys.readouterr().out)
    said.append(NOTE in str(read_archive(maps, "skin-forcemap").attrs.get("outside", "")))
    assert said == [aside > 0] * 4


def test_a_skin_that_cannot_be_told_is_left_alone(skin):
    assert placement_finding(skin, np.full(550, np.nan), np.ones(550, bool)) is None
    assert placement_finding(skin, -np.asarray(je.forward(je.discretise(je.Scene(skin)))), np.ones(550, bool)) is None
