"""A video as a moving picture for a page: `make figures` makes README's of the demonstration's overlay.

python -m benchmarks.moving_figure runs/demo/overlay.mp4 docs/figures/demo.webp [--width 480]
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
from PIL import Image

from torchpose.atomic import replacing

QUALITY = 70  # of WebP, which GitHub and every browser play


def convert(video: Path, picture: Path, width: int = 480) -> int:
    """Write an endless WebP of a video, `width` px wide, and return how many frames it has.

    Raises ValueError for a file that is no video.
    """
    capture = cv2.VideoCapture(str(video))
    rate, frames = capture.get(cv2.CAP_PROP_FPS), []
    while True:
        read, image = capture.read()
        if not read:
            break
        height = round(image.shape[0] * width / image.shape[1])
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        frames.append(Image.fromarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB)))
    capture.release()
    if not frames:
        raise ValueError(f"{video} must be a video with frames, got none; run `make demo` first")
    with replacing(picture) as partial:
        frames[0].save(
            partial,
            "WEBP",
            save_all=True,
            append_images=frames[1:],
            duration=round(1000 / rate),
            loop=0,
            quality=QUALITY,
        )
    return len(frames)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.moving_figure", description=__doc__.split("\n")[0]
    )
    parser.add_argument("video", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--width", type=int, default=480, help="px")
    options = parser.parse_args(argv)
    count = convert(options.video, options.picture, options.width)
    print(f"{options.picture}  {count} frames, {options.picture.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
