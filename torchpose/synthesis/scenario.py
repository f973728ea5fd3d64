"""Companies by seed: people who cross or stand side by side, somebody behind a counter, somebody who comes and sits.

Left-camera frame, metres, seconds; they are made for a camera like `synthetic_camera()`, whose view is 1.07 times as
wide as it is deep.
"""

import math

from torchpose.body.superquadric import Person, draw_person
from torchpose.synthesis.box import Box
from torchpose.synthesis.company import Company, Guest
from torchpose.synthesis.motion import Draw
from torchpose.synthesis.path import Path

CROSSINGS = ("opposite", "passing", "returning")
EMPTY = 1.2  # s, at least, before anybody is seen
FRONT, BACK = 3.1, 4.2  # m, ways across the room


def unlike(seed: int) -> tuple[Person, Person]:
    """Two people who differ in size and in the colour of their shirts."""
    draw = Draw("two people", seed)
    first = draw_person(int(draw(0.0, 1e6)))
    while True:
        second = draw_person(int(draw(0.0, 1e6)))
        if math.dist(first.colours[2], second.colours[2]) > 0.3 and abs(first.height - second.height) > 0.08:
            return first, second


def crossing(seed: int, kind: str | None = None) -> Company:
    """Two people of whom one hides the other for a while; `kind` is one of `CROSSINGS` (None: by the seed, in turn).

    opposite: both walk across the image, in opposite directions. passing: one comes and stands, moving the arms,
    the other walks past, before or behind. returning: they pass each other, turn, and pass each other again.
    """
    kind = CROSSINGS[seed % len(CROSSINGS)] if kind is None else kind
    if kind not in CROSSINGS:
        raise ValueError(f"kind must be one of {', '.join(CROSSINGS)}, got {kind!r}")
    draw = Draw("crossing", kind, seed)
    people = unlike(seed)
    side = 1.0 if draw(0.0, 1.0) < 0.5 else -1.0  # where the first one comes from: -1 is the image's left
    near = int(draw(0.0, 2.0))  # which of them passes nearer to the camera
    depth = [FRONT + draw(-0.1, 0.1) if k == near else BACK + draw(-0.35, 0.2) for k in (0, 1)]
    pace = [draw(0.8, 1.25), draw(0.8, 1.25)]

    def beyond(k: int) -> float:
        """Distance from the middle at which somebody is out of view."""
        return 0.5334 * depth[k] + 0.55

    def from_side(k: int) -> float:
        return side if k == 0 else -side

    def across(k: int, middle: float) -> Path:
        way = beyond(k)
        half = way / pace[k]
        begin, end = from_side(k) * way, -from_side(k) * way
        return Path((middle - half, middle + half), ((begin, depth[k]), (end, depth[k])))

    if kind == "opposite":
        middle = EMPTY + max(beyond(k) / pace[k] for k in (0, 1))
        paths = [across(0, middle), across(1, middle + draw(-0.15, 0.15))]
        end = max(path.times[-1] for path in paths)
    elif kind == "passing":
        depth[0] = 3.7 + draw(-0.1, 0.1)
        stands = (draw(-0.25, 0.25), depth[0])
        way = beyond(0)
        there = EMPTY + way / pace[0]
        middle = there + 0.8 + beyond(1) / pace[1] / 2
        leaves = middle + 1.4
        begin = (side * way, depth[0])
        times = (EMPTY, there, leaves, leaves + way / pace[0])
        depth[1] = 4.5 if near == 0 else 3.0
        paths = [
            Path(times, (begin, stands, stands, (-side * way, depth[0])), gestures=((there, leaves),)),
            across(1, middle),
        ]
        end = times[-1]
    else:
        turn = draw(0.65, 0.9)
        paths, end = [], 0.0
        slowest = max((beyond(k) + turn) / pace[k] for k in (0, 1))
        for k in (0, 1):
            s, way = from_side(k), beyond(k)
            gone = (way + turn) / pace[k]
            reached = EMPTY + slowest
            back = reached + 0.7
            times = (reached - gone, reached, back, back + gone)
            far, over = (s * way, depth[k]), (-s * turn, depth[k])
            paths.append(Path(times, (far, over, over, far)))
            end = max(end, times[-1])
    guests = tuple(
        Guest(person, path, manner=2 * seed + k)
        for k, (person, path) in enumerate(zip(people, paths, strict=True))
    )
    return Company(f"{kind} {seed}", guests, round(end + 0.6, 1), room=seed)


def counter(x: float, width: float, z: float = 2.95, height: float = 1.0, floor: float = 1.1) -> Box:
    """A counter of `height` on the floor, its middle at x and z; it hides whoever stands 0.7 m behind to the waist."""
    grain, wood = (1.0, 0.25, 1.0), (0.50, 0.40, 0.30)
    return Box((x, floor - height / 2, z), (width, height, 0.35), wood, 0.0, 0.16, 0.05, grain)


def behind_counter(seed: int) -> Company:
    """Somebody comes in, stands in full view, and then for 2.4 s behind a counter, moving the arms, and leaves."""
    draw = Draw("counter", seed)
    side = 1.0 if draw(0.0, 1.0) < 0.5 else -1.0
    depth = 3.7 + draw(-0.05, 0.05)
    pace = draw(0.85, 1.1)
    way, open_spot, hidden_spot = 0.5334 * depth + 0.55, 1.05, 0.35 + draw(-0.1, 0.1)
    shown = EMPTY + (way - open_spot) / pace
    leaves = shown + 1.5
    hidden = leaves + (open_spot + hidden_spot) / pace
    out = hidden + 2.8
    path = Path(
        (EMPTY, shown, leaves, hidden, out, out + (way - hidden_spot) / pace),
        tuple((side * x, depth) for x in (way, open_spot, open_spot, -hidden_spot, -hidden_spot, -way)),
        gestures=((shown, leaves + 0.4), (hidden - 0.3, out + 0.3)),
    )
    guest = Guest(draw_person(int(draw(0.0, 1e6))), path, seed)
    furniture = (counter(-side * 0.35, 1.25),)
    return Company(f"counter {seed}", (guest,), round(path.times[-1] + 0.6, 1), furniture, seed)


def visit(seed: int) -> Company:
    """Somebody comes in, goes to the middle, sits down for a while, gets up, and leaves on the other side."""
    draw = Draw("visit", seed)
    side = 1.0 if draw(0.0, 1.0) < 0.5 else -1.0
    pace, way = draw(0.9, 1.2), 0.5334 * 3.9 + 0.55
    there = EMPTY + math.dist((way, 3.9), (0.0, 3.5)) / pace
    leaves = there + 4.0
    path = Path(
        (EMPTY, there, leaves, leaves + math.dist((way, 3.9), (0.0, 3.5)) / pace),
        ((side * way, 3.9), (0.0, 3.5), (0.0, 3.5), (-side * way, 3.9)),
        seated=((there + 0.4, leaves - 0.3),),
    )
    guest = Guest(draw_person(int(draw(0.0, 1e6))), path, seed)
    return Company(f"visit {seed}", (guest,), round(path.times[-1] + 0.6, 1), room=seed)


def side_by_side(seed: int) -> Company:
    """Two people come in from both sides, stand next to each other for 4 s, moving their arms, and leave again."""
    draw = Draw("side by side", seed)
    depth = [3.6 + draw(-0.2, 0.2) for _ in (0, 1)]
    guests, end = [], 0.0
    for k, (person, side) in enumerate(zip(unlike(seed), (-1.0, 1.0), strict=True)):
        way, spot = 0.5334 * depth[k] + 0.55, 0.85
        there = EMPTY + (way - spot) / draw(0.9, 1.2)
        leaves = there + 4.0
        path = Path(
            (EMPTY, there, leaves, leaves + (way - spot)),
            tuple((side * x, depth[k]) for x in (way, spot, spot, way)),
            gestures=((there, leaves),),
        )
        guests.append(Guest(person, path, 2 * seed + k))
        end = max(end, path.times[-1])
    return Company(f"side by side {seed}", tuple(guests), round(end + 0.6, 1), room=seed)
