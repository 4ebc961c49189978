"""The law of contacts: its updates against a regression in one piece, its honesty, and what it leaves alone."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_t

from jaxeit.imaging import InverseError
from jaxeit.tracking import ContactLaw
from jaxeit.tracking.contact_law import (
    EXTRAPOLATION,
    MAX_LOG_FACTOR,
    MIN_LOG_RATIO,
    MIN_SLOPE,
    PRIOR_SCATTER,
    PRIOR_SHAPE,
    PRIOR_STD,
    REFERENCE_LOGS,
)
from jaxeit.tracking.tracks import Track

from .conftest import load

TRUE = np.array([-1.0, 1.2, -2.5])  # a, b and c of a layer like that of the second simulator
OWN = np.zeros(3)  # of a layer that the model knows
LEFT = 0.3  # scatter of what the law leaves of the force by readings


def track(force, width, error=0.3, place=(0.05, 0.05)):
    return Track(1, np.array(place), 1e-6 * np.eye(2), width, force, error, np.zeros(2), np.zeros(2))


def contacts(rng, count, law, spread=0.5, left=LEFT):
    """Tracks by readings alone, and true forces, N."""
    true, width = np.exp(rng.normal(np.log(10), spread, count)), np.exp(rng.normal(np.log(0.012), 0.25, count))
    terms = np.stack([np.ones(count), np.log(true) - REFERENCE_LOGS[0], np.log(width) - REFERENCE_LOGS[1]], 1)
    force = true * np.exp(terms @ law + left * rng.normal(size=count))
    return [track(f, w) for f, w in zip(force, width, strict=True)], true, terms


def learned(seen, true):
    law = ContactLaw.unknown()
    for one, force in zip(seen, true, strict=True):
        law = law.told(one, force)
    return law


def test_contacts_one_by_one_are_the_regression_in_one_piece():
    """The mean is that of ridge regression, and the evidence the ratio of the densities of all contacts at once."""
    seen, true, terms = contacts(np.random.default_rng(101), 12, TRUE)
    law, error = learned(seen, true), np.log([one.force for one in seen] / true)
    before = np.diag((PRIOR_STD / PRIOR_SCATTER) ** 2)
    precision = np.linalg.inv(before) + terms.T @ terms
    np.testing.assert_allclose(law.mean, np.linalg.solve(precision, terms.T @ error), rtol=1e-8)
    np.testing.assert_allclose(law.covariance, np.linalg.inv(precision), rtol=1e-8)

    def log_density(covariance):
        return multivariate_t(np.zeros(12), PRIOR_SCATTER**2 * covariance, df=2 * PRIOR_SHAPE).logpdf(error)

    together = log_density(np.eye(12) + terms @ before @ terms.T) - log_density(np.eye(12))
    assert law.evidence == pytest.approx(together, rel=1e-9)


@pytest.mark.parametrize("seed", range(201, 204))
def test_the_law_at_least_halves_the_error_of_a_layer_of_another_law_and_states_what_is_left(seed):
    rng = np.random.default_rng(seed)
    law = learned(*contacts(rng, 40, TRUE)[:2])
    seen, true, _ = contacts(rng, 400, TRUE)
    told = [law.applied(one) for one in seen]
    before, after = (np.log([one.force for one in each] / true) for each in (seen, told))
    assert law.is_better
    assert np.median(np.abs(after)) < 0.4 * np.median(np.abs(before))
    covered = np.mean(np.abs(after) < 1.645 * np.array([one.log_force_error for one in told]))
    assert 0.82 < covered < 0.99


@pytest.mark.parametrize("seed", range(301, 311))
def test_a_layer_that_the_model_knows_is_left_alone(seed):
    rng = np.random.default_rng(seed)
    seen, true, _ = contacts(rng, 120, OWN, left=0.15)
    law = learned(seen, true)
    assert not law.is_better
    assert law.evidence < MIN_LOG_RATIO
    assert law.applied(seen[0]) is seen[0]
    assert "120 contacts do not speak for another law" in law.render()


def test_nothing_learned_changes_nothing_and_only_contacts_without_pads_are_changed():
    some = track(20.0, 0.02)
    assert ContactLaw.unknown().applied(some) is some
    law = learned(*contacts(np.random.default_rng(7), 40, TRUE)[:2])
    first, second = law.without_pads((some, some), np.array([True, False]))
    assert first is some
    assert second.force != some.force
    np.testing.assert_array_equal(second.position, some.position)


@pytest.mark.parametrize("seed", range(601, 604))
def test_presses_of_one_force_do_not_teach_that_every_force_is_that_one(seed):
    """Layer of twice the gain: what readings tell scatters, and the scatter tells nothing of the slope."""
    rng, twice = np.random.default_rng(seed), np.array([np.log(2), 0.0, 0.0])
    law = learned(*contacts(rng, 60, twice, spread=0.02)[:2])
    assert law.is_better
    for force in (10 / 1.6, 10, 16):
        found = law.applied(track(2 * force, 0.012))
        assert abs(np.log(found.force / force)) < 1.5 * found.log_force_error
    low, high = (law.applied(track(2 * force, 0.012)).force for force in (5.0, 20.0))
    assert high / low > 2


def test_the_factor_is_bounded():
    law = learned(*contacts(np.random.default_rng(8), 40, TRUE)[:2])
    far, further = law.applied(track(1e4, 0.012)), law.applied(track(1e6, 0.012))
    assert far.force > np.exp(law.high[0] + EXTRAPOLATION)
    assert further.force / far.force == pytest.approx(100)
    assert further.log_force_error == pytest.approx(far.log_force_error)
    wild = law._replace(mean=np.array([-9.0, 0.0, 0.0])).applied(track(8.0, 0.012))
    assert wild.force == pytest.approx(8 * np.exp(MAX_LOG_FACTOR))
    assert law._replace(mean=np.array([0.0, -5.0, 0.0])).slope == MIN_SLOPE


def test_ageing_leads_back_to_nothing_learned():
    law = learned(*contacts(np.random.default_rng(9), 40, TRUE)[:2])
    gone = law.aged(1.0)
    assert not gone.is_better
    for name in ("mean", "covariance", "shape", "rate", "plain", "evidence"):
        np.testing.assert_allclose(getattr(gone, name), getattr(ContactLaw.unknown(), name))
    half = law.aged(0.5)
    np.testing.assert_allclose(half.mean, 0.5 * law.mean)
    assert np.linalg.eigvalsh(half.covariance - law.covariance).min() > 0


@pytest.mark.parametrize("forces", [(0.0, 5.0), (5.0, 0.0), (5.0, np.nan), (np.inf, 5.0)])
def test_forces_that_tell_no_law_are_refused(forces):
    with pytest.raises(InverseError, match="do not tell a law; give numbers above zero"):
        ContactLaw.unknown().told(track(forces[0], 0.012), forces[1])


def test_a_share_that_is_none_is_refused():
    with pytest.raises(InverseError, match="give 0 to 1"):
        ContactLaw.unknown().aged(-0.1)


@pytest.mark.slow
def test_pads_tell_the_contacts_that_lie_on_them(tracker):
    """Pads of the testbed are its quarters: one of them is dead."""
    on = tuple(track(5.0, 0.01, place=place) for place in ((0.05, 0.05), (0.15, 0.05), (0.1, 0.05), (0.05, 0.15)))
    errors = np.array([np.nan, 0.1, 0.1, 0.1])
    known = tracker.told_by_pads(on, errors)
    assert known.tolist() == [False, True, True, True]
    assert not tracker.told_by_pads(on, None).any()
    assert tracker.told_by_pads((), errors).shape == (0,)


@pytest.mark.slow
@pytest.mark.parametrize("beyond", [-0.015, -0.008, 0.002, 0.01])
def test_pads_tell_an_edge_as_the_filter_says(tracker, beyond):
    """The middle of an edge lies on a dead pad, its end on another: the filter and the tracks must agree."""
    edge = track(5.0, 0.006, place=(0.1 + beyond, 0.05))._replace(half=np.array([0.025, 0.0]))
    errors = np.array([np.nan, 0.1, 0.1, 0.1])
    row = [*edge.position, np.log(edge.width), np.log(edge.force), *edge.half]
    sheet, contact = tracker.filter.sheet, jnp.asarray([row], tracker.filter.places.dtype)
    loads = np.asarray(sheet.pad_loads(contact, sheet.neighbourhood(contact)))[0]
    told = loads[np.isfinite(errors)].sum() >= 0.25 * edge.force
    assert tracker.told_by_pads((edge,), errors).tolist() == [told]


@pytest.mark.slow
def test_frames_of_the_librarys_own_law_are_left_alone(tracker, frame_of):
    """Presses from the full forward map, each told by its readings alone."""
    rng, law = np.random.default_rng(501), ContactLaw.unknown()
    for _ in range(16):
        place, force, width = rng.uniform(0.03, 0.17, 2), rng.uniform(4, 25), rng.uniform(0.009, 0.016)
        frame = frame_of([load(*place, force, width)])
        found = tracker.step(tracker.start(), frame, tracker.settings.persistence).tracks
        law = law.told(found[0], force) if len(found) == 1 else law
    assert law.contacts > 8
    assert not law.is_better
