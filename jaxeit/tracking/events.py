"""What may happen to contacts between two frames, as beliefs before the next one."""

import jax.numpy as jnp
import numpy as np

from .filter import EDGE, SHAPE, SIZE, VELOCITY, Belief

# Half length of an edge that is tried, m.
HALF = 0.012
# How far contacts may jump: x, y, log width, log force, half length, shape, velocity.
JUMP = np.array([0.01, 0.01, 0.3, 1.5, 0.0, 0.0, *6 * [0.1], 0.1, 0.1])
# How far a contact may change when it turns out to be an edge, and how much narrower its load then is.
LENGTHEN, NARROWER = np.array([0.01, 0.01, 0.4, 0.5, HALF, HALF, *6 * [0.1], 0.0, 0.0]), 0.3
# Half length of an edge over the distance of the two contacts that were taken for it.
BETWEEN = 0.8


def without(belief: Belief, k: int) -> Belief:
    """Without contact k."""
    kept = np.delete(np.arange(len(belief.covariance)), np.s_[SIZE * k : SIZE * (k + 1)])
    contacts = np.delete(np.asarray(belief.contacts), k, 0)
    return Belief(jnp.asarray(contacts), belief.gain, jnp.asarray(np.asarray(belief.covariance)[np.ix_(kept, kept)]))


def inserted(belief: Belief, row: np.ndarray, spread: np.ndarray) -> Belief:
    """With a contact after the others that is independent of all else."""
    place = belief.contacts.size
    old = np.asarray(belief.covariance)
    kept = np.concatenate([np.arange(place), np.arange(place + SIZE, len(old) + SIZE)])
    covariance = np.zeros((len(old) + SIZE,) * 2, old.dtype)
    covariance[np.ix_(kept, kept)] = old
    covariance[place : place + SIZE, place : place + SIZE] = np.diag(spread**2)
    contacts = np.concatenate([np.asarray(belief.contacts), row[None]]).astype(old.dtype)
    return Belief(jnp.asarray(contacts), belief.gain, jnp.asarray(covariance))


def jumped(belief: Belief) -> Belief:
    """With contacts that may be elsewhere, or press otherwise, than they could a frame ago."""
    spread = np.zeros(len(belief.covariance))
    spread[: belief.contacts.size] = np.tile(JUMP, len(belief.contacts))
    return belief._replace(covariance=belief.covariance + jnp.diag(jnp.asarray(spread**2, belief.covariance.dtype)))


def lengthened(belief: Belief, k: int, angle: float) -> Belief:
    """With contact k as an edge in about this direction."""
    contacts, covariance = np.array(belief.contacts), np.array(belief.covariance)
    own = np.arange(SIZE * k, SIZE * (k + 1))
    contacts[k, EDGE] = HALF * np.cos(angle), HALF * np.sin(angle)
    contacts[k, 2] -= NARROWER
    contacts[k, SHAPE] = 0.0
    covariance[own, own] += LENGTHEN**2
    return Belief(jnp.asarray(contacts), belief.gain, jnp.asarray(covariance))


def joined(belief: Belief, first: int, second: int) -> Belief:
    """With one edge in the place of two contacts, from the one to the other; it takes the place of the first."""
    contacts, covariance = np.array(belief.contacts), np.array(belief.covariance)
    pair = contacts[[first, second]]
    force = np.exp(pair[:, 3])
    contacts[first, :3] = force @ pair[:, :3] / force.sum()
    contacts[first, 3], contacts[first, EDGE] = np.log(force.sum()), BETWEEN * (pair[1, :2] - pair[0, :2])
    contacts[first, SHAPE], contacts[first, VELOCITY] = 0.0, pair[:, VELOCITY].mean(0)
    own = np.arange(SIZE * first, SIZE * (first + 1))
    covariance[own, own] += LENGTHEN**2
    return without(Belief(jnp.asarray(contacts), belief.gain, jnp.asarray(covariance)), second)
