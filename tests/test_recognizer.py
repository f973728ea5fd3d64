"""The recogniser as a whole: it tells activities apart, says when it cannot, comes back from its folder."""

import warnings
from dataclasses import replace

import pytest
import torch
from safetensors.torch import save_file
from torch.testing import assert_close

from torchpose.activity.baum_welch import HMMConfig, Status, Topology
from torchpose.activity.codebook import CodebookConfig, CodebookStart
from torchpose.activity.dataset import Clip, Split, read_skeletons, split_clips
from torchpose.activity.features import FeatureConfig, FeatureKind, Stream
from torchpose.activity.recognizer import NO_ACTIVITY, Answer, Evaluation, Recognizer, RecognizerConfig
from torchpose.activity.score_layer import LayerConfig
from torchpose.activity.subspace import Crop, SilhouetteConfig
from torchpose.cli import load_config
from torchpose.settings import compose_config

ACTIVITIES = ("both", "left", "right")
SMALL = RecognizerConfig(codebook=CodebookConfig(size=12), hmm=HMMConfig(iterations=20))


def waving(activity, frames, generator, subject="1"):
    """One or both of two joint parameters rise and fall once; the other 18 are noise about zero."""
    time = torch.linspace(0, 1, frames)
    rise = (torch.pi * time).sin() * (1 + 0.1 * torch.randn((), generator=generator))
    pose = 0.05 * torch.randn(frames, 24, generator=generator)
    pose[:, 6] += rise * (activity in ("left", "both"))
    pose[:, 9] += rise * (activity in ("right", "both"))
    pose[:, :4] += 5 * torch.randn(4, generator=generator)  # place and heading say nothing
    return Clip(activity, subject, "1", pose=pose)


def performances(count=8, seed=0):
    generator = torch.Generator().manual_seed(seed)
    lengths = torch.randint(20, 40, (count,), generator=generator).tolist()
    return [waving(name, frames, generator) for name in ACTIVITIES for frames in lengths]


@pytest.fixture(scope="module")
def trained():
    return Recognizer(SMALL).fit(performances())


def test_activities_are_told_apart(trained):
    test = performances(seed=1)
    found = trained(test)
    assert trained.activities == ACTIVITIES
    assert [ACTIVITIES[i] for i in found.activity] == [clip.activity for clip in test]
    assert (found.answer == Answer.RECOGNIZED).all()
    assert (found.log_odds > 0).all()
    assert set(trained.fitted[0].status.tolist()) <= {Status.CONVERGED, Status.MAX_ITERATIONS}


def test_scores_are_likelihoods_per_observed_frame(trained):
    clip = performances(1)[0]
    pose = clip.pose.clone()
    pose[3:6] = torch.nan
    found = trained([replace(clip, pose=pose)])
    member = trained.members[0]
    (rows,) = trained.feature(replace(clip, pose=pose))
    symbols = member.codebooks[0](rows)[None]
    total = member.hmm.log_likelihood(symbols[..., None], torch.tensor([len(clip)]))
    assert (symbols == -1).sum() == 3
    assert_close(found.log_likelihood, total / (len(clip) - 3))
    assert torch.equal(found.score, found.log_likelihood)
    best = found.log_likelihood[0].sort(descending=True).values
    assert_close(found.log_odds[0], best[0] - best[1])
    background = member.log_background[0, symbols[symbols >= 0]].mean()
    assert_close(found.log_odds_background[0], best[0] - background)


def test_a_batch_is_recognised_as_one_by_one(trained):
    clips = performances(2, seed=2)
    together = trained(clips)
    for s, clip in enumerate(clips):
        alone = trained([clip])
        assert_close(alone.log_likelihood[0], together.log_likelihood[s])
        assert alone.activity[0] == together.activity[s]


def test_training_repeats_and_the_seed_matters(trained):
    again, other = (Recognizer(replace(SMALL, seed=seed)).fit(performances()) for seed in (0, 1))
    for name, value in trained.state_dict().items():
        assert torch.equal(again.state_dict()[name], value)
    first, second = (one.members[0].codebooks[0].centers for one in (other, trained))
    assert not torch.equal(first, second)


def test_a_lost_sequence_has_no_answer(trained):
    clip = performances(1)[0]
    lost = replace(clip, pose=torch.full_like(clip.pose, torch.nan))
    found = trained([clip, lost])
    assert found.answer.tolist() == [Answer.RECOGNIZED, Answer.UNOBSERVED]
    assert found.activity[1] == NO_ACTIVITY
    assert found.log_likelihood[1].isnan().all()
    assert found.log_odds[1].isnan()


def test_none_of_these_is_rejected():
    train, test = performances(), performances(seed=1)
    recognizer = Recognizer(replace(SMALL, rejection_threshold=0.2)).fit(train)
    # A stranger's frames are like those of the training, but in no order that an activity has.
    shuffled = [replace(clip, pose=clip.pose[torch.randperm(len(clip))]) for clip in test]
    known, unknown = recognizer(test), recognizer(shuffled)
    assert (known.answer == Answer.RECOGNIZED).float().mean() > 0.9
    assert (unknown.answer == Answer.REJECTED).float().mean() > 0.8
    assert known.log_odds_background.min() > unknown.log_odds_background.median()
    assert (unknown.activity[unknown.answer == Answer.REJECTED] == NO_ACTIVITY).all()
    rate = recognizer.evaluate(shuffled)
    assert rate.unanswered.sum() == (unknown.answer == Answer.REJECTED).sum()
    assert rate.accuracy < 0.2


def test_an_impossible_sequence_is_no_silent_answer():
    hard = replace(SMALL, hmm=HMMConfig(emission_prior=1.0, transition_prior=1.0))
    recognizer = Recognizer(hard).fit(performances(2))
    clip = performances(1)[0]
    backwards = clip.pose.clone()
    backwards[:, 6], backwards[:, 9] = 1 - clip.pose[:, 6], 1 - clip.pose[:, 9]
    with pytest.warns(RuntimeWarning, match="minus infinity"):
        found = recognizer([replace(clip, pose=backwards)])
    assert torch.isneginf(found.log_likelihood).all()
    assert found.answer.tolist() == [Answer.IMPOSSIBLE]
    assert found.activity.tolist() == [NO_ACTIVITY]


def test_one_sequence_an_activity_and_sequences_shorter_than_the_states():
    generator = torch.Generator().manual_seed(0)
    clips = [waving(name, 30, generator) for name in ACTIVITIES]
    recognizer = Recognizer(SMALL).fit([*clips, waving("left", 2, generator)])
    found = recognizer([*clips, replace(clips[0], pose=clips[0].pose[:1])])
    assert found.activity[:3].tolist() == [0, 1, 2]
    assert found.log_likelihood.isfinite().all()
    assert found.answer[3] == Answer.RECOGNIZED


def test_members_average_their_scores():
    train, test = performances(), performances(2, seed=1)
    both = Recognizer(replace(SMALL, members=2)).fit(train)
    first, second = both.members
    rows = [both.feature(clip) for clip in test]
    frames = torch.tensor([len(clip) for clip in test])[:, None]
    alone = []
    for member in (first, second):
        symbols = member.encode(rows, None)
        alone.append(member.hmm.log_likelihood(symbols.values, symbols.lengths) / frames)
    assert not torch.equal(*alone)
    assert_close(both(test).log_likelihood, (alone[0] + alone[1]) / 2)


def test_a_second_stream_tells_what_the_first_cannot():
    """Up and down are the same poses in another order, which one state cannot tell apart but their changes can."""
    generator = torch.Generator().manual_seed(0)

    def moving(name, frames):
        pose = 0.02 * torch.randn(frames, 24, generator=generator)
        ramp = torch.linspace(-1, 1, frames)
        pose[:, 6] += ramp if name == "up" else -ramp
        return Clip(name, "1", "1", pose=pose)

    lengths = torch.randint(20, 40, (20,), generator=generator).tolist()
    train, test = (
        [moving(n, f) for n in ("up", "down") for f in half] for half in (lengths[:10], lengths[10:])
    )
    hmm = HMMConfig(states=1, iterations=5)
    still = Recognizer(RecognizerConfig(codebook=CodebookConfig(size=8), hmm=hmm)).fit(train)
    feature = FeatureConfig(streams=(Stream.feature, Stream.velocity))
    moves = Recognizer(RecognizerConfig(feature, CodebookConfig(size=8), hmm)).fit(train)
    assert still.evaluate(test).accuracy < 0.8
    assert moves.evaluate(test).accuracy == 1


def test_certain_frames_count_more():
    """Half the frames of a test show the other activity, but their deviations say that they are not to be trusted."""
    config = replace(SMALL, certainty=True)
    train, test = performances(), performances(seed=1)
    found, plain = (Recognizer(one).fit(train) for one in (config, SMALL))
    assert torch.equal(found(test).log_likelihood, plain(test).log_likelihood)  # nothing is known of errors
    other = {"left": "right", "right": "left", "both": "left"}
    generator = torch.Generator().manual_seed(2)
    spoilt = []
    for clip in test:
        wrong = waving(other[clip.activity], len(clip), generator).pose
        bad = torch.rand(len(clip), generator=generator) < 0.6
        spread = torch.where(bad, 3.0, 0.02)[:, None].expand(-1, 24)
        spoilt.append(replace(clip, pose=torch.where(bad[:, None], wrong, clip.pose), pose_sd=spread))
    assert plain.evaluate(spoilt).accuracy < 0.7
    assert found.evaluate(spoilt).accuracy > 0.9


def test_mirror_images_teach_the_other_hand():
    names = ("shoulder_left", "shoulder_right", "hip_left", "hip_right", "elbow_left", "elbow_right")
    at = torch.tensor([[0.2, 1.4], [-0.2, 1.4], [0.1, 0.9], [-0.1, 0.9], [0.25, 1.1], [-0.25, 1.1]])
    generator = torch.Generator().manual_seed(0)

    def person(activity, elbow, subject="1"):
        joints = torch.cat([at, torch.zeros(6, 1)], 1).repeat(20, 1, 1)
        turn = torch.linspace(0, 3, 20) * (activity == "raise")
        side = at[elbow - 4, 0].sign()
        joints[:, elbow] = joints[:, elbow - 4] + 0.3 * torch.stack(
            [side * turn.sin(), -turn.cos(), 0 * turn], 1
        )
        return Clip(
            activity,
            subject,
            "1",
            joints=joints + 0.01 * torch.randn(20, 6, 3, generator=generator),
            joint_names=names,
        )

    right = [person(activity, 5, str(s)) for activity in ("raise", "rest") for s in range(4)]
    left = [person("raise", 4)]
    config = replace(SMALL, feature=FeatureConfig(FeatureKind.skeleton))
    plain, both = (Recognizer(replace(config, mirror=mirror)).fit(right) for mirror in (False, True))
    assert both.evaluate(left).accuracy == 1
    odds = [one(left).score[0, 0] - one(left).score[0, 1] for one in (plain, both)]
    assert odds[1] > odds[0]
    with pytest.raises(ValueError, match=r"mirror needs joint positions .* set mirror=false"):
        Recognizer(replace(SMALL, mirror=True)).fit(performances(1))


def test_the_layer_keeps_what_is_right_and_gives_probabilities():
    generator = torch.Generator().manual_seed(0)
    train = [waving(name, 25, generator, str(s)) for name in ACTIVITIES for s in range(6)]
    recognizer = Recognizer(replace(SMALL, layer=LayerConfig(enabled=True))).fit(train)
    test = performances(seed=1)
    found = recognizer(test)
    assert recognizer.evaluate(test).accuracy == 1
    assert_close(found.score.exp().sum(1), torch.ones(len(test)).double())
    lost = replace(test[0], pose=torch.full_like(test[0].pose, torch.nan))
    assert recognizer([lost]).answer.tolist() == [Answer.UNOBSERVED]
    alone = [waving(name, 25, generator, "1") for name in ACTIVITIES for _ in range(3)]  # a single subject
    assert Recognizer(recognizer.config).fit(alone).evaluate(test).accuracy > 0.9
    with pytest.raises(ValueError, match="the layer needs activities that several subjects did, got none"):
        Recognizer(recognizer.config).fit([waving(name, 25, generator, name) for name in ACTIVITIES])


def test_a_single_activity_is_the_answer():
    found = Recognizer(SMALL).fit(performances()[:8])(performances()[:1])
    assert found.activity.tolist() == [0]
    assert torch.isposinf(found.log_odds).all()


def test_accuracy_counts_by_hand():
    counts = torch.tensor([[3, 1, 0], [0, 2, 0], [0, 0, 0]])
    evaluation = Evaluation(ACTIVITIES, counts, torch.tensor([1, 2, 0]))
    assert evaluation.accuracy == pytest.approx(5 / 9)
    by_class = evaluation.accuracy_by_class
    assert by_class["both"] == pytest.approx(3 / 5)
    assert by_class["left"] == pytest.approx(2 / 4)
    assert by_class["right"] != by_class["right"]  # never tested: NaN
    both = evaluation + evaluation
    assert both.accuracy == pytest.approx(5 / 9)
    assert both.confusion.sum() == 12
    with pytest.raises(ValueError, match="only evaluations of the same activities add up"):
        evaluation + replace(evaluation, activities=("a", "b", "c"))


def test_the_confusion_has_the_truth_in_its_rows(trained):
    clip = performances(1)[0]
    assert clip.activity == "both"
    wrong = trained.evaluate([replace(clip, activity="right"), clip])
    assert wrong.confusion.tolist() == [[1, 0, 0], [0, 0, 0], [1, 0, 0]]
    assert wrong.accuracy == 0.5


@pytest.mark.parametrize("kind", [FeatureKind.angles, FeatureKind.pca, FeatureKind.ica])
def test_a_saved_recogniser_comes_back_from_its_folder_alone(tmp_path, kind):
    clips = [
        replace(
            clip,
            silhouettes=(torch.arange(20)[:, None] < 10 + 9 * clip.pose[:, 6, None, None]).expand(-1, -1, 9),
        )
        for clip in performances(2)
    ]
    feature = FeatureConfig(
        kind, (Stream.feature, Stream.velocity), num_components=5, silhouette=SilhouetteConfig(8, 6)
    )
    config = RecognizerConfig(
        feature,
        CodebookConfig(size=9),
        HMMConfig(states=3),
        LayerConfig(enabled=kind is not FeatureKind.pca),
        members=2,
        certainty=True,
        rejection_threshold=-1.0,
        seed=7,
    )
    recognizer = Recognizer(config).fit(clips)
    recognizer.save(tmp_path / "model")
    back = Recognizer.load(tmp_path / "model")
    assert back.config == config
    assert back.activities == recognizer.activities
    before, after = recognizer(clips), back(clips)
    for name in vars(before):
        assert torch.equal(getattr(before, name), getattr(after, name))
    assert sorted(path.name for path in (tmp_path / "model").iterdir()) == [
        "recognizer.safetensors",
        "recognizer.yaml",
    ]
    back.save(tmp_path / "model")  # over an older one
    assert torch.equal(Recognizer.load(tmp_path / "model")(clips).log_likelihood, before.log_likelihood)


def test_damaged_folders_are_named(trained, tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"no recogniser in .*: recognizer\.yaml is missing; train one"
    ):
        Recognizer.load(tmp_path)
    trained.save(tmp_path)
    settings, weights = tmp_path / "recognizer.yaml", tmp_path / "recognizer.safetensors"
    text, binary = settings.read_text(), weights.read_bytes()

    weights.write_bytes(binary[: len(binary) // 2])
    with pytest.raises(ValueError, match=r"recognizer\.safetensors cannot be read: .*train it again"):
        Recognizer.load(tmp_path)
    weights.write_bytes(binary)
    for broken in ("", "feature: [", text.replace("states: 4", "states: 5")):
        settings.write_text(broken)
        with pytest.raises(ValueError, match=r"recognizer\.yaml and .* must be of one training"):
            Recognizer.load(tmp_path)
    settings.write_text(text)
    save_file({"members.0.log_background": torch.zeros(1)}, weights)  # somebody else's, without our metadata
    with pytest.raises(ValueError, match=r"recognizer\.yaml and .* must be of one training"):
        Recognizer.load(tmp_path)
    weights.write_bytes(binary)
    assert Recognizer.load(tmp_path).activities == trained.activities


def test_the_configuration_is_read_from_yaml_and_key_value(tmp_path):
    (tmp_path / "train.yaml").write_text(
        "codebook:\n  start: lbg\nfeature:\n  silhouette:\n    crop: image\n"
    )
    config = compose_config(
        RecognizerConfig,
        tmp_path,
        "train",
        ["feature.kind=pca", "hmm.states=6", "hmm.topology=ergodic", "rejection_threshold=0.1"],
    )
    assert config == RecognizerConfig(
        feature=FeatureConfig(FeatureKind.pca, silhouette=SilhouetteConfig(crop=Crop.image)),
        codebook=CodebookConfig(start=CodebookStart.lbg),
        hmm=HMMConfig(states=6, topology=Topology.ergodic),
        rejection_threshold=0.1,
    )


def test_bad_input_is_named(trained):
    clips = performances(2)
    with pytest.raises(ValueError, match="needs clips to learn from, got none"):
        Recognizer().fit([])
    with pytest.raises(ValueError, match="every activity needs a training clip, got none for jumping"):
        Recognizer(SMALL, activities=(*ACTIVITIES, "jumping")).fit(clips)
    with pytest.raises(ValueError, match="must be of the activities left; got both, right too"):
        Recognizer(SMALL, activities=("left",)).fit(clips)
    gone = [
        replace(clip, activity="jumping", pose=torch.full_like(clip.pose, torch.nan)) for clip in clips[:1]
    ]
    with pytest.raises(ValueError, match="frames in which the person was seen, got none for jumping"):
        Recognizer(SMALL).fit([*clips, *gone])
    with pytest.raises(ValueError, match=r"codebook of 500 symbols needs .* lower codebook.size"):
        Recognizer(replace(SMALL, codebook=CodebookConfig(size=500))).fit(clips)
    with pytest.raises(
        ValueError, match=r"needs 'silhouettes' in every clip, but clip 'both' .* has only pose"
    ):
        Recognizer(replace(SMALL, feature=FeatureConfig(FeatureKind.pca))).fit(clips)
    with pytest.raises(ValueError, match="members must be at least 1, got 0"):
        RecognizerConfig(members=0)
    with pytest.raises(ValueError, match="penalty of the layer must be positive, got 0"):
        LayerConfig(penalty=0.0)
    with pytest.raises(ValueError, match="the layer needs 2 folds and 1 iteration at least, got 1 and 100"):
        LayerConfig(folds=1)
    with pytest.raises(ValueError, match="has not learned any activity; call fit or load first"):
        Recognizer(SMALL)(clips)
    with pytest.raises(ValueError, match="at least one clip to recognise"):
        trained([])
    with pytest.raises(ValueError, match="must be of the activities both, left, right; got jumping too"):
        trained.evaluate([replace(clips[0], activity="jumping")])


@pytest.mark.slow
def test_utkinect_is_recognised(shared_data):
    """Odd subjects train, one member of configs/experiment/skeleton.yaml: 96 % (95 by three)."""
    clips = read_skeletons(shared_data / "utkinect.npz")
    config = replace(load_config("train", ["experiment=skeleton"]).recognizer, members=1)
    config = replace(config, feature=replace(config.feature, kind=FeatureKind.skeleton))
    (fold,) = split_clips(clips, Split.cross_subject)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recognizer = Recognizer(config).fit([clips[i] for i in fold.train])
        result = recognizer.evaluate([clips[i] for i in fold.test])
    assert result.confusion.sum() + result.unanswered.sum() == 99
    assert result.accuracy > 0.9
