"""A learned proposal of contacts: scenes drawn at random, a small network, and the file that `jaxeit.contacts` applies.

`train_proposal` is what ``jaxeit train`` does. Only this room needs a library of training (extra ``train``).

Example:
    import jaxeit as je
    from calib import learning

    skin = je.load_skin("testbed")  # or your own; the default numbers take longer
    if __name__ == "__main__":  # other processes import this file
        proposal = learning.train_proposal(skin, "proposal.npz", frames=8192, epochs=1)
        print(proposal.about["held_out"]["kinds_told"])  # share of frames whose kind it tells
"""

from .procedure import train_proposal

__all__ = ["train_proposal"]
