"""A pose from a single frame of which nothing is known: many starts, fitted in one batch, the best arms combined.

Left-camera frame, metres and radians.
"""

from dataclasses import dataclass, field, replace
from math import cos, pi, radians, sin

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.body.model import BodyModel
from torchpose.geometry import exp_rotation
from torchpose.registration.fitting import PosePrior
from torchpose.registration.labelling import LabellingConfig
from torchpose.registration.limb_search import LimbSearch, LimbSearchConfig
from torchpose.registration.vem import Observation, Registrar, Registration, RegistrationConfig
from torchpose.registration.walk import WalkConfig, backwards_cost
from torchpose.vision.faces import Faces
from torchpose.vision.points import PointCloud

# Directions of the left upper arm and forearm in the torso's frame (x to the left, y down, z back), from which arms
# start: hanging, hanging bent, to the side, forward, up, side bent up, guard, forward low.
ARMS = (
    ((0.15, 1.0, 0.0), (0.05, 1.0, -0.1)),
    ((0.25, 1.0, 0.1), (0.0, 0.3, -1.0)),
    ((1.0, 0.05, -0.05), (1.0, 0.0, -0.15)),
    ((0.1, 0.1, -1.0), (0.0, 0.0, -1.0)),
    ((0.3, -1.0, -0.1), (0.1, -1.0, -0.1)),
    ((1.0, 0.1, 0.0), (0.2, -0.8, -0.6)),
    ((0.2, 0.9, -0.4), (-0.2, -0.8, -0.7)),
    ((0.3, 0.6, -0.8), (-0.2, 0.3, -0.9)),
)
# The same for thigh and shank: standing, sitting or knee raised, crouching, stepping back, to the side.
LEGS = (
    ((0.08, 1.0, -0.03), (0.05, 1.0, 0.03)),
    ((0.2, 0.25, -1.0), (0.1, 1.0, 0.0)),
    ((0.1, 0.85, -0.5), (0.05, 0.85, 0.5)),
    ((0.1, 0.9, 0.3), (0.05, 0.6, 0.8)),
    ((0.6, 0.8, -0.2), (0.2, 1.0, 0.0)),
)
# Sitting, crouching and stepping back, each with the lean of the trunk that goes with it, rad.
BENT = ((ARMS[1], LEGS[1], 0.2), (ARMS[1], LEGS[2], 0.35), (ARMS[6], LEGS[2], 0.35), (ARMS[1], LEGS[3], 0.1))


@dataclass(frozen=True)
class StartConfig:
    points: int = 200  # of the cloud, for the many starts
    rounds: int = 5  # of these starts
    final_rounds: int = 8  # of the best few, on all points
    finalists: int = 4
    finalists_apart: float = 0.25  # rad by which these differ in an angle: one pose four times is one
    sigma: float = 0.15  # m, in the first round: a cold start is decimetres off
    exchanged: int = 8  # best starts whose limbs are exchanged
    apart: float = 0.03  # rad by which limbs differ that are exchanged: the others end in the same place
    combined: int = 32  # of their combinations that are fitted, the likeliest as they stand
    good_misfit: float = 0.020  # m; a worse answer is refreshed limb by limb
    refreshes: int = 1  # at the most
    # m, in a refresh's first rounds on few points and on all: all but a limb or two are right
    refresh_sigma: float = 0.05
    face_yaws: tuple[float, ...] = (-75.0, -35.0, 0.0, 35.0, 75.0)  # degrees: a face is seen, or none can be
    yaws: tuple[float, ...] = (-90.0, -45.0, 0.0, 45.0, 90.0, 180.0)  # when none is
    limbs: LimbSearchConfig = field(default_factory=LimbSearchConfig)
    back_penalty: float = 4.0  # nats that a pose turned away from the camera must make good
    walking_yaws: tuple[float, ...] = (-35.0, 0.0, 35.0, 180.0)  # degrees from the way that somebody walks
    walk: WalkConfig = field(default_factory=WalkConfig)

    def __post_init__(self) -> None:
        for name in ("points", "rounds", "final_rounds", "finalists", "exchanged", "combined"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name, all_of in (("apart", "exchanges all limbs"), ("finalists_apart", "takes the best of all")):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)} rad; 0 {all_of}")
        if not (self.yaws and self.face_yaws and self.walking_yaws):
            raise ValueError("yaws, face_yaws and walking_yaws need at least one angle each, in degrees")
        if not self.back_penalty >= 0:
            raise ValueError(f"back_penalty must not be negative, got {self.back_penalty} nats")


class Starter(nn.Module):
    """Finds the pose in one frame from a list of plausible ones."""

    arms: Tensor  # (places, parameters) poses with the arms in each of `ARMS`

    def __init__(self, body: BodyModel, config: StartConfig, registration: RegistrationConfig):
        super().__init__()
        self.body = body
        self.config = config
        self.registrar = Registrar(body, registration)
        # Far from the answer neighbours agree on wrong labels, and single points are many enough.
        alone = LabellingConfig(sweeps=0, potts=0.0)
        self.coarse = Registrar(body, replace(registration, labelling=alone))
        self.limb_search = LimbSearch(body, self.coarse, config.limbs)
        directions = torch.stack([_directions(arm, LEGS[0]) for arm in ARMS]).to(body.axes)
        zero = directions.new_zeros(len(ARMS), 3)
        self.register_buffer("arms", body.pose_from_directions(zero, zero, directions), persistent=False)

    def forward(
        self,
        observation: Observation,
        faces: Faces,
        size: Float[Tensor, "#batch sizes"],
        walking: float | None = None,
    ) -> Registration:
        """Register one frame (batch 1) without a known pose.

        `walking` is the yaw of the way the person walks, rad; a face that is seen says more.
        """
        walking = None if bool(faces.found[0]) else walking
        starts = self.hypotheses(observation, faces, size, walking)
        found = self._search(observation, starts[None], size, self.config.sigma, walking=walking)
        for _ in range(self.config.refreshes):
            if float(found.misfit) < self.config.good_misfit:
                break
            better = self.refresh(observation, found.pose, size, walking=walking)
            if not bool(better.score < found.score):
                break
            found = better
        return found

    def refresh(
        self,
        observation: Observation,
        pose: Float[Tensor, "batch parameters"],
        size: Float[Tensor, "#batch sizes"],
        prior: PosePrior | None = None,
        walking: float | None = None,
    ) -> Registration:
        """Register frames from poses of which some limbs may be wrong: each limb is tried elsewhere too.

        An arm in a wrong place leans the trunk to where the two together find points; then neither is found alone. So
        both arms are also tried in their common places, on a trunk that stands upright.
        """
        few = thin(observation, self.config.points)
        limbs = self.limb_search(few, pose, size)  # (B, limbs, best, P)
        together = pose.clone()
        for k, own in enumerate(self.limb_search.limbs):
            together[:, own] = limbs[:, k, 0, own]
        starts = [pose[:, None], together[:, None], limbs.flatten(1, 2), self._upright(pose)]
        sigma = self.config.refresh_sigma
        return self._search(observation, torch.cat(starts, 1), size, sigma, sigma, prior, walking)

    def _upright(self, pose: Float[Tensor, "batch parameters"]) -> Float[Tensor, "batch places parameters"]:
        """The poses upright, with both arms in each of `ARMS`."""
        upright = pose[:, None].repeat(1, len(self.arms), 1)
        upright[..., 4:6] = 0  # pitch and roll
        arms = self.limb_search.limbs[:2].flatten()  # as in the body file, see `_directions`
        upright[..., arms] = self.arms[:, arms]
        return upright

    def _search(
        self,
        observation: Observation,
        starts: Float[Tensor, "batch starts parameters"],
        size: Float[Tensor, "#batch sizes"],
        sigma: float,
        final_sigma: float | None = None,
        prior: PosePrior | None = None,
        walking: float | None = None,
    ) -> Registration:
        """Every start of each frame is fitted on a few points, the limbs of the good ones are exchanged, and the best
        few that differ are fitted on all points. Of each frame the registration with the least score is returned."""
        few, (B, S, P) = thin(observation, self.config.points), starts.shape
        row = torch.arange(B, device=starts.device)
        every = row.repeat_interleave(S)
        rough = self._fit(
            self.coarse, few, every, starts.flatten(0, 1), size, prior, self.config.rounds, sigma
        )
        pose, score = rough.pose.view(B, S, P), self.score(rough, walking).view(B, S)
        exchanged, worth = self._exchange(few, pose, score, size, prior)
        combined = torch.cat([pose, exchanged], 1)
        new = torch.cat([torch.ones_like(score, dtype=torch.bool), worth], 1)
        last, every = self.registrar.config.sigma_last, new.nonzero()[:, 0]
        again = self._fit(self.coarse, few, every, combined[new], size, prior, 1, last)
        rank = torch.full_like(combined[..., 0], torch.inf).masked_scatter(new, self.score(again, walking))
        finalists = combined.masked_scatter(new[..., None], again.pose)
        best, other = self._different(rank, finalists)
        every, rounds = other.nonzero()[:, 0], self.config.final_rounds
        finalists = finalists.gather(1, best[..., None].expand(-1, -1, P))[other]
        final = self._fit(
            self.registrar, observation, every, finalists, size, prior, rounds, final_sigma, covariance=True
        )
        rank = torch.full_like(rank[:, : best.shape[1]], torch.inf).masked_scatter(
            other, self.score(final, walking)
        )
        return final.take((other.flatten().cumsum(0) - 1).view_as(other)[row, rank.argmin(1)])

    def _different(
        self, rank: Float[Tensor, "batch poses"], pose: Float[Tensor, "batch poses parameters"]
    ) -> tuple[Int[Tensor, "batch best"], Bool[Tensor, "batch best"]]:
        """The best few poses of each frame that differ in an angle, the least rank first; and which of these exist."""
        angles, best, there = pose[..., 3:], [], []  # of the root, too: somebody may face either way
        for _ in range(min(self.config.finalists, rank.shape[1])):
            least, which = rank.min(1, keepdim=True)
            best.append(which)
            there.append(least < torch.inf)
            one = angles.gather(1, which[..., None].expand(-1, -1, angles.shape[2]))
            gap = torch.remainder(angles - one + pi, 2 * pi) - pi
            near = gap.abs().amax(2) < self.config.finalists_apart
            rank = torch.where(near, torch.inf, rank).scatter(1, which, torch.inf)
        # Of a frame of no numbers one is as good as another, and one must be answered.
        there[0] = torch.ones_like(there[0])
        return torch.cat(best, 1), torch.cat(there, 1)

    @staticmethod
    def _fit(
        registrar: Registrar,
        observation: Observation,
        frame: Int[Tensor, " rows"],
        starts: Float[Tensor, "rows parameters"],
        size: Float[Tensor, "#batch sizes"],
        prior: PosePrior | None,
        rounds: int,
        sigma: float | None = None,
        covariance: bool = False,
    ) -> Registration:
        """Starts of several frames as one batch; `frame` is whose each is."""
        if prior is not None:
            prior = PosePrior(prior.mean[frame], prior.precision[frame])
        sizes = size.expand(len(observation.potential), -1)[frame]
        return registrar(observation.share(frame), starts, sizes, prior, rounds, sigma, covariance)

    def score(self, found: Registration, walking: float | None = None) -> Float[Tensor, " starts"]:
        """The registrations' scores with what the way the person faces costs, nats: less is better."""
        score = found.score.nan_to_num(nan=torch.inf)
        score = score + self.config.back_penalty * self._turned_away(found.pose)
        if walking is not None:
            score = score + backwards_cost(found.pose[:, 3], walking, self.config.walk)
        return score

    def hypotheses(
        self,
        observation: Observation,
        faces: Faces,
        size: Float[Tensor, "#batch sizes"],
        walking: float | None = None,
    ) -> Float[Tensor, "starts parameters"]:
        """Poses to start from: headings x arms, standing, and a few with bent legs."""
        # Without colours nothing else tells front from back: whoever comes before the camera is taken to face it.
        facing = bool(faces.found[0]) or not faces.sought
        yaws = self.config.face_yaws if facing else self.config.yaws
        poses = [(arm, LEGS[0], 0.0) for arm in ARMS] + [(arm, leg, lean) for arm, leg, lean in BENT]
        directions = torch.stack([_directions(arm, leg) for arm, leg, _ in poses]).to(size)
        lean = torch.tensor([lean for _, _, lean in poses]).to(size)
        heading = torch.tensor([radians(yaw) for yaw in yaws]).to(size)
        if walking is not None:
            heading = torch.tensor([walking + radians(yaw) for yaw in self.config.walking_yaws]).to(size)
        Y, L = len(heading), len(poses)
        zero = torch.zeros(Y * L).to(size)
        root = torch.stack([heading.repeat_interleave(L), lean.repeat(Y), zero], 1)
        # Whoever leans by an angle has the hips behind and higher up, seen from the head.
        away = torch.stack([zero, zero, torch.ones_like(zero)], -1)
        back = (exp_rotation(torch.stack([zero, root[:, 0], zero], -1)) @ away[..., None])[..., 0]
        pelvis = pelvis_position(observation.cloud, faces, size, self.body).expand(Y * L, 3)
        trunk = 0.65 * size[0, 0]
        pelvis = pelvis + trunk * root[:, 1:2].sin() * back
        pelvis = pelvis - trunk * (1 - root[:, 1:2].cos()) * torch.tensor([0.0, 1.0, 0.0]).to(size)
        return self.body.pose_from_directions(pelvis, root, directions.repeat(Y, 1, 1))

    def _exchange(
        self,
        observation: Observation,
        pose: Float[Tensor, "batch starts parameters"],
        score: Float[Tensor, "batch starts"],
        size: Float[Tensor, "#batch sizes"],
        prior: PosePrior | None,
    ) -> tuple[Float[Tensor, "batch combinations parameters"], Bool[Tensor, "batch combinations"]]:
        """The best start with the left and right arm, or leg, of any two of the best starts, in the likeliest of these
        combinations; and which of them are no repetition: of limbs that differ from those of all better starts, and
        not that start itself."""
        search, config = self.limb_search, self.config
        order = score.argsort(1)[:, : config.exchanged]
        good = pose.gather(1, order[..., None].expand(-1, -1, pose.shape[2]))  # the best first
        places = good[:, :, search.limbs].transpose(1, 2)  # (B, L, H, 4)
        likely = search.score_pairs(observation, good[:, 0], places, size).nan_to_num(nan=-torch.inf)
        near = (places[:, :, :, None] - places[:, :, None]).abs().amax(4) < config.apart
        fresh, cost = ~near.tril(-1).any(3), torch.zeros_like(places[..., 0])  # (B, L, H)
        if prior is not None:
            mean, precision = (x[:, search.limbs][:, :, None] for x in (prior.mean, prior.precision))
            cost = 0.5 * (precision * (places - mean).square()).sum(3)
        left, right = search.pairs.unbind(1)
        new = fresh[:, left, :, None] & fresh[:, right, None]  # (B, pairs, H, H)
        new[..., 0, 0] = False
        rank = likely - cost[:, left, :, None] - cost[:, right, None]
        # What the best start itself has is the same for all pairs but for its own rims and prior.
        rank = torch.where(new, rank - rank[..., :1, :1], -torch.inf).flatten(1)
        best = rank.topk(min(config.combined, rank.shape[1]), 1)
        H = good.shape[1]
        which, one, other = best.indices // H**2, best.indices // H % H, best.indices % H
        combined = good[:, :1].repeat(1, best.indices.shape[1], 1)
        for limb, from_start in ((left[which], one), (right[which], other)):
            own = search.limbs[limb]  # (B, M, 4)
            source = good.gather(1, from_start[..., None].expand(-1, -1, good.shape[2]))
            combined = combined.scatter(2, own, source.gather(2, own))
        return combined, new.flatten(1).gather(1, best.indices)

    def turned_away(self, found: Registration) -> bool:
        """Whether a registration (batch 1) shows the person's back."""
        return bool(self._turned_away(found.pose)[0])

    def _turned_away(self, pose: Float[Tensor, "starts parameters"]) -> Bool[Tensor, " starts"]:
        return pose[:, 3].cos() < cos(0.6 * pi)


def pelvis_position(
    cloud: PointCloud, faces: Faces, size: Float[Tensor, "#batch sizes"], body: BodyModel
) -> Float[Tensor, "batch 3"]:
    """A first guess of the middle of the hips, m: below the face, or below the head's top over the cloud's middle."""
    posed = body(torch.zeros(1, body.num_parameters).to(size), size[:1])
    down = -posed.centers[0, body.segment_names.index("head"), 1]  # hips below the head's centre, upright
    crown = posed.radii[0, body.segment_names.index("head"), 2]
    nan = torch.nan
    points = torch.where(cloud.mask[..., None], cloud.points, nan)
    middle = points.nanmedian(1).values
    column = (points[..., 0] - middle[:, None, 0]).abs() < 0.12
    tops = torch.where(column, points[..., 1], nan)
    # A few stray points may stand above the head: the second hundredth is taken, not the least.
    top = torch.nanquantile(tops, 0.02, dim=1) + crown
    head = torch.where(
        faces.found[:, None], faces.position, torch.stack([middle[:, 0], top, middle[:, 2]], -1)
    )
    y = head[:, 1] + down
    trunk = (points[..., 1] - (y - 0.2)[:, None]).abs() < 0.25
    x, z = (torch.where(trunk, points[..., i], nan).nanmedian(1).values for i in (0, 2))
    x, z = torch.where(x.isfinite(), x, middle[:, 0]), torch.where(z.isfinite(), z, middle[:, 2])
    # The cloud is the body's front: the hips lie half a trunk's depth behind it.
    return torch.stack([x, y, z + 0.11], -1)


def other_side(body: BodyModel) -> list[int]:
    """Of each limb (bodies 1 and on) the number of the one on the other side; its own where there is none."""
    names, exchange = list(body.body_names[1:]), {"left": "right", "right": "left"}
    return [names.index("_".join(exchange.get(word, word) for word in name.split("_"))) for name in names]


def turned_by(
    body: BodyModel,
    pose: Float[Tensor, "batch parameters"],
    yaw: Float[Tensor, " batch"],
    size: Float[Tensor, "#batch sizes"],
) -> Float[Tensor, "batch parameters"]:
    """Poses turned by `yaw`, rad.

    By up to a right angle the limbs turn with the body. Beyond, somebody was taken for facing the other way: the limbs
    stay where they are seen, each as the one of the other side.
    """
    turned = pose + torch.nn.functional.pad(yaw[:, None], (3, pose.shape[1] - 4))
    directions = body.limb_directions(body(pose, size))[:, other_side(body)]
    zero = torch.zeros_like(yaw)
    back = exp_rotation(torch.stack([zero, yaw, zero], -1)).mT
    seen = body.pose_from_directions(turned[:, :3], turned[:, 3:6], directions @ back.mT)
    seen = torch.cat([seen[:, :6], pose[:, 6:8], seen[:, 8:]], 1)
    return torch.where(yaw.abs()[:, None] > pi / 2, seen, turned)


def legs_uncrossed(
    body: BodyModel, pose: Float[Tensor, "1 parameters"], size: Float[Tensor, "1 sizes"]
) -> Float[Tensor, "1 parameters"] | None:
    """The pose with knees and ankles of left and right in each other's places, if the ankles are crossed; else None.

    Seen from the front, a leg that is fitted to the points of the other one hardly fits worse.
    """
    posed, limb = body(pose, size), body.body_names[1:].index
    left, right = (
        posed.joints[0, [body.joint_names.index(f"{name}_{side}") for name in ("hip", "knee", "ankle")]]
        for side in ("left", "right")
    )
    hips = left[0] - right[0]
    if float(hips @ (left[2] - right[2])) >= 0:
        return None
    directions = body.limb_directions(posed)
    across = hips.norm() * directions.new_tensor([1.0, 0.0, 0.0])  # x of the torso's frame is to its left
    there = directions.clone()
    for own, other, knee, hip, shift in (
        ("left", "right", right[1], right[0], -across),
        ("right", "left", left[1], left[0], across),
    ):
        thigh = directions[:, limb(f"thigh_{other}")] * (knee - hip).norm() + shift
        there[:, limb(f"thigh_{own}")] = torch.nn.functional.normalize(thigh, dim=-1)
        there[:, limb(f"shank_{own}")] = directions[:, limb(f"shank_{other}")]
    return body.pose_from_directions(pose[:, :3], pose[:, 3:6], there)


def _directions(
    arm: tuple[tuple[float, ...], tuple[float, ...]], leg: tuple[tuple[float, ...], tuple[float, ...]]
) -> Float[Tensor, "limbs 3"]:
    """Limb directions of a symmetric pose in the order of the body file: head, arms, legs, left before right."""
    mirror = torch.tensor([-1.0, 1.0, 1.0])
    arms, legs = torch.tensor(arm), torch.tensor(leg)
    head = torch.tensor([[0.0, -cos(0.1), -sin(0.1)]])
    rows = torch.cat([head, arms, arms * mirror, legs, legs * mirror])
    return torch.nn.functional.normalize(rows, dim=-1)


def thin(observation: Observation, num: int) -> Observation:
    """About `num` of each frame's points, evenly along the grid; without neighbours, which thinning parts."""
    cloud = observation.cloud
    count = cloud.mask.sum(1, keepdim=True)
    if bool((count <= num).all()):
        return observation
    steps = torch.arange(num, device=cloud.mask.device)
    even = (steps * (count - 1) / max(num - 1, 1)).round().long()
    order = cloud.mask.to(torch.uint8).argsort(dim=1, descending=True, stable=True)  # points before padding
    index = order.gather(1, torch.where(count > num, even, steps))
    return replace(picked(observation, index), frame=None)


def picked(observation: Observation, index: Int[Tensor, "batch few"]) -> Observation:
    """Some of each frame's points; without neighbours, which this parts."""
    cloud, num = observation.cloud, index.shape[1]
    wide = index[..., None].expand(-1, -1, 3)
    fewer = PointCloud(
        points=cloud.points.gather(1, wide),
        pixels=cloud.pixels.gather(1, wide[..., :2]),
        grid=cloud.grid.gather(1, wide[..., :2]),
        mask=cloud.mask.gather(1, index),
        neighbours=torch.full_like(cloud.neighbours[:, :num], num),
    )
    parts = index[..., None].expand(-1, -1, observation.potential.shape[2])
    potential = observation.potential.gather(1, parts)
    return replace(observation, cloud=fewer, potential=potential, geodesic=None)
