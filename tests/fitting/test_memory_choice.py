"""Curves with memory beside others: chosen where pads have hysteresis, left where they have none.

The pads are those of the second simulator (`tests.oracles.bench`): their loops follow Bouc and Wen's equation, not the
play operators that are fitted.
"""

import jax
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.calibration.localisation.press_images import Imager
from calib.fitting.cross_validation.held_out import Folds, folds_by_place
from calib.fitting.cross_validation.scores import rmse
from calib.fitting.cross_validation.selection import Candidate, _listed, choose, nested_selection
from calib.fitting.curves import CURVES, AffinePlay, Linear, PowerLaw
from calib.fitting.curves.samples import by_rows
from calib.fitting.fields import PadEdge, geometry_of, single_places
from calib.fitting.losses import SoftL1
from calib.fitting.pads import LocatedPresses, fit_pads, forces
from calib.fitting.press_forces import predict_holds
from calib.presses.pooled import MEANS_PER_PRESS, PressData, PressSeries, block_means, press_series, with_holds
from calib.presses.table import measure

from ..oracles.bench import Bench, Faults, simulate, write
from ..oracles.bench.pads import AREA, yielding
from .test_location import REACH, grid, owner

RAMP, HOLD = 9, 3  # samples of each press
CURVES_COMPARED = (Linear(), PowerLaw(), AffinePlay())
SEEDS = (11, 12, 13)


def pressed_pads(opening, seed, side=8):
    """Two presses at each place in a random order, of 5 to 20 N, with loops of ``opening`` of 20 N."""
    rng = np.random.default_rng([seed, 25])
    place = grid(side)[rng.permutation(np.repeat(np.arange(side**2), 2))]
    top, own = rng.uniform(5, 20, len(place)), np.eye(4)[owner(place)]
    shape = np.r_[np.linspace(0, 1, RAMP), np.ones(HOLD), np.linspace(1, 0, RAMP)[1:]]
    press, force = np.repeat(np.arange(len(place)), len(shape)), np.outer(top, shape).ravel()
    pressure = yielding(force[:, None] * own[press], opening) / AREA
    first = np.searchsorted(press, np.arange(len(place)))
    pressure -= np.r_[pressure[:1], pressure[first[1:] - 1]][press]  # the baseline is the rest before a press
    pressure *= np.exp(rng.normal(0, 0.01, len(place)))[press, None]
    pressure += rng.normal(0, 5.0, pressure.shape)
    held = np.tile(np.r_[np.zeros(RAMP), np.ones(HOLD), np.zeros(RAMP - 1)] > 0, len(place))
    return place, PressData(
        sample_pressure=pressure.T,
        sample_force=force,
        sample_press=press,
        mask=own[press].T > 0,
        pressure=pressure[held].reshape(len(place), HOLD, 4).mean(1),
        force=top,
        place=np.unique(place, axis=0, return_inverse=True)[1].ravel(),
        reach=np.asarray(REACH),
    )


def folds_of(skin, place, data):
    presses = LocatedPresses(data, geometry_of(skin), single_places(place, 4))
    return Folds(presses, SoftL1(), folds_by_place(data.place, 5))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("opening", "remembers"), [(0.1, True), (0.0, False)])
def test_memory_is_chosen_where_pads_have_it(skin, opening, remembers, seed):
    folds = folds_of(skin, *pressed_pads(opening, seed))
    found = choose(CURVES_COMPARED, [None], folds)
    assert found.curve.path == remembers, found.why
    assert len(found.tried) == len(CURVES_COMPARED)
    nested = nested_selection(CURVES_COMPARED, [None], folds)
    assert [model.curves.curve.path for model in nested.values()] == [remembers] * 5


def test_curve_field_and_memory_are_chosen_together(skin):
    found = choose([Linear(), AffinePlay()], [None, PadEdge()], folds_of(skin, *pressed_pads(0.1, SEEDS[0])))
    assert [candidate.name for candidate in sorted(found.tried, key=lambda c: c.name)] == [
        "hysteresis, edge", "hysteresis, none", "linear, edge", "linear, none",
    ]  # fmt: skip
    assert (CURVES.name_of(found.curve), found.field) == ("hysteresis", None), found.why


def test_a_hold_follows_the_way_up_to_it(skin):
    """Taken one after the other without the presses around them, holds would stand on branches that nobody went."""
    _, data = pressed_pads(0.1, SEEDS[0])
    presses = LocatedPresses(data, geometry_of(skin))
    model = fit_pads(AffinePlay(), None, presses, SoftL1())
    after = predict_holds(model, presses).force.sum(1) - data.force
    alone = model.hold_forces(data.pressure)[0].sum(1) - data.force
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(alone**2))
    along = PressSeries(data.sample_press, data.sample_pressure.T, data.sample_force)
    np.testing.assert_allclose(model.hold_forces(data.pressure, None, along)[0].sum(1) - data.force, after, atol=1e-9)


def test_a_hold_stands_after_the_largest_pressure_of_its_press():
    press, pressure = np.array([0, 0, 0, 2, 2]), np.array([[1.0], [9.0], [2.0], [7.0], [np.nan]])
    found = with_holds(PressSeries(press, pressure, pressure[:, 0]), np.array([[8.0], [5.0], [6.0]]))
    np.testing.assert_array_equal(found.pressure[:, 0], [1, 9, 8, 2, 5, 7, 6, np.nan])
    np.testing.assert_array_equal(found.press, [0, 0, 0, 0, 1, 2, 2, 2])
    np.testing.assert_array_equal(found.hold, [2, 4, 6])


def test_refused_candidates_are_named_among_many():
    table = [Candidate("curve", f"c{k}", 1.0, 1.0 + k, 1.0, 1.0, False) for k in range(13)]
    table.insert(3, Candidate("curve", "refused", 1.0, None, None, None, False))
    words = _listed(table)
    assert "c2 3.00, refused not determined, c3 4.00" in words
    assert words.endswith("c11 12.00 and 1 more")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Sessions of the second simulator: two of one skin with hysteresis, and one of a skin without."""
    folder = tmp_path_factory.mktemp("memory")
    made = {}
    for name, opening, skin_seed, seed in (("first", 0.15, 5, 5), ("later", 0.15, 5, 6), ("elastic", 0.0, 7, 7)):
        bench = Bench(Faults(hysteresis=opening), skin_seed, seed, places=81, levels=(7.0, 20.0), spacing=5e-3)
        write(folder / f"{name}.h5", simulate(bench))
        made[name] = folder / f"{name}.h5"
    return made


SOME = ("linear", "power", "polynomial", "hysteresis")  # of those that auto stands for: quicker to compile


def calibrated(path, names):
    recipe = calib.Recipe(
        curve=[CURVES.make(name) for name in names],
        location=calib.PadEdgeSpline(),
        imaging=je.Imaging(je.Pixels(24)),
        fidelity=je.Fidelity.draft(),
    )
    with calib.open_session(path) as session:
        return calib.calibrate([session], recipe=recipe, ignore_errors=True)


@pytest.fixture(scope="module")
def calibrations(simulated):
    """Of the skin with hysteresis: with memory among the candidates, and without."""
    return calibrated(simulated["first"], SOME), calibrated(simulated["first"], SOME[:-1])


def errors_along(calibration, found, places):
    """RMSE (N) of the total force at all samples of measured presses, loading and unloading."""
    along = block_means(press_series([found]), MEANS_PER_PRESS)
    rows = along.pressure, jax.tree.map(lambda part: part[along.press], places)
    return rmse(by_rows(forces, *rows, before=(calibration.pads,)).force.sum(1), along.force)


@pytest.mark.slow
def test_a_session_with_eit_chooses_memory_where_it_is(simulated, calibrations):
    """On a later session of the skin, forces along presses are better than by the best curve without memory."""
    assert [one.curves.curve.path for one in calibrations] == [True, False]
    along = []
    for one in calibrations:
        with calib.open_session(simulated["later"]) as later:
            found = measure(later, one.skin, one.processing)
        along.append(errors_along(one, found, Imager(one.recon, one.masks, one.locator).presses(found.dv).places))
    assert along[0] < 0.85 * along[1]


@pytest.mark.slow
def test_holds_of_a_later_session_follow_their_presses(simulated, calibrations):
    """They follow a rise of the load, which a curve without memory follows as well. Taken one for the successor of the
    other, they were off by 1.6 N, and the pads seemed to have moved by 14 %."""
    with calib.open_session(simulated["later"]) as later:
        found = [calib.evaluate(one, later, ignore_errors=True) for one in calibrations]
    with_memory, without = (one.summary()["force_rmse"] for one in found)
    assert with_memory < 1.1 * without
    assert not [note for note in found[0].notes if "calibration health" in note]


@pytest.mark.slow
def test_a_session_with_eit_chooses_no_memory_where_there_is_none(simulated):
    assert not calibrated(simulated["elastic"], SOME).curves.curve.path
