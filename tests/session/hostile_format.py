"""A format whose library misbehaves; in a module of few imports, as a child process imports it."""

import os

import numpy as np

from calib.session.importers import AbstractArrayImporter
from calib.session.importers.arrays import ArrayShape
from jaxeit.budget import Budget


class Hostile(AbstractArrayImporter):
    """A format whose library misbehaves as the file's name says."""

    name = "hostile"

    @classmethod
    def outline(cls, path):
        if path.name == "memory":
            np.ones(Budget().child_bytes // 8)
        if path.name == "crash":
            os.abort()
        if path.name == "loop":
            while True:
                pass
        return {"t": ArrayShape(3, 1), "f": ArrayShape(3, 1)}

    @classmethod
    def arrays(cls, path, names):
        return [np.zeros((2, 1)) for _ in names]
