"""Everybody in a recording: told apart in each frame, and each followed by a model of his or her own.

Whose pixels are whose is decided by where each body should be; who comes back is known by place and by clothes. Each
person is located by a filter of head and trunk (T. 4.3.1), which frees the points of artefacts and says where the
registration starts. Left-camera frame; metres, radians and seconds.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from torchpose.body.model import PosedBody
from torchpose.export import JOINT_NAMES
from torchpose.eyes import Sight, View
from torchpose.follower import Follower
from torchpose.pipeline import FramePose, StereoToPose
from torchpose.recording import Frame, Recording, UnreadableFrame
from torchpose.registration.vem import Registration
from torchpose.registration.walk import yaw_of_way
from torchpose.tracking.kalman import Gaussian
from torchpose.tracking.location import LocationConfig, LocationFilter, Sighting, nowhere, sighting
from torchpose.tracking.partition import PartitionConfig, split_people
from torchpose.tracking.tracker import Sought, TrackStatus, track_together
from torchpose.vision.clump import ArtefactConfig, keep_points, person_points
from torchpose.vision.colour_histogram import back_projection, colour_histogram, colour_similarity
from torchpose.vision.faces import FaceMemory
from torchpose.vision.head import HeadConfig, find_head
from torchpose.vision.trunk import TrunkConfig, find_trunk
from torchpose.window import PeopleWindows

TOUCHING = 3  # px between somebody and what may hide a part
HIDING = (
    1.2  # of the root of somebody's pixels, beside which something nearer stands; fewer are noise and floor
)
WHOLE = 3  # frames that show all of somebody, from which the height is taken: legs that stride are short
FACE_TO_HEAD = (0.0, -0.06, 0.08)  # m, from a face's surface to the head's centre, as measured on `people`


@dataclass(frozen=True)
class PeopleConfig:
    """How people are told apart and located."""

    partition: PartitionConfig = field(default_factory=PartitionConfig)
    location: LocationConfig = field(default_factory=LocationConfig)
    head: HeadConfig = field(default_factory=HeadConfig)
    trunk: TrunkConfig = field(default_factory=TrunkConfig)
    artefact: ArtefactConfig = field(default_factory=ArtefactConfig)
    before: float = 0.3  # m by which the scene must be nearer than a person, to hide what lies behind it
    hidden_parts: int = (
        3  # of the body, that make a person partly visible; both feet are soon behind something
    )
    mostly: float = 0.5  # of the body's parts hidden, above which a pose no longer says where somebody is
    memory: float = 2.0  # s for which the location of somebody unseen is believed
    pose_sd: float = 0.03  # m, of head and trunk as a pose has them
    same_clothes: float = 0.75  # similarity of colours, from which somebody who comes back is the same
    apart: float = 0.4  # m, least distance of two people's trunks seen from above
    middle_sd: float = 0.25  # m by which the middle of a silhouette is off the trunk's
    strangeness: float = (
        2.0  # up to which a newcomer is somebody known: 1 for clothes at the limit above, 1 for a
    )
    # place two standard deviations off
    appearing: float = (
        3.0  # times that, for whoever does not come in at the image's border, and was just there
    )
    scraps: float = 0.2  # of a newcomer's pixels; who has fewer may be the newcomer
    arrival: int = 3  # frames in which somebody further must be seen, before a pose is sought
    size_apart: float = 0.4  # s between the frames from which the size is measured on the way

    def __post_init__(self) -> None:
        for name in (
            "before",
            "memory",
            "pose_sd",
            "size_apart",
            "apart",
            "middle_sd",
            "strangeness",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0 <= self.same_clothes < 1:
            raise ValueError(f"same_clothes must be a similarity in [0, 1), got {self.same_clothes}")
        if min(self.hidden_parts, self.arrival) < 1:
            raise ValueError(
                f"hidden_parts and arrival must be at least 1, got {self.hidden_parts} and {self.arrival}"
            )


class People:
    """Follows everybody in a recording. The first person is the one of the model that is given."""

    def __init__(self, model: StereoToPose, config: PeopleConfig = PeopleConfig()):
        self.model, self.config = model, config
        self.filter = LocationFilter(config.location)
        self.followers = [Follower(model, sized=True)]

    def prepare(self, recording: Recording) -> None:
        """Learn the recording's empty scene and the size and colours of a person who is alone in it.

        Where nobody is seen alone, sizes are measured on the way.
        """
        seen = self.model.prepare(recording, self._alone)
        self.followers = [Follower(self.model, sized=seen or bool(self.model.config.person))]

    def _alone(self, frame: Frame) -> Sight | None:
        """Whoever is in a frame with nobody else, and with nothing before."""
        view = self.model.eyes.look(frame, self.model.device)
        masks = split_people(
            view.silhouette[0], view.depth[0], self.model.camera, None, self.config.partition
        )
        if len(masks) != 1:
            return None
        sight = self.model.eyes.sight(view, masks, None)
        return None if self._half_hidden(sight, view) else sight

    def __call__(self, recording: Recording) -> Iterator[list[FramePose]]:
        """Smoothed poses of a prepared recording's frames, in order: those of everybody who was there so far."""
        windows = PeopleWindows(self.followers)
        for position in range(len(recording)):
            yield from windows.push(self.step(recording, position))
        yield from windows.flush()

    def step(self, recording: Recording, position: int) -> list[FramePose]:
        """The poses in one frame, the next in order, of everybody known so far; newcomers are added at the end."""
        try:
            frame = recording[position]
        except UnreadableFrame as error:
            problem = str(error)
            return [
                FramePose(error.index, error.time_s, TrackStatus.lost, None, None, problem if first else "")
                for first in [True] + [False] * (len(self.followers) - 1)
            ]
        return self.follow(frame)

    def follow(self, frame: Frame) -> list[FramePose]:
        """The poses in the next frame."""
        eyes, time_s = self.model.eyes, frame.time_s
        view = eyes.look(frame, self.model.device)
        with self.model.stopwatch.measure("people"):
            expected = [self._expected(follower, time_s) for follower in self.followers]
            masks = self._whose(view, expected, time_s)
            expected += [None] * (len(self.followers) - len(expected))
        sights = [
            eyes.sight(view, mask[None], self._face(follower, time_s)) if bool(mask.any()) else None
            for follower, mask in zip(self.followers, masks, strict=True)
        ]
        with self.model.stopwatch.measure("people"):
            sights = [
                None if sight is None else self._without_artefacts(follower, sight, time_s)
                for follower, sight in zip(self.followers, sights, strict=True)
            ]
            covered = [
                self._covered(follower, view, masks, k, time_s) for k, follower in enumerate(self.followers)
            ]
        with self.model.stopwatch.measure("registration"):
            asked = []
            for follower, sight, body, cover in zip(self.followers, sights, expected, covered, strict=True):
                there = sight is not None and sight.present
                follower.seen = follower.seen + 1 if there else 0
                arrived = follower is self.followers[0] or follower.seen >= self.config.arrival
                follower.known |= there and arrived
                observation = None
                if sight is not None and there:
                    self._measure_height(follower, sight, view)
                if sight is not None and there and (arrived or follower.known):
                    observation = follower.model.observe(sight, cover)
                cut = sight is not None and (sight.cut or self._partly(body, cover))
                asked.append(
                    Sought(
                        follower.model.tracker,
                        time_s,
                        observation,
                        None if sight is None else sight.faces,
                        follower.model.size,
                        cut,
                        self._pelvis(follower, time_s),
                        self._walking(follower, time_s),
                    )
                )
            answers = track_together(asked)
        poses = []
        for k, (follower, sight, person, tracked) in enumerate(
            zip(self.followers, sights, asked, answers, strict=True)
        ):
            status = tracked.status
            if status is TrackStatus.absent and sight is not None and sight.present:
                status = TrackStatus.entering
            elif status is TrackStatus.absent and self._behind(expected[k], covered[k]):
                status = TrackStatus.lost
            if sight is not None:
                with self.model.stopwatch.measure("people"):
                    # A pose from the few points of somebody mostly hidden is drawn to whatever hides the rest.
                    body = expected[k]
                    if (
                        body is None
                        or float(self._unseen(body, covered[k]).float().mean()) <= self.config.mostly
                    ):
                        self._relocate(follower, sight, tracked.registration, time_s)
            if sight is not None and tracked.registration is not None:
                with self.model.stopwatch.measure("registration"):
                    follower.model.learn_colours(sight, tracked.registration)
                    self._learn(follower, sight, person, tracked.registration)
            poses.append(
                FramePose(frame.index, time_s, status, tracked.registration, sight, "", person.observation)
            )
        return poses

    def _located(self, follower: Follower, time_s: float) -> bool:
        where = follower.location
        return bool(where.known[0]) and 0 <= time_s - float(where.time_s[0]) <= self.config.memory

    def _pelvis(self, follower: Follower, time_s: float) -> Gaussian | None:
        """The middle of the hips at `time_s`, m; None if nobody knows."""
        if not self._located(follower, time_s):
            return None
        return self.filter.pelvis(self.filter.predict(follower.location, time_s))

    def _walking(self, follower: Follower, time_s: float) -> float | None:
        """Yaw of the way that the person walks, rad; None for whoever stands, or nobody knows.

        The filter's velocity answers to each step; where somebody was a while ago says more.
        """
        trail = follower.trail
        if not self._located(follower, time_s) or len(trail) < 2:
            return None
        gone = trail[-1] - trail[0]
        yaw = float(yaw_of_way(gone[0], gone[1:], self.model.config.start.walk))
        return None if math.isnan(yaw) else yaw

    def _expected(self, follower: Follower, time_s: float) -> PosedBody | None:
        """Where the person's body should be at `time_s`; None if nobody knows."""
        model, place = follower.model, self._pelvis(follower, time_s)
        expected = model.tracker.expect(time_s, place)
        if expected is not None:
            return model.body(expected.starts[:1], model.size)
        if place is None:
            return None
        pose = torch.cat([place.mean.to(model.size), model.size.new_zeros(1, 3), model.body.rest[None]], 1)
        return model.body(pose, model.size)

    def _whose(self, view: View, expected: list[PosedBody | None], time_s: float) -> list[Tensor]:
        """A mask for each follower; newcomers are followed from now on, or are somebody who comes back."""
        there = [k for k, body in enumerate(expected) if body is not None]
        bodies = _together([body for body in expected if body is not None])
        masks = split_people(
            view.silhouette[0], view.depth[0], self.model.camera, bodies, self.config.partition
        )
        nobody = torch.zeros_like(view.silhouette[0])
        own = [nobody] * len(self.followers)
        for k, mask in zip(there, masks, strict=False):
            own[k] = mask
        for mask in masks[len(there) :]:
            # Whoever has only scraps may be this one: a newcomer is as large as somebody.
            few = self.config.scraps * int(mask.sum())
            who = self._who_is(view, mask, [k for k in range(len(own)) if int(own[k].sum()) < few], time_s)
            if who is None:
                if len(self.followers) >= self.model.eyes.config.people:
                    continue
                self.followers.append(Follower(self.model.another(), sized=False))
                own.append(nobody)
                who = len(own) - 1
            own[who] = own[who] | mask
        return own

    def _who_is(
        self, view: View, mask: Bool[Tensor, "height width"], free: list[int], time_s: float
    ) -> int | None:
        """Which of the free followers a newcomer is, by clothes and by where each should be; None if somebody new.

        A first person who was never there is whoever comes first.
        """
        unknown = [k for k in free if not self.followers[k].known and self.followers[k].seen == 0]
        if unknown:
            return unknown[0]
        clothes = colour_histogram(view.images, mask[None]) if view.coloured else None
        v, u = (mask & (view.depth[0] > 0)).nonzero(as_tuple=True)
        points = self.model.camera.back_project(torch.stack([u, v], -1).to(view.depth), view.depth[0, v, u])
        middle = points.median(0).values
        # Who does not come in at the image's border was there before, behind something or lost.
        inside = not _at_border(mask)
        best, least = None, math.inf
        for k, follower in enumerate(self.followers):
            strange, limit = 0.0, self.config.strangeness
            if clothes is not None and follower.clothes is not None:
                alike = float(colour_similarity(follower.clothes, clothes)[0])
                strange += (1 - alike) / (1 - self.config.same_clothes)
            if self._located(follower, time_s):
                body = self.filter.predict(follower.location, time_s).body
                off = (middle - body.mean[0])[[0, 2]] ** 2  # upright or stooping: not the height
                if float(off.sum().sqrt()) < self.config.apart:
                    return k  # two people are not at one place: this is more of the same
                variance = body.covariance[0].diagonal()[[0, 2]] + self.config.middle_sd**2
                strange += float((off / variance).sum()) / 4
                limit *= self.config.appearing if inside else 1.0
            elif k not in free or clothes is None or follower.clothes is None:
                continue
            if strange < min(limit, least):
                best, least = k, strange
        return best

    def _measure_height(self, follower: Follower, sight: Sight, view: View) -> None:
        """A first size from frames that show head and feet, until frames with poses tell it better; from the head alone
        where the floor is known."""
        if follower.sized or self.model.config.height:
            return
        own = sight.silhouette[0]
        if self.model.eyes.floor is not None:
            hidden = _at_border(own) or bool(own[:2].any())
        else:
            hidden = sight.cut or self._half_hidden(sight, view)
        if hidden:
            return
        follower.heights.append(follower.model.height_in(sight))
        if len(follower.heights) >= WHOLE:
            height = follower.model.height_of(follower.heights)
            follower.model.size = self.model.body.size_of_height(height)

    def _half_hidden(self, sight: Sight, view: View) -> bool:
        """Whether something stands before what is seen of somebody, and beside it in the image."""
        own = sight.silhouette
        depth = torch.where(own, view.depth.nan_to_num(0.0), 0.0)
        beside = max_pool2d(depth, 2 * TOUCHING + 1, 1, TOUCHING)
        front = view.depth.nan_to_num(nan=torch.inf)
        if self.model.eyes.background_depth is not None:
            front = torch.minimum(front, self.model.eyes.background_depth.nan_to_num(nan=torch.inf))
        hides = ~own & (beside > 0) & (front < beside - self.config.before)
        return int(hides.sum()) > HIDING * int(own.sum()) ** 0.5

    def _face(self, follower: Follower, time_s: float) -> FaceMemory | None:
        recent = 0 < time_s - follower.face_time < self.model.eyes.config.memory
        return follower.face if recent else None

    def _without_artefacts(self, follower: Follower, sight: Sight, time_s: float) -> Sight:
        """The sight without points that cannot be the person's, by where he or she should be.

        Whoever has no pose to expect is located first, by head and trunk.
        """
        follower.face = sight.faces.memory
        if follower.face is not None:
            follower.face_time = time_s
        if not sight.present:
            return sight
        if not self._located(follower, time_s):
            follower.location = nowhere(follower.location.mean[:, :3])
        if follower.model.tracker.expect(time_s) is None:
            follower.location = self.filter.step(
                follower.location, self._measure(follower, sight, time_s), time_s
            ).location
        at = self.filter.predict(follower.location, time_s)
        sds = _spread(at.head), _spread(at.body)
        kept = person_points(sight.cloud, at.head.mean, at.body.mean, *sds, self.config.artefact)
        cloud = keep_points(sight.cloud, kept)
        return replace(sight, cloud=cloud, present=int(cloud.mask.sum()) >= self.model.eyes.config.min_points)

    def _measure(self, follower: Follower, sight: Sight, time_s: float) -> Sighting:
        """Head and trunk by face, shape and mean shift, near where they should be."""
        at = self.filter.predict(follower.location, time_s)
        cloud = sight.cloud
        weights = cloud.mask.to(cloud.points)
        if sight.coloured and follower.clothes is not None:
            u, v = cloud.pixels.round().long().unbind(-1)
            height, width = sight.images.shape[2:]
            colours = sight.images[0][:, v.clamp(0, height - 1), u.clamp(0, width - 1)].permute(1, 2, 0)
            weights = weights * (0.2 + 0.8 * back_projection(colours, follower.clothes))
        trunk = find_trunk(cloud.points, weights, self.config.trunk, at.body.mean)
        if bool(sight.faces.found[0]) and bool(sight.faces.position.isfinite().all()):
            head = sight.faces.position + torch.tensor(FACE_TO_HEAD).to(sight.faces.position)
            head_sd = torch.full_like(trunk.sd, torch.nan)
        else:
            heads = find_head(
                sight.depth,
                sight.silhouette,
                trunk.position,
                self.model.camera,
                self.config.head,
                at.head.mean,
                _spread(at.head),
            )
            head, head_sd = heads.position, heads.sd
        return sighting(head=head, body=trunk.position, head_sd=head_sd, body_sd=trunk.sd)

    def _relocate(self, follower: Follower, sight: Sight, found: Registration | None, time_s: float) -> None:
        """What a frame's pose says of the place goes into the filter; without a pose, what head and trunk say.

        A pose knows better than the densest place of the cloud, which in profile slides to the thighs.
        """
        measured = bool(follower.location.known[0]) and float(follower.location.time_s[0]) == time_s
        if found is None:
            if sight.present and not measured:
                seen = self._measure(follower, sight, time_s)
                follower.location = self.filter.step(follower.location, seen, time_s).location
            return
        joints = follower.model.body(found.pose, follower.model.size).joints
        pelvis, head = joints[:, JOINT_NAMES.index("pelvis")], joints[:, JOINT_NAMES.index("head")]
        body = head + (pelvis - head) / (1 + self.config.location.pelvis_share)
        sd = torch.full_like(body[:, 0], self.config.pose_sd)
        seen = sighting(head, body, sd, sd, (head - body).norm(dim=-1))
        step = (
            self.filter.begin(seen, time_s) if measured else self.filter.step(follower.location, seen, time_s)
        )
        follower.location = step.location
        place = [time_s, *step.location.body.mean[0, [0, 2]].tolist()]
        trail = torch.cat([follower.trail, follower.trail.new_tensor([place])])
        follower.trail = trail[trail[:, 0] >= time_s - self.model.config.start.walk.span]

    def _covered(
        self, follower: Follower, view: View, masks: list[Tensor], own: int, time_s: float
    ) -> Bool[Tensor, "1 height width"] | None:
        """Where the scene, or somebody else, stands before the person and may hide parts of the body."""
        if not self._located(follower, time_s):
            return None
        distance = float(follower.location.body.mean[0, 2]) - self.config.before
        scene = self.model.eyes.background_depth
        covered = torch.zeros_like(view.silhouette)
        if scene is not None:
            covered |= (scene < distance)[None]
        for k, mask in enumerate(masks):
            if k != own:
                covered |= (mask & (view.depth[0] < distance))[None]
        return covered if bool(covered.any()) else None

    def _partly(self, body: PosedBody | None, covered: Tensor | None) -> bool:
        """Whether parts of the expected body are hidden, or outside of the image."""
        return body is not None and int(self._unseen(body, covered).sum()) >= self.config.hidden_parts

    def _behind(self, body: PosedBody | None, covered: Tensor | None) -> bool:
        """Whether nearly all of the expected body is hidden, inside of the image."""
        if body is None or covered is None:
            return False
        return float(self._unseen(body, covered).float().mean()) > 0.7 and not bool(
            self._outside(body).float().mean() > 0.5
        )

    def _outside(self, body: PosedBody) -> Bool[Tensor, " parts"]:
        u, v = self.model.camera.project(body.centers[0]).unbind(-1)
        camera = self.model.camera
        return ~((u > -0.5) & (u < camera.width - 0.5) & (v > -0.5) & (v < camera.height - 0.5))

    def _unseen(self, body: PosedBody, covered: Tensor | None) -> Bool[Tensor, " parts"]:
        outside = self._outside(body)
        if covered is None:
            return outside
        u, v = self.model.camera.project(body.centers[0]).nan_to_num(0.0).round().long().unbind(-1)
        camera = self.model.camera
        return outside | covered[0, v.clamp(0, camera.height - 1), u.clamp(0, camera.width - 1)]

    def _learn(self, follower: Follower, sight: Sight, person: Sought, found: Registration) -> None:
        """The person's clothes, and the size from the first frames in which all of the person is seen."""
        if sight.coloured and not person.cut:
            now = colour_histogram(sight.images, sight.silhouette)
            follower.clothes = now if follower.clothes is None else 0.95 * follower.clothes + 0.05 * now
        if follower.sized or person.cut or person.observation is None:
            return
        if follower.samples and person.time_s - follower.samples[-1][0] < self.config.size_apart:
            return
        follower.samples.append((person.time_s, person.observation, found))
        if len(follower.samples) == self.model.config.size_frames:
            follower.model.size = follower.model.fit_size(
                [observation for _, observation, _ in follower.samples],
                torch.cat([registration.pose for _, _, registration in follower.samples]),
            )
            follower.sized, follower.samples = True, []

    def restore(self, states: Sequence[Mapping[str, Tensor]]) -> None:
        """Go on from the states of everybody."""
        self.followers = [Follower(self.model, sized=True)]
        self.followers += [Follower(self.model.another(), sized=False) for _ in states[1:]]
        for follower, state in zip(self.followers, states, strict=True):
            follower.restore(state)


def _at_border(mask: Bool[Tensor, "height width"]) -> bool:
    """Whether somebody is cut by the image's sides, where people come in."""
    return bool(mask[:, :2].any() | mask[:, -2:].any())


def _spread(place: Gaussian) -> Float[Tensor, " batch"]:
    """The greatest standard deviation of a place's coordinates, m."""
    return place.covariance.diagonal(dim1=-2, dim2=-1).amax(-1).sqrt()


def _together(bodies: list[PosedBody]) -> PosedBody | None:
    """Bodies of batch 1 as one batch."""
    if not bodies:
        return None
    names = PosedBody.__dataclass_fields__
    return PosedBody(**{name: torch.cat([getattr(body, name) for body in bodies]) for name in names})
