"""The matrix of the model: its unknowns, its structure, and the coefficients of sheet and coat."""
