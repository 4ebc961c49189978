"""A frame that is not expected is looked into: what may have happened to the contacts before it?

The belief before the frame is updated in several ways: as it is; with contacts that have jumped; without one of them;
with one, or two, that are an edge; with one more. The way under which the frame was most probable is taken, with the
rates of such events as prior (evidence by Laplace's approximation, MacKay 1992, Neural Comput. 4).

This is many updates. They are done in pieces of a few evaluations, so that a live view does some of them in each frame
and goes on following the contacts meanwhile, as if nothing had happened. Where something has, the contacts after the
event are followed through the frames since then, and take the place of the others.
"""

from dataclasses import replace

import numpy as np

from .events import Events, Hypothesis
from .filter import Update
from .programs import Programs
from .tracks import Look, Seen, Tracking, Trial

# A contact dies after as many frames in which its signal is below so many standard deviations of the noise.
FAINT, FAINT_FRAMES = 4.0, 2
# Signal of a contact that begins beside others, at least: in standard deviations of the noise, and over that of all.
MIN_LOUDNESS, RIPPLE = 12.0, 0.05
# Frames since the one that is looked into that are kept; where there are more, each stands for two. An even number.
KEPT = 8
# A frame that no event explains is asked about again after so many frames.
PATIENCE = 10


def begun(before: Tracking, seen: Seen, events: int) -> Look:
    """Begin to look into a frame, for so many events; `before`: the contacts as they were predicted."""
    return Look(seen, before, Trial(_as_is(before)), events)


def meanwhile(look: Look, seen: Seen) -> Look:
    """A frame has come before the look has ended."""
    since = look.since
    if look.after is not None:
        since = _merged(since[:2]) + since[2:]  # else a frame more would come for each that is followed
    elif len(since) >= KEPT:
        since = _merged(since)
    return replace(look, since=(*since, seen))


def _merged(frames: tuple[Seen, ...]) -> tuple[Seen, ...]:
    """Every other frame, with the seconds of both."""
    if len(frames) < 2:
        return frames
    pairs = zip(frames[::2], frames[1::2], strict=True)
    return tuple(second._replace(seconds=first.seconds + second.seconds) for first, second in pairs)


def _as_is(now: Tracking) -> Hypothesis:
    return Hypothesis(now.belief, now.numbers, now.edges)


def looked(look: Look, programs: Programs, events: Events) -> Look:
    """A piece more of a look that has not ended (`is_over`)."""
    if look.after is not None:
        first, *rest = look.since
        _, update = programs.followed(look.after.belief, *first)
        return replace(look, after=settled(look.after, update), since=tuple(rest))
    if not look.best.ended:
        return replace(look, best=_further(look.best, look.seen, programs))
    if look.trials is None:
        return replace(look, trials=_trials(look, programs, events))
    open_ = [k for k, trial in enumerate(look.trials) if not trial.ended]
    if open_:
        trials = list(look.trials)
        trials[open_[0]] = _further(trials[open_[0]], look.seen, programs)
        return replace(look, trials=tuple(trials))
    return _judged(look, look.trials, programs)


def is_over(look: Look) -> bool:
    """Whether nothing is left to be done."""
    return look.after is not None and not look.since


def _further(trial: Trial, seen: Seen, programs: Programs) -> Trial:
    return trial._replace(attempt=programs.attempted(trial.event.belief, seen.dv, seen.pads, trial.attempt))


def _trials(look: Look, programs: Programs, events: Events) -> tuple[Trial, ...]:
    """What may have happened."""
    attempt = look.best.attempt
    assert attempt is not None
    best = programs.concluded(look.before.belief, look.seen.dv, look.seen.pads, attempt)
    place = programs.unexplained_place(best.belief, look.seen.dv, look.seen.pads)
    possible = events.possible(_as_is(look.before), look.before.begun, place, look.seen.seconds)
    return tuple(map(Trial, possible))


def _judged(look: Look, trials: tuple[Trial, ...], programs: Programs) -> Look:
    """The look after the most probable event; the end of it if this is that nothing has happened."""
    tried = [trial for trial in trials if not _is_ripple(look.before, trial)]
    best = max([look.best, *tried], key=lambda trial: trial.probability)
    happened = best is not look.best
    if happened:
        event = best.event
        before, best = look.before.under(event, event.belief), best._replace(event=event._replace(prior=0.0))
        look = replace(look, before=before, best=best, events=look.events - 1, trials=None, happened=True)
        if look.events:
            return look
    if not look.happened:
        return replace(look, trials=None, events=0, since=(), after=look.before)
    attempt = look.best.attempt
    assert attempt is not None
    update = programs.concluded(look.before.belief, look.seen.dv, look.seen.pads, attempt)
    since = 0 if look.events else PATIENCE  # there may have been more events
    return replace(look, after=settled(replace(look.before, since=since, misfit=float(update.misfit)), update))


def _is_ripple(before: Tracking, trial: Trial) -> bool:
    """Whether a contact beside others would begin so weak that it may be an error of their model."""
    assert trial.attempt is not None
    born = len(trial.event.numbers) > len(before.numbers) > 0
    loudness = np.asarray(trial.attempt.loudness)
    return born and bool(loudness[-1] < max(MIN_LOUDNESS, RIPPLE * loudness[:-1].sum()))


def settled(now: Tracking, update: Update) -> Tracking:
    """The contacts after an update, without those that are no longer seen."""
    loudness = np.asarray(update.loudness)
    faint = tuple(count + 1 if own < FAINT else 0 for count, own in zip(now.faint, loudness, strict=True))
    now = replace(now, belief=update.belief, faint=faint)
    for k in reversed(range(len(faint))):
        if faint[k] >= FAINT_FRAMES:
            left = _as_is(now).without(k, 0.0)
            now = now.under(left, left.belief)
    return now
