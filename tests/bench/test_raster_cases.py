"""The groups cover every choice and leave out cases that take too long."""

from dataclasses import replace

import pytest
import torch

from pansplat.bench.raster_cases import (
    BenchScene,
    RasterCase,
    Settings,
    list_choices,
    list_raster_groups,
    make_official_case,
    make_room_scene,
    make_sample_group,
)
from pansplat.bench.scenes import full_lattice_room

QUICK = Settings(height=512, quick=True, threads=2, backends=("numba",), memory=8e9)
FULL = replace(QUICK, quick=False)


def groups_of(settings: Settings, suite: str) -> list:
    return [group for group in list_raster_groups(settings, make_room_scene, synthetic=True) if group.suite == suite]


def cases_of(settings: Settings, suite: str) -> list[RasterCase]:
    return [case for group in groups_of(settings, suite) for case in group.cases]


@pytest.mark.parametrize(("settings", "height", "sizes"), [(QUICK, 192, (122,)), (FULL, 512, (256, 326, 512))])
def test_every_choice_of_the_fast_backend_is_measured(settings, height, sizes):
    assert settings.choice_height == height
    assert set(list_choices("numba", height, sizes, 2)) <= set(cases_of(settings, "choices"))


def test_all_choices_are_all_combinations():
    choices = list_choices("torch", 64, (32, 48), 1)
    assert len(set(choices)) == len(choices) == 2 + 2 * 8 + 2
    equirects = [case for case in choices if case.layout == "equirect"]
    assert [(case.kernel, case.order, case.filter) for case in equirects] == [
        ("ray", "radial", "angular"),
        ("ray", "radial", "3dgs"),
    ]


def test_sweeps_cover_the_papers_counts_and_heights():
    counts = [group.scene.name for group in groups_of(QUICK, "count")]
    assert counts[0] == "room 128" and counts[-1] == "room 512" and len(counts) == 5
    assert [case.height for case in cases_of(QUICK, "resolution") if case.backend == "numba"] == [128, 256, 512, 1024]
    assert {case.height for case in cases_of(QUICK, "count")} == {512}
    both = replace(QUICK, backends=("numba", "triton"))
    assert {case.backend for case in cases_of(both, "resolution") if case.height > 256} == {"numba", "triton"}


def test_scenes_that_do_not_fit_in_memory_are_left_out():
    heights = [group.cases[0].height for group in groups_of(replace(FULL, memory=1e9), "resolution")]
    assert heights == [128, 256, 512]


def test_slow_renderers_have_small_scenes():
    huge = replace(FULL, height=2048, memory=1e12)
    groups = list_raster_groups(huge, make_room_scene, synthetic=True)
    assert [group.references for group in groups if group.suite == "headline"] == ["none"]
    assert max(case.height for group in groups for case in group.cases if case.backend == "torch") <= 1024
    assert {case.height for case in cases_of(huge, "choices")} == {512}
    assert {case.height for case in cases_of(huge, "headline")} == {2048}


def test_other_scenes_are_thinned_out():
    gaussians = full_lattice_room(16)
    scene = BenchScene("mine", lambda: gaussians, torch.eye(4, dtype=torch.float64))
    groups = list_raster_groups(QUICK, lambda height: scene, synthetic=False)
    sizes = [len(group.scene.load()) for group in groups if group.suite == "count"]
    assert sizes == [-(-len(gaussians) // step) for step in (16, 8, 4, 2, 1)]


def test_without_a_fast_backend_torch_is_measured():
    alone = replace(QUICK, backends=())
    assert {case.backend for case in cases_of(alone, "count")} == {"torch"}
    assert {case.backend for case in make_sample_group(alone, make_room_scene(64)).cases} == {"torch"}


def test_official_choices():
    case = make_official_case("numba", 512, 2)
    choices = (case.kernel, case.order, case.filter, case.face_size, case.stitching)
    assert choices == ("ewa", "z", "3dgs", 256, "official")
    assert case.exact == RasterCase("torch", 512, precision="float64", backward=False)
