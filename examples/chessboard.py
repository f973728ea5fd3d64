"""A chessboard to print and calibrate with.

python examples/chessboard.py --board 9x6 --square 0.025 --output chessboard.pdf

The page has the board's own size and a margin: print it at 100 %, measure a square, and give what you measured to
`python -m torchpose.vision.calibrate FOLDER --board 9x6 --square 0.025`.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

INCH, MARGIN = 0.0254, 0.015  # m

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
parser.add_argument("--board", default="9x6", help="inner corners, columns x rows")
parser.add_argument("--square", type=float, default=0.025, help="side of a square, m")
parser.add_argument("--output", type=Path, default=Path("chessboard.pdf"), help="PDF, SVG or PNG")
options = parser.parse_args()

columns, rows = (int(count) + 1 for count in options.board.split("x"))  # squares
width, height = columns * options.square, rows * options.square  # m
page = np.array([width + 2 * MARGIN, height + 2 * MARGIN])
figure = Figure(figsize=tuple(page / INCH))
axes = figure.add_axes((MARGIN / page[0], MARGIN / page[1], width / page[0], height / page[1]))
axes.pcolormesh(np.indices((rows, columns)).sum(0) % 2, cmap="gray", edgecolors="none", antialiased=False)
axes.set_axis_off()
figure.text(
    0.5, 0.01, f"{options.board} inner corners, {1000 * options.square:g} mm squares", ha="center", fontsize=7
)
figure.savefig(options.output, dpi=254)
print(f"{options.output}: {1000 * page[0]:.0f} x {1000 * page[1]:.0f} mm; A4 is 297 x 210 mm")
