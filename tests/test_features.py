"""Features against scikit-learn, SciPy's rotations, and what they must not depend on."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from sklearn.decomposition import PCA, FastICA
from torch.testing import assert_close

from torchpose.activity.dataset import Clip
from torchpose.activity.features import (
    BodyFrame,
    FeatureConfig,
    FeatureKind,
    FeatureStreams,
    ICAFeature,
    JointAngleFeature,
    LimbDirectionFeature,
    PCAFeature,
    SkeletonFeature,
    Stream,
    build_feature,
    change,
)
from torchpose.activity.skeleton import (
    arm_places,
    bone_directions,
    joint_distances,
    joint_index,
    joint_places,
    mirror_joints,
    travel,
    trunk_frame,
)
from torchpose.activity.subspace import Crop, SilhouetteConfig, fast_ica, pca, resize_silhouettes

WHO = ("walk", "1", "1")
JOINTS = (
    *("pelvis", "neck", "head", "shoulder_left", "shoulder_right", "elbow_left", "elbow_right", "wrist_left"),
    *("wrist_right", "hip_left", "hip_right", "knee_left", "knee_right", "ankle_left", "ankle_right"),
)


def generator():
    return torch.Generator().manual_seed(0)


def blocks(frames=40, height=24, width=32):
    """Rectangles of many shapes and places, as silhouettes."""
    masks = torch.zeros(frames, height, width, dtype=torch.bool)
    for mask in masks:
        top, left = (int(torch.randint(size // 2, ())) for size in (height, width))
        high, wide = (int(torch.randint(3, size // 2, ())) for size in (height, width))
        mask[top : top + high, left : left + wide] = True
    return masks


# --- silhouettes ---


def test_the_whole_image_shrinks_by_block_means():
    image = torch.rand(3, 12, 20, dtype=torch.float64)
    small = resize_silhouettes(image, SilhouetteConfig(4, 5, Crop.image))
    assert_close(small, image.reshape(3, 4, 3, 5, 4).mean((2, 4)))


def test_the_same_size_is_the_same_image():
    masks = blocks()
    same = resize_silhouettes(masks, SilhouetteConfig(24, 32, Crop.image))
    assert_close(same, masks.float())


def test_an_uneven_shrink_keeps_the_area():
    masks = blocks(height=25, width=31)
    small = resize_silhouettes(masks, SilhouetteConfig(7, 9, Crop.image), torch.float64)
    assert_close(small.mean((1, 2)), masks.double().mean((1, 2)))


def test_a_person_crop_keeps_proportions_and_forgets_place_and_size():
    config = SilhouetteConfig(8, 6)
    base = torch.zeros(1, 60, 80)
    base[0, 10:26, 20:26] = 1  # 16 x 6: the box becomes 16 x 12, a target pixel is 2 x 2
    expected = torch.zeros(8, 6)
    expected[:, 1:2], expected[:, 2:4], expected[:, 4:5] = 0.5, 1, 0.5
    assert_close(resize_silhouettes(base, config)[0], expected)
    moved = base.roll((7, 30), dims=(1, 2))
    doubled = base.repeat_interleave(2, 1).repeat_interleave(2, 2)
    assert_close(resize_silhouettes(moved, config)[0], expected)
    assert_close(resize_silhouettes(doubled, config)[0], expected)
    wide = torch.zeros(1, 60, 80)
    wide[0, 30:34, 10:70] = 1  # arms out: not stretched to the full height
    assert_close(resize_silhouettes(wide, config).sum(), torch.tensor(4 * 60 / 10**2))


def test_a_crop_beyond_the_image_is_background():
    mask = torch.zeros(1, 10, 10, dtype=torch.bool)
    mask[:, :, :2] = True  # 10 x 2 at the left edge; the box reaches out to the left
    small = resize_silhouettes(mask, SilhouetteConfig(5, 5))
    assert_close(small, torch.tensor([0.0, 0, 1, 0, 0]).expand(1, 5, 5))


def test_frames_without_a_silhouette_are_lost():
    masks = blocks(4)
    masks[1] = False
    images = masks.float()
    images[2, 0, 0] = torch.nan
    for crop in Crop:
        small = resize_silhouettes(images, SilhouetteConfig(crop=crop))
        assert small.isnan().flatten(1).all(1).tolist() == [False, True, True, False]
        assert not small[[0, 3]].isnan().any()


def test_silhouettes_shrink_together_as_one_by_one():
    masks = blocks(6)
    together = resize_silhouettes(masks)
    assert_close(together, torch.cat([resize_silhouettes(mask[None]) for mask in masks]))


# --- subspaces ---


@pytest.mark.parametrize(("images", "pixels"), [(30, 12), (12, 30)], ids=["covariance", "Gram"])
def test_pca_matches_scikit_learn(images, pixels):
    data = torch.randn(images, pixels, dtype=torch.float64) * torch.linspace(
        1, 3, pixels, dtype=torch.float64
    )
    ours, oracle = pca(data, 6), PCA(6).fit(data.numpy())
    signs = torch.from_numpy(np.sign(np.sum(oracle.components_ * ours.components.numpy(), axis=1)))
    assert_close(ours.components, torch.from_numpy(oracle.components_) * signs[:, None], rtol=0, atol=1e-9)
    assert_close(ours.mean, torch.from_numpy(oracle.mean_))
    # scikit-learn divides by n - 1
    assert_close(ours.variance * images / (images - 1), torch.from_numpy(oracle.explained_variance_))
    greatest = ours.components.gather(1, ours.components.abs().argmax(1, keepdim=True))
    assert (greatest > 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("images", "pixels"), [(50, 20), (15, 20)], ids=["covariance", "Gram"])
def test_pca_gives_no_more_components_than_the_images_span(images, pixels, dtype):
    data = torch.randn(images, 4, dtype=dtype) @ torch.randn(4, pixels, dtype=dtype)
    fitted = pca(data, 150)
    assert fitted.components.shape == (4, pixels)
    assert_close(fitted.components @ fitted.components.T, torch.eye(4, dtype=dtype), rtol=0, atol=1e-4)
    centered = data - fitted.mean
    assert_close(centered @ fitted.components.T @ fitted.components, centered, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("fall", [0.99, 0.999])
def test_few_components_of_large_images_reconstruct_as_well_as_the_exact_ones(fall, dtype):
    """The error is that of LAPACK's decomposition to 5e-4, with a steep and a flat spectrum."""
    images = torch.randn(1200, 1000) * fall ** torch.arange(1000)
    images = (images @ torch.linalg.qr(torch.randn(1000, 1000)).Q + 3).to(dtype)
    found = pca(images, 60)
    exact = images.double() - images.double().mean(0)
    rows = found.components.double()
    assert_close(rows @ rows.T, torch.eye(60).double(), rtol=0, atol=1e-4)
    error = (exact - exact @ rows.T @ rows).square().sum()
    least = torch.linalg.svdvals(exact)[60:].square().sum()
    assert least * (1 - 1e-6) <= error <= least * (1 + 5e-4)
    assert_close(found.variance.double(), (exact @ rows.T).square().mean(0), rtol=1e-3, atol=0)
    assert torch.equal(found.components, pca(images, 60).components)


def test_large_images_that_span_little_have_few_components():
    images = torch.randn(1100, 7, dtype=torch.float64) @ torch.randn(7, 1050, dtype=torch.float64)
    assert pca(images, 100).components.shape == (7, 1050)


def test_pca_of_silhouettes_that_leave_most_pixels_alone():
    """Single precision LAPACK did not converge on this covariance: most of its eigenvalues are 0."""
    draw = torch.Generator().manual_seed(9)
    middle, top = 12 + 3 * torch.randn(800, generator=draw), 8 + torch.randn(800, generator=draw)
    half, height = 1 + 2 * torch.rand(800, generator=draw), 14 + 2 * torch.randn(800, generator=draw)
    row, column = torch.arange(32.0)[:, None], torch.arange(24.0)
    middle, top, half, bottom = (v[:, None, None] for v in (middle, top, half, top + height))
    across = (half - (column - middle).abs()).clamp(0, 1)
    upright = across * (row - top).clamp(0, 1) * (bottom - row).clamp(0, 1)
    components = pca(upright.flatten(1), 150).components
    assert_close(components @ components.T, torch.eye(150), rtol=0, atol=1e-4)


def test_pca_needs_images_that_differ():
    with pytest.raises(ValueError, match="at least two images that differ, got 5"):
        pca(torch.ones(5, 9), 3)
    with pytest.raises(ValueError, match="at least two images that differ, got 1"):
        pca(torch.rand(1, 9), 3)


def mixture(samples=4000):
    """Four independent sources, none of them Gaussian, and a known mixing."""
    time = torch.linspace(0, 80, samples, dtype=torch.float64)
    sources = torch.stack(
        [
            time.sin(),
            (3 * time).sin().sign(),
            (time % 1.7) - 0.85,
            torch.rand(samples, dtype=torch.float64, generator=generator()).sub(0.5).pow(3),
        ]
    )
    sources = (sources - sources.mean(1, keepdim=True)) / sources.std(1, keepdim=True, unbiased=False)
    mixing = torch.randn(4, 4, dtype=torch.float64, generator=generator())
    return mixing, mixing @ sources + 5


def test_fast_ica_finds_the_sources():
    mixing, signals = mixture()
    fitted = fast_ica(signals, torch.randn(4, 4, dtype=torch.float64, generator=generator()))
    assert fitted.converged
    # Unmixing and mixing undo each other up to order and sign.
    product = (fitted.unmixing @ mixing).abs()
    assert sorted(product.argmax(1).tolist()) == [0, 1, 2, 3]
    assert_close(product.amax(1), torch.ones(4).double(), rtol=0, atol=0.01)
    assert (product.sum(1) - product.amax(1)).max() < 0.15
    found = fitted.unmixing @ (signals - signals.mean(1, keepdim=True))
    assert_close(found @ found.T / signals.shape[1], torch.eye(4).double())  # unit variance, uncorrelated


def test_fast_ica_matches_scikit_learn():
    _, signals = mixture()
    start = torch.randn(4, 4, dtype=torch.float64, generator=generator())
    ours = fast_ica(signals, start, iterations=500, tolerance=1e-12)
    oracle = FastICA(4, whiten="unit-variance", fun="logcosh", tol=1e-12, max_iter=500, w_init=start.numpy())
    oracle.fit(signals.T.numpy())
    # The whitening's basis differs in order and sign, so the starts and the rows found do.
    product = ours.unmixing @ torch.from_numpy(np.linalg.pinv(oracle.components_))
    assert sorted(product.abs().argmax(1).tolist()) == [0, 1, 2, 3]
    assert_close(product.abs(), (product.abs() > 0.5).double(), rtol=0, atol=1e-5)


def test_fast_ica_drops_what_the_other_signals_determine_and_reports_no_convergence():
    _, signals = mixture()
    doubled = torch.cat([signals, signals[:2].sum(0, keepdim=True)])
    fitted = fast_ica(doubled, torch.eye(5, dtype=torch.float64))
    assert fitted.unmixing.shape == (4, 5)
    assert fitted.converged
    hasty = fast_ica(signals, torch.randn(4, 4, dtype=torch.float64, generator=generator()), iterations=1)
    assert not hasty.converged
    assert hasty.iterations == 1


def silhouette_clips():
    return [Clip(*WHO, silhouettes=blocks(30)) for _ in range(3)]


def subspace_config(kind, components):
    return FeatureConfig(kind, num_components=components, silhouette=SilhouetteConfig(8, 8, Crop.image))


def test_pca_feature_is_the_projection_of_scikit_learn():
    clips = silhouette_clips()
    feature = PCAFeature(subspace_config(FeatureKind.pca, 10))
    feature.fit(clips, generator())
    images = torch.cat(
        [resize_silhouettes(c.silhouettes, feature.config.silhouette).flatten(1) for c in clips]
    )
    expected = torch.from_numpy(PCA(10).fit(images.double().numpy()).transform(images.double().numpy()))
    found = torch.cat([feature(clip) for clip in clips])
    assert_close(found.abs().double(), expected.abs(), rtol=0, atol=1e-3)


def test_ica_feature_spans_what_pca_spans():
    """(4.8): F E_ICA = X E_PCA^T W^-1 W E_PCA, so both rebuild the same silhouettes."""
    clips = silhouette_clips()
    by_pca, by_ica = (build_feature(subspace_config(kind, 10)) for kind in (FeatureKind.pca, FeatureKind.ica))
    for feature in (by_pca, by_ica):
        feature.fit(clips, generator())
    rebuilt = [feature(clips[0]) @ torch.linalg.pinv(feature.projection) for feature in (by_pca, by_ica)]
    assert_close(rebuilt[1], rebuilt[0], rtol=0, atol=1e-3)
    assert (by_ica(clips[0]).abs() - by_pca(clips[0]).abs()).abs().max() > 0.1
    # E_ICA = projection^+ has rows of unit variance over the pixels, uncorrelated once their means are off.
    images = torch.linalg.pinv(by_ica.projection)
    images = images - images.mean(1, keepdim=True)
    assert_close(images @ images.T / images.shape[1], torch.eye(10), rtol=0, atol=1e-3)


@pytest.mark.parametrize("kind", [FeatureKind.pca, FeatureKind.ica])
def test_silhouette_features_clip_m_pass_lost_frames_and_repeat(kind):
    clips = [Clip(*WHO, silhouettes=blocks(5)) for _ in range(2)]
    clips[0].silhouettes[2] = False
    feature, again = (build_feature(subspace_config(kind, 150)) for _ in range(2))
    for one in (feature, again):
        one.fit(clips, generator())
    values = feature(clips[0])
    assert values.shape[1] <= 8  # nine silhouettes span eight directions
    assert values.isnan().all(1).tolist() == [False, False, True, False, False]
    assert torch.equal(values.nan_to_num(), again(clips[0]).nan_to_num())


@pytest.mark.parametrize("feature", [PCAFeature(), ICAFeature()], ids=["pca", "ica"])
def test_silhouette_features_name_what_is_missing(feature):
    with pytest.raises(ValueError, match="made for images of 0 pixels, got 768; call fit first"):
        feature(Clip(*WHO, silhouettes=blocks(2)))
    with pytest.raises(ValueError, match="need a frame with foreground, got none"):
        feature.fit([Clip(*WHO, silhouettes=torch.zeros(2, 9, 9))], generator())
    with pytest.raises(ValueError, match="needs 'silhouettes' in every clip"):
        feature.fit([Clip(*WHO, pose=torch.zeros(2, 24))], generator())


# --- angles and directions ---


def test_joint_angles_leave_out_place_and_heading():
    pose = torch.randn(5, 24)
    pose[3] = torch.nan
    values = JointAngleFeature()(Clip(*WHO, pose=pose))
    assert torch.equal(values.nan_to_num(), pose[:, 4:].nan_to_num())
    elsewhere = pose.clone()
    elsewhere[:, :4] += 2
    assert torch.equal(JointAngleFeature()(Clip(*WHO, pose=elsewhere)).nan_to_num(), values.nan_to_num())


def test_limb_directions_and_lean():
    pose = torch.randn(6, 24, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(6, 9, 3, dtype=torch.float64), dim=2)
    values = LimbDirectionFeature()(Clip(*WHO, pose=pose, directions=directions))
    assert_close(values[:, :27], directions.flatten(1))
    # R = Ry(yaw) Rx(pitch) Rz(roll); the camera's down in the torso's frame is R^T e_y.
    rotation = Rotation.from_euler("YXZ", pose[:, 3:6].numpy()).as_matrix()
    assert_close(values[:, 27:], torch.from_numpy(rotation[:, 1, :].copy()))
    directions[2, 4, 1] = torch.nan
    lost = LimbDirectionFeature()(Clip(*WHO, pose=pose, directions=directions))
    assert lost.isnan().all(1).tolist() == [False, False, True, False, False, False]
    assert not lost[[0, 1, 3, 4, 5]].isnan().any()


def standing():
    """A person who stands upright in the camera's frame (y down), facing it, arms hanging; m."""
    points = {
        "pelvis": (0, 0, 3),
        "neck": (0, -0.5, 3),
        "head": (0, -0.75, 3),
        "shoulder_left": (0.2, -0.5, 3),
        "elbow_left": (0.2, -0.2, 3),
        "wrist_left": (0.2, 0.05, 3),
        "hip_left": (0.1, 0, 3),
        "knee_left": (0.1, 0.45, 3),
        "ankle_left": (0.1, 0.9, 3),
    }
    for name, (x, y, z) in list(points.items()):
        if name.endswith("_left"):
            points[name.replace("left", "right")] = (-x, y, z)
    return torch.tensor([points[name] for name in JOINTS], dtype=torch.float64)


def test_bones_of_a_person_who_stands_and_points():
    joints = standing()[None].repeat(2, 1, 1)
    joints[1, JOINTS.index("wrist_left")] = joints[1, JOINTS.index("elbow_left")] + torch.tensor(
        [0, 0, -0.25]
    )
    found = bone_directions(joints, JOINTS)
    down, up, forward = torch.tensor([[0.0, 1, 0], [0, -1, 0], [0, 0, -1]], dtype=torch.float64)
    assert_close(found[0], torch.stack([up, *[down] * 8]))
    assert_close(found[1], torch.stack([up, down, forward, *[down] * 6]))
    assert_close(bone_directions(joints, JOINTS, upright=True)[:, 1:], found)
    assert_close(bone_directions(joints, JOINTS, upright=True)[:, 0], down.expand(2, 3))


@pytest.mark.parametrize("frame", list(BodyFrame))
def test_bones_do_not_depend_on_place_heading_size_and_where_up_is(frame):
    joints = standing() + 0.1 * torch.randn(7, 15, 3, dtype=torch.float64)
    turn = torch.from_numpy(Rotation.from_euler("y", 2.1).as_matrix())
    feature = SkeletonFeature(frame)
    expected = feature(Clip(*WHO, joints=joints, joint_names=JOINTS))
    for other in (1.7 * joints @ turn.T + 5, joints * torch.tensor([-1.0, -1.0, 1.0])):
        assert_close(feature(Clip(*WHO, joints=other, joint_names=JOINTS)), expected)
    tipped = joints @ torch.from_numpy(Rotation.from_euler("x", 0.5).as_matrix()).T
    same = torch.allclose(feature(Clip(*WHO, joints=tipped, joint_names=JOINTS)), expected)
    assert same == (frame is BodyFrame.trunk)


@pytest.mark.parametrize("upright", [False, True])
def test_the_body_frame_is_a_rotation(upright):
    joints = standing() + 0.1 * torch.randn(7, 15, 3, dtype=torch.float64)
    frame = trunk_frame(joints, joint_index(JOINTS), upright)
    assert_close(frame.transpose(1, 2) @ frame, torch.eye(3).double().expand(7, 3, 3))
    assert_close(torch.linalg.det(frame), torch.ones(7).double())


def test_lost_skeletons_are_lost_features():
    joints = standing()[None].repeat(3, 1, 1)
    joints[1] = torch.nan
    for frame in BodyFrame:
        values = SkeletonFeature(frame)(Clip(*WHO, joints=joints, joint_names=JOINTS))
        assert values.isnan().all(1).tolist() == [False, True, False]


def test_joint_names_of_other_recorders():
    kinect = ["hip_center", "spine", "shoulder_center", "head", "left_shoulder", "right_shoulder", "left_hip"]
    kinect += ["right_hip", "left_hand"]
    assert joint_index(tuple(kinect)) == {
        "pelvis": 0,
        "neck": 2,
        "head": 3,
        "shoulder_left": 4,
        "shoulder_right": 5,
        "hip_left": 6,
        "hip_right": 7,
    }
    camel = ["LeftShoulder", "RightShoulder", "leftHip", "HipRight", "RElbow", "l_wrist"]
    assert set(joint_index(tuple(camel))) == {
        *("shoulder_left", "shoulder_right", "hip_left", "hip_right", "elbow_right", "wrist_left"),
    }
    with pytest.raises(ValueError, match="hip_right cannot be found in joint_names left_shoulder, "):
        joint_index(("left_shoulder", "right_shoulder", "left_hip", "head"))


def test_velocity_is_the_change_over_both_sides():
    rows = torch.randn(6, 20)
    found = change(rows, 2)
    assert_close(found[2:4], rows[4:] - rows[:2])
    assert_close(found[0], rows[2] - rows[0])
    assert_close(found[5], rows[5] - rows[3])
    assert_close(change(rows[:1], 2), torch.zeros(1, 20))
    rows[3] = torch.nan
    assert change(rows, 2).isnan().all(1).tolist() == [False, True, False, False, False, True]


def test_streams_stand_in_the_order_asked_for():
    pose = torch.randn(6, 24)
    config = FeatureConfig(streams=(Stream.velocity, Stream.feature), velocity_step=1)
    moving, still = FeatureStreams(config)(Clip(*WHO, pose=pose))
    assert torch.equal(still, pose[:, 4:])
    assert torch.equal(moving, change(pose[:, 4:], 1))
    joints = standing() + 0.1 * torch.randn(5, 15, 3, dtype=torch.float64)
    clip = Clip(*WHO, joints=joints, joint_names=JOINTS)
    config = FeatureConfig(FeatureKind.skeleton, streams=tuple(Stream))
    every = FeatureStreams(config)(clip)
    found = dict(zip(Stream, every, strict=True))
    assert [rows.shape[1] for rows in every] == [30, 30, 33, 33, 12, 12, 15, 3]
    assert torch.equal(found[Stream.place_velocity], change(found[Stream.places], 2))
    assert torch.equal(found[Stream.arms], arm_places(joints, JOINTS, True).flatten(1))
    joints[2] = torch.nan
    for stream, rows in zip(Stream, FeatureStreams(config)(clip), strict=True):
        lost = rows.isnan().all(1).nonzero()[:, 0].tolist()
        assert lost == ([0, 4] if "velocity" in stream.value else [2])  # a change needs the frames beside


def test_a_change_is_as_uncertain_as_both_its_frames():
    spread = torch.rand(5, 24) + 0.1
    clip = Clip(*WHO, pose=torch.randn(5, 24), pose_sd=spread)
    own, both = FeatureStreams(FeatureConfig(streams=(Stream.feature, Stream.velocity))).deviation(clip)
    assert torch.equal(own, spread[:, 4:])
    assert_close(both[2].square(), spread[0, 4:].square() + spread[4, 4:].square())
    assert FeatureStreams().deviation(Clip(*WHO, pose=torch.randn(5, 24))) == (None,)


def test_places_and_distances_of_a_person_who_stands():
    joints = standing()[None]
    places = joint_places(joints, JOINTS)[0]  # trunk 0.5 m
    assert_close(places[0], torch.tensor([0, -1.5, 0]).double())  # head
    assert_close(places[3], torch.tensor([0.4, 0.1, 0]).double())  # left wrist
    assert_close(places[4], torch.tensor([-0.4, 0.1, 0]).double())
    assert_close(arm_places(joints, JOINTS)[0, 0], torch.tensor([0.4, 1.1, 0]).double())
    distances = joint_distances(joints, JOINTS)[0]
    assert_close(distances[0], torch.tensor(0.8).double())  # from hand to hand
    assert_close(distances[1], torch.tensor((0.2**2 + 0.8**2) ** 0.5 / 0.5).double())  # to the head


def test_travel_is_way_and_rise_since_the_first_frame_seen():
    joints = standing()[None].repeat(4, 1, 1)
    joints[0] = torch.nan
    joints[2] += torch.tensor([0.3, -0.2, -0.4])  # y down: up by 0.2 m
    joints[3, JOINTS.index("head")] += torch.tensor([0, 0.1, 0])
    expected = torch.tensor([[0, 0, 0], [1, 0.4, 0.4], [0, 0, -0.2]]).double()
    assert_close(travel(joints, JOINTS)[1:], expected)
    upside = joints * torch.tensor([1.0, -1, -1])
    assert_close(travel(upside, JOINTS)[1:], expected)


@pytest.mark.parametrize("stream", [s for s in Stream if s is not Stream.velocity])
def test_streams_do_not_depend_on_place_heading_and_size(stream):
    joints = standing() + 0.1 * torch.randn(7, 15, 3, dtype=torch.float64)
    turn = torch.from_numpy(Rotation.from_euler("y", 2.1).as_matrix())
    streams = FeatureStreams(FeatureConfig(FeatureKind.skeleton, streams=(stream,)))
    (expected,) = streams(Clip(*WHO, joints=joints, joint_names=JOINTS))
    (found,) = streams(Clip(*WHO, joints=1.7 * joints @ turn.T + 5, joint_names=JOINTS))
    assert_close(found, expected)


def test_a_mirror_image_does_the_same_with_the_other_hand():
    joints = standing() + 0.1 * torch.randn(7, 15, 3, dtype=torch.float64)
    other = mirror_joints(joints, JOINTS)
    assert_close(mirror_joints(other, JOINTS), joints)
    left, right = JOINTS.index("wrist_left"), JOINTS.index("wrist_right")
    assert_close(other[:, left], joints[:, right] * torch.tensor([-1.0, 1, 1]))
    assert_close(joint_distances(other, JOINTS)[:, 0], joint_distances(joints, JOINTS)[:, 0])
    places, mirrored = joint_places(joints, JOINTS, True), joint_places(other, JOINTS, True)
    assert_close(mirrored[:, 3], places[:, 4] * torch.tensor([-1.0, 1, 1]))  # wrists, in the body's own frame
    camel = ["LeftShoulder", "RShoulder", "Head"]
    assert_close(mirror_joints(joints[:, :3], tuple(camel))[:, 0], joints[:, 1] * torch.tensor([-1.0, 1, 1]))


def test_streams_without_their_joints_are_named():
    names = ("shoulder_left", "shoulder_right", "hip_left", "hip_right")
    clip = Clip(*WHO, joints=torch.randn(3, 4, 3), joint_names=names)
    with pytest.raises(
        ValueError, match=r"the stream arms needs more joints than shoulder_left.* leave it out"
    ):
        FeatureStreams(FeatureConfig(FeatureKind.skeleton, streams=(Stream.arms,)))(clip)
    with pytest.raises(ValueError, match="needs 'joints' in every clip"):
        FeatureStreams(FeatureConfig(streams=(Stream.arms,)))(Clip(*WHO, pose=torch.zeros(3, 24)))


@pytest.mark.parametrize("kind", list(FeatureKind))
def test_the_configuration_builds_every_kind(kind):
    built = {
        FeatureKind.angles: JointAngleFeature,
        FeatureKind.directions: LimbDirectionFeature,
        FeatureKind.pca: PCAFeature,
        FeatureKind.ica: ICAFeature,
        FeatureKind.skeleton: SkeletonFeature,
    }
    assert isinstance(build_feature(FeatureConfig(kind)), built[kind])


def test_bad_settings_are_named():
    with pytest.raises(ValueError, match="velocity_step must be at least 1 frame, got 0"):
        FeatureConfig(velocity_step=0)
    with pytest.raises(ValueError, match="streams must be one or more, each once, got none"):
        FeatureConfig(streams=())
    with pytest.raises(ValueError, match="streams must be one or more, each once, got arms, arms"):
        FeatureConfig(streams=(Stream.arms, Stream.arms))
    with pytest.raises(ValueError, match="num_components and ica_iterations must be at least 1"):
        FeatureConfig(num_components=0)
    with pytest.raises(ValueError, match="silhouette size must be at least 1 x 1 px, got 0 x 24"):
        SilhouetteConfig(height=0)
