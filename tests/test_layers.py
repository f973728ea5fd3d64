"""The order of the house: a file imports only from rooms, and in its room from files, before its own."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "torchpose"

# The rooms in the order in which data flows through them, and the files of each in the order in which they
# may import one another, also those that the design names and that are still to come. A new file takes its
# place here first.
ROOMS: dict[str, tuple[str, ...]] = {
    "the ground": (
        "version",
        "atomic",
        "terminal",
        "image_file",
        "settings",
        "manual",
        "geometry",
        "least_squares",
    ),
    "vision": (
        "camera",
        "windows",
        "density",
        "pieces",
        "photometry",
        "disparity",
        "disparity_space",
        "growing_seeds",
        "semi_global",
        "stereo",
        "background",
        "empty_scene",
        "scene_match",
        "floor",
        "silhouette",
        "focal_length",
        "points",
        "clump",
        "colour_histogram",
        "mean_shift",
        "trunk",
        "head",
        "skin",
        "faces",
        "alignment",
        "calibrate",
    ),
    "body": ("skeleton", "model", "ellipsoid", "superquadric", "angle"),
    "registration": (
        "likelihood",
        "colour",
        "labelling",
        "geodesic",
        "moment",
        "fitting",
        "solid",
        "silhouette",
        "occlusion",
        "vem",
        "size",
        "limb_search",
        "walk",
        "start",
        "limb_score",
    ),
    "tracking": (
        "kalman",
        "location",
        "chain",
        "trellis",
        "limb_hypothesis",
        "smoother",
        "partition",
        "tracker",
    ),
    "activity": (
        *("dataset", "skeleton", "subspace", "features"),
        *("inference", "baum_welch", "hmm", "codebook", "score_layer", "recognizer", "segmenter", "diary"),
    ),
    "synthesis": (
        *("motion", "path", "box", "room", "actor", "render", "depth"),
        *("database", "company", "scenario"),
    ),
    "learning": ("part_network", "training"),
    "the desk": (
        *("depthai", "calibration", "video", "recording", "scaled", "aligned", "capture", "rendered"),
        *("export", "trajectory_filter", "level", "resampling"),
        *("opensim", "bvh", "c3d_file", "motion_export"),
        *("figures", "timeline", "journal", "report", "rerun_log", "activities"),
        *("eyes", "pipeline", "window", "follower", "people", "parts", "overlay", "picture", "session"),
        *("feed", "web_view", "live", "clips", "study", "cli"),
    ),
}
ORDER = [
    f"torchpose.{file}" if room.startswith("the ") else f"torchpose.{room}.{file}"
    for room, files in ROOMS.items()
    for file in files
]
# The two columns meet in the data types and in the pipeline: activities are told from features alone.
FORBIDDEN = {
    "torchpose.activity": tuple(
        f"torchpose.{room}" for room in ("vision", "body", "registration", "tracking")
    )
}
# Slow or optional: imported where they are used.
NOT_AT_TOP = {"matplotlib", "pytorch_kinematics", "rerun", "ray", "tensorboard", "ezc3d"}

FILES = sorted(PACKAGE.rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(path: Path, tree: ast.AST) -> Iterator[str]:
    """Every module that the statements in `tree` import, as an absolute name."""
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) + 1 - node.level] if node.level else []
            source = ".".join([*start, *(node.module.split(".") if node.module else [])])
            for alias in node.names:
                # `from torchpose.vision import camera` imports a file, `from torch import Tensor` a name.
                full = f"{source}.{alias.name}"
                yield full if full in ORDER else source


def top_level(tree: ast.Module) -> ast.Module:
    """What runs when the file is imported: the statements outside functions and `if TYPE_CHECKING`."""

    class Outside(ast.NodeTransformer):
        def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
            return None

        def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> None:
            return None

        def visit_If(self, node: ast.If) -> ast.AST | None:
            guarded = isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
            return None if guarded else self.generic_visit(node)

    return Outside().visit(tree)


def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def violations(path: Path, tree: ast.Module) -> list[str]:
    """The package's own imports in `tree` that do not point down."""
    name = module_name(path)
    if name == "torchpose":  # lists the public names of all rooms
        return []
    wrong = []
    forbidden = FORBIDDEN.get(name.rpartition(".")[0], ())
    if path.name == "__init__.py":
        below = [module for module in ORDER if module.startswith(f"{name}.")]
    else:
        below = ORDER[: ORDER.index(name)]
    for module in imports(path, tree):
        if module.split(".")[0] != "torchpose":
            continue
        if module not in below or module.startswith(forbidden):
            wrong.append(module)
    return wrong


@pytest.mark.parametrize("path", FILES, ids=module_name)
def test_imports_only_point_down(path: Path):
    if path.name != "__init__.py":
        assert module_name(path) in ORDER, f"give {module_name(path)} its place in ROOMS first"
    assert violations(path, parse(path)) == []


@pytest.mark.parametrize("path", FILES, ids=module_name)
def test_slow_and_optional_libraries_are_imported_where_they_are_used(path: Path):
    names = {module.split(".")[0] for module in imports(path, top_level(parse(path)))}
    assert not names & NOT_AT_TOP


@pytest.mark.parametrize(
    ("file", "line", "wrong"),
    [
        ("vision/stereo.py", "from torchpose.vision.camera import StereoCamera", []),
        ("vision/stereo.py", "from torchpose.vision import camera", []),
        ("vision/stereo.py", "from .camera import StereoCamera", []),
        ("vision/stereo.py", "from . import background", ["torchpose.vision.background"]),
        ("vision/stereo.py", "from ..body.model import BodyModel", ["torchpose.body.model"]),
        ("vision/camera.py", "from torchpose.vision.camera import StereoCamera", ["torchpose.vision.camera"]),
        ("vision/camera.py", "def f():\n    import torchpose.cli", ["torchpose.cli"]),
        ("geometry.py", "import torchpose", ["torchpose"]),
        ("activity/hmm.py", "from torchpose.geometry import rotation", []),
        ("activity/hmm.py", "from torchpose.body.model import BodyModel", ["torchpose.body.model"]),
        ("vision/__init__.py", "from torchpose.vision.stereo import GrowingSeeds", []),
        ("vision/__init__.py", "from torchpose.body.model import BodyModel", ["torchpose.body.model"]),
        ("recording.py", "import torch\nfrom torchpose.vision.camera import StereoCamera", []),
        ("recording.py", "from torchpose.pipeline import StereoToPose", ["torchpose.pipeline"]),
    ],
)
def test_the_rule_itself(file: str, line: str, wrong: list[str]):
    assert violations(PACKAGE / file, ast.parse(line)) == wrong


def test_top_level_looks_into_classes_but_not_into_functions():
    source = "class A:\n    import rerun\n    def f(self):\n        import ray\nif x:\n    import matplotlib"
    assert set(imports(PACKAGE / "geometry.py", top_level(ast.parse(source)))) == {"rerun", "matplotlib"}
