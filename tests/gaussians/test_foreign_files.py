"""Files in the layout of other tools are read right side up."""

from pathlib import Path

import torch

from pansplat.gaussians.formats import load_scene

FILE = Path(__file__).with_name("supersplat.compressed.ply")
"""Three Gaussians as serializePlyCompressed of SuperSplat writes them (src/splat-serialize.ts): y is down."""


def test_a_compressed_ply_of_supersplat_has_its_values_and_is_upright() -> None:
    scene = load_scene(FILE)
    found, order = scene.gaussians, scene.gaussians.means[:, 1].argsort()
    assert found.degree == 3 and len(scene.cam2world) == 0

    def check(name: str, expected: list, tolerance: float) -> None:
        assert torch.allclose(getattr(found, name)[order], torch.tensor(expected), rtol=0, atol=tolerance), name

    check("means", [[0.0, -2, 0], [1.5, 0, 1], [0, 2, 0.5]], 4e-3)
    check("scales", [[0.1, 0.2, 0.3], [0.2, 0.2, 0.2], [0.4, 0.2, 0.1]], 1e-3)
    check("quats", [[1.0, 0, 0, 0], [0.1195, 0.8367, -0.2390, 0.4781], [0.5, -0.5, 0.5, 0.5]], 1e-3)
    check("opacities", [0.9, 0.5, 0.7], 4e-3)
    harmonics = 0.1 * torch.sin(torch.arange(144.0).reshape(3, 16, 3))
    harmonics[:, 0] = torch.tensor([[-1.6, -1.6, 1.6], [1.6, -1.6, -1.6], [0, 0, 0]])  # blue is above, red is below
    check("harmonics", harmonics[[0, 2, 1]].tolist(), 0.036)
