"""Recordings that are well formed and cannot be true: each lie is told, and the words that name it are read."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest

import jaxeit as je
from calib.bench import simulate
from calib.check import Severity, check_session, render, transfer_matrix
from calib.check.eit.reading_order import predict_readings
from calib.check.evidence import PressEvidence
from calib.check.presses.pad_responses import pad_response_findings
from calib.check.presses.places import pads_under
from calib.session import StreamFacts, open_session

from ..helpers import stand_in
from .honest import sixteen_presses
from .recording import SECOND, Recording, Samples

ERROR, WARNING = Severity.ERROR, Severity.WARNING


@pytest.fixture(scope="module")
def honest(skin, tmp_path_factory):
    """Sixteen presses of the testbed with noise, as a file would hold them; nothing tells that they were simulated."""
    bench = sixteen_presses(skin, blank=4.0, pad_rate=100.0)
    path = simulate(bench, tmp_path_factory.mktemp("honest") / "s.h5", fidelity=je.Fidelity.draft())
    with open_session(path) as session:
        return Recording.of(session)


@pytest.fixture(scope="module")
def transfer(skin):
    return transfer_matrix(skin)


@pytest.fixture
def findings(tmp_path, transfer):
    """Write a recording and check it; the findings above a note."""

    def of(recording):
        with open_session(recording.write(tmp_path / "s.h5")) as session:
            report = check_session(session, transfer=transfer)
        page = render(report)
        assert max(map(len, page.splitlines())) <= 100
        return [f for f in report.findings if f.severity > Severity.OK]

    return of


def test_an_honest_recording_has_no_finding(honest, findings):
    assert findings(honest) == []


def test_an_honest_recording_without_a_table_has_no_finding(honest, findings):
    assert findings(stage_for_table(honest)) == []


def test_a_recording_that_begins_in_mid_press_is_not_negative(honest, findings):
    """Without a table, the rests between the presses look like presses of the negated force."""
    start = honest.presses.t_hold0[0] + SECOND // 2
    cut = honest
    for name, s in honest.streams.items():
        cut = cut.with_stream(name, replace(s, time=s.time[s.time >= start], values=s.values[s.time >= start]))
    force = cut.values("force")
    for level in (0.0, force[0]):  # also with a load cell that was tared under load
        found = findings(stage_for_table(cut.change("force", force - level)))
        assert not any("negative" in f.what for f in found), found


# --- how lies are told ---------------------------------------------------------------------------


def stage_for_table(recording, place=lambda p: p):
    """The places of the presses in a stage stream, and no table of presses."""
    force, table = recording.streams["force"], recording.presses
    row = np.clip(np.searchsorted(table.t_press, force.time, side="right") - 1, 0, None)
    sites = place(np.stack([table.x, table.y], 1))
    stage = Samples(StreamFacts("position", units="m", channels=2, rate_hz=100.0), force.time, sites[row])
    return replace(recording.with_stream("stage", stage), presses=None)


def scaled(name, factor):
    return lambda r: r.change(name, factor * r.values(name))


def added(name, shift):
    return lambda r: r.change(name, shift + r.values(name))


def columns(name, order):
    return lambda r: r.change(name, r.values(name)[:, order])


def late(name, seconds):
    return lambda r: r.at(name, r.streams[name].time + int(seconds * SECOND))


def table_late(seconds):
    return lambda r: r.pressed(
        **{n: getattr(r.presses, n) + int(seconds * SECOND) for n in ("t_press", "t_hold0", "t_hold1", "t_release")}
    )


def in_blocks(name, size):
    """The samples of a block have the time stamp of its first one, and a microsecond more each."""

    def tell(r):
        time, index = r.streams[name].time, np.arange(len(r.streams[name].time))
        return r.at(name, time[index // size * size] + index % size * 1000)

    return tell


def table_at_rate(factor):
    """The times of the table run at another rate."""

    def tell(r):
        times = {n: getattr(r.presses, n) for n in ("t_press", "t_hold0", "t_hold1", "t_release")}
        first = times["t_press"][0]
        return r.pressed(**{n: first + ((t - first) * factor).astype(np.int64) for n, t in times.items()})

    return tell


def turned(degrees):
    """The places are turned about the middle of the sheet."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return moved(lambda x, y: 0.1 + c * (x - 0.1) - s * (y - 0.1), lambda x, y: 0.1 + s * (x - 0.1) + c * (y - 0.1))


def at_rate(name, factor):
    """The time stamps of one stream run at another rate."""
    return lambda r: r.at(name, r.streams[name].time * factor)


def jump(name, seconds):
    """The clock of one stream jumps in the middle."""

    def tell(r):
        time = r.streams[name].time.copy()
        time[len(time) // 2 :] += int(seconds * SECOND)
        return r.at(name, time)

    return tell


def moved(x=lambda x, y: x, y=lambda x, y: y):
    return lambda r: r.pressed(x=x(r.presses.x, r.presses.y), y=y(r.presses.x, r.presses.y))


def rows(order):
    return lambda r: r.pressed(x=order(r.presses.x), y=order(r.presses.y), pad=order(r.presses.pad))


def readings(order):
    return lambda r: r.change("eit", r.values("eit")[:, order(len(r.values("eit")[0]))])


def in_half(name, change, first=False):
    """A change of the values of one stream in its second half, or in its first one."""

    def tell(r):
        values = r.values(name).copy()
        half = slice(None, len(values) // 2) if first else slice(len(values) // 2, None)
        values[half] = change(values[half])
        return r.change(name, values)

    return tell


def channels(name, numbers, factor):
    """Some channels of one stream are multiplied."""

    def tell(r):
        values = r.values(name).copy()
        values[:, numbers] *= factor
        return r.change(name, values)

    return tell


def clipped_at(name, limit, numbers=slice(None)):
    """Some channels of one stream read no more than a limit."""

    def tell(r):
        values = r.values(name).copy()
        values[:, numbers] = np.minimum(values[:, numbers], limit)
        return r.change(name, values)

    return tell


def drive_scaled(a, b, factor):
    """All readings of one drive pair are multiplied."""
    return lambda r: channels("eit", (r.facts.pattern[:, :2] == [a, b]).all(1), factor)(r)


def lost_electrode(noise, half=False):
    """The readings of electrode 12 are noise, in the whole recording or in its second half."""

    def tell(r):
        lost = (r.facts.pattern == 12).any(1)
        values = r.values("eit").copy()
        some = slice(len(values) // 2 if half else 0, None)
        shape = values[some][:, lost].shape
        values[some, lost] = np.random.default_rng(0).normal(0, noise, shape)
        return r.change("eit", values)

    return tell


def pair_exchanged(first, second, half=False):
    """The wires of two electrodes are exchanged, in the whole recording or in its second half."""

    def tell(r):
        number = np.arange(25)
        number[[first, second]] = second, first
        patterns = r.facts.pattern, number[r.facts.pattern]
        transfer = transfer_matrix(je.load_skin(r.facts.skin_name))
        own, wrong = (r.facts.current * predict_readings(transfer, pattern) for pattern in patterns)
        values = r.values("eit").copy()
        values[len(values) // 2 if half else 0 :] += wrong - own
        return r.change("eit", values)

    return tell


def dead_electrode(value):
    def tell(r):
        values = r.values("eit").copy()
        values[:, (r.facts.pattern == 12).any(1)] = value
        return r.change("eit", values)

    return tell


def frozen(name, first, last, numbers=slice(None)):
    """A stream, or some channels of it, stands still for a part of the recording."""

    def tell(r):
        values = r.values(name).copy()
        a, b = int(first * len(values)), int(last * len(values))
        values[a:b, numbers] = values[a, numbers]
        return r.change(name, values)

    return tell


def cells(name, value):
    """Single cells in a hundred hold a value that stands for no reading."""

    def tell(r):
        values = r.values(name).copy()
        values[np.random.default_rng(1).random(values.shape) < 0.01] = value
        return r.change(name, values)

    return tell


def at_rest(name):
    """A stream shows its rest for ever, with its noise."""

    def tell(r):
        values, table, time = r.values(name), r.presses, r.streams[name].time
        rest = values[time < table.t_press[0] - SECOND]
        rest = rest if len(rest) else values[:1]  # the table was moved before, and lists no rest
        return r.change(name, rest[np.random.default_rng(1).integers(0, len(rest), len(values))])

    return tell


def doubled_frames(r):
    values = r.values("eit").copy()
    values[1::2] = values[: len(values) - len(values) % 2 : 2]
    return r.change("eit", values)


def pasted_twice(r):
    """The same recording once more behind itself, with time stamps that go on."""
    out, span = r, max(s.time[-1] for s in r.streams.values()) + SECOND // 10
    for name, s in r.streams.items():
        out = out.with_stream(name, replace(s, time=np.r_[s.time, s.time + span], values=np.r_[s.values, s.values]))
    table = r.presses
    twice = {n: np.tile(getattr(table, n), 2) for n in ("x", "y", "tip_diameter", "target_force", "pad", "accepted")}
    times = {n: np.r_[getattr(table, n), getattr(table, n) + span] for n in table.__dataclass_fields__ if n[:2] == "t_"}
    return out.pressed(**twice, **times, reason=table.reason * 2)


def clipped(r):
    values = r.values("eit")
    limit = np.sort(np.abs(values).max(0))[-80]
    return r.change("eit", np.clip(values, -limit, limit))


def cells_shifted(r):
    """The log of a table in which, from the middle on, each cell stands one column further right."""
    table = np.concatenate([r.values("force"), r.values("pressure")], 1)
    half = len(table) // 2
    table[half:] = np.roll(table[half:], 1, axis=1)
    log = replace(r.without("eit"), presses=None)
    return log.change("force", table[:, :1]).change("pressure", table[:, 1:])


def slowed(factor):
    """All time stamps in another unit than they are said to be."""

    def tell(r):
        for name, s in r.streams.items():
            r = r.with_stream(
                name, replace(s.at(s.time * factor), facts=replace(s.facts, rate_hz=s.facts.rate_hz / factor))
            )
        return r.pressed(**{n: getattr(r.presses, n) * factor for n in ("t_press", "t_hold0", "t_hold1", "t_release")})

    return tell


def unpressed(r):
    """The force of every other press is cut out."""
    values, time = r.values("force").copy(), r.streams["force"].time
    for start, stop in zip(r.presses.t_press[::2], r.presses.t_release[::2], strict=True):
        values[(time > start - SECOND // 5) & (time < stop + SECOND // 5)] = values[0]
    return r.change("force", values)


def half_listed(r):
    kept = np.arange(len(r.presses)) % 2 == 0
    return replace(r, presses=replace(r.presses, **{
        n: tuple(np.array(v)[kept]) if isinstance(v := getattr(r.presses, n), tuple) else v[kept]
        for n in r.presses.__dataclass_fields__
    }))  # fmt: skip


def with_temperature(r):
    time = r.streams["force"].time[::100]
    values = np.full((len(time), 1), 21.5)
    return r.with_stream(
        "temperature", Samples(StreamFacts("temperature", units="K", channels=1, rate_hz=1.0), time, values)
    )


class Lie(NamedTuple):
    tell: Callable[[Recording], Recording]
    severity: Severity
    words: tuple[str, ...]


LIES = {
    # units
    "force in mN": Lie(scaled("force", 1e3), WARNING, ("/streams/force", "times the target")),
    "force in kN": Lie(scaled("force", 1e-3), WARNING, ("/streams/force", "times the target")),
    "force in kN up to the middle": Lie(
        in_half("force", lambda v: v / 1e3, first=True),
        WARNING,
        ("0.001 times the target", "up to 24.4 s after the start, 1 times"),
    ),
    "force doubled from the middle on": Lie(
        in_half("force", lambda v: 2 * v), WARNING, ("2 times the target of the presses from 27.7 s",)
    ),
    "targets of other presses": Lie(
        lambda r: r.pressed(target_force=np.roll(r.presses.target_force, 1)),
        WARNING,
        ("targets are not those of the presses", "1 press too late"),
    ),
    "force of the unloaded cell": Lie(at_rest("force"), ERROR, ("/streams/force", "no press changes the force")),
    "force constant": Lie(lambda r: r.change("force", 0 * r.values("force") + 3), ERROR, ("always reads 3 N",)),
    "force in mN, no target": Lie(
        lambda r: scaled("force", 1e3)(r).pressed(target_force=np.zeros(16)), WARNING, ("what the pressures", "unit")
    ),
    "load in g": Lie(scaled("force", 1 / 9.80665e-3), WARNING, ("/streams/force", "times the target")),
    "force of a converter's counts": Lie(scaled("force", 1e4), WARNING, ("cannot be true",)),
    "one pad in kPa": Lie(
        channels("pressure", [0], 1e-3), WARNING, ("column 0, pad 'lower left', reads 0.001 times", "kPa")
    ),
    "one pad of ten times the gain": Lie(
        channels("pressure", [1], 10), WARNING, ("column 1, pad 'lower right', reads 9.9 times",)
    ),
    "pads at -20 kPa": Lie(added("pressure", -2e4), WARNING, ("lie below the sensor's span",)),
    "load cell that clips": Lie(clipped_at("force", 12.0), WARNING, ("/streams/force: clips at 12 N", "5 flat tops")),
    "pad that clips": Lie(clipped_at("pressure", 600.0, [1]), WARNING, ("column 1 clips at 600 Pa", "flat tops")),
    "pressure in kPa": Lie(scaled("pressure", 1e-3), WARNING, ("/streams/pressure", "kPa or bar")),
    "pressure in mbar": Lie(scaled("pressure", 1e-2), WARNING, ("/streams/force", "a unit of one of the two")),
    "pressure in mPa": Lie(scaled("pressure", 1e3), WARNING, ("beyond the sensor's span",)),
    "absolute pressure": Lie(added("pressure", 101325.0), WARNING, ("beyond the sensor's span", "gage")),
    "voltage in mV": Lie(scaled("eit", 1e3), WARNING, ("/streams/eit", "times the model's")),
    "voltage in kV": Lie(scaled("eit", 1e-3), WARNING, ("/streams/eit", "times the model's")),
    "places in mm": Lie(moved(lambda x, y: 1e3 * x, lambda x, y: 1e3 * y), ERROR, ("outside the sheet", "press 0")),
    "places in um on the stage": Lie(lambda r: stage_for_table(r, lambda p: 1e6 * p), ERROR, ("outside the sheet",)),
    "places 100 km off": Lie(moved(lambda x, y: x + 1e5), ERROR, ("outside the sheet",)),
    "tip in mm": Lie(lambda r: r.pressed(tip_diameter=np.full(16, 20.0)), WARNING, ("a tip of 20 m",)),
    "temperature in degC as K": Lie(with_temperature, WARNING, ("temperature", "21.5 K cannot be true")),
    "time in ms as s": Lie(slowed(1000), WARNING, ("Hz", "another unit")),
    # signs
    "force pulls": Lie(scaled("force", -1), ERROR, ("negative while pressing",)),
    "force pulls, no table": Lie(
        lambda r: stage_for_table(scaled("force", -1)(r)), ERROR, ("negative while pressing",)
    ),
    "force pulls up to the middle": Lie(
        in_half("force", lambda v: -v, first=True), ERROR, ("negative while pressing up to 24.4 s",)
    ),
    "changes of EIT reversed from the middle on": Lie(
        lambda r: in_half("eit", lambda v: 2 * np.median(r.values("eit")[:60], 0) - v)(r),
        ERROR,
        ("the changes of the readings have the opposite sign from",),
    ),
    "targets that are negative": Lie(
        lambda r: r.pressed(target_force=-r.presses.target_force), WARNING, ("/presses", "target_force is negative")
    ),
    "pressure falls on pressing": Lie(scaled("pressure", -1), ERROR, ("falls on pressing", "16 of 16")),
    "one pad falls on pressing": Lie(
        lambda r: r.change("pressure", r.values("pressure") * [1, 1, -1, 1]),
        ERROR,
        ("column 2, pad 'upper left', falls on pressing", "4 of 4"),
    ),
    "voltages reversed": Lie(scaled("eit", -1), ERROR, ("every sign is reversed",)),
    "magnitudes": Lie(lambda r: r.change("eit", np.abs(r.values("eit"))), ERROR, ("magnitudes without sign",)),
    "voltages reversed from the middle on": Lie(
        in_half("eit", lambda v: -v), ERROR, ("untouched skin differ from 28.4 s", "every sign is reversed")
    ),
    "voltages reversed up to the middle": Lie(
        in_half("eit", lambda v: -v, first=True),
        ERROR,
        ("untouched skin differ up to 28.4 s", "every sign is reversed"),
    ),
    "magnitudes from the middle on": Lie(in_half("eit", np.abs), ERROR, ("differ from 28.4 s", "magnitudes")),
    "voltage in mV up to the middle": Lie(
        in_half("eit", lambda v: 1e3 * v, first=True), ERROR, ("differ up to 28.4 s", "1000 times that of the other")
    ),
    "gain of EIT 1.1 from the middle on": Lie(
        in_half("eit", lambda v: 1.1 * v), WARNING, ("differ from 28.4 s", "1.1 times that of the other frames")
    ),
    "EIT less a frame of the untouched skin": Lie(
        lambda r: r.change("eit", r.values("eit") - r.values("eit")[:40].mean(0)),
        WARNING,
        ("/streams/eit", "a reference frame was subtracted", "record the voltages themselves"),
    ),
    "offset of EIT": Lie(added("eit", 0.01), WARNING, ("/streams/eit", "+0.0101 V in addition", "offset")),
    "one reading reversed": Lie(channels("eit", [275], -1), WARNING, ("reading 275 has the opposite sign",)),
    "one reading twice as large": Lie(channels("eit", [100], 2), WARNING, ("reading 100 is 2 times",)),
    "one drive reversed": Lie(drive_scaled(12, 13, -1), WARNING, ("all that drive with 12-13", "the opposite sign")),
    "one drive in mV": Lie(drive_scaled(12, 13, 1e3), WARNING, ("all that drive with 12-13", "times the reading")),
    "three pads fall on pressing": Lie(
        channels("pressure", [0, 1, 3], -1), ERROR, ("column 1, pad 'lower right', falls on pressing", "4 of 4")
    ),
    "pressure falls on pressing from the middle on": Lie(
        in_half("pressure", lambda v: -v), ERROR, ("falls on pressing", "all of them from 27.7 s after the start on")
    ),
    # order
    "two readings exchanged": Lie(
        readings(lambda n: np.r_[np.arange(5), 300, np.arange(6, 300), 5, np.arange(301, n)]),
        WARNING,
        ("readings are exchanged", "5 and 300"),
    ),
    "readings rolled from the middle on": Lie(
        in_half("eit", lambda v: np.roll(v, -7, axis=1)), ERROR, ("differ from 28.4 s", "starts at reading 7 ")
    ),
    "readings in reversed order": Lie(readings(lambda n: np.arange(n)[::-1]), ERROR, ("reversed order",)),
    "readings rolled": Lie(readings(lambda n: np.roll(np.arange(n), -7)), ERROR, ("starts at reading 7 ",)),
    "electrode pair exchanged": Lie(pair_exchanged(3, 17), ERROR, ("electrodes 3 and 17 are exchanged",)),
    "electrode pair exchanged from the middle on": Lie(
        pair_exchanged(11, 12, half=True), ERROR, ("differ from 28.4 s", "electrodes 11 and 12 are exchanged")
    ),
    "neighbouring electrodes exchanged": Lie(pair_exchanged(23, 24), ERROR, ("electrodes 23 and 24 are exchanged",)),
    "pressure columns exchanged": Lie(
        columns("pressure", [1, 0, 2, 3]), ERROR, ("column 1 responds over pad 'lower left'",)
    ),
    "pressure columns exchanged from the middle on": Lie(
        in_half("pressure", lambda v: v[:, [1, 2, 3, 0]]),
        ERROR,
        ("responds from 31.0 s after the start on", "column 1 responds over pad 'upper left'"),
    ),
    "one pressure column for all pads": Lie(
        columns("pressure", [0, 0, 0, 0]), ERROR, ("hold the same values: 0 and 1",)
    ),
    "pressure columns exchanged, no table": Lie(
        lambda r: stage_for_table(columns("pressure", [0, 1, 3, 2])(r)),
        ERROR,
        ("column 3 responds over pad 'upper left'",),
    ),
    "a pressure column too few": Lie(columns("pressure", [0, 1, 2]), ERROR, ("has 3 columns",)),
    "cells one column further right": Lie(cells_shifted, WARNING, ("columns look exchanged", "that of pressure[0]")),
    # places
    "x and y exchanged": Lie(moved(lambda x, y: y, lambda x, y: x), ERROR, ("x and y are exchanged",)),
    "x mirrored": Lie(moved(lambda x, y: 0.2 - x), ERROR, ("x is mirrored",)),
    "y mirrored on the stage": Lie(
        lambda r: stage_for_table(r, lambda p: p * [1, -1] + [0, 0.2]), ERROR, ("y is mirrored",)
    ),
    "stage turned": Lie(moved(lambda x, y: 0.2 - x, lambda x, y: 0.2 - y), ERROR, ("turned by 180",)),
    "table one press late": Lie(rows(lambda c: np.roll(c, 1)), ERROR, ("one press late",)),
    "table in reversed order": Lie(rows(lambda c: c[::-1]), ERROR, ("/presses", "places look wrong")),
    "table shuffled": Lie(
        rows(lambda c: c[np.random.default_rng(8).permutation(16)]), WARNING, ("do not match the readings",)
    ),
    "table five presses late": Lie(rows(lambda c: np.roll(c, 5)), ERROR, ("places look wrong", "5 presses late")),
    "x mirrored from the middle on": Lie(
        moved(lambda x, y: np.where(np.arange(16) < 8, x, 0.2 - x)),
        ERROR,
        ("look wrong from 31.0 s after the start on", "x is mirrored"),
    ),
    "two presses exchanged": Lie(
        rows(lambda c: np.r_[c[15], c[1:15], c[0]]), WARNING, ("in 2 presses", "presses 0 and 15 look exchanged")
    ),
    "one press elsewhere": Lie(
        moved(lambda x, y: np.r_[0.17, x[1:]], lambda x, y: np.r_[0.165, y[1:]]),
        WARNING,
        ("elsewhere than listed in 1 press", "press 0 near x = 0.028 m"),
    ),
    "places shifted by 20 mm": Lie(moved(lambda x, y: x + 0.02), WARNING, ("the places look shifted by +18 mm in x",)),
    "places turned by 10 degrees": Lie(turned(10), WARNING, ("the places look turned by 11 degrees",)),
    "places scaled by a half": Lie(
        moved(lambda x, y: 0.05 + x / 2, lambda x, y: 0.05 + y / 2), WARNING, ("the places look scaled by 0.52",)
    ),
    "places scaled in x": Lie(moved(lambda x, y: x / 2), WARNING, ("the places look scaled by 0.52 in x",)),
    "places in km": Lie(
        moved(lambda x, y: x / 1e3, lambda x, y: y / 1e3), WARNING, ("do not match", "all x lie within 0.14 mm")
    ),
    "a stage that stands still, no table": Lie(
        lambda r: stage_for_table(r, lambda p: 0 * p + 0.07),
        WARNING,
        ("do not match", "all x lie within 0 mm, near 0.07 m"),
    ),
    "a pad that is not under the tip": Lie(
        lambda r: r.pressed(pad=np.full(16, 2)), WARNING, ("name a pad that is not under",)
    ),
    "a pad that does not exist": Lie(lambda r: r.pressed(pad=np.full(16, 7)), WARNING, ("name a pad",)),
    "origin of the stage moved": Lie(
        lambda r: replace(stage_for_table(r, lambda p: np.add(p, (0.012, 0.0))), presses=r.presses),
        WARNING,
        ("+12.0 mm in x",),
    ),
    "pads never pressed": Lie(
        lambda r: r.pressed(accepted=(r.presses.y < 0.1) | (r.presses.x < 0.1), reason=("",) * 16),
        WARNING,
        ("none of 12 presses lies on 1 pad of 4: upper right",),
    ),
    # time
    "EIT 0.5 s late": Lie(late("eit", 0.5), ERROR, ("/streams/eit", "after the force")),
    "pressure 0.5 s early": Lie(late("pressure", -0.5), ERROR, ("/streams/pressure", "0.500 s before the force")),
    "pressure 7 s late": Lie(late("pressure", 7.0), ERROR, ("/streams/pressure", "7.000 s after", "when moved")),
    "EIT 3.3 s late, a press": Lie(late("eit", 3.3), ERROR, ("/streams/eit", "3.300 s after", "when moved")),
    "pressure 3.3 s early, a press": Lie(
        late("pressure", -3.3), ERROR, ("/streams/pressure", "3.300 s before", "when moved")
    ),
    "EIT 9 s late": Lie(late("eit", 9.0), ERROR, ("/streams/eit", "9.000 s after", "when moved")),
    "pressure 0.3 s late": Lie(late("pressure", 0.3), ERROR, ("/streams/pressure", "0.300 s after the force")),
    "pressure 3.1 s late": Lie(late("pressure", 3.1), ERROR, ("/streams/pressure", "3.100 s after the force")),
    "EIT 1.5 s late": Lie(late("eit", 1.5), ERROR, ("/streams/eit", "1.500 s after the force")),
    "pressure at 1.005 times its rate": Lie(at_rate("pressure", 1.005), ERROR, ("/streams/pressure", "another rate")),
    "force at 0.995 times its rate": Lie(at_rate("force", 0.995), ERROR, ("/streams/pressure", "another rate")),
    "clock of the EIT jumps by 2 s": Lie(jump("eit", 2.0), ERROR, ("second half", "2.000 s after", "jumped")),
    "clock of the pressure jumps by 0.5 s": Lie(jump("pressure", 0.5), ERROR, ("second half", "0.500 s after")),
    "time stamps in blocks": Lie(
        in_blocks("pressure", 50), WARNING, ("/streams/pressure", "in blocks of 50 samples", "a block every 0.5 s")
    ),
    "table 1.5 s late": Lie(table_late(1.5), ERROR, ("/presses", "1.500 s before the presses of the table")),
    "table late by a press": Lie(
        table_late(3.3), WARNING, ("targets are not those of the presses", "1 press too late")
    ),
    "table at 1.01 times its rate": Lie(table_at_rate(1.01), ERROR, ("/presses", "more and more late", "another rate")),
    "no press accepted": Lie(
        lambda r: r.pressed(accepted=np.zeros(16, bool), reason=("",) * 16), ERROR, ("all are set aside",)
    ),
    "most presses set aside": Lie(
        lambda r: r.pressed(accepted=np.arange(16) > 9, reason=("",) * 16),
        WARNING,
        ("/presses", "10 of 16 presses are set aside (accepted = 0)"),
    ),
    "table 0.3 s late": Lie(table_late(0.3), ERROR, ("/presses", "0.300 s before the presses of the table")),
    "table 0.5 s early": Lie(table_late(-0.5), ERROR, ("/presses", "0.500 s after the presses of the table")),
    "table of another recording": Lie(
        lambda r: r.pressed(
            **{n: getattr(r.presses, n) + 10**12 for n in r.presses.__dataclass_fields__ if n[:2] == "t_"}
        ),
        ERROR,
        ("none of 16 presses can be used",),
    ),
    "presses that overlap": Lie(
        lambda r: r.pressed(t_release=r.presses.t_release + 4 * SECOND), WARNING, ("begin before",)
    ),
    # what was never measured
    "EIT constant": Lie(
        lambda r: r.change("eit", np.tile(r.values("eit")[:1], (len(r.values("eit")), 1))), ERROR, ("never change",)
    ),
    "EIT of the untouched skin": Lie(at_rest("eit"), ERROR, ("no reading changes", "16 of 16")),
    "EIT frozen": Lie(frozen("eit", 0.5, 0.8), WARNING, ("equal the one before", "the longest for")),
    "EIT frozen at the end": Lie(frozen("eit", 0.9, 1.0), WARNING, ("/streams/eit", "stands still for 5.65 s")),
    "one pressure column frozen": Lie(
        frozen("pressure", 0.5, 0.7, 0), WARNING, ("/streams/pressure: column 0 stands still for 11.3 s",)
    ),
    "every frame twice": Lie(doubled_frames, WARNING, ("50 % of its frames equal the one before",)),
    "recording pasted twice": Lie(pasted_twice, WARNING, ("copies of earlier ones",)),
    "EIT at the converter's end": Lie(clipped, ERROR, ("saturated",)),
    "an electrode dead from the middle on": Lie(
        lost_electrode(0.0, half=True), ERROR, ("differ from 28.4 s", "hold no voltage", "all with electrode 12")
    ),
    "an electrode that reads noise": Lie(lost_electrode(1e-5), ERROR, ("readings of electrode 12", "only noise")),
    "an electrode dead": Lie(dead_electrode(0.0), ERROR, ("all of them use electrode 12",)),
    "pressure frozen": Lie(frozen("pressure", 0.5, 0.8), WARNING, ("no pad feels",)),
    "pressure of the last moment for ever": Lie(
        frozen("pressure", 0.9, 1.0), WARNING, ("/streams/pressure", "stands still for")
    ),
    "pressure of untouched pads": Lie(
        at_rest("pressure"), WARNING, ("/streams/force", "the pressures of the pads bear")
    ),
    "force missing throughout": Lie(
        lambda r: r.change("force", np.full_like(r.values("force"), np.nan)),
        ERROR,
        ("/streams/force", "no finite value"),
    ),
    "force missing throughout, no table": Lie(
        lambda r: replace(r.change("force", np.full_like(r.values("force"), np.nan)), presses=None),
        ERROR,
        ("/streams/force", "no finite value"),
    ),
    "values of single pads 65535, without a reading": Lie(
        cells("pressure", 65535.0), WARNING, ("/streams/pressure", "single values are one and the same", "in column 2")
    ),
    "frames of force 999, without a reading": Lie(
        cells("force", 999.0), WARNING, ("/streams/force", "single frames are one and the same, all 999")
    ),
    "pressure without force": Lie(unpressed, WARNING, ("without force",)),
    "force outside the listed presses": Lie(half_listed, WARNING, ("outside the listed presses", "8 contacts")),
}


def test_a_hum_is_no_value_for_missing_ones(honest, findings):
    """Its extremes repeat to the last digit; one value for no reading stands by far the most often."""
    force = honest.values("force")
    hum = 5 * np.round(np.sin(2 * np.pi * 0.503 * np.arange(len(force))), 2)[:, None]
    assert not [found for found in findings(honest.change("force", force + hum)) if "one and the same" in found.what]


def test_a_jump_of_a_day_is_no_wrong_unit(honest, findings):
    found = findings(jump("force", 86400.0)(honest))
    assert any("1 gap, the longest of 8.64e+04 s" in one.what for one in found)
    assert not any("another unit" in one.what for one in found)


@pytest.mark.parametrize("lie", LIES)
def test_a_lie_is_named(lie, honest, findings, hard):
    tell, severity, words = LIES[lie]
    found = findings(tell(honest))
    texts = [f"{f.where}: {f.what}; {f.remedy}" for f in found if f.severity is severity and f.remedy]
    named = [text for text in texts if all(word in text for word in words)]
    assert named, found
    hard(f"lie: {lie}", f"`check`: {severity.name.lower()}", beyond=named[0])


def found_by_pads(skin, site, pressure, arriving=None):
    """What is said of pressures (24, pads) of presses of 10 N at places (24, 2), and of those while they arrive."""
    numbers = np.arange(24)
    held = {
        "number": numbers,
        "site": site,
        "force": np.full(24, 10.0),
        "pressure": pressure,
        "arriving": partial(np.copy, 0.5 * pressure if arriving is None else arriving),
        "tip_diameter": np.zeros(24),
        "times": numbers * SECOND,
    }
    return [*pad_response_findings(stand_in(PressEvidence, **held), skin, 0)]


def test_pressures_that_are_late_by_a_press_are_named(skin):
    """Presses come at even times, so that the streams correlate as they are."""
    rng = np.random.default_rng(2)
    site = np.array([[0.05, 0.05], [0.15, 0.05], [0.05, 0.15], [0.15, 0.15]])[rng.permutation(24) % 4]
    pressure = np.where(pads_under(skin, site).T, 800.0, 5.0)
    assert found_by_pads(skin, site, pressure) == []
    for rows, said in ((1, "1 press late: 100% of"), (-2, "2 presses early: 100% of")):
        (found,) = found_by_pads(skin, site, np.roll(pressure, rows, 0))
        assert f"the pads respond {said} the presses so moved" in found.what


def test_tips_that_slide_onto_the_pad_of_the_next_press_are_not_late(skin):
    site = np.array([[0.05, 0.05], [0.15, 0.05], [0.05, 0.15], [0.15, 0.15]])[np.arange(24) // 2 % 4]
    arriving = np.where(pads_under(skin, site).T, 400.0, 5.0)
    held = 2 * np.roll(arriving, -1, 0)
    assert found_by_pads(skin, site, held, arriving) == []
    (found,) = found_by_pads(skin, site, held, 0.5 * held)
    assert "the pads respond 1 press early" in found.what


def test_a_pad_that_dies_is_named_where_pads_beside_it_bear_a_part(skin):
    """The load spreads over the walls, so that some pad feels every press."""
    site = np.array([[0.09, 0.09], [0.03, 0.03], [0.15, 0.03], [0.03, 0.15]] * 6)
    under = pads_under(skin, site)
    pressure = np.where(under.T, 800.0, 20.0)
    dying = (np.arange(24)[:, None] >= 12) & (np.arange(4) == under[:, 0].argmax())
    assert not [found for found in found_by_pads(skin, site, pressure) if "feel" in found.what]
    (found,) = [one for one in found_by_pads(skin, site, np.where(dying, 0.3, pressure)) if "feel" in one.what]
    assert found.severity is WARNING
    assert re.search(r"column \d, pad '.*', does not feel 6 of 12 presses on it: 12, 13", found.what)
