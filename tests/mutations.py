"""Guards broken one at a time, in a copy of the project: a test must fail for each, or the guard is dead.

    python -m tests.mutations [TEXT]

breaks those whose file or code contains TEXT, all without it, runs the tests that concern each (the slow ones if no
other minds), and lists the ones that no test held; exit status 1 if there are any. Hours for all of them. Guards that
only save time are not here.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
COPIED = ("jaxeit", "calib", "tests", "data", "benchmarks", "pyproject.toml", "README.md")


class Mutant(NamedTuple):
    """A text that stands once in a file, what to put in its place, and the tests that should mind."""

    file: str
    old: str
    new: str
    tests: str


def of(file: str, tests: str, *changes: tuple[str, str]) -> list[Mutant]:
    """Mutants of one file under the same tests."""
    return [Mutant(file, old, new, tests) for old, new in changes]


SOLVING = "test_solvers test_hard_contacts test_hard_forward"
IMAGING = "test_hard_inverse test_inverse test_whitening test_methods"
FITTING = "test_hard_fits test_fit test_curves"
GRADIENTS = "test_hard_gradients"

MUTANTS = [
    *of(
        "jaxeit/solvers/_base.py",
        SOLVING,
        ("d = jax.lax.rsqrt(values[plan.diagonal])", "d = jnp.ones_like(values[plan.diagonal])"),
        ("rows.size and not (cols.min() >= 0 and rows.max() < n and (cols <= rows).all())", "False"),
        ("np.unique(rows.astype(np.int64) * n + cols).size != rows.size", "False"),
        ("np.count_nonzero(rows == cols) != n", "False"),
        ("rows.ndim != 1 or rows.shape != cols.shape", "False"),
        ("coords is not None and (coords.ndim != 2 or coords.shape[0] != n)", "False"),
        ("root.ndim != 1 or np.unique(root).size != root.size", "False"),
        ("root.size and not (root.min() >= 0 and root.max() < n)", "False"),
    ),
    *of(
        "jaxeit/solvers/conjugate_gradient.py",
        SOLVING,
        ("max(self.tolerance, 8 * float(jnp.finfo(b.dtype).eps))", "self.tolerance"),
        ("return jnp.where(jnp.linalg.norm(r, axis=0) <= goal, x, jnp.nan)", "return x"),
        ("jnp.where(below == 0, 0, above / jnp.where(below == 0, 1, below))", "above / below"),
    ),
    *of(
        "jaxeit/solvers/nested_dissection.py",
        SOLVING,
        ("portion = gcd(count, 1 << int(np.log2(max(1, _IN_PLACE // work))))", "portion = count"),
    ),
    *of(
        "jaxeit/forward.py",
        f"test_hard_forward test_hard_contacts test_forward test_effects_electrical {GRADIENTS}",
        ("jnp.where(values < 0, jnp.nan, values)", "values"),
        ("(jnp.where(lumped, v, 1.0) for v in", "(v for v in"),
        ("jnp.where(lumped, resistance, 0.0)", "resistance"),
        ("total = jnp.where(touch > 0, touch + sheet, 1.0)", "total = touch + sheet"),
        ("best = jnp.argmax(own * system.ground_weight)", "best = 0"),
        ("best = jnp.argmax(own * system.ground_weight)", "best = jnp.argmax(own)"),
        ("values.shape != model.background.shape or values.dtype != model.dtype", "False"),
        ("if model.coat is None:", "if False:"),
    ),
    *of(
        "jaxeit/inverse.py",
        IMAGING,
        ("jax.lax.cond(jnp.isfinite(jnp.sum(sums)), lambda: sums, mended)", "sums"),
        ("there = (jnp.arange(_FEW) < jnp.sum(missing)).astype(dv.dtype)", "there = jnp.ones(_FEW, dv.dtype)"),
        ("few = jnp.sum(missing) <= (_FEW if", "few = True | (_FEW if"),
        ("(_FEW if self.whitening.weight.ndim == 1 else 0)", "_FEW"),
        ("jnp.where(missing, 0, dv)), p @", "dv), p @"),
        ("if not isfinite(np.vdot(t, t)):", "if False:"),
        ("if not np.isfinite(recon.factor).all():", "if False:"),
        ("if hyperparameter.needs_noise and not noise_is_known:", "if False:"),
        ("if not least <= hyperparameter <= _MOST:", "if not 0 < hyperparameter <= _MOST:"),
        ("if not least <= hyperparameter <= _MOST:", "if not least <= hyperparameter:"),
        ("(1e3 * eps) ** 0.5 if isinstance(method, AbstractIterativeMethod) else 8e3 * eps", "8e3 * eps"),
        ("jnp.full_like(problem.picture.areas, jnp.inf)", "method.variance(problem)"),
        ("if np.shape(dv)[-1:] != (readings,):", "if False:"),
    ),
    *of(
        "jaxeit/whitening.py",
        IMAGING,
        ("dv = jnp.where(self.channels, dv, 0)", "dv = jnp.asarray(dv)"),
        ("missing = self.channels & ~jnp.isfinite(dv)", "missing = ~jnp.isfinite(dv)"),
        ("known = jnp.where(self.channels & ~missing, dv, 0)", "known = jnp.where(missing, 0, dv)"),
        ("rows / jnp.where(self.weight > 0, self.weight, 1)[:, None]", "rows / self.weight[:, None]"),
        ("jnp.diag((~missing).astype(rows.dtype))", "0"),
        ("weight = jnp.where(used, self.weight, 0)", "weight = self.weight"),
        ("rows = jnp.where(gone[:, None], self.weight, 0)", "rows = self.weight"),
        ("if noise.shape not in ((readings,), (readings, readings)):", "if False:"),
        ("bad = channels & ~(np.isfinite(noise) & (noise > 0))", "bad = channels & ~(noise > 0)"),
        ("bad = channels & ~(np.isfinite(noise) & (noise > 0))", "bad = channels & ~np.isfinite(noise)"),
        ("bad = channels & ~(np.isfinite(noise) & (noise > 0))", "bad = ~(np.isfinite(noise) & (noise > 0))"),
        ("np.where(channels, np.where(channels, noise, 1.0) ** -2.0, 0.0)", "np.where(channels, noise**-2.0, 0.0)"),
        ("if not np.isfinite(weight).all() or not np.allclose(part, part.T, rtol=1e-6, atol=0):", "if False:"),
        (
            "not np.isfinite(weight).all() or not np.allclose(part, part.T, rtol=1e-6, atol=0)",
            "not np.isfinite(weight).all()",
        ),
        ("if blank.ndim != 2 or len(blank) < 4 or not np.isfinite(blank).all():", "if False:"),
        ("if (std == 0).any():", "if False:"),
        ("max((correlation[off] ** 2).sum(), 1e-300)", "(correlation[off] ** 2).sum()"),
        ("shrink = np.clip(", "shrink = (lambda value, *_: value)("),
    ),
    *of(
        "jaxeit/methods.py",
        f"test_hard_inverse test_methods test_iterative test_hyperparameter {GRADIENTS}",
        ("jax.lax.cond(enough, _squared, _orthogonal, b, level, y)", "_squared(b, level, y)"),
        ("jnp.maximum(problem.level(b), max(b.shape) * jnp.finfo(b.dtype).eps * s[0])", "problem.level(b)"),
        ("power + self.floor * jnp.max(power)", "power"),
        (
            "contacts = jnp.exp(-0.5 * square / self.width**2) * (areas > 0)",
            "contacts = jnp.exp(-0.5 * square / self.width**2)",
        ),
        ("jnp.where(whole > 0, mass / jnp.where(whole > 0, whole, 1), 0)", "mass / whole"),
        ("top = jnp.where(top > 0, top, 1)  # all", "# all"),
        ("jax.lax.stop_gradient((j, weight, y))", "(j, weight, y)"),
        (
            "return jnp.maximum(j.T @ _left(above, j, weight, y) / weight, 0) * above",
            "return j.T @ _left(above, j, weight, y) / weight * above",
        ),
        ("jax.lax.cond(jnp.sum(above) <= size, few, many, j, weight, y)", "few(j, weight, y)"),
        (
            "return length[jnp.argmin(0.5 * jnp.sum(moved**2, 1) - moved @ y + 0.5 * jnp.sum(image**2 / weight, 1))]",
            "return length[0]",
        ),
        ("jnp.maximum(0.1 * jnp.mean(x * z), jnp.finfo(x.dtype).eps ** 2)", "0.1 * jnp.mean(x * z)"),
        ("-0.99 * v / jnp.where(d < 0, d, 1)", "-v / jnp.where(d < 0, d, 1)"),
        ("if not isinstance(precision, Diagonal):", "if False:"),
        ("top = jnp.where(top > 0, top, 1)\n        y = y / top", "y = y / top"),
        ("power = jnp.where(power > 0, power, 1)", "pass"),
        ("g * seen**2 / jnp.where(own > 0, own, 1)", "g * seen**2 / own"),
        ("jnp.maximum(left / len(j), least)", "left / len(j)"),
        ("max(1e-12, 4 * len(j) * float(jnp.finfo(j.dtype).eps))", "1e-12"),
    ),
    *of(
        "jaxeit/priors.py",
        f"test_hard_inverse test_priors test_methods test_iterative {GRADIENTS}",
        ("jnp.maximum(power, self.floor * jnp.max(power))", "power"),
        ("top = jnp.where(top > 0, top, 1)", "pass"),
        ("jnp.sqrt((step / top) ** 2 + self.beta**2)", "jnp.abs(step / top)"),
        ("jnp.maximum(picture.areas, 1e-3 * jnp.max(picture.areas))", "picture.areas"),
        ("floor * jnp.where(mean > 0, mean, 1)", "floor * mean"),
    ),
    *of(
        "jaxeit/fusion.py",
        f"test_hard_fusion test_fusion {GRADIENTS}",
        ("area = jnp.where(self.areas > 0, self.areas, 1.0)", "area = self.areas"),
        ("np.maximum(weights.sum(0), 1.0)", "1.0"),
        ("np.where(share > 1e-9, np.minimum(share, 1.0), 0.0)", "np.minimum(share, 1.0)"),
        ("np.where(share > 1e-9, np.minimum(share, 1.0), 0.0)", "np.where(share > 1e-9, share, 0.0)"),
        ("mass = jnp.where(finite, image, 0) * masks.areas", "mass = image * masks.areas"),
        ("positive / jnp.where(total > 0, total, 1)", "positive / total"),
        ("& ~missing & known & (forces > 0)", "& known & (forces > 0)"),
        ("& ~missing & known & (forces > 0)", "& ~missing & (forces > 0)"),
        ("& ~missing & known & (forces > 0)", "& ~missing & known"),
        ("jnp.where(valid[..., None], shape, masks.areas)", "shape"),
        ("seen = jnp.maximum(mass, 0)", "seen = mass"),
        ("part / jnp.where(whole > 0, whole, 1)", "part / whole"),
        ("jnp.where(known, forces, 0)[..., None]", "forces[..., None]"),
        ("force = jnp.where(silent, jnp.nan, force)", "pass"),
        ("if not (mask * areas).any():", "if False:"),
        ("if len(image.shape) != 2:", "if False:"),
        ("if image.shape[-1:] != (pixels,) or forces.shape[-1:] != (pads,):", "if False:"),
    ),
    *of(
        "jaxeit/descent.py",
        f"test_hard_contacts test_contacts {GRADIENTS}",
        ("jnp.maximum(squares, 1e-12 * jnp.max(squares) + 1e-30)", "squares"),
        ("return 1e3 * jnp.finfo(like.dtype).eps", "return 0.0"),
        ("jnp.clip(fit.flat + step, low, high)", "fit.flat + step"),
        ("taken = trial.square < fit.square", "taken = jnp.isfinite(trial.square)"),
        (
            "free = ~((fit.flat <= low) & (fit.downhill < 0) | (fit.flat >= high) & (fit.downhill > 0))",
            "free = jnp.ones_like(fit.flat, bool)",
        ),
        ("((step < _TRIAL) | (fit.square < hope))", "True"),
    ),
    *of(
        "jaxeit/nonlinear.py",
        "test_nonlinear",
        ("used = jnp.isfinite(readings) & jnp.isfinite(std)", "used = jnp.isfinite(std)"),
        ("used = jnp.isfinite(readings) & jnp.isfinite(std)", "used = jnp.isfinite(readings)"),
        ("jnp.sqrt(square + self.beta**2)", "jnp.sqrt(square)"),
        ("for n in range(5))", "for n in range(1))"),
    ),
    *of(
        "jaxeit/hyperparameter.py",
        "test_hyperparameter",
        (
            'if not within.size:\n            raise HyperparameterError(f"noise',
            'if False:\n            raise HyperparameterError(f"noise',
        ),
        ("np.maximum(x1**2 + z1**2, 1e-30)", "(x1**2 + z1**2)"),
        ("Spectrum(jnp.maximum(squares, 0),", "Spectrum(squares,"),
    ),
    *of(
        "jaxeit/metrics.py",
        f"test_metrics {GRADIENTS}",
        ("jnp.where(jnp.max(image, -1, keepdims=True) > 0, found, jnp.nan)", "found"),
        ("(image >= self.level * top) & (top > 0)", "(image >= self.level * top)"),
        (
            "jnp.where(total > 0, weight @ recon.centres / jnp.where(total > 0, total, 1), jnp.nan)",
            "weight @ recon.centres / jnp.where(total > 0, total, 1)",
        ),
        ("jnp.where(square == 0, 0, jnp.sqrt(jnp.where(square == 0, 1, square)))", "jnp.sqrt(square)"),
        ("jnp.where(mean == 0, jnp.nan, spread / jnp.where(mean == 0, 1, mean))", "spread / mean"),
        ("area = jnp.where(seen, lit.sum(-1), 1)", "area = lit.sum(-1)"),
        ("image = jnp.where(areas > 0, image, 0)", "pass"),
    ),
    *of(
        "jaxeit/effects/material.py",
        f"test_effects_sheet test_effects {GRADIENTS}",
        (
            "touched = x > 0\n    return jnp.where(touched, jnp.where(touched, x, 1.0) ** exponent, 0.0)",
            "return x**exponent",
        ),
        ("jnp.log(jnp.maximum(load, jnp.finfo(load.dtype).tiny))", "jnp.log(load)"),
        ("jnp.where(grown, before, 1.0) / jnp.where(grown, load, 1.0)", "before / load"),
        ("jnp.where(small, tail / (1 + tail), 1 - 2 * i1e(k) / (k * i0e(k)))", "1 - 2 * i1e(k) / (k * i0e(k))"),
        ("k = jnp.sqrt(jnp.where(small, 1.0, square))", "k = jnp.sqrt(square)"),
    ),
    *of(
        "jaxeit/effects/mechanics.py",
        f"test_effects_sheet test_effects {GRADIENTS}",
        ("jnp.where(off, jnp.sqrt(jnp.where(off, square, 1.0)), 0.0)[:, None]", "jnp.sqrt(square)[:, None]"),
    ),
    *of(
        "jaxeit/effects/pneumatics.py",
        "test_effects_pneumatics test_effects",
        ("jnp.where(steps > 0, -jnp.expm1(-steps) / jnp.where(steps > 0, steps, 1), 1)", "-jnp.expm1(-steps) / steps"),
    ),
    *of(
        "jaxeit/effects/electrical.py",
        "test_effects_electrical test_effects",
        ("jnp.maximum(1.0, circuit.current * path / self.compliance)", "circuit.current * path / self.compliance"),
    ),
    *of(
        "calib/fit.py",
        FITTING,
        ("far = jnp.maximum(s, 1.0)", "far = s"),
        ("safe = jnp.where(small, 1.0, s)", "safe = s"),
        ("return jnp.where(samples.valid, r, 0.0)", "return r"),
        (
            "mad = MAD_TO_SIGMA * jnp.nanmedian(jnp.where(samples.valid, r, jnp.nan))",
            "mad = 1.5 * jnp.median(r)",
        ),
        ("return jnp.where(mad > floor, mad, floor)", "return mad"),
        ("(dpsi - mean) ** 2, 0.0)) / n", "(dpsi - mean) ** 2, 0.0)) * 0"),
        ("root = jax.lax.rsqrt(jnp.where(decided, 1.0, 1 - values))", "root = jax.lax.rsqrt(1 - values)"),
        ("enough = ~jnp.any(decided) & (steepness[0] > 0.05)", "enough = steepness[0] > 0.05"),
        ("enough = ~jnp.any(decided) & (steepness[0] > 0.05)", "enough = ~jnp.any(decided)"),
        ("columns.append(column / jnp.where(length > 0, length, 1))", "columns.append(column / length)"),
        ("for _ in range(2):", "for _ in range(1):"),
        ("rank = jnp.sum(singular > tiny)", "rank = jnp.sum(singular > 0)"),
        ("right.T / jnp.where(singular > tiny, singular, jnp.nan)", "right.T / singular"),
        (
            "return jnp.where(last >= 0, jnp.where(present, pressure, 0.0)[last], 0.0)",
            "return jnp.where(present, pressure, 0.0)",
        ),
        ("clean = jnp.all(present | ~samples.valid)", "clean = True"),
        ("finite=clean & (n > 0) & jnp.all(jnp.isfinite(params))", "finite=clean & jnp.all(jnp.isfinite(params))"),
        ("finite=clean & (n > 0) & jnp.all(jnp.isfinite(params))", "finite=clean & (n > 0)"),
        ("enough=(n > k) & ((groups > k) if n_groups else True)", "enough=(groups > k) if n_groups else True"),
        ("enough=(n > k) & ((groups > k) if n_groups else True)", "enough=n > k"),
        ("rises=rise > 1e-3 * scale.force", "rises=True"),
        ("determined=(rank == k) & decided", "determined=rank == k"),
        ("determined=(rank == k) & decided", "determined=decided"),
        ("inside=jnp.all(free > start - _VANISHED)", "inside=True"),
        ("parameters=jnp.where(unusable, jnp.nan, params)", "parameters=params"),
        ("covariance=jnp.where(failed, jnp.nan, covariance)", "covariance=covariance"),
        ("pressure_range=jnp.where(n > 0, limits, jnp.nan)", "pressure_range=limits"),
        ("jnp.maximum(n - k, 1)", "(n - k)"),
        ("if not bool(jnp.all(jnp.isfinite(s) & (s > 0))):", "if False:"),
        ("jnp.where(wide.sigma > 0, wide.sigma, 1.0)", "wide.sigma"),
        ("if p.ndim != 2:", "if False:"),
    ),
    *of(
        "calib/curves.py",
        FITTING,
        ("return jnp.where(value > 0, value, otherwise)", "return value"),
        ("centre=jnp.nan_to_num(centre)", "centre=centre"),
        (
            "jnp.where(run > 0, (right[1] - left[1]) / jnp.where(run > 0, run, 1.0), jnp.nan)",
            "(right[1] - left[1]) / run",
        ),
        ("jnp.maximum(jnp.nan_to_num(jnp.nanmedian(ratio), nan=unit), 1e-3 * unit)", "jnp.nanmedian(ratio)"),
        ("slope = jnp.maximum(jnp.nan_to_num(slope, nan=unit), 1e-3 * unit)", "pass"),
        ("return jnp.stack([slope, jnp.nan_to_num(level)])", "return jnp.stack([slope, level])"),
        ("z = jnp.where(loaded, pressure, p0) / p0", "z = pressure / p0"),
        ("return jnp.where(jnp.isnan(pressure), pressure, force)", "return force"),
        ("z = jnp.where(loaded, force, 1.0) / (params[0] * p0)", "z = force / (params[0] * p0)"),
        ("return jnp.where(jnp.isnan(force), force, pressure)", "return pressure"),
        ("jnp.clip(jnp.nan_to_num(slope, nan=1.0), 0.2, 5.0)", "slope"),
        (
            "jnp.where(jnp.isfinite(slope) & (slope > 0), jnp.exp(intercept) * scale.force / p0, straight)",
            "jnp.exp(intercept) * scale.force / p0",
        ),
        ("inside = self._unit(params, jnp.clip(z, 0, 1))", "inside = self._unit(params, z)"),
        (
            "return jnp.where(jnp.isnan(force), force, z * self._top(params.dtype))",
            "return z * self._top(params.dtype)",
        ),
        ("low = jnp.where(hold, -jnp.inf, u - width)", "low = u - width"),
    ),
    *of(
        "calib/online.py",
        "test_hard_runs test_online",
        ("finite = jnp.isfinite(target) & jnp.all(jnp.isfinite(features))", "finite = jnp.isfinite(target)"),
        ("finite = jnp.isfinite(target) & jnp.all(jnp.isfinite(features))", "finite = jnp.all(jnp.isfinite(features))"),
        ("shrunk = (shrunk + shrunk.T) / 2", "pass"),
        ("shrunk = shrunk * jnp.minimum(1, limit / jnp.trace(shrunk))", "pass"),
        ("go = use & finite & (news > _NOTHING)", "go = use & finite"),
        ("go = use & finite & (news > _NOTHING)", "go = finite & (news > _NOTHING)"),
        ("jnp.sqrt(jnp.maximum(variance, 0))", "jnp.sqrt(variance)"),
        ("jnp.maximum(force, self.least)) ** 2)", "force) ** 2)"),
        ("jnp.sum(jnp.maximum(frames.pad_force, 0), 1)", "jnp.sum(frames.pad_force, 1)"),
        ("(contacts == 1) & (frames.image_sum > 0)", "(contacts == 1)"),
        ("(contacts == 1) & (frames.image_sum > 0)", "(frames.image_sum > 0)"),
    ),
    *of(
        "calib/location.py",
        "test_location",
        (
            "jnp.sum((point[..., None, :] - start) * vector, -1) / jnp.where(square > 0, square, 1)",
            "jnp.sum((point[..., None, :] - start) * vector, -1) / square",
        ),
        ("jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)", "jnp.sqrt(square)"),
        ("jnp.where(present[..., None], places.position, 0)", "places.position"),
        ("(weight / jnp.where(total > 0, total, 1))", "(weight / total)"),
        ("jnp.diag(jnp.where(present, 1e-12, 1.0).astype(x.dtype))", "0"),
        ("unknown = jnp.maximum(self.spread**2 - self.noise**2, 0)", "unknown = self.spread**2 - self.noise**2"),
        ("finite = jnp.isfinite(log_ratio) & jnp.all(jnp.isfinite(share), -1)", "finite = jnp.isfinite(log_ratio)"),
        ("coefficients=jnp.where(good, found.coefficients, 0)", "coefficients=found.coefficients"),
        ("values, axes = jnp.maximum(values, 0), root[:, None] * vectors", "axes = root[:, None] * vectors"),
    ),
]


def survived(mutant: Mutant, copy: Path) -> bool:
    """Whether the tests pass although this guard is broken; the copy is whole again afterwards."""
    path = copy / mutant.file
    sound = path.read_text()
    if sound.count(mutant.old) != 1:
        raise ValueError(f"{mutant.file}: {mutant.old!r} stands there {sound.count(mutant.old)} times; mend this list")
    path.write_text(sound.replace(mutant.old, mutant.new))
    try:
        minded = next(filter(None, (failure(mutant.tests, speed, copy) for speed in ("not slow", "slow"))), None)
    finally:
        path.write_text(sound)
    print(f"{mutant.file}: {mutant.new!r} for {mutant.old!r}: {minded or 'SURVIVED'}", flush=True)
    return minded is None


def failure(names: str, speed: str, copy: Path) -> str | None:
    """What the first of these tests to fail is called, or None."""
    tests = [f"tests/{name}.py" for name in names.split()]
    command = [sys.executable, "-m", "pytest", "-n0", "-x", "-q", "-m", speed, "-p", "no:cacheprovider", *tests]
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


def main(text: str = "") -> int:
    with tempfile.TemporaryDirectory() as folder:
        copy = copied(Path(folder))
        chosen = [mutant for mutant in MUTANTS if text in mutant.file or text in mutant.old]
        alive = [mutant for mutant in chosen if survived(mutant, copy)]
    print(f"{len(chosen)} guards broken, {len(alive)} of them held by no test")
    for mutant in alive:
        print(f"  {mutant.file}: {mutant.new!r} for {mutant.old!r}")
    return 1 if alive else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
