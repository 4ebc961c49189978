"""A learned proposal of contacts: scenes drawn at random, a small network, and the file that `jaxeit.contacts` applies.

`train_proposal` is what ``jaxeit train`` does. Only this room needs a library of training (extra ``train``).
"""

from .procedure import train_proposal

__all__ = ["train_proposal"]
