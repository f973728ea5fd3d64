"""Mean shift: OpenCV's on back-projections, scikit-learn's and SciPy's on clouds."""

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from sklearn.cluster import MeanShift
from torch.testing import assert_close

from torchpose.vision.mean_shift import Kernel, MeanShiftConfig, cam_shift, mean_shift, shift_window

CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1)
KINDS = ("noise", "ellipse", "one pixel", "sparse", "empty", "two blobs")


def picture(kind, generator, height=90, width=120):
    image = np.zeros((height, width), np.uint8)
    if kind == "noise":
        image = generator.integers(0, 256, image.shape).astype(np.uint8)
    elif kind in ("ellipse", "two blobs"):
        for _ in range(1 + (kind == "two blobs")):
            centre = int(generator.integers(0, width)), int(generator.integers(0, height))
            axes = int(generator.integers(2, 30)), int(generator.integers(2, 30))
            value = int(generator.integers(50, 256))
            cv2.ellipse(image, centre, axes, float(generator.uniform(0, 180)), 0, 360, value, -1)
    elif kind == "one pixel":
        image[generator.integers(0, height), generator.integers(0, width)] = 7
    elif kind == "sparse":
        image[generator.random(image.shape) < 0.02] = 200
    return image


def boxes(generator, count, height=90, width=120):
    """Windows that overlap the image, many of them its border."""
    corner = [generator.integers(-20, [width - 1, height - 1]) for _ in range(count)]
    return [(*map(int, at), *map(int, generator.integers(21, 60, 2))) for at in corner]


@pytest.mark.parametrize("kind", KINDS)
def test_windows_move_as_opencvs(kind):
    generator = np.random.default_rng(len(kind))
    images = [picture(kind, generator) for _ in range(40)]
    starts = boxes(generator, 40)
    tensor = torch.from_numpy(np.stack(images)).float()
    found = shift_window(tensor, torch.tensor(starts))
    for k, (image, box) in enumerate(zip(images, starts, strict=True)):
        _, theirs = cv2.meanShift(image, box, CRITERIA)
        assert tuple(found.box[k].tolist()) == tuple(theirs)
        x, y, w, h = theirs
        assert bool(found.found[k]) == bool(image[y : y + h, x : x + w].any())


@pytest.mark.parametrize("kind", KINDS)
def test_size_and_direction_are_opencvs(kind):
    generator = np.random.default_rng(10 + len(kind))
    images = [picture(kind, generator) for _ in range(40)]
    starts = boxes(generator, 40)
    found = cam_shift(torch.from_numpy(np.stack(images)).double(), torch.tensor(starts))
    for k, (image, box) in enumerate(zip(images, starts, strict=True)):
        (centre, (width, length), angle), window = cv2.CamShift(image, box, CRITERIA)
        if (centre, (width, length), angle) == ((0, 0), (0, 0), 0):
            assert not found.window.found[k]
            assert found.length[k].isnan()
            continue
        assert tuple(found.window.box[k].tolist()) == tuple(window)
        assert_close([found.length[k].item(), found.width[k].item()], [length, width], atol=1e-3, rtol=1e-5)
        if length - width > 0.01:  # a disc has no direction
            turn = np.degrees(found.angle[k].item()) + 90 - angle
            assert abs((turn + 90) % 180 - 90) < 1e-2
    assert found.window.found.any() == (kind != "empty")


def test_a_window_off_the_image_stays_and_says_so():
    image = torch.ones(4, 30, 40)
    box = torch.tensor([[-50, 3, 20, 10], [3, 60, 20, 10], [40, 0, 5, 5], [0, 0, 40, 30]])
    for found in (shift_window(image, box), cam_shift(image, box).window):
        assert found.found.tolist() == [False, False, False, True]
        assert torch.equal(found.box[:3], box[:3])
    assert cam_shift(image, box).centre[:3].isnan().all()


def test_an_ellipse_is_found_with_its_axes():
    """A filled ellipse has standard deviations of half its semi-axes: four of them are its diameters."""
    v, u = torch.meshgrid(torch.arange(200.0), torch.arange(240.0), indexing="ij")
    turned = np.radians(30)
    along = (u - 130) * np.cos(turned) + (v - 90) * np.sin(turned)
    across = -(u - 130) * np.sin(turned) + (v - 90) * np.cos(turned)
    image = ((along / 50) ** 2 + (across / 20) ** 2 <= 1).float()[None]
    box = torch.tensor([[60, 60, 100, 60]])
    for _ in range(5):
        found = cam_shift(image, box)
        box = found.window.box
    assert_close(found.centre, torch.tensor([[130.0, 90.0]]), atol=0.1, rtol=0)
    assert_close(found.length, torch.tensor([100.0]), atol=0.5, rtol=0)
    assert_close(found.width, torch.tensor([40.0]), atol=0.5, rtol=0)
    assert_close(found.angle.item(), turned, atol=0.01, rtol=0)


def cloud(generator, count=200):
    centres = generator.normal(size=(3, 3))
    return centres[generator.integers(0, 3, count)] + 0.15 * generator.normal(size=(count, 3))


def test_the_flat_kernel_is_scikit_learns():
    generator = np.random.default_rng(0)
    for _ in range(5):
        points = cloud(generator)
        start = points[generator.integers(0, len(points), 4)]
        config = MeanShiftConfig(bandwidth=0.4, kernel=Kernel.flat, steps=300, tolerance=1e-9)
        ours = mean_shift(
            torch.from_numpy(points)[None], torch.ones(1, len(points)), torch.from_numpy(start)[None], config
        )
        assert ours.converged.all()
        for k in range(4):
            theirs = MeanShift(bandwidth=0.4, seeds=start[k : k + 1], max_iter=300).fit(points)
            assert_close(ours.position[0, k], torch.from_numpy(theirs.cluster_centers_[0]), atol=1e-6, rtol=0)


def test_the_gaussian_kernel_ends_on_a_maximum_of_the_density():
    generator = np.random.default_rng(1)
    points, weights = cloud(generator), generator.random(200)
    config = MeanShiftConfig(bandwidth=0.2, steps=500, tolerance=1e-9)
    start = torch.from_numpy(points[:10])[None]
    ours = mean_shift(torch.from_numpy(points)[None], torch.from_numpy(weights)[None], start, config)
    assert ours.converged.all()

    def density(x):
        return (weights * np.exp(-0.5 * ((points - x) ** 2).sum(1) / 0.2**2)).sum()

    for k in range(10):
        place = ours.position[0, k].numpy()
        best = minimize(lambda x: -density(x), place, tol=1e-10)
        assert np.linalg.norm(best.x - place) < 1e-4
        assert density(place) >= density(points[k])
        assert_close(ours.weight[0, k].item(), density(place), rtol=1e-6, atol=0)


def test_padding_starts_out_of_reach_and_batches():
    generator = np.random.default_rng(2)
    points = torch.from_numpy(np.stack([cloud(generator) for _ in range(3)]))
    mask = torch.rand(3, 200) < 0.7
    mask[2] = False
    points[~mask] = torch.nan
    start = torch.stack([points[0][mask[0]][:2], points[1][mask[1]][:2], torch.zeros(2, 3).double()])
    start[0, 1] = 100.0
    config = MeanShiftConfig(bandwidth=0.3, kernel=Kernel.flat)
    found = mean_shift(points, mask, start, config)
    assert found.position.isfinite().all(-1).tolist() == [[True, False], [True, True], [False, False]]
    assert found.converged.tolist() == [[True, False], [True, True], [False, False]]
    for row, k in ((0, 0), (1, 0), (1, 1)):
        kept = points[row][mask[row]][None]
        alone = mean_shift(kept, torch.ones(1, kept.shape[1]), start[row : row + 1, k : k + 1], config)
        assert_close(found.position[row, k], alone.position[0, 0])


def test_bad_input_is_said():
    with pytest.raises(ValueError, match=r"at least 1 px wide and high, got \(0, 5\)"):
        shift_window(torch.ones(1, 9, 9), torch.tensor([[0, 0, 0, 5]]))
    with pytest.raises(ValueError, match=r"bandwidth must be positive, got 0\.0"):
        MeanShiftConfig(bandwidth=0.0)
    with pytest.raises(ValueError, match="steps must be at least 1, got 0"):
        MeanShiftConfig(steps=0)
