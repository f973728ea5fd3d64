"""What a depth camera's eyes make of bad input: holes, equal frames, who is always there, who is in the background.

A floor, a wall and a person's outline by rays; no part of it is shared with the code under test.
"""

import warnings
from dataclasses import dataclass

import pytest
import torch
from torch.testing import assert_close

from torchpose.eyes import Eyes, EyesConfig, Stopwatch
from torchpose.recording import Backgrounds, Frame
from torchpose.vision.camera import StereoCamera

CAMERA = StereoCamera(160, 120, 150.0, 79.5, 39.5, None, 10.0)
V, U = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
NOISE = 0.004  # m per m^2
WALL, PERSON = 4.5, 3.0  # m


def outline(x: float, arm: float = 0.0) -> torch.Tensor:
    """The pixels of somebody 1.6 m tall at `x` (m), an arm `arm` m out to the right."""
    aside, down = (
        (U - CAMERA.cx) / CAMERA.focal_length * PERSON - x,
        (V - CAMERA.cy) / CAMERA.focal_length * PERSON,
    )
    body = (aside.abs() < 0.22) & (down > -0.3) & (down < 1.0)
    head = (aside.abs() < 0.1) & (down > -0.6) & (down <= -0.3)
    stretched = (aside > 0) & (aside < 0.22 + arm) & (down > -0.25) & (down < -0.1)
    return body | head | stretched


def scene() -> torch.Tensor:
    """Depth of the empty room: a wall, and a floor 1.05 m below the camera."""
    floor = 1.05 / ((V - CAMERA.cy) / CAMERA.focal_length).clamp_min(1e-3)
    return floor.clamp_max(WALL)


def frame(x: float | None, generator: torch.Generator, holes: float = 0.0, arm: float = 0.0) -> torch.Tensor:
    depth = scene() if x is None else torch.where(outline(x, arm), PERSON, scene())
    depth = depth + NOISE * depth.square() * torch.randn(depth.shape, generator=generator)
    return torch.where(torch.rand(depth.shape, generator=generator) < holes, torch.nan, depth)


@dataclass
class Film:
    """A recording in memory."""

    depth: list[torch.Tensor]
    empty: torch.Tensor | None = None
    camera: StereoCamera = CAMERA

    def __len__(self) -> int:
        return len(self.depth)

    def __getitem__(self, position: int, /) -> Frame:
        return Frame(position, position / CAMERA.frame_rate, depth=self.depth[position])

    def background(self) -> Backgrounds:
        return Backgrounds(depth=self.empty)


def look(film: Film, positions: list[int]) -> tuple[Eyes, list[torch.Tensor]]:
    eyes = Eyes(CAMERA, EyesConfig())
    eyes.learn_background(film.background(), film, torch.device("cpu"))
    return eyes, [eyes(film[k], torch.device("cpu")).silhouette[0] for k in positions]


def overlap(one: torch.Tensor, other: torch.Tensor) -> float:
    return float((one & other).sum() / (one | other).sum())


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(1)


def walk(generator, holes=0.0):
    places = [None] * 6 + [0.2 * k - 1.0 for k in range(11)] + [0.6] * 8
    return Film([frame(x, generator, holes) for x in places]), places


@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_who_walks_in_and_stands_is_seen_and_the_empty_room_is_nobody(generator, holes):
    film, places = walk(generator, holes)
    for k, mask in enumerate(look(film, list(range(len(film))))[1]):
        if places[k] is None:
            assert not mask.any()
        else:
            assert overlap(mask, outline(places[k])) > (0.85 if holes == 0 else 0.75)


def test_two_identical_frames_give_the_same(generator):
    film, _ = walk(generator)
    film.depth[12] = film.depth[11]
    eyes, (one, other) = look(film, [11, 12])
    assert torch.equal(one, other)
    again = eyes(
        Frame(12, film[12].time_s, depth=film.depth[12]), torch.device("cpu")
    )  # the time stands, too
    assert torch.equal(again.silhouette[0], one)


def test_the_floor_is_in_the_state(generator):
    """Before anybody was seen, too: the files of a run may be all that is left to do."""
    film, _ = walk(generator)
    eyes, _ = look(film, [])
    assert float(eyes.floor.height) == pytest.approx(1.05, abs=0.02)
    for state in (eyes.state(), look(film, [11])[0].state()):
        other = Eyes(CAMERA, EyesConfig())
        other.restore(state, torch.device("cpu"))
        assert torch.equal(other.floor.normal, eyes.floor.normal)
        assert torch.equal(other.floor.height, eyes.floor.height)
    blind = Eyes(CAMERA, EyesConfig())
    assert blind.state() == {}
    blind.restore({}, torch.device("cpu"))
    assert blind.floor is None


@pytest.mark.filterwarnings("ignore:nobody moves")
@pytest.mark.parametrize("arm", [0.0, 0.5], ids=["still", "an arm moves"])
def test_who_is_there_from_the_first_frame_to_the_last_is_seen(generator, arm):
    film = Film([frame(0.0, generator, arm=arm * (k % 4) / 3) for k in range(12)])
    for k, mask in zip((0, 5), look(film, [0, 5])[1], strict=True):
        assert overlap(mask, outline(0.0, arm * (k % 4) / 3)) > 0.8


def test_that_nobody_moves_is_said(generator):
    film = Film([frame(0.0, generator) for _ in range(8)])
    with pytest.warns(UserWarning, match="nobody moves in this recording"):
        look(film, [])


@pytest.mark.parametrize("count", [1, 2, 5])
def test_somebody_in_a_background_frame_is_told_once_and_survived(generator, count):
    film, places = walk(generator)
    empty = [frame(None, generator) for _ in range(count - 1)]
    film.empty = torch.stack([*empty, frame(-0.6, generator)])
    with pytest.warns(UserWarning, match=rf"in 1 of {count} background frames \({count - 1}\)") as told:
        _, masks = look(film, list(range(len(film))))
    assert len(told) == 1
    for k, mask in enumerate(masks):
        if places[k] is None:
            assert not mask.any()
        else:
            assert overlap(mask, outline(places[k])) > 0.85


def test_a_background_without_anybody_stays_as_it_is(generator):
    film, places = walk(generator)
    film.empty = torch.stack([frame(None, generator) for _ in range(3)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, masks = look(film, [0, 12])
    assert not masks[0].any()
    assert overlap(masks[1], outline(places[12])) > 0.85


# Somebody whose feet cannot be told from the floor.


def feetless(generator, x=0.0, lost=0.12):
    """Eyes that know the room, and their sight of somebody of whose legs the last `lost` m are not seen."""
    down = (V - CAMERA.cy) / CAMERA.focal_length * PERSON
    seen = outline(x) & (down < 1.05 - lost)
    depth = torch.where(seen, PERSON, scene())
    depth = depth + NOISE * depth.square() * torch.randn(depth.shape, generator=generator)
    eyes = Eyes(CAMERA, EyesConfig())
    empty = torch.stack([frame(None, generator) for _ in range(5)])
    film = Film([frame(None, generator), depth], empty)
    eyes.learn_background(film.background(), film, torch.device("cpu"))
    return eyes, eyes(film[1], torch.device("cpu"))


def test_the_room_has_a_floor(generator):
    eyes, _ = feetless(generator)
    at = torch.tensor([[-1.0, 1.05, 2.5], [0.0, 1.05, PERSON], [0.5, 0.05, 3.0]])
    assert_close(eyes.floor.above(at), torch.tensor([0.0, 0.0, 1.0]), atol=0.03, rtol=0)


def test_whose_legs_are_hidden_does_not_stand_where_the_scene_goes_on(generator):
    eyes, sight = feetless(generator, lost=0.5)
    assert sight.present
    assert torch.equal(eyes.standing_room(sight), sight.silhouette)


def test_where_no_floor_is_seen_feet_are_where_they_are_seen(generator):
    eyes, sight = feetless(generator)
    eyes.floor = None
    assert torch.equal(eyes.standing_room(sight), sight.silhouette)


def test_feet_may_be_where_the_floor_is_as_near_and_nobody_is_below_it(generator):
    eyes, sight = feetless(generator)
    room = eyes.standing_room(sight)[0]
    down = (V - CAMERA.cy) / CAMERA.focal_length * PERSON
    # 5 cm above the floor the ray goes on for 15 cm to it: less than the readings' noise and a foot.
    feet = (((U - CAMERA.cx) / CAMERA.focal_length * PERSON).abs() < 0.2) & (down > 1.0) & (down < 1.05)
    assert bool(room[feet].all())
    assert not bool(room[down > 1.25].any())  # 20 cm under the floor
    behind = (down < 0.6) & ~sight.silhouette[0]  # the wall, and the floor farther off
    assert not bool(room[behind].any())
    assert bool(room[sight.silhouette[0]].all())
    covered = torch.zeros_like(sight.silhouette)
    covered[0, :40, :20] = covered[0, 110:] = True
    room = eyes.standing_room(sight, covered)[0]
    assert bool(room[:40, :20].all())
    assert not bool(room[down > 1.25].any())


def test_time_counts_for_the_stage_that_spent_it_alone(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr("torchpose.eyes.time.process_time", lambda: now[0])
    stopwatch = Stopwatch()

    def spend(stage: str, seconds: float, *within: tuple[str, float], fails: bool = False) -> None:
        with stopwatch.measure(stage):
            for inner in within:
                spend(*inner, fails=fails)
            now[0] += seconds
            if fails:
                raise ValueError("broken")

    spend("registration", 1.0, ("size", 2.0), ("faces", 4.0))
    spend("registration", 8.0)
    with pytest.raises(ValueError, match="broken"):
        spend("faces", 64.0, ("size", 16.0), fails=True)
    spend("faces", 32.0)
    assert dict(stopwatch.seconds) == {
        "registration": 9.0,
        "size": 18.0,
        "faces": 36.0,
    }  # the 64 s were never spent
