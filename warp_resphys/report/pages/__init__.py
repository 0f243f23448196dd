"""The pages of runs: trials, pictures, tests of specimens, and numbers of markers."""
