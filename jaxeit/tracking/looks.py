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

from .belief.filter import CONTACT_SIZE, Update
from .belief.programs import Programs
from .events import Events, Hypothesis
from .tracks import MOST_PATIENCE, PATIENCE, Backlog, Look, Seen, Tracking, Trial

# A contact dies after as many frames in which its signal is below so many standard deviations of the noise.
FAINT, FAINT_FRAMES = 4.0, 2
# Signal of a contact that begins beside others, at least: in standard deviations of the noise, and over that of all.
MIN_LOUDNESS, RIPPLE = 12.0, 0.05
# Contacts may be fewer where the log of a force has a larger standard deviation. They are counted again so many times
# as often as a frame that no event explains is looked into.
DOUBTED, DOUBTS = 0.5, 4
# Frames that wait while another is looked into; where there are more, each stands for two. An even number.
KEPT = 8
# Events that one frame may show.
EVENTS = 4
# A look is given up when frames of so many seconds wait: contacts that moved on unseen for so long are not believed.
LONGEST_WAIT = 2.0


def begun(before: Tracking, otherwise: Tracking, seen: Seen, unfinished: bool = False) -> Look:
    """Begin to look into a frame: contacts as they were predicted, and as the frame leaves them if nothing happened.

    Args:
        unfinished: whether the update that led to the latter had not converged.
    """
    return Look(seen, before, otherwise, Trial(_as_is(before)), EVENTS, unfinished)


def is_doubted(now: Tracking) -> bool:
    """Whether contacts are to be counted again: the force of one beside others is hardly known."""
    return len(now.numbers) > 1 and now.since >= now.patience // DOUBTS and bool(_doubted(now))


def _doubted(now: Tracking) -> list[int]:
    """Which contacts may be none."""
    forces = CONTACT_SIZE * np.arange(len(now.numbers)) + 3
    errors = np.sqrt(np.diag(np.asarray(now.belief.covariance))[forces])
    return [k for k, error in enumerate(errors) if error > DOUBTED and not now.edges[k]]


def recounted(before: Tracking, otherwise: Tracking, seen: Seen, programs: Programs, events: Events) -> Look:
    """Begin to look whether one contact fewer explains a frame; arguments as for `begun`."""
    places, anew = np.asarray(before.belief.contacts)[:, :2], _as_is(before)
    for k, place in enumerate(places):
        anew = events.elsewhere(anew, k, place)

    def fewer(k: int) -> Trial:
        """One contact in the place of contact k and the one beside it."""
        beside = int(np.argsort(np.linalg.norm(places - places[k], axis=1))[1])
        first, second = sorted((k, beside))
        left = anew.without(second, 0.0)
        place = programs.unexplained_place(left.without(first, 0.0).belief, seen.dv, seen.pads)
        return Trial(events.elsewhere(left, first, place))

    best = Trial(anew._replace(prior=events.anywhere(seen.seconds)))
    return Look(seen, before, otherwise, best, EVENTS, trials=tuple(map(fewer, _doubted(before))))


def meanwhile(backlog: Backlog, seen: Seen) -> Backlog:
    """A frame has come while others wait."""
    waiting = backlog.waiting
    if backlog.look is None:
        waiting = _merged(waiting[:2]) + waiting[2:]  # else a frame more would come for each that is followed
    elif len(waiting) >= KEPT:
        waiting = _merged(waiting)
    return replace(backlog, waiting=(*waiting, seen))


def caught_up(now: Tracking, backlog: Backlog, seen: Seen) -> tuple[Tracking, Seen]:
    """Where one frame waits and none is looked into, the frame that has come stands for both.

    Else one would wait for ever where a piece is done after each frame.
    """
    if backlog.look is not None or len(backlog.waiting) > 1:
        return now, seen
    return backlog.before, seen._replace(seconds=seen.seconds + sum(one.seconds for one in backlog.waiting))


def is_given_up(backlog: Backlog) -> bool:
    """Whether so many frames wait that no spare time can be hoped for, as on a machine that is too slow or too busy."""
    return sum(seen.seconds for seen in backlog.waiting) > LONGEST_WAIT


def _merged(frames: tuple[Seen, ...]) -> tuple[Seen, ...]:
    """Every other frame, with the seconds of both."""
    if len(frames) < 2:
        return frames
    pairs = zip(frames[::2], frames[1::2], strict=True)
    return tuple(second._replace(seconds=first.seconds + second.seconds) for first, second in pairs)


def _as_is(now: Tracking) -> Hypothesis:
    return Hypothesis(now.belief, now.numbers, now.edges)


def looked(look: Look, programs: Programs, events: Events) -> Look:
    """A piece more of a look, until it knows the contacts after its frame."""
    if not look.best.ended:
        return replace(look, best=_further(look.best, look.seen, programs))
    if look.trials is None:
        careful = _concluded(look, look.best, programs)
        if _is_explained(careful, programs.size, events.rare(look.seen.seconds)):
            return replace(look, after=_uneventful(look, programs, careful))
        return replace(look, trials=_trials(look, careful, programs, events))
    best = max(trial.probability for trial in [look.best, *_possible(look)])
    for k, trial in enumerate(look.trials):
        if not (trial.ended or trial.is_hopeless(best)):
            trials = (*look.trials[:k], _further(trial, look.seen, programs), *look.trials[k + 1 :])
            return replace(look, trials=trials)
    return _judged(look, programs)


def _further(trial: Trial, seen: Seen, programs: Programs) -> Trial:
    return trial._replace(attempt=programs.attempted(trial.event.belief, seen.dv, seen.pads, trial.attempt))


def _is_explained(careful: Update, size: int, rare: float) -> bool:
    """Whether no event is more probable than none, even one that would leave only noise of a frame.

    Args:
        size: number of whitened readings.
        rare: log of the prior probability of an event.
    """
    gained = 0.5 * (float(careful.misfit) - size + float(careful.surprise))
    return is_finite(careful) and gained + rare < 0


def _trials(look: Look, careful: Update, programs: Programs, events: Events) -> tuple[Trial, ...]:
    """What may have happened."""
    before, seen = _as_is(look.before), look.seen
    place = programs.unexplained_place(careful.belief, seen.dv, seen.pads)
    others = [before.without(k, 0.0).belief for k in range(len(before.numbers))]
    instead = [programs.unexplained_place(belief, seen.dv, seen.pads) for belief in others]
    return tuple(map(Trial, events.possible(before, look.before.begun, place, instead, seen.seconds)))


def _concluded(look: Look, trial: Trial, programs: Programs) -> Update:
    assert trial.attempt is not None
    return programs.concluded(trial.event.belief, look.seen.dv, look.seen.pads, trial.attempt)


def _possible(look: Look) -> list[Trial]:
    """Trials that have ended and may be what has happened."""
    return [trial for trial in look.trials or () if trial.ended and not _is_ripple(look.before, trial)]


def _most_probable(look: Look) -> Trial:
    return max([look.best, *_possible(look)], key=lambda trial: trial.probability)


def _judged(look: Look, programs: Programs) -> Look:
    """The look after the most probable event; the end of it if this is that nothing more has happened."""
    best = _most_probable(look)
    if best is look.best or best.attempt is None:
        after = _uneventful(look, programs)
        return replace(look, after=calmer(after) if look.events == EVENTS else after)
    event = best.event
    update = _concluded(look, best, programs)
    before = look.before.under(event, event.belief)
    after = settled(replace(before, since=0, patience=PATIENCE, misfit=float(update.misfit)), update)
    best, left = best._replace(event=event._replace(prior=0.0)), look.events - 1
    look = replace(look, before=before, best=best, otherwise=after, events=left, unfinished=False, trials=None)
    return look if left else replace(look, after=after)


def _uneventful(look: Look, programs: Programs, careful: Update | None = None) -> Tracking:
    """Contacts to which nothing more has happened: by the careful update, if the ordinary one ended before it was best.

    Where a force grows severalfold between two frames, the few evaluations of an ordinary update end before the force
    is found, and the gain explains the rest of the frame.
    """
    if not look.unfinished:
        return look.otherwise
    careful = _concluded(look, look.best, programs) if careful is None else careful
    if not float(careful.misfit) < look.otherwise.misfit:
        return look.otherwise
    return settled(replace(look.before, since=0, misfit=float(careful.misfit)), careful)


def calmer(after: Tracking) -> Tracking:
    """Contacts to which nothing has happened, although a frame looked like it."""
    return replace(after, patience=min(2 * after.patience, MOST_PATIENCE))


def _is_ripple(before: Tracking, trial: Trial) -> bool:
    """Whether a contact beside others would begin so weak that it may be an error of their model."""
    assert trial.attempt is not None
    born = len(trial.event.numbers) > len(before.numbers) > 0
    loudness = np.asarray(trial.attempt.loudness)
    return born and bool(loudness[-1] < max(MIN_LOUDNESS, RIPPLE * loudness[:-1].sum()))


def settled(now: Tracking, update: Update) -> Tracking:
    """The contacts after an update, without those that are no longer seen.

    Without any if the update is not finite, as where rounding has left a covariance indefinite: the gain stays known,
    and contacts begin anew.
    """
    if not is_finite(update):
        return without_contacts(now)
    loudness = np.asarray(update.loudness)
    faint = tuple(count + 1 if own < FAINT else 0 for count, own in zip(now.faint, loudness, strict=True))
    now = replace(now, belief=update.belief, faint=faint)
    for k in reversed(range(len(faint))):
        if faint[k] >= FAINT_FRAMES:
            left = _as_is(now).without(k, 0.0)
            now = now.under(left, left.belief)
    return now


def is_finite(update: Update) -> bool:
    """Whether an update can be believed."""
    belief = update.belief
    numbers = (update.evidence, belief.contacts, belief.gain, np.diag(np.asarray(belief.covariance)))
    return all(bool(np.isfinite(np.asarray(one)).all()) for one in numbers)


def has_ended(update: Update) -> bool:
    """Whether an update can be believed, and has converged."""
    return is_finite(update) and bool(update.converged)


def without_contacts(now: Tracking) -> Tracking:
    """No contact is believed in any longer; the gain stays known."""
    left = _as_is(now)
    while left.numbers:
        left = left.without(0, 0.0)
    return now.under(left, left.belief)
