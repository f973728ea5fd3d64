"""A discriminative layer on the models' scores: which scores go with which activity, learned from held-out sequences.

Letters: S sequences, A activities.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

_FLOOR = -20.0  # of standardised scores; a minus infinity would spoil every sum


@dataclass(frozen=True)
class LayerConfig:
    """Whether the most likely model decides, or a layer that weighs all models' scores."""

    enabled: bool = (
        False  # learn the layer; it needs sequences by several subjects, or several of each activity
    )
    penalty: float = 10.0  # on squared weights and biases: the greater, the closer to the most likely model
    folds: int = 5  # held out in turn, by subject, to score what the models did not learn from
    iterations: int = 100  # at most, of L-BFGS

    def __post_init__(self) -> None:
        if self.penalty <= 0:
            raise ValueError(f"penalty of the layer must be positive, got {self.penalty}; 10 is the default")
        if self.folds < 2 or self.iterations < 1:
            raise ValueError(
                f"the layer needs 2 folds and 1 iteration at least, got {self.folds} and {self.iterations}"
            )


class ScoreLayer(nn.Module):
    """Multinomial logistic regression on scores: softmax of b s + s W + c, the penalty on W and c alone.

    So without evidence against it the activity of the best score wins, and the layer gives its probability. Scores are
    taken less their mean over the activities, in units of how far they typically lie behind the best.
    """

    scale: Float[Tensor, ""]
    weight: Float[Tensor, "activities activities"]  # b I + W
    bias: Float[Tensor, " activities"]

    def __init__(self, activities: int, config: LayerConfig = LayerConfig()) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("scale", torch.ones((), dtype=torch.float64))
        self.register_buffer("weight", torch.eye(activities, dtype=torch.float64))
        self.register_buffer("bias", torch.zeros(activities, dtype=torch.float64))

    @torch.enable_grad()
    def fit(
        self, scores: Float[Tensor, "sequences activities"], labels: Int[Tensor, " sequences"]
    ) -> "ScoreLayer":
        """Learn from scores of sequences that the models have not seen. Convex; starts at the best score."""
        behind = scores - scores.amax(1, keepdim=True)
        spread = behind[behind.isfinite()].square().mean().sqrt()
        self.scale = torch.where(spread > 0, spread, 1.0)
        x = self._standardise(scores)
        size = scores.shape[1]
        trust = x.new_ones(()).requires_grad_()
        weight, bias = x.new_zeros(size, size).requires_grad_(), x.new_zeros(size).requires_grad_()
        optimizer = torch.optim.LBFGS(
            [trust, weight, bias], max_iter=self.config.iterations, line_search_fn="strong_wolfe"
        )
        share = self.config.penalty / 2 / len(labels)

        def loss() -> Tensor:
            optimizer.zero_grad()
            penalty = share * (weight.square().sum() + bias.square().sum() + 1e-3 * trust.square())
            value = F.cross_entropy(trust * x + x @ weight + bias, labels) + penalty
            value.backward()
            return value

        optimizer.step(loss)
        self.weight = (trust * torch.eye(size, dtype=x.dtype, device=x.device) + weight).detach()
        self.bias = bias.detach()
        return self

    def forward(self, scores: Float[Tensor, "sequences activities"]) -> Float[Tensor, "sequences activities"]:
        """Log-probability of each activity, nats; NaN where the scores are."""
        return (self._standardise(scores) @ self.weight + self.bias).log_softmax(1)

    def _standardise(self, scores: Tensor) -> Tensor:
        behind = ((scores - scores.amax(1, keepdim=True)) / self.scale).clamp(min=_FLOOR)
        return behind - behind.mean(1, keepdim=True)
