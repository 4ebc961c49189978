"""Series handed to an effect block by block."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from jaxeit import effects as fx

# With the fusion emitters that other tests do without, by which blocks of another length are rounded alike. jaxlib 0.11
# knows no other way.
_as_the_bench_does = partial(
    eqx.filter_jit,
    compiler_options={name: True for name in je.compiler_options() if name == "xla_cpu_use_fusion_emitters"},
)


def after(effect, series, *, interval=0.005, cuts=(), temperature=None, barometer=None, pattern=()):
    """The series after one effect, in blocks that begin at 0 and at each of ``cuts``; block n has `block_key(n)`."""
    series = np.asarray(series)
    air = [np.zeros(len(series)) if a is None else np.asarray(a, float) for a in (temperature, barometer)]
    pattern = np.asarray(pattern, np.int32).reshape(-1, 4)
    state, out = _start(effect, series[0]), []
    for number, (block, heat, weight) in enumerate(zip(*(np.split(a, cuts) for a in (series, *air)), strict=True)):
        line = fx.HistoryInputs(*jax.tree.map(jnp.asarray, (block_key(number), interval, heat, weight, pattern)))
        block, state = _call(effect, block, state, line)
        out.append(block)
    return np.concatenate(out)


@_as_the_bench_does
def _start(effect, first):
    return effect.start(first)


@_as_the_bench_does
def _call(effect, series, state, line):
    return effect(series, state, line)


def block_key(number):
    """What the effect of block ``number`` is given to draw from."""
    return jax.random.fold_in(jax.random.key(7), number)


def presses(samples, channels, interval=0.005, seed=0):
    """Ramps and holds of half a second, different in each channel, up to 2 kPa."""
    rng = np.random.default_rng(seed)
    knots = np.arange(0, samples * interval + 1, 0.5)
    heights = np.vstack([np.zeros(channels), rng.uniform(0, 2000, (len(knots) - 1, channels))])
    heights[2::3] = heights[1::3][: len(heights[2::3])]
    times = np.arange(samples) * interval
    return np.stack([np.interp(times, knots, h) for h in heights.T], 1)
