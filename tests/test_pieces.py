"""The connected pieces of masks beside SciPy's, image by image."""

import numpy as np
import pytest
import scipy.ndimage
import torch
from torch.testing import assert_close

from torchpose.vision.pieces import connected_pieces


@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("share", [0.0, 0.4, 0.6, 1.0])
def test_pieces_are_scipy_s_and_images_stay_apart(connectivity, share):
    masks = torch.rand(3, 9, 14) < share
    pieces = connected_pieces(masks, connectivity)
    structure = np.ones((3, 3)) if connectivity == 8 else None
    number = 0
    for k, mask in enumerate(masks.numpy()):
        labels, count = scipy.ndimage.label(mask, structure)
        for index, (rows, columns) in enumerate(scipy.ndimage.find_objects(labels), 1):
            part = torch.from_numpy(labels == index)
            (label,) = pieces.labels[k][part].unique().tolist()
            assert label > 0
            assert torch.equal(
                pieces.labels == label, torch.zeros_like(masks).index_put((torch.tensor(k),), part)
            )
            assert int(pieces.area[label]) == int(part.sum())
            assert int(pieces.image[label]) == k
            box = [columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start]
            assert pieces.box[label].tolist() == box
        number += count
    assert len(pieces.area) == len(pieces.image) == len(pieces.box) == number + 1
    assert torch.equal(pieces.labels > 0, masks)
    assert int(pieces.area[0]) == int((~masks).sum())


def test_the_best_piece_of_each_image_and_none_where_no_score_is_positive():
    masks = torch.zeros(4, 6, 20, dtype=torch.bool)
    masks[0, 1, 1:4] = masks[0, 3, 1:9] = masks[1, 5, 5:9] = masks[3, 0, 0:2] = True  # image 2 is empty
    pieces = connected_pieces(masks)
    best = pieces.best(pieces.area)
    assert pieces.area[best].tolist()[:2] == [8, 4]
    assert best[2] == 0
    assert pieces.labels[3, 0, 0] == best[3]
    long = pieces.area > 3
    assert_close(pieces.best(torch.where(long, 1.0 / pieces.area, -1.0))[[0, 1]], best[[0, 1]])
    assert pieces.best(torch.where(long, 1.0, -1.0))[3] == 0
