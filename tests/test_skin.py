"""The model of skin: its colour plane beside kornia's HSV, its learning beside the closed forms."""

import colorsys
import math

import kornia.color
import pytest
import scipy.stats
import torch
from torch.testing import assert_close

from torchpose.vision.skin import (
    GREY_SPREAD,
    SkinConfig,
    SkinModel,
    chroma,
    fade_skin,
    learn_skin,
    skin_prior,
    skin_probability,
    stack_skin,
)


def noise(*shape, seed=0):
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def patch(colour, size=24, grain=0.02, seed=0):
    """A square of one colour (3,) with grain, 1 x 3 x size x size."""
    colour = torch.as_tensor(colour, dtype=torch.float64)[None, :, None, None]
    return (colour + grain * (2 * noise(1, 3, size, size, seed=seed) - 1)).clamp(0, 1)


def everywhere(image):
    return torch.ones(len(image), *image.shape[2:], dtype=torch.bool)


def some_model(batch=1):
    prior = skin_prior(torch.zeros(1, dtype=torch.float64), batch=batch)
    images = torch.cat([patch((0.7, 0.5 - 0.05 * k, 0.4), seed=k) for k in range(batch)])
    return learn_skin(prior, images, everywhere(images))


def test_the_plane_has_the_hue_as_its_angle_and_the_saturation_as_its_length():
    image = 0.05 + 0.95 * noise(1, 3, 40, 50)
    hue, saturation, _ = kornia.color.rgb_to_hsv(image)[0]
    x, y = chroma(image)[0]
    turned = (torch.atan2(y, x) - hue + math.pi).remainder(2 * math.pi) - math.pi
    assert turned[saturation > 1e-3].abs().max() < math.radians(1.2)
    ratio = torch.hypot(x, y) / saturation
    assert 0.86 < ratio.min() < ratio.max() < 1 + 1e-9


def test_corners_of_the_plane():
    """Red, yellow, green, blue, white, black; brightness changes nothing."""
    colours = torch.tensor([[1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [0, 0, 0]]).double()
    half = math.sqrt(0.75)
    expected = torch.tensor([[1, 0], [0.5, half], [-0.5, half], [-0.5, -half], [0, 0], [0, 0]]).double()
    for brightness in (1.0, 0.3):
        assert_close(chroma((brightness * colours).T[None, :, None])[0, :, 0].T, expected)


def test_probability_is_bayes_rule_with_scipys_densities():
    model, image = some_model(), noise(1, 3, 12, 15, seed=3)
    at = chroma(image)[0].flatten(1).T.numpy()
    skin = scipy.stats.multivariate_normal(model.mean[0].numpy(), model.covariance[0].numpy()).pdf(at)
    grey = scipy.stats.multivariate_normal([0, 0], GREY_SPREAD**2).pdf(at)
    other = 0.5 * grey + 0.5 / math.pi
    expected = torch.from_numpy(skin / (skin + other)).reshape(12, 15)
    assert_close(skin_probability(image, model)[0], expected)
    assert (skin_probability(0.05 * image, model) == 0).all()  # too dark to have a colour


def test_learning_is_the_normal_inverse_wishart_posterior():
    """Murphy 2012, eq. 4.209 to 4.214, with as many degrees of freedom as pixels and weighted observations."""
    config = SkinConfig()
    prior, image = skin_prior(torch.zeros(1, dtype=torch.float64)), noise(1, 3, 6, 7, seed=5)
    face = noise(1, 6, 7, seed=6) > 0.4
    weight = skin_probability(image, prior)[face] * config.face_pixels / int(face.sum())
    x = chroma(image)[0].permute(1, 2, 0)[face[0]]
    number = weight.sum()
    mean = (weight[:, None] * x).sum(0) / number
    scatter = (weight[:, None, None] * (x - mean)[:, :, None] * (x - mean)[:, None]).sum(0)
    before, strength = prior.mean[0], config.prior_pixels
    apart = strength * number / (strength + number) * torch.outer(mean - before, mean - before)
    posterior = strength * prior.covariance[0] + scatter + apart
    learned = learn_skin(prior, image, face)
    assert_close(learned.weight[0], strength + number)
    assert_close(learned.mean[0], (strength * before + number * mean) / (strength + number))
    assert_close(learned.covariance[0], posterior / (strength + number))


def test_prior_is_as_configured():
    config = SkinConfig(hue=0.3, saturation=0.5, spread=0.1, prior_pixels=7.0)
    prior = skin_prior(torch.zeros(1, dtype=torch.float64), config, 2)
    assert_close(prior.weight, torch.full((2,), 7.0).double())
    expected = torch.tensor([0.5 * math.cos(0.3), 0.5 * math.sin(0.3)]).double()
    assert_close(prior.mean, expected.expand(2, 2))
    assert_close(prior.covariance, (0.01 * torch.eye(2)).double().expand(2, 2, 2))


def test_what_was_learned_fades_by_the_same_share_each_frame_and_the_prior_stays():
    prior, model = skin_prior(torch.zeros(1, dtype=torch.float64)), some_model()
    faded = model
    for frame in range(1, 200):
        faded = fade_skin(faded)
        share = 0.95**frame
        assert_close(faded.weight, prior.weight + share * (model.weight - prior.weight))
    assert_close(faded.mean, prior.mean, atol=1e-4, rtol=0)
    assert_close(faded.covariance, prior.covariance, atol=1e-4, rtol=0)
    assert_close(fade_skin(prior).square, prior.square)


def test_nothing_is_learned_without_a_face():
    model = some_model()
    learned = learn_skin(model, noise(1, 3, 5, 6), torch.zeros(1, 5, 6, dtype=torch.bool))
    for name in ("weight", "total", "square"):
        assert_close(getattr(learned, name), getattr(model, name), rtol=0, atol=0)


def watch(image, frames=40):
    """The model after a face of this colour was seen for some frames."""
    model = skin_prior(image)
    for _ in range(frames):
        model = learn_skin(fade_skin(model), image, everywhere(image))
    return model


LIGHT_SKIN, DARK_SKIN = (0.85, 0.65, 0.55), (0.30, 0.18, 0.12)
LIGHTS = {"white": (1.0, 1.0, 1.0), "warm": (1.1, 0.95, 0.75), "bluish": (0.88, 0.97, 1.1)}


@pytest.mark.parametrize("skin", [LIGHT_SKIN, DARK_SKIN], ids=["light skin", "dark skin"])
@pytest.mark.parametrize("light", list(LIGHTS))
def test_a_person_and_a_light_are_learned(skin, light):
    """Then the person's hands are told from wood, denim and white cloth better than before."""
    lit = torch.tensor(LIGHTS[light])
    face, hand = (patch(torch.tensor(skin) * lit, seed=seed, grain=0.03 * max(skin)) for seed in (1, 2))
    others = [
        patch(torch.tensor(c) * lit, seed=3) for c in ((0.25, 0.35, 0.6), (0.8, 0.8, 0.78), (0.2, 0.6, 0.3))
    ]
    prior, learned = skin_prior(face), watch(face)
    before, after = (skin_probability(hand, model).mean() for model in (prior, learned))
    assert after > before
    assert (skin_probability(hand, learned) > 0.5).double().mean() > 0.9
    for other in others:
        assert (skin_probability(other, learned) > 0.5).double().mean() < 0.1
    assert learned.covariance.det() < 0.1 * prior.covariance.det()


def test_a_change_of_light_is_followed():
    white, warm = (
        patch(torch.tensor(LIGHT_SKIN) * torch.tensor(LIGHTS[k]), seed=4) for k in ("white", "warm")
    )
    model = watch(white)
    for _ in range(60):
        model = learn_skin(fade_skin(model), warm, everywhere(warm))
    assert_close(model.mean[0], chroma(warm)[0].mean((1, 2)), atol=0.03, rtol=0)


def test_eyes_and_beard_hardly_change_the_model():
    skin = patch(LIGHT_SKIN, seed=1)
    beard = skin.clone()
    beard[:, :, 14:] = patch((0.12, 0.12, 0.13), grain=0.01, seed=2)[:, :, 14:]
    assert_close(watch(beard).mean, watch(skin).mean, atol=0.03, rtol=0)


def test_probability_has_the_gradient_of_finite_differences():
    model, image = some_model(), (0.2 + 0.6 * noise(1, 3, 2, 3, seed=9)).requires_grad_()
    assert torch.autograd.gradcheck(lambda i: skin_probability(i, model), image)
    total = model.total.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda t: skin_probability(image.detach(), SkinModel(model.weight, t, model.square)), total
    )


def test_batch_equals_one_by_one():
    models, images = some_model(3), noise(3, 3, 8, 9, seed=2)
    face = noise(3, 8, 9, seed=4) > 0.5
    together, probability = learn_skin(fade_skin(models), images, face), skin_probability(images, models)
    alone = []
    for k in range(3):
        one = models.item(k)
        assert_close(skin_probability(images[k : k + 1], one), probability[k : k + 1])
        alone.append(learn_skin(fade_skin(one), images[k : k + 1], face[k : k + 1]))
    stacked = stack_skin(alone)
    for name in ("weight", "total", "square"):
        assert_close(getattr(stacked, name), getattr(together, name))
    assert_close(  # one model for all images
        skin_probability(images, models.item(1))[2], skin_probability(images[2:], models.item(1))[0]
    )


def test_hue_of_the_prior_is_that_of_colorsys():
    """A colour of the prior's own hue and saturation is skin; the opposite hue is not."""
    for turn, skin in ((0.0, True), (0.5, False)):
        colour = colorsys.hsv_to_rgb(0.4 / (2 * math.pi) + turn, 0.4, 0.7)
        probability = skin_probability(
            patch(colour, grain=0.0), skin_prior(torch.zeros(1, dtype=torch.float64))
        )
        assert bool((probability > 0.5).all()) is skin


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: SkinConfig(spread=0.0), "spread"),
        (lambda: SkinConfig(prior_pixels=-1.0), "prior_pixels"),
        (lambda: SkinConfig(face_pixels=0.0), "face_pixels"),
        (lambda: SkinConfig(memory=1.5), "memory"),
        (lambda: SkinConfig(saturation=-0.1), "saturation"),
        (lambda: SkinConfig(least_value=2.0), "least_value"),
        (lambda: skin_probability(noise(3, 3, 4, 4), some_model(2)), "one for each of 3, got 2"),
    ],
)
def test_bad_input_is_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()
