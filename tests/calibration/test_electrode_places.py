"""Calibrations of skins whose electrodes are not where the skin's file says."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.calibration.localisation import electrode_places
from calib.calibration.localisation.electrode_places import MOST_PRESSES, spread_presses
from calib.report.document import write_report
from jaxeit.imaging import ElectrodeFit, InverseError

QUICK = calib.Recipe(imaging=je.Imaging(je.Pixels(20)), fidelity=je.Fidelity.draft(), fit_electrodes=True)


@pytest.fixture
def session(root):
    with calib.open_session(root / "data" / "sessions" / "testbed_grid.h5") as opened:
        yield opened


def _fit(shift, misfit):
    """What `fit_electrodes` finds, without its half minute of compiling; the frames that it is given are kept."""
    given = []

    def fit(model, v0, presses):
        given.append((v0, presses))
        return ElectrodeFit(shift, jnp.eye(50) * 1e-8, model.background, jnp.asarray(misfit), jnp.asarray(True))

    return fit, given


@pytest.mark.slow
def test_a_calibration_keeps_the_skin_with_its_electrodes_where_they_sit(session, skin, tmp_path, monkeypatch):
    shift = jnp.zeros((25, 2)).at[12, 0].set(1e-3)
    fit, given = _fit(shift, 0.8)
    monkeypatch.setattr(electrode_places, "fit_electrodes", fit)
    stages = []
    found = calib.calibrate([session], recipe=QUICK, progress=stages.append)
    assert stages[1] == "placing the electrodes"
    note = (
        "electrodes: moved by 0.14 mm in each direction (root mean square), electrode 12 by 1 mm; known to 0.1 mm, from"
    )
    assert any(one.startswith(note) for one in found.notes)
    (v0, presses), *_ = given
    assert np.isfinite(v0).all()
    assert 9 <= len(presses.place) <= MOST_PRESSES
    assert presses.change.shape == (len(presses.place), 550)
    found.save(tmp_path / "c.h5")
    kept = calib.load_calibration(tmp_path / "c.h5")
    for calibration in (found, kept):
        np.testing.assert_allclose(calibration.skin.electrode_positions, skin.electrode_positions + shift, atol=1e-9)
        np.testing.assert_array_equal(calibration.electrodes.shift, shift)
        np.testing.assert_allclose(calibration.electrodes.standard_error, 1e-4)
        assert (calibration.electrodes.misfit, calibration.electrodes.presses) == (0.8, len(presses.place))
    report = write_report(kept, tmp_path / "r.html")
    assert tmp_path / "r_electrodes.png" in report
    assert "Shifts of the electrodes, 10 times larger" in report[0].read_text()
    plain = calib.calibrate([session], recipe=replace(QUICK, fit_electrodes=False))
    assert plain.electrodes is None
    assert float(jnp.abs(found.recon.matrix - plain.recon.matrix).max()) > 1e-3 * float(
        jnp.abs(plain.recon.matrix).max()
    )
    assert calib.evaluate(kept, session).summary()  # the session's own skin is the same hardware


def test_readings_that_no_places_explain_are_refused(session, monkeypatch):
    monkeypatch.setattr(electrode_places, "fit_electrodes", _fit(jnp.zeros((25, 2)), 7.0)[0])
    with pytest.raises(InverseError, match="no places of the electrodes explain the presses"):
        calib.calibrate([session], recipe=QUICK)


def test_presses_are_spread():
    rng = np.random.default_rng(0)
    places = rng.uniform(0, 0.2, (200, 2))
    places[7] = np.nan
    rows = spread_presses(places)
    assert len(set(rows.tolist())) == MOST_PRESSES
    gaps = np.linalg.norm(places[rows][:, None] - places[rows], axis=2) + np.eye(MOST_PRESSES)
    assert gaps.min() > 0.03
    assert len(spread_presses(np.repeat(places[:2], 9, 0))) == 2
    assert not len(spread_presses(np.full((3, 2), np.nan)))


@pytest.mark.slow
def test_electrodes_that_sit_right_stay(session, skin):
    """The electrodes of the bundled session are where its file says; coat, gain and noise are those of its scene."""
    found = calib.calibrate([session], recipe=QUICK)
    shift = found.skin.electrode_positions - skin.electrode_positions
    inner = np.abs(skin.electrode_positions - 0.1).max(1) < 0.05
    assert np.sqrt(np.mean(shift[inner] ** 2)) < 0.25e-3
