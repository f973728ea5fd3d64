"""A chain of frames' poses, each tied to the next: fitted at once, with what each is known by.

The matrix of the Gauss-Newton problem is block tridiagonal; its inverse's diagonal blocks are the poses' covariances,
which is the Rauch-Tung-Striebel smoother for these equations (T. App. B). Metres and radians.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.least_squares import NormalEquations

LONGEST = 0.5  # m and rad, of a step in one unknown
FLOOR = 1e-6  # precision of every unknown of every frame, so that none is without any


@dataclass(frozen=True)
class Chain:
    """What ties the frames' poses: independent steps from frame to frame, and what came before the first."""

    pull: Float[Tensor, "frames_1 parameters"]  # precision of the step from each frame to the next
    before: Float[Tensor, " parameters"]  # mean of the first frame's pose as the frames before it have it
    link: Float[Tensor, "parameters parameters"]  # precision of that; 0 says nothing

    def loss(self, pose: Float[Tensor, "frames parameters"]) -> Float[Tensor, ""]:
        """Minus the log-density of the poses, up to a constant."""
        gap = pose[0] - self.before
        return 0.5 * (self.pull * pose.diff(dim=0) ** 2).sum() + 0.5 * gap @ self.link @ gap

    def gradient(self, pose: Float[Tensor, "frames parameters"]) -> Float[Tensor, "frames parameters"]:
        """Derivative of `loss`."""
        force = torch.nn.functional.pad(self.pull * pose.diff(dim=0), (0, 0, 1, 1))
        gradient = force[:-1] - force[1:]
        gradient[0] += self.link @ (pose[0] - self.before)
        return gradient

    def blocks(self) -> Float[Tensor, "frames parameters parameters"]:
        """Diagonal blocks of the second derivative; those beside them are -diag(`pull`)."""
        pull = torch.nn.functional.pad(self.pull, (0, 0, 1, 1))
        blocks = torch.diag_embed(pull[:-1] + pull[1:])
        blocks[0] += self.link
        return blocks


def fit_chain(
    equations: NormalEquations, start: Float[Tensor, "frames parameters"], chain: Chain, steps: int
) -> tuple[
    Float[Tensor, "frames parameters"],
    Float[Tensor, "frames parameters parameters"],
    Float[Tensor, "frames parameters parameters"],
]:
    """Poses after some Levenberg-Marquardt steps in all frames at once, their covariances given all frames, and their
    precisions given the frames up to each.

    Args:
        equations: loss, gradient and normal matrix of each frame alone; a frame where they are not finite at the start
            says nothing.
    """
    sound: Bool[Tensor, " frames"] | None = None

    def evaluate(pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        nonlocal sound
        loss, gradient, normal = equations(pose)
        if sound is None:
            sound = loss.isfinite() & gradient.isfinite().all(1) & normal.isfinite().all((1, 2))
        gradient = torch.where(sound[:, None], gradient, 0.0) + chain.gradient(pose)
        normal = torch.where(sound[:, None, None], normal, 0.0) + chain.blocks()
        return torch.where(sound, loss, 0.0).sum() + chain.loss(pose), gradient, normal

    pose, damping = start, 1e-3
    loss, gradient, blocks = evaluate(pose)
    for _ in range(steps):
        damped = blocks + torch.diag_embed(damping * blocks.diagonal(dim1=1, dim2=2) + FLOOR)
        trial = pose + solve_chain(damped, -chain.pull, -gradient)[0].clamp(-LONGEST, LONGEST)
        new_loss, new_gradient, new_blocks = evaluate(trial)
        if bool(new_loss < loss):
            pose, loss, gradient, blocks = trial, new_loss, new_gradient, new_blocks
            damping /= 10
        else:
            damping *= 30
    floor = torch.full_like(pose, FLOOR)
    _, covariance, filtered = solve_chain(blocks + floor.diag_embed(), -chain.pull, torch.zeros_like(pose))
    # What is left of a frame's block holds the tie to the next frame, of which the frames so far know nothing.
    return pose, covariance, filtered - torch.nn.functional.pad(chain.pull, (0, 0, 0, 1)).diag_embed()


def solve_chain(
    blocks: Float[Tensor, "frames p p"],
    beside: Float[Tensor, "frames_1 p"],
    right: Float[Tensor, "frames p *columns"],
) -> tuple[Float[Tensor, "frames p *columns"], Float[Tensor, "frames p p"], Float[Tensor, "frames p p"]]:
    """Solution of a symmetric block tridiagonal system for one right side or for several as columns, the diagonal
    blocks of the matrix's inverse, and those that elimination leaves (a frame's precision given those before it).

    The blocks beside the diagonal are diagonal themselves, `beside`. Elimination forward and substitution back, as the
    smoother of Rauch, Tung and Striebel.
    """
    T, columns = len(blocks), right.reshape(*right.shape[:2], -1)
    left, inverse, value = [blocks[0]], [torch.linalg.inv(blocks[0])], [columns[0]]
    for t in range(1, T):
        b = beside[t - 1]
        left.append(blocks[t] - b[:, None] * inverse[-1] * b)
        inverse.append(torch.linalg.inv(left[-1]))
        value.append(columns[t] - b[:, None] * (inverse[t - 1] @ value[-1]))
    x, covariance = [inverse[-1] @ value[-1]], [inverse[-1]]
    for t in range(T - 2, -1, -1):
        b = beside[t]
        x.append(inverse[t] @ (value[t] - b[:, None] * x[-1]))
        gain = inverse[t] * b
        covariance.append(inverse[t] + gain @ covariance[-1] @ gain.T)
    return torch.stack(x[::-1]).view_as(right), torch.stack(covariance[::-1]), torch.stack(left)
