"""`warp-resphys film`, by the name of a script."""

from warp_resphys.cli import main

if __name__ == "__main__":
    main("film")
