"""The documentation: it builds strictly and offline, every public name is in it, and its commands are real."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import torchpose as tp
from torchpose.cli import CONFIGS, load_config

ROOT = CONFIGS.parent
DOCS = ROOT / "docs"
EXTRA = "needs the extra docs: pip install -c constraints.txt -e '.[docs]'"
PAGES = [ROOT / "README.md", ROOT / "examples" / "README.md", *sorted(DOCS.glob("*.md"))]


def pages_of(nav: list) -> list[str]:
    """The files of MkDocs's nav, in order."""
    found: list[str] = []
    for entry in nav:
        target = next(iter(entry.values())) if isinstance(entry, dict) else entry
        found += [target] if isinstance(target, str) else pages_of(target)
    return found


def test_every_public_name_is_described_once():
    text = "\n".join(path.read_text() for path in sorted((DOCS / "api").glob("*.md")))
    described = re.findall(r"^::: torchpose\.(\w+)$", text, re.M)
    assert sorted(described) == sorted(set(tp.__all__) - {"__version__"})
    for name in described:
        assert f"#torchpose.{name})" in (DOCS / "api" / "index.md").read_text()


def test_the_navigation_names_every_page_once():
    named = pages_of(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    assert sorted(named) == sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_commands_are_real(page: Path):
    """Every command names a script, a benchmark or a target that exists, with settings that are known."""
    commands = re.findall(
        r"^(?:OMP_NUM_THREADS=1 )?((?:python|make) .*?)(?:\s+#.*)?$", page.read_text(), re.M
    )
    assert len(commands) >= {"README.md": 6, "tutorial.md": 6}.get(page.name, 0) or page.parent != ROOT
    for command in commands:
        words = command.split(" && ")[0].split()
        if words[0] == "make":
            assert f"\n{words[1]}:" in (ROOT / "Makefile").read_text(), command
        elif words[1] == "-m":
            assert (ROOT / Path(*words[2].split("."))).with_suffix(".py").is_file(), command
        elif words[1] in ("infer.py", "train.py"):
            overrides = [word for word in words[2:] if "=" in word]
            load_config(
                "infer" if words[1] == "infer.py" else "train", overrides
            )  # raises for an unknown one
        else:
            assert (ROOT / words[1]).is_file(), command


def test_equations_become_mathml():
    pytest.importorskip("latex2mathml", reason=EXTRA)
    sys.path.insert(0, str(DOCS))
    try:
        from equation import on_page_content
    finally:
        sys.path.remove(str(DOCS))
    page = '<p><span class="arithmatex">\\(a &lt; b\\)</span></p><code>\\(c\\)</code>'
    page += '<div class="arithmatex">\\[\nx = \\frac{1}{2} \\tag{3.6}\n\\]</div>'
    html = on_page_content(page)
    assert html.count("<math") == 2
    assert "<mo>&#x0003C;</mo>" in html  # MathML is made of elements: an operator, not a tag
    assert '<span class="number" id="eq-3.6">(3.6)</span>' in html
    assert html.count("3.6") == 2  # once as the mark, once as the number; not within the formula
    assert "<mfrac>" in html
    assert "<code>\\(c\\)</code>" in html


def test_the_site_builds_strictly_and_asks_nobody(tmp_path: Path):
    """Any broken link, missing page or unresolved name fails; no page loads anything from elsewhere."""
    for module in ("mkdocs", "material", "mkdocstrings", "latex2mathml"):
        pytest.importorskip(module, reason=EXTRA)
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1", "http_proxy": "http://127.0.0.1:9"}
    done = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stdout + done.stderr
    pages = sorted(tmp_path.rglob("*.html"))
    assert len(pages) >= len(list(DOCS.rglob("*.md")))
    loads = re.compile(r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^>]*>", re.I)
    for page in pages:
        assert loads.findall(page.read_text()) == [], page
    method = (tmp_path / "method.html").read_text()
    assert method.count("<math") > 100
    assert "merror" not in method
    assert 'class="arithmatex"' not in method


def test_the_equations_of_the_thesis_are_all_there_in_order():
    """Numbers of chapter 3 that carry a formula of their own, as the thesis counts them."""
    tags = re.findall(r"\\tag\{(3\.\d+)\}", (DOCS / "method.md").read_text())
    prose = {"3.16", "3.17", "3.18", "3.19", "3.22", "3.23"}  # named in the text, or corrected
    assert tags == [f"3.{n}" for n in range(1, 25) if f"3.{n}" not in prose]
    for number in prose:
        assert f"{number}" in (DOCS / "method.md").read_text() or number == "3.22"


def test_fields_are_described_by_their_comments():
    """The reference has what `--help` has: the comment behind a field, or above it, with its unit."""
    pytest.importorskip("griffe", reason=EXTRA)
    sys.path.insert(0, str(DOCS))
    try:
        from comment import comment_of
    finally:
        sys.path.remove(str(DOCS))
    lines = [
        "class A:",
        "    # m, above,",
        "    # in two lines",
        "    a: float = 1.0",
        "    b: tuple[float, float] = (",
        "        1.0,  # px, low",
        "        '#2',  # and high",
        "    )",
        "    c: int",
    ]
    assert comment_of(lines, 4, 4) == "m, above, in two lines"
    assert comment_of(lines, 5, 8) == "px, low and high"
    assert comment_of(lines, 9, 9) == ""
