"""People who go about a room: along a path, standing still, seated for a while, moving their arms.

Left-camera frame (x right, y down, z forward); metres, radians, seconds.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.model import BodyModel
from torchpose.synthesis.motion import (
    AHEAD,
    Draw,
    Figure,
    lowest,
    pose_figure,
    root_height,
    sit_down,
    smooth_step,
    soon,
    stand_at_ease,
    wander_arms,
)

STEP = 0.02  # s, of the fine grid on which a path is measured
ROUNDING = 0.35  # s before and after, over which corners of a path are rounded
CHANGE = 0.9  # s, to sit down, to stand up, to begin and to end a gesture
Span = tuple[float, float]


@dataclass(frozen=True)
class Path:
    """Where somebody is, and when: straight from spot to spot, with rounded corners.

    Before the first and after the last time they go on as between the first two and the last two spots. Whoever goes
    looks ahead, whoever stands looks at the camera.
    """

    times: tuple[float, ...]  # s, ascending
    spots: tuple[tuple[float, float], ...]  # m, x and z, at these times
    seated: tuple[Span, ...] = ()  # s, from and to: the change takes `CHANGE` inside of it
    gestures: tuple[Span, ...] = ()  # s, when the arms wander about

    def __post_init__(self) -> None:
        if not self.times or len(self.times) != len(self.spots):
            raise ValueError(
                f"a path must have a time for each spot, got {len(self.times)} times and {len(self.spots)} spots; "
                "give as many, at least one"
            )
        if any(later <= earlier for earlier, later in zip(self.times, self.times[1:], strict=False)):
            raise ValueError(f"the times of a path must ascend, got {self.times}; order them")
        for first, last in (*self.seated, *self.gestures):
            if last - first < 2 * CHANGE:
                raise ValueError(
                    f"sitting and gestures must last {2 * CHANGE:g} s, got {first:g} to {last:g}; lengthen them"
                )

    def place(self, times: Float[Tensor, " time"]) -> Float[Tensor, "time 2"]:
        """x and z at `times`, m."""
        offsets = torch.linspace(-ROUNDING, ROUNDING, 15).to(times)
        weight = 1 + torch.cos(math.pi * offsets / ROUNDING)
        around = self._straight((times[:, None] + offsets).flatten()).unflatten(0, (-1, len(offsets)))
        return (around * (weight / weight.sum())[:, None]).sum(1)

    def velocity(self, times: Float[Tensor, " time"]) -> Float[Tensor, "time 2"]:
        """Its derivative, m/s."""
        return (self.place(times + STEP) - self.place(times - STEP)) / (2 * STEP)

    def _straight(self, times: Float[Tensor, " time"]) -> Float[Tensor, "time 2"]:
        spots = torch.tensor(self.spots).to(times)
        if len(spots) == 1:
            return spots.expand(len(times), 2)
        known = torch.tensor(self.times).to(times)
        i = torch.searchsorted(known, times.contiguous()).clamp(1, len(known) - 1)
        share = (times - known[i - 1]) / (known[i] - known[i - 1])
        return spots[i - 1] + share[:, None] * (spots[i] - spots[i - 1])


def walk(
    body: BodyModel,
    size: Float[Tensor, "1 sizes"],
    path: Path,
    times: Float[Tensor, " time"],
    person: int = 0,
    take: int = 0,
    floor: float = 1.1,
) -> Float[Tensor, "time parameters"]:
    """The poses at `times` (s) of somebody on a path, within the body's limits, on a floor `floor` m below the camera.

    `person` decides the style, `take` what is not style. The hips keep to the path (of whoever sits the feet do); the
    legs swing with the way that has been gone, not with time, so that feet hardly slide.
    """
    times = times.to(size)
    style, draw = Draw("walk", "style", person), Draw("walk", "take", person, take)
    figure = stand_at_ease(draw, times)
    leg = _leg_length(body, size)
    figure = _stride(figure, style, draw, path, times, leg)
    if path.gestures:
        moving = replace(figure, arms=figure.arms.clone())
        wander_arms(moving, draw, times, 0.5)
        figure = replace(figure, arms=torch.lerp(figure.arms, moving.arms, _during(path.gestures, times)))
    down = _during(path.seated, times)
    if path.seated:
        sit_down(figure, style, draw, down)
    pose = pose_figure(body, figure, _heading(path, times))
    posed = body(pose, size)
    feet = [body.joint_names.index(f"ankle_{side}") for side in ("left", "right")]
    back = down[:, None] * posed.joints[:, feet].mean(1)[:, 0::2]
    x, z = (path.place(times) - back).unbind(1)
    return torch.cat((torch.stack((x, root_height(lowest(body, posed), floor), z), 1), pose[:, 3:]), 1)


def _stride(
    figure: Figure, style: Draw, take: Draw, path: Path, times: Float[Tensor, " time"], leg: float
) -> Figure:
    """The figure with the legs and arms of somebody who goes, as far as they go."""
    swing, hands, knee, bend = style(0.30, 0.40), style(0.25, 0.5), style(0.75, 1.1), style(0.2, 0.6)
    speed = path.velocity(times).norm(dim=1)
    going = 1 - torch.exp(-((speed / 0.35) ** 2))
    # In half a stride the foot on the floor goes from `swing` before the hip to `swing` behind it, and a little more.
    phase = math.tau * (_way(path, times) / (4.4 * swing * leg) + take(0.0, 1.0))
    for side in (0, 1):
        own = phase + math.pi * side
        thigh = 0.1 + swing * own.sin()
        flexion = 0.08 + knee * ((1 + (own + 0.25).cos()) / 2) ** 2  # bent while the leg swings forward
        arm = -hands * take(0.9, 1.1) * own.sin()
        goal = (thigh, thigh - flexion, arm, arm + bend * (1 - 0.3 * own.sin()))
        for limbs, row, angle in zip(
            (figure.legs, figure.legs, figure.arms, figure.arms), (0, 2) * 2, goal, strict=True
        ):
            limbs[side, row] += (angle - limbs[side, row]) * going
            limbs[side, row + 1] += (AHEAD - 0.05 - limbs[side, row + 1]) * soon(going)
    figure.trunk[0] -= style(0.02, 0.08) * phase.sin() * going
    figure.trunk[1] += style(0.0, 0.06) * going
    return figure


def _way(path: Path, times: Float[Tensor, " time"]) -> Float[Tensor, " time"]:
    """How far somebody has gone since the path's first time, m."""
    start = path.times[0]
    first = math.floor((min(float(times.min()), start) - start) / STEP) - 1
    last = math.ceil((max(float(times.max()), start) - start) / STEP) + 1
    # Midpoints of steps that lie alike for whatever times are asked for.
    grid = start + STEP * torch.arange(first, last + 1).to(times)
    gone = torch.cat((grid.new_zeros(1), (STEP * path.velocity(grid[:-1] + STEP / 2).norm(dim=1)).cumsum(0)))
    at = (times - start) / STEP - first
    i = at.floor().long().clamp(0, len(gone) - 2)
    return torch.lerp(gone[i], gone[i + 1], at - i) - gone[-first]


def _heading(path: Path, times: Float[Tensor, " time"]) -> Float[Tensor, " time"]:
    """Yaw, rad: along the way, and to the camera where somebody stands; turning takes its time."""
    offsets = torch.linspace(-0.3, 0.3, 13).to(times)
    velocity = path.velocity((times[:, None] + offsets).flatten())
    speed = velocity.norm(dim=1, keepdim=True)
    # Not straight to the camera, so that whoever comes back turns to one side.
    ahead = velocity + 0.4 * torch.exp(-((speed / 0.3) ** 2)) * velocity.new_tensor([0.08, -1.0])
    ahead = torch.nn.functional.normalize(ahead, dim=1).unflatten(0, (-1, len(offsets))).mean(1)
    return torch.atan2(-ahead[:, 0], -ahead[:, 1])


def _during(spans: tuple[Span, ...], times: Float[Tensor, " time"]) -> Float[Tensor, " time"]:
    """1 within the spans, 0 outside, without corners."""
    inside = torch.zeros_like(times)
    for first, last in spans:
        inside = inside + smooth_step((times - first) / CHANGE) * smooth_step((last - times) / CHANGE)
    return inside


def _leg_length(body: BodyModel, size: Float[Tensor, "1 sizes"]) -> float:
    posed = body(torch.cat((size.new_zeros(1, 6), body.rest[None].to(size)), 1), size)
    hip, ankle = (posed.joints[0, body.joint_names.index(f"{name}_left")] for name in ("hip", "ankle"))
    return float((hip - ankle).norm())
