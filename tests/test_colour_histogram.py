"""Histograms of colours and their back-projection: SciPy's interpolation in a table, and its transpose."""

import cv2
import numpy as np
import torch
from scipy.interpolate import RegularGridInterpolator
from skimage.color import rgb2lab
from torch.testing import assert_close

from torchpose.vision.colour_histogram import (
    BINS,
    HIGH,
    LOW,
    NUM_BINS,
    back_projection,
    colour_histogram,
    colour_similarity,
)
from torchpose.vision.mean_shift import cam_shift


def looked_up(table, images):
    """A table at the colours of (H, W, 3) RGB, linear between its bins' middles."""
    axes = [np.linspace(low, high, n) for low, high, n in zip(LOW, HIGH, BINS, strict=True)]
    return RegularGridInterpolator(axes, table.reshape(BINS))(np.clip(rgb2lab(images), LOW, HIGH))


def test_back_projection_is_interpolation_and_the_histogram_its_transpose():
    generator = np.random.default_rng(0)
    images, mask = generator.random((2, 3, 12, 15)), generator.random((2, 12, 15)) < 0.5
    table = generator.random((2, NUM_BINS))
    tensor = torch.from_numpy(images)
    found = back_projection(tensor.permute(0, 2, 3, 1), torch.from_numpy(table))
    histogram = colour_histogram(tensor, torch.from_numpy(mask))
    assert_close(histogram.sum(1), torch.ones(2).double())
    for k in range(2):
        expected = looked_up(table[k], images[k].transpose(1, 2, 0))
        # kornia's and scikit-image's CIELAB differ by thousandths.
        assert_close(found[k], torch.from_numpy(expected / table[k].max()), atol=2e-3, rtol=0)
        assert_close(float(histogram[k].numpy() @ table[k]), expected[mask[k]].mean(), atol=1e-3, rtol=0)


def test_weights_empty_masks_and_similarity():
    images = torch.zeros(3, 3, 4, 4)
    images[0, 0], images[1, 2], images[2, 0, :2] = 0.6, 0.6, 0.6  # red, blue, half red and half black
    mask = torch.ones(3, 4, 4)
    mask[2, :2] = 3
    one = colour_histogram(images, mask)
    table = colour_similarity(one[:, None], one[None])
    assert_close(table.diagonal(), torch.ones(3))
    assert table[0, 1] < 0.05
    assert_close(table[0, 2].item(), 0.75**0.5, atol=1e-3, rtol=0)
    empty = colour_histogram(images, torch.zeros(3, 4, 4, dtype=torch.bool))
    assert (empty == 0).all()
    assert (back_projection(images.permute(0, 2, 3, 1), empty) == 0).all()


def test_a_shirt_is_found_again_before_a_scene():
    generator = torch.Generator().manual_seed(0)
    image = 0.4 + 0.1 * torch.rand(1, 3, 60, 80, generator=generator)
    shirt = torch.zeros(1, 60, 80, dtype=torch.bool)
    shirt[:, 20:50, 30:50] = True
    colour = torch.tensor([0.7, 0.2, 0.2])[None, :, None, None]
    image = torch.where(shirt[:, None], colour + 0.05 * torch.rand(1, 3, 60, 80, generator=generator), image)
    person, scene = colour_histogram(image, shirt), colour_histogram(image, ~shirt)
    later = image.roll(9, 3)
    share = back_projection(later.permute(0, 2, 3, 1), person, scene)
    assert share[shirt.roll(9, 2)].mean() > 0.8
    assert share[~shirt.roll(9, 2)].mean() < 0.05
    found = cam_shift(share, torch.tensor([[30, 20, 20, 30]]))
    assert_close(found.centre, torch.tensor([[48.5, 34.5]]), atol=1.0, rtol=0)
    bytes_ = (255 * share[0]).round().byte().numpy()
    box, _ = cv2.CamShift(bytes_, (30, 20, 20, 30), (3, 100, 1))
    assert abs(box[0][0] - found.centre[0, 0].item()) < 1.5
