"""Places of electrodes by `jaxeit check --electrodes`: misplaced bolts of the oracle's bench are told, no others."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

import calib
import calib.check.electrodes
import jaxeit as je
from calib.check import ChannelTable, Severity, check_session
from calib.check.eit.reading_order import OrderCheck
from calib.check.electrodes import check_electrodes
from calib.cli import main

from ..helpers import stand_in
from ..oracles.bench import Bench, Faults, simulate, write
from ..oracles.bench.skin import read_skin


def _session(folder, misplaced, seed):
    """A session of a few presses, and the shifts of its bolts, m."""
    bench = Bench(Faults(misplaced=misplaced), places=4, levels=(10.0,), spacing=4e-3, skin_seed=seed, seed=seed)
    path = folder / f"{misplaced}.h5"
    write(path, simulate(bench))
    return path, misplaced * np.random.default_rng([seed, 11]).standard_normal(read_skin().bolts.shape)


@pytest.mark.slow
def test_misplaced_electrodes_are_told(tmp_path, capsys):
    """Bolts 1.1 mm aside, in readings of another program: those accused are off by what is said, within its error."""
    path, shift = _session(tmp_path, 1.1e-3, 31)
    with calib.open_session(path) as session:
        report = check_session(session, electrodes=True)
    (said,) = [f for f in report.findings if f.severity > Severity.OK]
    rows = [row for row in report.electrodes if row.elsewhere]
    assert len(rows) > 5
    assert f"{len(rows)} of 25 electrodes seem to sit elsewhere" in said.what
    assert "--fit-electrodes" in said.remedy
    for row in rows:
        assert np.hypot(*shift[row.electrode]) > 0.4e-3
        assert np.hypot(*(np.array([row.x, row.y]) - shift[row.electrode])) < 4 * row.error
    path, _ = _session(tmp_path, 0.0, 32)
    assert main(["check", str(path), "--electrodes", "--json"]) == 0
    body = json.loads(capsys.readouterr().out)
    assert len(body["electrodes"]) == 25
    assert not any(row["elsewhere"] for row in body["electrodes"])
    assert not [f for f in body["findings"] if f["severity"] != "OK"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["testbed_grid", "testbed_presses"])
def test_shipped_sessions_are_not_accused(root, name):
    with calib.open_session(root / "data" / "sessions" / f"{name}.h5") as session:
        report = check_session(session, electrodes=True)
    assert [f for f in report.findings if f.severity > Severity.OK] == []
    assert max(row.significance for row in report.electrodes) < 3
    assert "no electrode seems to sit elsewhere" in " ".join(f.what for f in report.findings)


def _table(skin, **changes):
    readings = skin.protocol.readings
    parts = {"pattern": skin.protocol.pattern, "mean": np.ones(readings), "bad": np.zeros(readings, bool)}
    return stand_in(ChannelTable, **parts | changes)


def _found(skin, table, order=None):
    findings = []
    return check_electrodes(skin, table, order, findings), findings


def test_what_cannot_be_checked_is_said(skin, monkeypatch):
    table = _table(skin)
    cases = {
        "no EIT voltages": (skin, None, None),
        "describes no skin": (None, table, None),
        "order of the readings": (skin, table, stand_in(OrderCheck, claimed=True)),
        "is not that of the skin": (skin, _table(skin, pattern=skin.protocol.pattern[::-1]), None),
        "only 0 of 550 readings are sound": (skin, _table(skin, bad=np.ones(550, bool)), None),
        "opposite sign": (skin, _table(skin, mean=-np.asarray(je.forward(_draft(skin)))), None),
    }
    for said, given in cases.items():
        rows, (finding,) = _found(*given)
        assert (rows, finding.severity) == ((), Severity.OK)
        assert f"not checked: {said}" in finding.what or said in finding.what
    fit = je.imaging.ElectrodeFit(
        jnp.zeros((25, 2)), 1e-8 * jnp.eye(50), jnp.ones(1), jnp.asarray(7.0), jnp.asarray(True)
    )
    monkeypatch.setattr(calib.check.electrodes, "fit_electrodes", lambda *_: fit)
    rows, (finding,) = _found(skin, table)
    assert (rows, finding.severity) == ((), Severity.WARNING)
    assert "what is left of it is 7 times the errors" in finding.what


def _draft(skin):
    return je.discretise(je.Scene(skin), je.Fidelity.draft())


def test_shifts_are_told_that_are_significant_and_not_small(skin, monkeypatch):
    shift = np.zeros((25, 2))
    shift[[3, 4, 5, 6]] = [2e-3, 0], [0, -1e-3], [3e-4, 0], [9e-4, 0]
    error = np.full((25, 2), 2e-4)
    error[5], error[6] = 5e-5, 5e-4
    fit = je.imaging.ElectrodeFit(
        jnp.asarray(shift), jnp.diag(jnp.asarray(error.ravel() ** 2)), jnp.ones(1), jnp.asarray(0.1), jnp.asarray(True)
    )
    monkeypatch.setattr(calib.check.electrodes, "fit_electrodes", lambda *_: fit)
    rows, (finding,) = _found(skin, _table(skin))
    assert [row.electrode for row in rows if row.elsewhere] == [3, 4]
    assert rows[3].significance == pytest.approx(10)
    said = "no. 3 by 2.0 +- 0.2 mm (x +2.0, y +0.0), no. 4 by 1.0 +- 0.2 mm (x +0.0, y -1.0)"
    assert finding.what == f"2 of 25 electrodes seem to sit elsewhere than the skin's file says: {said}"


def test_a_fit_that_its_steps_ended_is_said(skin, monkeypatch):
    fit = je.imaging.ElectrodeFit(
        jnp.zeros((25, 2)), 1e-8 * jnp.eye(50), jnp.ones(1), jnp.asarray(0.1), jnp.asarray(False)
    )
    monkeypatch.setattr(calib.check.electrodes, "fit_electrodes", lambda *_: fit)
    rows, (first, finding) = _found(skin, _table(skin))
    assert len(rows) == 25
    assert first.severity == finding.severity == Severity.OK
    assert "has not converged: shifts may err by more than their standard errors" in first.what
