"""Angles that people read: anatomical joint angles, angles between limbs, and their standard deviations.

Radians, of a posed body; the torso's frame is x to the left, y down, z out of the back. Zero is the upright
person with hanging arms who faces the camera. Flexion is forward (at the knee backward), abduction away from
the middle, rotation inward; trunk rotation is positive to the person's right, lateral bending positive to the
right.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.model import BodyModel, PosedBody
from torchpose.geometry import angle_between, exp_rotation

DRAWS = 128  # pairs of poses for the standard deviations of the angles
SIDES = ("left", "right")
LIMB_ANGLE_NAMES = tuple(
    f"{joint}_{side}_limb" for joint in ("elbow", "knee", "shoulder", "hip") for side in SIDES
)
TRUNK_NAMES = ("trunk_flexion", "trunk_lateral_bending", "trunk_rotation")
ANATOMICAL_NAMES = (
    *TRUNK_NAMES,
    "neck_flexion",
    "neck_lateral_bending",
    *(f"shoulder_{motion}_{side}" for motion in ("flexion", "abduction", "rotation") for side in SIDES),
    *(f"elbow_flexion_{side}" for side in SIDES),
    *(f"hip_{motion}_{side}" for motion in ("flexion", "abduction", "rotation") for side in SIDES),
    *(f"knee_flexion_{side}" for side in SIDES),
)


def limb_angles(joints: Float[Tensor, "*batch 15 3"]) -> Float[Tensor, "*batch 8"]:
    """Angles between adjoining limbs, 0 = aligned, in the order of `LIMB_ANGLE_NAMES` (T. 5.1).

    Elbows and knees between their two limbs; shoulders between upper arm and trunk; hips between thigh and
    trunk. The trunk runs from the middle of the shoulders down to the middle of the hips. `joints` are the
    contract's fifteen.
    """
    shoulder, elbow, wrist, hip, knee, ankle = joints[..., 3:, :].unflatten(-2, (6, 2)).unbind(-3)
    trunk = (hip.mean(-2, keepdim=True) - shoulder.mean(-2, keepdim=True)).expand_as(hip)
    pairs = (
        (elbow - shoulder, wrist - elbow),
        (knee - hip, ankle - knee),
        (elbow - shoulder, trunk),
        (knee - hip, trunk),
    )
    return torch.cat([angle_between(first, second) for first, second in pairs], -1)


def anatomical_angles(body: BodyModel, posed: PosedBody) -> Float[Tensor, "batch 21"]:
    """Joint angles with the names of `ANATOMICAL_NAMES`, from the limbs' directions in the torso's frame.

    Flexion and abduction are those of a hinge pair (flexion first, then abduction, as OpenSim's shoulder and
    hip); rotation of the upper arm and the thigh is read from the limb below, so a straight elbow or knee
    leaves it undefined: its standard deviation then says so.
    """
    limb = dict(zip(body.body_names[1:], body.limb_directions(posed).unbind(1), strict=True))
    angles = [
        *trunk_angles(posed.rotations[:, 0]).unbind(1),
        torch.atan2(-limb["head"][:, 2], -limb["head"][:, 1]),
        -_elevation(limb["head"][:, 0], limb["head"][:, 1:]),
    ]
    shoulder = [
        _ball(limb[f"upper_arm_{s}"], limb[f"forearm_{s}"], side, -1)
        for side, s in zip((1, -1), SIDES, strict=True)
    ]
    hip = [
        _ball(limb[f"thigh_{s}"], limb[f"shank_{s}"], side, 1) for side, s in zip((1, -1), SIDES, strict=True)
    ]
    elbow = [angle_between(limb[f"upper_arm_{s}"], limb[f"forearm_{s}"]) for s in SIDES]
    knee = [angle_between(limb[f"thigh_{s}"], limb[f"shank_{s}"]) for s in SIDES]
    for ball, hinge in ((shoulder, elbow), (hip, knee)):
        for motion in range(3):
            angles += [ball[0][motion], ball[1][motion]]
        angles += hinge
    return torch.stack(angles, 1)


def trunk_angles(R: Float[Tensor, "batch 3 3"]) -> Float[Tensor, "batch 3"]:
    """Angles with the names of `TRUNK_NAMES` of a trunk that is turned by R, in whose frame y is down.

    R = Ry(yaw) Rx(pitch) Rz(roll); a forward bend turns the upper body towards the camera: pitch > 0.
    """
    flexion = _elevation(-R[:, 1, 2], R[:, 1, :2])
    return torch.stack(
        [flexion, -torch.atan2(R[:, 1, 0], R[:, 1, 1]), torch.atan2(R[:, 0, 2], R[:, 2, 2])], 1
    )


def trunk_turn(angles: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch 3 3"]:
    """R of a trunk with these angles: the inverse of `trunk_angles`."""
    axes = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).to(angles)
    pitch, roll, yaw = exp_rotation(angles[..., None] * axes).unbind(1)
    return yaw @ pitch @ roll


def _elevation(height: Float[Tensor, " batch"], level: Float[Tensor, "batch 2"]) -> Float[Tensor, " batch"]:
    """Angle of a vector above a plane, from its part across the plane and those in it; exact to the poles."""
    # A norm has no derivative at zero; the floor makes it 0 there.
    return torch.atan2(height, (level * level).sum(-1).clamp_min(torch.finfo(level.dtype).tiny).sqrt())


def _ball(
    upper: Float[Tensor, "batch 3"], lower: Float[Tensor, "batch 3"], side: int, bend: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Flexion, abduction, inward rotation of a ball joint.

    `side` is 1 on the left; `bend` is the z to which the lower limb folds at zero rotation: -1 forward
    (elbow), 1 backward (knee).
    """
    x, y, z = upper.unbind(-1)
    abduction = _elevation(side * x, upper[:, 1:])
    flexion = torch.atan2(-z, y)
    # The lower limb across the upper one, in the frame that flexion and abduction have turned: outward and
    # back.
    cos_f, sin_f, cos_a, sin_a = flexion.cos(), flexion.sin(), abduction.cos(), abduction.sin()
    lx, ly, lz = lower.unbind(-1)
    down, back = cos_f * ly - sin_f * lz, sin_f * ly + cos_f * lz
    out = cos_a * side * lx - sin_a * down
    return flexion, abduction, torch.atan2(bend * out, bend * back)


def angle_sd(
    body: BodyModel,
    pose: Float[Tensor, "batch parameters"],
    covariance: Float[Tensor, "batch parameters parameters"],
    size: Float[Tensor, "#batch sizes"],
) -> Float[Tensor, "batch angles"]:
    """Standard deviations of the anatomical angles about those of `pose`, rad, from the pose's covariance.

    By draws from the pose's Gaussian (the same for every frame, in pairs of opposite ones), not by derivatives: the
    rotation of a limb that is almost straight, and the flexion of an arm held out to the side, may be any within the
    uncertainty of the limb's direction, which a derivative at one direction does not see. Differences go round the
    circle, so that an angle of which nothing is known has pi / sqrt(3). A covariance that is not finite gives that,
    too.
    """
    even = torch.quasirandom.SobolEngine(pose.shape[1], scramble=True, seed=0).draw(DRAWS).to(pose)
    normal = torch.special.ndtri(even.clamp(1e-4, 1 - 1e-4))
    normal = torch.cat([normal, -normal])
    value, axes = torch.linalg.eigh(torch.where(covariance.isfinite(), covariance, 0.0))
    root = axes * value.clamp_min(0).sqrt()[:, None]
    step = (normal @ root.mT).clamp(-torch.pi, torch.pi)  # (B, draws, P)
    drawn = (pose[:, None] + step).flatten(0, 1)
    each = size if len(size) == 1 else size.repeat_interleave(len(normal), 0)
    angles = anatomical_angles(body, body(drawn, each)).unflatten(0, (len(pose), len(normal)))
    gap = angles - anatomical_angles(body, body(pose, size))[:, None]
    gap = torch.remainder(gap + torch.pi, 2 * torch.pi) - torch.pi
    sd = (gap * gap).mean(1).sqrt()
    nothing = torch.pi / 3**0.5
    known = covariance.flatten(1).isfinite().all(1, keepdim=True) & pose.isfinite().all(1, keepdim=True)
    return torch.where(known, sd, nothing).clamp_max(nothing)
