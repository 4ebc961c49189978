"""Lies of recordings: one or two of the kinds of `tests.check.test_lies`, at a random place and strength."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from calib.check.eit.reading_order import predict_readings
from tests.check import test_lies as lies
from tests.check.recording import SECOND, Recording

from .honest import Honest
from .telling import Verdict, judged, same, tell

Change = Callable[[Recording], Recording]
Random = np.random.Generator
UNITS = (1e3, 1e-3, 1e6, 1e-6, 101.97, 6894.8, 1e-2, 1e2)  # milli, kilo, micro, mega, gram-force, psi, mbar or cm
STREAMS = ("eit", "pressure", "force")


def pick(rng: Random, values):
    """One of several values."""
    return values[int(rng.integers(len(values)))]


def sign(rng: Random) -> int:
    return pick(rng, (-1, 1))


def nothing(rng: Random, honest: Honest) -> Change:
    """The truth, which must do no harm."""
    return lambda r: r


def in_a_unit(rng: Random, honest: Honest) -> Change:
    """A stream in another unit than is said."""
    return lies.scaled(pick(rng, STREAMS), pick(rng, UNITS))


def reversed_sign(rng: Random, honest: Honest) -> Change:
    return lies.scaled(pick(rng, STREAMS), -1)


def offset(rng: Random, honest: Honest) -> Change:
    """Absolute pressure, or a level that no sensor of this kind has."""
    return lies.added("pressure", sign(rng) * 101325.0 * rng.uniform(0.9, 3))


def magnitudes(rng: Random, honest: Honest) -> Change:
    return lambda r: r.change("eit", np.abs(r.values("eit")))


def other_order(rng: Random, honest: Honest) -> Change:
    """Readings reversed, rolled or permuted."""
    shift, order = int(rng.integers(1, 208)), rng.permutation(208)
    orders = (lambda n: np.arange(n)[::-1], lambda n: np.roll(np.arange(n), shift), lambda n: order)
    return lies.readings(pick(rng, orders))


def exchanged_electrodes(rng: Random, honest: Honest) -> Change:
    """The wires of two electrodes are exchanged."""
    a, b = rng.choice(16, 2, replace=False)
    number = np.arange(16)
    number[[a, b]] = b, a
    pattern, current = honest.recording.facts.pattern, honest.recording.facts.current
    own, wrong = (current * predict_readings(honest.transfer, p) for p in (pattern, number[pattern]))
    return lambda r: r.change("eit", r.values("eit") - own + wrong)


def dead_electrode(rng: Random, honest: Honest) -> Change:
    electrode = int(rng.integers(16))

    def told(r: Recording) -> Recording:
        values = r.values("eit").copy()
        values[:, (r.facts.pattern == electrode).any(1)] = 0.0
        return r.change("eit", values)

    return told


def exchanged_pads(rng: Random, honest: Honest) -> Change:
    """Two columns of pressure or all of them in another place."""
    order = rng.permutation(4)
    return lies.columns("pressure", order if (order != np.arange(4)).any() else order[::-1])


def lost_pad(rng: Random, honest: Honest) -> Change:
    kept = np.delete(np.arange(4), int(rng.integers(4)))
    return lies.columns("pressure", kept)


def one_pad(rng: Random, honest: Honest) -> Change:
    """One column of pressure reversed, in another unit, standing still or without a number."""
    column, how = int(rng.integers(4)), pick(rng, (-1.0, 1e3, 1e-3, 0.0, np.nan))

    def told(r: Recording) -> Recording:
        values = r.values("pressure").copy()
        values[:, column] = np.full(len(values), how) if not how or np.isnan(how) else how * values[:, column]
        return r.change("pressure", values)

    return told


def places(rng: Random, honest: Honest) -> Change:
    """Mirrored, turned, exchanged, in another unit, far off."""
    factor, far = pick(rng, (1e3, 1e2, 1e6, 10.0, 0.1, 1e-3)), sign(rng) * rng.uniform(0.06, 1e5)
    return pick(rng, (
        lies.moved(lambda x, y: 0.2 - x), lies.moved(y=lambda x, y: 0.2 - y),
        lies.moved(lambda x, y: y, lambda x, y: x),
        lies.moved(lambda x, y: 0.2 - x, lambda x, y: 0.2 - y), lies.moved(lambda x, y: x + far),
        lies.moved(y=lambda x, y: y + far), lies.moved(lambda x, y: factor * x, lambda x, y: factor * y),
    ))  # fmt: skip


def table_order(rng: Random, honest: Honest) -> Change:
    """The rows of the table late, in falling order or shuffled."""
    shift, seed = int(rng.integers(1, 15)), int(rng.integers(2**32))

    def shuffled(column: np.ndarray) -> np.ndarray:
        return column[np.random.default_rng(seed).permutation(len(column))]  # another lie may have added rows

    return lies.rows(pick(rng, (lambda c: np.roll(c, shift), lambda c: c[::-1], shuffled)))


def table_numbers(rng: Random, honest: Honest) -> Change:
    """Tips and targets in other units, pads that do not exist or were not pressed."""
    factor, pad = pick(rng, (1e3, 1e-3, 1e2, -1.0)), int(rng.integers(4, 99))
    return pick(rng, (
        lambda r: r.pressed(tip_diameter=abs(factor) * r.presses.tip_diameter),
        lambda r: r.pressed(target_force=factor * r.presses.target_force),
        lambda r: r.pressed(pad=np.full(len(r.presses.pad), pad)),
        lambda r: r.pressed(pad=np.roll(r.presses.pad, 2)),
    ))  # fmt: skip


def table_times(rng: Random, honest: Honest) -> Change:
    """The table in another time, or with presses that overlap."""
    shift = int(sign(rng) * rng.uniform(0.6, 1e4) * SECOND)
    names = ("t_press", "t_hold0", "t_hold1", "t_release")
    return pick(rng, (
        lambda r: r.pressed(**{n: getattr(r.presses, n) + shift for n in names}),
        lambda r: r.pressed(t_release=r.presses.t_release + abs(shift)),
    ))  # fmt: skip


def late(rng: Random, honest: Honest) -> Change:
    return lies.late(pick(rng, ("eit", "pressure")), sign(rng) * rng.uniform(0.5, 9))


def clock_step(rng: Random, honest: Honest) -> Change:
    """The clock of a device is set in the middle of the recording."""
    name, where, step = pick(rng, STREAMS), rng.uniform(0.2, 0.8), int(rng.uniform(0.6, 30) * SECOND)

    def told(r: Recording) -> Recording:
        time = r.streams[name].time.copy()
        time[int(where * len(time)) :] += step
        return r.at(name, time)

    return told


def other_seconds(rng: Random, honest: Honest) -> Change:
    """All times in another unit than s, beside rates in Hz that are true."""
    factor = pick(rng, (1000.0, 100.0, 60.0, 10.0, 0.1, 0.01))
    names = ("t_press", "t_hold0", "t_hold1", "t_release")

    def told(r: Recording) -> Recording:
        for name, s in r.streams.items():
            r = r.at(name, s.time * factor)
        return r.pressed(**{n: (getattr(r.presses, n) * factor).astype(np.int64) for n in names})

    return told


def standing_still(rng: Random, honest: Honest) -> Change:
    first = rng.uniform(0.1, 0.6)
    return lies.frozen(pick(rng, STREAMS), first, first + rng.uniform(0.2, 0.35))


def missing(rng: Random, honest: Honest) -> Change:
    """No number in a stream for a part of the recording, or throughout."""
    name, first, part = pick(rng, STREAMS), rng.uniform(0, 0.6), rng.uniform(0.1, 1)

    def told(r: Recording) -> Recording:
        values = r.values(name).copy()
        values[int(first * len(values)) : int((first + part) * len(values))] = np.nan
        return r.change(name, values)

    return told


def never_measured(rng: Random, honest: Honest) -> Change:
    """EIT or pressure of the untouched skin, frames twice, the recording twice, cut off by the converter, constant."""
    name = pick(rng, ("eit", "pressure"))
    return pick(rng, (
        lies.at_rest(name), lies.doubled_frames, lies.pasted_twice, lies.clipped, lies.unpressed, lies.half_listed,
        lambda r: r.change(name, np.tile(r.values(name)[:1], (len(r.values(name)), 1))),
    ))  # fmt: skip


KINDS = (
    nothing, in_a_unit, reversed_sign, offset, magnitudes, other_order, exchanged_electrodes, dead_electrode,
    exchanged_pads, lost_pad, one_pad, places, table_order, table_numbers, table_times, late, clock_step, other_seconds,
    standing_still, missing, never_measured,
)  # fmt: skip


def lie(rng: Random, honest: Honest, folder: Path) -> tuple[str, Verdict]:
    """Tell one lie or two of different kinds to `check`; without a word, compare what `apply` and `evaluate` give."""
    chosen = [KINDS[i] for i in rng.choice(len(KINDS), 1 + (rng.random() < 0.3), replace=False)]
    chosen.sort(key=lambda kind: kind is lost_pad)  # last: other kinds change one of all pads
    recording, name = honest.recording, " and ".join(kind.__name__ for kind in chosen)
    for kind in chosen:
        recording = kind(rng, honest)(recording)
    path = recording.write(folder / "lie.h5")
    verdict = judged(tell("check", path, "--json"))
    return name, verdict or _compared(honest, path)


def _compared(honest: Honest, path: Path) -> Verdict:
    maps, answer = honest.force_maps(honest.folder / "c.h5", path)
    summary, evaluated = honest.evaluated(path)
    for refusal in (answer, evaluated):
        if refusal.refused:
            return Verdict("refused", refusal.err)
    true = honest.summary
    wrong = [name for name in honest.maps if not same(maps[name], honest.maps[name])]
    wrong += [name for name in true if not same(summary.get(name) or np.nan, true[name] or np.nan)]
    return Verdict("SILENT", f"no word, and {', '.join(wrong[:4])} differ") if wrong else Verdict("harmless")
