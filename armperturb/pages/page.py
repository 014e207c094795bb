"""One HTML file that holds everything and opens offline: sections from templates, figures inside."""

import base64
from collections.abc import Mapping
from importlib import metadata
from typing import Any, NamedTuple, Self

import jinja2
from jinja2.bccache import Bucket
from markupsafe import Markup
from matplotlib.figure import Figure

from armperturb.pages import formats
from armperturb.plots.style import svg


class Picture(NamedTuple):
    """A figure inside a page.

    Attributes:
      svg: its file.
      width: [inch].
      height: [inch].
    """

    svg: str
    width: float
    height: float

    @classmethod
    def of(cls, figure: Figure) -> Self:
        """A figure as it is drawn now."""
        width, height = figure.get_size_inches()
        return cls(svg(figure).decode(), float(width), float(height))

    @property
    def uri(self) -> str:
        """The SVG itself, as a data URI."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.svg.encode()).decode('ascii')}"


class _CompiledTemplates(jinja2.BytecodeCache):
    """Templates that were compiled for one page serve the next ones."""

    def __init__(self) -> None:
        self._compiled: dict[str, bytes] = {}

    def load_bytecode(self, bucket: Bucket) -> None:
        if bucket.key in self._compiled:
            bucket.bytecode_from_string(self._compiled[bucket.key])

    def dump_bytecode(self, bucket: Bucket) -> None:
        self._compiled[bucket.key] = bucket.bytecode_to_string()


_compiled_templates = _CompiledTemplates()


def rendered(
    package: str,
    page: str,
    sections: Mapping[str, Mapping[str, Any]],
    titles: Mapping[str, str],
    pictures: Mapping[str, Picture | str],
    **shared: Any,
) -> str:
    """A page of sections.

    Args:
      package: whose folder `templates` holds the page's templates; they may extend and import those of this package.
      page: template of the whole, which extends `page.html`.
      sections: template of each section, in order, to the values that it alone shows.
      titles: of the sections; templates know them as `titles`, and the names of the sections as `shown`.
      pictures: figures by name; instead of one that could not be drawn, the reason.
      **shared: values that all templates show.
    """
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(package), jinja2.PackageLoader(__package__)]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        bytecode_cache=_compiled_templates,
    )
    for name in ("chance", "digits", "fixed", "mean_sd", "signed", "symbol", "words"):
        environment.filters[name] = getattr(formats, name)
    environment.globals.update(shared, pictures=pictures, titles=titles, shown=tuple(sections))
    # Sections come out as markup, escaped already.
    bodies = {
        template: Markup(environment.get_template(f"{template}.html").render(values))
        for template, values in sections.items()
    }
    return environment.get_template(page).render(sections=bodies)


def versions(*packages: str) -> dict[str, str]:
    """Package to its version."""
    return {name: metadata.version(name) for name in packages}
