"""Refinement of a small scene with known photographs, and its guards."""

import dataclasses
import math

import pytest
import torch
from fake_card import CARD, pretend_card
from refusals import expect_error
from synthetic_scenes import make_balls

import pansplat
from pansplat import pipeline
from pansplat.errors import InputWarning
from pansplat.gaussians.scene import Gaussians, empty_gaussians
from pansplat.geometry.pose import invert_pose
from pansplat.refinement import RefineConfig, Refinement, fuse_views, refinement_fingerprint
from pansplat.refinement import refinement as module
from pansplat.refinement.budget import merge_to
from pansplat.refinement.parameters import LEARNING_RATES
from pansplat.rendering import rasterize
from pansplat.system.progress import show_progress


def _refine(room, steps: int, views=None, scene=None, **config):
    refinement = Refinement(scene or room.predicted, views or room.views, RefineConfig(**config))
    report = refinement.run(steps=steps)
    return refinement.scene(), report


def _photo_error(scene, views) -> float:
    """Mean absolute difference of the photographs and the images of their own Gaussians, where masks are white."""
    errors = [
        (
            rasterize(scene.gaussians.select(scene.gaussians.views == n), pose, size=tuple(mask.shape)).color - image
        ).abs()
        * mask
        for n, (pose, image, mask) in enumerate(zip(scene.cam2world, views.images, views.masks, strict=True))
        if (scene.gaussians.views == n).any()
    ]
    return float(torch.stack(errors).mean())


def _tensors(scene) -> list[torch.Tensor]:
    return list(vars(scene.gaussians).values())


def test_refinement_brings_the_image_between_the_cameras_near_the_truth(room) -> None:
    middle = room.truth.pose_between(0.5)
    refined, report = _refine(room, steps=60)
    assert room.error(refined, middle) < 0.5 * room.error(room.predicted, middle)
    assert report.after < 0.5 * report.before and report.steps <= 60
    assert torch.equal(refined.cam2world, room.predicted.cam2world)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize("joint", [False, True])
def test_a_refinement_without_gradients_of_the_caller_is_the_same(small_room, mode, joint: bool) -> None:
    def refine(scene, views):
        return pansplat.refine(fuse_views(scene) if joint else scene, views, steps=3)

    expected = refine(small_room.predicted, small_room.views)
    with mode():
        tensors = {name: value.clone() for name, value in vars(small_room.predicted.gaussians).items()}
        gaussians = dataclasses.replace(small_room.predicted.gaussians, **tensors)
        poses, images = small_room.views.cam2world.clone(), small_room.views.images.clone()
        views = dataclasses.replace(
            small_room.views, images=images, cam2world=poses, masks=small_room.views.masks.clone()
        )
        refined = refine(dataclasses.replace(small_room.predicted, gaussians=gaussians, cam2world=poses), views)
    assert all(torch.equal(a, b) for a, b in zip(_tensors(refined), _tensors(expected), strict=True))


def test_the_exposure_of_a_photograph_is_found(room) -> None:
    images = room.views.images.clone()
    images[1] = 0.8 * images[1]
    darker = room.predicted.gaussians.harmonics.clone()
    second = room.predicted.gaussians.views == 1
    darker[second] = 0.8 * (darker[second] + 0.5 / 0.28209479) - 0.5 / 0.28209479
    scene = dataclasses.replace(
        room.predicted, gaussians=dataclasses.replace(room.predicted.gaussians, harmonics=darker)
    )
    refined, _ = _refine(room, views=dataclasses.replace(room.views, images=images), scene=scene, steps=60)
    ratios = [b / a for a, b in zip(*refined.gains, strict=True)]
    assert ratios == pytest.approx([0.8] * 3, abs=0.03)


def test_pose_errors_are_corrected(room, monkeypatch) -> None:
    offset = torch.eye(4, dtype=torch.float64)
    angle = math.radians(0.8)
    offset[0, 0] = offset[2, 2] = math.cos(angle)
    offset[0, 2], offset[2, 0] = math.sin(angle), -math.sin(angle)
    poses = room.truth.cam2world.clone()
    poses[1] = poses[1] @ offset
    gaussians = room.truth.gaussians
    moved = Refinement(dataclasses.replace(room.truth), room.views)._cameras.move  # identity without corrections
    assert moved(gaussians, 0) is gaussians
    motion = poses[1] @ invert_pose(room.truth.cam2world[1])
    means = gaussians.means.double()
    means[gaussians.views == 1] = means[gaussians.views == 1] @ motion[:3, :3].T + motion[:3, 3]
    scene = dataclasses.replace(
        room.truth, cam2world=poses, gaussians=dataclasses.replace(gaussians, means=means.float())
    )
    views = dataclasses.replace(room.views, cam2world=poses)
    monkeypatch.setattr(module, "_POSE_PENALTY", 1.0)
    refined, _ = _refine(room, scene=scene, views=views, steps=150, poses=True)

    def relative_angle(pair: torch.Tensor) -> float:
        rotation = (invert_pose(pair[0]) @ pair[1])[:3, :3]
        return math.degrees(math.acos(min(1.0, float(rotation.trace() - 1) / 2)))

    assert relative_angle(refined.cam2world) < 0.4 * relative_angle(poses)
    fixed, _ = _refine(room, scene=scene, views=views, steps=2)
    assert torch.equal(fixed.cam2world, poses)


def test_a_scene_that_gets_worse_is_returned_unchanged(room, monkeypatch) -> None:
    for name, rate in {"distance": 1.0, "scale": 3.0, "color": 5.0}.items():
        monkeypatch.setitem(LEARNING_RATES, name, rate)
    kept, report = _refine(room, scene=room.truth, steps=6)
    assert report.stopped == "worse" and kept is room.truth
    kept, report = _refine(room, scene=room.truth, steps=6, gaussians=900)
    assert report.stopped == "worse" and len(kept.gaussians) <= 900


def test_what_parallax_shows_keeps_its_shape_and_nothing_becomes_much_more_opaque(room) -> None:
    offsets = room.predicted.gaussians.means - room.predicted.cam2world[room.predicted.gaussians.views, :3, 3].float()
    changes = []
    for baseline in (0.6, 6.0):  # metres; the photographs stay, and contradict the scene of the second
        poses = room.predicted.cam2world.clone()
        poses[:, :3, 3] *= baseline / 0.6
        means = offsets + poses[room.predicted.gaussians.views, :3, 3].float()
        given = dataclasses.replace(room.predicted.gaussians, means=means)
        scene = dataclasses.replace(room.predicted, gaussians=given, cam2world=poses, joint=True)
        refinement = Refinement(scene, dataclasses.replace(room.views, cam2world=poses), RefineConfig(splits=()))
        for step in range(20):
            refinement.step(step / 40)
        moved = refinement.scene().gaussians
        assert (moved.opacities.logit() <= given.opacities.logit() + 0.7 + 1e-3).all()
        distances = [(each.means - poses[given.views, :3, 3].float()).norm(dim=1) for each in (moved, given)]
        changes.append(float((distances[0] / distances[1]).log().abs().max()))
    assert changes[1] < 0.003 < changes[0] < 0.11


def test_what_is_in_neither_photograph_is_an_error_of_pictures_between_them(room, monkeypatch) -> None:
    joint, middle = fuse_views(room.truth), room.truth.pose_between(0.5)
    ball = make_balls(middle[:3, 3].float() + torch.tensor([[0.0, 0.0, 0.5]]), 0.15)
    refinement = Refinement(joint, room.views)
    given = refinement.half_way_error()
    monkeypatch.setattr(Refinement, "_build", lambda self, layer: Gaussians.cat([joint.gaussians, ball]))
    assert refinement.half_way_error() > module._MAX_ERROR_RATIO * given
    masks = torch.zeros_like(room.views.masks)
    assert Refinement(joint, dataclasses.replace(room.views, masks=masks)).half_way_error() == 0


@pytest.mark.parametrize(
    ("errors", "kept"),
    [((5, 4, 4.1, 3, 3.1), 8), ((5, 4, 3, 3.5, 3.6), 4), ((5, 4, 4.3, 3, 3.5), 6), ((5, 6, 5.8, 7, 6), 0)],
)
def test_the_last_state_is_kept_whose_pictures_between_the_cameras_are_as_good_as_the_best(
    small_room, monkeypatch, errors: tuple[float, ...], kept: int
) -> None:
    monkeypatch.setattr(module, "drop_unseen", lambda scene, *_: scene)
    monkeypatch.setattr(Refinement, "_finish", lambda self, scene: scene)
    states, remaining = [small_room.predicted], iter(errors)

    def judge(refinement: Refinement) -> float:
        states.append(refinement.scene())
        return next(remaining)

    monkeypatch.setattr(Refinement, "half_way_error", judge)
    refinement = Refinement(small_room.predicted, small_room.views)
    report = refinement.run(steps=8)
    assert (report.steps, report.kept, report.stopped) == (8, kept, "done" if kept else "torn")
    expected = states[1 + kept // 2] if kept else small_room.predicted
    assert all(torch.equal(a, b) for a, b in zip(_tensors(refinement.scene()), _tensors(expected), strict=True))


def test_a_scene_whose_pictures_would_be_torn_is_left_as_it_is_and_that_is_said(room, monkeypatch) -> None:
    monkeypatch.setattr(module, "_MAX_ERROR_RATIO", 0.0)
    with pytest.warns(InputWarning, match="left, right: not refined"):
        kept = pansplat.refine(room.predicted, room.views, steps=4)
    assert all(torch.equal(a, b) for a, b in zip(_tensors(kept), _tensors(room.predicted), strict=True))


def test_a_run_is_judged_before_it_fits_the_held_out_blocks(room, monkeypatch: pytest.MonkeyPatch) -> None:
    refinement, fractions = Refinement(room.predicted, room.views), []
    errors = iter((1.0, 2.0, 0.1))  # worse, until the blocks are fitted
    monkeypatch.setattr(refinement, "held_out_error", lambda: next(errors))
    monkeypatch.setattr(refinement, "step", fractions.append)
    report = refinement.run(steps=8)
    assert (report.stopped, report.before, report.after) == ("worse", 1.0, 2.0)
    assert refinement.scene() is room.predicted and report.steps == len(fractions) == 6
    assert max(fractions) < module._RELEASE_AT


def test_a_stagnating_run_ends_early_with_its_last_part(small_room) -> None:
    _, report = _refine(small_room, steps=2000)
    assert report.stopped == "converged" and report.steps < 1500


def test_a_run_can_be_stopped_at_any_step_and_keeps_its_state(room) -> None:
    refinement = Refinement(room.predicted, room.views)
    report = refinement.run(steps=1000, should_stop=lambda: refinement._steps >= 9)
    assert (report.steps, report.stopped) == (9, "interrupted")
    middle = room.truth.pose_between(0.5)
    assert room.error(refinement.scene(), middle) < room.error(room.predicted, middle)


@pytest.mark.usefixtures("refinement_clock")
def test_a_time_limit_ends_the_run_and_is_said_and_progress_grows(room) -> None:
    fractions: list[float] = []
    with show_progress(lambda what, fraction: fractions.append(fraction)):
        report = Refinement(room.predicted, room.views).run(steps=1000, seconds=0.2)
    assert report.stopped == "time limit" and 0 < report.steps < 1000
    assert fractions == sorted(fractions) and fractions[-1] == 1
    with pytest.warns(InputWarning, match=r"ended after \d+ steps, at its limit of 0.2 s"):
        pansplat.refine(room.predicted, room.views, steps=1000, seconds=0.2)


def test_a_scene_is_compared_at_the_rows_of_a_display(room, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pansplat.refinement.refinement._CONTRIBUTION_HEIGHT", 8)
    errors = []
    for rows in (8, 32):
        monkeypatch.setattr("pansplat.refinement.refinement.DISPLAY_HEIGHT", rows)
        refined, _ = _refine(room, steps=20, gaussians=800)
        errors.append(room.error(refined, room.truth.cam2world[0]))
    assert errors[1] < 0.8 * errors[0]


@pytest.mark.usefixtures("any_state")
def test_a_coarse_scene_is_split_within_its_limit_and_explains_the_photographs_better(room) -> None:
    coarse = merge_to(room.predicted, room.views.images.shape[-2:], 160)
    plain, _ = _refine(room, steps=24, scene=coarse, splits=())
    split, _ = _refine(room, steps=24, scene=coarse)
    limited, _ = _refine(room, steps=10, scene=coarse, gaussians=200)
    assert len(plain.gaussians) <= 160 < len(limited.gaussians) <= 200 < len(split.gaussians)
    for pose in (room.truth.pose_between(0.5), *room.truth.cam2world):
        assert room.error(split, pose) < 0.95 * room.error(plain, pose)


def test_masked_pixels_have_no_effect(room) -> None:
    masks = room.views.masks.clone()
    masks[:, 24:] = False
    spoiled = room.views.images.clone()
    spoiled[:, :, 24:] = torch.rand(2, 3, 8, 64, generator=torch.Generator().manual_seed(0))
    results = [
        _refine(room, steps=4, views=dataclasses.replace(room.views, images=images, masks=masks))[0]
        for images in (room.views.images, spoiled)
    ]
    assert all(torch.equal(a, b) for a, b in zip(*(_tensors(result) for result in results), strict=True))


@pytest.mark.parametrize("case", ["all masked", "one color", "one place", "one view", "three views"])
def test_degenerate_scenes_stay_finite_and_are_not_worse(small_room, case: str) -> None:
    scene, views = small_room.predicted, small_room.views
    if case == "all masked":
        views = dataclasses.replace(views, masks=torch.zeros_like(views.masks))
    elif case == "one color":
        views = dataclasses.replace(views, images=torch.full_like(views.images, 0.4))
    elif case == "one place":
        poses = views.cam2world[:1].repeat(2, 1, 1)
        scene, views = dataclasses.replace(scene, cam2world=poses), dataclasses.replace(views, cam2world=poses)
    elif case == "one view":
        first = scene.gaussians.select(scene.gaussians.views == 0)
        scene = dataclasses.replace(scene, gaussians=first)
    else:
        poses = torch.cat((views.cam2world, views.cam2world[:1]))
        scene = dataclasses.replace(scene, cam2world=poses)
        views = dataclasses.replace(
            views,
            images=torch.cat((views.images, views.images[:1])),
            masks=torch.cat((views.masks, views.masks[:1])),
            cam2world=poses,
        )
    refined, _ = _refine(small_room, scene=scene, views=views, steps=6)
    assert all(torch.isfinite(t).all() for t in _tensors(refined))
    assert _photo_error(refined, views) <= 1.001 * _photo_error(scene, views)


def test_an_empty_scene_is_returned(room) -> None:
    empty = dataclasses.replace(room.predicted, gaussians=empty_gaussians())
    refined, report = _refine(room, scene=empty, steps=5)
    assert len(refined.gaussians) == 0 and report.steps == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s, v: (dataclasses.replace(s, cam2world=s.cam2world[:0]), v), "no input cameras"),
        (lambda s, v: (s, dataclasses.replace(v, images=v.images[:1])), "needs its 2 photographs"),
        (lambda s, v: (s, dataclasses.replace(v, images=v.images * math.nan)), "finite images"),
        (lambda s, v: (s, dataclasses.replace(v, cam2world=v.cam2world + 0.1)), "differ by up to 0.1"),
    ],
)
def test_photographs_that_do_not_fit_are_refused(room, change, message: str) -> None:
    scene, views = change(room.predicted, room.views)
    expect_error(message, Refinement, scene, views)


@pytest.mark.parametrize("limits", [{"seconds": 0.0, "steps": 1}, {"steps": 0}, {"seconds": math.nan, "steps": 1}])
def test_invalid_limits_are_refused(room, limits: dict) -> None:
    expect_error("of a refinement", lambda: Refinement(room.predicted, room.views).run(**limits))
    expect_error("`gaussians` must be at least 1", RefineConfig, gaussians=0)


def test_the_fingerprint_depends_on_the_settings() -> None:
    assert refinement_fingerprint() == refinement_fingerprint(RefineConfig())
    assert refinement_fingerprint() != refinement_fingerprint(RefineConfig(poses=True))


@pytest.mark.parametrize("joint", [False, True])
def test_a_step_on_a_card_moves_nothing_between_card_and_memory(small_room, joint: bool) -> None:
    scene = fuse_views(small_room.predicted) if joint else small_room.predicted
    refinements = []
    for device in (torch.device("cpu"), CARD):
        with pretend_card() as count:
            moved = dataclasses.replace(scene, gaussians=scene.gaussians.to(device=device))
            refinement = Refinement(moved, small_room.views, RefineConfig())
            for step in range(3):  # the third step splits Gaussians
                if step == 1:  # the first one finds out which Gaussians a photograph shows
                    count.clear()
                refinement.step(step / 6)
            assert {name for name in count if count[name]} <= {"reads", "constants"}
            refinements.append((refinement.held_out_error(), len(refinement.scene().gaussians)))
    (expected, number), (got, number_on_card) = refinements
    assert got == pytest.approx(expected, rel=0.02) and number_on_card == pytest.approx(number, rel=0.02)


@pytest.fixture
def only_card(monkeypatch: pytest.MonkeyPatch):
    """All work is that of a pretended card."""
    for part in (pipeline.prediction, pipeline.drawing):
        monkeypatch.setattr(part, "choose_device", lambda *_, **__: CARD)
    monkeypatch.setattr(module, "_NUM_STATES", 1)
    monkeypatch.setattr("pansplat.rendering.color_fit._STEPS", 1)
    with pretend_card() as count:
        yield count


@pytest.mark.parametrize("joint", [False, True])
def test_what_a_card_has_refined_and_drawn_is_in_main_memory(small_room, only_card, joint: bool) -> None:
    scene, pose = (
        fuse_views(small_room.predicted) if joint else small_room.predicted,
        small_room.truth.pose_between(0.5),
    )
    refined = pansplat.refine(scene, small_room.views, steps=3)
    drawn = pipeline.make_renderer(refined, "image", 1, size=(8, 16))(pose)
    assert only_card["copies"] and not any("mixed" in name for name in only_card if only_card[name])
    assert {tensor.device.type for tensor in (*_tensors(refined), drawn.color, drawn.alpha, drawn.depth)} == {"cpu"}
    expected = pipeline.render(refined, pose, size=(8, 16))
    assert torch.allclose(drawn.color, expected.color, atol=1e-4)
    assert small_room.error(refined, pose) < small_room.error(scene, pose)


@pytest.mark.usefixtures("only_card")
def test_a_refinement_that_a_card_has_no_memory_for_is_the_processors(small_room, monkeypatch) -> None:
    def refuse(scene, *arguments, **options):
        if scene.gaussians.means.device == CARD:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return Refinement(scene, *arguments, **options)

    monkeypatch.setattr(pipeline.prediction, "Refinement", refuse)
    with pytest.warns(InputWarning, match="refinement: the graphics card has too little memory; it runs on the proces"):
        refined = pansplat.refine(small_room.predicted, small_room.views, steps=2)
    expected = _refine(small_room, steps=2)[0]
    assert all(torch.equal(a, b) for a, b in zip(_tensors(refined), _tensors(expected), strict=True))
    moved = dataclasses.replace(small_room.predicted, gaussians=small_room.predicted.gaussians.to(device=CARD))
    with pytest.raises(torch.cuda.OutOfMemoryError):
        pansplat.refine(moved, small_room.views, steps=2)


def test_an_image_that_a_card_has_no_memory_for_is_the_processors(small_room, only_card, monkeypatch) -> None:
    pose, render = small_room.truth.pose_between(0.5), pipeline.render

    def draw(scene, pose, **options):
        if scene.gaussians.means.device == CARD:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return render(scene, pose, **options)

    monkeypatch.setattr(pipeline.drawing, "render", draw)
    renderer = pipeline.make_renderer(small_room.truth, "film", 1, size=(8, 16))
    with pytest.warns(InputWarning, match="film: the graphics card has too little memory; it runs on the processor"):
        first = renderer(pose)
    assert torch.equal(first.color, renderer(pose).color), "the second one without a note"
