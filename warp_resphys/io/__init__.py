"""Files, stages and workers: safe files, resumable work, progress, work for several processes or a cluster.

From outside: `errors`, `files`, `resumable.ResumableHDF5`, `stages.run_stages`, `progress.Progress`.
"""
