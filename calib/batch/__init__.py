"""Many sessions at once, on several processes or a cluster."""
