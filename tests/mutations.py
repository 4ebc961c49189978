"""Guards broken one at a time, in a copy of the project: a test must fail for each, or the guard is dead.

    python -m tests.mutations [TEXT] [--log FILE | --check]

breaks those whose file or code contains TEXT, all without it, runs the tests that concern each (first those that are
known to hold it, the slow ones last), and lists the ones that no test held; exit status 1 if there are any. An hour
for all of them; verdicts are kept in FILE, if one is given, and what has one there is not run again. ``--check`` only
looks whether this list still fits the sources and the tests, as every run does first. Guards that only save time are
not here.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
COPIED = ("jaxeit", "calib", "tests", "data", "benchmarks", "pyproject.toml", "README.md")


class Mutant(NamedTuple):
    """A text that stands once in a file, what to put in its place, and the test files that should mind.

    ``first``: the name of a test that holds it, or part of it, as ``pytest -k`` takes it.
    """

    file: str
    old: str
    new: str
    tests: str
    first: str = ""


def of(file: str, tests: str, *changes: tuple[str, ...]) -> list[Mutant]:
    """Mutants of one file under the same tests, from what stands there, what to put there, and ``first``."""
    return [Mutant(file, old, new, tests, *first) for old, new, *first in changes]


SOLVING = "test_solvers test_hard_contacts test_hard_forward"
IMAGING = "test_hard_inverse test_inverse test_whitening test_methods test_hyperparameter"
FITTING = "test_hard_fits test_fit test_curves test_solver"
GRADIENTS = "test_hard_gradients"

MUTANTS = [
    *of(
        "jaxeit/stiffness.py",
        "test_stiffness test_jacobian",
        ("jnp.where(fresh[:, None], found, 0)", "found", "sums_over_the_elements"),
        ("x = x[:, 1:] - x[:, :1]", "x = x[:, 1:]", "sums_over_the_elements"),
        ("np.abs(value) > rounding * largest[owner[first]]", "np.abs(value) > 0", "right_angle"),
        ("np.flatnonzero(excess > 1)", "np.flatnonzero(excess > 2)", "shared_out"),
    ),
    *of(
        "jaxeit/jacobian.py",
        "test_stiffness test_jacobian",
        ("made_for != given", "False", "another_model"),
    ),
    *of(
        "jaxeit/solvers/_base.py",
        SOLVING,
        ("d = jax.lax.rsqrt(values[plan.diagonal])", "d = jnp.ones_like(values[plan.diagonal])", "iteration_does_not"),
        (
            "rows.size and not (cols.min() >= 0 and rows.max() < n and (cols <= rows).all())",
            "False",
            "bad_patterns_are",
        ),
        ("np.unique(rows.astype(np.int64) * n + cols).size != rows.size", "False", "bad_patterns_are"),
        ("np.count_nonzero(rows == cols) != n", "False", "bad_patterns_are"),
        ("rows.ndim != 1 or rows.shape != cols.shape", "False", "bad_patterns_are"),
        ("coords is not None and (coords.ndim != 2 or coords.shape[0] != n)", "False", "bad_patterns_are"),
        ("root.ndim != 1 or np.unique(root).size != root.size", "False", "bad_patterns_are"),
        ("root.size and not (root.min() >= 0 and root.max() < n)", "False", "bad_patterns_are"),
    ),
    *of(
        "jaxeit/solvers/conjugate_gradient.py",
        SOLVING,
        ("max(self.tolerance, 8 * float(jnp.finfo(b.dtype).eps))", "self.tolerance", "iterations_end_where"),
        ("return jnp.where(jnp.linalg.norm(r, axis=0) <= goal, x, jnp.nan)", "return x", "iteration_that_does"),
        ("jnp.where(below == 0, 0, above / jnp.where(below == 0, 1, below))", "above / below", "iteration_leaves_a"),
    ),
    *of(
        "jaxeit/lapack.py",
        f"test_lapack {SOLVING}",
        (
            "return gcd(count, 1 << int(np.log2(max(1, _IN_PLACE // work))))",
            "return count",
            "no_stack_is_spread",
        ),
        ("operations=10", "operations=1", "no_stack_is_spread"),
        ("if batched[0]:", "if True:", "one_matrix_for_many"),
        ("eye = jnp.eye(len(apart), dtype=apart.dtype)", "eye = jnp.zeros(())", "values_and_derivatives"),
    ),
    *of(
        "jaxeit/forward.py",
        f"test_hard_forward test_hard_contacts test_forward test_effects_electrical test_coating {GRADIENTS}",
        ("jnp.where(values < 0, jnp.nan, values)", "values", "what_is_no_conductivity"),
        ("(jnp.where(lumped, v, 1.0) for v in", "(v for v in", "derivatives_with_every"),
        ("jnp.where(lumped, resistance, 0.0)", "resistance", "contrast_of_twelve"),
        ("total = jnp.where(touch > 0, touch + sheet, 1.0)", "total = touch + sheet", "point_electrodes_on"),
        ("best = jnp.argmax(own * system.ground_weight)", "best = 0", "contrast_of_twelve"),
        ("best = jnp.argmax(own * system.ground_weight)", "best = jnp.argmax(own)", "a_ground_amid"),
        ("values.shape != model.background.shape or values.dtype != model.dtype", "False", "wrong_sigma_is"),
        ("if model.coat is None:", "if False:", "what_does_not"),
    ),
    *of(
        "jaxeit/host.py",
        IMAGING,
        ("if isfinite(t.dot(t)) else", "if True else", "numpy_mends"),
        ("np.flatnonzero(~whole)", "()", "numpy_gives_the"),
        ("        if self._correlated:\n            image", "        if False:\n            image", "numpy_mends"),
        ("np.flatnonzero(self._used & ~there)", "np.flatnonzero(~there)", "numpy_leaves_out"),
        (
            "np.asarray(factor), np.asarray(predict)",
            "np.asarray(factor), np.asarray(predict, dtype)",
            "mended_in_double",
        ),
    ),
    *of(
        "jaxeit/inverse.py",
        IMAGING,
        ("jax.lax.cond(jnp.isfinite(jnp.sum(sums)), lambda: sums, each)", "sums", "readings_that_are"),
        (
            "there = (jnp.arange(_FEW) < jnp.sum(missing)).astype(dv.dtype)",
            "there = jnp.ones(_FEW, dv.dtype)",
            "all_channels_dead",
        ),
        ("few = jnp.sum(missing) <= (_FEW if", "few = True | (_FEW if", "readings_that_are"),
        ("(_FEW if self.whitening.weight.ndim == 1 else 0)", "_FEW", "readings_that_are"),
        ("jnp.where(missing, 0, dv)), p @", "dv), p @", "readings_that_are"),
        ("if not np.isfinite(recon.factor).all():", "if False:", "a_conductivity_that"),
        ("if hyperparameter.needs_noise and not noise_is_known:", "if False:", "discrepancy_says_when"),
        ("if not least <= hyperparameter <= _MOST:", "if not 0 < hyperparameter <= _MOST:", "a_lambda_without"),
        ("if not least <= hyperparameter <= _MOST:", "if not least <= hyperparameter:", "a_lambda_without"),
        (
            "(1e3 * eps) ** 0.5 if isinstance(method, AbstractIterativeMethod) else 8e3 * eps",
            "8e3 * eps",
            "what_is_refused",
        ),
        ("jnp.full_like(problem.picture.areas, jnp.inf)", "method.variance(problem)", "without_noise_the"),
    ),
    *of(
        "jaxeit/whitening.py",
        IMAGING,
        ("if np.shape(dv)[-1:] != (readings,):", "if False:", "frames_of_another_protocol"),
        ("dv = jnp.where(self.channels, dv, 0)", "dv = jnp.asarray(dv)", "readings_that_are"),
        ("missing = self.channels & ~jnp.isfinite(dv)", "missing = ~jnp.isfinite(dv)", "channels_left_out"),
        (
            "known = jnp.where(self.channels & ~missing, dv, 0)",
            "known = jnp.where(missing, 0, dv)",
            "channels_left_out",
        ),
        (
            "rows / jnp.where(self.weight > 0, self.weight, 1)[:, None]",
            "rows / self.weight[:, None]",
            "channels_left_out",
        ),
        ("jnp.diag((~missing).astype(rows.dtype))", "0", "readings_that_are"),
        ("weight = jnp.where(used, self.weight, 0)", "weight = self.weight", "leaving_out_nothing"),
        ("rows = jnp.where(gone[:, None], self.weight, 0)", "rows = self.weight", "readings_that_are"),
        ("if noise.shape not in ((readings,), (readings, readings)):", "if False:", "a_covariance_that"),
        ("bad = channels & ~(np.isfinite(noise) & (noise > 0))", "bad = channels & ~(noise > 0)", "a_noise_that"),
        (
            "bad = channels & ~(np.isfinite(noise) & (noise > 0))",
            "bad = channels & ~np.isfinite(noise)",
            "a_noise_that",
        ),
        (
            "bad = channels & ~(np.isfinite(noise) & (noise > 0))",
            "bad = ~(np.isfinite(noise) & (noise > 0))",
            "channels_left_out",
        ),
        (
            "np.where(channels, np.where(channels, noise, 1.0) ** -2.0, 0.0)",
            "np.where(channels, noise**-2.0, 0.0)",
            "channels_left_out",
        ),
        (
            "if not np.isfinite(weight).all() or not np.allclose(part, part.T, rtol=1e-6, atol=0):",
            "if False:",
            "a_covariance_that",
        ),
        (
            "not np.isfinite(weight).all() or not np.allclose(part, part.T, rtol=1e-6, atol=0)",
            "not np.isfinite(weight).all()",
            "a_covariance_that",
        ),
        ("if blank.ndim != 2 or len(blank) < 4 or not np.isfinite(blank).all():", "if False:", "blanks_that_tell"),
        ("if (std == 0).any():", "if False:", "blanks_that_tell"),
        ("max((correlation[off] ** 2).sum(), 1e-300)", "(correlation[off] ** 2).sum()", "a_covariance_of"),
        ("shrink = np.clip(", "shrink = (lambda value, *_: value)(", "a_covariance_of"),
    ),
    *of(
        "jaxeit/methods.py",
        f"test_hard_inverse test_methods test_iterative test_hyperparameter {GRADIENTS}",
        ("jax.lax.cond(enough, _squared, _orthogonal, b, level, y)", "_squared(b, level, y)", "lambda_to_zero"),
        (
            "jnp.maximum(problem.level(b), max(b.shape) * jnp.finfo(b.dtype).eps * s[0])",
            "problem.level(b)",
            "truncation_to_zero",
        ),
        ("power + self.floor * jnp.max(power)", "power", "pixels_that_no"),
        (
            "contacts = jnp.exp(-0.5 * square / self.width**2) * (areas > 0)",
            "contacts = jnp.exp(-0.5 * square / self.width**2)",
            "pixels_beside_the_sheet_teach",
        ),
        (
            "jnp.where(whole > 0, mass / jnp.where(whole > 0, whole, 1), 0)",
            "mass / whole",
            "pixels_beside_the_sheet_teach",
        ),
        ("top = jnp.where(top > 0, top, 1)  # all", "# all", "nothing_makes_no"),
        (
            "return jnp.maximum(j.T @ _left_by_many(above, j, weight, y) / weight, 0) * above",
            "return j.T @ _left_by_many(above, j, weight, y) / weight * above",
            "what_may_not",
        ),
        ("jax.lax.cond(jnp.sum(above) <= size, few, many, j, weight, y)", "few(j, weight, y)", "ends_at_any_lambda"),
        ("return (length < 1) | jnp.any(above != before)", "return jnp.any(above != before)", "ends_at_any_lambda"),
        ("return x * (top / curved), x > z", "return x * (top / curved), x > 0", "ends_at_any_lambda"),
        (
            "jnp.maximum(0.1 * jnp.mean(x * z), jnp.finfo(x.dtype).eps ** 2)",
            "0.1 * jnp.mean(x * z)",
            "nothing_makes_no",
        ),
        ("-0.99 * v / jnp.where(d < 0, d, 1)", "-v / jnp.where(d < 0, d, 1)", "not_negative_in"),
        ("if not isinstance(precision, Diagonal):", "if False:", "sparse_bayes_needs"),
        ("top = jnp.where(top > 0, top, 1)\n        y = y / top", "y = y / top", "nothing_makes_no"),
        ("power = jnp.where(power > 0, power, 1)", "pass", "nothing_makes_no"),
        ("g * seen**2 / jnp.where(own > 0, own, 1)", "g * seen**2 / own", "pixels_that_no"),
        ("jnp.maximum(left / len(j), least)", "left / len(j)", "nothing_makes_no"),
        ("max(1e-12, 4 * len(j) * float(jnp.finfo(j.dtype).eps))", "1e-12", "nothing_makes_no"),
    ),
    *of(
        "jaxeit/priors.py",
        f"test_hard_inverse test_priors test_methods test_iterative {GRADIENTS}",
        ("jnp.maximum(power, self.floor * jnp.max(power))", "power", "pixels_that_no"),
        ("top = jnp.where(top > 0, top, 1)", "pass", "nothing_makes_no"),
        ("jnp.sqrt((step / top) ** 2 + self.beta**2)", "jnp.abs(step / top)", "nothing_makes_no"),
        ("jnp.maximum(picture.areas, 1e-3 * jnp.max(picture.areas))", "picture.areas", "pixels_beside_the_sheet_have"),
        ("floor * jnp.where(mean > 0, mean, 1)", "floor * mean", "pixels_without_neighbours"),
    ),
    *of(
        "jaxeit/fusion.py",
        f"test_hard_fusion test_fusion {GRADIENTS}",
        ("area = jnp.where(self.areas > 0, self.areas, 1.0)", "area = self.areas", "a_pixel_that"),
        ("np.maximum(weights.sum(0), 1.0)", "1.0", "test_overlapping_pads_share"),
        ("np.where(share > 1e-9, share, 0.0)", "share", "light_touches_are"),
        ("mass = jnp.where(finite, image, 0) * masks.areas", "mass = image * masks.areas", "a_pad_without_image"),
        ("positive / jnp.where(total > 0, total, 1)", "positive / total", "light_touches_are"),
        ("& ~missing & known & (forces > 0)", "& known & (forces > 0)", "a_pad_without_image"),
        ("& ~missing & known & (forces > 0)", "& ~missing & (forces > 0)", "a_sensor_saturated"),
        ("& ~missing & known & (forces > 0)", "& ~missing & known", "any_force_is"),
        ("jnp.where(valid[..., None], shape, masks.areas)", "shape", "light_touches_are"),
        ("seen = jnp.maximum(mass, 0)", "seen = mass", "light_touches_are"),
        ("part / jnp.where(whole > 0, whole, 1)", "part / whole", "a_mask_of"),
        ("jnp.where(known, forces, 0)[..., None]", "forces[..., None]", "a_sensor_saturated"),
        ("force = jnp.where(silent, jnp.nan, force)", "pass", "a_sensor_saturated"),
        ("if not (mask * areas).any():", "if False:", "shapes_that_do"),
        ("if len(image.shape) != 2:", "if False:", "shapes_that_do"),
        ("if image.shape[-1:] != (pixels,) or forces.shape[-1:] != (pads,):", "if False:", "shapes_that_do"),
    ),
    *of(
        "jaxeit/descent.py",
        f"test_descent test_hard_contacts test_contacts {GRADIENTS}",
        ("jnp.maximum(squares, 1e-12 * jnp.max(squares) + 1e-30)", "squares", "a_touch_on"),
        ("return 1e3 * jnp.finfo(like.dtype).eps", "return 0.0", "columns_that_are_alike"),
        ("jnp.clip(fit.flat + step, low, high)", "fit.flat + step", "a_number_pushed"),
        ("taken = trial.square < fit.square", "taken = jnp.isfinite(trial.square)", "a_step_that_leads"),
        (
            "free = ~((fit.flat <= low) & (fit.downhill < 0) | (fit.flat >= high) & (fit.downhill > 0))",
            "free = jnp.ones_like(fit.flat, bool)",
            "a_number_pushed",
        ),
        ("(fit.steps < TRIAL) | (fit.square - ahead * fit.promised < hope)", "True", "a_descent_that"),
    ),
    *of(
        "jaxeit/nonlinear.py",
        f"test_nonlinear {GRADIENTS}",
        ("used = jnp.isfinite(readings) & jnp.isfinite(std)", "used = jnp.isfinite(std)", "readings_not_finite"),
        ("used = jnp.isfinite(readings) & jnp.isfinite(std)", "used = jnp.isfinite(readings)", "readings_not_finite"),
        ("jnp.sqrt(square + self.beta**2)", "jnp.sqrt(square)", "derivatives_are_right"),
        ("for n in range(5))", "for n in range(1))", "a_step_that_overshoots"),
        (
            "jnp.where(found.result == optx.RESULTS.successful, image(found.value), jnp.nan)",
            "image(found.value)",
            "an_image_that_did_not",
        ),
    ),
    *of(
        "jaxeit/optimise.py",
        "test_nonlinear test_fit",
        ("lambda leaf: leaf.astype(y.dtype)", "lambda leaf: leaf", "float32_agrees_with"),
    ),
    *of(
        "jaxeit/contacts.py",
        "test_contacts",
        ("(k < most) & (fit.square > allowed)", "False", "one_start_ends_badly"),
    ),
    *of(
        "jaxeit/hyperparameter.py",
        "test_hyperparameter test_hard_inverse",
        (
            'if not within.size:\n            raise HyperparameterError(f"noise',
            'if False:\n            raise HyperparameterError(f"noise',
            "the_noise_figure",
        ),
        ("np.maximum(x1**2 + z1**2, 1e-30)", "(x1**2 + z1**2)", "where_the_l"),
        ("Spectrum(jnp.maximum(squares, 0),", "Spectrum(squares,", "no_square_is"),
        ("if not np.any(y):", "if False:", "frames_that_say_nothing"),
        ("if bad.size:", "if False:", "frames_that_say_nothing"),
        ("jnp.where(areas > 0, square, jnp.inf)", "square", "a_sheet_around_a_hole"),
    ),
    *of(
        "jaxeit/metrics.py",
        f"test_metrics {GRADIENTS}",
        ("jnp.where(jnp.max(image, -1, keepdims=True) > 0, found, jnp.nan)", "found", "where_nothing_is"),
        ("(image >= self.level * top) & (top > 0)", "(image >= self.level * top)", "where_nothing_is"),
        (
            "jnp.where(total > 0, weight @ recon.centres / jnp.where(total > 0, total, 1), jnp.nan)",
            "weight @ recon.centres / jnp.where(total > 0, total, 1)",
            "where_nothing_is",
        ),
        (
            "jnp.where(square == 0, 0, jnp.sqrt(jnp.where(square == 0, 1, square)))",
            "jnp.sqrt(square)",
            "lengths_by_hand",
        ),
        (
            "jnp.where(mean == 0, jnp.nan, spread / jnp.where(mean == 0, 1, mean))",
            "spread / mean",
            "derivatives_are_right",
        ),
        ("image = jnp.where(areas > 0, image, 0)", "pass", "pixels_off_the"),
    ),
    *of(
        "jaxeit/effects/material.py",
        f"test_effects_sheet test_effects {GRADIENTS}",
        (
            "touched = x > 0\n    return jnp.where(touched, jnp.where(touched, x, 1.0) ** exponent, 0.0)",
            "return x**exponent",
            "piezoresistance_follows_hill",
        ),
        ("jnp.log(jnp.maximum(load, jnp.finfo(load.dtype).tiny))", "jnp.log(load)", "memories_leave_nothing"),
        ("jnp.where(grown, before, 1.0) / jnp.where(grown, load, 1.0)", "before / load", "age_of_a"),
        (
            "jnp.where(small, tail / (1 + tail), 1 - 2 * i1e(k) / (k * i0e(k)))",
            "1 - 2 * i1e(k) / (k * i0e(k))",
            "islands_of_the",
        ),
        ("k = jnp.sqrt(jnp.where(small, 1.0, square))", "k = jnp.sqrt(square)", "sheets_have_slopes"),
    ),
    *of(
        "jaxeit/effects/mechanics.py",
        f"test_effects_sheet test_effects {GRADIENTS}",
        (
            "jnp.where(off, jnp.sqrt(jnp.where(off, square, 1.0)), 0.0)[:, None]",
            "jnp.sqrt(square)[:, None]",
            "indentation_has_slopes",
        ),
    ),
    *of(
        "jaxeit/effects/pneumatics.py",
        "test_effects_pneumatics test_effects",
        (
            "jnp.where(steps > 0, -jnp.expm1(-steps) / jnp.where(steps > 0, steps, 1), 1)",
            "-jnp.expm1(-steps) / steps",
            "without_its_cause_the_pad",
        ),
    ),
    *of(
        "jaxeit/effects/electrical.py",
        "test_effects_electrical test_effects",
        (
            "jnp.maximum(1.0, circuit.current * path / self.compliance)",
            "circuit.current * path / self.compliance",
            "a_lost_electrode",
        ),
    ),
    *of(
        "calib/fit.py",
        FITTING,
        ("far = jnp.maximum(s, 1.0)", "far = s", "losses_have_slopes"),
        ("safe = jnp.where(small, 1.0, s)", "safe = s", "losses_have_slopes"),
        ("return jnp.where(samples.valid, r, 0.0)", "return r", "robust_fit_is"),
        (
            "mad = MAD_TO_SIGMA * jnp.nanmedian(jnp.where(samples.valid, r, jnp.nan))",
            "mad = 1.5 * jnp.median(r)",
            "the_scatter_of",
        ),
        ("return jnp.where(mad > floor, mad, floor)", "return mad", "the_scatter_of"),
        ("(dpsi - mean) ** 2, 0.0)) / n", "(dpsi - mean) ** 2, 0.0)) * 0", "the_covariance_of"),
        ("enough = ~jnp.any(decided) & (steepness[0] > 0.05)", "enough = steepness[0] > 0.05", "presses_that_alone"),
        ("enough = ~jnp.any(decided) & (steepness[0] > 0.05)", "enough = ~jnp.any(decided)", "presses_that_alone"),
        (
            "columns.append(column / jnp.where(length > 0, length, 1))",
            "columns.append(column / length)",
            "columns_that_are_almost",
        ),
        ("for _ in range(2):", "for _ in range(1):", "columns_that_are_almost"),
        ("rank = jnp.sum(singular > tiny)", "rank = jnp.sum(singular > 0)", "a_curve_that_runs"),
        (
            "return jnp.where(last >= 0, jnp.where(present, pressure, 0.0)[last], 0.0)",
            "return jnp.where(present, pressure, 0.0)",
            "a_pressure_is",
        ),
        ("clean = jnp.all(present | ~samples.valid)", "clean = True", "missing_samples_are_dropped"),
        (
            "finite=clean & (n > 0) & jnp.all(jnp.isfinite(params))",
            "finite=clean & jnp.all(jnp.isfinite(params))",
            "hopeless_samples_are",
        ),
        ("finite=clean & (n > 0) & jnp.all(jnp.isfinite(params))", "finite=clean & (n > 0)", "a_slope_that"),
        (
            "enough=(n > k) & ((groups > k) if n_groups else True)",
            "enough=(groups > k) if n_groups else True",
            "hopeless_samples_are",
        ),
        ("enough=(n > k) & ((groups > k) if n_groups else True)", "enough=n > k", "hopeless_samples_each"),
        ("rises=rise > 1e-3 * scale.force", "rises=True", "hopeless_samples_are"),
        ("determined=(rank == k) & decided", "determined=rank == k", "a_slope_from"),
        ("determined=(rank == k) & decided", "determined=decided", "a_curve_that_runs"),
        ("inside=~jnp.any(vanished) | (missed < _CONTRADICTED)", "inside=True", "a_curve_that_runs"),
        ("inside=~jnp.any(vanished) | (missed < _CONTRADICTED)", "inside=~jnp.any(vanished)", "a_slope_that_the"),
        ("jnp.where(total > 0, total, 1)", "total", "samples_without_residuals"),
        ("bends @ above(multiple)", "bends @ multiple", "a_dead_zone"),
        (
            "jnp.minimum(push, push + bends.T @ (bends @ (1 / unit)))",
            "(push + bends.T @ (bends @ (1 / unit)))",
            "a_dead_zone",
        ),
        ("jnp.minimum((r / w) ** 2, 0.1 * jnp.finfo(r.dtype).max)", "(r / w) ** 2", "what_is_further"),
        ("parameters=jnp.where(unusable, jnp.nan, params)", "parameters=params", "hopeless_samples_each"),
        ("covariance=jnp.where(failed, jnp.nan, covariance)", "covariance=covariance", "hopeless_samples_are"),
        ("pressure_range=jnp.where(n > 0, limits, jnp.nan)", "pressure_range=limits", "hopeless_samples_are"),
        ("if not bool(jnp.all(jnp.isfinite(s) & (s > 0))):", "if False:", "wrong_shapes_and"),
        ("jnp.where(wide.sigma > 0, wide.sigma, 1.0)", "wide.sigma", "samples_that_only"),
        ("if p.ndim != 2:", "if False:", "wrong_shapes_and"),
    ),
    *of(
        "calib/solver.py",
        "test_solver",
        ("taken = square < state.square", "taken = jnp.isfinite(square)", "a_step_that_leads"),
        ("free = (y > lower) | (downhill > 0)", "free = y > lower", "one_that_starts"),
        ("trial = jnp.maximum(y + part + rest, lower)", "trial = y + part + rest", "parameters_pushed"),
        ("& (damping <= 1) & jnp.isfinite(square)", "", "what_is_not_finite"),
    ),
    *of(
        "calib/curves.py",
        FITTING,
        ("return jnp.where(value > 0, value, otherwise)", "return value", "start_is_finite"),
        ("centre=jnp.nan_to_num(centre)", "centre=centre", "start_is_finite"),
        (
            "jnp.where(run > 0, (right[1] - left[1]) / jnp.where(run > 0, run, 1.0), jnp.nan)",
            "(right[1] - left[1]) / run",
            "resistant_line_is_none",
        ),
        (
            "jnp.maximum(jnp.nan_to_num(jnp.nanmedian(ratio), nan=unit), 1e-3 * unit)",
            "jnp.nanmedian(ratio)",
            "start_is_finite",
        ),
        ("slope = jnp.maximum(jnp.nan_to_num(slope, nan=unit), 1e-3 * unit)", "pass", "start_is_finite"),
        ("return jnp.stack([slope, jnp.nan_to_num(level)])", "return jnp.stack([slope, level])", "start_is_finite"),
        ("z = jnp.where(loaded, pressure, p0) / p0", "z = pressure / p0", "power_law_is_zero"),
        ("return jnp.where(jnp.isnan(pressure), pressure, force)", "return force", "nan_pressure_gives"),
        ("z = jnp.where(loaded, force, 1.0) / (params[0] * p0)", "z = force / (params[0] * p0)", "power_law_is_zero"),
        ("return jnp.where(jnp.isnan(force), force, pressure)", "return pressure", "nan_pressure_gives"),
        ("jnp.clip(jnp.nan_to_num(slope, nan=1.0), 0.2, 5.0)", "slope", "start_is_finite"),
        (
            "jnp.where(jnp.isfinite(slope) & (slope > 0), jnp.exp(intercept) * scale.force / p0, straight)",
            "jnp.exp(intercept) * scale.force / p0",
            "start_is_finite",
        ),
        ("inside = self._unit(params, jnp.clip(z, 0, 1))", "inside = self._unit(params, z)", "inverse_undoes_the"),
        (
            "return jnp.where(jnp.isnan(force), force, z * self._top(params.dtype))",
            "return z * self._top(params.dtype)",
            "nan_pressure_gives",
        ),
        ("low = jnp.where(hold, -jnp.inf, u - width)", "low = u - width", "play_is_its"),
    ),
    *of(
        "calib/online.py",
        "test_hard_runs test_online",
        (
            "finite = jnp.isfinite(target) & jnp.all(jnp.isfinite(features))",
            "finite = jnp.isfinite(target)",
            "a_sample_that",
        ),
        (
            "finite = jnp.isfinite(target) & jnp.all(jnp.isfinite(features))",
            "finite = jnp.all(jnp.isfinite(features))",
            "a_sample_that",
        ),
        ("shrunk = (shrunk + shrunk.T) / 2", "pass", "it_is_weighted"),
        ("shrunk = shrunk * jnp.minimum(1, limit / jnp.trace(shrunk))", "pass", "idling_winds_nothing"),
        ("go = use & finite & (news > _NOTHING)", "go = use & finite", "idling_winds_nothing"),
        ("go = use & finite & (news > _NOTHING)", "go = finite & (news > _NOTHING)", "idling_winds_nothing"),
        ("jnp.sqrt(jnp.maximum(variance, 0))", "jnp.sqrt(variance)", "pads_that_pull"),
        ("jnp.maximum(force, self.least)) ** 2)", "force) ** 2)", "pads_that_pull"),
        ("jnp.sum(jnp.maximum(frames.pad_force, 0), 1)", "jnp.sum(frames.pad_force, 1)", "pads_that_pull"),
        ("(contacts == 1) & (frames.image_sum > 0)", "(contacts == 1)", "pads_that_pull"),
        ("(contacts == 1) & (frames.image_sum > 0)", "(frames.image_sum > 0)", "only_single_confident"),
    ),
    *of(
        "calib/location.py",
        "test_hard_fields test_location",
        (
            "jnp.sum((point[..., None, :] - start) * vector, -1) / jnp.where(square > 0, square, 1)",
            "jnp.sum((point[..., None, :] - start) * vector, -1) / square",
            "a_side_of",
        ),
        ("jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)", "jnp.sqrt(square)", "a_place_on"),
        ("jnp.where(present[..., None], places.position, 0)", "places.position", "a_contact_that_is_not_there"),
        ("(weight / jnp.where(total > 0, total, 1))", "(weight / total)", "a_contact_that_is_not_there"),
        ("jnp.diag(jnp.where(present, 1e-12, 1.0).astype(x.dtype))", "0", "a_pad_without_presses"),
        (
            "unknown = jnp.maximum(self.spread**2 - self.noise**2, 0)",
            "unknown = self.spread**2 - self.noise**2",
            "a_contact_that_is_not_known",
        ),
        (
            "finite = jnp.isfinite(log_ratio) & jnp.all(jnp.isfinite(share), -1)",
            "finite = jnp.isfinite(log_ratio)",
            "presses_of_unknown",
        ),
        (
            "coefficients=jnp.where(good, found.coefficients, 0)",
            "coefficients=found.coefficients",
            "presses_of_unknown",
        ),
        (
            "values, axes = jnp.maximum(values, 0), root[:, None] * vectors",
            "axes = root[:, None] * vectors",
            "features_that_are",
        ),
        ("jnp.clip(place, reach[..., 0, :], reach[..., 1, :])", "place", "beyond_what_was"),
        ("(there - held) @ self.coefficients", "0.0", "what_a_field_would"),
        ("jnp.where(none, -1, low), jnp.where(none, 1, high)", "low, high", "a_pad_that_no_press"),
        ("& (share >= _BORNE)[:, None, :, None]", "", "leave_out_the_borders"),
        ("jnp.maximum(box[:, 0], reach[0])", "box[:, 0]", "a_pad_that_no_press"),
        ("farthest = jnp.max(jnp.maximum(-low, high), -1, keepdims=True)", "return low, high", "one_wall_tells"),
    ),
    *of(
        "calib/acquisition/entries.py",
        "test_recorder",
        ("if not size or len(payload) != _HEAD.size + channels * size:", "if False:", "records_of_another"),
        ("if abs(host) >= 2**62:", "if False:", "records_of_another"),
        ("if len(payload) != _PONG.size:", "if False:", "records_of_another"),
        ("except (ValueError, RecursionError) as error:", "except ValueError as error:", "records_of_another"),
        ("if not isinstance(pair, list) or len(pair) != 2:", "if False:", "records_of_another"),
        ('.encode(errors="replace").decode().replace("\\0", "?")', "", "what_a_device_says"),
    ),
    *of(
        "calib/acquisition/priority.py",
        "test_live",
        ("before = _raised() if wanted else {}", "before = _raised()", "a_priority_that_is_refused"),
        ("        _set(before)", "        pass", "before_all_ordinary"),
        ('not (hasattr(os, "sched_setscheduler") and _TASKS.is_dir())', "False", "a_priority_that_is_refused"),
        ("    except PermissionError as error:", "    except ValueError as error:", "a_priority_that_is_refused"),
    ),
    *of(
        "jaxeit/verbs.py",
        "test_verbs",
        ("small = array.size <= _SMALL and isinstance(array.dtype, np.dtype)", "small = True", "arrays_keep"),
    ),
    *of(
        "calib/acquisition/plan.py",
        "test_recorder",
        ("if not _is(value, declared[name]):", "if False:", "a_plan_no_session"),
        ('len(raw) > MAX_ATTRIBUTE_BYTES or b"\\0" in raw', 'b"\\0" in raw', "a_plan_no_session"),
        ('or b"\\0" in raw or', "or", "a_plan_no_session"),
        ("or (raw and raw.decode() != text)", "", "a_plan_no_session"),
        ("noqa: B018  refuses channels, scale and number\n        _check_texts(self)", "noqa: B018", "plans_must_be"),
        ("abs(number) >= 2**62", "False", "a_plan_no_session"),
        ("len(row) != 4 or min(row)", "min(row)", "a_plan_no_session"),
        ("or max(row) >= 1 << 15", "", "a_plan_no_session"),
        ("if self.simulated and (self.scene is None or self.seed is None):", "if False:", "a_plan_no_session"),
    ),
    *of(
        "calib/acquisition/finish.py",
        "test_recorder",
        ("if number in surveys:", "if True:", "an_answer_of"),
        ("isinstance(seed, int) and abs(seed) < 2**62", "isinstance(seed, int)", "what_a_device_says"),
    ),
    *of(
        "calib/acquisition/wire.py",
        "test_wire",
        ("except (ValueError, RecursionError):", "except ValueError:", "a_note_is_no_sample"),
    ),
]


def misfits(mutants: Iterable[Mutant]) -> list[str]:
    """What of this list does not stand in the sources once, or in the names of the tests; a line each."""
    return [line for mutant in mutants for line in _misfits(mutant)]


def _misfits(mutant: Mutant) -> Iterator[str]:
    times = (ROOT / mutant.file).read_text().count(mutant.old) if (ROOT / mutant.file).exists() else 0
    if times != 1:
        yield f"{mutant.file}: {mutant.old!r} stands there {times} times"
    paths = [ROOT / "tests" / f"{name}.py" for name in mutant.tests.split()]
    names = [name for path in paths if path.exists() for name in re.findall(r"def (test_\w+)", path.read_text())]
    yield from (f"{path.name}: there is no such test file" for path in paths if not path.exists())
    if not any(mutant.first in name for name in names):
        yield f"{mutant.tests}: no test is called {mutant.first!r}, for {mutant.old!r}"


def held(mutant: Mutant, copy: Path) -> str | None:
    """The first test to fail where this guard is broken, if any does; the copy is whole again afterwards."""
    path = copy / mutant.file
    sound = path.read_text()
    path.write_text(sound.replace(mutant.old, mutant.new))
    runs = [["-k", mutant.first]] if mutant.first else []
    try:
        return next(filter(None, (failure(mutant.tests, run, copy) for run in [*runs, *SPEEDS])), None)
    finally:
        path.write_text(sound)


SPEEDS = ["-m", "not slow"], ["-m", "slow"]


def failure(names: str, chosen: list[str], copy: Path) -> str | None:
    """What the first of these tests to fail is called, or None."""
    tests = [f"tests/{name}.py" for name in names.split()]
    command = [sys.executable, "-m", "pytest", "-n0", "-x", "-q", *chosen, "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, timeout=1800, check=False
        )
    except subprocess.TimeoutExpired:
        return "no end"
    if done.returncode in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        return None
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    if not failed:
        raise RuntimeError(done.stdout[-2000:] + done.stderr[-2000:])
    return failed[0]


def copied(folder: Path) -> Path:
    """What the tests need, and what they compiled before."""
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, folder / name)
    if (ROOT / ".pytest_cache" / "jax").is_dir():
        shutil.copytree(ROOT / ".pytest_cache" / "jax", folder / ".pytest_cache" / "jax")
    return folder


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("text", nargs="?", default="", help="break only guards whose file or code contains this")
    parser.add_argument("--log", type=Path, default=Path(os.devnull), help="verdicts: kept here, and taken from here")
    parser.add_argument("--check", action="store_true", help="break nothing: does this list fit the sources?")
    given = parser.parse_args()
    if misfit := misfits(MUTANTS):
        print("mend this list:", *misfit, sep="\n  ")
        return 2
    if given.check:
        print(f"{len(MUTANTS)} guards, all where this list says")
        return 0
    verdicts = {tuple(key): by for *key, by in map(json.loads, given.log.open())} if given.log.exists() else {}
    chosen = {mutant[:3]: mutant for mutant in MUTANTS if given.text in mutant.file or given.text in mutant.old}
    with tempfile.TemporaryDirectory() as folder, given.log.open("a") as log:
        copy = copied(Path(folder))
        for key in [key for key in chosen if key not in verdicts]:
            verdicts[key] = held(chosen[key], copy)
            print(*key, verdicts[key] or "SURVIVED", sep=" | ", flush=True)
            print(json.dumps([*key, verdicts[key]]), file=log, flush=True)
    alive = [key for key in chosen if verdicts[key] is None]
    print(f"{len(chosen)} guards broken, {len(alive)} of them held by no test")
    for file, old, new in alive:
        print(f"  {file}: {new!r} for {old!r}")
    return 1 if alive else 0


if __name__ == "__main__":
    sys.exit(main())
