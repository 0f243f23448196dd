"""Is it right, and what was published: checks and studies beside the experiments."""
