"""Equations of the pages as MathML, which browsers set by themselves: nothing is fetched."""

import re
from html import unescape

from latex2mathml.converter import convert

_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(html: str, **_) -> str:
    """Replace what the Markdown extension has marked as an equation."""

    def mathml(found: re.Match) -> str:
        display = "block" if found[1] == "div" else "inline"
        return convert(unescape(found[2]), display=display)

    return _EQUATION.sub(mathml, html)
