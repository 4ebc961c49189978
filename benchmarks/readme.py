"""Write the results table and the picture of the README from the bundled session.

python benchmarks/readme.py
"""

import re
from pathlib import Path

import calib
import jaxeit as je
from calib.figures import png, sensitivity_figure
from calib.runtime import set_up
from calib.session import replacing

ROOT = Path(__file__).parents[1]
PAPER = {"localisation": "6.9 mm (estimator not stated)", "eit": "0.31", "hybrid": "0.14"}


def main() -> None:
    set_up()
    with calib.open_session(ROOT / "data" / "sessions" / "testbed_grid.h5") as session:
        calibration = calib.calibrate([session])
    readme = ROOT / "README.md"
    text = re.sub(
        r"(<!-- results.*?-->\n).*?(<!-- end of results -->)",
        lambda m: m[1] + _table(calibration.evaluation.summary()) + m[2],
        readme.read_text(encoding="utf-8"),
        flags=re.DOTALL,
    )
    with replacing(readme) as new:
        new.write_text(text, encoding="utf-8")
    (ROOT / "docs").mkdir(exist_ok=True)
    figure = sensitivity_figure(calibration.evaluation, calibration.skin, simulated=True)
    (ROOT / "docs" / "sensitivity.png").write_bytes(png(figure))


def _table(s: dict[str, float]) -> str:
    rows = [
        f"| localisation error, {name} estimator, mean | {1e3 * s[f'localisation_{name}_mean']:.1f} ± "
        f"{1e3 * s[f'localisation_{name}_mean_se']:.1f} mm | {PAPER['localisation'] if name == 'quarter' else ''} |"
        for name in je.ESTIMATORS
    ]
    rows += [
        f"| coefficient of variation of sensitivity, {label} | {s[f'cv_{name}_ddof1']:.3f} ± {s[f'cv_{name}_se']:.3f} "
        f"| {PAPER[name]} |"
        for name, label in (("eit", "EIT only"), ("hybrid", "hybrid"))
    ]
    rows.append(
        f"| force error on presses held out by place, RMSE | {s['force_rmse']:.2f} N, "
        f"{s['force_rmse_percent_full_scale']:.1f} % of 20 N | |"
    )
    head = "| simulated, 225 presses | this run, ± SE over places | the paper, on hardware |\n|---|---|---|\n"
    return head + "\n".join(rows) + "\n"


if __name__ == "__main__":
    main()
