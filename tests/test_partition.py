"""Whose pixels are whose, against the labels of people cast one by one."""

import pytest
import torch
from torch import Tensor

from torchpose.body.model import BodyModel, PosedBody
from torchpose.body.superquadric import DisplayModel, Person, draw_person
from torchpose.synthesis.depth import Scene, cast_depth
from torchpose.tracking.partition import PartitionConfig, split_people
from torchpose.vision.camera import StereoCamera

BODY = BodyModel()
CAMERA = StereoCamera(320, 240, 300.0, 159.3, 119.7, 0.12, 10.0)
PEOPLE = (draw_person(3), draw_person(8))


def standing(person: Person, x: float, z: float) -> PosedBody:
    """Somebody at ease, m."""
    pose = torch.cat([torch.tensor([[x, 0.15, z, 0.3, 0.0, 0.0]]), BODY.rest[None]], 1)
    return BODY(pose, person.size(BODY))


def scene(*places: tuple[float, float]) -> tuple[Tensor, Tensor, list[PosedBody]]:
    """Depth and the true number of each pixel (0: nobody), with the bodies."""
    bodies = [standing(person, *place) for person, place in zip(PEOPLE, places, strict=False)]
    displays = [DisplayModel(BODY, person) for person in PEOPLE[: len(bodies)]]
    frames = cast_depth(displays, bodies, CAMERA, Scene(1.1, 6.0))
    return frames.depth[0], frames.people[0], bodies


def together(bodies: list[PosedBody]) -> PosedBody:
    names = PosedBody.__dataclass_fields__
    return PosedBody(**{name: torch.cat([getattr(body, name) for body in bodies]) for name in names})


def overlap(mask: Tensor, truth: Tensor) -> float:
    return float((mask & truth).sum() / (mask | truth).sum())


@pytest.mark.parametrize("apart", [0.9, 0.35, 0.0])
def test_people_who_overlap_are_split_where_the_nearer_one_hides_the_other(apart: float):
    depth, true, bodies = scene((-apart / 2, 3.0), (apart / 2, 3.9))
    masks = split_people(true > 0, depth, CAMERA, together(bodies))
    assert len(masks) == 2
    assert not (masks[0] & masks[1]).any()
    for k in (0, 1):
        assert overlap(masks[k], true == k + 1) > (0.95 if int((true == k + 1).sum()) > 1000 else 0.5)


def test_people_side_by_side_at_one_depth_are_split_between_their_bodies():
    """Their arms touch in the image: no jump of depth parts them, only where each should be."""
    depth, true, bodies = scene((-0.24, 3.3), (0.24, 3.3))
    for k, mask in enumerate(split_people(true > 0, depth, CAMERA, together(bodies))):
        assert overlap(mask, true == k + 1) > 0.93


def test_somebody_who_moved_on_keeps_all_of_the_body():
    """What is expected lags 15 cm behind; a limb that is further is a piece with the rest."""
    depth, true, _ = scene((0.0, 3.2))
    late = standing(PEOPLE[0], -0.15, 3.25)
    mask = split_people(true > 0, depth, CAMERA, late)[0]
    assert overlap(mask, true == 1) > 0.97


def test_newcomers_are_as_large_as_people_and_the_largest_comes_first():
    depth, true, bodies = scene((-0.6, 4.5), (0.6, 3.0))
    wall = torch.zeros_like(true)
    wall[20:40, 20:45] = 3  # a picture that fell: a tenth of a square metre, but not tall
    silhouette = (true > 0) | (wall > 0)
    depth = torch.where(wall > 0, 3.0, depth)
    masks = split_people(silhouette, depth, CAMERA, None)
    assert len(masks) == 2
    assert overlap(masks[0], true == 2) > 0.97
    assert overlap(masks[1], true == 1) > 0.97
    beside = split_people(silhouette, depth, CAMERA, bodies[0])
    assert len(beside) == 2
    assert overlap(beside[0], true == 1) > 0.97
    assert overlap(beside[1], true == 2) > 0.97
    assert not (beside.any(0) & (wall > 0)).any()


def test_pixels_without_depth_follow_their_neighbours():
    depth, true, bodies = scene((-0.5, 3.0), (0.5, 3.6))
    holes = torch.rand(depth.shape, generator=torch.Generator().manual_seed(1)) < 0.3
    masks = split_people(true > 0, depth.masked_fill(holes, torch.nan), CAMERA, together(bodies))
    for k in (0, 1):
        assert overlap(masks[k], true == k + 1) > 0.95


def test_an_empty_silhouette_and_one_without_depth_are_nobody_s():
    depth, true, bodies = scene((-0.5, 3.0), (0.5, 3.6))
    for silhouette, z in ((true < 0, depth), (true > 0, torch.full_like(depth, torch.nan))):
        assert split_people(silhouette, z, CAMERA, together(bodies)).sum(dim=(1, 2)).tolist() == [0, 0]
        assert split_people(silhouette, z, CAMERA, None).shape == (0, 240, 320)


def test_wrong_settings_are_one_sentence():
    with pytest.raises(ValueError, match="stride must be at least 1 px, got 0"):
        PartitionConfig(stride=0)
    with pytest.raises(ValueError, match="jump must be positive, got 0"):
        PartitionConfig(jump=0.0)
    with pytest.raises(ValueError, match=r"clear_share must be a share in \[0, 1\], got 2"):
        PartitionConfig(clear_share=2.0)


def pieces(*boxes: tuple[int, int, int, int, float]) -> Tensor:
    """Depth of flat boxes (top, bottom, left, right, m) before nothing."""
    depth = torch.full((240, 320), torch.nan)
    for top, bottom, left, right, z in boxes:
        depth[top:bottom, left:right] = z
    return depth


def test_a_newcomer_whose_arm_parts_trunk_and_legs_is_one_person():
    """The trunk, and the legs a quarter of a metre behind it, 90 cm of each; beside them another person."""
    trunk, legs, other = (40, 110, 20, 60, 3.5), (110, 190, 25, 58, 3.78), (50, 190, 220, 260, 3.5)
    depth = pieces(trunk, legs, other)
    masks = split_people(depth > 0, depth, CAMERA, None)
    assert len(masks) == 2
    assert {bool(mask[60, 40]) for mask in masks} == {True, False}
    for mask in masks:
        assert bool(mask[60, 40]) == bool(mask[150, 40]) != bool(mask[100, 240])


def test_one_behind_the_other_are_two_newcomers():
    depth = pieces((40, 190, 100, 140, 3.2), (40, 190, 140, 175, 4.2))
    masks = split_people(depth > 0, depth, CAMERA, None)
    assert len(masks) == 2
    assert not (masks[0] & masks[1]).any()
