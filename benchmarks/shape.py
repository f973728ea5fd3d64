"""How far the body file's ellipsoids lie from the skin of the rendered people, when they stand at the true joints.

python -m benchmarks.shape PEOPLE [--frames N] [--fit STEPS] [key=value ...]

The pose is the true one and so are the lengths; every rigid body is moved onto its true joint, so that what is left is
the shape of the ellipsoids. Each true point of the surface, of a known part, goes to the nearest visible point of its
part's ellipsoid: `rms` is its distance, `outside` its mean with a sign (positive where the skin lies outside of the
ellipsoid), mm. `rim` is how far the ellipsoid's rim stands out of the true mask, mean over its points, mm.

With `--fit` the ellipsoids are then fitted to the same points and masks, near those of the file, and their entries are
printed. They are one person's: round them, and keep what anatomy says.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from benchmarks.people import SEGMENT_OF_PART, Truth, true_pose, true_size
from torchpose.body.ellipsoid import foot_point
from torchpose.body.model import BodyModel, PosedBody, frame_along
from torchpose.cli import load_config
from torchpose.recording import open_recording, spread_positions
from torchpose.registration.silhouette import RimConfig, nearest_inside, silhouette_rows
from torchpose.vision.camera import StereoCamera

POINTS = 300  # of a part in a frame, at most
FEWEST = 30  # a part that shows less is left out of the frame
RIM = RimConfig(sd=1.0, rim_points=24)  # rows in metres
JOINT_OF_BODY = {"upper_arm": "shoulder", "forearm": "elbow", "thigh": "hip", "shank": "knee"}
# What the fit is held by: m, by which a part's centre, and share, by which its radii may leave the file's.
CENTER_SD, RADIUS_SD, AXIS_SD = 0.04, 0.25, 0.15
ROBUST = 0.05  # m, beyond which a point says no more: it lies on a neighbour's ellipsoid


@dataclass(frozen=True)
class Skin:
    """A frame's surface points, and the body that stands at the true joints."""

    posed: PosedBody
    points: Float[Tensor, "1 num 3"]  # m, camera's frame
    part: Int[Tensor, " num"]  # the segment that each lies on
    nearest: Float[Tensor, "1 height width 2"]  # of the true mask, see `nearest_inside`
    camera: StereoCamera


def look(body: BodyModel, recording: Path, index: int, generator: torch.Generator) -> Skin:
    """One frame of a recording with its truth."""
    truth = Truth(recording)
    camera = open_recording(recording).camera
    posed = body(true_pose(body, truth, index), true_size(body, truth))
    at = {name: joints[index] for name, joints in truth.all_joints.items()}
    origins = posed.origins[0].clone()
    for i, name in enumerate(body.body_names):
        limb, _, side = name.rpartition("_")
        if limb in JOINT_OF_BODY:
            origins[i] = at[f"{JOINT_OF_BODY[limb]}_{side[0].upper()}"]
    moved = origins - posed.origins[0]
    centers = posed.centers + moved[list(body.segment_bodies)]
    labels, depth = torch.from_numpy(truth.labels(index).astype(np.int64)), truth.depth(index)[0]
    points, part = [], []
    for label, name in enumerate(truth.parts):
        if name not in SEGMENT_OF_PART:
            continue
        v, u = ((labels == label) & depth.isfinite()).nonzero(as_tuple=True)
        if len(v) < FEWEST:
            continue
        some = torch.randperm(len(v), generator=generator)[:POINTS]
        v, u = v[some], u[some]
        points.append(camera.back_project(torch.stack([u, v], -1).float(), depth[v, u]))
        part.append(torch.full((len(v),), body.segment_names.index(SEGMENT_OF_PART[name])))
    return Skin(
        replace(posed, origins=origins[None], centers=centers),
        torch.cat(points)[None],
        torch.cat(part),
        nearest_inside(labels[None] > 0),
        camera,
    )


def gaps(skin: Skin, posed: PosedBody) -> tuple[Tensor, Tensor, Tensor]:
    """Distance of each point from its part's ellipsoid and the same with its sign, m; overhang of each rim point, m."""
    foot = foot_point(posed, skin.points)
    index = skin.part[None, None, :]
    distance = foot.distance.gather(1, index)[0, 0]
    side = (foot.residual * foot.normal).sum(-1).sign().gather(1, index)[0, 0]
    rows = silhouette_rows(posed, skin.nearest, skin.camera, RIM)
    rim = (rows.direction * (rows.target - rows.points(posed))).sum(-1).abs()
    return distance, distance * side, rim.unflatten(1, (-1, RIM.rim_points))[0]


def measure(skins: Sequence[Skin], names: Sequence[str], shape: "Shape | None" = None) -> None:
    """Print the figures, per segment, left and right together."""
    bases = list(dict.fromkeys(base_name(name) for name in names))
    sums = torch.zeros(len(bases), 6)
    row = torch.tensor([bases.index(base_name(name)) for name in names])
    for skin in skins:
        posed = skin.posed if shape is None else shape.place(skin.posed)
        distance, signed, rim = gaps(skin, posed)
        one = torch.ones_like(distance)
        sums[:, :3].index_add_(0, row[skin.part], torch.stack([distance**2, signed, one], 1))
        seen = torch.zeros(len(names)).index_fill_(0, skin.part, 1.0)
        sums[:, 3:5].index_add_(0, row, torch.stack([rim.mean(1), torch.ones(len(names))], 1) * seen[:, None])
    print(f"{'segment':10s}  rms mm  outside mm  rim mm")
    rms, outside, rim = (sums[:, 0] / sums[:, 2]).sqrt(), sums[:, 1] / sums[:, 2], sums[:, 3] / sums[:, 4]
    for name, *values in zip(bases, *(1000 * x for x in (rms, outside, rim)), strict=True):
        print(f"{name:10s}  {values[0]:6.1f}  {values[1]:10.1f}  {values[2]:6.1f}")
    print(f"{'all':10s}  {1000 * (sums[:, 0].sum() / sums[:, 2].sum()).sqrt():6.1f}")


def base_name(name: str) -> str:
    return name.removesuffix("_left").removesuffix("_right")


class Shape:
    """Ellipsoids that can be moved: centre (m), long axis and half axes of the left and the middle segments."""

    def __init__(self, body: BodyModel, posed: PosedBody):
        self.body = body
        self.names = [name for name in body.segment_names if not name.endswith("_right")]
        index = [body.segment_names.index(name) for name in self.names]
        on = [body.segment_bodies[i] for i in index]
        R = posed.rotations[0, on]
        center = ((posed.centers[0, index] - posed.origins[0, on])[:, None] @ R)[:, 0]
        self.start = torch.cat(
            [center, body.segment_frames[index][:, :, 2], posed.radii[0, index].log()], 1
        ).detach()
        self.value = self.start.clone().requires_grad_()
        middle = torch.tensor([not name.endswith("_left") for name in self.names])
        self.mask = torch.ones_like(self.start)
        self.mask[:, 0] = self.mask[:, 3] = (~middle).float()  # the trunk and the head are symmetric

    def place(self, posed: PosedBody) -> PosedBody:
        """The same bodies with these ellipsoids on them."""
        value = self.start + (self.value - self.start) * self.mask
        row = [self.names.index(name.replace("_right", "_left")) for name in self.body.segment_names]
        side = torch.tensor(
            [[-1.0 if name.endswith("_right") else 1.0, 1, 1] for name in self.body.segment_names]
        )
        on = list(self.body.segment_bodies)
        R = posed.rotations[0, on]
        center = posed.origins[0, on] + (R @ (value[row, :3] * side)[..., None])[..., 0]
        frame = R @ frame_along(torch.nn.functional.normalize(value[row, 3:6] * side, dim=1))
        radii = value[row, 6:].exp()
        radii = torch.cat([radii[:, :2], radii.amax(1, keepdim=True)], 1)
        return replace(posed, centers=center[None], frames=frame[None], radii=radii[None])

    def prior(self) -> Tensor:
        gone = (self.value - self.start) / torch.tensor(3 * [CENTER_SD] + 3 * [AXIS_SD] + 3 * [RADIUS_SD])
        return (gone**2).sum()

    def entries(self, size: Float[Tensor, " sizes"]) -> None:
        """Print them as entries of a body file."""
        value = (self.start + (self.value - self.start) * self.mask).detach()
        segments = {segment.name: segment for segment in self.body.skeleton.segments}
        for name, row in zip(self.names, value, strict=True):
            segment = segments[name]
            terms, (girth, _), (length, _) = segment.center.terms, segment.radius, segment.half_length
            unit = {n: float(size[self.body.size_names.index(n)]) for n in (terms[0][0], girth, length)}
            center = [round(float(x) / unit[terms[0][0]], 3) for x in row[:3]]
            axis = [round(float(x), 2) for x in row[3:6] / row[3:6].abs().max()]
            radii = row[6:].exp()
            across = [round(float(x) / unit[girth], 3) for x in radii[:2]]
            half = round(float(radii[2]) / unit[length], 3)
            print(
                f"  {base_name(name)}: center: {{{terms[0][0]}: {center}}}, axis: {axis}, "
                f"radius: {{{girth}: {across}}}, half_length: {{{length}: {half}}}"
            )


def fit(skins: Sequence[Skin], shape: Shape, steps: int) -> None:
    """Adam on robust distances and overhangs, the file's shape as the prior."""
    optimizer = torch.optim.Adam([shape.value], lr=0.005)
    for _ in range(steps):
        optimizer.zero_grad()
        loss = shape.prior()
        for skin in skins:
            distance, _, rim = gaps(skin, shape.place(skin.posed))
            square = distance**2
            loss = loss + (square / (square + ROBUST**2)).sum() * (ROBUST / 0.02) ** 2 / POINTS
            loss = loss + (rim.clamp_max(0.1) / 0.02).square().mean()
        loss.backward()
        optimizer.step()


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.shape", description=__doc__.split("\n")[0])
    parser.add_argument("people", type=Path, help="folder of recordings, each with a truth/ folder")
    parser.add_argument("settings", nargs="*", help="settings of infer.py, key=value (body.path)")
    parser.add_argument("--frames", type=int, default=4, help="of each recording")
    parser.add_argument("--fit", type=int, default=0, metavar="STEPS", help="also fit the shape, e.g. 120")
    args = parser.parse_args(argv)
    body = BodyModel(load_config("infer", args.settings).pose.body)
    folders = sorted(path.parent for path in args.people.glob("*/truth"))
    if not folders:
        parser.error(f"{args.people} must hold recordings with a truth/ folder, found none")
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        skins = [
            look(body, folder, index, generator)
            for folder in folders
            for index in spread_positions(len(Truth(folder).joints), args.frames)
        ]
        measure(skins, body.segment_names)
    if args.fit:
        shape = Shape(body, skins[0].posed)
        fit(skins, shape, args.fit)
        with torch.no_grad():
            measure(skins, body.segment_names, shape)
        shape.entries(true_size(body, Truth(folders[0]))[0])


if __name__ == "__main__":
    main()
