"""Equations as MathML, which browsers draw by themselves: a hook of MkDocs, see `hooks` in mkdocs.yml.

`pymdownx.arithmatex` finds $x$ and $$y$$ outside of code; `\\tag{3.6}` puts a number at the right of an equation.
"""

import html
import re
from typing import Any

from latex2mathml.converter import convert

_MATH = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)
_TAG = re.compile(r"\\tag\{([^}]*)\}")


def on_page_content(content: str, **_: Any) -> str:
    """The page's HTML with its formulas as MathML."""
    return _MATH.sub(_mathml, content)


def _mathml(found: re.Match[str]) -> str:
    latex = html.unescape(found[2]).strip()[2:-2].strip()  # without \( \) or \[ \]
    tag = _TAG.search(latex)
    block = found[1] == "div"
    drawn = convert(_TAG.sub("", latex), display="block" if block else "inline")
    if not block:
        return drawn
    number = f'<span class="number" id="eq-{tag[1]}">({tag[1]})</span>' if tag else ""
    return f'<div class="equation">{drawn}{number}</div>'
