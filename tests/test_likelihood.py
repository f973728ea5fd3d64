"""Face and torso terms by hand, and a user's own likelihood in the registration."""

import math
from dataclasses import replace

import pytest
import torch
from synthetic_cloud import RELAXED, see, standing
from torch import nn
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.registration.likelihood import (
    AppearanceConfig,
    Evidence,
    FaceLikelihood,
    PartLikelihood,
    TorsoLikelihood,
    appearance_potential,
)
from torchpose.registration.vem import Registrar
from torchpose.vision.faces import Faces
from torchpose.vision.points import PointCloud

NAMES = ("torso", "hand", "head")
HEIGHT, WIDTH = 60, 80
FACE = (38.0, 8.0, 42.0, 12.0)  # px: its centre is (40, 10)
CENTRE = (40.0, 30.0)  # of the silhouette


def scene(pixels, found=True, padding=1):
    """A frame with points at `pixels` (u, v), a face at (40, 10) and a silhouette about (40, 30)."""
    num = len(pixels) + padding
    uv = torch.zeros(1, num, 2)
    uv[0, : len(pixels)] = torch.tensor(pixels, dtype=torch.float32)
    mask = torch.arange(num)[None] < len(pixels)
    empty = torch.full((1, num, 2), -1)
    cloud = PointCloud(torch.zeros(1, num, 3), uv, empty, mask, torch.full((1, num, 12), num))
    silhouette = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    silhouette[0, 5:56, 35:46] = True  # rows 5 to 55, columns 35 to 45
    face_mask = torch.zeros_like(silhouette)
    face_mask[0, 8:13, 38:43] = found
    box = torch.tensor([FACE]) if found else torch.full((1, 4), torch.nan)
    faces = Faces(box, torch.tensor([found]), face_mask, torch.full((1, 3), torch.nan))
    return Evidence(torch.zeros(1, 3, HEIGHT, WIDTH), silhouette, cloud, faces)


def test_points_on_the_face_are_the_heads_by_e_to_the_c():
    evidence = scene([(40, 10), (38.4, 12.4), (43, 10), (40, 40), (10, 40)])
    potential = FaceLikelihood(NAMES, AppearanceConfig(face=1.7))(evidence)
    expected = torch.zeros(1, 6, 3)
    expected[0, :2, 2] = 1.7
    assert_close(potential, expected)


def test_u_is_the_column_and_v_the_row():
    evidence = scene([(40, 10), (10, 40)])
    assert FaceLikelihood(NAMES)(evidence)[0, :, 2].tolist() == [1.0, 0.0, 0.0]


def test_the_torsos_term_is_kappa_e_to_the_minus_d():
    """The ellipse is centred at (40, 20), 0.9 of the 20 px to the centre half high and 0.6 of that half wide."""
    a, b = 0.6 * 18, 18.0
    pixels = [(40, 20), (40, 38), (40 + a, 20), (46, 26), (40, 20 + 1.4 * b), (40, 20 + 1.42 * b), (70, 20)]
    got = TorsoLikelihood(NAMES)(scene(pixels))
    distances = [
        ((u - 40) / a) ** 2 + ((v - 20) / b) ** 2 - 1 for u, v in pixels
    ]  # algebraic, 0 on the ellipse
    phi = [math.e * math.exp(-d) if d <= 1 else 1.0 for d in distances]  # (3.10), (3.11)
    assert [round(x, 3) for x in phi[:3]] == [7.389, 2.718, 2.718]  # e^2 at the centre, e on the ellipse
    assert phi[4] > 1 == phi[5] == phi[6]
    assert_close(got[0, :7, 0], torch.tensor(phi).log(), rtol=0, atol=1e-5)
    assert (got[..., 1:] == 0).all()
    assert (got[0, 7] == 0).all()  # padding


def test_the_torsos_ellipse_leans_with_the_person():
    """The same person lying on the side: u and v of everything exchanged."""
    pixels = [(40, 20), (46, 26), (40, 35), (48, 20)]
    upright = scene(pixels)
    box = upright.faces.box[:, [1, 0, 3, 2]]
    lying = Evidence(
        upright.images.mT,
        upright.silhouette.mT,
        replace(upright.cloud, pixels=upright.cloud.pixels.flip(-1)),
        replace(upright.faces, box=box, mask=upright.faces.mask.mT),
    )
    for term in (TorsoLikelihood(NAMES), FaceLikelihood(NAMES)):
        assert_close(term(lying), term(upright))


def test_without_a_face_nothing_is_said():
    evidence = scene([(40, 10), (40, 20)], found=False)
    for term in (TorsoLikelihood(NAMES), FaceLikelihood(NAMES)):
        assert (term(evidence) == 0).all()


def test_an_empty_silhouette_gives_no_nan():
    evidence = scene([(40, 10), (40, 20)])
    empty = replace(evidence, silhouette=torch.zeros_like(evidence.silhouette))
    assert TorsoLikelihood(NAMES)(empty).isfinite().all()


def test_terms_add_and_zero_switches_them_off():
    evidence = scene([(40, 10), (40, 20)])
    terms = [FaceLikelihood(NAMES), TorsoLikelihood(NAMES)]
    assert_close(appearance_potential(terms, evidence, 3), terms[0](evidence) + terms[1](evidence))
    off = AppearanceConfig(face=0.0, torso=0.0)
    silent = [FaceLikelihood(NAMES, off), TorsoLikelihood(NAMES, off)]
    assert (appearance_potential(silent, evidence, 3) == 0).all()
    assert (appearance_potential([], evidence, 3) == 0).all()


@pytest.mark.parametrize("setting", ["torso_aspect", "torso_length"])
def test_bad_settings_are_told(setting):
    with pytest.raises(ValueError, match=f"{setting} must be positive, got 0"):
        AppearanceConfig(**{setting: 0.0})


class HeightLikelihood(PartLikelihood):
    """A user's own term, learned: the parts' log-odds are linear in the image row."""

    def __init__(self, segment_names):
        super().__init__(segment_names)
        self.slope = nn.Parameter(torch.zeros(len(segment_names)))

    def forward(self, evidence):
        return (evidence.cloud.pixels[..., 1:] / 100 - 1.2) * self.slope


@pytest.fixture(scope="module")
def frame():
    body = BodyModel()
    pose = standing(body, RELAXED)
    view = see(body, pose, num=150)
    evidence = Evidence(torch.zeros(1, 3, 240, 320), view.silhouette, view.cloud, view.no_face())
    return body, pose, view, evidence


def test_a_users_likelihood_shifts_the_labels(frame):
    body, pose, view, evidence = frame
    registrar, posed = Registrar(body), body(pose)
    foot = registrar.correspond(posed, view.observation())
    mine = HeightLikelihood(body.segment_names)
    observation = view.observation()
    before = registrar.label(posed, foot, observation, 0.05).belief
    mine.slope.data[body.segment_names.index("foot_left")] = 20.0
    potential = appearance_potential([mine], evidence, body.num_parts)
    after = registrar.label(posed, foot, replace(observation, potential=potential), 0.05).belief
    left = body.segment_names.index("foot_left")
    assert after[0, left].sum() > before[0, left].sum() + 5


def test_a_users_likelihood_learns_through_the_labels(frame):
    """Gradients reach its parameters, and follow them down to the labels that are wanted."""
    body, pose, view, evidence = frame
    registrar, posed = Registrar(body), body(pose)
    foot = registrar.correspond(posed, view.observation())
    mine = HeightLikelihood(body.segment_names)
    optimizer = torch.optim.Adam(mine.parameters(), 0.2)
    seen = view.cloud.mask[0]
    wanted = view.part[0, seen]
    losses = []
    for _ in range(15):
        potential = appearance_potential([mine], evidence, body.num_parts)
        # Labels at a sigma so soft that the distances alone say little.
        labelling = registrar.label(posed, foot, replace(view.observation(), potential=potential), 0.5)
        loss = -labelling.belief[0, wanted, seen.nonzero()[:, 0]].clamp_min(1e-9).log().mean()
        optimizer.zero_grad()
        loss.backward()
        assert mine.slope.grad.isfinite().all()
        assert mine.slope.grad.abs().max() > 0
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.9 * losses[0]
