"""`python -m warp_resphys` is `warp-resphys`, where the environment's commands are not on the path."""

from .cli import main

main()
