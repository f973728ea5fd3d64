"""Artefacts: clumps against OpenCV's and SciPy's components, and hard scenes about a drawn person."""

import numpy as np
import pytest
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch.testing import assert_close

from torchpose.vision.camera import StereoCamera
from torchpose.vision.clump import ArtefactConfig, clumps, keep_points, person_points
from torchpose.vision.points import PointCloud, SamplingConfig, sample_grid

CAMERA = StereoCamera(320, 240, 150.0, 159.5, 119.5, 0.12)
HEAD, BODY = torch.tensor([[0.0, -0.55, 2.95]]), torch.tensor([[0.0, 0.0, 3.0]])
SD = torch.tensor([0.05])


def scene(*boxes):
    """A cloud of flat boxes (left, right, top, bottom, depth; m), the nearer before the further."""
    depth = torch.full((1, 240, 320), torch.nan)
    for left, right, top, bottom, z in sorted(boxes, key=lambda box: -box[4]):
        u = [round(x * 150 / z + 159.5) for x in (left, right)]
        v = [round(y * 150 / z + 119.5) for y in (top, bottom)]
        depth[0, max(v[0], 0) : v[1], max(u[0], 0) : u[1]] = z
    return sample_grid(depth, depth.isfinite(), CAMERA, SamplingConfig(num_points=600, isolation=9.0))


PERSON = ((-0.1, 0.1, -0.68, -0.4, 2.95), (-0.22, 0.22, -0.4, 0.3, 2.9), (-0.2, 0.2, 0.3, 1.1, 2.93))


def kept_of(cloud, body=BODY, sd=SD):
    return person_points(cloud, HEAD, body, sd, sd)


def inside(cloud, left, right, top, bottom, z, margin=0.03):
    x, y, own = cloud.points.unbind(-1)
    found = (x > left - margin) & (x < right + margin) & (y > top - margin) & (y < bottom + margin)
    return found & ((own - z).abs() < 1e-3) & cloud.mask


def test_clumps_are_components_of_the_graph():
    generator = torch.Generator().manual_seed(0)
    batch, num = 3, 400
    nodes = torch.stack(
        [torch.randperm(30 * 30, generator=generator)[:num].sort().values for _ in range(batch)]
    )
    grid = torch.stack([nodes // 30, nodes % 30], -1)
    mask = torch.rand(batch, num, generator=generator) < 0.9
    points = torch.rand(batch, num, 3, generator=generator) * 0.3
    grid[~mask] = -1
    found = clumps(points, grid, mask, 0.1)
    assert (found[~mask] == -1).all()
    for k in range(batch):
        index = mask[k].nonzero()[:, 0]
        at, z = grid[k, index].numpy(), points[k, index, 2].numpy()
        beside = (abs(at[:, None] - at[None]).max(-1) == 1) & (abs(z[:, None] - z[None]) <= 0.1)
        count, label = connected_components(coo_matrix(beside), directed=False)
        ours = found[k, index].numpy()
        assert len(set(ours)) == count > 20
        assert len(set(zip(ours, label, strict=True))) == count
        first = [int(index[label == label[i]][0]) for i in range(len(index))]
        assert ours.tolist() == first  # named by its first point


def test_nothing_of_a_person_alone_goes():
    wide = ((-0.9, -0.22, -0.35, -0.22, 2.9), (0.22, 0.9, -0.35, -0.22, 2.9))  # arms stretched out
    up = ((0.12, 0.22, -1.1, -0.4, 2.9),)
    before = ((-0.15, 0.15, -0.2, 0.0, 2.4),)  # hands before the chest are a clump of their own
    for arms in ((), wide, up, before):
        cloud = scene(*PERSON, *arms)
        assert torch.equal(kept_of(cloud), cloud.mask)


def test_what_is_far_or_not_joined_goes_as_a_whole():
    wall = (-1.9, -1.3, -0.6, 0.6, 4.5)
    chair = (0.55, 1.3, 0.2, 0.9, 3.0)  # its near half is within reach
    other = (0.75, 1.1, -0.7, 0.9, 2.2)  # somebody else, before the camera
    cloud = scene(*PERSON, wall, chair, other)
    kept = kept_of(cloud)
    for box in PERSON:
        assert kept[inside(cloud, *box)].all()
    for box in (wall, chair, other):
        assert inside(cloud, *box).sum() > 10
        assert not kept[inside(cloud, *box)].any()


def test_legs_below_a_table_stay_and_a_wall_leant_on_goes_beyond_reach():
    table = scene(PERSON[0], (-0.22, 0.22, -0.4, 0.2, 2.9), (-0.2, 0.2, 0.6, 1.1, 2.93))
    assert torch.equal(kept_of(table), table.mask)
    leant = scene(*PERSON, (0.22, 2.6, -0.8, 0.9, 2.95))
    kept = kept_of(leant)
    for box in PERSON:
        assert kept[inside(leant, *box)].all()
    x = leant.points[..., 0]
    assert not kept[leant.mask & (x > 1.3)].any()
    assert kept[leant.mask & (x < 1.0)].all()


def test_a_lone_speck_goes_unless_it_lies_on_the_person():
    speck = (0.5, 0.62, 0.3, 0.36, 2.7)  # half of it is near
    cloud = scene(*PERSON, speck)
    assert inside(cloud, *speck).sum() > 3
    assert not kept_of(cloud)[inside(cloud, *speck)].any()
    on = scene(*PERSON, (0.0, 0.06, 0.0, 0.06, 2.7))
    assert torch.equal(kept_of(on), on.mask)


def test_without_a_track_or_with_a_doubtful_one_all_stay():
    cloud = scene(*PERSON, (-1.9, -1.3, -0.6, 0.6, 4.5))
    nothing = torch.full_like(BODY, torch.nan)
    assert torch.equal(kept_of(cloud, body=nothing), cloud.mask)
    assert torch.equal(kept_of(cloud, sd=torch.tensor([0.5])), cloud.mask)
    # Where all would go it is the track that is wrong.
    assert torch.equal(person_points(cloud, HEAD + 20, BODY + 20, SD, SD), cloud.mask)
    headless = person_points(cloud, nothing, BODY, SD, SD)
    assert headless[inside(cloud, *PERSON[1])].all()
    assert not headless[cloud.points[..., 2] > 4].any()


def test_a_batch_is_its_rows():
    clouds = [scene(*PERSON), scene(*PERSON, (-1.9, -1.3, -0.6, 0.6, 4.5)), scene(PERSON[1])]
    cloud = PointCloud(*(torch.cat([getattr(c, name) for c in clouds]) for name in vars(clouds[0])))
    head, body, sd = HEAD.repeat(3, 1), BODY.repeat(3, 1), SD.repeat(3)
    body[2] = torch.nan
    kept = person_points(cloud, head, body, sd, sd)
    for k, own in enumerate(clouds):
        alone = person_points(own, head[k : k + 1], body[k : k + 1], sd[k : k + 1], sd[k : k + 1])
        assert torch.equal(kept[k : k + 1], alone)


def test_a_cut_cloud_is_the_cloud_of_the_cut_silhouette():
    cloud = scene(*PERSON, (-1.9, -1.3, -0.6, 0.6, 4.5))
    kept = kept_of(cloud)
    cut = keep_points(cloud, kept)
    count = int(kept.sum())
    assert 0 < count < int(cloud.mask.sum())
    assert cut.mask[0].tolist() == [True] * count + [False] * (600 - count)
    assert_close(cut.points[0, :count], cloud.points[0, kept[0]])
    assert_close(cut.pixels[0, :count], cloud.pixels[0, kept[0]])
    assert torch.equal(cut.grid[0, :count], cloud.grid[0, kept[0]])
    for values, blank in ((cut.points, 0), (cut.pixels, 0), (cut.grid, -1), (cut.neighbours, 600)):
        assert (values[0, count:] == blank).all()
    # Neighbours are those of the same nodes as before.
    node = [tuple(x) for x in cloud.grid[0].tolist()]
    for new, old in enumerate(kept[0].nonzero()[:, 0].tolist()):
        before = {node[i] for i in cloud.neighbours[0, old].tolist() if i < 600 and kept[0, i]}
        after = {tuple(cut.grid[0, i].tolist()) for i in cut.neighbours[0, new].tolist() if i < 600}
        assert before == after
    whole = keep_points(cloud, cloud.mask)
    for name, value in vars(cloud).items():
        assert torch.equal(getattr(whole, name), value)


def test_bad_input_is_said():
    with pytest.raises(ValueError, match=r"core must be below reach, got 2\.0 and 1\.1 m"):
        ArtefactConfig(core=2.0)
    with pytest.raises(ValueError, match=r"spill must be a share in \[0, 1\), got 1\.0"):
        ArtefactConfig(spill=1.0)
    with pytest.raises(ValueError, match="joint must be positive, got nan m"):
        ArtefactConfig(joint=float(np.nan))
