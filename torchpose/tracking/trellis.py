"""Which of several hypotheses holds in each frame: the best sequence (Viterbi) and the weight of each (sum-product).

A trellis has frames, chains that are independent of each other (limbs), and hypotheses of each chain in each frame.
Costs are minus log-probabilities, nats; an infinite one is no hypothesis.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def step_cost(
    place: Float[Tensor, "frames chains hypotheses unknowns"], pull: Float[Tensor, "frames_1 chains unknowns"]
) -> Float[Tensor, "frames_1 chains hypotheses hypotheses"]:
    """Cost of going from each hypothesis of a frame to each of the next, for Gaussian steps of precision `pull`."""
    gap = place[:-1, :, :, None] - place[1:, :, None]
    return 0.5 * (pull[:, :, None, None] * gap**2).sum(-1)


def best_sequence(
    cost: Float[Tensor, "frames chains hypotheses"],
    step: Float[Tensor, "frames_1 chains hypotheses hypotheses"],
) -> Int[Tensor, "frames chains"]:
    """The hypothesis of each frame in the sequence of least cost, for each chain."""
    total, came = cost[0], []
    for t in range(1, len(cost)):
        best, index = (total[:, :, None] + step[t - 1]).min(1)
        came.append(index)
        total = best + cost[t]
    chosen = [total.argmin(1)]
    for index in came[::-1]:
        chosen.append(index.gather(1, chosen[-1][:, None])[:, 0])
    return torch.stack(chosen[::-1])


def weights(
    cost: Float[Tensor, "frames chains hypotheses"],
    step: Float[Tensor, "frames_1 chains hypotheses hypotheses"],
) -> Float[Tensor, "frames chains hypotheses"]:
    """Probability of each hypothesis given all frames: forward and backward over the trellis."""
    forward, backward = [-cost[0]], [torch.zeros_like(cost[0])]
    for t in range(1, len(cost)):
        forward.append((forward[-1][:, :, None] - step[t - 1]).logsumexp(1) - cost[t])
    for t in range(len(cost) - 2, -1, -1):
        backward.append((backward[-1] - cost[t + 1])[:, None].sub(step[t]).logsumexp(2))
    return (torch.stack(forward) + torch.stack(backward[::-1])).softmax(2)


def spread(
    place: Float[Tensor, "frames chains hypotheses unknowns"],
    weight: Float[Tensor, "frames chains hypotheses"],
    about: Float[Tensor, "frames chains unknowns"],
) -> Float[Tensor, "frames chains unknowns unknowns"]:
    """What hypotheses add to the covariance of an answer `about`: their weighted second moment around it."""
    gap = torch.where(weight[..., None] > 0, place - about[:, :, None], 0.0)
    return (weight[..., None] * gap).mT @ gap
