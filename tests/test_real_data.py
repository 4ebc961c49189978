"""Recordings of others, on real hardware; skipped where they are not at hand."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from calib.cli import main

from .helpers import REAL_DATA, skin_of

TANK = sorted((REAL_DATA / "pyeidors_tank" / "tank").glob("*_latest_tank_data/*/*_1000Hz.csv"))

needs_tank = pytest.mark.skipif(not TANK, reason="pyeidors_tank is not at hand; set JAXEIT_REAL_DATA to its folder")


@pytest.fixture(scope="module")
def tank():
    """A 60 mm saline tank with 16 electrodes, in two dimensions."""
    disc = je.Disc(0.03)
    patches = je.skin.rim_electrodes(disc, 16, width=0.4 * disc.perimeter / 16, contact=1e-3)
    skin = skin_of(disc, patches, je.skin.adjacent(16))
    model = je.discretise(je.Scene(skin), je.Fidelity(edge_length=0.05))
    return skin, model, je.Pixels(24).on(model)


def _frames(path):
    """Empty tank and targets; the instrument's polarity is the reverse of ours."""
    table = np.loadtxt(path, delimiter=",")
    return -table[:, 0], -table[:, 2]


@needs_tank
def test_homogeneous_tank_looks_like_the_model(tank):
    _, model, _ = tank
    empty, _ = _frames(TANK[0])
    assert np.corrcoef(empty, np.asarray(je.forward(model)))[0, 1] > 0.98


METHODS = {
    "one step": (je.Noser(), je.OneStep()),
    "Tikhonov": (je.Tikhonov(), je.OneStep()),
    "Laplace": (je.Laplace(), je.OneStep()),
    "Gaussian": (je.GaussianSmooth(0.006), je.OneStep()),
    "truncated": (je.Noser(), je.TruncatedSvd()),
    "back projection": (je.Noser(), je.imaging.BackProjection()),
    "GREIT": (je.Noser(), je.Greit(0.003, 0.006, 0.001)),
    "sparse": (je.Noser(), je.SparseBayes()),
    "total variation": (je.TotalVariation(), je.Reweighted()),
}


@pytest.mark.slow
@needs_tank
@pytest.mark.parametrize("method", METHODS)
def test_sign_of_the_change_at_every_labelled_electrode(tank, method):
    """For every method that images; not for `NonNegative`, since plastic takes conductivity away."""
    skin, model, image = tank
    recon = je.prepare(model, *METHODS[method], image, hyperparameter=0.1)
    wrong = []
    for path in TANK:
        empty, full = _frames(path)
        scale = np.asarray(je.forward(model)) @ empty / (empty @ empty)
        values = np.asarray(recon(jnp.asarray(scale * (full - empty))))
        labels = re.findall(r"electrode(\d+)_(metal|plastic)", path.parent.name)
        assert labels
        for number, kind in labels:
            place = 0.8 * skin.electrode_positions[int(number) - 1]
            near = np.linalg.norm(np.asarray(recon.centres) - place, axis=1) < 0.006
            if np.sign(values[near].sum()) != (1 if kind == "metal" else -1):
                wrong.append((path.parent.name, number, kind))
    assert not wrong


PRESSURE = ["--stream", "pressure=5:bar", "--stream", "force=6:N"]
SCALE = ["--stream", "force=4:g", "--missing", "-1"]
EFLESH = "eflesh/20250401_014340_probe/states.csv"
LOGS = [
    # name, import options, curve, largest held-out error in N
    *(
        (f"pneumatic_actuator/{name}.csv.gz", PRESSURE, "affine", limit)
        for name, limit in (("Circle_1bar", 1.6), ("Circle_5bar", 1.4), ("O-ring257_3bar", 1.5), ("Stadium_1bar", 2.2))
    ),
    (EFLESH, SCALE, "affine", 0.33),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "streams", "curve", "limit"), LOGS)
def test_logs_of_others_are_imported_and_fitted(name, streams, curve, limit, tmp_path, capsys):
    path = REAL_DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not at hand; set JAXEIT_REAL_DATA to its folder")
    session, clock = tmp_path / "log.h5", "0:s" if "eflesh" in name else "0:ms"
    more = []
    if "eflesh" in name:
        sensor = str(path.with_name("sensor_post_baselines.csv"))
        more = ["--from", sensor, "--time", clock, "--stream", "sensor=1-15:counts"]
    assert main(["import", "csv", str(path), "--time", clock, *streams, *more, "-o", str(session)]) == 0
    imported = capsys.readouterr().out
    assert main(["calibrate", str(session), "--curve", curve, "-o", str(tmp_path / "curve.h5")]) == 0
    printed = capsys.readouterr().out
    error = float(re.search(r"force RMSE ([\d.]+) N", printed)[1])
    assert error < limit
    if "eflesh" in name:
        assert "1,740 values declared missing" in imported
        assert "1740 samples without a force" in printed
        assert "N/Pa" not in printed
        assert "chosen: Gaussian process" in printed
