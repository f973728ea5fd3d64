"""The articulated body: pose and sizes in; rigid bodies, ellipsoids and joints in the camera's frame out.

Left-camera frame (x right, y down, z forward); metres and radians. A pose has P = 24 parameters: the root's
translation, its yaw, pitch and roll, then two per joint. A body's own frame is x to its left, y down, z out
of its back.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose.body.skeleton import HUMAN, Hinges, SizedVector, load_skeleton
from torchpose.geometry import axis_pair_angles, exp_rotation, rotation_and_left_jacobian, rotation_between

STRAIGHT = 1e-6  # 1 - cosine, below which a limb goes on straight


class JointKind(Enum):
    """How two degrees of freedom turn a limb: two parts of one rotation vector, or two hinges in a row."""

    anatomical = "anatomical"  # each as the body file says: hinges at elbows and knees, swings elsewhere
    swing = "swing"
    revolute = "revolute"


@dataclass(frozen=True)
class BodyConfig:
    path: str = ""  # a body file; empty for the built-in human.yaml
    joint: JointKind = (
        JointKind.anatomical
    )  # the thesis has revolute, which is singular at every straight limb


@dataclass(frozen=True)
class PosedBody:
    """Where everything is, in the camera's frame."""

    rotations: Float[Tensor, "batch bodies 3 3"]  # R_camera_body
    origins: Float[Tensor, "batch bodies 3"]  # m, of the rigid bodies: the joint to the parent
    centers: Float[Tensor, "batch parts 3"]  # m, of the ellipsoids
    frames: Float[Tensor, "batch parts 3 3"]  # columns: the ellipsoids' axes, the long one last
    radii: Float[Tensor, "batch parts 3"]  # m: half axes along the columns of `frames`
    joints: Float[Tensor, "batch joints 3"]  # m, in the order of `BodyModel.joint_names`
    # Axis of each parameter: a unit vector, but shorter the further a swing has turned (see `left_jacobian`).
    screw_axes: Float[Tensor, "batch parameters 3"]
    screw_origins: Float[Tensor, "batch parameters 3"]  # m, a point on it

    def where(self, rows: Bool[Tensor, " batch"], other: "PosedBody") -> "PosedBody":
        """This body in some rows of the batch, the other one elsewhere."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in PosedBody.__dataclass_fields__)
        return PosedBody(*(torch.where(rows.view(-1, *[1] * (x.ndim - 1)), x, y) for x, y in pairs))


class BodyModel(nn.Module):
    """Forward kinematics of a body file, differentiable in the pose and in the sizes.

    The tree's tables (axes, limits, ancestors) are pytorch-kinematics' own, copied into buffers, and with
    `joint=revolute` the result equals that library's. Geometry is linear in the sizes (B, S), 1 = the body
    file's. Constants are made in torch's default dtype; `.to` converts them.
    """

    axes: Tensor  # (P, 3) of each parameter: the root's in the camera's frame, else in the parent body's
    low: Tensor  # (P,) limits, infinite for the root
    high: Tensor
    moves: Tensor  # (bodies, P) bool: does the parameter move the body?
    rest: Tensor  # (P - 6,) joint parameters of the rest pose
    limbs: Tensor  # (J, 3) direction of each limb in its own body
    centers: Tensor  # (J, 3) direction of each limb at zero, in the parent body
    hinged: Tensor  # (J,) bool: two hinges in a row, the limb's own axis first, or a swing
    align: Tensor  # (J, 3, 3) brings `limbs` to `centers`: the body's rotation at zero
    # (S, 3 J + 3 K + 3 joints + 3 K): sizes times it are offsets in the parents' frames, centres and joints in
    # their bodies', and radii.
    size_basis: Tensor
    segment_frames: Tensor  # (K, 3, 3) columns: the ellipsoid's axes in its body
    bottom: Tensor  # (6,) the last row of a body's place in its parent
    by_depth: Tensor  # (J,) the bodies but for the root, by their depth in the tree
    above: Tensor  # (J,) where among root and `by_depth` the parent of each of these is
    places: Tensor  # (bodies,) where among them each body is
    carriers: Tensor  # (K + joints,) the body that carries each ellipsoid and joint

    def __init__(self, config: BodyConfig = BodyConfig()):
        super().__init__()
        self.config = config
        self.skeleton = skeleton = load_skeleton(config.path or HUMAN)
        self.parents = tuple(body.parent for body in skeleton.bodies)
        self.body_names = skeleton.body_names
        self.segment_names = tuple(segment.name for segment in skeleton.segments)
        self.joint_names = tuple(joint.name for joint in skeleton.joints)
        self.parameter_names = skeleton.parameter_names
        self.size_names = skeleton.sizes
        self.num_lengths = skeleton.num_lengths
        self.segment_bodies = tuple(segment.body for segment in skeleton.segments)
        self.joint_bodies = tuple(joint.body for joint in skeleton.joints)
        self._register_order()
        self._register_tree()
        self._register_sizes()

    @property
    def num_parameters(self) -> int:
        return len(self.parameter_names)

    @property
    def num_parts(self) -> int:
        return len(self.segment_names)

    def _register_order(self) -> None:
        """Bodies of equal depth are placed together, after those above them: one product a level."""
        depth = [0]
        for parent in self.parents:
            depth.append(depth[parent] + 1)
        order = sorted(range(len(depth)), key=lambda i: depth[i])  # the root is body 0 and comes first
        self.levels = tuple(depth.count(level) for level in range(1, max(depth) + 1))
        for name, index in (
            ("by_depth", [i - 1 for i in order[1:]]),
            ("above", [order.index(self.parents[i - 1]) for i in order[1:]]),
            ("places", [order.index(i) for i in range(len(depth))]),
            ("carriers", [*self.segment_bodies, *self.joint_bodies]),
        ):
            self.register_buffer(name, torch.tensor(index), persistent=False)

    def _register_tree(self) -> None:
        chain = self.skeleton.chain()
        if tuple(chain.get_joint_parameter_names()) != self.parameter_names:
            raise AssertionError("pytorch-kinematics orders the parameters otherwise than the skeleton")
        kind, bodies = self.config.joint, self.skeleton.bodies
        hinged = [
            body.hinged if kind is JointKind.anatomical else kind is JointKind.revolute for body in bodies
        ]
        self.register_buffer("hinged", torch.tensor(hinged), persistent=False)
        hinges: list[Hinges] = [
            body.revolute if own else body.swing for body, own in zip(bodies, hinged, strict=True)
        ]
        axes = torch.tensor([axis for hinge in hinges for axis in hinge.axes])
        limits = torch.tensor([limit for hinge in hinges for limit in hinge.limits])
        free = torch.full((6,), torch.inf)
        # chain.axes has every axis by parameter; the swings replace those of the joints, not of the root.
        self._constant("axes", torch.cat([chain.axes[:6], axes]))
        self._constant("low", torch.cat([-free, limits[:, 0]]))
        self._constant("high", torch.cat([free, limits[:, 1]]))
        limbs = torch.tensor([body.limb for body in self.skeleton.bodies])
        centers = torch.tensor(
            [h.center or b.limb for h, b in zip(hinges, self.skeleton.bodies, strict=True)]
        )
        self._constant("limbs", limbs)
        self._constant("centers", centers)
        self._constant("align", exp_rotation(rotation_between(limbs.double(), centers.double())))
        # moves[k, p]: parameter p moves body k. The library lists the frames from the base to each frame.
        on_path = [
            {
                chain.find_frame(chain.idx_to_frame[i]).joint.name
                for i in chain.parents_indices[chain.frame_to_idx[name]].tolist()
            }
            for name in self.body_names
        ]
        moves = torch.tensor([[name in path for name in self.parameter_names] for path in on_path])
        self.register_buffer("moves", moves, persistent=False)
        rest = torch.tensor([body.rest for body in self.skeleton.bodies])[None]
        zero = torch.zeros(1, 3)
        self._constant("rest", self.pose_from_directions(zero, zero, self._rest_in_torso(rest))[0, 6:])

    def _rest_in_torso(self, rest: Float[Tensor, "batch limbs 3"]) -> Float[Tensor, "batch limbs 3"]:
        """Rest directions are stated in the parent's frame; a child's parent has itself turned."""
        turn, directions = [torch.eye(3)[None]], []
        for i, parent in enumerate(self.parents):
            toward = rest[:, i]
            directions.append((turn[parent] @ toward[..., None])[..., 0])
            turn.append(turn[parent] @ self._turn(i, self._hinge_angles(i, toward)))
        return torch.stack(directions, 1)

    def _constant(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value.to(torch.get_default_dtype()), persistent=False)

    def _register_sizes(self) -> None:
        def basis(vectors: Sequence[SizedVector]) -> Tensor:
            table = torch.zeros(len(vectors), 3, len(self.size_names))
            for row, vector in enumerate(vectors):
                for name, value in vector.terms:
                    table[row, :, self.size_names.index(name)] += torch.tensor(value)
            return table

        skeleton = self.skeleton
        radii = torch.zeros(len(skeleton.segments), 3, len(self.size_names))
        for row, segment in enumerate(skeleton.segments):
            (girth, across), (length, along) = segment.radius, segment.half_length
            radii[row, :2, self.size_names.index(girth)] = torch.tensor(across)
            radii[row, 2, self.size_names.index(length)] = along
        tables = [
            basis([body.origin for body in skeleton.bodies]),
            basis([segment.center for segment in skeleton.segments]),
            basis([joint.at for joint in skeleton.joints]),
            radii,
        ]
        self.size_counts = [len(table.flatten(0, 1)) for table in tables]
        self._constant("bottom", torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
        self._constant("size_basis", torch.cat([table.flatten(0, 1) for table in tables]).mT)
        axes = torch.tensor([segment.axis for segment in skeleton.segments], dtype=torch.double)
        self._constant("segment_frames", frame_along(axes))

    def default_size(self, batch: int) -> Float[Tensor, "batch sizes"]:
        return torch.ones(batch, len(self.size_names), dtype=self.axes.dtype, device=self.axes.device)

    @property
    def height(self) -> float:
        """Height of the person whose sizes are all 1, m."""
        return self.skeleton.height

    def size_of_height(self, height: float) -> Float[Tensor, "1 sizes"]:
        """Sizes of a person of `height` m with the body file's proportions."""
        return self.default_size(1) * (height / self.height)

    def forward(
        self, pose: Float[Tensor, "batch parameters"], size: Float[Tensor, "#batch sizes"] | None = None
    ) -> PosedBody:
        """Place the body. `size` (B or 1, S) multiplies the file's lengths and girths; None is all ones."""
        B = pose.shape[0]
        if size is None:
            size = self.default_size(1)
        shift, center, joint, radii = (
            x.unflatten(1, (-1, n)).expand(B, -1, -1)
            for x, n in zip((size @ self.size_basis).split(self.size_counts, 1), (3, 3, 3, 3), strict=True)
        )
        root, root_axes, local, axes = self._turns(pose)
        # Each body as (R, t, axes of its joint), 3 x 6: the parent's (R, t) times (local; 0 0 0 1 0 0) places it.
        bottom = self.bottom.expand(B, len(self.parents), 1, 6)
        step = torch.cat([torch.cat([local, shift[..., None], axes.mT], -1), bottom], -2)
        step = step.index_select(1, self.by_depth)
        placed = torch.cat([root, pose[:, :3, None], torch.zeros_like(root[..., :2])], -1)[:, None]
        first = 0
        for count in self.levels:
            above = placed.index_select(1, self.above[first : first + count])[..., :4]
            placed = torch.cat([placed, above @ step[:, first : first + count]], 1)
            first += count
        placed = placed.index_select(1, self.places)
        R, t = placed[..., :3], placed[..., 3]
        carriers = placed.index_select(1, self.carriers)
        turns = carriers[..., :3]
        points = (turns @ torch.cat([center, joint], 1)[..., None])[..., 0] + carriers[..., 3]
        centers, joints = points.split([self.num_parts, len(self.joint_bodies)], 1)
        # A stout person's segment may grow as thick as it is long, but an ellipsoid's long axis stays the long one.
        return PosedBody(
            R,
            t,
            centers,
            turns[:, : self.num_parts] @ self.segment_frames,
            torch.cat([radii[..., :2], radii.amax(-1, keepdim=True)], -1),
            joints,
            torch.cat([root_axes, placed[:, 1:, :, 4:].mT.flatten(1, 2)], 1),
            torch.cat([pose[:, None, :3].expand(B, 6, 3), t[:, 1:].repeat_interleave(2, 1)], 1),
        )

    def _turns(self, pose: Float[Tensor, "batch parameters"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The root's rotation and the axes of its parameters; of the joints the same, in the parents' frames."""
        root = self.axes[3:6] * pose[:, 3:6, None]
        angles = pose[:, 6:].unflatten(1, (-1, 2))  # (B, J, 2)
        axes = self.axes[6:].unflatten(0, (-1, 2))  # (J, 2, 3)
        first, second = (angles[..., None] * axes).unbind(2)
        # A swing is one turn about the sum, hinges are two turns in a row; the second turn of a swing is none.
        hinged = self.hinged[:, None]
        second_turn = torch.where(hinged, second, 0.0)
        turned = torch.cat([root, first + second - second_turn, second_turn], 1)
        rotation, slope = rotation_and_left_jacobian(turned)
        one, two = rotation[:, 3:].split(len(self.hinged), 1)
        local = one @ two @ self.align
        both = (slope[:, 3 : 3 + len(self.hinged)] @ axes.mT).mT  # (B, J, 2, 3)
        after = (one @ axes[:, 1, :, None])[..., 0]
        across = torch.stack([both[:, :, 0], torch.where(hinged, after, both[:, :, 1])], 2)
        yaw, pitch, roll = rotation[:, :3].unbind(1)
        turned = yaw @ pitch
        eye = torch.eye(3, dtype=pose.dtype, device=pose.device).expand(len(pose), 3, 3)
        root_axes = torch.cat([eye, yaw.mT[:, 1:2], yaw.mT[:, :1], turned.mT[:, 2:]], 1)
        return turned @ roll, root_axes, local, across

    def jacobian(
        self, posed: PosedBody, points: Float[Tensor, "batch parts num 3"]
    ) -> Float[Tensor, "batch parts num 3 parameters"]:
        """Derivative of points fixed to the ellipsoids: `axis x (p - origin)`, 0 off the path (App. E)."""
        lever = points[..., None, :] - posed.screw_origins[:, None, None]
        turning = torch.linalg.cross(posed.screw_axes[:, None, None].expand_as(lever), lever)
        columns = torch.cat(
            [posed.screw_axes[:, None, None, :3].expand_as(turning[..., :3, :]), turning[..., 3:, :]], -2
        )
        return (columns * self.part_moves[:, None, :, None]).mT

    @property
    def part_moves(self) -> Bool[Tensor, "parts parameters"]:
        """Which parameters move which ellipsoid."""
        return self.moves.index_select(0, self.carriers[: self.num_parts])

    @property
    def limb_starts(self) -> list[int]:
        """Of each limb the first of its parameters. A limb is a body on the root that others hang from, and these."""
        roots = [k for k, parent in enumerate(self.parents, 1) if parent == 0 and k in self.parents]
        return [6 + 2 * (k - 1) for k in roots]

    def pose_from_directions(
        self,
        translation: Float[Tensor, "batch 3"],
        root_angles: Float[Tensor, "batch 3"],
        directions: Float[Tensor, "batch limbs 3"],
    ) -> Float[Tensor, "batch parameters"]:
        """The pose whose limbs point along `directions` (unit vectors in the torso's frame, bodies 1 to 9).

        `root_angles` are yaw, pitch and roll, rad. A revolute joint that cannot reach a direction takes the
        nearest.
        """
        eye = torch.eye(3, dtype=directions.dtype, device=directions.device)
        turn: list[Tensor] = [eye.expand(len(directions), 3, 3)]
        angles = []
        for i, parent in enumerate(self.parents):
            toward = (turn[parent].mT @ directions[:, i, :, None])[..., 0]
            angles.append(self._hinge_angles(i, toward))
            turn.append(turn[parent] @ self._turn(i, angles[-1]))
        return torch.cat([translation, root_angles, *angles], -1)

    def _hinge_angles(self, joint: int, toward: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch 2"]:
        axes = self.axes[6 + 2 * joint : 8 + 2 * joint].to(toward)
        if not self.hinged[joint]:
            return rotation_between(self.centers[joint].to(toward).expand_as(toward), toward) @ axes.mT
        both = axis_pair_angles(
            axes.expand(len(toward), 2, 3), self.limbs[joint].to(toward).expand_as(toward), toward
        )
        low, high = (limit[6 + 2 * joint : 8 + 2 * joint].to(toward) for limit in (self.low, self.high))
        # Of the two solutions the one within the limits, and of two such the one that turns less.
        cost = (
            (low - both).clamp_min(0).sum(-1) + (both - high).clamp_min(0).sum(-1) + 1e-3 * both.abs().sum(-1)
        )
        first, second = both[torch.arange(len(both)), cost.argmin(-1)].unbind(-1)
        # A first hinge along a limb that goes on straight only turns it about itself: rounding shall not twist a foot.
        limb = self.limbs[joint].to(toward)
        straight = ((limb * toward).sum(-1) > 1 - STRAIGHT) & ((axes[0] * limb).sum().abs() > 1 - STRAIGHT)
        return torch.stack([torch.where(straight, 0.0, first), second], -1)

    def _turn(self, joint: int, angles: Float[Tensor, "batch 2"]) -> Float[Tensor, "batch 3 3"]:
        axes = self.axes[6 + 2 * joint : 8 + 2 * joint].to(angles)
        if not self.hinged[joint]:
            return exp_rotation(angles @ axes) @ self.align[joint].to(angles)
        return exp_rotation(angles[:, :1] * axes[0]) @ exp_rotation(angles[:, 1:] * axes[1])

    def limb_directions(self, posed: PosedBody) -> Float[Tensor, "batch limbs 3"]:
        """Unit directions of the nine limbs in the torso's frame: the inverse of `pose_from_directions`."""
        return (
            posed.rotations[:, :1].mT @ _turned(posed.rotations[:, 1:], self.limbs[:, :, None])[..., None]
        )[..., 0]


def _turned(rotation: Tensor, column: Tensor) -> Tensor:
    return (rotation @ column)[..., 0]


def frame_along(axis: Float[Tensor, "*axes 3"]) -> Float[Tensor, "*axes 3 3"]:
    """R_body_part: the third column along the unit vector `axis`, the first the body's x as far as it lies across.

    Of an axis along x itself the first column is the body's y.
    """
    eye = torch.eye(3, dtype=axis.dtype, device=axis.device)
    across = torch.where(axis[..., :1].abs() > 0.9, eye[1], eye[0])
    first = nn.functional.normalize(across - axis * (across * axis).sum(-1, keepdim=True), dim=-1)
    return torch.stack([first, torch.linalg.cross(axis, first), axis], -1)


def ellipsoid_matrix(posed: PosedBody) -> Float[Tensor, "batch parts 4 4"]:
    """The homogeneous form A with `X^T A X = 2` on the surface (T. 3.3), in the camera's frame."""
    D = torch.diag_embed(posed.radii**-2)
    A = posed.frames @ D @ posed.frames.mT
    b = -(A @ posed.centers[..., None])
    corner = (posed.centers[..., None, :] @ -b) + 1
    return torch.cat([torch.cat([A, b], -1), torch.cat([b.mT, corner], -1)], -2)
