"""Files, stages and processes: safe files, resumable work, progress, several processes.

From outside: `errors`, `files`, `resumable.ResumableHDF5`, `stages.run_stages`, `progress.Progress`.
"""
