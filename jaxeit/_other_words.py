"""Words of other packages, and the words of jaxeit for them: the tables of docs/from-eidors.md and docs/from-pyeit.md.

A reader of those packages types them first; the error then names the word of jaxeit and the page.
"""

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


def translation(name: str) -> str:
    """What to write for a word of another package, as the end of a message; empty for another name."""
    for (package, page), words in WORDS.items():
        if name in words:
            return f"; for {name} of {package} write {words[name]} ({page})"
    return ""
