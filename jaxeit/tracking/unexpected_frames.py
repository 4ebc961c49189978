"""A frame that is not expected is looked into: what may have happened to the contacts before it?

The belief before the frame is updated in several ways: as it is; with contacts that have jumped; with one of them
elsewhere; without one of them; with one, or two, that are an edge; with one more. The way under which the frame was
most probable is taken, with the rates of such events as prior (evidence by Laplace's approximation, MacKay 1992, Neural
Comput. 4).

As a contact begins, what the model errs by may look like a second one, and frames that come later do not contradict:
two contacts explain what one does. So where the share of contacts in their force stays unknown they are counted again:
all of them begin anew in one frame, against one fewer.

This is many updates. They are done in pieces of a few evaluations, so that a live view does some of them in each frame.
Meanwhile it goes on as if nothing had happened, and keeps the frames, some standing for several. When it is known what
has happened, these frames are followed, and looked into, one after the other, until none is left.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from .belief.programs import MIN_START_DISTANCE, Programs
from .belief.state import CONTACT_SIZE, Belief, Update
from .events import EventHypotheses, Hypothesis
from .tracks import MAX_PATIENCE, PATIENCE, Backlog, Look, Observation, Tracking, Trial

# Signal-to-noise ratio below which a contact is faint, and number of such frames after which it dies.
FAINT_SIGNAL, FAINT_FRAMES = 4.0, 2
# Smallest signal-to-noise ratio of a contact that is born beside others, and its smallest share of that of all others.
MIN_BIRTH_SIGNAL, MIN_BIRTH_SHARE = 12.0, 0.05
# Smallest distance, m, from contacts at which what a frame shows more than predicted may be a new one.
MIN_BIRTH_DISTANCE = 0.012
# Number of frames without a look, after which contacts are settled.
SETTLED_FRAMES = 5
# Standard deviation of the log of a force above which a contact is doubtful, and rate of recounts over that of looks
# into a frame that no event explains.
DOUBTFUL_STD, RECOUNT_RATE = 0.5, 4
# Largest number of frames that wait while another is looked into; where there are more, each stands for two. Even.
MAX_WAITING = 8
# Largest number of events in one frame.
MAX_EVENTS = 4
# Longest time of waiting frames, s, after which a look is abandoned: contacts that moved for so long are not known.
MAX_WAIT = 2.0


def begin_look(before: Tracking, uneventful: Tracking, observation: Observation, unconverged: bool = False) -> Look:
    """Begin to look into a frame.

    Args:
        before: contacts as they were predicted.
        uneventful: contacts after the frame if nothing happened.
        unfinished: whether the update that led to the latter had not converged.
    """
    return Look(observation, before, uneventful, Trial(_unchanged(before)), MAX_EVENTS, unconverged)


def needs_recount(now: Tracking) -> bool:
    """Whether contacts are to be counted again, since the force of one beside others is hardly known."""
    return len(now.numbers) > 1 and now.since >= now.patience // RECOUNT_RATE and bool(_doubtful_contacts(now))


def _doubtful_contacts(now: Tracking) -> list[int]:
    """Indices of the contacts that may be none."""
    forces = CONTACT_SIZE * np.arange(len(now.numbers)) + 3
    errors = np.sqrt(np.diag(np.asarray(now.belief.covariance))[forces])
    return [k for k, error in enumerate(errors) if error > DOUBTFUL_STD and not now.edges[k]]


def begin_recount(
    before: Tracking, uneventful: Tracking, observation: Observation, programs: Programs, events: EventHypotheses
) -> Look:
    """Begin to compare one contact fewer with all contacts in a frame; arguments as for `begin_look`."""
    positions, reborn = np.asarray(before.belief.contacts)[:, :2], _unchanged(before)
    for k, position in enumerate(positions):
        reborn = events.relocate(reborn, k, position)

    def merged(k: int) -> Trial:
        """One contact in place of contact k and its nearest neighbour."""
        neighbour = int(np.argsort(np.linalg.norm(positions - positions[k], axis=1))[1])
        first, second = sorted((k, neighbour))
        rest = reborn.without(second, 0.0)
        position = programs.birth_position(rest.without(first, 0.0).belief, observation.dv, observation.pads)
        return Trial(events.relocate(rest, first, position))

    best = Trial(reborn._replace(prior=events.birth_log_prior(observation.seconds)))
    trials = tuple(map(merged, _doubtful_contacts(before)))
    return Look(observation, before, uneventful, best, MAX_EVENTS, trials=trials)


def queue_frame(backlog: Backlog, observation: Observation) -> Backlog:
    """Queue a frame behind others that wait."""
    waiting = backlog.waiting
    if backlog.look is None:
        waiting = _merge_pairs(waiting[:2]) + waiting[2:]  # else a frame more would come for each that is followed
    elif len(waiting) >= MAX_WAITING:
        waiting = _merge_pairs(waiting)
    return replace(backlog, waiting=(*waiting, observation))


def catch_up(now: Tracking, backlog: Backlog, observation: Observation) -> tuple[Tracking, Observation]:
    """Let a new frame stand for the one that waits too, where only one waits and none is looked into.

    Otherwise one would wait for ever where a piece is done after each frame.
    """
    if backlog.look is not None or len(backlog.waiting) > 1:
        return now, observation
    return backlog.before, observation._replace(
        seconds=observation.seconds + sum(one.seconds for one in backlog.waiting)
    )


def is_overdue(backlog: Backlog) -> bool:
    """Whether frames have waited for longer than `MAX_WAIT`, as on a machine that is too slow or too busy."""
    return sum(observation.seconds for observation in backlog.waiting) > MAX_WAIT


def _merge_pairs(frames: tuple[Observation, ...]) -> tuple[Observation, ...]:
    """Merge pairs of frames: the second of each, with the seconds of both."""
    if len(frames) < 2:
        return frames
    pairs = zip(frames[::2], frames[1::2], strict=True)
    return tuple(second._replace(seconds=first.seconds + second.seconds) for first, second in pairs)


def _unchanged(now: Tracking) -> Hypothesis:
    return Hypothesis(now.belief, now.numbers, now.edges)


def advance_look(look: Look, programs: Programs, events: EventHypotheses) -> Look:
    """Advance a look by one piece, until it has the contacts after its frame."""
    if not look.best.ended:
        return replace(look, best=_advance_trial(look.best, look.observation, programs))
    if look.trials is None:
        careful = _conclude(look, look.best, programs)
        if _is_explained(careful, programs.size, events.event_log_prior(look.observation.seconds)):
            return replace(look, after=_without_event(look, programs, careful))
        return replace(look, trials=_event_trials(look, careful, programs, events))
    best = max(trial.log_probability for trial in [look.best, *_admissible_trials(look)])
    for k, trial in enumerate(look.trials):
        if not (trial.ended or trial.is_hopeless(best)):
            trials = (*look.trials[:k], _advance_trial(trial, look.observation, programs), *look.trials[k + 1 :])
            return replace(look, trials=trials)
    return _decide(look, programs)


def _advance_trial(trial: Trial, observation: Observation, programs: Programs) -> Trial:
    return trial._replace(
        attempt=programs.advance(trial.hypothesis.belief, observation.dv, observation.pads, trial.attempt)
    )


def _is_explained(careful: Update, size: int, log_prior: float) -> bool:
    """Whether no event is more probable than none, even one that would leave only noise of a frame.

    Args:
        size: number of whitened readings.
        log_prior: of an event.
    """
    gain = 0.5 * (float(careful.misfit) - size + float(careful.correction_square))
    return is_finite(careful) and gain + log_prior < 0


def _event_trials(look: Look, careful: Update, programs: Programs, events: EventHypotheses) -> tuple[Trial, ...]:
    """Trials of the events that may have happened.

    A contact may have begun where most is left of the frame by the contacts before it, or where the frame shows more
    than they had predicted: towards a strong new contact they move, and leave of it what lies elsewhere. What a frame
    shows more near them, or while they begin, is their own growth: an edge may have been taken for round.
    """
    before, observation = _unchanged(look.before), look.observation

    def position(belief: Belief) -> Float[np.ndarray, "2"]:
        return programs.birth_position(belief, observation.dv, observation.pads)

    places = [position(careful.belief)]
    excess = None
    if look.before.since >= SETTLED_FRAMES:
        excess = programs.excess_position(before.belief, observation.dv, observation.pads)
    if excess is not None and np.linalg.norm(excess - places[0]) >= MIN_START_DISTANCE:
        away = _distances(np.asarray(before.belief.contacts), excess)
        places = [excess, *places] if (away >= MIN_BIRTH_DISTANCE).all() else places
    alternatives = [position(before.without(k, 0.0).belief) for k in range(len(before.numbers))]
    return tuple(map(Trial, events.hypotheses(before, look.before.begun, places, alternatives, observation.seconds)))


def _distances(contacts: Float[np.ndarray, "K 8"], place: Float[np.ndarray, "2"]) -> Float[np.ndarray, " K"]:
    """Distances of a place from contacts, m; from the nearest point of an edge."""
    away, half = place - contacts[:, :2], contacts[:, 4:6]
    along = np.clip((away * half).sum(1) / np.maximum((half**2).sum(1), np.finfo(half.dtype).tiny), -1, 1)
    found: np.ndarray = np.linalg.norm(away - along[:, None] * half, axis=1)
    return found


def _conclude(look: Look, trial: Trial, programs: Programs) -> Update:
    assert trial.attempt is not None
    return programs.conclude(trial.hypothesis.belief, look.observation.dv, look.observation.pads, trial.attempt)


def _admissible_trials(look: Look) -> list[Trial]:
    """Trials that have ended and are not spurious."""
    return [trial for trial in look.trials or () if trial.ended and not _is_spurious(look.before, trial)]


def _most_probable_trial(look: Look) -> Trial:
    return max([look.best, *_admissible_trials(look)], key=lambda trial: trial.log_probability)


def _decide(look: Look, programs: Programs) -> Look:
    """Decide for the most probable event; end the look if this is that nothing more has happened."""
    best = _most_probable_trial(look)
    if best is look.best or best.attempt is None:
        after = _without_event(look, programs)
        return replace(look, after=extend_patience(after) if look.events == MAX_EVENTS else after)
    hypothesis = best.hypothesis
    update = _conclude(look, best, programs)
    before = look.before.under(hypothesis, hypothesis.belief)
    after = apply_update(replace(before, since=0, patience=PATIENCE, misfit=float(update.misfit)), update)
    best, left = best._replace(hypothesis=hypothesis._replace(prior=0.0)), look.events - 1
    look = replace(look, before=before, best=best, uneventful=after, events=left, unconverged=False, trials=None)
    return look if left else replace(look, after=after)


def _without_event(look: Look, programs: Programs, careful: Update | None = None) -> Tracking:
    """Contacts after no further event: by the careful update, if the ordinary one had not converged and fits worse.

    Where a force grows severalfold between two frames, the few evaluations of an ordinary update end before the force
    is found, and the gain explains the rest of the frame.
    """
    if not look.unconverged:
        return look.uneventful
    careful = _conclude(look, look.best, programs) if careful is None else careful
    if not float(careful.misfit) < look.uneventful.misfit:
        return look.uneventful
    return apply_update(replace(look.before, since=0, misfit=float(careful.misfit)), careful)


def extend_patience(after: Tracking) -> Tracking:
    """Wait for longer before the next look, as no event explained this frame."""
    return replace(after, patience=min(2 * after.patience, MAX_PATIENCE))


def _is_spurious(before: Tracking, trial: Trial) -> bool:
    """Whether a contact born beside others is so weak that it may be an error of their model."""
    assert trial.attempt is not None
    born = len(trial.hypothesis.numbers) > len(before.numbers) > 0
    signal = np.asarray(trial.attempt.signal_to_noise)
    return born and bool(signal[-1] < max(MIN_BIRTH_SIGNAL, MIN_BIRTH_SHARE * signal[:-1].sum()))


def apply_update(now: Tracking, update: Update) -> Tracking:
    """Apply an update, and remove contacts that have been faint for too long.

    All are removed if the update is not finite, as where rounding has left a covariance indefinite: the gain stays
    known, and contacts begin anew.
    """
    if not is_finite(update):
        return remove_contacts(now)
    signal = np.asarray(update.signal_to_noise)
    faint = tuple(count + 1 if own < FAINT_SIGNAL else 0 for count, own in zip(now.faint, signal, strict=True))
    now = replace(now, belief=update.belief, faint=faint)
    for k in reversed(range(len(faint))):
        if faint[k] >= FAINT_FRAMES:
            left = _unchanged(now).without(k, 0.0)
            now = now.under(left, left.belief)
    return now


def is_finite(update: Update) -> bool:
    """Whether an update is finite."""
    belief = update.belief
    numbers = (update.evidence, belief.contacts, belief.gain, np.diag(np.asarray(belief.covariance)))
    return all(bool(np.isfinite(np.asarray(one)).all()) for one in numbers)


def has_converged(update: Update) -> bool:
    """Whether an update is finite and has converged."""
    return is_finite(update) and bool(update.converged)


def remove_contacts(now: Tracking) -> Tracking:
    """Remove all contacts; the gain stays known."""
    left = _unchanged(now)
    while left.numbers:
        left = left.without(0, 0.0)
    return now.under(left, left.belief)
