"""The activity recogniser (T. 4.4): features, codebooks and an HMM per activity, from clips to activities.

Several streams are independent given the state. Several members, each with codebooks of its own, average their scores.
Scores are log-likelihoods divided by the number of observed frames, nats per frame, so that long and short
sequences compare. Letters: S sequences, T time, R streams, A activities, V symbols.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from omegaconf import OmegaConf
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from torchpose.activity.baum_welch import MISSING, BaumWelch, HMMConfig, Status
from torchpose.activity.codebook import Codebook, CodebookConfig
from torchpose.activity.dataset import Clip
from torchpose.activity.features import FeatureConfig, FeatureStreams
from torchpose.activity.hmm import DiscreteHMM
from torchpose.activity.score_layer import LayerConfig, ScoreLayer
from torchpose.activity.skeleton import mirror_joints
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
    layer: LayerConfig = field(default_factory=LayerConfig)
    members: int = 1  # recognisers from different starts, whose scores are averaged
    # Skeletons train with their mirror images, too: an activity is the same with the other hand. It must be.
    mirror: bool = False
    certainty: bool = False  # symbols count by how certain their features are, as the clips' deviations say
    # Reject a sequence whose best model beats the background by less, nats per frame; null never rejects.
    rejection_threshold: float | None = None
    seed: int = 0  # of the starts of ICA, codebook and models

    def __post_init__(self) -> None:
        if self.members < 1:
            raise ValueError(f"members must be at least 1, got {self.members}; 3 to 5 make sense")


@dataclass(frozen=True)
class Recognition:
    """What the sequences are (4.16). NaN: nothing was observed; for the odds, or no model is possible."""

    log_likelihood: Float[Tensor, "sequences activities"]  # nats per observed frame
    # What decides: these, or the layer's log-probabilities where there is one, nats.
    score: Float[Tensor, "sequences activities"]
    activity: Int[Tensor, " sequences"]  # of the best score; -1: no answer
    # The best score over the next best; infinite where there is no other activity.
    log_odds: Float[Tensor, " sequences"]
    # The best likelihood over a background model, the shares of the symbols in all training frames; low: none of these.
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


@dataclass(frozen=True)
class Symbols:
    """The sequences as the HMMs see them; behind each one's length all is `MISSING`."""

    values: Int[Tensor, "sequences time streams"]
    weights: Float[Tensor, "sequences time streams"] | None
    lengths: Int[Tensor, " sequences"]

    @property
    def seen(self) -> Bool[Tensor, "sequences time"]:
        """Frames with a symbol in some stream."""
        return (self.values != MISSING).any(2)

    def of(self, sequences: Tensor) -> "Symbols":
        """Some of them."""
        weights = None if self.weights is None else self.weights[sequences]
        return Symbols(self.values[sequences], weights, self.lengths[sequences])


Rows = tuple[Tensor, ...]  # one clip's streams
Deviations = tuple[Tensor | None, ...]


class Member(nn.Module):
    """A codebook for each stream, a bank of HMMs on their symbols, and a background model of the symbols alone."""

    log_background: Float[Tensor, "streams symbols"]

    def __init__(self, config: RecognizerConfig, activities: int) -> None:
        super().__init__()
        streams, size = len(config.feature.streams), config.codebook.size
        self.config = config
        self.codebooks = nn.ModuleList(Codebook(config.codebook) for _ in range(streams))
        self.hmm = DiscreteHMM(activities, size, config.hmm, streams=(streams,))
        self.register_buffer("log_background", torch.zeros_like(self.hmm.log_emission[0, :, 0]))

    def fit_codebooks(self, rows: Sequence[Rows], generator: torch.Generator) -> None:
        """Learn the symbols of each stream from all frames of all clips."""
        for stream, codebook in enumerate(self._codebooks):
            codebook.fit(torch.cat([clip[stream] for clip in rows]), generator)

    def encode(self, rows: Sequence[Rows], deviations: Sequence[Deviations] | None) -> Symbols:
        """The clips' symbols, padded, and, where their deviations are known, how certain these are."""
        lengths = [len(clip[0]) for clip in rows]
        symbols = self._padded(
            [codebook(torch.cat([clip[r] for clip in rows])) for r, codebook in enumerate(self._codebooks)],
            lengths,
            MISSING,
        )
        weights = None
        if deviations is not None:
            certain = []
            for r, codebook in enumerate(self._codebooks):
                parts = [
                    torch.ones(n) if (sd := clip[r]) is None else codebook.certainty(sd).cpu()
                    for clip, n in zip(deviations, lengths, strict=True)
                ]
                certain.append(torch.cat(parts).to(self.hmm.log_emission))
            weights = self._padded(certain, lengths, 0)
        return Symbols(symbols, weights, torch.tensor(lengths, device=symbols.device))

    def fit_models(
        self, symbols: Symbols, labels: Int[Tensor, " sequences"], generator: torch.Generator
    ) -> BaumWelch:
        """Train the HMM of each activity, and the background model on all."""
        training = self.hmm.fit(symbols.values, symbols.lengths, labels, generator, symbols.weights)
        counts = [
            stream[stream != MISSING].bincount(minlength=self.hmm.num_symbols)
            for stream in symbols.values.unbind(2)
        ]
        smoothed = torch.stack(counts) + (self.config.hmm.emission_prior - 1)
        self.log_background = (smoothed / smoothed.sum(1, keepdim=True)).log().to(self.hmm.log_emission)
        return training

    def background(self, symbols: Symbols) -> Float[Tensor, " sequences"]:
        """Log-likelihood of each sequence if its symbols came in no order."""
        stream = torch.arange(symbols.values.shape[2], device=symbols.values.device)
        scores = self.log_background[stream, symbols.values.clamp(min=0)]
        if symbols.weights is not None:
            scores = scores * symbols.weights
        return torch.where(symbols.values != MISSING, scores, 0.0).flatten(1).sum(1)

    @property
    def _codebooks(self) -> list[Codebook]:
        return [codebook for codebook in self.codebooks if isinstance(codebook, Codebook)]

    @staticmethod
    def _padded(streams: list[Tensor], lengths: list[int], padding: int) -> Tensor:
        parts = torch.stack(streams, dim=1).split(lengths)
        return nn.utils.rnn.pad_sequence(list(parts), batch_first=True, padding_value=padding)


class Recognizer(nn.Module):
    """Clips in, activities out; the clips' tensors and the module are on one device.

    >>> recognizer = Recognizer(RecognizerConfig()).fit(training_clips)
    >>> recognizer(clips).activity
    """

    def __init__(self, config: RecognizerConfig = RecognizerConfig(), activities: Sequence[str] = ()) -> None:
        """`activities` may be left to `fit`, which then takes those of its clips in alphabetical order."""
        super().__init__()
        self.config = config
        self.activities = tuple(activities)
        self.fitted: tuple[BaumWelch, ...] = ()  # the course of the last fit, of each member
        self.feature = FeatureStreams(config.feature)
        self._build(max(len(self.activities), 1))

    def _build(self, activities: int) -> None:
        self.members = nn.ModuleList(Member(self.config, activities) for _ in range(self.config.members))
        self.layer = ScoreLayer(activities, self.config.layer) if self.config.layer.enabled else None

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
            raise ValueError(
                f"every activity needs a training clip, got none for {', '.join(untaught)}; add some"
            )

        own = len(clips)
        subjects = [clip.subject for clip in clips]
        if self.config.mirror:
            clips = [*clips, *map(_mirrored, clips)]
            labels = labels.repeat(2)
        generator = torch.Generator().manual_seed(self.config.seed)
        self.feature.fit(clips, generator)
        rows, deviations = self._observe(clips)
        device = rows[0][0].device
        labels = labels.to(device)
        self._build(len(activities))
        self.to(device)
        courses, encoded = [], []
        for member in self._members:
            member.fit_codebooks(rows, generator)
            symbols = member.encode(rows, deviations)
            training = member.fit_models(symbols, labels, generator)
            status = training.status.tolist()
            empty = [name for name, end in zip(activities, status, strict=True) if end == Status.NO_DATA]
            if empty:
                raise ValueError(
                    f"every activity needs frames in which the person was seen, got none for {', '.join(empty)}; "
                    "look at their recordings"
                )
            courses.append(training)
            encoded.append(symbols)
        self.activities, self.fitted = activities, tuple(courses)
        if self.layer is not None:
            self._fit_layer(self.layer, encoded, labels, subjects, own)
        return self

    def _fit_layer(
        self, layer: ScoreLayer, encoded: list[Symbols], labels: Tensor, subjects: list[str], own: int
    ) -> None:
        """Learn the layer from the scores of models that have not seen the subject; the codebooks have, but no label.

        What is held out are the `own` clips; their mirror images are held out with them, and only train.
        """
        people = sorted(set(subjects))
        # Of a single subject the sequences are held out instead.
        group = [people.index(name) for name in subjects] if len(people) > 1 else list(range(own))
        fold = torch.tensor(group, device=labels.device) % self.config.layer.folds
        of_all = fold.repeat(len(labels) // own)
        scores, known = [], []
        for number in fold.unique().tolist():
            train, test = (of_all != number).nonzero()[:, 0], (fold == number).nonzero()[:, 0]
            of_members = []
            for member, symbols in zip(self._members, encoded, strict=True):
                generator = torch.Generator().manual_seed(self.config.seed)
                bank = DiscreteHMM(
                    len(self.activities),
                    member.hmm.num_symbols,
                    self.config.hmm,
                    streams=symbols.values.shape[2:],
                ).to(labels.device)
                seen, asked = symbols.of(train), symbols.of(test)
                bank.fit(seen.values, seen.lengths, labels[train], generator, seen.weights)
                of_members.append(_per_frame(bank, asked))
            found = torch.stack(of_members).mean(0)
            # An activity that nobody else did has no model here.
            taught = torch.isin(labels[:own][test], labels[train]) & ~found.isnan().any(1)
            scores.append(found[taught])
            known.append(labels[:own][test][taught])
        held_out, truth = torch.cat(scores), torch.cat(known)
        if len(truth) == 0:
            raise ValueError(
                "the layer needs activities that several subjects did, got none; give more sequences or set "
                "layer.enabled=false"
            )
        layer.fit(held_out, truth)

    def _observe(self, clips: Sequence[Clip]) -> tuple[list[Rows], list[Deviations] | None]:
        deviations = [self.feature.deviation(clip) for clip in clips] if self.config.certainty else None
        return [self.feature(clip) for clip in clips], deviations

    @property
    def _members(self) -> list[Member]:
        return [member for member in self.members if isinstance(member, Member)]

    @torch.no_grad()
    def forward(self, clips: Sequence[Clip]) -> Recognition:
        """Score the clips under every activity and decide for the most likely (4.16)."""
        if not self.activities:
            raise ValueError("the recogniser has not learned any activity; call fit or load first")
        if not clips:
            raise ValueError("give at least one clip to recognise, got none")
        rows, deviations = self._observe(clips)
        likelihoods, backgrounds = [], []
        for member in self._members:
            symbols = member.encode(rows, deviations)
            likelihoods.append(_per_frame(member.hmm, symbols))
            backgrounds.append(member.background(symbols) / _frames(symbols))
        likelihood, background = torch.stack(likelihoods).mean(0), torch.stack(backgrounds).mean(0)
        scores = likelihood if self.layer is None else self.layer(likelihood)

        best, activity = scores.max(1)
        others = scores.scatter(1, activity[:, None], -torch.inf)
        over_background = likelihood.amax(1) - background
        answer = torch.full_like(activity, int(Answer.RECOGNIZED))
        if self.config.rejection_threshold is not None:
            answer[over_background < self.config.rejection_threshold] = int(Answer.REJECTED)
        answer[torch.isneginf(likelihood).all(1)] = int(Answer.IMPOSSIBLE)
        answer[likelihood.isnan().any(1)] = int(Answer.UNOBSERVED)
        return Recognition(
            log_likelihood=likelihood,
            score=scores,
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


def _frames(symbols: Symbols) -> Float[Tensor, " sequences"]:
    """Observed frames; NaN for none."""
    frames = symbols.seen.sum(1)
    return torch.where(frames > 0, frames, torch.nan)


def _per_frame(bank: DiscreteHMM, symbols: Symbols) -> Float[Tensor, "sequences activities"]:
    return bank.log_likelihood(symbols.values, symbols.lengths, symbols.weights) / _frames(symbols)[:, None]


def _mirrored(clip: Clip) -> Clip:
    if clip.joints is None:
        raise ValueError(f"mirror needs joint positions in every clip, got none in {clip}; set mirror=false")
    return replace(clip, joints=mirror_joints(clip.joints, clip.joint_names))


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
