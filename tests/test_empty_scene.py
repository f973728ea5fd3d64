"""The scene behind people who move: known rooms in disparity, and a rendered recording without its empty frames."""

import pytest
import torch
from torch.testing import assert_close

from torchpose.vision.camera import StereoCamera
from torchpose.vision.disparity import Disparity, StereoMatcher
from torchpose.vision.empty_scene import (
    EmptySceneConfig,
    continue_rows,
    find_people,
    learn_empty_scene,
    room_planes,
    stands_in_background,
)

HEIGHT, WIDTH = 120, 160
CAMERA = StereoCamera(WIDTH, HEIGHT, 180.0, 80.0, 60.0, 0.12)  # f b = 21.6 px m
CONFIG = EmptySceneConfig(shrink=1, least_moved=20)


def room(noise=0.0):
    """Disparity of a wall at 4.5 m and of a floor that comes nearer from row 80 on."""
    rows = torch.arange(HEIGHT, dtype=torch.float32)[:, None].expand(HEIGHT, WIDTH)
    return torch.maximum(torch.full_like(rows, 4.8), 4.8 + 0.1 * (rows - 80)) + noise * torch.randn(
        HEIGHT, WIDTH
    )


def rectangle(top, left, height, width):
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[top : top + height, left : left + width] = True
    return mask


def person(frame):
    """A trunk and legs that stay and an arm that is raised: pixels, and disparity (px) at about 2.2 m."""
    arm = rectangle(20 + 8 * frame, 92, 9, 30)
    return rectangle(15, 70, 84, 22) | arm, 9.8 + 0.01 * torch.arange(WIDTH).expand(HEIGHT, WIDTH)


def frames(count=7, noise=0.05):
    masks, disparity = [], []
    for frame in range(count):
        mask, near = person(frame)
        masks.append(mask)
        disparity.append(torch.where(mask, near, room()) + noise * torch.randn(HEIGHT, WIDTH))
    return torch.stack(masks), torch.stack(disparity)


def test_planes_of_the_room_are_found_and_the_person_is_none():
    _, disparity = frames()
    planes = room_planes(disparity.nanquantile(0.2, dim=0), CONFIG)
    assert len(planes) == 2
    assert_close(planes[0], torch.full((HEIGHT, WIDTH), 4.8), atol=0.15, rtol=0)
    rows = torch.arange(HEIGHT, dtype=torch.float32)[:, None].expand(HEIGHT, WIDTH)
    assert_close(planes[1], 4.8 + 0.1 * (rows - 80), atol=0.3, rtol=0)
    assert room_planes(torch.full((HEIGHT, WIDTH), torch.nan), CONFIG) == []


def test_still_parts_hang_together_with_the_moving_arm_and_furniture_does_not():
    masks, disparity = frames()
    cupboard = rectangle(40, 10, 60, 30)  # at the person's own depth, apart from them
    disparity[:, cupboard] = 10.0
    found = find_people(disparity, CAMERA, CONFIG)
    for k in range(len(masks)):
        assert found[k][masks[k]].float().mean() > 0.98
        assert not found[k][cupboard].any()
        assert found[k].sum() < 1.6 * masks[k].sum()  # the margin of 1 + 2 px around a thin arm


def test_who_walks_through_is_found_in_every_frame():
    masks = torch.stack([rectangle(25, 10 + 18 * k, 75, 20) for k in range(7)])
    disparity = torch.where(masks, 9.0, room()) + 0.05 * torch.randn(7, HEIGHT, WIDTH)
    disparity[:, ::11] = torch.nan
    found = find_people(disparity, CAMERA, CONFIG)
    for k in range(7):
        assert found[k][masks[k]].float().mean() > 0.97
        assert found[k].sum() < 1.4 * masks[k].sum()


def test_where_nobody_moves_it_warns_and_guesses_the_tallest_of_a_person_s_height():
    standing, low = rectangle(15, 70, 84, 22), rectangle(70, 10, 35, 40)
    disparity = torch.where(standing, 9.8, torch.where(low, 10.0, room())) + 0.03 * torch.randn(
        5, HEIGHT, WIDTH
    )
    with pytest.warns(UserWarning, match="nobody moves in this recording"):
        found = find_people(disparity, CAMERA, CONFIG)
    assert found[:, standing].float().mean() > 0.98
    assert not found[:, low].any()
    with pytest.warns(UserWarning, match="empty frame|empty scene"):
        assert not find_people(room(0.03).expand(3, -1, -1), CAMERA, CONFIG).any()


def test_hidden_pixels_take_the_farther_side_of_their_row():
    disparity = torch.tensor([[5.0, 9.0, 9.0, 3.0], [9.0, 4.0, 9.0, 9.0], [9.0, 9.0, 9.0, 9.0]])
    seen = torch.tensor([[True, False, False, True], [False, True, False, False], [False] * 4])
    nan = torch.nan
    expected = torch.tensor([[5.0, 3.0, 3.0, 3.0], [4.0, 4.0, 4.0, 4.0], [nan] * 4])
    assert_close(continue_rows(disparity, seen), expected, equal_nan=True)


class TrueDisparity(StereoMatcher):
    """A matcher that knows the answers, in the order in which it is asked."""

    def __init__(self, answers):
        super().__init__()
        self.answers = list(answers)

    def match(self, task):
        values = self.answers.pop(0).float()[None]
        return Disparity(values, torch.ones_like(values))


def test_the_scene_is_what_the_frames_show_behind_the_person():
    masks, disparity = frames()
    wall = torch.rand(3, HEIGHT, WIDTH)
    left = torch.where(masks[:, None], 0.9, wall) + 0.0
    right = torch.rand(3, HEIGHT, WIDTH).expand(len(masks), -1, -1, -1)
    matcher = TrueDisparity([*disparity, torch.where(masks[0], disparity[0], room())])
    scene = learn_empty_scene(left, right, matcher, CAMERA, (0, 20), CONFIG)
    always, never = masks.all(0), ~masks.any(0)
    assert scene.left[:, :, always].isnan().all()
    known = scene.left.isfinite()
    truth = wall.expand_as(scene.left)
    assert (
        (scene.left == truth) | ~known
    ).float().mean() > 0.999  # the person is nowhere taken for the scene
    assert scene.seen[never].float().mean() > 0.93
    assert not scene.seen[always].any()
    raised = masks[0] & ~always  # the wall behind the arm is seen in the other frames
    assert scene.seen[raised].float().mean() > 0.8
    # Behind the trunk the wall goes on, and no farther than the floor below.
    assert_close(scene.disparity[always], room()[always], atol=0.3, rtol=0)
    # In the right image the person stands about 10 px to the left.
    hidden = scene.right.isnan().all(0).all(0)
    assert hidden[30:90, 64:78].float().mean() > 0.95
    assert not hidden[:, :50].any()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"shrink": 0}, "shrink"),
        ({"far_share": 1.0}, "far_share"),
        ({"reach": 0.0}, "reach"),
        ({"gap": -1.0}, "gap"),
    ],
)
def test_bad_settings_are_named(setting, message):
    with pytest.raises(ValueError, match=message):
        EmptySceneConfig(**setting)


def stands(background, disparity):
    """`stands_in_background` of a matcher that finds these disparities, of images that do not matter."""
    empty, shown = torch.rand(1, 3, HEIGHT, WIDTH), torch.rand(5, 3, HEIGHT, WIDTH)
    matcher = TrueDisparity([*background, *disparity])
    return stands_in_background((empty, empty), (shown, shown), matcher, CAMERA, (0, 20), CONFIG)


def test_somebody_in_the_background_is_told_by_frames_that_see_behind():
    walks = torch.stack([rectangle(25, 10 + 30 * k, 75, 20) for k in range(5)])
    disparity = torch.where(walks, 9.0, room()) + 0.05 * torch.randn(5, HEIGHT, WIDTH)
    occupied = torch.where(rectangle(25, 60, 75, 20), 9.0, room())[None]
    with pytest.warns(UserWarning, match="stands in the background that the recording sees behind"):
        assert stands(occupied, disparity)


def test_an_empty_background_and_furniture_that_stays_warn_of_nobody(recwarn):
    walks = torch.stack([rectangle(25, 10 + 30 * k, 75, 20) for k in range(5)])
    furnished = torch.where(rectangle(40, 20, 60, 30), 7.0, room())
    disparity = torch.where(walks, 9.0, furnished) + 0.05 * torch.randn(5, HEIGHT, WIDTH)
    assert not stands(furnished[None], disparity)
    cup = torch.where(rectangle(90, 100, 8, 5), 9.0, furnished)  # taken away since
    assert not stands(cup[None], disparity)
    assert not recwarn.list
