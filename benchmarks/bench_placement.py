"""Electrodes moved to where a scan places contacts best, verified by fits of contacts.

For the worst places (`PlaceError(8.0)`), for the adjacent scan and for one designed afterwards. "Expected": the error
of place that `place_sensitivity` states at sites that the search has not seen, on a finer mesh than that of the search.
"Fitted": presses of 8 N by a 20 mm tip all over the sheet, 8 mm or more from the rim, simulated on a third mesh, with
noise 60 and 50 dB below the readings of the shipped skin, the same for all, and without noise: what is left then is
the error of the fit's model, to which the weights of 60 dB are kept; "as loads": by `prepare_loads` in place of bumps,
one draw; "region": mean error in the worst of 36 equal parts of the sheet, over some twenty presses with three draws of
the noise each, so that chance does not choose the part. The search knows none of the presses.
"""

from collections.abc import Iterator
from operator import itemgetter
from time import perf_counter

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib.runtime import set_up

from .harness import Question, Run
from .problems import pressed
from .rows import Row

CASES = (("testbed", None), ("testbed", 0.01), ("chest", None))  # skin, and how near to the rim electrodes may sit, m
WORST = je.scan.PlaceError(8.0)
COLUMNS = 13  # of the sites at which errors are stated; the search has 8
REGIONS, PRESSES, DRAWS, CLEAR, LOAD, SEED = 6, 720, 3, 0.008, 8.0, 2060
LOUD = 10**0.5  # a second noise over the first
AS_IT_IS, MOVED, DESIGNED = "as it is", "electrodes moved", "electrodes moved, scan designed"


def measure(run: Run) -> Iterator[Row]:
    """Rows of a skin as it is, with its electrodes moved, and with a scan designed for these."""
    shown: dict[tuple[str, str], Row] = {}  # of skins as they are, which does not depend on the margin
    for name, margin in run.sizes(CASES, CASES[1:2]):
        shipped = je.load_skin(name)
        model = je.discretise(je.Scene(shipped), je.Fidelity.draft())
        noise = 1e-3 * float(jnp.sqrt(jnp.mean(je.forward(model) ** 2)))
        settings = je.scan.DesignSettings(noise=noise, columns=4 if run.smoke else 8)
        limits, meshes = je.scan.PlacementLimits(margin=margin), 2 if run.smoke else 12
        began = perf_counter()
        moved = je.scan.move_electrodes(shipped, WORST, limits, settings, meshes=meshes).skin
        seconds = perf_counter() - began
        there = je.scan.place_sensitivity(je.discretise(je.Scene(moved), je.Fidelity.draft()), settings)
        designed = je.scan.design_scan(there, shipped.protocol.readings, WORST).pattern
        skins = {AS_IT_IS: shipped, MOVED: moved, DESIGNED: je.skin.with_rows(moved, designed)}
        low, high = (np.asarray(corner) for corner in shipped.domain.bounds)
        about = {
            "skin": name,
            "margin_mm": 1e3 * float(shipped.domain.boundary_distance(moved.electrode_positions).min()),
        }
        for way, skin in skins.items():
            row = about | {"way": way, "search_s": seconds if way == MOVED else None}
            found = shown.get((name, way)) or errors(run, skin, noise, (low, high))
            shown |= {(name, AS_IT_IS): found} if way == AS_IT_IS else {}
            yield {"rows": [found | row]}


def errors(run: Run, skin: je.Skin, noise: float, bounds: tuple[np.ndarray, np.ndarray]) -> Row:
    """Expected and fitted errors of a skin, mm."""
    model = je.discretise(je.Scene(skin), je.Fidelity.draft() if run.smoke else je.Fidelity.standard())
    settings = je.scan.DesignSettings(noise=noise, columns=5 if run.smoke else COLUMNS)
    expected = 1e3 * np.asarray(je.scan.place_sensitivity(model, settings).errors(skin.protocol.pattern))
    out: Row = {"expected_mm": float(expected.mean()), "expected_worst_mm": float(expected.max())}
    low, high = bounds
    rng = np.random.default_rng(SEED)
    sites = rng.uniform(low, high, (4 * PRESSES, 2))
    clear = skin.domain.contains(sites) & (skin.domain.boundary_distance(sites) > CLEAR)
    sites = sites[clear][: 6 if run.smoke else PRESSES]
    region = np.clip(((sites - low) / (high - low) * REGIONS).astype(int), 0, REGIONS - 1) @ [REGIONS, 1]
    for name, fitted in fits(run, skin, model, noise, sites).items():
        means = [np.nanmean(fitted[:, region == one]) for one in np.unique(region)]
        found = {"mm": np.nanmean(fitted), "median_mm": np.nanmedian(fitted), "region_mm": np.max(means)}
        out |= {f"{name}_{figure}": float(value) for figure, value in found.items()}
        out[f"{name}_lost"] = float(np.mean(np.isnan(fitted)))
    return out


def fits(run: Run, skin: je.Skin, model: je.Model, noise: float, sites: np.ndarray) -> dict[str, np.ndarray]:
    """Errors of the contacts fitted at sites, (draws, presses) mm, for both noises and for none; NaN: none found."""
    loads = np.full((len(sites), 1), LOAD)
    change = pressed((), sites[:, None], loads, 0.06 if run.smoke else 0.026, skin=skin).change
    settings = je.contacts.ContactSettings(most=2, columns=21 if run.smoke else 41)
    rng, errors = np.random.default_rng(SEED + 1), {}
    for name, std, part in (("fit", noise, 1.0), ("loud", LOUD * noise, 1.0), ("exact", noise, 0.0)):
        fit = je.prepare_contacts(model, settings, noise=np.full(change.shape[1], std))
        drawn = [change + part * std * rng.normal(size=change.shape) for _ in range(DRAWS if part else 1)]
        bumps = [fit(jnp.asarray(frames)) for frames in drawn]
        errors[name] = np.stack([_errors(je.contacts.strongest(found), sites) for found in bumps])
        if name == "fit":
            errors["loads"] = _errors(_as_loads(model, std, drawn[0], bumps[0]), sites)[None]
    return errors


def _as_loads(model: je.Model, std: float, frames: np.ndarray, bumps: je.contacts.Contacts) -> jax.Array:
    """Places (frames, 2), m, of the one load that fits a frame best, from the bumps found in it."""
    fit = je.contacts.prepare_loads(model, noise=np.full(frames.shape[1], std), sigma=model.background)
    found = (fit(frame, jax.tree.map(itemgetter(k), bumps)) for k, frame in enumerate(frames))
    return jnp.stack([loads.one.position[0] for loads in found])


def _errors(places: jax.Array, sites: np.ndarray) -> np.ndarray:
    return 1e3 * np.asarray(je.localisation_error(places, jnp.asarray(sites)))


main = Question("placement", __doc__, {"rows": measure}, prepare=set_up)

if __name__ == "__main__":
    main()
