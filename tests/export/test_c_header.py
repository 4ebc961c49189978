"""The C header computes what `calib.force_map` does, and says what it cannot."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import calib
import jaxeit as je
from benchmarks import bench_firmware
from calib.calibration.localisation.locators import AbstractLocator, CentroidLocator
from calib.calibration.press_examples import PressExamples
from calib.calibration.recalibration.changes import Recalibration
from calib.cli import main
from calib.export import ExportError
from calib.export.c.curves import FORMULAS
from calib.export.c.fields import FORMULAS as FIELD_FORMULAS
from calib.fitting import Play
from calib.fitting.curves import CURVES
from calib.fitting.fields import FIELDS, FittedField, geometry_of, single_places
from calib.fitting.pad_gains import PadGains
from calib.presses.crosstalk import Crosstalk
from tests.helpers import stand_in

CC = shutil.which("cc")
STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic")
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler: there is no program cc")
TARE, FRAMES = 20, 1000
ROUNDING = 300 * 6e-8  # of sums of 300 products in single precision
STEEPEST = 300  # 1/m: change of the log-gain with the place, of the fields drawn here
LOST_DIGIT = 10  # a frame without a reading and its partner, which are predicted in single precision

# Frames from standard input: the first 20 for the tare, then results to standard output.
DRIVER = r"""
#include <stdio.h>
#include <string.h>
#include "PREFIX.h"

static PREFIX_rest rest;
static PREFIX_tare tare;
static PREFIX_result out;
static float frame[UPPER_READINGS + UPPER_PADS];

static void put(const void *from, size_t bytes) { fwrite(from, 1, bytes, stdout); }

int main(int argc, char **argv)
{
    if (argc > 1 && strcmp(argv[1], "sizes") == 0) {
        printf("%d %d %d\n", (int)sizeof rest, (int)sizeof tare, (int)sizeof out);
        return 0;
    }
    PREFIX_tare_start(&tare);
    for (int n = 0; fread(frame, sizeof frame, 1, stdin) == 1; n++) {
        uint8_t unknown;
        if (n < 20) {
            PREFIX_tare_add(&tare, frame, frame + UPPER_READINGS);
            continue;
        }
        if (n == 20) {
            PREFIX_tare_rest(&tare, &rest);
            put(&rest, sizeof rest);
        }
        unknown = (uint8_t)PREFIX_frame(&rest, frame, frame + UPPER_READINGS, &out);
        put(out.image, sizeof out.image);
        put(out.map, sizeof out.map);
        put(out.force, sizeof out.force);
        put(out.in_range, sizeof out.in_range);
        put(out.shaped, sizeof out.shaped);
        put(&out.missing, sizeof out.missing);
        put(&unknown, 1);
        PUT_PLACE
    }
    return 0;
}
"""
MIXING = np.array([[1, 0.08, 0, 0.01], [0.05, 1, 0, 0], [0, 0.02, 1, 0.1], [0, 0, 0.03, 1]])


def fitted(curve):
    """The curve fitted to slightly bent presses, with other numbers for each pad."""
    pressure = np.linspace(0, 2000, 64) * np.array([[1.0], [1.1], [0.9], [1.2]])
    noise = np.random.default_rng(0).normal(0, 0.02, pressure.shape)
    return calib.fit_curves(curve, pressure, 0.011 * pressure**0.97 + noise)


@pytest.fixture(scope="module")
def recon(model):
    return je.prepare(model, basis=je.Pixels(20))


@pytest.fixture(scope="module")
def calibration(skin, recon):
    curves = fitted(calib.Linear())
    return calib.Calibration(
        skin, recon, je.pad_masks(skin, recon), curves, stand_in(calib.calibration.Evaluation), {}, simulated=True
    )


@pytest.fixture(scope="module")
def recorded(model, pixels, recon):
    """Readings (V) and pressures (Pa) in float32: frames without contact, then presses with what may be missing."""
    rng = np.random.default_rng(1)
    centres, readings = np.asarray(recon.centres), recon.readings
    place, width = centres[rng.integers(len(centres), size=FRAMES)], rng.uniform(0.01, 0.04, FRAMES)
    bump = np.exp(-((centres - place[:, None]) ** 2).sum(-1) / (2 * width[:, None] ** 2))
    change = bump * rng.uniform(-2e-6, 1e-5, (FRAMES, 1)) @ np.asarray(je.jacobian(model, basis=pixels)).T
    change += 0.02 * np.abs(change).max(1, keepdims=True) * rng.normal(size=change.shape)
    rest = 0.1 * rng.uniform(0.5, 1, readings)
    pressed = rng.uniform(-100, 3000, (FRAMES, 4)) * (rng.random((FRAMES, 4)) < 0.7)  # 2.4 kPa were calibrated
    untouched = np.hstack([rest + 1e-6 * rng.normal(size=(TARE, readings)), 1e5 + rng.normal(size=(TARE, 4))])
    frames = np.hstack([rest + change, 1e5 + pressed])
    partner = je.skin.reciprocal_rows(np.asarray(model.pattern))
    for frame in frames[::2]:
        lost = rng.choice(readings, rng.integers(1, 9), replace=False)
        lost = np.unique([lost, partner[lost]])  # what the partner reads is as good as the reading itself
        frame[lost] = rng.choice([np.nan, np.inf, -np.inf], len(lost))
    frames[::3, readings + 1] = np.nan  # a pad that tells nothing
    frames[::7, readings + 2] = np.inf  # and one whose converter says so that it is saturated
    untouched[rng.random(untouched.shape) < 0.05] = np.nan
    return np.vstack([untouched, frames]).astype("f4")


def built(folder, prefix="skin", flags=STRICT, source=DRIVER):
    """The program of a header in a folder."""
    if "PUT_PLACE" in source:
        located = "float place[2]" in (folder / f"{prefix}.h").read_text()
        source = source.replace("PUT_PLACE", "put(out.place, sizeof out.place);" if located else "")
    (folder / "main.c").write_text(source.replace("PREFIX", prefix).replace("UPPER", prefix.upper()))
    done = subprocess.run([CC, *flags, "main.c", "-o", "program", "-lm"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "program"


def run_c(program, recorded, readings, pads, pixels, located=False):
    """Rest of the tare, and a structured array of the results."""
    out = subprocess.run([program], input=recorded.tobytes(), capture_output=True, check=True).stdout
    fields = [("image", "f4", pixels), ("map", "f4", pixels), ("force", "f4", pads), ("in_range", "u1", pads)]
    fields += [("shaped", "u1", pads), ("missing", "u4"), ("unknown", "u1")]
    row = np.dtype([*fields, *([("place", "f4", 2)] if located else [])])
    first = 4 * (readings + pads)
    return np.frombuffer(out[:first], "f4"), np.frombuffer(out[first:], row)


def compare(calibration, recorded, program, exact=False):
    """Run the program, and compare each frame with Python."""
    readings, pads, pixels = calibration.recon.readings, 4, len(calibration.masks.areas)
    located = calibration.field is not None
    rest, found = run_c(program, recorded, readings, pads, pixels, located)
    np.testing.assert_allclose(rest, np.nanmean(recorded[:TARE].astype(float), 0), rtol=1e-7)
    change = recorded[TARE:].astype(float) - rest
    change[:, readings:][~np.isfinite(change[:, readings:])] = np.nan
    wanted = calib.force_map(calibration, change[:, :readings], change[:, readings:])
    assert len(found) == len(change)
    image, force = np.asarray(calibration.recon(change[:, :readings])), np.asarray(wanted.force)
    largest = np.abs(image).max(1, keepdims=True)
    error = np.abs(found["image"] - image) / largest
    missing = (~np.isfinite(change[:, :readings])).sum(1)
    rounding = ROUNDING * np.where((missing > 0) & (not exact), LOST_DIGIT, 1)
    assert (error.max(1) < rounding).all(), error.max()
    np.testing.assert_array_equal(found["missing"], missing)
    assert not found["unknown"].any()

    np.testing.assert_array_equal(np.isnan(found["force"]), np.isnan(change[:, readings:]))
    placed, tolerance = np.ones(len(found), bool), np.full(len(found), 3e-6)
    if located:
        placed, tolerance = compare_places(calibration, found, image, rounding)
    error = np.abs(found["force"] - force) - 3e-6
    assert (np.nanmax(error / (np.abs(force) + 1e-9), 1, initial=0) < tolerance)[placed].all(), np.nanmax(error[placed])
    own = np.asarray(calibration.own_pressures(change[:, readings:]))
    low, high = np.asarray(calibration.curves.pressure_range).T
    low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
    clear = (np.abs(own - low) > 1e-3) & (np.abs(own - high) > 1e-3)
    np.testing.assert_array_equal(found["in_range"][clear], np.asarray(wanted.valid)[clear])
    assert {0, 1} == set(found["in_range"][np.isfinite(own)].ravel())  # saturated or not

    # Where a number lies at the gate, rounding decides whether the image gives the shape.
    clear = np.abs(np.asarray(wanted.map.concentration) - 0.6) > 1e-4
    np.testing.assert_array_equal((found["shaped"] > 0)[clear], np.asarray(wanted.map.valid)[clear])
    sure = clear.all(1)
    assert sure.mean() > 0.95
    sure &= placed
    silent = np.asarray(calibration.masks.weights)[None] * np.isnan(force)[..., None] > 0
    np.testing.assert_array_equal(np.isnan(found["map"]), silent.any(1))
    scale = np.maximum(np.nanmax(np.abs(np.asarray(wanted.map.force)), 1, keepdims=True), 1e-6)  # N
    error = np.abs(found["map"] - np.asarray(wanted.map.force)) / scale
    assert (np.nanmax(error, 1, initial=0) < 5 * rounding)[sure].all(), np.nanmax(error[sure])
    assert {0, 1} == set(found["shaped"].ravel())


def compare_places(calibration, found, image, rounding):
    """Compare the places of frames. Returns where rounding cannot decide which pixels count, and bounds of the error
    of the forces: that of the formulas, and that of places that follow the values of the image."""
    estimator = calibration.locator.estimator
    peak = isinstance(estimator, je.metrics.Peak)
    wanted = np.asarray(estimator(image, calibration.recon))
    largest = image.max(1, keepdims=True)
    level = 1.0 if peak else getattr(estimator, "level", None)
    edge = largest * (level or 0)
    near = (np.abs(image - edge) < 2 * rounding[:, None] * np.abs(image).max(1, keepdims=True)).sum(1)
    clear = (near <= peak) if level else np.ones(len(image), bool)
    assert clear.mean() > 0.8
    error = np.linalg.norm(found["place"] - wanted, axis=1)
    moved = 0 if level else rounding
    assert (error < 1e-6 + 0.2 * moved)[clear].all(), error[clear].max()  # m, on a sheet of 0.2 m
    return clear, 2e-5 + STEEPEST * (1e-6 + 0.2 * moved)


def gain_field(field, skin, rng):
    """The field with coefficients and levels drawn at random, known in a box within each pad."""
    geometry = geometry_of(skin)
    size = field.size(4)
    low, high = np.asarray(geometry.start).min(1), np.asarray(geometry.start).max(1)
    zero = jnp.zeros(())
    return FittedField(
        field=field,
        geometry=geometry,
        coefficients=jnp.asarray(rng.normal(0, 0.3, size)),
        covariance=jnp.zeros((size, size)),
        reach=jnp.asarray(np.stack([low + 0.012, high - 0.007], 1)),
        centre=jnp.asarray(rng.normal(0, 0.3, (4, size))),
        **dict.fromkeys(("noise", "spread", "evidence", "effective", "n", "error_scale"), zero),
        result=jnp.zeros((), int),
    )


def located(calibration, field, place, skin=None):
    """The calibration with a correction by location, at places of the image; a skin other than its own tells sides."""
    gains = gain_field(field, skin or calibration.skin, np.random.default_rng(2))
    return replace(calibration, field=gains, locator=CentroidLocator(je.metrics.ESTIMATORS.make(place)))


def variants(calibration):
    """Calibrations that differ in what a header holds."""
    gains = PadGains(np.array([0.1, -0.05, 0.0, 0.02]), np.zeros((4, 4)))
    mixed = replace(calibration, crosstalk=Crosstalk(MIXING, 0 * MIXING))
    return {
        "crosstalk": mixed,
        "recalibrated": replace(mixed, recalibration=stand_in(Recalibration, gains=gains)),
        **{name: replace(calibration, curves=fitted(CURVES[name]())) for name in FORMULAS},
    }


CASES = ["crosstalk", "recalibrated", *FORMULAS]


@needs_compiler
@pytest.mark.parametrize("case", CASES)
def test_a_thousand_frames_are_those_of_python(case, calibration, recorded, tmp_path):
    chosen = variants(calibration)[case]
    sizes = calib.export_c(chosen, tmp_path / "skin.h")
    program = built(tmp_path)
    compare(chosen, recorded, program)
    told = subprocess.run([program, "sizes"], capture_output=True, text=True, check=True).stdout
    assert told.split() == [str(n) for n in (sizes.rest, sizes.tare, sizes.result)]


PLACED_CASES = [*((name, "half") for name in FIELD_FORMULAS), *(("edge", n) for n in ("peak", "quarter", "positive"))]
QUICK_CASES = {("edge", "half"), ("edge", "peak"), ("edge-spline", "half"), ("rbf", "half"), ("gp", "half")}
PLACED = [case if case in QUICK_CASES else pytest.param(*case, marks=pytest.mark.slow) for case in PLACED_CASES]


@needs_compiler
@pytest.mark.parametrize(("field", "place"), PLACED)
def test_a_correction_by_location_is_that_of_python(field, place, calibration, recorded, tmp_path):
    chosen = located(calibration, FIELDS.make(field), place)
    sizes = calib.export_c(chosen, tmp_path / "skin.h")
    program = built(tmp_path)
    compare(chosen, recorded, program)
    told = subprocess.run([program, "sizes"], capture_output=True, text=True, check=True).stdout
    assert told.split() == [str(n) for n in (sizes.rest, sizes.tare, sizes.result)]
    plain = calib.export_c(calibration, tmp_path / "plain.h")
    sides, rim, numbers = 4, 4, chosen.field.field.shapes().shape[1] - (field == "edge-size") + 1
    if field == "edge-spline":  # products of all pairs of bumps, in place of those of the principal functions
        numbers = 2 * chosen.field.field.bumps * (1 + chosen.field.field.bumps) + 1
    assert sizes.flash - plain.flash == 4 * (3 * 400 + 4 * 4 * sides + 2 * 4 * 4 + 4 * rim + 4 * numbers)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("field", ["edge", "edge-spline", "rbf", "gp"])
def test_a_field_with_other_settings_is_that_of_python(field, calibration, recorded, tmp_path):
    """Coefficients of all pads together or of each, other numbers of them, no corners."""
    settings = {
        "edge": "corners=false,width=0.011,bumps=3,shared=false",
        "edge-spline": "corners=false",
        "rbf": "nodes=3,shared=true",
    }
    chosen = located(calibration, FIELDS.make(f"{field}:{settings.get(field, 'modes=3,shared=true')}"), "half")
    calib.export_c(chosen, tmp_path / "skin.h")
    compare(chosen, recorded, built(tmp_path))


@needs_compiler
def test_pads_of_other_shapes_on_a_round_sheet(calibration, recorded, tmp_path):
    """A triangle, whose fourth side has no length, a pad with a notch, and a rim of 128 sides."""
    skin = calibration.skin
    triangle = np.array([[0.1, 0.0], [0.2, 0.0], [0.13, 0.1]])
    notched = np.array([[0.0, 0.1], [0.1, 0.1], [0.1, 0.2], [0.04, 0.13], [0.0, 0.2]])
    pads = (skin.pads[0], je.Pad("triangle", triangle), je.Pad("notched", notched), skin.pads[3])
    odd = je.Skin("odd", je.Disc(0.3), 1.0, skin.electrodes, skin.protocol, pads)
    chosen = located(calibration, FIELDS.make("edge"), "positive", odd)
    calib.export_c(chosen, tmp_path / "skin.h")
    assert "#define SKIN_SIDES 5\n#define SKIN_RIM 128\n" in (tmp_path / "skin.h").read_text()
    compare(chosen, recorded, built(tmp_path))


class InTheMiddle(AbstractLocator):
    """Finds every contact in the middle of the sheet, by no image."""

    def __call__(self, dv, image, recon, masks):
        return single_places(jnp.full((len(dv), 2), 0.1), masks.weights.shape[0])


@needs_compiler
def test_places_of_the_image_stand_in_for_fits_and_what_it_changes_is_told(calibration, recorded, tmp_path):
    by_image = located(calibration, FIELDS.make("edge"), "half")
    rest = np.nanmean(recorded[:TARE].astype(float), 0)
    seen = recorded[TARE + 1 :: 40].astype(float) - rest
    seen = seen[np.isfinite(seen).all(1)]
    force = np.random.default_rng(3).uniform(5, 40, len(seen))
    probes = PressExamples(seen[:, :550], seen[:, 550:], np.zeros((len(seen), 2)), force)
    fitted = replace(by_image, locator=InTheMiddle(), probes=probes)
    refused(
        fitted, tmp_path, r"location: contacts are fitted.*--locator image-centroid.*--place half.*--without-location"
    )
    told = []
    calib.export_c(fitted, tmp_path / "skin.h", place=je.LevelCentroid(0.5), tell=told.append)
    compare(by_image, recorded, built(tmp_path))

    own, theirs, plain = (
        calib.force_map(which, probes.dv, probes.pressure).force.sum(1)
        for which in (fitted, by_image, replace(by_image, field=None, locator=None))
    )
    assert f"{len(seen)} presses" in told[0]
    assert f"by {np.abs(own - theirs).max():.2g} N at most" in told[0]
    rms = [f"{np.sqrt(np.mean((found - force) ** 2)):.2g} N" for found in (own, theirs, plain)]
    assert re.findall(r"[\d.e+]+ N", told[1]) == rms
    header = " ".join((tmp_path / "skin.h").read_text().split())
    assert " ".join(told) in header
    assert "at the place of the image by the estimator 'level-centroid:level=0.5'" in header


class Lowest(je.LevelCentroid):
    """An estimator of a user's own; what it is derived from does not say its formula."""


def test_only_an_estimator_with_a_formula_gives_the_place(calibration, tmp_path, monkeypatch):
    fitted = located(calibration, FIELDS.make("edge"), "half")
    refused(fitted, tmp_path, f"place '{__name__}:Lowest:level=0.4': has no formula in C", place=Lowest(0.4))
    monkeypatch.setattr(calib.calibration, "load_calibration", lambda path: fitted)
    export = ["export", "c", "calibration.h5", "-o", str(tmp_path / "skin.h"), "--place"]
    assert main([*export, "level-centroid:level=0.4"]) == 0
    assert "value >= 0.4f * top" in (tmp_path / "skin.h").read_text()
    assert main([*export, f"{__name__}:Lowest"]) == main([*export, "middle"]) == 2


@pytest.mark.slow
@needs_compiler
def test_more_missing_readings_than_there_is_room_for(calibration, recorded, tmp_path):
    """The image is then unknown, and the forces are spread evenly; with more room the image is that of Python."""
    calib.export_c(calibration, tmp_path / "skin.h")
    lost = recorded.copy()
    lost[TARE:, :40] = np.nan
    _, found = run_c(built(tmp_path), lost, 550, 4, 400)
    assert np.isnan(found["image"]).all()
    assert found["unknown"].all()
    assert not found["shaped"].any()
    whole = np.isfinite(found["force"]).all(1)
    np.testing.assert_allclose(found["map"][whole].sum(1), found["force"][whole].sum(1), rtol=1e-5, atol=1e-5)
    compare(calibration, lost[: TARE + 40], built(tmp_path, flags=(*STRICT, "-DSKIN_MAX_MISSING=64")))
    none = np.where(np.arange(554) < 550, np.nan, lost[: TARE + 4]).astype("f4")
    _, found = run_c(built(tmp_path, flags=(*STRICT, "-DSKIN_MAX_MISSING=550")), none, 550, 4, 400)
    np.testing.assert_array_equal(found["image"], 0)
    assert not found["shaped"].any()


@needs_compiler
def test_without_room_for_missing_readings(calibration, recorded, tmp_path):
    """The table that predicts them is left out too."""
    sizes = calib.export_c(calibration, tmp_path / "skin.h")
    small, large = (built(tmp_path, flags=(*STRICT, f"-DSKIN_MAX_MISSING={n}")).read_bytes() for n in (0, 1))
    assert len(large) - len(small) > 0.95 * sizes.predict
    program = built(tmp_path, flags=(*STRICT, "-DSKIN_MAX_MISSING=0"))
    compare(calibration, np.vstack([recorded[:TARE], recorded[TARE + 1 :: 2]]), program)
    _, found = run_c(program, np.vstack([recorded[:TARE], recorded[TARE::2]]), 550, 4, 400)
    assert found["unknown"].all()


@needs_compiler
def test_readings_that_the_others_hardly_predict_need_double_precision(calibration, model, recorded, tmp_path):
    """With little regularisation a missing reading takes nearly all that is known of some pair sums with it."""
    weak = je.prepare(model, basis=je.Pixels(20), hyperparameter=1e-3)
    calib.export_c(replace(calibration, recon=weak), tmp_path / "skin.h")
    assert "typedef double skin_exact;" in (tmp_path / "skin.h").read_text()
    compare(replace(calibration, recon=weak), recorded, built(tmp_path), exact=True)


@needs_compiler
def test_channels_that_are_not_used_may_hold_anything(calibration, recorded, tmp_path):
    unused = np.arange(550) < 30
    recon = calibration.recon.without(unused)
    calib.export_c(replace(calibration, recon=recon), tmp_path / "skin.h")
    spoilt = recorded.copy()
    spoilt[:, :30] = np.nan
    _, found = run_c(built(tmp_path), spoilt, 550, 4, 400)
    _, same = run_c(tmp_path / "program", recorded, 550, 4, 400)
    np.testing.assert_array_equal(found["image"], same["image"])
    assert (found["missing"] <= 16).all()


@needs_compiler
def test_two_skins_in_one_program(calibration, tmp_path):
    calib.export_c(calibration, tmp_path / "left_arm.h", prefix="left_arm")
    calib.export_c(calibration, tmp_path / "right.h", prefix="right")
    names = set(re.findall(r"\b\w*(?:skin|SKIN)\w*", re.sub(r"(?s)/\*.*?\*/", "", (tmp_path / "right.h").read_text())))
    assert names == set()
    source = '#include "left_arm.h"\n#include "right.h"\nint main(void)\n{\n    return LEFT_ARM_PADS - RIGHT_PADS;\n}\n'
    program = built(tmp_path, source=source)
    assert subprocess.run([program], check=False).returncode == 0


@needs_compiler
@pytest.mark.parametrize("option", ["-ffast-math", "-Ofast", "-ffinite-math-only"])
def test_options_that_take_nan_for_impossible_are_refused(option, calibration, tmp_path):
    calib.export_c(calibration, tmp_path / "skin.h")
    (tmp_path / "main.c").write_text('#include "skin.h"\nint main(void)\n{\n    return 0;\n}\n')
    command = [CC, "main.c", "-o", "program"]
    assert subprocess.run(command, cwd=tmp_path, check=False).returncode == 0
    fast = subprocess.run([*command, option], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert fast.returncode != 0
    assert "compile without -ffast-math" in fast.stderr


def test_same_calibration_same_bytes(calibration, tmp_path):
    for name in ("a.h", "b.h"):
        calib.export_c(calibration, tmp_path / name)
    assert (tmp_path / "a.h").read_bytes() == (tmp_path / "b.h").read_bytes()


def test_sizes_are_those_of_the_tables(calibration, tmp_path):
    sizes = calib.export_c(calibration, tmp_path / "skin.h")
    text = (tmp_path / "skin.h").read_text()
    pairs, entries = 300, np.count_nonzero(np.asarray(calibration.masks.weights))
    numbers = 550 + 400 * pairs + pairs * (pairs + 1) // 2 + 16 + 4 + 8 + entries
    assert sizes.flash == 4 * numbers + 2 * (4 * 550 + entries) + 4 * 5
    for size in (sizes.flash, sizes.rest, sizes.tare, sizes.result, sizes.stack, sizes.operations):
        assert f"{size:,}" in text


def refused(calibration, folder, message, **options):
    with pytest.raises(ExportError, match=message):
        calib.export_c(calibration, folder / "skin.h", **options)
    assert list(folder.iterdir()) == []


def test_what_cannot_be_exported_is_refused(calibration, model, tmp_path):
    refused(replace(calibration, curves=fitted(Play())), tmp_path, r"curve 'play'.*remembers.*linear, affine, power")
    iterative = je.prepare(model, basis=je.Pixels(20), method=je.NonNegative())
    refused(replace(calibration, recon=iterative), tmp_path, r"solves a problem for each frame.*--method one-step")
    correlated = eqx.tree_at(lambda r: r.whitening.weight, calibration.recon, jnp.eye(550))
    refused(replace(calibration, recon=correlated), tmp_path, r"covariance between readings.*--noise measured")
    refused(stand_in(calib.calibration.LogCalibration), tmp_path, "a log has no EIT")
    located = replace(calibration, field=stand_in(FittedField))
    own = type("Own", (calib.fitting.PadEdge,), {"name": "own"})()
    refused(
        replace(located, field=stand_in(FittedField, field=own), locator=CentroidLocator(je.LevelCentroid(0.5))),
        tmp_path,
        "location .*: has no formula in C",
    )
    refused(located, tmp_path, r"location.*--without-location")
    refused(located, tmp_path, "of no use", without_location=True, place=je.LevelCentroid(0.5))
    refused(calibration, tmp_path, "has no correction by location", place=je.LevelCentroid(0.5))
    refused(located, tmp_path, "place: 'half' is not an estimator; give an object, such as je.Level", place="half")
    assert calib.export_c(located, tmp_path / "skin.h", without_location=True).flash > 0
    assert "correction by location is left out" in (tmp_path / "skin.h").read_text()


@pytest.mark.parametrize("prefix", ["", "Skin", "9skin", "_skin", "skin-1", "skin\n", "a" * 32])
def test_names_that_are_no_names_in_c(calibration, tmp_path, prefix):
    refused(calibration, tmp_path, "prefix .*lower-case letter", prefix=prefix)


def test_numbers_that_are_not_finite(calibration, tmp_path):
    curves = replace(calibration.curves, parameters=calibration.curves.parameters * np.nan)
    refused(replace(calibration, curves=curves), tmp_path, "curves: some numbers are not finite")


def test_text_of_a_session_cannot_end_the_comment(calibration, tmp_path):
    hostile = replace(calibration, provenance={"sessions": "hash  */ #error /* ??/ \\ \u00e9"})
    calib.export_c(hostile, tmp_path / "skin.h")
    assert "* / #error / * ?/ ? ?" in (tmp_path / "skin.h").read_text()


def test_the_command(calibration, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("calib.calibration.load_calibration", lambda path: calibration)
    assert main(["export", "c", "calibration.h5", "-o", str(tmp_path / "new" / "palm.h"), "--prefix", "palm"]) == 0
    assert "bytes of flash for tables" in capsys.readouterr().out
    assert "palm_frame(" in (tmp_path / "new" / "palm.h").read_text()
    (tmp_path / "folder.h").mkdir()
    assert main(["export", "c", "calibration.h5", "-o", str(tmp_path / "folder.h")]) == 2
    assert "is a folder" in capsys.readouterr().err
    assert main(["export", "c", "calibration.h5", "-o", str(tmp_path / "x.h"), "--place", "half"]) == 2
    assert "no correction by location" in capsys.readouterr().err
    assert main(["export", "c", "calibration.h5", "-o", str(tmp_path / "x.h"), "--prefix", "X"]) == 2
    assert "lower-case" in capsys.readouterr().err
    assert not (tmp_path / "x.h").exists()


@needs_compiler
def test_the_program_of_the_page(calibration, recorded, root, tmp_path):
    """`docs/firmware.md` shows a program; its output is what Python finds."""
    (source,) = re.findall(r'```c title="main.c"\n(.*?)```', (root / "docs" / "firmware.md").read_text(), re.DOTALL)
    calib.export_c(calibration, tmp_path / "skin.h")
    untouched = np.repeat(recorded[:1], 50, 0)
    untouched[np.isnan(untouched)] = 0.05
    frames = np.vstack([untouched, recorded[TARE : TARE + 20]])
    program = built(tmp_path, source=source)
    out = subprocess.run([program], input=frames.tobytes(), capture_output=True, text=False, check=True).stdout
    printed = np.array([line.split() for line in out.decode().splitlines()], float)
    wanted = calibration.pad_forces((frames[50:] - frames[0])[:, 550:].astype(float))[0]
    np.testing.assert_allclose(printed, np.where(np.isfinite(wanted), wanted, np.nan), atol=1e-3, rtol=1e-5)


@pytest.mark.slow
@needs_compiler
def test_the_benchmark_runs(root):
    command = [sys.executable, "-m", "benchmarks.bench_firmware", "--smoke"]
    printed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout
    for part in bench_firmware.PARTS:
        assert re.search(
            rf"^\| 10 \| 928 \| {part} \| [\d.]*[1-9][\d.]* \| [\d.]*[1-9][\d.]* \|$", printed, re.MULTILINE
        )


@pytest.mark.slow
def test_the_benchmark_of_places_runs(root):
    command = [sys.executable, "-m", "benchmarks.bench_firmware_places", "--smoke"]
    printed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout
    errors = dict(re.findall(r"^\| (none|image-centroid, half) \| [^|]* \| ([\d.]+) \|", printed, re.MULTILINE))
    assert 0 < float(errors["image-centroid, half"]) < float(errors["none"])
