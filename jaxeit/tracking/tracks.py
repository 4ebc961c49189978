"""What is known of contacts after a frame."""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from .belief.consider import ConsiderErrors
from .belief.layer import LearnedLayer
from .belief.state import Attempt, Belief, Pads, contact_slice
from .events import Hypothesis

# Number of frames after which a frame that no event explains is looked into again: twice as many each time that nothing
# is found, as where the model of a held contact errs by more than was stated; and the largest such number.
PATIENCE, MAX_PATIENCE = 10, 80


class Track(NamedTuple):
    """A contact as it is now.

    | meaning                                                             | shape  | unit  |
    |---------------------------------------------------------------------|--------|-------|
    | number: of the contact, which it keeps while it lives               |        |       |
    | position in the sheet's flat coordinates; of an edge, its middle    | (2,)   | m     |
    | covariance of the position                                          | (2, 2) | m^2   |
    | width: standard deviation of the load, across an edge               |        | m     |
    | force                                                               |        | N     |
    | log_force_error: standard deviation of the logarithm of the force   |        | 1     |
    | half: from the middle of an edge to its end; zero for other contacts | (2,)  | m     |
    | velocity                                                            | (2,)   | m/s   |
    """

    number: int
    position: np.ndarray
    covariance: np.ndarray
    width: float
    force: float
    log_force_error: float
    half: np.ndarray
    velocity: np.ndarray


@dataclass(frozen=True, eq=False)
class Tracking:
    """What a `Tracker` knows after a frame.

    | meaning                                                               |
    |-----------------------------------------------------------------------|
    | belief: of contacts and gain                                          |
    | layer: what was known of the gain before the contacts of now          |
    | numbers: of the contacts                                              |
    | edges: which of them are edges                                        |
    | faint: for how many frames each has hardly been seen                  |
    | begun: number of contacts so far                                      |
    | taught: number of contacts that the layer holds of those that have begun |
    | unaged: time, s, for which the layer is still to be aged              |
    | misfit: chi-square of the last frame that was looked into             |
    | since, patience: frames since then, and until a frame like it is looked into again |
    | considered: what unknown shapes and an unknown coat make the contacts err by |
    | backlog: frames that are not explained yet; the belief is that without events since then |
    """

    belief: Belief
    layer: LearnedLayer
    numbers: tuple[int, ...] = ()
    edges: tuple[bool, ...] = ()
    faint: tuple[int, ...] = ()
    begun: int = 0
    misfit: float = 0.0
    since: int = 0
    patience: int = PATIENCE
    considered: ConsiderErrors = field(default_factory=ConsiderErrors)
    backlog: "Backlog | None" = None
    taught: int = 0
    unaged: float = 0.0

    @property
    def tracks(self) -> tuple[Track, ...]:
        """The contacts, in the order in which they began."""
        contacts, covariance = np.asarray(self.belief.contacts), np.asarray(self.belief.covariance)
        blocks = [covariance[own, own] for own in map(contact_slice, range(len(contacts)))]
        return tuple(
            track_of(number, contacts[k], self.considered.add_to(number, blocks[k]), edge)
            for k, (number, edge) in enumerate(zip(self.numbers, self.edges, strict=True))
        )

    def under(self, hypothesis: Hypothesis, belief: Belief) -> "Tracking":
        """After an event, with what is believed then."""
        faint = dict(zip(self.numbers, self.faint, strict=True))
        return replace(
            self,
            belief=belief,
            numbers=hypothesis.numbers,
            edges=hypothesis.edges,
            faint=tuple(faint.get(number, 0) for number in hypothesis.numbers),
            begun=max([self.begun, *hypothesis.numbers]),
        )


class Observation(NamedTuple):
    """A frame (readings,) V, the forces on the pads, and the seconds since the frame before."""

    dv: np.ndarray
    pads: Pads
    seconds: float


# Evaluations after which a trial may be given up: if so many more steps like the next one would not make it the best.
MIN_TRIAL_STEPS, FORECAST_STEPS = 2, 3


class Trial(NamedTuple):
    """The hypothesis of an event before a frame, and the update by this frame as far as it has come."""

    hypothesis: Hypothesis
    attempt: Attempt | None = None

    @property
    def ended(self) -> bool:
        """Whether the update has ended."""
        return self.attempt is not None and bool(self.attempt.ended)

    @property
    def log_probability(self) -> float:
        """Log of the probability of event and frame, up to a constant; -inf for an update that is not finite."""
        assert self.attempt is not None
        evidence = float(self.attempt.evidence)
        return evidence + self.hypothesis.prior if math.isfinite(evidence) else -math.inf

    def is_hopeless(self, best: float) -> bool:
        """Whether the update would stay less probable than another after more steps that do as much as the next one."""
        if self.attempt is None or self.attempt.state is None or int(self.attempt.state.steps) < MIN_TRIAL_STEPS:
            return False
        return self.log_probability + FORECAST_STEPS * float(self.attempt.state.promised) < best


@dataclass(frozen=True, eq=False)
class Look:
    """A frame that is looked into, piece by piece.

    | meaning                                                                             |
    |-------------------------------------------------------------------------------------|
    | observation: the frame                                                              |
    | before: contacts before it, after the events that have been found                   |
    | uneventful: contacts after it if nothing more has happened                          |
    | best: the trial of the contacts before it                                           |
    | events: number of events that are still looked for                                  |
    | unconverged: whether `uneventful` is from an update that had not converged          |
    | trials: of the events that may have happened; None: not begun                       |
    | after: contacts after the frame; None: not yet known                                |
    """

    observation: Observation
    before: Tracking
    uneventful: Tracking
    best: Trial
    events: int
    unconverged: bool = False
    trials: tuple[Trial, ...] | None = None
    after: Tracking | None = None


@dataclass(frozen=True, eq=False)
class Backlog:
    """Frames that are still to be followed, while one before them is looked into.

    | meaning                                                                            |
    |------------------------------------------------------------------------------------|
    | before: contacts before the frames that wait; of no meaning while there is a look  |
    | look: into the frame before them                                                   |
    | waiting: the frames; where there are many, each stands for several                 |
    """

    before: Tracking
    look: Look | None
    waiting: tuple[Observation, ...] = ()


def track_of(number: int, row: np.ndarray, covariance: np.ndarray, edge: bool) -> Track:
    """A contact from its state (8,) and the covariance of that (8, 8)."""
    return Track(
        number=number,
        position=row[:2],
        covariance=covariance[:2, :2],
        width=float(np.exp(row[2])),
        force=float(np.exp(row[3])),
        log_force_error=float(np.sqrt(covariance[3, 3])),
        half=row[4:6] if edge else np.zeros(2),
        velocity=row[6:],
    )
