"""Logs of presses at many places, with a known gain over the place, for the tests."""

from datetime import UTC, datetime

import numpy as np

from calib.session import SessionFacts, SessionWriter, StreamFacts

RATE = 20.0  # Hz
SIDE = 0.03  # m
SECONDS = 4.0  # of a press, and of the way to the next one


def true_gain(place):
    """Gain at places (n, 2) m: 40 % from side to side, and a bump of 30 % in the middle."""
    u = place / SIDE - 0.5
    return np.exp(0.4 * u[:, 0] + 0.3 * np.exp(-8 * (u**2).sum(1)))


def grid(per_side=7):
    """Places (n, 2) m over the pad."""
    along = np.linspace(0, SIDE, per_side)
    return np.stack(np.meshgrid(along, along, indexing="ij"), -1).reshape(-1, 2)


def place_log(seed, places=None, channels=1, noise=0.05, spread=0.0):
    """Times ns, channels, force N, and place m of one press at each place; F = gain(x) h(s), h(s) = s + s^2 / 20.

    Each channel reads the pressure times its own factor, which depends on the place by `spread`.
    """
    rng = np.random.default_rng(seed)
    places = grid() if places is None else places
    n = int(SECONDS * RATE)
    shape = np.concatenate([np.sin(np.linspace(0, np.pi, n)) ** 2, np.zeros(n // 2)])
    peak = rng.uniform(4, 10, len(places))
    signal = (peak[:, None] * shape).ravel()
    where = np.repeat(places, len(shape), 0)
    force = true_gain(where) * (signal + signal**2 / 20)
    u = where / SIDE - 0.5
    factor = 1 + spread * np.stack([np.cos(k + 2 * u[:, 0] + k * u[:, 1]) for k in range(channels)], 1)
    values = signal[:, None] * factor * (1 + np.arange(channels) / 3) + rng.normal(0, 0.01, (len(signal), channels))
    time = np.rint(np.arange(len(signal)) / RATE * 1e9).astype(np.int64)
    return time, values, force + rng.normal(0, noise, len(force)), where


def write_place_log(path, log, stage=True):
    """A session with the streams force, sensor and, if asked for, stage."""
    time, values, force, place = log
    facts = SessionFacts(title="presses at places", skin_name="", skin_toml="", epoch=datetime(2026, 1, 1, tzinfo=UTC))
    streams = {"force": ("N", force[:, None]), "pressure": ("Pa", values)}
    if stage:
        streams["stage"] = ("m", np.column_stack([place, np.zeros(len(place))]))
    with SessionWriter(path, facts) as writer:
        for name, (unit, columns) in streams.items():
            writer.add_stream(name, StreamFacts(name, units=unit, channels=columns.shape[1], rate_hz=RATE))
            writer.append(name, time, columns)
    return path
