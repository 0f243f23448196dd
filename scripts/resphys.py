"""Any command from a copy of the repository: `python scripts/resphys.py benchmark` is `warp-resphys benchmark`."""

from warp_resphys.cli import main

if __name__ == "__main__":
    main()
