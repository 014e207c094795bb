"""Text that users read, and names that engineers read, use the words of the field."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PHRASES = re.compile(
    r"\b(greatest likelihood|likelier|hardly known|told apart|can hardly be told|bl[eo]ws? up|blown up|restless\w*"
    r"|weighed anew|beside the thesis|doubts|people who yield|thins|a way in|house|crew)\b".replace(" ", r"[\s#]+"),
    re.IGNORECASE,
)
NAMES = frozenset({"one", "found", "own", "told", "kept", "crew"})
SCRIPTS = ("benchmarks/", "docs/")


def pages():
    """Every file that has text for users, as paths relative to the root."""
    for pattern in (
        "*.md",
        "docs/**/*.md",
        "docs/**/*.py",
        "examples/*.md",
        "armperturb/**/*.py",
        "armperturb/**/*.html",
        "armperturb/**/*.js",
        "benchmarks/**/*.py",
        "examples/*.py",
    ):
        yield from sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob(pattern))


@cache
def strings_and_names(path):
    """(line, text) of each string of a module, docstrings and the constant parts of f-strings included; of each name.

    The syntax tree, of which there are hundreds, isn't kept.
    """
    strings, names = [], []
    waiting = [ast.parse((ROOT / path).read_text(encoding="utf-8"))]
    while waiting:  # as `ast.walk`, which takes twice as long
        node = waiting.pop()
        if isinstance(node, ast.Constant):
            if isinstance(node.value, str):
                strings.append((node.lineno, node.value))
            continue
        if isinstance(node, ast.Name):
            if isinstance(node.ctx, ast.Store):
                names.append((node.lineno, node.id))
            continue
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.append((node.lineno, node.attr))
        elif isinstance(node, ast.arg | ast.alias):
            names.append((node.lineno, node.arg if isinstance(node, ast.arg) else node.asname))
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.append((node.lineno, node.name))
        for part in vars(node).values():
            if isinstance(part, list):
                waiting += [each for each in part if isinstance(each, ast.AST)]
            elif isinstance(part, ast.AST) and not isinstance(part, ast.expr_context):
                waiting.append(part)
    return strings, names


def phrases(path):
    text = (ROOT / path).read_text(encoding="utf-8")
    parts = [(1, text), *(strings_and_names(path)[0] if path.endswith(".py") else ())]  # comments; joined strings
    for line, part in parts:
        for match in PHRASES.finditer(part):
            yield f"{path}:{line + part.count(chr(10), 0, match.start())}: {match.group()}"


def names(path):
    for line, name in strings_and_names(path)[1]:
        if name in NAMES:
            yield f"{path}:{line}: {name}"


def remarks(find, paths):
    return sorted({remark for path in paths for remark in find(path)})


@pytest.mark.slow(reason="reads all text")
def test_text_has_the_words_of_the_field():
    assert not remarks(phrases, pages())


def test_phrases_are_seen_across_lines():
    assert PHRASES.search("the greatest\n    # likelihood")
    assert not PHRASES.search("household, strengthens")


@pytest.mark.slow(reason="parses all modules")
def test_names_say_what_they_hold():
    assert not remarks(names, [path for path in pages() if path.endswith(".py") and not path.startswith(SCRIPTS)])
