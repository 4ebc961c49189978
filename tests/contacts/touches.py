"""What touches the testbed in tests of loads: one tip, two, an edge, and others; and the frames that show it."""

import numpy as np

import jaxeit as je
from benchmarks.problems import pressed
from jaxeit.contacts import LoadKind

TIPS = 9  # that an edge is simulated by
GAIN = je.effects.ContactGain(0.12, 0.015, seed=71)
COAT = je.effects.CoatingNonUniformity(0.15, 0.03, seed=70)


def frames_of(touches, effects=(COAT, GAIN), seed=0, **how):
    """Frames (n, readings), noise and untouched frame of touches: lists of places and forces, on another mesh."""
    places = np.array([np.concatenate([p, np.repeat(p[-1:], TIPS - len(p), 0)]) for p, _ in touches])
    loads = np.array([np.concatenate([f, np.zeros(TIPS - len(f))]) for _, f in touches])
    found = pressed(effects, places, loads, **how)
    blank, frames = found.frames(np.random.default_rng(seed))
    return frames, np.full(blank.size, found.noise), blank


def single(x, y, force=20.0):
    return np.array([[x, y]]), np.array([force])


def pair(x, y, distance, angle, share=1.0, force=20.0):
    step = distance / 2 * np.array([np.cos(angle), np.sin(angle)])
    return np.array([x, y]) + np.array([-step, step]), force * np.array([1.0, share])


def edge(x, y, length, angle, force=20.0):
    step = length / 2 * np.array([np.cos(angle), np.sin(angle)])
    return [x, y] + np.linspace(-1, 1, TIPS)[:, None] * step, np.full(TIPS, force / TIPS)


def three(x, y, reach, force=20.0):
    angle = 0.4 + 2 * np.pi * np.arange(3) / 3
    return np.array([x, y]) + reach * np.stack([np.cos(angle), np.sin(angle)], 1), np.full(3, force)


def ring(x, y, reach, force=20.0):
    angle = 2 * np.pi * np.arange(TIPS) / TIPS
    return np.array([x, y]) + reach * np.stack([np.cos(angle), np.sin(angle)], 1), np.full(TIPS, force / TIPS)


def tilted(x, y, angle, tilt, force=20.0):
    """A square tip of 36 mm that presses more on one side."""
    away = 0.012 * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), -1).reshape(-1, 2)
    loads = 1 + tilt * away @ np.array([np.cos(angle), np.sin(angle)]) / 0.018
    return np.array([x, y]) + away, force * loads / loads.sum()


TOUCHES = {
    "one": (LoadKind.ONE, single(0.09, 0.12)),
    "one in a corner": (LoadKind.ONE, single(0.025, 0.03)),
    "two at 30 mm": (LoadKind.TWO, pair(0.1, 0.08, 0.03, 0.7)),
    "two at 40 mm, one of a third": (LoadKind.TWO, pair(0.08, 0.1, 0.04, 2.0, 1 / 3)),
    "an edge of 30 mm": (LoadKind.EDGE, edge(0.1, 0.1, 0.03, 1.2)),
    "an edge of 60 mm": (LoadKind.EDGE, edge(0.11, 0.09, 0.06, 0.3)),
    "three in a triangle": (LoadKind.MORE, three(0.1, 0.1, 0.03)),
}
