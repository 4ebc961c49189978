"""Commands that make, convert and examine recordings."""
