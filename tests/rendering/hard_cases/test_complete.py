"""The fifty hard cases by number; each has a test that is marked with its number."""

import re
from pathlib import Path

CASES = {
    1: "an empty scene",
    2: "a single Gaussian",
    3: "a centre on a cube's edge or corner",
    4: "a centre at a pole",
    5: "a centre on the seam at 180 degrees",
    6: "a centre at the camera or nearer than near",
    7: "crossing the near distance",
    8: "behind the camera",
    9: "the camera inside a Gaussian",
    10: "EWA: a mean outside the view",
    11: "coincident Gaussians",
    12: "distances that differ by a rounding",
    13: "order while the camera rotates or moves",
    14: "needles of 10000:1",
    15: "discs, lines and points",
    16: "far smaller than a pixel",
    17: "opacities at and beyond their limits",
    18: "saturation by a million Gaussians",
    19: "gradients at low transmittance",
    20: "alpha at its cuts",
    21: "quaternions of any length",
    22: "numbers that are not finite",
    23: "matrices that are not covariances",
    24: "any unit of length",
    25: "units of 1e18 and 1e-18",
    26: "half precision",
    27: "more intersections than 2^31",
    28: "odd sizes",
    29: "fewer Gaussians than tiles",
    30: "white furnace",
    31: "channels",
    32: "stitching at seams and corners",
    33: "deferred backpropagation",
    34: "spherical harmonics of degree 0 to 4",
    35: "a colour at 0",
    36: "threads and vector widths",
    37: "forks, threads, no gradients, second derivatives",
    38: "no baseline",
    39: "the epipole",
    40: "sampling over seam and poles",
    41: "near equals far, one candidate",
    42: "large logits in half precision",
    43: "rotated cameras",
    44: "depths of 1 : 10000",
    45: "blending at an input position",
    46: "blending inputs in one place",
    47: "blending far outside",
    48: "blending over holes",
    49: "blending where all views are empty",
    50: "the ends of the lattice",
}


def test_every_hard_case_has_a_test():
    assert sorted(CASES) == list(range(1, 51))
    tests = Path(__file__).resolve().parents[2]
    text = "".join(path.read_text(encoding="utf-8") for path in tests.rglob("test_*.py"))
    marked = {int(number) for number in re.findall(r"^@pytest\.mark\.hard_case\((\d+)\)", text, re.M)}
    assert marked >= set(CASES), f"no test is marked with {sorted(set(CASES) - marked)}"
    assert marked <= set(CASES)
