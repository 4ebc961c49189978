"""No frame waits for a compilation once `compile_tracker` has run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.tracking import compile_tracker
from jaxeit.tracking.belief.programs import Programs


@pytest.fixture(params=[False, True], ids=["traced", "kept"])
def bound(request, tracker, monkeypatch, tmp_path):
    """The tracker, its programs kept in a folder or not."""
    if request.param:
        je.cache_programs(tmp_path)
        monkeypatch.setattr(tracker, "programs", Programs(tracker.filter))
    yield tracker
    je.cache_programs(None)


@pytest.mark.slow
def test_no_frame_waits_for_a_compilation(model, bound, blank, request):
    """Births, an unexpected frame, missing readings, and deaths; looks piece by piece too."""
    tracker = bound
    v0, noise = blank
    rng, points, law = np.random.default_rng(5), np.asarray(model.centroids), tracker.settings.loads.law

    def frame(*contacts):
        pressure = np.full(len(points), 1e-9)
        for x, y, force in contacts:
            away = ((points - [x, y]) ** 2).sum(1)
            pressure += force * np.exp(-away / 2 / 0.012**2) / (2 * np.pi * 0.012**2)
        v = je.forward(model, model.background * law.factor(jnp.asarray(pressure)))
        return np.asarray(v) - v0 + noise * rng.normal(size=v0.size)

    one, other = (0.06, 0.07, 10.0), (0.14, 0.13, 8.0)
    frames = [frame(), frame(one), frame(one), frame(one, other), frame(one, other), frame(other), frame(), frame()]
    frames[4][::7] = np.nan
    jax.clear_caches()  # of the other tests
    compile_tracker(tracker)
    seen = request.getfixturevalue("compilations")
    now, counts = tracker.start(), []
    for n, dv in enumerate(frames):
        pads = (np.array([10.0, 0, 0, np.nan]), np.ones(4)) if n % 2 else ()
        now = tracker.step(now, dv, 0.01 * (n + 1), *pads)
        counts.append(len(now.tracks))
    for dv in frames:
        now = tracker.step(now, dv, 0.01, np.ones(4), np.ones(4), whole=False)
        for _ in range(8):
            now = tracker.look(now)
    assert not seen
    assert max(counts) == 2
    assert counts[0] == 0
