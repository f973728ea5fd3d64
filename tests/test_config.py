"""Settings: from YAML and the command line into frozen dataclasses, and every mistake by its message."""

import dataclasses
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import pytest
import torch

from torchpose.atomic import replacing
from torchpose.cli import (
    CONFIG_TYPES,
    CONFIGS,
    InferConfig,
    Kind,
    find_device,
    help_text,
    load_config,
    run_command,
)
from torchpose.manual import FIRST
from torchpose.recording import open_recording
from torchpose.settings import compose_config, config_groups, setting_rows

ROOT = Path(__file__).resolve().parents[1]


class Solver(Enum):
    SIMPLE = "simple"
    ROBUST = "robust"


@dataclass(frozen=True)
class Steps:
    weights: tuple[float, ...] = (1.0, 2.0)  # of each step
    names: tuple[str, ...] = ()
    damping: float = 1e-3

    def __post_init__(self) -> None:
        if self.damping <= 0:
            raise ValueError(f"damping must be positive, got {self.damping}; 0.001 is a good start")


@dataclass(frozen=True)
class Fitting:
    em_steps: int = 5  # rounds a frame
    robust: bool = True
    solver: Solver = Solver.SIMPLE
    # above,
    # in two lines
    body: str | None = None
    limit: float | None = 2.5
    steps: Steps = Steps()


@dataclass(frozen=True)
class Root:
    recording: str | None = None  # a folder
    output: str = "runs"
    fitting: Fitting = Fitting()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    files = {
        "root.yaml": "defaults: [_self_, {fitting: quick}, {optional experiment: null}]\noutput: results\n",
        "fitting/quick.yaml": "em_steps: 2\nsteps:\n  weights: [3, 4, 5]\n",
        "fitting/careful.yaml": "em_steps: 20\nsolver: ROBUST\n",
        "experiment/night.yaml": "# @package _global_\n"
        "defaults: [{override /fitting: careful}]\nfitting: {limit: null}\noutput: night\n",
        "fitting/typo.yaml": "steps: {weigths: [1]}\n",
        "fitting/wrong.yaml": "em_steps: many\n",
        "fitting/broken.yaml": "em_steps: [\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_files_hold_the_differences(folder: Path):
    config = compose_config(Root, folder, "root")
    assert config == Root(None, "results", Fitting(em_steps=2, steps=Steps(weights=(3.0, 4.0, 5.0))))
    assert isinstance(config.fitting.steps.weights, tuple)
    assert isinstance(config.fitting.steps.weights[0], float)
    assert hash(config)
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.fitting.em_steps = 3


def test_groups_are_chosen_by_name(folder: Path):
    assert compose_config(Root, folder, "root", ["fitting=careful"]).fitting == Fitting(
        20, solver=Solver.ROBUST
    )
    night = compose_config(Root, folder, "root", ["experiment=night"])
    assert night == Root(None, "night", Fitting(20, solver=Solver.ROBUST, limit=None))
    assert config_groups(folder, "root") == {
        "fitting": ["broken", "careful", "quick", "typo", "wrong"],
        "experiment": ["night"],
    }


def test_what_is_typed_comes_last(folder: Path):
    typed = [
        "fitting.em_steps=7",
        "fitting.robust=false",
        "fitting=careful",  # the order does not matter
        "fitting.solver=SIMPLE",
        "fitting.steps.weights=[1, 2.5]",
        "fitting.steps.names=[a, b]",
        "fitting.steps.damping=1e-5",
        "fitting.limit=null",
        "fitting.body=null",
    ]
    steps = Steps((1.0, 2.5), ("a", "b"), 1e-5)
    expected = Fitting(7, False, Solver.SIMPLE, None, None, steps)
    assert compose_config(Root, folder, "root", typed).fitting == expected


@pytest.mark.parametrize(
    "path",
    ["/a b/c", "C:\\films (2)\\x", "/a/b=c", "1", "true", "{x}", "*.png", "ü", "'quoted'", "a: b", "# c"],
)
def test_any_path_will_do(folder: Path, path: str):
    assert compose_config(Root, folder, "root", [f"recording={path}"]).recording == path


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("fitting.em_step=7", "unknown config key 'fitting.em_step'; did you mean 'em_steps'?"),
        ("fiting.em_steps=7", "unknown config key 'fiting.em_steps'; did you mean 'fitting'?"),
        ("experimant=night", "unknown config key 'experimant'; did you mean 'experiment'?"),
        ("zzz=1", "unknown config key 'zzz'; there are recording, output, fitting, experiment"),
        ("output.em_steps=7", "unknown config key 'output.em_steps'; there is nothing below it"),
        (
            "fitting.steps.weights.a=7",
            "unknown config key 'fitting.steps.weights.a'; there is nothing below it",
        ),
        (
            "fitting.steps=7",
            "fitting.steps must be given one setting at a time, such as fitting.steps.weights=...",
        ),
        ("fitting=carefull", "unknown fitting 'carefull'; did you mean 'careful'?"),
        ("experiment=zzz", "unknown experiment 'zzz'; there are night"),
        ("fitting.em_steps=many", "fitting.em_steps must be a whole number, got 'many'; correct the value"),
        ("fitting.em_steps=2.5", "fitting.em_steps must be a whole number, got 2.5; correct the value"),
        ("fitting.em_steps=null", "fitting.em_steps must be a whole number, got None; correct the value"),
        ("fitting.em_steps=[1", "fitting.em_steps must be a whole number, got '[1'; correct the value"),
        ("fitting.limit=[1]", "fitting.limit must be a number or null, got [1]; correct the value"),
        ("fitting.robust=7x", "fitting.robust must be true or false, got '7x'; correct the value"),
        (
            "fitting.solver=FAST",
            "fitting.solver must be one of SIMPLE, ROBUST, got 'FAST'; correct the value",
        ),
        (
            "fitting.steps.weights=[1, a]",
            "fitting.steps.weights must be a list [...], each item a number, got [1, 'a']; correct the value",
        ),
        (
            "fitting.steps.weights=3",
            "fitting.steps.weights must be a list [...], each item a number, got 3; correct the value",
        ),
        ("fitting.steps.damping=0", "fitting.steps.damping must be positive, got 0.0; 0.001 is a good start"),
        ("my_folder", "settings must be given as key=value, got 'my_folder'; --help-all lists them"),
        ("=3", "settings must be given as key=value, got '=3'; --help-all lists them"),
        ("fitting=typo", "unknown config key 'fitting.steps.weigths'; did you mean 'weights'?"),
        ("fitting=wrong", "fitting.em_steps must be a whole number, got 'many'; correct the value"),
    ],
)
def test_mistakes_are_told_in_one_sentence(folder: Path, override: str, message: str):
    with pytest.raises(ValueError) as error:  # noqa: PT011  (the whole message is compared)
        compose_config(Root, folder, "root", [override])
    assert str(error.value) == message


def test_a_broken_file_is_told_in_one_line(folder: Path):
    with pytest.raises(ValueError, match=r"the files in .* must go together, got: .*; correct them") as error:
        compose_config(Root, folder, "root", ["fitting=broken"])
    assert "\n" not in str(error.value)


def test_every_setting_has_its_comment():
    assert setting_rows(Root()) == [
        ("recording=null", "a folder"),
        ("output=runs", ""),
        ("fitting.em_steps=5", "rounds a frame"),
        ("fitting.robust=true", ""),
        ("fitting.solver=SIMPLE", ""),
        ("fitting.body=null", "above, in two lines"),
        ("fitting.limit=2.5", ""),
        ("fitting.steps.weights=[1.0,2.0]", "of each step"),
        ("fitting.steps.names=[]", ""),
        ("fitting.steps.damping=0.001", ""),
    ]


CHOICES = [
    (kind, [f"{group}={name}"])
    for kind in CONFIG_TYPES
    for group, names in config_groups(CONFIGS, kind).items()
    for name in names
]


@pytest.mark.parametrize(("kind", "overrides"), [("infer", []), ("train", []), *CHOICES])
def test_every_config_that_we_ship_is_valid(kind: Kind, overrides: list[str]):
    assert isinstance(load_config(kind, overrides), CONFIG_TYPES[kind])


@pytest.mark.parametrize("kind", ["infer", "train"])
def test_help_says_what_is_needed_on_a_screen_or_two(kind: Kind):
    text = help_text(kind)
    assert f"usage: python {kind}.py" in text
    assert text.count(f"\n  python {kind}.py") == 3
    assert len(text.splitlines()) <= 50
    assert max(map(len, text.splitlines())) <= 100
    assert "start over instead of continuing" in " ".join(text.split())
    for name in FIRST[kind]:
        assert f"\n  {name}=" in text, name


@pytest.mark.parametrize("kind", ["infer", "train"])
def test_the_whole_help_has_every_setting_once_under_a_heading(kind: Kind):
    text = help_text(kind, whole=True)
    assert max(map(len, text.splitlines())) <= 100
    joined = text.replace("=\n    ", "=").splitlines()  # a long list goes below its name
    for setting, _ in setting_rows(load_config(kind)):
        assert sum(setting in line.split() for line in joined) == 1, setting
    assert "\npose.registration:" in text
    assert "\neyes.stereo:" in text


@pytest.mark.parametrize("kind", ["infer", "train"])
def test_the_commands_in_the_help_are_real(kind: Kind):
    commands = [line for line in help_text(kind).splitlines() if line.startswith(f"  python {kind}.py")]
    assert len(commands) >= 3
    for line in commands:
        load_config(kind, re.split(r"\s{2,}", line.strip())[0].split()[2:])  # raises for an unknown one


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("max_frames=0", "max_frames must be at least 1, got 0"),
        ("max_width=8", "max_width must be at least 64 px, got 8"),
        ("seed=-1", "seed must be 0 or more, got -1"),
        ("threads=0", "threads must be at least 1, got 0"),
    ],
)
def test_infer_config_is_checked(override: str, message: str):
    with pytest.raises(ValueError, match=message):
        load_config("infer", [override])


def test_a_command_gets_its_configuration_its_device_and_its_seed():
    seen = []
    draws = []

    def action(config: InferConfig, device: torch.device) -> None:
        seen.append((config, device))
        draws.append(torch.rand(()).item())

    for seed in (3, 3, 4):
        assert run_command("infer", ["recording=x", f"seed={seed}"], action) == 0
    config, device = seen[0]
    assert (config.recording, config.seed, device) == ("x", 3, torch.device("cpu"))
    assert draws[0] == draws[1] != draws[2]
    assert torch.get_num_threads() == 1


def fail_reading(config: object, device: object) -> None:
    open_recording("/no such folder")


def fail_in_a_library(config: object, device: object) -> None:
    int("a fault of ours")


def fail_on_disk(config: object, device: object) -> None:
    with replacing(Path("/proc/no/such/file.csv")):
        pass


def interrupt(config: object, device: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("argv", "action", "code", "message"),
    [
        (["recordin=x"], print, 2, "error: unknown config key 'recordin'; did you mean 'recording'?\n"),
        (["device=gpu"], print, 2, "error: device must be one that this machine has, got 'gpu'; device=cpu"),
        (
            [],
            fail_reading,
            2,
            "error: the recording must be a folder or a video, but /no such folder does not exist",
        ),
        ([], fail_on_disk, 2, "error: /proc/no/such/file.csv must be written, got: "),
        ([], interrupt, 130, "\ninterrupted: the same command again goes on where this one stopped\n"),
    ],
)
def test_exit_codes(
    capsys: pytest.CaptureFixture, argv: list[str], action: Callable, code: int, message: str
):
    assert run_command("infer", argv, action) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(message)
    assert captured.err.strip().count("\n") == 0


def test_a_fault_of_ours_keeps_its_traceback():
    with pytest.raises(ValueError, match="a fault of ours"):
        run_command("infer", [], fail_in_a_library)


def test_help_runs_nothing(capsys: pytest.CaptureFixture):
    assert run_command("infer", ["recording=x", "--help"], interrupt) == 0
    assert "recording=null" in capsys.readouterr().out


def test_no_device_of_that_name():
    assert find_device("cpu") == torch.device("cpu")
    with pytest.raises(ValueError, match="got 'cuda:99'; device=cpu works everywhere"):
        find_device("cuda:99")


@pytest.mark.parametrize("script", ["infer.py", "train.py"])
def test_the_scripts_answer_from_any_folder(tmp_path: Path, script: str):
    """Both are thin: what they print comes from the package, and a mistake writes nothing."""
    run = [sys.executable, str(ROOT / script)]
    wrong = subprocess.run([*run, "outptu=x"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert wrong.stderr == "error: unknown config key 'outptu'; did you mean 'output'?\n"
    assert list(tmp_path.iterdir()) == []


def test_replacing_keeps_the_old_file_after_an_error(tmp_path: Path):
    path = tmp_path / "new" / "poses.csv"
    with replacing(path) as partial:
        assert partial.suffix == ".csv"
        partial.write_text("whole")
        assert not path.exists()

    def fail() -> None:
        with replacing(path) as partial:
            partial.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_text() == "whole"
    assert list(path.parent.iterdir()) == [path]
