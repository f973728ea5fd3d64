"""How people move: the eight activities of the thesis (T. 5.3), its exercises of single joints (T. 5.1, 5.2),
free motion and a demonstration, as poses over time.

Left-camera frame (x right, y down, z forward); metres, radians, seconds. Left and right are the subject's.
Every take is drawn from random streams named after the person and the take, so it does not depend on what was
drawn before it.
"""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from torchpose.body.model import BodyModel, PosedBody
from torchpose.geometry import exp_rotation
from torchpose.vision.camera import StereoCamera

ACTIVITIES = (
    "left_hand",
    "right_hand",
    "both_hands",
    "boxing",
    "left_leg",
    "right_leg",
    "walking",
    "sitting",
)
# What the thesis measured angles on (5.1 and Table 5.1), and a trunk that turns to and fro.
EXERCISES = ("arms", "elbow_horizontal", "elbow_vertical", "knee", "shoulder", "turning")
MOTIONS = (*ACTIVITIES, *EXERCISES, "free", "demo")
LEFT, RIGHT = 0, 1
_USUAL = 4.0  # s, of a take: a person's place is its average over these
AHEAD = math.pi / 2  # azimuth of a limb that is raised straight ahead; 0: outward to its own side


def random_stream(*names: int | str) -> torch.Generator:
    """A generator of its own for whatever is named, the same on every machine and in any order of calls."""
    digest = hashlib.sha256(repr(names).encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") % 2**63)


@dataclass(frozen=True)
class MotionConfig:
    heading: float = 0.61  # rad, the most that a person turns away from facing the camera: 35 degrees
    period: tuple[float, float] = (1.4, 2.6)  # s, of one repetition
    distance: tuple[float, float] = (2.5, 3.5)  # m, where people stand; further off if they would not fit
    aside: float = 0.15  # m, the most to the left or right of the camera's axis
    floor: float = 1.1  # m below the camera

    def __post_init__(self) -> None:
        for name in ("period", "distance"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"{name} must be a positive range, low to high, got {low} to {high}")


class Draw:
    """Numbers about a person or a take, one after the other from a stream."""

    def __init__(self, *names: int | str):
        self.generator = random_stream(*names)

    def __call__(self, low: float, high: float) -> float:
        return low + (high - low) * torch.rand((), generator=self.generator).item()

    def drift(self, times: Tensor, amplitude: float, fastest: float = 0.5) -> Tensor:
        """A slow, smooth wandering about 0, at most `amplitude`: three sines up to `fastest` Hz."""
        waves = [torch.sin(math.tau * (self(0.1, fastest) * times + self(0.0, 1.0))) for _ in range(3)]
        return amplitude / 3 * (waves[0] + waves[1] + waves[2])


@dataclass(frozen=True)
class Figure:
    """How the limbs are held, without the place. A limb is raised by an angle from hanging, towards an
    azimuth.

    Arms are given in the trunk's frame, legs in the upright frame that faces where the person faces: the
    trunk may lean and turn above planted feet.
    """

    arms: Float[Tensor, "2 4 time"]  # left, right: the upper arm's raise and azimuth, the forearm's
    legs: Float[Tensor, "2 4 time"]  # left, right: the thigh's raise and azimuth, the shank's
    trunk: Float[Tensor, "3 time"]  # turn (to the right, seen by the person), lean forward, tilt to the left
    head: Float[Tensor, "2 time"]  # nod, tilt to the left
    planted: bool = (
        True  # the lower foot keeps its place; else the hips do, and the feet slide as on a treadmill
    )
    leader: float = 0.0  # m by which the left foot may count as lower than it is (negative: the right one)


_Act = Callable[[Draw, Draw, Tensor, float], Figure]


def _directions(angles: Float[Tensor, "2 4 time"]) -> Float[Tensor, "2 2 time 3"]:
    """Unit vectors (side, limb) of raises and azimuths; x to the person's left, y down, z backward."""
    rise, azimuth = angles[:, 0::2], angles[:, 1::2]
    out = torch.tensor([1.0, -1.0])[:, None, None].to(angles)
    return torch.stack((out * rise.sin() * azimuth.cos(), rise.cos(), -rise.sin() * azimuth.sin()), -1)


def stand_at_ease(draw: Draw, times: Tensor) -> Figure:
    """A person who stands at ease, never quite still."""

    def held(rows: list[float], amplitude: float) -> Tensor:
        return torch.stack([value + draw.drift(times, amplitude) for value in rows])

    arm = [draw(0.08, 0.18), draw(0.3, 0.8), draw(0.15, 0.35), draw(0.9, 1.4)]
    leg = [draw(0.03, 0.09), draw(0.1, 0.6), draw(0.0, 0.05), draw(0.1, 0.6)]
    return Figure(
        arms=torch.stack([held(arm, 0.05), held(arm, 0.05)]),
        legs=torch.stack([held(leg, 0.01), held(leg, 0.01)]),
        trunk=held([0.0, draw(-0.03, 0.06), 0.0], 0.03),
        head=held([draw(-0.1, 0.15), 0.0], 0.08),
    )


def _repetition(draw: Draw, times: Tensor, period: float) -> Float[Tensor, " time"]:
    """Phase (rad) of a repeated movement: a person's tempo wanders a little."""
    return math.tau * (times / (period * draw(0.92, 1.08)) + draw(0.0, 1.0)) + draw.drift(times, 0.35)


def _up_and_down(phase: Float[Tensor, " time"]) -> Float[Tensor, " time"]:
    """0 at the bottom, 1 at the top, with rests at both ends."""
    wave = (1 - phase.cos()) / 2
    return wave * wave * (3 - 2 * wave)


def _raise_hands(sides: tuple[int, ...]) -> _Act:
    def act(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
        figure = stand_at_ease(take, times)
        top, azimuth, bend = style(2.25, 2.75), style(0.35, 1.35), style(0.1, 0.9)
        phase = _repetition(take, times, period)
        for side in sides:
            lift = _up_and_down(phase + take(-0.12, 0.12)) * (1 + take.drift(times, 0.05)) * take(0.92, 1.0)
            hanging = figure.arms[side].clone()
            figure.arms[side, 0] = hanging[0] + (top - hanging[0]) * lift
            figure.arms[side, 1] = azimuth + take(-0.15, 0.15)
            flexion = hanging[2] - hanging[0] + 4 * bend * lift * (1 - lift)  # the elbow bends on the way
            figure.arms[side, 2] = figure.arms[side, 0] + flexion
            figure.arms[side, 3] = figure.arms[side, 1] + (hanging[3] - figure.arms[side, 1]) * (1 - lift)
        return figure

    return act


def _box(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
    figure = stand_at_ease(take, times)
    guard = times.new_tensor([style(0.15, 0.45), style(0.7, 1.1), style(2.4, 2.7), style(1.6, 1.9)])
    punch = times.new_tensor([style(1.3, 1.5), style(1.35, 1.5), style(1.4, 1.6), style(1.5, 1.7)])
    phase = _repetition(take, times, period / 1.3)
    reach = []
    for side in (LEFT, RIGHT):
        wave = (1 + (phase + math.pi * side + take(-0.2, 0.2)).cos()) / 2
        reach.append(wave * wave * take(0.88, 1.0))
        wander = torch.stack([take.drift(times, 0.04) for _ in guard])
        figure.arms[side] = guard[:, None] + (punch - guard)[:, None] * reach[side] + wander
    figure.trunk[0] += style(0.1, 0.3) * (reach[LEFT] - reach[RIGHT])
    figure.trunk[1] += style(0.02, 0.15)
    return figure


def _raise_leg(side: int) -> _Act:
    def act(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
        figure = stand_at_ease(take, times)
        lift = _up_and_down(_repetition(take, times, period)) * (1 + take.drift(times, 0.05))
        top, knee, azimuth = style(0.85, 1.35), style(0.65, 1.1), style(1.3, 1.5)
        figure.legs[side, 0] += top * take(0.92, 1.0) * lift
        figure.legs[side, 1] += (azimuth - figure.legs[side, 1]) * soon(lift)
        figure.legs[side, 2] += top * (1 - knee) * lift
        figure.legs[side, 3] = azimuth
        figure.arms[:, 0] += style(0.0, 0.2) * lift  # for balance
        figure.trunk[1] -= style(0.0, 0.08) * lift
        return replace(figure, leader=-1.0 if side == LEFT else 1.0)

    return act


def _walk(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
    figure = stand_at_ease(take, times)
    phase = _repetition(take, times, period / 1.6)
    stride, swing, knee, bend = style(0.28, 0.42), style(0.25, 0.5), style(0.75, 1.1), style(0.2, 0.6)
    for side in (LEFT, RIGHT):
        own = phase + math.pi * side
        thigh = 0.1 + stride * own.sin()
        flexion = (
            0.08 + knee * ((1 + (own + 0.25).cos()) / 2) ** 2
        )  # the knee bends while the leg swings forward
        figure.legs[side, 0], figure.legs[side, 1] = thigh, AHEAD - 0.03
        figure.legs[side, 2], figure.legs[side, 3] = thigh - flexion, AHEAD - 0.03
        arm = -swing * take(0.9, 1.1) * own.sin()
        figure.arms[side, 0], figure.arms[side, 1] = arm, AHEAD - 0.1
        figure.arms[side, 2], figure.arms[side, 3] = arm + bend * (1 - 0.3 * own.sin()), AHEAD
    figure.trunk[0] -= style(0.02, 0.08) * phase.sin()
    figure.trunk[1] += style(0.0, 0.06)
    return replace(figure, planted=False)


def _sit(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
    figure = stand_at_ease(take, times)
    sit_down(figure, style, take, _up_and_down(_repetition(take, times, 1.3 * period)))
    return figure


def sit_down(figure: Figure, style: Draw, take: Draw, down: Float[Tensor, " time"]) -> None:
    """Bring a figure from standing (0) to sitting (1)."""
    thigh, shank, spread = style(1.25, 1.5), style(0.1, 0.25), style(1.3, 1.5)
    hands, reach = style(0.3, 0.8), style(0.4, 0.9)
    for side in (LEFT, RIGHT):
        figure.legs[side, 0] += (thigh - figure.legs[side, 0]) * down
        figure.legs[side, 1] += (spread - figure.legs[side, 1]) * soon(down)
        figure.legs[side, 2] -= shank * down
        figure.legs[side, 3] = AHEAD
        figure.arms[side, 0] += (hands * take(0.9, 1.1) - figure.arms[side, 0]) * down
        figure.arms[side, 1] += (AHEAD - 0.2 - figure.arms[side, 1]) * down
        figure.arms[side, 2] += reach * down
    figure.trunk[1] += 4 * style(0.08, 0.14) * down * (1 - down) + style(0.0, 0.15) * down


def _exercise_arms(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
    """Elbows and shoulders move and nothing else does (T. 5.1)."""
    still, T = stand_at_ease(take, times[:1]), len(times)
    figure = Figure(
        arms=still.arms.repeat(1, 1, T),
        legs=still.legs.repeat(1, 1, T),
        trunk=still.trunk.repeat(1, T),
        head=still.head.repeat(1, T),
    )
    wander_arms(figure, take, times, 1.8 / period)
    return figure


def wander_arms(figure: Figure, take: Draw, times: Tensor, pace: float) -> None:
    """Shoulders and elbows wander through their range, up to `pace` Hz."""
    for side in (LEFT, RIGHT):
        rise = 1.0 + take.drift(times, 0.95, pace)
        figure.arms[side, 0] = rise
        figure.arms[side, 1] = take(0.5, 1.1) + take.drift(times, 0.5, pace)
        figure.arms[side, 2] = rise + 0.8 + take.drift(times, 0.75, pace)
        figure.arms[side, 3] = figure.arms[side, 1] + take.drift(times, 0.5, pace)


def _bend_elbows(up: bool) -> _Act:
    """The upper arms are held out; the forearms go from straight to a right angle, forward or up."""

    def act(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
        figure = stand_at_ease(take, times)
        rise, azimuth, bend = style(1.4, 1.6), style(0.05, 0.3), style(1.35, 1.65)
        phase = _repetition(take, times, period)
        for side in (LEFT, RIGHT):
            flexion = style(0.05, 0.2) + bend * _up_and_down(phase + take(-0.15, 0.15)) * take(0.92, 1.0)
            figure.arms[side, 0] = rise + take.drift(times, 0.06)
            figure.arms[side, 1] = azimuth + take.drift(times, 0.06)
            figure.arms[side, 2] = figure.arms[side, 0] + (flexion if up else take.drift(times, 0.06))
            figure.arms[side, 3] = figure.arms[side, 1] + (take.drift(times, 0.06) if up else flexion)
        return figure

    return act


def _bend_knees(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
    """A knee is lifted until thigh and shank make a right angle, the right one and the left in turn."""
    figure = stand_at_ease(take, times)
    phase = _repetition(take, times, period)
    top, azimuth = style(1.2, 1.5), style(1.3, 1.5)
    for side in (LEFT, RIGHT):
        own = (phase / math.tau).floor().remainder(2) != side
        lift = own * _up_and_down(phase) * take(0.92, 1.0)
        figure.legs[side, 0] += top * lift
        figure.legs[side, 1] += (azimuth - figure.legs[side, 1]) * soon(lift)
        figure.legs[side, 2] -= (math.pi / 2 - top) * lift
        figure.legs[side, 3] = azimuth
    figure.arms[:, 0] += style(0.0, 0.2)
    return figure


def _circle_arms(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
    """Straight arms go up at the sides, down to the front, out to the sides and down again (T. Fig. 5.6)."""
    figure = stand_at_ease(take, times)
    phase = _repetition(take, times, 2.4 * period)
    top, level, front = style(2.5, 2.75), style(1.45, 1.6), style(1.3, 1.45)
    for side in (LEFT, RIGHT):
        own = (phase + take(-0.1, 0.1)).remainder(math.tau) * (4 / math.tau)  # quarters of the round
        up, over, out, down = (smooth_step(own - quarter) for quarter in range(4))
        hanging = figure.arms[side, 0].clone()
        figure.arms[side, 0] += (top - hanging) * up + (level - top) * over - (level - hanging) * down
        figure.arms[side, 1] = take(0.1, 0.3) + (front - 0.2) * (over - out)
        figure.arms[side, 2:] = figure.arms[side, :2]
        figure.arms[side, 2] += style(0.05, 0.15) + take.drift(times, 0.04)
    return figure


def _turn(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
    """The trunk turns to the right and to the left, 40 degrees each."""
    figure = stand_at_ease(take, times)
    phase = _repetition(take, times, 1.5 * period)
    figure.trunk[0] += 0.7 * phase.sin() * take(0.95, 1.0)
    swing, bend = style(0.1, 0.3), style(0.1, 0.9)
    for side, way in ((LEFT, 1.0), (RIGHT, -1.0)):
        figure.arms[side, 0] += swing * (1 + way * (phase - 0.3).sin())
        figure.arms[side, 2] += swing * (1 + way * (phase - 0.5).sin()) + bend
    return figure


def _move_freely(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
    figure = stand_at_ease(take, times)
    pace = 1 / period
    wander_arms(figure, take, times, pace)
    # One foot stands while the other is lifted a little.
    balance = take.drift(times, 1.0, pace)
    for side in (LEFT, RIGHT):
        lift = smooth_step(balance if side == LEFT else -balance) * take(0.5, 0.9)
        figure.legs[side, 0] += lift
        figure.legs[side, 1] += (AHEAD - take(0.0, 0.5) - figure.legs[side, 1]) * soon(lift)
        figure.legs[side, 2] -= 0.3 * lift
        figure.legs[side, 3] = AHEAD
    figure.trunk[:] += torch.stack([take.drift(times, amplitude, pace) for amplitude in (0.35, 0.15, 0.1)])
    figure.head[:] += torch.stack([take.drift(times, 0.25, pace), take.drift(times, 0.2, pace)])
    return figure


def _demonstrate(style: Draw, take: Draw, times: Tensor, period: float) -> Figure:
    """Both hands go up, and down again to the sides; then a step forward with the left leg. 2.5 seconds."""
    figure = stand_at_ease(take, times)
    up = smooth_step(times / 0.9) * (1 - smooth_step((times - 1.0) / 0.8))
    for side in (LEFT, RIGHT):
        figure.arms[side, 0] += 2.35 * up
        figure.arms[side, 1] = 0.45 + 0.15 * side
        figure.arms[side, 2] += 2.5 * up
        figure.arms[side, 3] += (0.6 - figure.arms[side, 3]) * up
    lift, step = _bump((times - 1.5) / 0.8), smooth_step((times - 1.6) / 0.8)
    figure.legs[LEFT, 0] += 0.75 * lift + 0.26 * step
    figure.legs[LEFT, 2] += 0.22 * step - 0.15 * lift
    figure.legs[RIGHT, 0] -= 0.22 * step
    figure.legs[RIGHT, 2] -= 0.24 * step
    figure.legs[:, 1::2] = AHEAD - 0.25
    figure.arms[LEFT, 0] -= 0.2 * step
    figure.arms[RIGHT, 2] += 0.35 * step
    return replace(figure, leader=-1.0)


def soon(lift: Tensor) -> Tensor:
    """How far a limb has found its plane, 0 to 1: long before it is up, so that it does not swing out
    sideways.
    """
    return lift / (lift + 0.05)


def smooth_step(x: Tensor) -> Tensor:
    """From 0 to 1 as x does, without corners; 0 before, 1 after."""
    x = x.clamp(0, 1)
    return x * x * x * (10 - 15 * x + 6 * x * x)


def _bump(x: Tensor) -> Tensor:
    """Up and down again while x goes from 0 to 1, without corners; 0 outside."""
    return torch.sin(math.pi * x.clamp(0, 1)) ** 2


_ACTS: dict[str, _Act] = {
    "left_hand": _raise_hands((LEFT,)),
    "right_hand": _raise_hands((RIGHT,)),
    "both_hands": _raise_hands((LEFT, RIGHT)),
    "boxing": _box,
    "left_leg": _raise_leg(LEFT),
    "right_leg": _raise_leg(RIGHT),
    "walking": _walk,
    "sitting": _sit,
    "arms": _exercise_arms,
    "elbow_horizontal": _bend_elbows(up=False),
    "elbow_vertical": _bend_elbows(up=True),
    "knee": _bend_knees,
    "shoulder": _circle_arms,
    "turning": _turn,
    "free": _move_freely,
    "demo": _demonstrate,
}


def perform(
    body: BodyModel,
    size: Float[Tensor, "1 sizes"],
    motion: str,
    times: Float[Tensor, " time"],
    camera: StereoCamera,
    person: int = 0,
    take: int = 0,
    config: MotionConfig = MotionConfig(),
) -> Float[Tensor, "time parameters"]:
    """The poses of one take of a motion (one of `MOTIONS`) at `times` (s), within the body's limits.

    `person` decides the style (how high, in which plane, how bent), `take` the tempo, phase, heading and
    place. The whole person, hands up, is in the camera's view; where, does not depend on the motion. Raises
    ValueError for an unknown motion.
    """
    if motion not in _ACTS:
        raise ValueError(f"the motion must be one of {', '.join(MOTIONS)}, got {motion!r}")
    asked, usual = len(times), torch.arange(0.0, _USUAL, 0.1)
    times = torch.cat([times.to(size), usual.to(size)])  # the place must not depend on what is asked for
    style, draw = Draw("style", motion, person), Draw("take", motion, person, take)
    place = Draw("place", person, take, motion)
    figure = _ACTS[motion](style, draw, times, place(*config.period))
    facing = 0.25 if motion in ("demo", "turning") else config.heading
    heading = facing * place(-1.0, 1.0)
    pose = pose_figure(body, figure, times.new_tensor(heading).expand_as(times))
    near, far = _distances(body, size, camera, config)
    spot = torch.tensor([config.aside * place(-1.0, 1.0), place(near, far)]).to(size)
    root = _stand(body, size, pose, figure, heading, spot, config.floor, len(usual))
    return torch.cat((root, pose[:, 3:]), -1)[:asked]


def pose_figure(
    body: BodyModel, figure: Figure, heading: Float[Tensor, " time"]
) -> Float[Tensor, "time parameters"]:
    """A figure's poses within the body's limits, the root at the camera. `heading` is the yaw, rad: 0 faces it."""
    turn, lean, tilt = figure.trunk
    nod, aslant = figure.head
    leaning = exp_rotation(_along(1, turn)) @ exp_rotation(_along(0, lean)) @ exp_rotation(_along(2, tilt))
    arms = (
        _directions(figure.arms).permute(2, 0, 1, 3).flatten(1, 2)
    )  # (T, left and right upper arm and forearm, 3)
    legs = _directions(figure.legs).permute(2, 0, 1, 3).flatten(1, 2) @ leaning  # rows: R^T d
    head = torch.stack((aslant.sin(), -aslant.cos() * nod.cos(), -aslant.cos() * nod.sin()), -1)
    directions = torch.cat((head[:, None], arms, legs), 1)
    angles = torch.stack((heading + turn, lean, tilt), -1)
    pose = body.pose_from_directions(torch.zeros_like(angles), angles, directions)
    return torch.maximum(torch.minimum(pose, body.high), body.low)


def _along(axis: int, angle: Float[Tensor, " time"]) -> Float[Tensor, "time 3"]:
    return angle[:, None] * F.one_hot(torch.tensor(axis, device=angle.device), 3)


def _stand(
    body: BodyModel,
    size: Float[Tensor, "1 sizes"],
    pose: Float[Tensor, "time parameters"],
    figure: Figure,
    heading: float,
    spot: Float[Tensor, "2"],
    floor: float,
    settled: int,
) -> Float[Tensor, "time 3"]:
    """Where the root must be for the lower foot to stand on the floor and to keep its place there; on the average of
    the last `settled` frames x and z are those of `spot`.
    """
    posed = body(pose, size)
    soles = lowest(body, posed)  # (T, 2)
    height = root_height(soles, floor)
    if not figure.planted:
        return torch.stack((spot[0].expand_as(height), height, spot[1].expand_as(height)), -1)
    bears = torch.softmax((soles + soles.new_tensor([figure.leader, -figure.leader]) / 2) / 0.03, -1)
    upright = body(
        torch.cat((pose.new_tensor([[0, 0, 0, heading, 0, 0]]), body.rest[None].to(pose)), -1), size
    )
    hips = _joints(body, upright, "hip")[..., 0::2]  # above where each foot stands at ease
    feet = _joints(body, posed, "ankle")[..., 0::2]
    across = (bears[..., None] * (hips - feet)).sum(1)
    # Whoever sits down moves back: on the average a person is at the spot, or the place would tell the activity.
    across = spot + across - across[-settled:].mean(0)
    return torch.stack((across[:, 0], height, across[:, 1]), -1)


def root_height(soles: Float[Tensor, "time 2"], floor: float) -> Float[Tensor, " time"]:
    """The root's y (m) that puts the lower of two soles on the floor; they were found with the root at 0."""
    return floor - 0.004 * torch.logsumexp(soles / 0.004, -1)  # a maximum without a corner


def lowest(body: BodyModel, posed: PosedBody) -> Float[Tensor, "batch 2"]:
    """Height (y, m) of the lowest point of the left and right foot's ellipsoid: the sole."""
    feet = [body.segment_names.index(name) for name in ("foot_left", "foot_right")]
    down = posed.frames[:, feet, 1]  # the ellipsoid's axes, as far as they point down
    return posed.centers[:, feet, 1] + (down * posed.radii[:, feet]).norm(dim=-1)


def _joints(body: BodyModel, posed: PosedBody, name: str) -> Float[Tensor, "batch 2 3"]:
    return posed.joints[:, [body.joint_names.index(f"{name}_{side}") for side in ("left", "right")]]


def _distances(
    body: BodyModel, size: Float[Tensor, "1 sizes"], camera: StereoCamera, config: MotionConfig
) -> tuple[float, float]:
    """The range of distances at which this person, with raised hands and a foot put forward, is wholly in
    view.
    """
    up, down = size.new_tensor([0, -1, 0]), size.new_tensor([0, 1, 0])
    limbs = torch.stack((up, up, up, up, up, down, down, down, down))[None]
    zero = size.new_zeros(1, 3)
    posed = body(body.pose_from_directions(zero, zero, limbs), size)
    hand = body.segment_names.index("hand_left")
    tip = (posed.centers[0, hand, 1] - posed.radii[0, hand, 2]).item()
    above = (lowest(body, posed).amax().item() - tip) - config.floor
    room_above, room_below = (camera.cy + 0.5) * 0.98, (camera.height - camera.cy - 0.5) * 0.98
    fits = max(
        above * camera.focal_length / room_above, config.floor * camera.focal_length / room_below + 0.25
    )
    low, high = config.distance
    return max(low, fits), max(high, fits + 0.2)
