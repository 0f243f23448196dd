"""The film of the README, docs/segment.webp: a real pneumatic segment
at a pressure beyond those of its training.

`docs/recordings.md` says how recordings/segment is made from the published file.

    warp-resphys experiment=segment_real data.folder=recordings/segment \
        'data.validation=[segment_175,segment_275]' \
        'data.train=[segment_050,segment_100,segment_125,segment_200,segment_250]' \
        'data.test=[segment_325,segment_350,segment_400]'
    python scripts/readme_film.py RUN
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import imageio_ffmpeg

FILM = Path(__file__).parents[1] / "docs" / "segment.webp"
TRIAL = "segment_350"
FRAMES_PER_SECOND = 12
WIDTH = 1000  # pixels

if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("name the run: python scripts/readme_film.py RUN [OUTPUT.webp]")
    output = sys.argv[2] if len(sys.argv) > 2 else str(FILM)
    with TemporaryDirectory() as folder:
        film = f"{folder}/film.mp4"
        view = [
            sys.executable,
            "-m",
            "warp_resphys",
            "view",
            "film",
            sys.argv[1],
            f"trial={TRIAL}",
            f"file={film}",
        ]
        subprocess.run(view, check=True)
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-i", film]
        shape = ["-vf", f"fps={FRAMES_PER_SECOND},scale={WIDTH}:-2", "-loop", "0", "-quality", "70"]
        subprocess.run([*command, *shape, output], check=True)
