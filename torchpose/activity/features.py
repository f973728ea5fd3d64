"""Features of a clip (T. 4.2, 4.3): joint angles, limb directions, PCA, ICA, skeletons, and streams beside them.

Every feature has the same interface: `fit` on the training clips, then call it with a clip. A frame that was
lost has a row of NaN. Angles in rad, directions are unit vectors.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose.activity.dataset import Clip
from torchpose.activity.skeleton import (
    arm_places,
    bone_directions,
    joint_distances,
    joint_index,
    joint_places,
    travel,
)
from torchpose.activity.subspace import SilhouetteConfig, fast_ica, pca, resize_silhouettes


class FeatureKind(Enum):
    """Which feature. Lower-case names, as Hydra reads an enum by its member's name."""

    angles = "angles"  # joint parameters of the body pose (T. 4.3.2)
    directions = "directions"  # limb directions in the trunk's frame: no singular pose, no wrap-around
    pca = "pca"  # silhouettes on principal components (4.4)
    ica = "ica"  # silhouettes on independent components (4.8)
    skeleton = "skeleton"  # bone directions from joint positions


class Stream(Enum):
    """What an HMM sees side by side, each by a codebook of its own; all but the first two need joint positions."""

    feature = "feature"  # what `kind` names
    velocity = "velocity"  # its change
    places = "places"  # head and limb joints from the hips
    place_velocity = "place_velocity"  # their change
    arms = "arms"  # wrists and elbows from the shoulders
    arm_velocity = "arm_velocity"  # their change
    distances = "distances"  # between the hands, and from them to head, trunk and knees
    travel = "travel"  # way and rise since the first frame


class BodyFrame(Enum):
    """The frame of a skeleton's bone directions."""

    heading = "heading"  # turns with the hips about the vertical, the data's second axis; shows the lean
    trunk = "trunk"  # turns and leans with the trunk; for data whose vertical is unknown


@dataclass(frozen=True)
class FeatureConfig:
    """Which feature and how; each kind reads its own part."""

    kind: FeatureKind = FeatureKind.angles  # angles, directions, pca, ica or skeleton
    streams: tuple[Stream, ...] = (Stream.feature,)  # seen side by side
    velocity_step: int = 2  # frames: a change is x(t + step) - x(t - step)
    num_components: int = 150  # pca, ica: m of the thesis
    silhouette: SilhouetteConfig = field(default_factory=SilhouetteConfig)  # pca, ica
    ica_iterations: int = 200  # ica: at most, of FastICA
    ica_tolerance: float = 1e-4  # ica: stop when no component turns by more, 1 - |cosine|
    frame: BodyFrame = BodyFrame.heading  # skeleton: heading or trunk

    def __post_init__(self) -> None:
        if self.velocity_step < 1:
            raise ValueError(f"velocity_step must be at least 1 frame, got {self.velocity_step}")
        if not self.streams or len(set(self.streams)) < len(self.streams):
            names = ", ".join(stream.value for stream in self.streams)
            raise ValueError(f"streams must be one or more, each once, got {names or 'none'}; name some")
        if self.num_components < 1 or self.ica_iterations < 1 or self.ica_tolerance <= 0:
            raise ValueError(
                "num_components and ica_iterations must be at least 1 and ica_tolerance positive, got "
                f"{self.num_components}, {self.ica_iterations} and {self.ica_tolerance}"
            )


class Feature(nn.Module, ABC):
    """From a clip to one feature vector a frame."""

    @abstractmethod
    def fit(self, clips: Sequence[Clip], generator: torch.Generator) -> None:
        """Learn from the training clips what there is to learn; random starts come from `generator` (CPU)."""

    @abstractmethod
    def forward(self, clip: Clip) -> Float[Tensor, "time features"]:
        """The features of each frame, NaN where the frame was lost."""

    def deviation(self, clip: Clip) -> Float[Tensor, "time features"] | None:
        """Standard deviation of each feature by what the recorder knew of its errors; none where it knew nothing."""
        return None


class FeatureStreams(nn.Module):
    """A clip's streams: the feature and what else the configuration names, one vector a frame each.

    A frame is lost in the streams that need it: a change is lost if either of its frames was.
    """

    def __init__(self, config: FeatureConfig = FeatureConfig()) -> None:
        super().__init__()
        self.config = config
        self.feature = build_feature(config)

    def fit(self, clips: Sequence[Clip], generator: torch.Generator) -> None:
        """Learn the feature from the training clips."""
        self.feature.fit(clips, generator)

    def forward(self, clip: Clip) -> tuple[Float[Tensor, "time _"], ...]:
        """Each stream's vectors, in the order of `config.streams`."""
        step = self.config.velocity_step
        needed = set(self.config.streams)
        feature = self.feature(clip) if needed & {Stream.feature, Stream.velocity} else None
        found = []
        for stream in self.config.streams:
            match stream:
                case Stream.feature | Stream.velocity:
                    assert feature is not None
                    rows = feature
                case _:
                    rows = self._of_joints(stream, clip)
            moves = stream in (Stream.velocity, Stream.place_velocity, Stream.arm_velocity)
            found.append(change(rows, step) if moves else rows)
        return tuple(found)

    def deviation(self, clip: Clip) -> tuple[Float[Tensor, "time _"] | None, ...]:
        """Standard deviations of each stream, where the feature has them: errors of two frames are independent."""
        own = self.feature.deviation(clip)
        if own is None:
            return (None,) * len(self.config.streams)
        # Signs do not matter to squares: the variance of a change is the sum of two.
        both = change(own.square(), self.config.velocity_step, sign=1).sqrt()
        return tuple(
            {Stream.feature: own, Stream.velocity: both}.get(stream) for stream in self.config.streams
        )

    def _of_joints(self, stream: Stream, clip: Clip) -> Float[Tensor, "time features"]:
        joints, names = clip.stream("joints"), clip.joint_names
        upright = self.config.frame is BodyFrame.heading
        match stream:
            case Stream.places | Stream.place_velocity:
                rows = joint_places(joints, names, upright).flatten(1)
            case Stream.arms | Stream.arm_velocity:
                rows = arm_places(joints, names, upright).flatten(1)
            case Stream.distances:
                rows = joint_distances(joints, names)
            case _:
                rows = travel(joints, names)
        if rows.shape[1] == 0:
            raise ValueError(
                f"the stream {stream.value} needs more joints than {', '.join(joint_index(names))}, which the "
                "skeletons have; leave it out of feature.streams"
            )
        return _whole_rows(rows)


def change(rows: Float[Tensor, "time features"], step: int, sign: int = -1) -> Float[Tensor, "time features"]:
    """What is `step` frames later less (`sign` 1: plus) what is `step` earlier; at the ends over those that there are.

    A frame whose partner was lost counts as lost too.
    """
    frame = torch.arange(len(rows), device=rows.device)
    return rows[(frame + step).clamp(max=len(rows) - 1)] + sign * rows[(frame - step).clamp(min=0)]


def build_feature(config: FeatureConfig) -> Feature:
    """The feature that the configuration names."""
    feature: Feature
    match config.kind:
        case FeatureKind.angles:
            feature = JointAngleFeature()
        case FeatureKind.directions:
            feature = LimbDirectionFeature()
        case FeatureKind.pca:
            feature = PCAFeature(config)
        case FeatureKind.ica:
            feature = ICAFeature(config)
        case FeatureKind.skeleton:
            feature = SkeletonFeature(config.frame)
    return feature


class JointAngleFeature(Feature):
    """The pose parameters (T. 4.3.2) but for place and heading: pitch, roll and the 18 joint parameters."""

    def fit(self, clips: Sequence[Clip], generator: torch.Generator) -> None:
        """Nothing to learn."""

    def forward(self, clip: Clip) -> Float[Tensor, "time 20"]:
        return clip.stream("pose")[:, 4:]

    def deviation(self, clip: Clip) -> Float[Tensor, "time 20"] | None:
        return None if clip.pose_sd is None else clip.pose_sd[:, 4:]


class LimbDirectionFeature(Feature):
    """Limb directions in the torso's frame, and in that frame the direction of the camera's down: the lean.

    Unlike two-angle parameters these are continuous in the pose, also where a limb is straight.
    """

    def fit(self, clips: Sequence[Clip], generator: torch.Generator) -> None:
        """Nothing to learn."""

    def forward(self, clip: Clip) -> Float[Tensor, "time features"]:
        pitch, roll = clip.stream("pose")[:, 4:6].unbind(1)
        # R^T e_y for R = Ry(yaw) Rx(pitch) Rz(roll): the yaw cancels.
        down = torch.stack([pitch.cos() * roll.sin(), pitch.cos() * roll.cos(), -pitch.sin()], dim=1)
        return _whole_rows(torch.cat([clip.stream("directions").flatten(1), down], dim=1))


class PCAFeature(Feature):
    """Silhouettes on their principal components (4.4): F = (X - mean) E_PCA^T."""

    mean: Float[Tensor, " pixels"]
    projection: Float[Tensor, "pixels components"]

    def __init__(self, config: FeatureConfig = FeatureConfig(kind=FeatureKind.pca)) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.empty(0))
        self.register_buffer("projection", torch.empty(0, 0))

    def fit(self, clips: Sequence[Clip], generator: torch.Generator) -> None:
        """Principal components of all frames that are not lost."""
        fitted = pca(_training_images(clips, self.config.silhouette), self.config.num_components)
        self.mean, self.projection = fitted.mean, fitted.components.T

    def forward(self, clip: Clip) -> Float[Tensor, "time components"]:
        return _project(clip, self.config.silhouette, self.mean, self.projection)


class ICAFeature(Feature):
    """Silhouettes on independent component images (4.7, 4.8): E_ICA = W E_PCA, F = (X - mean) E_PCA^T W^+.

    The rows of E_PCA are taken as mixtures of m independent images, with a sample at each pixel (T. 4.2.2).
    W^+ is W^-1 unless the whitening found that the components determine one another.
    """

    mean: Float[Tensor, " pixels"]
    projection: Float[Tensor, "pixels components"]

    def __init__(self, config: FeatureConfig = FeatureConfig(kind=FeatureKind.ica)) -> None:
        super().__init__()
        self.config = config
        self.converged = False  # whether FastICA did, at the last fit
        self.register_buffer("mean", torch.empty(0))
        self.register_buffer("projection", torch.empty(0, 0))

    def fit(self, clips: Sequence[Clip], generator: torch.Generator) -> None:
        """PCA of all frames that are not lost, then FastICA of the components."""
        subspace = pca(_training_images(clips, self.config.silhouette), self.config.num_components)
        size = len(subspace.components)
        start = torch.randn(size, size, generator=generator, dtype=torch.float64).to(subspace.components)
        ica = fast_ica(subspace.components, start, self.config.ica_iterations, self.config.ica_tolerance)
        self.converged = ica.converged
        self.mean = subspace.mean
        self.projection = subspace.components.T @ torch.linalg.pinv(ica.unmixing)

    def forward(self, clip: Clip) -> Float[Tensor, "time components"]:
        return _project(clip, self.config.silhouette, self.mean, self.projection)


class SkeletonFeature(Feature):
    """Bone directions in the body's frame, from joint positions (`torchpose.activity.skeleton`)."""

    def __init__(self, frame: BodyFrame = BodyFrame.heading) -> None:
        super().__init__()
        self.frame = frame

    def fit(self, clips: Sequence[Clip], generator: torch.Generator) -> None:
        """Nothing to learn."""

    def forward(self, clip: Clip) -> Float[Tensor, "time features"]:
        upright = self.frame is BodyFrame.heading
        directions = bone_directions(clip.stream("joints"), clip.joint_names, upright)
        return _whole_rows(directions.flatten(1))


def _whole_rows(rows: Float[Tensor, "time features"]) -> Float[Tensor, "time features"]:
    """A frame is lost as a whole: one NaN makes its row NaN."""
    return torch.where(rows.isnan().any(1, keepdim=True), torch.nan, rows)


def _training_images(clips: Sequence[Clip], config: SilhouetteConfig) -> Float[Tensor, "images pixels"]:
    """All silhouettes that are not lost, small and flat."""
    images = torch.cat([resize_silhouettes(clip.stream("silhouettes"), config).flatten(1) for clip in clips])
    images = images[~images.isnan().any(1)]
    if len(images) == 0:
        raise ValueError("silhouette features need a frame with foreground, got none in any training clip")
    return images


def _project(
    clip: Clip,
    config: SilhouetteConfig,
    mean: Float[Tensor, " pixels"],
    projection: Float[Tensor, "pixels components"],
) -> Float[Tensor, "time components"]:
    images = resize_silhouettes(clip.stream("silhouettes"), config, projection.dtype).flatten(1)
    if len(mean) != images.shape[1]:
        raise ValueError(
            f"the subspace was made for images of {len(mean)} pixels, got {images.shape[1]}"
            + ("; call fit first" if len(mean) == 0 else "")
        )
    return (images - mean) @ projection
