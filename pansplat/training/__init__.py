"""Training. Not here yet: `pansplat-train` says what will come."""

import sys


def main() -> None:
    """Say that training comes with a later release, and exit with status 1."""
    print(
        "pansplat-train: training the network is not part of this release; it comes with a later one.\n"
        "What works today needs no trained weights: `pansplat predict PAIR -o scene.ply --model sweep`.",
        file=sys.stderr,
    )
    sys.exit(1)
