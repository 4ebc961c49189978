"""Which kinds of loads are fitted to one frame, and from where."""

from dataclasses import dataclass, replace

import numpy as np

from ..result import Contacts
from .comparison import evidences, summary
from .fits import Fit, FrameFits
from .pressure import FORMS
from .result import LoadKind, Loads, Proposed
from .starts import Starts

MIN_FALL = 12.0  # of chi-square by a third load, below which none is fitted
MIN_PROBABILITY = 2e-3  # of a kind that is proposed, below which it is not fitted
# Chi-square over the number of readings, above which a fit from a proposal is searched too. Proposals of three loads
# often begin astray. Beyond 1.3 lies one in a thousand of fits whose errors are those believed.
SURPRISING = 2.0
# Probability that the evidence of fits tells kinds, beside a proposal; otherwise it says nothing. Fits know the forward
# map and one load's shape; the network has seen shapes, layers and faults that fits do not have. Of 0.3, 0.5, 0.7 and
# 0.9, this number had the least surprise on frames of skins that neither had seen (docs/proposal.md).
TRUST = 0.3
MIN_SHARE = 0.15  # of the force, that the weaker of two ends of an edge bears


@dataclass(frozen=True, eq=False)
class FrameSearch:
    """Fits of kinds of loads to one frame, from the contacts that a finder saw, or from all over the sheet."""

    frame: FrameFits
    starts: Starts
    contacts: Contacts | None

    def loads(self) -> Loads:
        """Loads of all kinds with their probabilities."""
        fits = self.searched()
        # What the finder cannot tell from noise is nothing.
        there = self.contacts is None or bool(np.any(self.contacts.present))
        evidence = evidences(self.frame, fits if there else {})
        return summary(self.frame, dict.fromkeys(fits, -np.inf) | evidence, {LoadKind.MORE: fits[LoadKind.TWO]} | fits)

    def refined(self, proposed: Proposed) -> Loads:
        """Loads of the kinds that are proposed, from where they are proposed; searched too where these surprise."""
        likely = [kind for kind in FORMS if proposed.probability[kind] > MIN_PROBABILITY]
        tried = {LoadKind.ONE: None} | dict.fromkeys(likely)
        fits = {kind: self.frame.best(kind, [proposed.of(kind)]) for kind in tried}
        found, y = self._pooled(proposed, fits), self.frame.y
        left = fits[found.kind].square if found.kind in fits else float(y @ y)
        if left <= SURPRISING * len(y):
            return found
        for kind, other in self.searched().items():
            fits[kind] = min(other, fits.get(kind, other), key=lambda fit: fit.improbability)
        return self._pooled(proposed, fits)

    def _pooled(self, proposed: Proposed, fits: dict[LoadKind, Fit]) -> Loads:
        """Loads of fits, whose kinds are as probable as the proposal and the fits say together."""
        evidence = evidences(self.frame, fits)
        found = summary(self.frame, evidence, fits)
        pooled = TRUST * np.asarray(found.probability) + (1 - TRUST) / len(LoadKind)
        pooled *= proposed.probability * np.isin(np.arange(len(LoadKind)), list(evidence))
        return replace(found, probability=self.frame.belief.put(pooled / pooled.sum())[0])

    def searched(self) -> dict[LoadKind, Fit]:
        """Fits of all kinds from where frame and finder say; of three loads only where a third explains more."""
        one = self.one()
        halves, long = self.starts.split(one.rows[0], self.frame.reach(one))
        two = self.frame.best(LoadKind.TWO, [halves, *self._seen(2)])
        share, between = self.starts.between(two.rows)
        edge = self.frame.best(LoadKind.EDGE, [between if share > MIN_SHARE else long])
        fits = {LoadKind.ONE: one, LoadKind.TWO: two, LoadKind.EDGE: edge}
        left, known = self.frame.left(two)
        fall, three = self.starts.another(two.rows, two.root, left, np.asarray(known.loads)[:, two.free])
        if fall > MIN_FALL:
            fits[LoadKind.MORE] = self.frame.best(LoadKind.MORE, [three, *self._seen(3)])
        return fits

    def one(self) -> Fit:
        """The best single load; where the contacts lead astray, a usual load in their place or the best atom."""
        frame = self.frame
        if self.contacts is None:
            return frame.best(LoadKind.ONE, [self._atom()])
        begin = self.starts.single(frame.y, self.contacts)
        found = frame.best(LoadKind.ONE, [begin])
        if not frame.astray(found):
            return found
        usual = np.append(begin[0, :2], np.asarray(frame.belief.usual))[None]
        return min(found, frame.best(LoadKind.ONE, [usual, self._atom()]), key=lambda fit: fit.square)

    def _atom(self) -> np.ndarray:
        """The atom (1, 4) that explains most of the frame."""
        return self.starts.atom(self.frame.y, np.eye(len(self.frame.y)))[1]

    def _seen(self, count: int) -> list[np.ndarray]:
        """Loads of the contacts that a finder saw, if there are so many."""
        return [] if self.contacts is None else self.starts.seen(self.contacts, count)
