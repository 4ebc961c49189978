"""Kinds of electrodes: points, discs, polygons, rings, and stretches of the edge of the sheet."""
