"""The body file: a kinematic tree with sizes, limits, ellipsoids and reported joints, as plain checked data.

Metres and radians; `human.yaml` is written in metres and degrees. Every vector is given per size (`trunk`,
`thigh`, ...), so that the whole geometry is linear in the sizes of a person.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf, isfinite, radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    import pytorch_kinematics as pk

Vector = tuple[float, float, float]
HUMAN = Path(__file__).with_name("human.yaml")
ROOT_PARAMETERS = ("x", "y", "z", "yaw", "pitch", "roll")
X, Y, Z, ZERO = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
ROOT_AXES: tuple[Vector, ...] = (X, Y, Z, Y, X, Z)  # of x, y, z, yaw, pitch, roll


@dataclass(frozen=True)
class SizedVector:
    """A vector that is linear in the sizes: the sum over `terms` of size x vector (m)."""

    terms: tuple[tuple[str, Vector], ...]

    def mirrored(self) -> "SizedVector":
        return SizedVector(tuple((name, (-x, y, z)) for name, (x, y, z) in self.terms))

    def default(self) -> Vector:
        """The vector of a person whose sizes are all 1, m."""
        x, y, z = (sum(vector[i] for _, vector in self.terms) for i in range(3))
        return x, y, z


@dataclass(frozen=True)
class Hinges:
    """Two degrees of freedom about two axes (parent's frame) and their limits, rad."""

    axes: tuple[Vector, Vector]
    limits: tuple[tuple[float, float], tuple[float, float]]
    center: Vector | None = None  # the limb's direction at zero; None for a pair of revolute hinges


@dataclass(frozen=True)
class Body:
    """A rigid body and the joint to its parent. The root has neither parent nor joint."""

    name: str
    parent: int
    origin: SizedVector
    limb: Vector
    rest: Vector
    swing: Hinges
    revolute: Hinges
    hinged: bool  # as anatomy has it: the pair of hinges (a knee, an elbow), not the swing


@dataclass(frozen=True)
class Segment:
    """An ellipsoid on a body: centre, direction of its long axis, half axes across it and half its length.

    Of the two across, the first is the body's x as far as it lies across (its y, if the long axis is x).
    """

    name: str
    body: int
    center: SizedVector
    axis: Vector
    radius: tuple[str, tuple[float, float]]
    half_length: tuple[str, float]


@dataclass(frozen=True)
class Joint:
    """A reported joint: a point of a body."""

    name: str
    body: int
    at: SizedVector


@dataclass(frozen=True)
class Skeleton:
    """A body file, expanded to both sides and checked. Bodies stand before their children."""

    height: float  # m, of the person whose sizes are all 1
    sizes: tuple[str, ...]
    num_lengths: int  # the first of `sizes` are lengths, the others girths
    root: str
    bodies: tuple[Body, ...]  # without the root
    segments: tuple[Segment, ...]
    joints: tuple[Joint, ...]

    @property
    def body_names(self) -> tuple[str, ...]:
        return (self.root, *(body.name for body in self.bodies))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the 6 + 2 x joints pose parameters, in their order."""
        root = tuple(f"{self.root}_{name}" for name in ROOT_PARAMETERS)
        return root + tuple(f"{body.name}_{k}" for body in self.bodies for k in (1, 2))

    def chain(self) -> "pk.Chain":
        """The tree for pytorch-kinematics, two revolute joints a body, at the default sizes (T. 3.4).

        A joint of two degrees of freedom is two revolutes with an empty link between; the root is three
        prismatic and three revolute joints.
        """
        import pytorch_kinematics as pk  # imports matplotlib, so not at the top

        def add(
            parent: "pk.Frame", name: str, kind: str, axis: Vector, offset: Vector, link: str
        ) -> "pk.Frame":
            where = pk.Transform3d(pos=list(offset)) if any(offset) else None
            frame = pk.Frame(name=link, link=pk.Link(name=link), joint=pk.Joint(name, where, kind, axis))
            parent.add_child(frame)
            return frame

        base = frame = pk.Frame(name="camera", link=pk.Link(name="camera"))
        for i, axis in enumerate(ROOT_AXES):
            link = self.root if i == 5 else f"{self.root}_link_{i}"
            frame = add(
                frame, self.parameter_names[i], "prismatic" if i < 3 else "revolute", axis, ZERO, link
            )
        frames = [frame]
        for body in self.bodies:
            (one, two), names = body.revolute.axes, (f"{body.name}_1", f"{body.name}_2")
            frame = add(
                frames[body.parent], names[0], "revolute", one, body.origin.default(), f"{body.name}_link"
            )
            frames.append(add(frame, names[1], "revolute", two, ZERO, body.name))
        return pk.Chain(base)


def load_skeleton(path: Path | str = HUMAN) -> Skeleton:
    """Read and check a body file.

    Raises ValueError, naming file and entry, if a key is missing, a name is unknown or a number senseless.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(
            f"the body file must exist, got {path}; leave `body.path` empty for the built-in human"
        )
    try:
        return _expand(yaml.safe_load(path.read_text()))
    except (KeyError, TypeError, AttributeError, yaml.YAMLError) as error:
        raise ValueError(
            f"{path}: a body file needs the keys of human.yaml; wrong or missing here: {error}"
        ) from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}; correct it, human.yaml in torchpose/body shows how") from error


@contextmanager
def _reading(entry: str) -> Iterator[None]:
    """Name the entry of the body file in every complaint about it."""
    try:
        yield
    except KeyError as error:
        raise ValueError(f"{entry} needs the key {error}, see human.yaml") from error
    except (TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{entry}: {error}") from error


def _expand(data: Any) -> Skeleton:
    sizes = (*data["lengths"], *data["girths"])
    if len(set(sizes)) != len(sizes):
        raise ValueError(f"sizes must have different names, got {list(sizes)}")

    def sized(entry: Any) -> SizedVector:
        if not isinstance(entry, dict) or not set(entry) <= set(data["lengths"]):
            raise ValueError(f"a vector must be given per length, of {data['lengths']}, got {entry}")
        return SizedVector(tuple((name, _vector(value)) for name, value in entry.items()))

    def measure(entry: Any, kind: str) -> tuple[str, tuple[float, ...]]:
        name, given = next(iter(entry.items())) if isinstance(entry, dict) and len(entry) == 1 else ("", 0)
        values = tuple(float(value) for value in (given if isinstance(given, list) else [given]))
        if name not in data[kind] or not values or not all(0 < value < inf for value in values):
            raise ValueError(f"one of {data[kind]} must come with a positive value in metres, got {entry}")
        return name, values

    def across(entry: Any) -> tuple[str, tuple[float, float]]:
        name, values = measure(entry, "girths")
        if len(values) > 2:
            raise ValueError(f"radius must be one number or two, across the long axis, got {entry}")
        return name, (values[0], values[-1])

    def along(entry: Any) -> tuple[str, float]:
        name, values = measure(entry, "lengths")
        if len(values) > 1:
            raise ValueError(f"half_length must be one number, got {entry}")
        return name, values[0]

    height = float(data["height"])
    if not 0 < height < inf:
        raise ValueError(f"height must be positive, in metres, got {height}")
    roots = [name for name, entry in data["bodies"].items() if entry["parent"] is None]
    if len(roots) != 1:
        raise ValueError(f"exactly one body must have `parent: null`, got {roots}")
    names, bodies, reached = [roots[0]], [], {roots[0]}

    def add(name: str, parent: int, side: str) -> None:
        """A body and, depth first, what hangs from it: pytorch-kinematics orders parameters the same way."""
        entry = data["bodies"][name]
        with _reading(f"body {name}"):
            origin, limb, rest = sized(entry["origin"]), _unit(entry["limb"]), _unit(entry["rest"])
            swing = _hinges(entry["swing"], _unit(entry["swing"]["center"]))
            revolute = _hinges(entry["revolute"])
            kind = entry["anatomical"]
            if kind not in ("swing", "revolute"):
                raise ValueError(f"anatomical must be swing or revolute, got {kind!r}")
        if side == "_right":
            origin, limb, rest = origin.mirrored(), _mirror(limb), _mirror(rest)
            swing, revolute = _mirror_hinges(swing), _mirror_hinges(revolute)
        bodies.append(Body(name + side, parent, origin, limb, rest, swing, revolute, kind == "revolute"))
        names.append(name + side)
        reached.add(name)
        descend(name, len(names) - 1, side)

    def descend(name: str, index: int, side: str) -> None:
        for child, entry in data["bodies"].items():
            if entry["parent"] == name:
                for own in [side] if side or not entry.get("sided") else ["_left", "_right"]:
                    add(child, index, own)

    descend(roots[0], 0, "")
    if unreached := set(data["bodies"]) - reached:
        raise ValueError(f"every body must hang from {roots[0]!r}, these do not: {sorted(unreached)}")

    def sides(entry: Any) -> tuple[str, ...]:
        sided = bool(entry.get("sided"))
        wanted = tuple(entry["body"] + side for side in (("_left", "_right") if sided else ("",)))
        if not set(wanted) <= set(names):
            raise ValueError(f"it must stand on a body of the same side, one of {names}, got {wanted}")
        return wanted

    segments, joints = [], []
    for name, entry in data["segments"].items():
        with _reading(f"segment {name}"):
            radius, half_length = across(entry["radius"]), along(entry["half_length"])
            if max(radius[1]) > half_length[1]:
                raise ValueError(f"half_length must be at least the radius, got {half_length} < {radius}")
            for body in sides(entry):
                side, center, axis = (
                    body.removeprefix(entry["body"]),
                    sized(entry["center"]),
                    _unit(entry["axis"]),
                )
                if side == "_right":
                    center, axis = center.mirrored(), _mirror(axis)
                segments.append(Segment(name + side, names.index(body), center, axis, radius, half_length))
    for name, entry in data["joints"].items():
        with _reading(f"joint {name}"):
            for body in sides(entry):
                side, at = body.removeprefix(entry["body"]), sized(entry["at"])
                joints.append(
                    Joint(name + side, names.index(body), at.mirrored() if side == "_right" else at)
                )
    segments.sort(key=lambda segment: segment.body)  # stable: along the tree, in the file's order on a body
    return Skeleton(
        height, sizes, len(data["lengths"]), roots[0], tuple(bodies), tuple(segments), tuple(joints)
    )


def _vector(value: Any) -> Vector:
    if len(value) != 3:
        raise ValueError(f"a vector must have 3 numbers, got {value}")
    x, y, z = (float(v) for v in value)
    if not (isfinite(x) and isfinite(y) and isfinite(z)):
        raise ValueError(f"a vector must be finite, got {value}")
    return x, y, z


def _unit(value: Any) -> Vector:
    x, y, z = _vector(value)
    norm = (x * x + y * y + z * z) ** 0.5
    if norm == 0:
        raise ValueError(f"a direction must not be zero, got {value}")
    return x / norm, y / norm, z / norm


def _mirror(direction: Vector) -> Vector:
    return -direction[0], direction[1], direction[2]


def _hinges(entry: Any, center: Vector | None = None) -> Hinges:
    one, two = (_unit(axis) for axis in entry["axes"])
    if center is not None:
        # A swing's axes lie across its centre, at right angles: made so here, for the reader's ease.
        one = _unit(_across(one, center))
        two = _unit(_across(_across(two, center), one))
    if abs(sum(a * b for a, b in zip(one, two, strict=True))) > 1e-6:
        raise ValueError(f"the two axes must be at a right angle, got {entry['axes']}")
    (low_1, high_1), (low_2, high_2) = ((radians(low), radians(high)) for low, high in entry["limits"])
    if not (low_1 < high_1 and low_2 < high_2):
        raise ValueError(f"limits must be [lower, upper] in degrees, got {entry['limits']}")
    return Hinges((one, two), ((low_1, high_1), (low_2, high_2)), center)


def _across(vector: Vector, axis: Vector) -> Vector:
    along = sum(a * b for a, b in zip(vector, axis, strict=True))
    x, y, z = (a - along * b for a, b in zip(vector, axis, strict=True))
    return x, y, z


def _mirror_hinges(hinges: Hinges) -> Hinges:
    """Axes of the right side, such that equal parameters are mirrored poses: M R(axis) M = R(-M axis)."""
    (x1, y1, z1), (x2, y2, z2) = hinges.axes
    center = None if hinges.center is None else _mirror(hinges.center)
    return Hinges(((x1, -y1, -z1), (x2, -y2, -z2)), hinges.limits, center)
