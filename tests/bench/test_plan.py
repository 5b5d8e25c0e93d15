"""A plan asks for every choice, and for no more than the machine can bear."""

from dataclasses import replace

import pytest
import torch

from pansplat.bench.cases import Case, choices, official
from pansplat.bench.plan import Settings, groups, of_scene, room, sample_groups
from pansplat.bench.scenes import full_lattice_room

QUICK = Settings(height=512, quick=True, threads=2, backends=("numba",), memory=8e9)
FULL = replace(QUICK, quick=False)


def cases(settings: Settings, suite: str) -> list[Case]:
    return [case for group in groups(settings, room, synthetic=True) if group.suite == suite for case in group.cases]


@pytest.mark.parametrize(("settings", "sizes"), [(QUICK, (122,)), (FULL, (256, 326, 512))])
def test_every_choice_of_the_fast_backend_is_measured(settings, sizes):
    found = {
        (c.kernel, c.order, c.filter, c.face_size)
        for c in cases(settings, "choices")
        if (c.backend, c.layout, c.stitching) == ("numba", "cubemap", "seamless")
    }
    assert settings.choice_height == (192 if settings.quick else 512)
    for size in sizes:
        for kernel in ("ray", "ewa"):
            for order in ("radial", "z"):
                for lowpass in ("angular", "3dgs"):
                    assert (kernel, order, lowpass, size) in found


def test_the_classic_kernel_is_never_asked_for_on_a_direct_panorama():
    assert not [c for c in cases(FULL, "choices") if c.layout == "equirect" and c.kernel == "ewa"]


def test_sweeps_cover_the_papers_counts_and_heights():
    found = groups(QUICK, room, synthetic=True)
    counts = [group.subject.name for group in found if group.suite == "count"]
    assert counts[0] == "room 128" and counts[-1] == "room 512" and len(counts) == 5
    assert [group.cases[0].height for group in found if group.suite == "resolution"] == [128, 256, 512, 1024]
    assert {c.height for c in cases(QUICK, "count")} == {512}


def test_scenes_that_do_not_fit_are_left_out():
    small = replace(FULL, memory=1e9)
    heights = [group.cases[0].height for group in groups(small, room, synthetic=True) if group.suite == "resolution"]
    assert heights == [128, 256, 512]


def test_the_dense_peer_gets_a_scene_it_can_bear():
    dense = [c for c in cases(QUICK, "dense") if c.backend == "dense"]
    assert [c.height for c in dense] == [64]
    assert not [
        c for g in groups(FULL, room, synthetic=True) for c in g.cases if c.backend == "dense" and c.height > 64
    ]


def test_nothing_asks_the_reference_for_more_than_it_can_bear():
    huge = replace(FULL, height=2048, memory=1e12)
    found = groups(huge, room, synthetic=True)
    assert [group.truths for group in found if group.suite == "headline"] == ["none"]
    assert max(c.height for group in found for c in group.cases if c.backend == "torch") <= 1024
    assert {c.height for c in cases(huge, "choices")} == {512}
    assert {c.height for c in cases(huge, "headline")} == {2048}


def test_sweeps_are_about_all_fast_backends():
    both = replace(QUICK, backends=("numba", "triton", "gsplat"))
    assert {c.backend for c in cases(both, "resolution") if c.height > 256} == {"numba", "triton"}


def test_a_scene_from_elsewhere_is_thinned_out():
    gaussians = full_lattice_room(16)
    subject = of_scene("mine", lambda: gaussians, torch.eye(4, dtype=torch.float64))
    found = groups(QUICK, subject, synthetic=False)
    assert not [group for group in found if group.suite == "dense"]
    sizes = [len(group.subject.load()) for group in found if group.suite == "count"]
    assert sizes == [-(-len(gaussians) // part) for part in (16, 8, 4, 2, 1)]


def test_without_a_fast_backend_torch_is_measured():
    alone = replace(QUICK, backends=())
    assert {c.backend for c in cases(alone, "count")} == {"torch"}
    assert [c for g in sample_groups(alone, room(64)) for c in g.cases]


def test_gsplat_is_asked_for_nothing_but_its_own_choices():
    drawn = [c for c in cases(replace(QUICK, backends=("numba", "gsplat")), "choices") if c.backend == "gsplat"]
    assert drawn and all((c.layout, c.kernel, c.order) == ("cubemap", "ewa", "z") for c in drawn)


def test_the_originals_choices_are_its_own():
    case = official("numba", 512, 2)
    assert (case.kernel, case.order, case.filter, case.face_size, case.stitching) == (
        "ewa",
        "z",
        "3dgs",
        256,
        "official",
    )
    assert case.exact == Case("torch", 512, precision="float64", backward=False)


def test_choices_of_a_panorama_have_one_order():
    direct = [c for c in choices("torch", 64, (32,), 1) if c.layout == "equirect"]
    assert [(c.order, c.filter) for c in direct] == [("radial", "angular"), ("radial", "3dgs")]
