"""The table of gpu.sh: refinements and films on each device, time beside error."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np


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
        for file in sorted(folder.glob(f"{work}-*.json")):
            report, wall = json.loads(file.read_text()), file.with_suffix(".seconds").read_text().strip()
            each = report["seconds"] / max(report["steps"], 1)
            error = f"{report['before']:.5f} | {report['after']:.5f}"
            print(f"| refine, {work} | {file.stem.split('-')[1]} | {wall} | {report['steps']} | {each:.4f} | {error} |")
    films = sorted(folder.glob("film-*.mp4"))
    for film in films:
        print(f"| film | {film.stem[5:]} | {film.with_suffix('.seconds').read_text().strip()} | | | | |")
    if len(films) == 2:
        first, second = map(read_frames, films)
        difference = np.abs(first - second)
        print(f"\nThe films differ by {difference.mean():.3f} of 255 in the mean, {difference.max():.0f} at most.")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
