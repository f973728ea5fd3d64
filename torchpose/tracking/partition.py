"""Whose pixels are whose: a silhouette of several people, split among those who are followed and newcomers.

Left-camera frame, metres; pixels (row, column).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body.ellipsoid import rough_distance
from torchpose.body.model import PosedBody
from torchpose.registration.silhouette import nearest_inside
from torchpose.vision.camera import StereoCamera
from torchpose.vision.pieces import connected_pieces


@dataclass(frozen=True)
class PartitionConfig:
    stride: int = 2  # px between the pixels that are judged
    jump: float = 0.20  # m of depth between neighbouring pixels, from which they are of different surfaces
    near: float = 0.35  # m from an expected body, within which a surface may be that person's
    known_share: float = 0.3  # of a piece's pixels that must be near somebody, or the piece is nobody's yet
    clear_share: float = 0.85  # of these that must be nearest to one person, to give that one the whole piece
    least_area: float = 0.08  # m^2 of a newcomer's surface
    least_height: float = 0.5  # m of a newcomer
    aside: float = 0.45  # m, seen from above, by which pieces of one newcomer lie apart

    def __post_init__(self) -> None:
        if self.stride < 1:
            raise ValueError(f"stride must be at least 1 px, got {self.stride}")
        for name in ("jump", "near", "least_area", "least_height", "aside"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("known_share", "clear_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be a share in [0, 1], got {getattr(self, name)}")


def split_people(
    silhouette: Bool[Tensor, "height width"],
    depth: Float[Tensor, "height width"],
    camera: StereoCamera,
    expected: PosedBody | None,
    config: PartitionConfig = PartitionConfig(),
) -> Bool[Tensor, "people height width"]:
    """A mask for each expected person, in their order, and after these one for each newcomer, the largest first.

    The silhouette falls into pieces where depth jumps. A piece near one expected body is that person's; one near
    several is split, every pixel to the nearest body, so that the nearest in depth wins where people overlap. A piece
    near nobody is a newcomer's, together with others of these above and below it, if they are as large and as tall as
    somebody; smaller ones are nobody's.

    Args:
        depth: m, NaN where unknown; such pixels follow the nearest pixel whose depth is known.
        expected: where those who are followed should be, one a row of the batch; None: nobody is.
    """
    step, people = config.stride, 0 if expected is None else len(expected.centers)
    mask, z = silhouette[::step, ::step], depth[::step, ::step]
    known = mask & (z > 0)
    rows, columns = known.nonzero(as_tuple=True)
    if not len(rows):
        return silhouette.new_zeros(people, *silhouette.shape)
    pixel = torch.stack([columns, rows], -1).to(z) * step
    points = camera.back_project(pixel, z[rows, columns])
    pieces = connected_pieces((known & ~_edges(z, config.jump))[None], connectivity=4)
    piece = _spread(pieces.labels[0].long(), known)[rows, columns]
    owner = torch.zeros_like(piece)  # 0 is nobody
    near = torch.zeros_like(piece, dtype=torch.bool)
    if expected is not None:
        distance = rough_distance(expected, points.expand(people, -1, -1)).amin(1)  # (people, points)
        least, nearest = distance.min(0)
        near, owner = least < config.near, nearest + 1
        owner = _of_pieces(owner, near, piece, len(pieces.area), people, config)
    foreign = _newcomers(points, near, piece, len(pieces.area), camera, config)
    for i, numbers in enumerate(foreign, people + 1):
        owner = torch.where(torch.isin(piece, numbers), i, owner)
    decided = torch.zeros_like(mask, dtype=torch.long)  # 1 is nobody
    decided[rows, columns] = owner + 1
    # What was not judged, for want of depth or between two judged pixels, follows the nearest one.
    full = _spread(decided, torch.ones_like(mask)).repeat_interleave(step, 0).repeat_interleave(step, 1)
    full = full[: silhouette.shape[0], : silhouette.shape[1]] - 1
    numbers = torch.arange(1, people + len(foreign) + 1, device=full.device)
    return (full == numbers[:, None, None]) & silhouette


def _edges(depth: Float[Tensor, "rows columns"], jump: float) -> Bool[Tensor, "rows columns"]:
    """Pixels behind which depth jumps, to the right or below: where they are taken out, surfaces come apart."""
    edge = torch.zeros_like(depth, dtype=torch.bool)
    edge[:, :-1] |= depth.diff(dim=1).abs() > jump
    edge[:-1] |= depth.diff(dim=0).abs() > jump
    return edge


def _spread(labels: Int[Tensor, "rows columns"], mask: Bool[Tensor, "rows columns"]) -> Tensor:
    """Each pixel of the mask without a label has that of the nearest pixel with one."""
    source = nearest_inside((labels > 0)[None])[0].long()
    return torch.where(mask, labels[source[..., 1], source[..., 0]], 0)


def _of_pieces(
    owner: Int[Tensor, " points"],
    near: Bool[Tensor, " points"],
    piece: Int[Tensor, " points"],
    count: int,
    people: int,
    config: PartitionConfig,
) -> Int[Tensor, " points"]:
    """Owners after each piece has been given whole where it can be, 0 where it is nobody's."""
    size = torch.bincount(piece, minlength=count)
    votes = torch.bincount((piece * (people + 1) + owner)[near], minlength=count * (people + 1))
    votes = votes.view(count, people + 1)
    of_someone = votes.sum(1)
    most, winner = votes.max(1)
    whole = most >= config.clear_share * of_someone
    owner = torch.where(whole[piece], winner[piece], owner)
    return torch.where((of_someone >= config.known_share * size)[piece], owner, 0)


def _newcomers(
    points: Float[Tensor, "points 3"],
    near: Bool[Tensor, " points"],
    piece: Int[Tensor, " points"],
    count: int,
    camera: StereoCamera,
    config: PartitionConfig,
) -> list[Int[Tensor, " numbers"]]:
    """Numbers of the pieces of each newcomer, the largest newcomer first.

    An arm before the hips parts the trunk from the legs, so pieces that are nobody's are taken together with the
    largest one that lies above or below them.
    """
    size = torch.bincount(piece, minlength=count)
    known = torch.bincount(piece[near], minlength=count)
    area = points.new_zeros(count).index_add(
        0, piece, (points[:, 2] * config.stride / camera.focal_length) ** 2
    )
    middle = points.new_zeros(count, 3).index_add(0, piece, points) / size.clamp_min(1)[:, None]
    top, bottom = (
        points.new_full((count,), start).scatter_reduce(0, piece, points[:, 1], how)
        for start, how in ((torch.inf, "amin"), (-torch.inf, "amax"))
    )
    open_ = (size > 0) & (known < config.known_share * size)
    open_[0] = False
    groups = []
    for number in area.argsort(descending=True):
        if not bool(open_[number]):
            continue
        aside = (middle - middle[number])[:, [0, 2]].norm(dim=1)
        group = (open_ & (aside < config.aside)).nonzero()[:, 0]
        open_[group] = False
        tall = bottom[group].max() - top[group].min()
        if bool((area[group].sum() >= config.least_area) & (tall >= config.least_height)):
            groups.append(group)
    return groups
