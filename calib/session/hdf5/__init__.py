"""Guarded access to HDF5: nothing in a file is trusted before it has been checked."""
