"""The activity recogniser (T. 4.4): a feature, a codebook and an HMM per activity, from clips to activities.

Scores are log-likelihoods divided by the number of observed frames, nats per frame, so that long and short
sequences compare.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path

import torch
from jaxtyping import Float, Int
from omegaconf import OmegaConf
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from torchpose.activity.baum_welch import MISSING, BaumWelch, HMMConfig, Status
from torchpose.activity.codebook import Codebook, CodebookConfig
from torchpose.activity.dataset import Clip
from torchpose.activity.features import FeatureConfig, build_feature
from torchpose.activity.hmm import DiscreteHMM
from torchpose.atomic import replacing
from torchpose.settings import compose_config

NO_ACTIVITY = -1
_SETTINGS, _WEIGHTS = "recognizer.yaml", "recognizer.safetensors"


class Answer(IntEnum):
    """What came of one sequence."""

    RECOGNIZED = 0
    REJECTED = 1  # none of these: no better than the background model
    UNOBSERVED = 2  # every frame was lost
    IMPOSSIBLE = 3  # probability zero under every model: train with emission_prior above 1


@dataclass(frozen=True)
class RecognizerConfig:
    """All of the recogniser."""

    feature: FeatureConfig = field(default_factory=FeatureConfig)
    codebook: CodebookConfig = field(default_factory=CodebookConfig)
    hmm: HMMConfig = field(default_factory=HMMConfig)
    # Reject a sequence whose best model beats the background by less, nats per frame; null never rejects.
    rejection_threshold: float | None = None
    seed: int = 0  # of the starts of ICA, codebook and models


@dataclass(frozen=True)
class Recognition:
    """What the sequences are (4.16). NaN: nothing was observed; for the odds, or no model is possible."""

    log_likelihood: Float[Tensor, "sequences activities"]  # nats per observed frame
    activity: Int[Tensor, " sequences"]  # the most likely; -1: no answer
    # The best score over the next best, nats per frame; infinite where there is no other activity.
    log_odds: Float[Tensor, " sequences"]
    # The best over a background model, the shares of the symbols in all training frames; low: none of these.
    log_odds_background: Float[Tensor, " sequences"]
    answer: Int[Tensor, " sequences"]  # `Answer`


@dataclass(frozen=True)
class Evaluation:
    """How often the recogniser is right; a sequence without an answer counts as wrong."""

    activities: tuple[str, ...]
    confusion: Int[Tensor, "activities activities"]  # row: the truth, column: the answer
    unanswered: Int[Tensor, " activities"]

    @property
    def accuracy(self) -> float:
        """Share of the sequences named rightly, 0 to 1."""
        return float(self.confusion.diagonal().sum() / (self.confusion.sum() + self.unanswered.sum()))

    @property
    def accuracy_by_class(self) -> dict[str, float]:
        """The same for each activity; NaN for one that was not tested."""
        right = self.confusion.diagonal() / (self.confusion.sum(1) + self.unanswered)
        return dict(zip(self.activities, right.tolist(), strict=True))

    def __add__(self, other: "Evaluation") -> "Evaluation":
        """The folds of a protocol together."""
        if other.activities != self.activities:
            raise ValueError(
                "only evaluations of the same activities add up, "
                f"got {', '.join(self.activities)} and {', '.join(other.activities)}"
            )
        return Evaluation(
            self.activities, self.confusion + other.confusion, self.unanswered + other.unanswered
        )


class Recognizer(nn.Module):
    """Clips in, activities out; the clips' tensors and the module are on one device.

    >>> recognizer = Recognizer(RecognizerConfig()).fit(training_clips)
    >>> recognizer(clips).activity
    """

    log_background: Float[Tensor, " symbols"]

    def __init__(self, config: RecognizerConfig = RecognizerConfig(), activities: Sequence[str] = ()) -> None:
        """`activities` may be left to `fit`, which then takes those of its clips in alphabetical order."""
        super().__init__()
        self.config = config
        self.activities = tuple(activities)
        self.fitted: BaumWelch | None = None  # the course of the last fit
        self.feature = build_feature(config.feature)
        self.codebook = Codebook(config.codebook)
        self.hmm = DiscreteHMM(max(len(self.activities), 1), config.codebook.size, config.hmm)
        self.register_buffer("log_background", torch.zeros_like(self.hmm.log_emission[0, 0]))

    @torch.no_grad()
    def fit(self, clips: Sequence[Clip]) -> "Recognizer":
        """Learn features, symbols and models; the same seed and clips give the same recogniser.

        Raises:
            ValueError: no clips, an activity without any observed frame, or too few frames for the codebook.
        """
        if not clips:
            raise ValueError("a recogniser needs clips to learn from, got none")
        activities = self.activities or tuple(sorted({clip.activity for clip in clips}))
        labels = _labels(clips, activities)
        untaught = [name for number, name in enumerate(activities) if number not in labels.tolist()]
        if untaught:
            raise ValueError(f"every activity needs a training clip, got none for {', '.join(untaught)}")

        generator = torch.Generator().manual_seed(self.config.seed)
        self.feature.fit(clips, generator)
        features = [self.feature(clip) for clip in clips]
        self.codebook.fit(torch.cat(features), generator)
        symbols, lengths = self._symbols(features)
        device = symbols.device
        self.hmm = DiscreteHMM(len(activities), self.config.codebook.size, self.config.hmm).to(device)
        training = self.hmm.fit(symbols, lengths, labels.to(device), generator)
        status = training.status.tolist()
        empty = [name for name, end in zip(activities, status, strict=True) if end == Status.NO_DATA]
        if empty:
            raise ValueError(
                f"every activity needs frames in which the person was seen, got none for {', '.join(empty)}"
            )
        self.activities, self.fitted = activities, training
        counts = symbols[symbols != MISSING].bincount(minlength=self.config.codebook.size)
        counts = counts + (self.config.hmm.emission_prior - 1)
        self.log_background = (counts / counts.sum()).log().to(self.hmm.log_emission)
        return self

    @torch.no_grad()
    def forward(self, clips: Sequence[Clip]) -> Recognition:
        """Score the clips under every activity and decide for the most likely (4.16)."""
        if not self.activities:
            raise ValueError("the recogniser has not learned any activity; call fit or load first")
        if not clips:
            raise ValueError("give at least one clip to recognise, got none")
        symbols, lengths = self._symbols([self.feature(clip) for clip in clips])
        seen = symbols != MISSING
        frames = seen.sum(1)
        per_frame = torch.where(frames > 0, frames, torch.nan).to(self.log_background)
        scores = self.hmm.log_likelihood(symbols, lengths) / per_frame[:, None]
        background = torch.where(seen, self.log_background[symbols.clamp(min=0)], 0.0).sum(1) / per_frame

        best, activity = scores.max(1)
        others = scores.scatter(1, activity[:, None], -torch.inf)
        over_background = best - background
        answer = torch.full_like(activity, int(Answer.RECOGNIZED))
        if self.config.rejection_threshold is not None:
            answer[over_background < self.config.rejection_threshold] = int(Answer.REJECTED)
        answer[torch.isneginf(best)] = int(Answer.IMPOSSIBLE)
        answer[frames == 0] = int(Answer.UNOBSERVED)
        return Recognition(
            log_likelihood=scores,
            activity=torch.where(answer == int(Answer.RECOGNIZED), activity, NO_ACTIVITY),
            log_odds=best - others.amax(1),
            log_odds_background=over_background,
            answer=answer,
        )

    def evaluate(self, clips: Sequence[Clip]) -> Evaluation:
        """Compare the answers with the clips' own activities.

        Raises:
            ValueError: a clip of an activity that was never learned.
        """
        recognition = self(clips)
        truth, found = _labels(clips, self.activities), recognition.activity.cpu()
        size, answered = len(self.activities), found != NO_ACTIVITY
        cells = (truth * size + found)[answered].bincount(minlength=size * size)
        return Evaluation(self.activities, cells.view(size, size), truth[~answered].bincount(minlength=size))

    def save(self, folder: Path | str) -> None:
        """Write `recognizer.yaml` (settings) and `recognizer.safetensors`, each whole or not at all."""
        folder = Path(folder)
        settings = OmegaConf.to_yaml(OmegaConf.structured(self.config))
        metadata = {"activities": json.dumps(self.activities), "settings_sha256": _digest(settings)}
        weights = {name: value.cpu().contiguous() for name, value in self.state_dict().items()}
        with replacing(folder / _WEIGHTS) as partial:
            save_file(weights, partial, metadata)
        with replacing(folder / _SETTINGS) as partial:
            partial.write_text(settings, encoding="utf-8")

    @classmethod
    def load(cls, folder: Path | str) -> "Recognizer":
        """Rebuild a saved recogniser from its folder alone.

        Raises:
            FileNotFoundError: a file is missing.
            ValueError: the files are damaged, or not of one save.
        """
        folder = Path(folder)
        for name in (_SETTINGS, _WEIGHTS):
            if not (folder / name).is_file():
                raise FileNotFoundError(
                    f"no recogniser in {folder}: {name} is missing; train one with train.py"
                )
        try:
            with safe_open(folder / _WEIGHTS, "pt") as file:
                metadata = file.metadata() or {}
                weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        except SafetensorError as error:
            raise ValueError(f"{folder / _WEIGHTS} cannot be read: {error}; train it again") from error
        settings = (folder / _SETTINGS).read_text(encoding="utf-8", errors="replace")
        if metadata.get("settings_sha256") != _digest(settings):
            raise ValueError(
                f"{_SETTINGS} and {_WEIGHTS} in {folder} must be of one training; train it again"
            )
        config = compose_config(RecognizerConfig, folder, Path(_SETTINGS).stem)
        recognizer = cls(config, json.loads(metadata["activities"]))
        # What is learned has no shape before it is learned.
        for name, value in weights.items():
            owner, _, buffer = name.rpartition(".")
            setattr(recognizer.get_submodule(owner), buffer, value)
        return recognizer

    def _symbols(
        self, features: list[Tensor]
    ) -> tuple[Int[Tensor, "sequences time"], Int[Tensor, " sequences"]]:
        """Symbols of all sequences, padded, and their lengths."""
        lengths = [len(rows) for rows in features]
        symbols = self.codebook(torch.cat(features)).split(lengths)
        padded = nn.utils.rnn.pad_sequence(list(symbols), batch_first=True, padding_value=MISSING)
        return padded, torch.tensor(lengths, device=padded.device)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", errors="replace")).hexdigest()


def _labels(clips: Sequence[Clip], activities: tuple[str, ...]) -> Int[Tensor, " sequences"]:
    unknown = sorted({clip.activity for clip in clips} - set(activities))
    if unknown:
        raise ValueError(
            f"clips must be of the activities {', '.join(activities)}; got {', '.join(unknown)} too"
        )
    number = {name: position for position, name in enumerate(activities)}
    return torch.tensor([number[clip.activity] for clip in clips])
