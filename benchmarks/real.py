"""What the eyes make of real cameras: contact sheets to look at, and the figures that can be told without a truth.

python -m benchmarks.real ../shared/data [--output docs/figures]

stereo_people  five pairs by a passive camera, disparity by each matcher: the scale is unknown, so only pictures
oakd_overhead  a video by an OAK-D from above in hard sunlight, rectified with its 14-coefficient calibration: how far
               apart its rows are before, after, and once corrected by what they show themselves, by frames that the
               correction has not seen too, and the person beside plain subtraction, which takes the shadow too

The rows of stereo_people are told as they come and corrected; its pairs were never calibrated.
The empty scene of the second is that of three frames of the video without anybody.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from torchpose.aligned import align_recording
from torchpose.atomic import replacing
from torchpose.eyes import Eyes, EyesConfig
from torchpose.recording import Backgrounds, Frame, Recording, open_recording
from torchpose.scaled import ScaledRecording
from torchpose.video import VideoFile
from torchpose.vision.alignment import Alignment, align_rows, measure_alignment
from torchpose.vision.stereo import MatcherKind, StereoConfig, stereo_matcher

CORRIDOR_RANGE = (0, 79)  # px; the pairs have an offset of about 18
EMPTY = (140, 165, 590)  # frames of the video without anybody
PERSON = (72, 234, 252, 270, 414, 432, 504, 522)  # with one, walking in and out
CHECKED = (60, 140, 240, 360, 480, 600)  # whose rows are compared; others than those that are corrected by
COLOUR_THRESHOLD = 0.06  # of the plain subtraction
TILE = 400  # px, width of a picture in a sheet

Picture = UInt8[np.ndarray, "height width 3"]  # BGR


def corridor(folder: Path) -> tuple[Picture, dict[str, float]]:
    """The pairs in columns: left image, then the disparity by each matcher; and how far apart the rows are."""
    lefts, rights = (
        torch.stack([_image(path) for path in sorted((folder / side).glob("*.png"))])
        for side in ("left", "right")
    )
    before = measure_alignment(lefts, rights)
    rights = align_rows(rights, before)
    after = measure_alignment(lefts, rights)
    rows: list[list[Picture]] = [[] for _ in range(1 + len(MatcherKind))]
    for path, left, right in zip(sorted((folder / "left").glob("*.png")), lefts, rights, strict=True):
        rows[0].append(_titled(_picture(left), f"{path.stem}, left image"))
        for row, kind in zip(rows[1:], MatcherKind, strict=True):
            found = stereo_matcher(StereoConfig(matcher=kind))(
                left[None], right[None], disparity_range=CORRIDOR_RANGE
            )
            share = float(found.values.isfinite().float().mean())
            row.append(
                _titled(_coloured(found.values[0], CORRIDOR_RANGE), f"{kind.value}, {share:.0%} answered")
            )
    return np.vstack([np.hstack(row) for row in rows]), _rows("raw", before) | _rows("corrected", after)


def overhead(folder: Path, kind: MatcherKind) -> tuple[Picture, dict[str, float]]:
    """Rows of rectified left image, plain subtraction, our silhouette and disparity; and how far apart the rows are."""
    whole = open_recording(folder / "left.mp4", folder / "right.mp4", folder / "calib.json")
    raw = [VideoFile(folder / f"{side}.mp4") for side in ("left", "right")]
    before = measure_alignment(*(torch.stack([_raw(video, number) for number in CHECKED]) for video in raw))
    corrected = align_recording(whole)
    after, left_over = (_alignment(recording) for recording in (whole, corrected))
    recording = ScaledRecording(corrected, 0.5)
    eyes = Eyes(recording.camera, EyesConfig(nearest=0.7, farthest=4.0, stereo=StereoConfig(matcher=kind)))
    empty = [recording[number] for number in EMPTY]
    backgrounds = Backgrounds(
        *(torch.stack([_side(frame, side) for frame in empty]) for side in ("left", "right"))
    )
    eyes.learn_background(backgrounds, recording, torch.device("cpu"))
    center = torch.stack([_side(frame, "left") for frame in empty]).median(0).values
    sheet = []
    for number in PERSON:
        frame = recording[number]
        left, sight = _side(frame, "left"), eyes(frame, torch.device("cpu"))
        plain = (left - center).abs().amax(0) > COLOUR_THRESHOLD
        disparity = recording.camera.disparity(sight.depth[0])
        tiles = (
            _titled(_picture(left), f"frame {number}, rectified"),
            _titled(_over(left, plain), "plain subtraction"),
            _titled(_over(left, sight.silhouette[0]), "silhouette"),
            _titled(_coloured(disparity, eyes.disparity_range), f"disparity ({kind.value})"),
        )
        sheet.append(np.hstack(tiles))
    return np.vstack(sheet), _rows("raw", before) | _rows("rectified", after) | _rows("corrected", left_over)


def _alignment(recording: Recording) -> Alignment:
    frames = [recording[number] for number in CHECKED]
    return measure_alignment(
        *(torch.stack([_side(frame, side) for frame in frames]) for side in ("left", "right"))
    )


def _rows(name: str, alignment: Alignment) -> dict[str, float]:
    return {
        f"{name}_dy_px": alignment.dy,
        f"{name}_apart_px": alignment.typical,
        f"{name}_spread_px": alignment.spread,
        f"{name}_matches": alignment.matches,
    }


def _image(path: Path) -> Float[Tensor, "3 height width"]:
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    if pixels is None:
        raise FileNotFoundError(f"no readable image {path}")
    return torch.from_numpy(pixels).permute(2, 0, 1).float() / 255


def _raw(video: VideoFile, number: int) -> Float[Tensor, "3 height width"]:
    return torch.from_numpy(video.read(number)).permute(2, 0, 1).float() / 255


def _side(frame: Frame, side: str) -> Float[Tensor, "3 height width"]:
    image = frame.left if side == "left" else frame.right
    assert image is not None
    return image


def _picture(image: Float[Tensor, "3 height width"]) -> Picture:
    return np.ascontiguousarray((255 * image).round().byte().permute(1, 2, 0).numpy()[..., ::-1])


def _over(image: Float[Tensor, "3 height width"], mask: Bool[Tensor, "height width"]) -> Picture:
    """The image with a mask in green."""
    green = torch.tensor([0.0, 1.0, 0.2])[:, None, None]
    return _picture(torch.where(mask, 0.55 * image + 0.45 * green, image))


def _coloured(disparity: Float[Tensor, "height width"], span: tuple[int, int]) -> Picture:
    """Near is red, far is blue, unknown is black."""
    level = (255 * (disparity - span[0]) / (span[1] - span[0])).nan_to_num(0).clamp(0, 255).byte().numpy()
    picture = cv2.applyColorMap(level, cv2.COLORMAP_TURBO)
    picture[disparity.isnan().numpy()] = 0
    return picture


def _titled(picture: Picture, title: str) -> Picture:
    height, width = picture.shape[:2]
    picture = cv2.resize(picture, (TILE, round(height * TILE / width)), interpolation=cv2.INTER_AREA)
    for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(picture, title, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, thickness, cv2.LINE_AA)
    return picture


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.real",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("data", type=Path, help="folder with stereo_people and oakd_overhead")
    parser.add_argument("--output", type=Path, default=Path("docs/figures"), help="folder for the sheets")
    parser.add_argument(
        "--matcher", choices=[kind.value for kind in MatcherKind], default="sgm", help="of the video"
    )
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    for name in ("stereo_people", "oakd_overhead"):
        if not (options.data / name).is_dir():
            print(
                f"{options.data} must hold the folder {name}, and does not; give the data's folder",
                file=sys.stderr,
            )
            return 2
    options.output.mkdir(parents=True, exist_ok=True)
    video, rows = overhead(options.data / "oakd_overhead", MatcherKind(options.matcher))
    people, people_rows = corridor(options.data / "stereo_people")
    sheets = {"stereo_people": people, "oakd_overhead": video}
    for name, sheet in sheets.items():
        _, data = cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, 80])
        with replacing(options.output / f"{name}.jpg") as partial:
            partial.write_bytes(data.tobytes())
    print(json.dumps({"stereo_people": people_rows, "oakd_overhead": rows}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
