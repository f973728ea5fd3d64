"""Figures by their pixels and by what matplotlib was told to draw."""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from torch.testing import assert_close

from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES
from torchpose.export import JOINT_NAMES, PoseSequence
from torchpose.figures import (
    BONES,
    LEFT_COLOUR,
    PART_COLOURS,
    RIGHT_COLOUR,
    UNLABELLED,
    Overlay,
    _draw_panel,
    draw_overlay,
    plot_angles,
)

GREY = 0.5


@pytest.fixture
def image() -> torch.Tensor:
    return torch.full((3, 120, 160), GREY)


def colour_at(image: torch.Tensor, u: int, v: int) -> tuple[int, ...]:
    return tuple((image[:, v, u] * 255).round().int().tolist())


def changed(before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    return (before - after).abs().amax(0) > 0.01


def test_points_have_the_colour_of_their_label_at_their_pixel(image: torch.Tensor):
    points = torch.tensor([[30.0, 70.0], [100.4, 80.6], [140.0, 90.0], [torch.nan, 3.0], [-50.0, 1e9]])
    labels = torch.tensor([3, 13, -1, 5, 6])
    drawn = draw_overlay(image, Overlay("", points=points, labels=labels))
    assert colour_at(drawn, 30, 70) == PART_COLOURS[3]
    assert colour_at(drawn, 100, 81) == PART_COLOURS[13]
    assert colour_at(drawn, 140, 90) == UNLABELLED
    assert changed(image, drawn).sum() == 3 * 9
    unlabelled = draw_overlay(image, Overlay("", points=points))
    assert colour_at(unlabelled, 30, 70) == UNLABELLED
    assert_close(image, torch.full_like(image, GREY), atol=0, rtol=0)


def test_outlines_close_and_leave_their_inside(image: torch.Tensor):
    square = torch.tensor([[40.0, 30.0], [80.0, 30.0], [80.0, 90.0], [40.0, 90.0]])
    outlines = torch.stack([square, square + 1000, torch.full_like(square, torch.nan)])
    drawn = changed(image, draw_overlay(image, Overlay("", outlines=outlines)))
    for u, v in ((40, 60), (80, 60), (60, 30), (60, 90)):
        assert drawn[v, u]
    assert not drawn[35:85, 45:75].any()
    assert not drawn[:, 90:].any()


@pytest.mark.parametrize(("side", "colour"), [("left", LEFT_COLOUR), ("right", RIGHT_COLOUR)])
def test_the_skeleton_has_the_subject_s_sides(image: torch.Tensor, side: str, colour: tuple[int, ...]):
    joints = torch.full((15, 2), torch.nan)
    joints[JOINT_NAMES.index(f"hip_{side}")] = torch.tensor([40.0, 40.0])
    joints[JOINT_NAMES.index(f"knee_{side}")] = torch.tensor([60.0, 90.0])
    drawn = draw_overlay(image, Overlay("", joints=joints))
    assert colour_at(drawn, 50, 65) == colour
    assert colour_at(drawn, 40, 40) == colour_at(drawn, 60, 90) == (255, 255, 255)
    assert not changed(image, drawn)[:, 70:].any()


def test_bones_form_one_tree_over_the_joints():
    assert {name for bone in BONES for name in bone} == set(JOINT_NAMES)
    assert len(BONES) == len(set(BONES)) == len(JOINT_NAMES) - 1
    for start, end in BONES:
        sides = {name.rpartition("_")[2] for name in (start, end)} & {"left", "right"}
        assert len(sides) <= 1


def test_a_frame_without_a_pose_has_its_status_only(image: torch.Tensor):
    nothing = torch.full((15, 2), torch.nan)
    drawn = changed(image, draw_overlay(image, Overlay("lost", joints=nothing)))
    assert drawn[:30, :80].any()
    assert not drawn[30:].any()


def test_angles_stand_beside_their_joints_each_on_its_own_side(image: torch.Tensor):
    joints = torch.full((15, 2), torch.nan)
    marks = (("knee_left", "71"), ("knee_right", "23"), ("elbow_left", "5"))
    for left, right in ((95.0, 75.0), (75.0, 95.0), (80.0, 80.0)):
        joints[JOINT_NAMES.index("knee_left")] = torch.tensor([left, 60.0])
        joints[JOINT_NAMES.index("knee_right")] = torch.tensor([right, 60.0])
        drawn = draw_overlay(image, Overlay("", joints=joints, marks=marks))
        sides = {}
        for name, colour in (("left", LEFT_COLOUR), ("right", RIGHT_COLOUR)):
            own = ((drawn * 255).round() == torch.tensor(colour)[:, None, None]).all(0)
            assert own.sum() > 50
            sides[name] = own.nonzero()[:, 1].float()
        warm, cool = (sides["left"], sides["right"]) if left >= right else (sides["right"], sides["left"])
        assert warm.min() > max(left, right) >= min(left, right) > cool.max()
    assert not changed(image, drawn)[:40].any()  # the elbow is nowhere


def test_names_stand_above_heads_and_statuses_in_rows(image: torch.Tensor):
    joints = torch.full((15, 2), torch.nan)
    joints[JOINT_NAMES.index("head")] = torch.tensor([120.0, 70.0])
    joints[JOINT_NAMES.index("neck")] = torch.tensor([120.0, 90.0])
    first, second = (changed(image, draw_overlay(image, Overlay("2 lost", row=row))) for row in (0, 1))
    rows = [drawn.any(1).nonzero()[:, 0] for drawn in (first, second)]
    assert rows[0].max() < rows[1].min()
    named = changed(image, draw_overlay(image, Overlay("", joints=joints, name="2")))
    plain = changed(image, draw_overlay(image, Overlay("", joints=joints)))
    place = (named & ~plain).nonzero().float().mean(0)
    assert 35 < place[0] < 65
    assert place[1] == pytest.approx(120, abs=3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_images_keep_their_size_and_dtype(dtype: torch.dtype):
    image = torch.rand(3, 481, 643, dtype=dtype)
    drawn = draw_overlay(image, Overlay(""))
    assert drawn.dtype == dtype
    assert_close(drawn, image, atol=0.5 / 255 + 1e-6, rtol=0)


def test_colours_are_distinct_also_to_the_colour_blind():
    """Machado, Oliveira and Fernandes (2009): what a deuteranope and a protanope see of linear RGB."""
    deuteranope = [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.01182, 0.04294, 0.968881],
    ]
    protanope = [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ]
    linear = (np.array(PART_COLOURS) / 255) ** 2.2
    for eye, least in ((np.eye(3), 60), (np.array(deuteranope), 25), (np.array(protanope), 25)):
        seen = 255 * (linear @ eye.T).clip(0, 1) ** (1 / 2.2)
        for first, second in itertools.combinations(range(14), 2):
            assert np.linalg.norm(seen[first] - seen[second]) > least, (first, second)


def make_sequence(status: list[str], names: tuple[str, ...] = ANATOMICAL_NAMES) -> PoseSequence:
    time = len(status)
    return PoseSequence(
        frame=torch.arange(time),
        time_s=torch.arange(time).double() / 10,
        status=tuple(status),
        point_to_model=torch.rand(time).double(),
        joints=torch.randn(time, 15, 3).double(),
        angle_names=names,
        angles=torch.randn(time, len(names)).double(),
        angle_sd=torch.full((time, len(names)), 0.1).double(),
        limb_angle_names=LIMB_ANGLE_NAMES,
        limb_angles=torch.rand(time, 8).double(),
    )


def test_a_panel_shows_degrees_bands_and_gaps():
    sequence = make_sequence(["absent", "tracked", "tracked", "lost", "lost", "tracked", "tracked"])
    sequence.angle_sd[6, 1] = 1.0  # rad, says nothing
    axes = Figure().subplots()
    names = ("left", "right")
    _draw_panel(axes, sequence.without_stale_numbers(), "knee_flexion", dict(zip(names, (0, 1), strict=True)))
    assert axes.get_title(loc="left") == "Knee: flexion +, extension −"
    left, right, _zero = axes.lines
    degrees = torch.rad2deg(sequence.angles[:, :2]).numpy()
    shown = np.array([False, True, True, False, False, True, True])
    np.testing.assert_array_equal(np.isfinite(left.get_ydata()), shown)
    np.testing.assert_allclose(left.get_ydata()[shown], degrees[shown, 0])
    np.testing.assert_array_equal(np.isfinite(right.get_ydata()), shown & (np.arange(7) < 6))
    np.testing.assert_allclose(left.get_xdata(), np.arange(7) / 10)
    assert left.get_color() != right.get_color()
    band = axes.collections[0].get_paths()[0].vertices
    at_first = band[np.isclose(band[:, 0], 0.1), 1]
    np.testing.assert_allclose(
        [at_first.min(), at_first.max()], degrees[1, 0] + np.rad2deg([-0.2, 0.2]), atol=1e-9
    )
    spans = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in axes.patches]
    np.testing.assert_allclose(spans, [(-0.05, 0.05), (0.25, 0.45)], atol=1e-12)
    low, high = axes.get_ylim()
    assert low < degrees[shown, 0].min() < degrees[shown, 0].max() < high


def test_noise_does_not_fill_a_panel():
    sequence = make_sequence(["tracked"] * 5)
    sequence.angles[:] = torch.randn(5, 1) * 1e-3
    sequence.angle_sd[:] = torch.nan  # unknown: drawn, without a band
    axes = Figure().subplots()
    _draw_panel(axes, sequence, "neck_flexion", {"": 3})
    assert np.isfinite(axes.lines[0].get_ydata()).all()
    low, high = axes.get_ylim()
    assert high - low == pytest.approx(20)


@pytest.mark.parametrize(
    "status", [["tracked"] * 30, ["lost"] * 4, ["tracked"], []], ids=["all", "lost", "one", "none"]
)
def test_angles_become_a_picture(tmp_path: Path, status: list[str]):
    plot_angles(tmp_path / "angles.png", make_sequence(status))
    picture = cv2.imread(str(tmp_path / "angles.png"))
    assert picture.shape[1] == 1210
    assert (picture != 255).any()
    assert [path.name for path in tmp_path.iterdir()] == ["angles.png"]


def test_a_taller_picture_for_more_angles(tmp_path: Path):
    heights = []
    for names in (("neck_flexion",), ANATOMICAL_NAMES):
        plot_angles(tmp_path / "angles.png", make_sequence(["tracked"] * 3, names))
        heights.append(cv2.imread(str(tmp_path / "angles.png")).shape[0])
    assert heights[1] == pytest.approx(110 * (0.9 + 5 * 1.75), abs=2)
    assert heights[0] < heights[1] / 3
