"""Is it right, how fast is it, and what was published: checks, benchmarks and studies beside the experiments."""
