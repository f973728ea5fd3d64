"""The benchmark on simulated disparity: its depth is that of the shapes, its noise has the stated statistics, its truth
and its figures are right.
"""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from scipy.ndimage import gaussian_filter

from benchmarks.simulated import (
    CAMERA,
    FACE,
    MOTIONS,
    Take,
    arm_axis_angles,
    draw_shape,
    face_boxes,
    main,
    overall,
    score,
    simulate,
)
from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES, limb_angles
from torchpose.body.model import BodyModel
from torchpose.body.skeleton import HUMAN
from torchpose.body.superquadric import DisplayModel, Person, implicit
from torchpose.geometry import exp_rotation
from torchpose.pipeline import FramePose, StereoToPose
from torchpose.registration.vem import Registration
from torchpose.synthesis.depth import MatcherNoise, Scene, cast_depth, smooth_field, spoil
from torchpose.synthesis.motion import perform, random_stream
from torchpose.synthesis.render import StereoRenderer
from torchpose.tracking.tracker import TrackStatus
from torchpose.vision.camera import StereoCamera

BODY = BodyModel()
JOINT = {name: i for i, name in enumerate(BODY.joint_names)}
SILENT = MatcherNoise(0.0, 0.0, quantum=0.0, fattening=0, outliers=0.0, dropouts=0.0, ragged=0.0)
SMALL = StereoCamera(160, 120, 200.0, 80.0, 61.0, baseline=0.12)


@pytest.fixture(scope="module")
def take() -> Take:
    return simulate("knee", 3, 4)


@pytest.fixture(scope="module")
def drawn():
    """A person in three poses before a small camera: shapes, poses, depth."""
    person = Person(height=1.7, girths=(1.1, 0.9, 1.0, 1.05, 0.95, 1.0))
    size = person.size(BODY)
    pose = perform(BODY, size, "free", torch.tensor([0.0, 0.7, 1.4]), SMALL)
    posed, display = BODY(pose, size), DisplayModel(BODY, person)
    return display, posed, cast_depth(display, posed, SMALL, Scene(floor=1.1, wall=6.0))


def test_depth_is_where_each_ray_first_meets_a_shape(drawn):
    display, posed, frames = drawn
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    pixels = torch.stack((u, v), -1)
    parts = display(posed)
    for i in range(3):
        mask = frames.mask[i]
        assert mask.sum() > 800

        def values(depth, i=i, mask=mask):
            """The implicit function of every shape at points on the rays."""
            points = SMALL.back_project(pixels[mask], depth)
            local = (points[:, None] - parts.origins[i])[..., None, :] @ parts.rotations[i]
            return implicit(local[..., 0, :], display.shapes)  # (pixels, shapes)

        at = values(frames.depth[i][mask])
        nearest = at.abs().argmin(1)
        assert at.amin(1).abs().max() < 1e-3  # on one, and inside of none
        assert torch.equal(display.segments[nearest] + 1, frames.labels[i][mask])
        # Nothing is met on the way there.
        for share in torch.linspace(0.9, 0.999, 12):
            assert (values(frames.depth[i][mask] * share) > -1e-3).all()
        # Pixels beside the person see the floor or the wall.
        beside = SMALL.back_project(pixels, frames.depth[i])[~mask]
        assert (((beside[:, 1] - 1.1).abs() < 1e-4) | ((beside[:, 2] - 6.0).abs() < 1e-5)).all()
        assert beside[:, 1].max() < 1.1 + 1e-4


def test_depth_agrees_with_the_renderer_of_images(drawn):
    _, posed, frames = drawn
    person = Person(height=1.7, girths=(1.1, 0.9, 1.0, 1.05, 0.95, 1.0))
    rendered = StereoRenderer(SMALL, BODY, person)(posed)
    assert torch.equal(rendered.labels, frames.labels)
    torch.testing.assert_close(rendered.depth[frames.mask], frames.depth[frames.mask])


def test_the_drawn_people_are_not_the_fitted_ellipsoids(drawn):
    display, posed, frames = drawn
    torso = BODY.segment_names.index("torso")
    v, u = (frames.labels[0] == torso + 1).nonzero(as_tuple=True)
    points = SMALL.back_project(torch.stack((u, v), -1).float(), frames.depth[0, v, u])
    local = (points - posed.centers[0, torso]) @ posed.frames[0, torso]
    radius = (local / posed.radii[0, torso]).norm(dim=-1)  # 1 everywhere on the ellipsoid
    assert radius.std() > 0.08
    assert (radius - 1).abs().mean() > 0.08
    # A rib cage is half as thick again in front as at the side, at least.
    assert display.shapes.size[0, 0] / display.shapes.size[0, 1] > 1.5


def test_people_differ_by_about_a_tenth():
    sizes = torch.cat([draw_shape(random_stream("a", i), BODY).size(BODY) for i in range(60)])
    assert sizes.std(0).min() > 0.04
    assert sizes.std(0).max() < 0.09
    # The drawn person of size 1 is 1.763 m tall (person.yaml), people are 1.75 m on average.
    assert (sizes.mean(0) - 1.75 / 1.763).abs().max() < 0.03
    assert sizes.min() > 0.8
    assert sizes.max() < 1.25
    # Lengths and girths vary on their own, too: none follows from another.
    correlation = torch.corrcoef(sizes.T) - torch.eye(sizes.shape[1])
    assert correlation.max() < 0.8


def test_smooth_fields_have_unit_deviation_everywhere_and_the_stated_spread():
    fields = torch.stack([smooth_field((24, 30), 3.0, random_stream("field", i)) for i in range(1500)])
    assert (fields.std(0) - 1).abs().max() < 0.08  # also in the corners
    assert fields.mean(0).abs().max() < 0.11
    # Oracle: white noise smoothed twice has the correlation exp(-d^2 / (4 spread^2)).
    for lag in (2, 5, 9):
        measured = (fields[:, :, :-lag] * fields[:, :, lag:]).mean()
        assert abs(measured - math.exp(-(lag**2) / 36)) < 0.02
    # SciPy's filter of the same noise agrees but for its scale.
    radius = 9
    white = torch.randn(24 + 2 * radius, 30 + 2 * radius, generator=random_stream("field", 0))
    theirs = gaussian_filter(white.numpy(), 3.0, truncate=3.0)[radius:-radius, radius:-radius]
    assert np.corrcoef(theirs.ravel(), fields[0].numpy().ravel())[0, 1] > 0.99999


def plane(distance: float = 3.2) -> tuple[torch.Tensor, torch.Tensor]:
    mask = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[30:450, 40:600] = True
    return torch.full((CAMERA.height, CAMERA.width), distance), mask


def test_the_noise_of_the_disparity_has_the_stated_statistics():
    noise = MatcherNoise(outliers=0.0, dropouts=0.0)
    depth, mask = plane()
    found = [spoil(depth, mask, CAMERA, random_stream("plane", i), noise).disparity for i in range(4)]
    error = torch.stack(found)[:, 60:420, 80:560] - 30.0  # 800 * 0.12 / 3.2
    assert abs(error.mean()) < 0.02
    quantum = 0.25**2 / 12
    assert error.var() == pytest.approx(0.2**2 + 0.25**2 + quantum, rel=0.05)
    for lag in (2, 4, 40):
        shared = (error[:, :, :-lag] * error[:, :, lag:]).mean()
        assert shared == pytest.approx(0.25**2 * math.exp(-(lag**2) / 16), abs=0.002)
    assert torch.equal(error * 4, (error * 4).round())
    assert found[0].isfinite().all()
    # Beyond the silhouette nothing is spoiled.
    torch.testing.assert_close(found[0][:20], torch.full((20, CAMERA.width), 30.0))


def test_outliers_and_dropouts_come_at_the_stated_rates_in_patches():
    depth, mask = plane()
    found = [spoil(depth, mask, CAMERA, random_stream("plane", i)).disparity for i in range(8)]
    disparity = torch.stack(found)[:, 60:420, 80:560]
    missing = disparity.isnan()
    assert missing.float().mean() == pytest.approx(0.02, rel=0.15)
    error = (disparity - 30.0)[~missing]
    low, high = 96 / 8.0, 96 / 1.2
    wild = error.abs() > 2.0  # 6 standard deviations
    assert wild.float().mean() == pytest.approx(0.01 * (1 - 4 / (high - low)), rel=0.15)
    assert error[wild].min() == pytest.approx(low - 30.0, abs=0.5)
    assert error[wild].max() == pytest.approx(high - 30.0, abs=0.5)
    # Right beside a dropout there is mostly another one.
    assert missing[:, :, 1:][missing[:, :, :-1]].float().mean() > 0.6


def test_what_is_near_grows_by_two_pixels_over_what_is_far():
    depth, mask = plane(5.0)
    depth[100:300, 200:260] = 3.0
    found = spoil(depth, mask, CAMERA, random_stream("step"), MatcherNoise(**vars(SILENT) | {"fattening": 2}))
    near = (found.disparity - 32.0).abs() < 1e-4
    expected = torch.zeros_like(mask)
    expected[98:302, 198:262] = True
    assert torch.equal(near, expected)
    assert torch.equal(found.silhouette, mask)
    unspoiled = spoil(depth, mask, CAMERA, random_stream("step"), SILENT)
    torch.testing.assert_close(CAMERA.depth(unspoiled.disparity), depth)


def test_the_silhouette_s_rim_wanders_by_the_stated_deviation():
    depth, mask = plane()
    shifts = []
    for i in range(12):
        rows = spoil(depth, mask, CAMERA, random_stream("rim", i)).silhouette[60:420]
        shifts.append(rows[:, :320].float().argmax(1) - 40.0)
        assert (rows[:, 80:560]).all()  # no holes
    shift = torch.stack(shifts)
    assert shift.std() == pytest.approx(1.5, rel=0.12)
    assert abs(shift.mean()) < 0.3
    # Ragged, not moved as a whole: far rows are independent, near ones alike.
    assert (shift[:, 60:] * shift[:, :-60]).mean() < 0.5
    assert (shift[:, 1:] - shift[:, :-1]).abs().mean() < 1.0


def test_true_limb_angles_are_those_of_the_limbs(take: Take):
    """By the law of cosines on the joints, and by the lengths that the person has."""

    def between(a, b, c):
        """Angle at b by the three distances, 0 where the limbs are aligned."""
        at = [take.joints[:, JOINT[name]].double() for name in (a, b, c)]
        ab, bc, ac = ((at[i] - at[j]).norm(dim=-1) for i, j in ((0, 1), (1, 2), (0, 2)))
        return math.pi - ((ab**2 + bc**2 - ac**2) / (2 * ab * bc)).clamp(-1, 1).acos()

    angles = dict(zip(LIMB_ANGLE_NAMES, limb_angles(take.joints).T, strict=True))
    anatomical = dict(zip(ANATOMICAL_NAMES, take.angles.T, strict=True))
    for side in ("left", "right"):
        for joint, chain in (("elbow", ("shoulder", "elbow", "wrist")), ("knee", ("hip", "knee", "ankle"))):
            expected = between(*(f"{name}_{side}" for name in chain)).float()
            torch.testing.assert_close(angles[f"{joint}_{side}_limb"], expected, atol=2e-3, rtol=0)
            torch.testing.assert_close(anatomical[f"{joint}_flexion_{side}"], expected, atol=2e-3, rtol=0)
    size = dict(zip(BODY.size_names, take.size[0].tolist(), strict=True))
    bodies = yaml.safe_load(HUMAN.read_text())["bodies"]
    for upper, lower, bone, child in (
        ("shoulder", "elbow", "upper_arm", "forearm"),
        ("hip", "knee", "thigh", "shank"),
    ):
        length = math.hypot(*bodies[child]["origin"][bone]) * size[bone]
        bone = (take.joints[:, JOINT[f"{upper}_left"]] - take.joints[:, JOINT[f"{lower}_left"]]).norm(dim=-1)
        torch.testing.assert_close(bone, torch.full_like(bone, length), atol=1e-5, rtol=0)


def test_arms_are_measured_against_the_image_s_axes():
    joints = torch.zeros(1, 15, 3)
    joints[0, 7] = torch.tensor([math.sin(0.3), math.cos(0.3), 0.0])  # left wrist: 0.3 rad from hanging
    joints[0, 8] = torch.tensor([0.0, 0.0, -1.0])  # forward
    expected = torch.tensor([[0.3, math.pi / 2, math.pi / 2 - 0.3, math.pi / 2]])
    torch.testing.assert_close(arm_axis_angles(joints), expected)


def followed(take: Take, poses: torch.Tensor, sd: float = 0.01, missing: tuple[int, ...] = ()):
    """What a tracker that finds these poses and the true size would write."""
    model = StereoToPose(CAMERA)
    model.size = take.size
    frames = []
    for i, pose in enumerate(poses[:, None]):
        P = pose.shape[1]
        fit = Registration(
            pose=pose,
            covariance=sd**2 * torch.eye(P)[None],
            belief=torch.zeros(1, 15, 1),
            distance=torch.zeros(1, 1),
            point_to_model=torch.full((1,), 0.012),
            misfit=torch.zeros(1),
            score=torch.zeros(1),
            bound=torch.zeros(1, 1),
            status=torch.zeros(1, dtype=torch.long),
        )
        status = TrackStatus.lost if i in missing else TrackStatus.tracked
        frames.append(FramePose(i, i / 20, status, None if i in missing else fit, take.sights[i]))
    return model.sequence(frames)


def test_a_perfect_tracker_has_no_error(take: Take):
    figures = score(take, followed(take, take.pose))
    for name, value in figures.items():
        if name.endswith(("_deg", "_mm")) and name != "point_to_model_mm":
            assert value == pytest.approx(0, abs=0.05), name  # float32's arc cosine
    assert figures["point_to_model_mm"] == pytest.approx(12.0)
    assert (figures["within"], figures["covered"]) == (1, 1)
    assert (figures["failed"], figures["unanswered"]) == (0, 0)


def test_errors_are_measured_where_they_are(take: Take):
    index = next(i for i, name in enumerate(BODY.parameter_names) if name == "shank_left_2")
    off = take.pose.clone()
    off[1, index] += math.radians(40)  # one of four frames
    figures = score(take, followed(take, off, missing=(2,)))
    assert figures["failed"] == 1
    assert figures["unanswered"] == 1
    assert figures["knee_right_deg"] == pytest.approx(0, abs=0.05)
    assert figures["knee_deg"] == pytest.approx(figures["knee_left_deg"] / 2, abs=0.05)
    assert 10 < figures["knee_left_deg"] < 13.5  # up to 40 degrees in one of three answered frames
    assert figures["angle_deg"] == pytest.approx(figures["knee_deg"] / 4, abs=0.05)
    assert figures["covered"] < 1
    moved = take.pose.clone()
    moved[:, 0] += 0.25
    aside = score(take, followed(take, moved))
    assert aside["failed"] == 4
    assert aside["joint_mm"] == pytest.approx(250, abs=0.1)
    assert aside["within"] == 0
    assert aside["angle_deg"] == pytest.approx(0, abs=0.05)


def test_a_take_repeats_exactly_and_another_draw_is_another_person(take: Take):
    again, other = simulate("knee", 3, 4), simulate("knee", 4, 4)
    assert torch.equal(again.joints, take.joints)
    assert torch.equal(again.sights[3].cloud.points, take.sights[3].cloud.points)
    assert torch.equal(again.sights[1].silhouette, take.sights[1].silhouette)
    assert (other.size - take.size).abs().max() > 0.02


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motion_is_seen_whole_from_3_m_on(motion: str):
    take = simulate(motion, 1, 2)
    assert take.pose[:, 2].min() > 2.9
    assert take.pose[:, 2].max() < 4.7
    for sight, joints in zip(take.sights, take.joints, strict=True):
        assert not sight.cut
        assert sight.present
        assert sight.cloud.mask.sum() > 400
        # The cloud is the person's: near the true joints, and before the middle of the body.
        points = sight.cloud.points[0][sight.cloud.mask[0]]
        assert torch.cdist(points, joints).amin(1).quantile(0.95) < 0.35
        if bool(sight.faces.found[0]):
            head = joints[JOINT["head"]]
            assert (sight.faces.position[0] - head).norm() < 0.2
            assert bool(sight.silhouette[sight.faces.mask].all())


def test_a_face_is_found_where_the_camera_sees_one():
    person, angles = Person(), torch.tensor([0.0, 0.6, -0.6, 1.4, math.pi, -1.4, 0.0])
    pose = torch.cat([torch.zeros(7, 6), BODY.rest.expand(7, -1)], 1)
    pose[:, 2], pose[:, 3] = 3.3, angles
    posed, display = BODY(pose, person.size(BODY)), DisplayModel(BODY, person)
    depth = cast_depth(display, posed, CAMERA).depth
    depth[6] = 2.0  # something before the last one
    box = face_boxes(BODY, display, posed, depth, random_stream("face"))
    assert box[:, 0].isfinite().tolist() == [True, True, True, False, False, False, False]
    head = BODY.body_names.index("head")
    turn = exp_rotation(torch.tensor([[0.0, angle, 0.0] for angle in angles]))
    face = posed.origins[:, head] + (turn @ (display.head_scale * torch.tensor(FACE)))
    middle = CAMERA.project(face)[:3]
    assert ((box[:3, :2] + box[:3, 2:]) / 2 - middle).abs().max() < 10  # 2 px, and the rest pose's nod


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: simulate("flying"), "the motion must be one of arms, .*got 'flying'"),
        (lambda: simulate("knee", 0, 0), "a take must have at least one frame, got 0"),
        (lambda: MatcherNoise(correlated=-1.0), "correlated must not be negative, got -1.0; give px"),
        (lambda: MatcherNoise(outliers=1.0), "outliers must be a share in"),
        (lambda: MatcherNoise(rim=0.0), "rim must be positive, got 0.0; give px"),
        (lambda: MatcherNoise(nearest=9.0), "0 < nearest < farthest must hold, in m, got 9"),
        (lambda: Person(girths=(1.0,)).size(BODY), "the person has 1 girths and the body 6"),
        (
            lambda: spoil(plane()[0], plane()[1] & False, CAMERA, random_stream(0)),
            "the mask must hold a person, got an empty one",
        ),
    ],
)
def test_bad_input_is_refused(make, message: str):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "flying"], "--only must be part of one of arms"),
        (["--draws", "0"], "--draws and --frames must be at least 1, got 0 and None"),
        (["--frames", "0"], "--draws and --frames must be at least 1, got 2 and 0"),
    ],
)
def test_bad_arguments_are_refused(arguments: list[str], message: str, capsys):
    with pytest.raises(SystemExit):
        main(arguments)
    assert message in capsys.readouterr().err


def test_the_benchmark_runs_and_writes_its_figures(tmp_path: Path, capsys):
    file = tmp_path / "figures.json"
    main(["--frames", "2", "--draws", "1", "--only", "elbow_h", "--json", str(file), "pose.size.rounds=0"])
    printed = capsys.readouterr().out
    assert "elbow_horizontal" in printed
    assert "Table 5.1, elbow_horizontal elbow: left" in printed
    written = json.loads(file.read_text())
    assert written["settings"] == ["pose.size.rounds=0"]
    assert [(take["motion"], take["draw"]) for take in written["takes"]] == [("elbow_horizontal", 0)]
    assert written["overall"]["angle_deg"] < 15
    assert written["overall"]["registration_ms"] > 0


def test_means_leave_out_what_is_not_there_and_counts_add_up():
    rows = [
        {"motion": "a", "draw": 0, "angle_deg": 2.0, "failed": 3.0, "unanswered": 0.0},
        {"motion": "a", "draw": 1, "angle_deg": math.nan, "failed": 0.0, "unanswered": 60.0},
        {"motion": "b", "draw": 0, "angle_deg": 4.0, "failed": 1.0, "unanswered": 0.0},
    ]
    assert overall(rows) == {"angle_deg": 3.0, "failed": 4.0, "unanswered": 60.0}
