"""Words of messages: what stands in the place of something else, and the known name that was meant."""
