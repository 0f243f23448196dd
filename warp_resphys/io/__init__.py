"""Files, stages and workers: safe files, resumable work, progress,
and worker processes here or on a cluster.
"""
