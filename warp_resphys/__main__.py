"""`python -m warp_resphys` runs `warp-resphys`, also where its script is not on the path."""

from .cli import main

main()
