"""Names that a package does not have: the room that has them, the word of jaxeit for them, or the nearest name.

The words of other packages are the tables of docs/from-eidors.md and docs/from-pyeit.md.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from .spelling import did_you_mean

PREPARE = "je.prepare(model, prior, method, basis, ...)"
MAKE = "je.discretise(je.Scene(skin), fidelity)"

WORDS = {
    ("EIDORS", "docs/from-eidors.md"): {
        "mk_common_model": MAKE,
        "ng_mk_cyl_models": MAKE,
        "mk_stim_patterns": "je.skin.eidors_adjacent(16)",
        "mk_image": "model.background",
        "fwd_solve": "je.forward(model, sigma)",
        "calc_jacobian": "je.jacobian(model, sigma, basis=...)",
        "inv_solve": PREPARE,
        "prior_noser": "je.Noser()",
        "prior_tikhonov": "je.Tikhonov()",
        "prior_laplace": "je.Laplace()",
        "prior_gaussian_HPF": "je.GaussianSmooth()",
        "prior_TV": "je.TotalVariation()",
        "inv_solve_diff_GN_one_step": "je.OneStep()",
        "inv_solve_TSVD": "je.TruncatedSvd()",
        "inv_solve_backproj": "je.imaging.BackProjection()",
        "mk_GREIT_model": "je.Greit()",
        "inv_solve_gn": "je.gauss_newton",
        "inv_solve_abs_GN": "je.gauss_newton",
        "eval_GREIT_fig_merit": "je.metrics.greit_figures",
        "show_fem": "je.plot.show_image(recon, image)",
        "show_slices": "je.plot.show_image(recon, image)",
    },
    ("pyEIT", "docs/from-pyeit.md"): {
        "mesh": MAKE,
        "protocol": "je.Protocol(rows, current)",
        "EITForward": "je.forward(model, sigma)",
        "compute_jac": "je.jacobian(model, sigma)",
        "JAC": "je.prepare(model, je.Noser(exponent=p), basis=je.Elements(), hyperparameter=...)",
        "BP": "je.imaging.BackProjection()",
        "GREIT": "je.Greit()",
        "sim2pts": "je.plot.show_image(recon, image)",
        "tripcolor": "je.plot.show_image(recon, image)",
    },
}
"""Package and page -> word of the package -> what the page says for it."""


def message(file: str, name: str, known: Sequence[str]) -> str:
    """The message of the error for a name that a package lacks: its ``__init__`` is `file`, and its names `known`."""
    package = Path(file).parent
    translation = _translation(name) if package.name == "jaxeit" else ""
    hint = _room_of(package, name) or translation or did_you_mean(name, known)
    return f"{package.name} has no {name}" + (f"; {hint}" if hint else "")


def _room_of(package: Path, name: str) -> str:
    """Where the name is, by the lists of the rooms, which may be single modules: none of them is imported."""
    own, stub = re.escape(name), (package / "__init__.pyi").read_text(encoding="utf-8")
    for room in re.findall(r"^    (\w+) as \1,$", stub.partition(")")[0], re.MULTILINE):
        for listing in [*package.glob(f"{room}/__init__.py*"), *package.glob(f"{room}.py")]:  # .pyi: of a lazy room
            if re.search(rf'^    "{own}",$|\b{own} as {own}\b', listing.read_text(encoding="utf-8"), re.MULTILINE):
                return f"it is {package.name}.{room}.{name}"
    return ""


def _translation(name: str) -> str:
    """What to write for a word of another package; empty for another name."""
    for (package, page), words in WORDS.items():
        if name in words:
            return f"for {name} of {package} write {words[name]} ({page})"
    return ""
