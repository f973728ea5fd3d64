"""Tapered super-quadrics, and a person made of them: the display model, for drawing and for casting rays at.

In a shape's own frame z runs along its axis from 0 to c0, x and y across it; metres. The surface is (T. 3.5,
in its source's form)

    (x/a0)^2 + (y/b0)^2 = g(z/c0),   g(t) = (1 + s t) (1 - (1 - 2 t)^d),   0 <= t <= 1

with an even exponent d (2: round, 4 and 6: ever more a cylinder with rounded ends) and a taper s. With d = 2,
s = 0 it is the ellipsoid with semi-axes a0, b0, c0/2. For -(d-1)/d <= s <= d-1 the profile g is concave, so
the solid is convex and the implicit function is convex along every ray: that is what makes the ray
intersection below safe.
"""

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path

import torch
import yaml
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchpose.body.model import BodyModel, PosedBody, frame_along

EXPONENTS = (2, 4, 6)
PERSON = Path(__file__).with_name("person.yaml")
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Superquadric:
    """Any number of shapes.

    Raises ValueError for sizes that are not positive, an exponent that is not 2, 4 or 6, or a taper outside
    the convex range.
    """

    size: Float[Tensor, "*shapes 3"]  # a0, b0, c0, m: half widths in x and y before tapering, length in z
    taper: Float[Tensor, "*shapes"]  # s: 0 none, negative narrows towards z = c0
    exponent: Int[Tensor, "*shapes"]  # d

    def __post_init__(self) -> None:
        if not bool((self.size > 0).all()):
            raise ValueError(f"sizes must be positive, got {self.size.min().item():g}; give metres")
        known = torch.isin(self.exponent, self.exponent.new_tensor(EXPONENTS))
        if not bool(known.all()):
            raise ValueError(
                f"exponents must be 2, 4 or 6, got {self.exponent[~known][0].item()}; choose one of those"
            )
        d = self.exponent.to(self.taper)
        convex = (self.taper >= -(d - 1) / d) & (self.taper <= d - 1)
        if not bool(convex.all()):
            raise ValueError(
                "tapers must lie in [-(d-1)/d, d-1] for the solid to be convex, got "
                f"{self.taper[~convex][0].item():g} with d = {self.exponent[~convex][0].item()}; "
                "use a smaller taper or a larger exponent"
            )

    def __getitem__(self, index: object) -> "Superquadric":
        """The shapes at `index` of the leading axes."""
        return Superquadric(self.size[index], self.taper[index], self.exponent[index])  # type: ignore[index]


def profile(
    t: Float[Tensor, "*points"], taper: Float[Tensor, "*#points"], exponent: Int[Tensor, "*#points"]
) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points"]]:
    """g(t) and its derivative g'(t): the squared radius at height t = z/c0, relative to a0 and b0.

    Outside 0 <= t <= 1 the taper is held at its end value, so that g stays negative there and means
    'outside'.
    """
    u = 1 - 2 * t
    square = u * u
    power = torch.where(exponent > 2, square, 1) * torch.where(exponent > 4, square, 1)  # u^(d-2)
    cap = 1 - square * power
    held = t.clamp(0, 1)
    slope = torch.where(held == t, taper, 0)
    widening = 1 + taper * held
    return widening * cap, slope * cap + widening * (2 * exponent * u * power)


def implicit(points: Float[Tensor, "*points 3"], shape: Superquadric) -> Float[Tensor, "*points"]:
    """The implicit function, relative: negative inside, 0 on the surface, positive outside. Points in the
    shapes' own frames.
    """
    x, y, t = (points / shape.size).unbind(-1)
    return x * x + y * y - profile(t, shape.taper, shape.exponent)[0]


def normals(points: Float[Tensor, "*points 3"], shape: Superquadric) -> Float[Tensor, "*points 3"]:
    """Outward unit normals at points on the surface: the normalised gradient of `implicit`."""
    x, y, t = (points / shape.size).unbind(-1)
    gradient = torch.stack((2 * x, 2 * y, -profile(t, shape.taper, shape.exponent)[1]), dim=-1) / shape.size
    return torch.nn.functional.normalize(gradient, dim=-1)


def surface(
    shape: Superquadric, around: int = 24, along: int = 13
) -> tuple[Float[Tensor, "*shapes {along} {around} 3"], Float[Tensor, "*shapes {along} {around} 3"]]:
    """A grid of surface points and their outward normals, pole to pole, for meshes and figures.

    The rows lie at t = (1 - cos(eta)) / 2, closer at the rounded ends; the first and last row are the poles.
    Raises ValueError for fewer than 3 points around or 2 rows.
    """
    if around < 3 or along < 2:
        raise ValueError(f"a surface needs around >= 3 and along >= 2, got {around} and {along}; use more")
    device, dtype = shape.size.device, shape.size.dtype
    t = (1 - torch.cos(torch.linspace(0, math.pi, along, device=device, dtype=dtype))) / 2
    angle = torch.arange(around, device=device, dtype=dtype) * (2 * math.pi / around)
    t, angle = torch.broadcast_tensors(t[:, None], angle)
    wide = Superquadric(
        shape.size[..., None, None, :], shape.taper[..., None, None], shape.exponent[..., None, None]
    )
    t = t.expand(*shape.taper.shape, along, around)
    radius = profile(t, wide.taper, wide.exponent)[0].clamp_min(0).sqrt()
    points = torch.stack((radius * angle.cos(), radius * angle.sin(), t), dim=-1) * wide.size
    return points, normals(points, wide)


def bounding_box(shape: Superquadric) -> Float[Tensor, "*shapes 8 3"]:
    """Corners of a box around each solid, in its own frame: |x| <= a0 w, |y| <= b0 w, 0 <= z <= c0 with w
    from `_widest`.
    """
    sign = shape.size.new_tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 1)])
    width = _widest(shape.taper).sqrt()[..., None]
    half = torch.cat((shape.size[..., :2] * width, shape.size[..., 2:]), dim=-1)
    return half[..., None, :] * sign


def _widest(taper: Float[Tensor, "*shapes"]) -> Float[Tensor, "*shapes"]:
    """An upper bound of g on [0, 1]: the cap's factor is at most 1, the taper's at most 1 + max(s, 0)."""
    return 1 + taper.clamp_min(0)


def intersect(
    origins: Float[Tensor, "*#rays 3"],
    directions: Float[Tensor, "*#rays 3"],
    shape: Superquadric,
    steps: int = 20,
) -> Float[Tensor, "*distances"]:
    """Where each ray enters its shape: the smallest l >= 0 with `origin + l * direction` in the solid, inf
    where it misses.

    Rays are given in the shapes' own frames; rays and shapes broadcast. Lengths are in units of the
    direction, so with a direction of z = 1 in the camera's frame l is the depth. A ray that starts inside
    gets 0. The ray is first cut to the slab 0 <= z <= c0 and the elliptic cylinder around the solid, in
    closed form. From the entry Newton's method runs on the implicit function, which is convex along the ray:
    it rises to the first root from the left without passing it, and a point with a positive value and no
    falling slope proves a miss. `steps` bounds the work: quadratic convergence on ordinary rays, a halving of
    the error per step on those that graze.
    """
    start = origins / shape.size
    ray = directions / shape.size
    entry, leave = _cut(start, ray, shape.taper)
    missed = entry > leave
    entry = torch.where(missed, 0, entry)
    x, y, t = (start + entry[..., None] * ray).unbind(-1)
    dx, dy, dt = ray.unbind(-1)
    a, b, c = dx * dx + dy * dy, 2 * (x * dx + y * dy), x * x + y * y
    span = leave - entry

    tolerance = 32 * torch.finfo(a.dtype).eps
    run = torch.zeros_like(a)
    done = missed
    for _ in range(steps):
        value, slope = profile(t + run * dt, shape.taper, shape.exponent)
        value = c + run * (b + run * a) - value
        slope = b + 2 * run * a - slope * dt
        arrived = value <= tolerance
        missed = missed | (~arrived & (slope >= 0)) | (run > span)
        done = done | arrived | missed
        run = torch.where(done, run, run - value / torch.where(done, 1, slope))
    # Rays still on their way are grazing ones; what is left of them is decided by where the last step led.
    missed = missed | (run > span)
    return torch.where(missed, math.inf, entry + run)


def _cut(
    start: Float[Tensor, "*#rays 3"], ray: Float[Tensor, "*#rays 3"], taper: Float[Tensor, "*#rays"]
) -> tuple[Float[Tensor, "*cuts"], Float[Tensor, "*cuts"]]:
    """First and last l >= 0 of each scaled ray in the slab 0 <= t <= 1 and the cylinder x^2 + y^2 <=
    `_widest`; first > last: none.
    """
    tiny = torch.finfo(start.dtype).tiny
    x, y, t = start.unbind(-1)
    dx, dy, dt = ray.unbind(-1)
    dt = torch.where(dt.abs() < tiny, tiny, dt)
    low, high = -t / dt, (1 - t) / dt
    a, b, c = dx * dx + dy * dy, x * dx + y * dy, x * x + y * y - _widest(taper)
    along = a < tiny  # parallel to the axis: inside the cylinder for ever, or never
    discriminant = b * b - a * c
    root = discriminant.clamp_min(0).sqrt()
    safe = torch.where(along, 1, a)
    inside = torch.where(along, c <= 0, discriminant >= 0)
    first = torch.where(along, -math.inf, (-b - root) / safe)
    last = torch.where(along, math.inf, (-b + root) / safe)
    entry = torch.maximum(torch.minimum(low, high), first).clamp_min(0)
    leave = torch.minimum(torch.maximum(low, high), last)
    return entry, torch.where(inside, leave, -math.inf)


class Material(IntEnum):
    """What a person's surface is made of: the rows of `Person.colours`."""

    SKIN = 0
    HAIR = 1
    SHIRT = 2
    TROUSERS = 3
    SHOES = 4


@dataclass(frozen=True)
class Person:
    """One person's size and clothes: plain numbers, from `draw_person(seed)` or by hand.

    Raises ValueError for a size or a share outside the range of people.
    """

    height: float = 1.75  # m, standing, in shoes
    girth: float = 1.0  # all girths, 1 = the body file's
    lengths: tuple[float, ...] = ()  # proportions: a factor for each of the body file's lengths; empty: all 1
    girths: tuple[float, ...] = ()  # the same for its girths, beside `girth`
    colours: tuple[Vector, ...] = (
        (0.78, 0.58, 0.47),
        (0.16, 0.11, 0.08),
        (0.32, 0.48, 0.68),
        (0.26, 0.27, 0.33),
        (0.30, 0.22, 0.18),
    )  # RGB of each material, linear in [0, 1]
    sleeve: float = 0.4  # share of the arm, shoulder to wrist, under the shirt
    trouser: float = 1.0  # share of the leg, hip to ankle, under the trousers
    pattern: int = 0  # seed of the cloths' textures

    def __post_init__(self) -> None:
        for name, low, high in (
            ("height", 1.0, 2.3),
            ("girth", 0.6, 1.8),
            ("sleeve", 0, 1),
            ("trouser", 0, 1),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(
                    f"{name} must lie in [{low}, {high}], got {getattr(self, name)}; height is in metres"
                )
        if len(self.colours) != len(Material):
            raise ValueError(
                f"colours must be {len(Material)} RGB triples, one a material, got {len(self.colours)}"
            )

    def size(self, body: BodyModel) -> Float[Tensor, "1 sizes"]:
        """The person's sizes for `body`: proportions scaled to the standing height, and girths."""
        size = body.default_size(1).clone()
        lengths, girths = size[0, : body.num_lengths], size[0, body.num_lengths :]
        for name, own, all_of in (("lengths", self.lengths, lengths), ("girths", self.girths, girths)):
            if own and len(own) != len(all_of):
                raise ValueError(
                    f"the person has {len(own)} {name} and the body {len(all_of)}: use the body's own"
                )
            if own:
                all_of.copy_(all_of.new_tensor(own))
        shares = yaml.safe_load(PERSON.read_text())["stature"]
        stature = sum(share * size[0, body.size_names.index(name)].item() for name, share in shares.items())
        lengths *= self.height / stature
        girths *= self.girth * self.height / sum(shares.values())
        return size


_SKINS: tuple[Vector, ...] = ((0.85, 0.66, 0.55), (0.78, 0.58, 0.46), (0.66, 0.47, 0.35), (0.48, 0.32, 0.23))
_HAIRS: tuple[Vector, ...] = ((0.10, 0.08, 0.07), (0.22, 0.14, 0.09), (0.42, 0.29, 0.16), (0.45, 0.43, 0.41))
_SHIRTS: tuple[Vector, ...] = (
    (0.72, 0.26, 0.24),
    (0.25, 0.45, 0.70),
    (0.30, 0.55, 0.38),
    (0.78, 0.74, 0.66),
    (0.70, 0.55, 0.22),
    (0.50, 0.34, 0.58),
    (0.36, 0.40, 0.44),
)
_TROUSERS: tuple[Vector, ...] = (
    (0.22, 0.29, 0.42),
    (0.28, 0.27, 0.27),
    (0.50, 0.44, 0.34),
    (0.34, 0.38, 0.30),
)
_SHOES: tuple[Vector, ...] = ((0.20, 0.17, 0.16), (0.62, 0.60, 0.58), (0.40, 0.26, 0.16))


def draw_person(seed: int) -> Person:
    """A person like others, by seed: 1.55 to 1.92 m tall, proportions and girth of their own, clothes at
    random.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * torch.rand((), generator=generator).item()

    def one_of(choices: tuple[Vector, ...]) -> Vector:
        return choices[int(torch.randint(len(choices), (), generator=generator))]

    def dyed(choices: tuple[Vector, ...]) -> Vector:
        r, g, b = (min(0.9, max(0.05, channel * uniform(0.85, 1.15))) for channel in one_of(choices))
        return r, g, b

    colours = (one_of(_SKINS), one_of(_HAIRS), dyed(_SHIRTS), dyed(_TROUSERS), dyed(_SHOES))
    return Person(
        height=uniform(1.55, 1.92),
        girth=uniform(0.9, 1.15),
        lengths=tuple(uniform(0.96, 1.04) for _ in range(8)),
        colours=colours,
        sleeve=uniform(0.3, 0.45) if uniform(0.0, 1.0) < 0.6 else 1.0,
        trouser=1.0 if uniform(0.0, 1.0) < 0.75 else uniform(0.35, 0.5),
        pattern=int(torch.randint(2**31, (), generator=generator)),
    )


@dataclass(frozen=True)
class Part:
    """One super-quadric of person.yaml on one rigid body, m at size 1."""

    body: str
    segment: str
    start: Vector  # where the part's z = 0, in the body's frame
    axis: Vector  # unit vector along its z
    size: Vector  # a0, b0, c0
    taper: float
    exponent: int
    scale: tuple[str, str]  # the sizes that scale start and c0, and a0 and b0
    cloth: Material
    covers: str = ""  # the share of the person's (sleeve or trouser) that says how far the cloth goes
    half: int = 0  # which half of the limb the part is on

    def on(self, side: str) -> "Part":
        """The part on the left side as given, or mirrored."""
        part = replace(self, body=f"{self.body}_{side}", segment=f"{self.segment}_{side}")
        (x, y, z), (dx, dy, dz) = self.start, self.axis
        return part if side == "left" else replace(part, start=(-x, y, z), axis=(-dx, dy, dz))

    def cut(self, person: Person) -> float:
        """The share of the part's length under cloth."""
        return min(1.0, max(0.0, 2 * getattr(person, self.covers) - self.half)) if self.covers else 1.0


def load_parts() -> list[Part]:
    """The parts of person.yaml, with a left and a right one where the body has two sides, in the file's
    order.
    """
    sided = {"upper_arm", "forearm", "thigh", "shank"}
    parts = []
    for entry in yaml.safe_load(PERSON.read_text())["parts"]:
        vectors = {key: tuple(float(value) for value in entry[key]) for key in ("start", "axis", "size")}
        entry |= {"scale": tuple(entry["scale"]), "cloth": Material[entry["cloth"].upper()]}
        part = Part(**{**entry, **vectors, "taper": float(entry["taper"])})
        parts += [part.on("left"), part.on("right")] if part.body in sided else [part]
    return parts


@dataclass(frozen=True)
class PosedParts:
    """Where each super-quadric stands in the camera's frame."""

    rotations: Float[Tensor, "batch shapes 3 3"]  # R_camera_part
    origins: Float[Tensor, "batch shapes 3"]  # m, the part's z = 0


class DisplayModel(nn.Module):
    """A person's super-quadrics on the rigid bodies of a `BodyModel`.

    `shapes` are their sizes, `segments` the segment that each belongs to (an index into the body's segment
    names), `materials` and `cuts` what each is made of: its material up to z = cut * c0, skin beyond. Raises
    ValueError if the body file lacks a name.
    """

    segments: Tensor
    materials: Tensor
    cuts: Tensor
    frames: Tensor
    offsets: Tensor
    head_scale: Tensor
    size: Tensor
    taper: Tensor
    exponent: Tensor

    def __init__(self, body: BodyModel, person: Person = Person()):
        super().__init__()
        self.person = person
        size = dict(zip(body.size_names, person.size(body)[0].tolist(), strict=True))
        parts = load_parts()
        try:
            self.bodies = tuple(body.body_names.index(part.body) for part in parts)
            segments = [body.segment_names.index(part.segment) for part in parts]
            lengths = torch.tensor([size[part.scale[0]] for part in parts])
            girths = torch.tensor([size[part.scale[1]] for part in parts])
        except (KeyError, ValueError) as error:
            raise ValueError(
                f"the display model needs the names of the built-in human.yaml: {error}"
            ) from error
        scale = torch.stack((girths, girths, lengths), -1)
        self._constant("size", torch.tensor([part.size for part in parts]) * scale)
        self._constant("taper", torch.tensor([part.taper for part in parts]))
        self._constant("exponent", torch.tensor([part.exponent for part in parts]))
        self._constant("segments", torch.tensor(segments))
        self._constant("materials", torch.tensor([part.cloth for part in parts]))
        self._constant("cuts", torch.tensor([part.cut(person) for part in parts]))
        self._constant("frames", frame_along(torch.tensor([part.axis for part in parts])))
        self._constant("offsets", torch.tensor([part.start for part in parts]) * lengths[:, None])
        head = torch.tensor([size["head_girth"], size["neck"], size["head_girth"]])
        self._constant(
            "head_scale", head
        )  # across, along and across the head: what a face at size 1 is stretched by

    def _constant(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value, persistent=False)

    @property
    def shapes(self) -> Superquadric:
        return Superquadric(self.size, self.taper, self.exponent)

    def forward(self, posed: PosedBody) -> PosedParts:
        """Carry the parts along with the rigid bodies."""
        rotations = posed.rotations[:, self.bodies]
        origins = posed.origins[:, self.bodies] + (rotations @ self.offsets.to(rotations)[..., None])[..., 0]
        return PosedParts(rotations @ self.frames.to(rotations), origins)
