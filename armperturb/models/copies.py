"""How large a model in MJCF is once MuJoCo has made the copies that it asks for, told before MuJoCo makes them."""

import math
from pathlib import Path
from xml.etree import ElementTree

from armperturb.files import require_input

LARGEST = 2**26
"""Largest file of a model or of a part that it includes [byte]."""

MOST = 200_000
"""Elements that a model may have."""

COPYING = ("replicate", "composite", "flexcomp")
"""Elements that MuJoCo copies as often as their `count` says, a number or several to be multiplied."""


def require_moderate(path: Path) -> None:
    """Refuse a model that is no file, or too large once copies are made.

    Args:
      path: of an MJCF file. Files that it includes count as well; what is no XML is left to MuJoCo.

    Raises:
      FileNotFoundError: there is no such file; a pipe or a device is none.
      ValueError: it, or what it includes, is too large.
    """
    total, waiting, known = 0, [(path, 1)], {path.resolve()}
    while waiting:
        file, factors = waiting.pop()
        require_input(file, LARGEST)
        above = [factors]
        try:
            for event, element in ElementTree.iterparse(file, events=("start", "end")):
                if event == "end":
                    above.pop()
                    element.clear()
                    continue
                total += above[-1]
                if total > MOST:
                    raise ValueError(f"{path}: more than {MOST} elements with all copies; expected fewer (count)")
                above.append(above[-1] * _copies(element))
                part = path.parent / element.get("file", "")
                # MuJoCo refuses files that are included twice.
                if element.tag == "include" and part.is_file() and part.resolve() not in known:
                    known.add(part.resolve())
                    waiting.append((part, above[-1]))
        except ElementTree.ParseError:
            continue


def _copies(element: ElementTree.Element) -> int:
    """How often the content of an element is there."""
    if element.tag not in COPYING:
        return 1
    numbers = [text for text in element.get("count", "1").split() if text.isdecimal() and len(text) < 19]
    return max(1, math.prod(map(int, numbers)))
