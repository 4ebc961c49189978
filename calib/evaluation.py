"""What a calibration is worth: localisation and evenness over the presses of a session.

The figures are the paper's: figure 5, true and estimated positions; figure 6, sensitivity (estimated
over true force, up to a constant for the image alone) at every place, and its coefficient of
variation.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

import jaxeit as je

_BOOTSTRAPS = 2000


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Press by press.

    | meaning                                                            | shape           | unit |
    |--------------------------------------------------------------------|-----------------|------|
    | position of the tip, true                                          | (presses, 2)    | m    |
    | estimated positions, by each named estimator                       | (presses, 2)    | m    |
    | force: true, from the load cell                                    | (presses,)      | N    |
    | pressure: change of each pad's pressure over the hold              | (presses, pads) | Pa   |
    | pad_force: estimated for each pad, by a fit that had not seen it   | (presses, pads) | N    |
    | image_sum: integral of the image, what the image alone tells       | (presses,)      | S m^2|
    | centre of the sheet                                                | (2,)            | m    |
    | held_out_by: what the fit had not seen, "location" or "session"    |                 |      |
    | notes                                                              |                 |      |
    """

    position: np.ndarray
    estimated: dict[str, np.ndarray]
    force: np.ndarray
    pressure: np.ndarray
    pad_force: np.ndarray
    image_sum: np.ndarray
    centre: np.ndarray
    held_out_by: str
    notes: tuple[str, ...] = ()

    @property
    def total_force(self) -> np.ndarray:
        """Sum of the pads' forces, (presses,) N."""
        return self.pad_force.sum(1)

    @property
    def sensitivity_eit(self) -> np.ndarray:
        """Image sum per newton over its own mean, (presses,)."""
        ratio = self.image_sum / self.force
        return ratio / ratio.mean()

    @property
    def sensitivity_hybrid(self) -> np.ndarray:
        """Estimated over true force, (presses,)."""
        return self.total_force / self.force

    def summary(self) -> dict[str, float]:
        """The numbers a person would read; lengths in m, forces in N, each CV with its ddof."""
        out: dict[str, float] = {"presses": len(self.force)}
        for name, estimate in self.estimated.items():
            out |= {f"localisation_{name}_{k}": v for k, v in self._localisation(estimate).items()}
        for name in ("eit", "hybrid"):
            values = getattr(self, f"sensitivity_{name}")
            if len(values) > 1:
                for ddof in (0, 1):
                    cv = je.coefficient_of_variation(values, ddof=ddof)
                    out[f"cv_{name}_ddof{ddof}"] = float(cv)
                out[f"cv_{name}_se"] = _bootstrap(values, lambda v: v.std(1, ddof=1) / v.mean(1))
        error = self.total_force - self.force
        out["force_rmse"] = float(np.sqrt(np.mean(error**2)))
        out["force_mean_absolute"] = float(np.abs(error).mean())
        out["force_worst"] = float(np.abs(error).max())
        out["force_rmse_percent_full_scale"] = 100 * out["force_rmse"] / float(self.force.max())
        return out

    def _localisation(self, estimate: np.ndarray) -> dict[str, float]:
        error = np.asarray(je.localisation_error(estimate, self.position))
        inward = np.asarray(je.inward_bias(estimate, self.position, self.centre))
        return {
            "mean": float(error.mean()),
            "mean_se": _bootstrap(error, lambda v: v.mean(1)),
            "median": float(np.median(error)),
            "p95": float(np.percentile(error, 95)),
            "inward_bias": float(inward.mean()),
        }

    def attributes(self) -> dict[str, str]:
        """What `restore` needs beside the arrays."""
        return {"held_out_by": self.held_out_by, "notes": "\n".join(self.notes)}

    def arrays(self) -> dict[str, tuple[np.ndarray, str, str]]:
        """Name -> values, units, meaning."""
        out = {
            "position": (self.position, "m", "true position of the tip"),
            "force": (self.force, "N", "load cell"),
            "pressure": (self.pressure, "Pa", "change of each pad's pressure over the hold"),
            "pad_force": (self.pad_force, "N", f"estimated, held out by {self.held_out_by}"),
            "image_sum": (self.image_sum, "S m2", "integral of the image"),
            "centre": (self.centre, "m", "centre of the sheet"),
        }
        for name, estimate in self.estimated.items():
            out[f"estimated_{name}"] = (estimate, "m", f"position estimated by {name}")
        return out

    @classmethod
    def restore(cls, attrs: Mapping, arrays: Mapping[str, np.ndarray], attribute: str, array: str) -> "Evaluation":
        """The evaluation that `attributes` and `arrays` described, found under these prefixes."""
        mark = f"{array}estimated_"
        estimated = {k.removeprefix(mark): v for k, v in arrays.items() if k.startswith(mark)}
        names = ("position", "force", "pressure", "pad_force", "image_sum", "centre")
        return cls(
            **{name: arrays[array + name] for name in names},
            estimated=estimated,
            held_out_by=str(attrs[f"{attribute}held_out_by"]),
            notes=tuple(filter(None, str(attrs[f"{attribute}notes"]).split("\n"))),
        )


def evaluate_presses(
    recon: je.Reconstructor,
    skin: je.Skin,
    position: np.ndarray,
    dv: np.ndarray,
    force: np.ndarray,
    pressure: np.ndarray,
    pad_force: np.ndarray,
    *,
    held_out_by: str,
    notes: tuple[str, ...] = (),
) -> Evaluation:
    """Image every press and say where it is."""
    image = recon(jnp.asarray(dv, recon.factor.dtype))
    (x0, y0), (x1, y1) = skin.domain.bounds
    return Evaluation(
        position=position,
        estimated={n: np.asarray(e(image, recon), float) for n, e in je.ESTIMATORS.items()},
        force=force,
        pressure=np.asarray(pressure, float),
        pad_force=np.asarray(pad_force, float),
        image_sum=np.asarray(je.image_sum(image, recon.areas), float),
        centre=np.array([(x0 + x1) / 2, (y0 + y1) / 2]),
        held_out_by=held_out_by,
        notes=notes,
    )


def _bootstrap(values: np.ndarray, statistic) -> float:
    """Standard error over presses drawn again with replacement; the same draw every time."""
    draws = np.random.default_rng(0).integers(len(values), size=(_BOOTSTRAPS, len(values)))
    return float(statistic(values[draws]).std(ddof=1))


def render_table(evaluation: Evaluation, title: str) -> str:
    """The results as a table for a terminal."""
    s = evaluation.summary()
    lines = [
        f"{title}: {s['presses']:.0f} presses, forces held out by {evaluation.held_out_by}",
        "",
    ]
    lines.append("  localisation, mm        mean  (+- SE)  median     p95   inward bias")
    for name in evaluation.estimated:
        mean, error, median, p95, inward = (
            1e3 * s[f"localisation_{name}_{k}"] for k in ("mean", "mean_se", "median", "p95", "inward_bias")
        )
        lines.append(f"    {name:<16}{mean:12.1f}  ({error:5.2f}) {median:7.1f} {p95:7.1f} {inward:13.1f}")
    if "cv_eit_ddof1" in s:
        lines += ["", "  sensitivity              CV    (+- SE)"]
        for name, label in (("eit", "EIT only"), ("hybrid", "hybrid")):
            lines.append(f"    {label:<16}{s[f'cv_{name}_ddof1']:12.3f}  ({s[f'cv_{name}_se']:.3f})   ddof 1")
    lines += [
        "",
        f"  force: RMSE {s['force_rmse']:.2f} N ({s['force_rmse_percent_full_scale']:.1f} % of the "
        f"largest), mean absolute {s['force_mean_absolute']:.2f} N, worst {s['force_worst']:.2f} N",
    ]
    return "\n".join(lines + [f"  note: {note}" for note in evaluation.notes])
