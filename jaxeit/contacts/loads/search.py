"""Which kinds of loads are fitted to one frame, and from where."""

from dataclasses import dataclass, replace

import numpy as np

from ..result import Contacts
from .fits.comparison import evidences, summarise
from .fits.kinds import Fit, FrameFits
from .pressure import FORMS
from .result import LoadKind, Loads, Proposed
from .starts import Starts

MIN_MISFIT_FALL = 12.0  # of chi-square by a third load, below which none is fitted
MIN_PROBABILITY = 2e-3  # of a kind that is proposed, below which it is not fitted
# Chi-square over the number of readings, above which kinds are searched beside a proposal. Fits from proposals of three
# loads often end far from the minimum. Beyond 1.3 lies one in a thousand of fits whose errors are those believed.
MAX_REDUCED_MISFIT = 2.0
# Probability that the evidence of fits is right about kinds, beside a proposal; otherwise it says nothing. Fits know
# the forward map and one load's shape; the network has seen shapes, layers and faults that fits do not have. Of 0.3,
# 0.5, 0.7 and 0.9, this number had the largest log probability on frames of skins new to both (docs/proposal.md).
EVIDENCE_WEIGHT = 0.3
MIN_SHARE = 0.15  # of the force, that the weaker of two ends of an edge bears


@dataclass(frozen=True, eq=False)
class FrameSearch:
    """Fits of kinds of loads to one frame, from the contacts that a finder saw, or from all over the sheet."""

    frame: FrameFits
    starts: Starts
    contacts: Contacts | None

    def loads(self) -> Loads:
        """Loads of all kinds with their probabilities."""
        fits = self.search()
        # What the finder cannot tell from noise is nothing.
        present = self.contacts is None or bool(np.any(self.contacts.present))
        evidence = evidences(self.frame, fits if present else {})
        return summarise(
            self.frame, dict.fromkeys(fits, -np.inf) | evidence, {LoadKind.MORE: fits[LoadKind.TWO]} | fits
        )

    def refine(self, proposed: Proposed) -> Loads:
        """Loads of the proposed kinds, from their proposed parameters; also by a search where these do not fit."""
        probable = [kind for kind in FORMS if proposed.probability[kind] > MIN_PROBABILITY]
        kinds = {LoadKind.ONE: None} | dict.fromkeys(probable)
        fits = {kind: self.frame.best_fit(kind, [proposed.of(kind)]) for kind in kinds}
        found, y = self._pool(proposed, fits), self.frame.y
        residual = fits[found.kind].square if found.kind in fits else float(y @ y)
        if residual <= MAX_REDUCED_MISFIT * len(y):
            return found
        for kind, other in self.search().items():
            fits[kind] = min(other, fits.get(kind, other), key=lambda fit: fit.deviance)
        return self._pool(proposed, fits)

    def _pool(self, proposed: Proposed, fits: dict[LoadKind, Fit]) -> Loads:
        """Loads of fits, whose kinds are as probable as the proposal and the fits say together."""
        evidence = evidences(self.frame, fits)
        found = summarise(self.frame, evidence, fits)
        pooled = EVIDENCE_WEIGHT * np.asarray(found.probability) + (1 - EVIDENCE_WEIGHT) / len(LoadKind)
        pooled *= proposed.probability * np.isin(np.arange(len(LoadKind)), list(evidence))
        return replace(found, probability=self.frame.belief.to_jax(pooled / pooled.sum())[0])

    def search(self) -> dict[LoadKind, Fit]:
        """Fit all kinds from starts by frame and finder; three loads only where a third one explains more."""
        one = self.one()
        halves, long = self.starts.split(one.rows[0], self.frame.second_moments(one))
        two = self.frame.best_fit(LoadKind.TWO, [halves, *self._strongest_contacts(2)])
        share, between = self.starts.edge_between(two.rows)
        edge = self.frame.best_fit(LoadKind.EDGE, [between if share > MIN_SHARE else long])
        fits = {LoadKind.ONE: one, LoadKind.TWO: two, LoadKind.EDGE: edge}
        residual, sensitivities = self.frame.residual(two)
        fall, three = self.starts.with_third(two.rows, two.root, residual, np.asarray(sensitivities.loads)[:, two.free])
        if fall > MIN_MISFIT_FALL:
            fits[LoadKind.MORE] = self.frame.best_fit(LoadKind.MORE, [three, *self._strongest_contacts(3)])
        return fits

    def one(self) -> Fit:
        """The best single load; where the fit from contacts is poor, one from a usual load there or the best atom."""
        frame = self.frame
        if self.contacts is None:
            return frame.best_fit(LoadKind.ONE, [self._best_atom()])
        start = self.starts.single(frame.y, self.contacts)
        found = frame.best_fit(LoadKind.ONE, [start])
        if not frame.is_poor(found):
            return found
        usual = np.append(start[0, :2], np.asarray(frame.belief.prior_mean))[None]
        return min(found, frame.best_fit(LoadKind.ONE, [usual, self._best_atom()]), key=lambda fit: fit.square)

    def _best_atom(self) -> np.ndarray:
        """The atom (1, 4) that explains most of the frame."""
        return self.starts.best_atom(self.frame.y, np.eye(len(self.frame.y)))[1]

    def _strongest_contacts(self, count: int) -> list[np.ndarray]:
        """Loads of the contacts that a finder saw, if there are so many."""
        return [] if self.contacts is None else self.starts.strongest(self.contacts, count)
