"""The thesis's figures: all are there and shown, and what they are made of is right."""

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from benchmarks import figures, moving_figure
from benchmarks.figures import FIGURES, OUTPUT, draw, labels_at
from benchmarks.panel import box_around, draw_sides
from torchpose.cli import CONFIGS
from torchpose.export import open_video

ROOT = CONFIGS.parent
THESIS = ("3.3", "3.7", "3.9", "4.2", "4.3", "4.5", "5.1", "5.2", "5.4", "5.7")


def test_every_figure_is_there_small_and_shown():
    page = (ROOT / "docs" / "thesis_figures.md").read_text()
    assert tuple(FIGURES) == THESIS
    for number in THESIS:
        path = ROOT / OUTPUT / f"figure_{number.replace('.', '_')}.png"
        assert path.stat().st_size < 150_000
        with Image.open(path) as image:
            assert image.width >= 400
        assert f"(figures/thesis/{path.name})" in page
    assert (ROOT / "docs/figures/demo.webp").stat().st_size < 3_000_000
    assert "docs/figures/demo.webp" in (ROOT / "README.md").read_text()


def test_components_are_drawn_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(figures, "PEOPLE", 1)
    monkeypatch.setattr(figures, "MOMENTS", 6)
    monkeypatch.setattr(figures, "COMPONENTS", 12)
    figures.silhouettes.cache_clear()
    for number in ("4.2", "4.3"):
        image = np.asarray(Image.open(draw(number, tmp_path, tmp_path)).convert("RGB")).astype(int)
        assert image.std() > 10
        assert (image[..., 0] - image[..., 2]).max() > 80  # positive weights are red
        assert (image[..., 2] - image[..., 0]).max() > 80  # negative ones are blue
    figures.silhouettes.cache_clear()


def test_an_unknown_figure_is_one_sentence(tmp_path: Path):
    with pytest.raises(ValueError, match=r"the figure must be one of 3\.3, .*5\.7, got '6\.1'"):
        draw("6.1", tmp_path, tmp_path)


def test_sides_are_drawn_with_what_they_are_off():
    """A left angle that is 3 degrees off and a right one 5, but unknown where its deviation is large."""
    time_s = torch.arange(10) / 10
    truth = torch.stack([time_s, -time_s], 1)
    estimate = truth + torch.tensor([3.0, 5.0]).deg2rad()
    estimate[4, 1] = 3.0
    sd = torch.full_like(truth, 0.05)
    sd[4, 1] = 1.0
    axes = Figure().subplots()
    draw_sides(axes, time_s, estimate, truth, sd)
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["left, 3.0° off", "right, 5.0° off", "truth"]
    right = axes.lines[2].get_ydata()
    assert np.isnan(right[4])
    assert right[5] == pytest.approx(5 - np.rad2deg(0.5))


def test_a_box_holds_the_mask_and_its_margin():
    mask = torch.zeros(100, 200, dtype=torch.bool)
    mask[30:41, 50:91] = True
    assert box_around(mask, 5) == (slice(25, 46), slice(45, 96))
    mask[0, 0] = True
    assert box_around(mask, 5) == (slice(0, 46), slice(0, 96))


def test_labels_are_read_where_the_points_are():
    labels = torch.arange(12).view(3, 4)
    assert labels_at(labels, torch.tensor([[0.0, 0.0], [3.2, 1.9], [0.6, 1.0]])).tolist() == [-1, 10, 4]


def test_a_video_becomes_a_moving_picture(tmp_path: Path):
    with open_video(tmp_path / "video.mp4", 64, 48, 10.0) as video:
        for level in (0.1, 0.5, 0.9):
            video.write(torch.tensor([level, 0.5, 0.5])[:, None, None].expand(3, 48, 64).clone())
    assert moving_figure.convert(tmp_path / "video.mp4", tmp_path / "moving.webp", 32) == 3
    picture = Image.open(tmp_path / "moving.webp")
    assert (picture.size, picture.n_frames, picture.info["loop"]) == ((32, 24), 3, 0)
    levels = []
    for number in range(3):
        picture.seek(number)
        levels.append(np.asarray(picture.convert("RGB"))[..., 0].mean())
        assert picture.info["duration"] == 100
    assert levels == pytest.approx([25, 128, 230], abs=12)
    with pytest.raises(ValueError, match="must be a video with frames, got none; run `make demo` first"):
        moving_figure.convert(tmp_path / "nothing.mp4", tmp_path / "moving.webp")
