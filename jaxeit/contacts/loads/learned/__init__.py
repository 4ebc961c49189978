"""What loads were learned from: presses of known force, and networks trained in simulation."""
