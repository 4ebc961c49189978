"""Sessions of a skin whose pads move, made without the bench: exact gains, offsets and forces, and images of any gain.

A pad reads gain x slope x force plus an offset. A contact of force F at x changes the sheet by a bump whose integral is
gain x sensitivity(x) x F^0.9; voltages follow by the Jacobian. Nothing here calls the code that is tested.
"""

from datetime import UTC, datetime, timedelta

import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib.calibration.calibration import Calibration
from calib.calibration.evaluation import Evaluation, centre_of
from calib.calibration.localisation.press_images import Imager
from calib.fitting.curves import FittedCurve, Linear
from calib.session import PressTable, SessionFacts, SessionWriter, StreamFacts

S = 1_000_000_000
SLOPE = 0.01  # N/Pa
MISFIT = 0.015  # of the pads' force, by place
START = datetime(2026, 11, 16, 9, tzinfo=UTC)
REST, RAMP, HOLD, RELEASE, RECOVERY = 0.7, 0.3, 1.2, 0.3, 1.0  # s
PERIOD = REST + RAMP + HOLD + RELEASE + RECOVERY


def smooth_sensitivity(place):
    """Sensitivity of the sheet (n,) at places (n, 2) m."""
    return 1 + 0.25 * np.sin(25 * place[:, 0]) * np.cos(30 * place[:, 1])


def rough_sensitivity(seed, deviation=0.15):
    """A sensitivity with as much variation at 5 mm as at 100 mm: plane waves of random direction and phase."""
    rng = np.random.default_rng(seed)
    number = 2 * np.pi / np.exp(rng.uniform(np.log(5e-3), np.log(0.2), 400))
    angle, phase = rng.uniform(0, 2 * np.pi, (2, 400))
    waves = number * np.stack([np.cos(angle), np.sin(angle)])
    return lambda place: np.exp(deviation * np.sqrt(2 / 400) * np.cos(place @ waves + phase).sum(1))


class Skin:
    """The skin with its pads and its sheet."""

    def __init__(self, model, pixels):
        self.model, self.skin = model, je.load_skin("testbed")
        self.v0 = np.asarray(je.forward(model))
        recon = je.Imaging(je.Pixels(20)).prepare(model)
        self.recon, self.masks = recon, je.pad_masks(self.skin, recon)
        self.jacobian = np.asarray(je.jacobian(model, basis=pixels))
        self.centres, self.areas = np.asarray(recon.centres), np.asarray(recon.areas)
        self.sensitivity = smooth_sensitivity

    def share(self, place):
        """Part of the force on each pad, (n, 4): lower left, lower right, upper left, upper right."""
        right, upper = (1 / (1 + np.exp(-(place[:, k] - 0.1) / 0.003)) for k in (0, 1))
        left, lower = 1 - right, 1 - upper
        return np.stack([left * lower, right * lower, left * upper, right * upper], 1)

    def pressures(self, place, force, gains):
        odd = 1 + MISFIT * np.sqrt(2) * np.sin(400 * place[:, 0] + 1.7) * np.cos(350 * place[:, 1])
        return self.share(place) * (force * odd)[:, None] / SLOPE * gains

    def readings(self, place, force, gain=1.0):
        """Change of the readings, (n, readings) V."""
        bump = np.exp(-0.5 * np.sum((place[:, None] - self.centres) ** 2, -1) / 0.015**2)
        bump /= bump @ self.areas[:, None]
        return (gain * 1e-6 * self.sensitivity(place) * force**0.9)[:, None] * bump @ self.jacobian.T

    def calibration(self, places=10, loads=(5.0, 10.0, 20.0)):
        """A calibration of presses on a grid, with linear curves that are known to half a percent."""
        line = np.linspace(0.02, 0.18, places)
        place = np.repeat(np.stack(np.meshgrid(line, line), -1).reshape(-1, 2), 1, 0)
        force = np.resize(loads, len(place)).astype(float)
        pressure = self.pressures(place, force, np.ones(4))
        images = Imager(self.recon, self.masks).presses(self.readings(place, force))
        evaluation = Evaluation(
            position=place, estimated=images.estimated, force=force, pressure=pressure, pad_force=pressure * SLOPE,
            image_sum=images.integral, centre=centre_of(self.skin), held_out_by="location",
        )  # fmt: skip
        ones = np.ones(4)
        curves = FittedCurve(
            curve=Linear(), parameters=jnp.full((4, 1), SLOPE), covariance=jnp.full((4, 1, 1), (0.005 * SLOPE) ** 2),
            pressure_range=jnp.tile(jnp.array([0.0, 2100.0]), (4, 1)), scale=jnp.asarray(0.1 * ones),
            residual_rms=jnp.asarray(0.1 * ones), n=jnp.full(4, 100), n_missing=jnp.full(4, 0),
            n_groups=jnp.full(4, 25), rank=jnp.full(4, 1), result=jnp.full(4, 0),
        )  # fmt: skip
        provenance = {"curve": "linear", "location": "none", "recorded_utc": START.isoformat(),
                      "created_utc": START.isoformat(), "hyperparameter": "", "image_rank": ""}  # fmt: skip
        return Calibration(
            skin=self.skin, recon=self.recon, masks=self.masks, curves=curves, evaluation=evaluation,
            provenance=provenance, simulated=True, rest=np.zeros(4),
        )  # fmt: skip

    def record(self, path, place, force, *, gains=1.0, offset=0.0, image_gain=1.0, load_cell=None, days=7.0, seed=0,
               name="testbed", table=True, drift=0.0):  # fmt: skip
        """Write a session of presses; `load_cell`: what it reads of the forces, None: no such stream."""
        rng = np.random.default_rng(seed)
        end = len(force) * PERIOD + RECOVERY + 1
        facts = SessionFacts(
            epoch=START + timedelta(days=days), skin_name=name, skin_toml=self.skin.toml, simulated=True, scene="x = 1",
            seed=0, pattern=self.skin.protocol.pattern, current=self.skin.protocol.current,
        )  # fmt: skip
        with SessionWriter(path, facts) as writer:

            def write(stream, variable, unit, rate, held, noise, level=0.0):
                time = np.arange(0, end, 1 / rate)
                values = _along(time, held) + level + noise * rng.normal(size=(len(time), held.shape[1]))
                if stream == "pressure":
                    values = values + drift * time[:, None] / 3600
                writer.add_stream(stream, StreamFacts(variable, unit, held.shape[1], rate, dtype="f8"))
                writer.append(stream, (time * S).astype(np.int64), values)

            write("eit", "voltage", "V", 10.0, self.readings(place, force, image_gain), 1e-7, self.v0)
            write("pressure", "pressure", "Pa", 50.0, self.pressures(place, force, gains), 2.0, offset)
            if load_cell is not None:
                write("force", "force", "N", 50.0, np.asarray(load_cell)[:, None], 0.01)
            if table:
                writer.set_presses(_table(place, force))
        return path


def _along(time, held):
    """Values of all presses along time: (presses, channels) -> (n, channels)."""
    number, phase = np.divmod(time - 1, PERIOD)
    level = np.interp(phase, np.cumsum([REST, RAMP, HOLD, RELEASE]), [0, 1, 1, 0])
    known = (number >= 0) & (number < len(held))
    return np.where(known, level, 0)[:, None] * held[np.clip(number, 0, len(held) - 1).astype(int)]


def _table(place, force):
    n = len(force)
    start = 1 + np.arange(n) * PERIOD + REST
    times = [
        (t * S).astype(np.int64) for t in (start, start + RAMP, start + RAMP + HOLD, start + RAMP + HOLD + RELEASE)
    ]
    return PressTable(
        place[:, 0], place[:, 1], np.full(n, 0.02), force, *times, np.full(n, -1), np.ones(n, bool), ("",) * n
    )
