"""The table of gpu.sh: refinements and films on each device, time beside error."""

import re
import sys
from pathlib import Path

import cv2
import numpy as np

_REPORT = r"(?m)^(\d+) steps in ([\d.]+) s.* error of .* pixels ([\d.]+) before, ([\d.]+) after$"
"""What `pansplat refine` prints."""


def read_frames(file: Path) -> np.ndarray:
    """All frames of a film (n, h, w, 3), 8 bits."""
    film, frames = cv2.VideoCapture(str(file)), []
    while (read := film.read())[0]:
        frames.append(read[1])
    return np.stack(frames).astype(np.float32)


def main(folder: Path) -> None:
    """Print the table of what a folder has."""
    print("| work | device | wall s | steps | s per step | error before | after |\n|---|---|---:|---:|---:|---:|---:|")
    for work in ("steps", "seconds"):
        for file in sorted(folder.glob(f"{work}-*.log")):
            wall = file.with_suffix(".seconds").read_text().strip()
            for steps, seconds, before, after in re.findall(_REPORT, file.read_text())[-1:]:
                row = f"{wall} | {steps} | {float(seconds) / max(int(steps), 1):.4f} | {before} | {after}"
                print(f"| refine, {work} | {file.stem.split('-')[1]} | {row} |")
    films = sorted(folder.glob("film-*.mp4"))
    for film in films:
        print(f"| film | {film.stem[5:]} | {film.with_suffix('.seconds').read_text().strip()} | | | | |")
    if len(films) == 2:
        first, second = map(read_frames, films)
        difference = np.abs(first - second)
        print(f"\nThe films differ by {difference.mean():.3f} of 255 in the mean, {difference.max():.0f} at most.")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
