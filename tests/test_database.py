"""Recordings that the package makes: truth that fits the images, files that read back, and a fair, stable
plan.
"""

import dataclasses
import functools

import cv2
import numpy as np
import pytest
import torch
from scipy.stats import f_oneway
from sklearn.ensemble import RandomForestClassifier

from torchpose.body.model import BodyModel
from torchpose.body.superquadric import draw_person
from torchpose.recording import Backgrounds, Frame, open_recording, write_recording
from torchpose.synthesis.database import (
    DatabaseConfig,
    SyntheticRecording,
    make_demo,
    make_recording,
    plan_database,
    synthetic_camera,
)
from torchpose.synthesis.motion import perform

BODY = BodyModel()
CAMERA = synthetic_camera(80, 60, 10.0)


@functools.cache
def recording() -> SyntheticRecording:
    return make_recording("left_leg", 4, 1, 3, CAMERA, body=BODY)


def test_the_true_joints_lie_inside_their_segments_in_the_images():
    big = make_recording("left_hand", 5, 1, 1, synthetic_camera(160, 120, 10.0), body=BODY)
    frame = big.frames()
    segments = ("torso", "upper_arm_left", "forearm_left", "upper_arm_right", "forearm_right", "head")
    for name in segments:
        index = BODY.segment_names.index(name)
        center = BODY(big.pose, big.size).centers[0, index]
        u, v = big.camera.project(center).round().int().tolist()
        assert frame.labels[0, v, u] == index + 1
        in_front = center[2] - frame.depth[0, v, u]
        assert 0.01 < in_front < 0.16  # m: the surface is one radius nearer than the middle


def test_the_truth_is_the_body_in_its_pose():
    posed = BODY(recording().pose, recording().size)
    assert torch.equal(recording().joints, posed.joints)
    assert len(recording()) == 3
    assert recording().joints.shape == (3, 15, 3)


def test_frames_come_one_by_one_or_together_in_any_order():
    last = recording().frames(2)
    whole = recording().frames()
    assert whole.left.shape == (3, 3, 60, 80)
    assert torch.equal(whole.left[2:], last.left)
    assert [torch.equal(frame.right[0], whole.right[i]) for i, frame in enumerate(recording())] == [True] * 3
    again = make_recording("left_leg", 4, 1, 3, CAMERA, body=BODY).frames(1, 2)
    assert torch.equal(whole.left[1:2], again.left)
    with pytest.raises(ValueError, match="frames must be a range within 0 to 3, got 2 to 5"):
        recording().frames(2, 5)


def test_a_written_recording_reads_back_exactly(tmp_path):
    left, right = recording().background(2)
    frames = (
        Frame(i, i / CAMERA.frame_rate, frame.left[0], frame.right[0]) for i, frame in enumerate(recording())
    )
    write_recording(tmp_path, recording().camera, frames, Backgrounds(left, right))
    read = open_recording(tmp_path)
    assert read.camera == CAMERA
    assert len(read) == 3
    torch.testing.assert_close(read[1].left, recording().frames(1, 2).left[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(read.background().right, right, atol=1e-6, rtol=0)


def test_written_truth_reads_back(tmp_path):
    recording().write_truth(tmp_path)
    whole = recording().frames()
    with np.load(tmp_path / "truth" / "truth.npz") as truth:
        np.testing.assert_array_equal(truth["joints_cam"], recording().joints)
        np.testing.assert_array_equal(truth["pose"], recording().pose)
        assert tuple(truth["joint_names"]) == BODY.joint_names
        assert tuple(truth["part_names"][1:]) == BODY.segment_names
        u = truth["joints_uv"][..., 0]
    f, cx = CAMERA.focal_length, CAMERA.cx
    x, _, z = recording().joints.numpy().transpose(2, 0, 1)
    np.testing.assert_allclose(u, f * x / z + cx, atol=1e-3)
    depth = cv2.imread(str(tmp_path / "truth" / "000002_depth.png"), cv2.IMREAD_UNCHANGED)
    labels = cv2.imread(str(tmp_path / "truth" / "000002_label.png"), cv2.IMREAD_UNCHANGED)
    assert depth is not None
    assert depth.dtype == np.uint16
    np.testing.assert_allclose(depth / 1000, whole.depth[2], atol=6e-4)
    np.testing.assert_array_equal(labels, whole.labels[2])


def test_the_demonstration_is_ready_to_run():
    demo = make_demo()
    assert len(demo) == 30
    assert (demo.camera.width, demo.camera.height) == (640, 480)
    assert torch.equal(demo.pose, make_demo().pose)
    assert not torch.equal(demo.pose, make_demo(1).pose)


def test_the_principal_point_is_not_the_middle_of_the_image():
    camera = synthetic_camera()
    assert camera.cx != 319.5
    assert camera.cy != 239.5
    assert camera.focal_length == 600


def test_the_plan_has_the_sequences_asked_for_and_test_people_never_train():
    config = DatabaseConfig(train_subjects=5, test_subjects=8, train_sequences=15, test_sequences=40)
    plan = plan_database(config)
    assert len(plan) == 8 * 55
    assert len({(clip.activity, clip.subject, clip.take) for clip in plan}) == len(plan)
    people = {split: {clip.subject for clip in plan if clip.split == split} for split in ("train", "test")}
    assert len(people["train"]) == 5
    assert len(people["test"]) == 8
    assert not people["train"] & people["test"]
    for activity in config.activities:
        count = [clip.split for clip in plan if clip.activity == activity]
        assert (count.count("train"), count.count("test")) == (15, 40)


@functools.cache
def nuisances() -> tuple[np.ndarray, np.ndarray]:
    """Length, noise, place (x, z of the hips on the average, m) and heading of 40 sequences of each activity."""
    config = DatabaseConfig(train_sequences=15, test_sequences=25)
    camera = synthetic_camera(config.width, config.height, config.frame_rate)
    size = functools.cache(lambda subject: draw_person(subject).size(BODY))
    rows, activities = [], []
    for clip in plan_database(config):
        times = torch.arange(clip.frames) / config.frame_rate
        with torch.no_grad():
            pose = perform(BODY, size(clip.subject), clip.activity, times, camera, clip.subject, clip.take)
        x, _, z, heading = pose[:, :4].mean(0).tolist()
        rows.append((clip.frames, clip.noise, x, z, heading))
        activities.append(clip.activity)
    return np.array(rows), np.array(activities)


def test_lengths_noise_places_and_headings_are_of_one_distribution():
    rows, activities = nuisances()
    low, high = DatabaseConfig().frames
    assert set(rows[:, 0]) == set(range(low, high + 1))
    for value in rows.T:
        groups = [value[activities == activity] for activity in DatabaseConfig().activities]
        assert f_oneway(*groups).pvalue > 1e-3


def test_length_noise_place_and_heading_do_not_teach_the_activity():
    rows, activities = nuisances()
    half = np.arange(len(rows)) % 2 == 0
    right = []
    for train, test in ((half, ~half), (~half, half)):
        forest = RandomForestClassifier(100, min_samples_leaf=3, random_state=0)
        right.append(forest.fit(rows[train], activities[train]).score(rows[test], activities[test]))
    chance = 1 / len(set(activities))
    error = (chance * (1 - chance) / len(rows)) ** 0.5
    assert abs(np.mean(right) - chance) < 3 * error


def test_keys_change_with_what_the_clip_depends_on_and_with_nothing_else():
    config = DatabaseConfig()
    clip = plan_database(config)[0]
    key = clip.key(config, "0.1.0", "pipeline")
    assert key == plan_database(DatabaseConfig())[0].key(DatabaseConfig(), "0.1.0", "pipeline")
    assert key == clip.key(dataclasses.replace(config, test_sequences=9), "0.1.0", "pipeline")
    others = [
        clip.key(dataclasses.replace(config, width=640), "0.1.0", "pipeline"),
        clip.key(dataclasses.replace(config, frame_rate=20.0), "0.1.0", "pipeline"),
        clip.key(config, "0.2.0", "pipeline"),
        clip.key(config, "0.1.0", "another"),
        dataclasses.replace(clip, noise=1.0).key(config, "0.1.0", "pipeline"),
    ]
    room = dataclasses.replace(config.synthesis.render.room, depth=5.5)
    render = dataclasses.replace(config.synthesis.render, room=room)
    synthesis = dataclasses.replace(config.synthesis, render=render)
    others.append(clip.key(dataclasses.replace(config, synthesis=synthesis), "0.1.0", "pipeline"))
    assert len({key, *others}) == 7
    assert key.startswith("left_hand-")


def test_a_planned_clip_records_as_planned():
    config = DatabaseConfig(width=80, height=60, frames=(3, 5))
    clip = plan_database(config)[5]
    recording = clip.record(config, BODY)
    assert len(recording) == clip.frames
    assert recording.camera.frame_rate == 10
    assert torch.equal(recording.pose, clip.record(config, BODY).pose)
    assert torch.equal(recording.frames(0, 1).left, clip.record(config, BODY).frames(0, 1).left)
    louder = dataclasses.replace(clip, noise=5.0).record(config, BODY).frames(0, 1).left
    assert not torch.equal(recording.frames(0, 1).left, louder)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"activities": ("left_hand", "jumping")}, r"activities must be some of .* got \['jumping'\]"),
        ({"activities": ()}, "got none"),
        ({"train_subjects": 0}, "train_subjects must be at least 1"),
        ({"frames": (9, 5)}, "frames must be a positive range, low to high, got 9 to 5"),
    ],
)
def test_senseless_plans_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        DatabaseConfig(**wrong)


def test_a_recording_needs_frames_and_a_known_motion():
    with pytest.raises(ValueError, match="at least one frame, got 0"):
        make_recording("free", frames=0)
    with pytest.raises(ValueError, match="the motion must be one of"):
        make_recording("jumping", body=BODY)
