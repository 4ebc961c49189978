"""Sparse Cholesky by nested dissection: ordering, symbolic and numerical factorisation, and solves."""
