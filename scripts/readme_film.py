"""The film of the README, docs/beam.webp, from one that `warp-resphys view film` has made.

warp-resphys && warp-resphys view film runs/beam_oscillation/default
python scripts/readme_film.py runs/beam_oscillation/default/films/TRIAL.mp4
"""

import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg

FILM = Path(__file__).parents[1] / "docs" / "beam.webp"
FRAMES_PER_SECOND = 15
WIDTH = 840  # pixels

if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("name the film: python scripts/readme_film.py FILM.mp4 [OUTPUT.webp]")
    output = sys.argv[2] if len(sys.argv) > 2 else str(FILM)
    shape = f"fps={FRAMES_PER_SECOND},scale={WIDTH}:-2"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-i", sys.argv[1], "-vf", shape]
    subprocess.run([*command, "-loop", "0", "-quality", "70", output], check=True)
